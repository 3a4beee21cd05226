"""The picture of costates over time: Pontryagin's λ, and DV of a solution on a grid along the same path."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hjbjax.plotting.style import COLOURS, axes_of, label_axes, legend


def costates(extremal: Any, *, solution: Any = None, ax: Any = None, names: Sequence[str] | None = None) -> list[Any]:
    """The costates of an extremal over time, and DV of a solution along its path: two roads to one curve.

    Args:
      extremal: what ``pontryagin`` returned.

    Keyword Args:
      solution: of the same problem on a grid, or ``None``; its DV is drawn broken, where the path is inside the grid.
      ax: matplotlib axes to draw on; ``None`` makes a figure.
      names: of the states, in place of the grid's.

    Returns:
      The artists: one line a state, then those of DV, then the legend.

    Example:
      >>> from types import SimpleNamespace
      >>> extremal = SimpleNamespace(times=np.array([0.0, 1.0]), costates=np.array([[2.0], [0.0]]))
      >>> costates(extremal)[0].get_ydata().tolist()
      [2.0, 0.0]
    """
    times, costates = np.asarray(extremal.times), np.asarray(extremal.costates)
    count = costates.shape[1]
    names = tuple(names or (solution.grid.names if solution is not None else (f"x{i + 1}" for i in range(count))))
    ax = axes_of(ax, wide=True)
    colours = [COLOURS[i % len(COLOURS)] for i in range(count)]
    artists = [
        ax.plot(times, costates[:, i], color=colours[i], linewidth=1.4, label=f"λ, {names[i]}")[0] for i in range(count)
    ]
    if solution is not None:
        where = (times,) * (solution.times is not None) + (np.asarray(solution.grid.wrap(extremal.states)),)
        slopes = np.ma.masked_invalid(solution.costate_at(*where))
        for i in range(count):
            style = {"color": colours[i], "linewidth": 3.6, "alpha": 0.4, "linestyle": "--"}
            artists += ax.plot(times, slopes[:, i], label=f"DV, {names[i]}", **style)
    label_axes(ax, "t", "costate")
    return [*artists, legend(ax)]
