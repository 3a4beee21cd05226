"""The picture of costates over time: Pontryagin's λ, and DV of a solution on a grid along the same path."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.plotting.scales import set_ticks
from hjbjax.plotting.style import COLOURS, Picture, axes_of, label_axes, legend

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from hjbjax.extremals.necessary_conditions import Extremal
    from hjbjax.solution.solution import Solution


def costates(
    extremal: Extremal, *, solution: Solution | None = None, ax: Axes | None = None, names: Sequence[str] | None = None
) -> Picture:
    """The costates of an extremal over time, and DV of a solution along its path: two roads to one curve.

    Args:
      extremal: the extremal of ``pontryagin``.

    Keyword Args:
      solution: of the same problem on a grid, or ``None``; its DV is drawn broken, where the path is inside the grid.
      ax: matplotlib axes to draw on; ``None`` takes pyplot's current ones.
      names: of the states, in place of the grid's.

    Returns:
      The picture: one line a state, then those of DV, then the legend.

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
    artists: list[Artist] = [
        ax.plot(times, costates[:, i], color=colours[i], linewidth=1.4, label=f"λ, {names[i]}")[0] for i in range(count)
    ]
    if solution is not None:
        # a marched V has the time as its first argument; angles of an extremal run on, those of the grid do not
        where = (times,) * (solution.times is not None) + (np.asarray(solution.grid.wrap(extremal.states)),)
        with warnings.catch_warnings(action="ignore"):  # NaN outside the grid: there the line is interrupted
            slopes = np.ma.masked_invalid(solution.costate_at(*where))
        for i in range(count):
            # broad and pale: the line λ stays to be seen where the two agree
            style: dict[str, Any] = {"color": colours[i], "linewidth": 3.6, "alpha": 0.4, "linestyle": "--"}
            artists += ax.plot(times, slopes[:, i], label=f"DV, {names[i]}", **style)
    label_axes(ax, "t", "costate")
    set_ticks(ax.xaxis, False)
    set_ticks(ax.yaxis, False)
    return Picture([*artists, legend(ax)], ax)
