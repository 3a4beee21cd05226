"""Plots over time: states, controls and modes of a path, and the costates of an extremal next to DV of a solution."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.plotting.scales import is_angle, set_ticks, time_label
from hjbjax.plotting.shading import is_level, limits_around
from hjbjax.plotting.slices import described, span_of, without_jumps
from hjbjax.plotting.style import COLOURS, Picture, axes_of, drawing, label_axes, legend, line_look
from hjbjax.problem.grid import Grid

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from hjbjax.extremals.necessary_conditions import Extremal
    from hjbjax.feedback.path import Path
    from hjbjax.solution.solution import Solution

JUMPS = 14  # if a control jumps more often, its running mean is drawn
WINDOW = 0.04  # fraction of the duration, the width of the running mean for such a control


@drawing
def costates(
    extremal: Extremal, *, solution: Solution | None = None, ax: Axes | None = None, names: Sequence[str] | None = None
) -> Picture:
    """Plot the costates of an extremal over time, and DV of a grid solution along its path to compare with.

    Args:
      extremal: the extremal of ``pontryagin``.

    Keyword Args:
      solution: a grid solution of the same problem, or ``None``; its DV is a broad dashed line, drawn inside the grid.
      ax: matplotlib axes to draw on; ``None`` makes a new figure.
      names: names of the states, instead of the grid's.

    Returns:
      The picture: one line per state, then the lines of DV, then the legend.

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
    looks = [line_look(i) for i in range(count)]
    artists: list[Artist] = [
        ax.plot(times, costates[:, i], linewidth=1.4, label=f"λ, {names[i]}", **looks[i])[0] for i in range(count)
    ]
    if solution is not None:
        # a marched V takes the time first; the angles of an extremal are unwound and must be wrapped into the grid
        where = (times,) * (solution.times is not None) + (np.asarray(solution.grid.wrap(extremal.states)),)
        with warnings.catch_warnings(action="ignore"):  # outside the grid DV is NaN, which interrupts the line
            slopes = np.ma.masked_invalid(solution.costate_at(*where))
        for i in range(count):
            # broad and pale, so that λ remains visible where the two agree
            style: dict[str, Any] = looks[i] | {"linewidth": 3.6, "alpha": 0.4, "linestyle": "--"}
            artists += ax.plot(times, slopes[:, i], label=f"DV, {names[i]}", **style)
    label_axes(ax, time_label(None if solution is None else solution.grid, described(solution).labels), "costate")
    set_ticks(ax.xaxis, False)
    set_ticks(ax.yaxis, False)
    return Picture([*artists, legend(ax)], ax)


@drawing
def controls(
    path: Path, *, ax: Axes | None = None, names: Sequence[str] | None = None, solution: Solution | None = None
) -> Picture:
    """Plot the inputs of a path over time as lines, or as steps if they are constant in each interval.

    ``path.controls`` has shape (k, m), the controls at the start of each interval. A line therefore ends at the start
    of the last interval, and a step at its end. A control that jumps back and forth too often for a plot is drawn pale,
    with its running mean.

    Args:
      path: the path of ``simulate``.

    Keyword Args:
      ax: matplotlib axes to draw on; ``None`` makes a new figure.
      names: names of the inputs.
      solution: gives the names, and the ranges of the controls, so that tiny variations are drawn as constant.

    Returns:
      The picture: one line per input, then the running means, then the legend.
    """
    ax = axes_of(ax, wide=True)
    return Picture(inputs_over_time(ax, path, range(np.shape(path.controls)[1]), solution, names), ax)


def inputs_over_time(
    ax: Axes, path: Path, chosen: Sequence[int], solution: Solution | None = None, names: Sequence[str] | None = None
) -> list[Artist]:
    """Draw the chosen inputs of a path over time; see ``controls``."""
    times, inputs = np.asarray(path.times), np.asarray(path.controls)
    count = inputs.shape[1]
    words = described(solution).labels
    names = tuple(names or (words.control(i, count) for i in range(count)))
    # a step continues through the last interval; a line stops before it, because the control at the end is unknown
    held = getattr(path, "held", True) or len(inputs) == 1  # extremals and users' own paths do not say
    drawing = "steps-post" if held else "default"
    # a path that ends at once has no controls
    shown = np.concatenate([inputs, inputs[-1:] if held else np.full((1, count), np.nan)])
    shown = shown if len(inputs) else np.full((len(times), count), np.nan)
    lines: list[Artist] = []
    means: list[Artist] = []
    for number, i in enumerate(chosen):
        look = line_look(number)
        restless = np.sum(np.abs(np.diff(inputs[:, i])) > np.ptp(inputs[:, i]) / 2) > JUMPS if len(inputs) else False
        width: dict[str, Any] = {"linewidth": 0.6, "alpha": 0.5} if restless else {"linewidth": 1.4}
        lines += ax.plot(times, shown[:, i], drawstyle=drawing, label=names[i], **look, **width)
        if restless:
            window = (times[-1] - times[0]) * WINDOW
            mean = _running_mean(times, inputs[:, i], window)
            means += ax.plot(times, mean, label=f"{names[i]}, mean over {window:.2g}", linewidth=1.4, **look)
    label_axes(
        ax, time_label(None if solution is None else solution.grid, words),
        names[chosen[0]] if len(chosen) == 1 else "control",
    )  # fmt: skip
    set_ticks(ax.xaxis, False)
    set_ticks(ax.yaxis, False)
    span = max((span_of(solution, i) for i in chosen), default=0.0) if solution is not None else 0.0
    known = inputs[:, list(chosen)]
    if known.size and is_level(known, span):  # otherwise the axis would show rounding errors
        ax.set_ylim(*limits_around(float(np.mean(known)), span))
    return [*lines, *means, *([legend(ax)] if len(chosen) > 1 or means else [])]


def states_over_time(
    ax: Axes, path: Path, names: Sequence[str], chosen: Sequence[int], grid: Grid | None, color: str | None = None
) -> list[Artist]:
    """Draw the chosen states of a path over time, periodic states without jumps at their seam."""
    times, states = np.asarray(path.times), without_jumps(np.asarray(path.states), grid)
    looks = [line_look(number) | ({"color": color} if color else {}) for number in range(len(chosen))]
    artists: list[Artist] = [
        ax.plot(times, states[:, i], label=names[i], **look)[0] for i, look in zip(chosen, looks, strict=True)
    ]
    only = len(chosen) == 1
    label_axes(ax, time_label(grid), names[chosen[0]] if only else "state")
    set_ticks(ax.xaxis, False)
    set_ticks(ax.yaxis, only and grid is not None and is_angle(grid, chosen[0]))
    return artists if only else [*artists, legend(ax)]


def modes_over_time(ax: Axes, path: Path, modes: Sequence[str]) -> list[Artist]:
    """Draw the mode of a path over time as steps between the names of the modes."""
    artists: list[Artist] = [
        *ax.plot(np.asarray(path.times), np.asarray(path.modes), drawstyle="steps-post", color=COLOURS[0])
    ]
    label_axes(ax, "t", "mode")
    ax.set_yticks(range(len(modes)), labels=list(modes))
    ax.set_ylim(-0.3, len(modes) - 0.7)
    return artists


def _running_mean(times: np.ndarray, held: np.ndarray, width: float) -> np.ndarray:
    """Means, (k+1,), of a step function with values (k,) over a window around each time, moved inward at the ends."""
    integral = np.concatenate([[0.0], np.cumsum(held * np.diff(times))])
    begin = np.clip(times - width / 2, times[0], times[-1] - width)
    return (np.interp(begin + width, times, integral) - np.interp(begin, times, integral)) / width
