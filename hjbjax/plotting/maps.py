"""Plots of a value, a feedback and its switching curve over one or two axes, and of paths."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.plotting.histories import controls
from hjbjax.plotting.modes import by_mode
from hjbjax.plotting.scales import is_angle, scale_axes, set_ticks, time_label
from hjbjax.plotting.shading import Look, dot_region, draw, fill_missing, frame, is_level, jumps
from hjbjax.plotting.slices import (
    Cuts,
    Region,
    Section,
    at_states,
    at_time,
    decided_sets,
    described,
    feedback,
    line_in_box,
    region_of,
    section_of,
    span_of,
    target_of,
    without_jumps,
    zeros,
)
from hjbjax.plotting.style import COLOURS, Picture, axes_of, drawing, label_axes, legend, new_figure, styled
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Number, State

SMOOTHING = 1.5  # width of the mean of signs at a switching curve, in cells

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from hjbjax.feedback.path import Path
    from hjbjax.solution.solution import Solution


@drawing
@by_mode
def value(
    solution: Solution,
    *,
    ax: Axes | None = None,
    fixed: Cuts | None = None,
    time: float | None = None,
    levels: int | Sequence[float] = 9,
    colorbar: bool = True,
    target: Callable[[State], Number] | None = None,
) -> Picture:
    """Plot the value function: a line over one axis, colours with contour lines over two axes.

    The set where it is optimal to stop, or to push, is dotted, up to the free boundary; see ``Solution.free_boundary``.

    Args:
      solution: the solution of ``solve`` or ``march``.

    Keyword Args:
      ax: matplotlib axes to draw on; ``None`` makes a new figure.
      fixed: coordinates at which axes are cut, by number or name; at most two axes may remain free. For a problem with
        modes also ``"mode"``; over one state all modes are drawn if it is not given.
      time: for a solution of ``march``, the time to draw. The nearest stored time is used; ``None`` is the earliest.
      levels: the number of contour lines, or their values; 0 for none.
      colorbar: draw a colour bar next to a two-dimensional plot.
      target: a function of the state, ≤ 0 inside a set that is outlined and hatched over two axes, because the numbers
        there need not be values; ``None`` uses the target of the solved problem.

    Returns:
      The picture: the line or the mesh first, with ``.figure`` and ``.save(path)``.

    Raises:
      ValueError: more than two axes are free, or ``fixed`` has an axis or a coordinate that does not exist.

    Example:
      >>> from types import SimpleNamespace
      >>> from matplotlib.figure import Figure
      >>> grid = Grid(lo=[-1.0], hi=[1.0], shape=(3,), names=("position",))
      >>> solution = SimpleNamespace(grid=grid, value=np.array([1.0, 0.0, 1.0]), times=None)
      >>> artists = value(solution, ax=Figure().add_subplot())
      >>> artists[0].axes.get_xlabel(), artists[0].get_ydata().tolist()
      ('position', [1.0, 0.0, 1.0])
    """
    field, caption = at_time(solution, solution.value, time)
    section = section_of("value", field, solution.grid, fixed, caption)
    ax = axes_of(ax)
    # .data has the masked numbers: infinity means unreachable, NaN must not be labelled so
    name = described(solution).labels.of_value
    lost = section.values.data[section.values.mask]
    hidden = "V = ∞" if np.all(np.isposinf(lost)) else "V = −∞" if np.all(np.isneginf(lost)) else "V not finite"
    section, regions = _without(section, target_of(solution, time) if target is None else target)
    artists = draw(ax, section, Look(name, hidden, colorbar), regions) + _stopped(ax, solution, section, time)
    lines = _levels(section.values, levels) if len(section.axes) == 2 else ()
    if len(lines):
        shades = fill_missing(section.values).T
        style: dict[str, Any] = {"levels": lines, "colors": "white", "linewidths": 0.6, "alpha": 0.65}
        artists.append(ax.contour(*section.coordinates, shades, **style))
    return Picture(artists, ax)


def _stopped(ax: Axes, solution: Solution, section: Section, time: float | None) -> list[Artist]:
    """Draw the stopping set and the push region of the solution, if there are any."""
    found = decided_sets(solution, section, time)
    return [artist for name, each in found.items() for artist in dot_region(ax, section, *each, name)]


def _without(section: Section, target: Callable[[State], Number] | None) -> tuple[Section, tuple[Region, ...]]:
    """Mask the nodes of the target and return its outline, over two axes only."""
    if target is None or len(section.axes) != 2:
        return section, ()
    region = region_of(target, section, "target")
    mask = np.ma.getmaskarray(section.values) | region.nodes
    return section._replace(values=np.ma.array(section.values.data, mask=mask)), (region,)


@drawing
@by_mode
def policy(
    solution: Solution,
    *,
    input: int = 0,
    ax: Axes | None = None,
    fixed: Cuts | None = None,
    time: float | None = None,
    colorbar: bool = True,
) -> Picture:
    """Plot one input of the feedback u(x): a line over one axis, colours over two axes.

    If the input changes sign, the colours diverge at zero. A feedback that jumps or is enumerated is drawn as cells,
    any other feedback smoothly. Nodes without a control or without a finite value are hatched. Where it is optimal to
    stop or to push no control acts, so none is drawn there.

    Args:
      solution: the solution of ``solve`` or ``march``.

    Keyword Args:
      input: index of the input.
      ax, fixed, time, colorbar: as in :func:`value`, which also describes the result and the errors.
    """
    section, label = feedback(solution, input, fixed, time)
    ax = axes_of(ax)
    decided = decided_sets(solution, section, time)
    section, regions = _without(section, target_of(solution, time))
    cells = described(solution).discrete or jumps(section.values.compressed())
    span = span_of(solution, input)
    inner = (slice(1, -1),) if len(section.axes) == 1 else ()
    # skip the two ends of a line, where the run ends, because hatches half a cell wide show nothing
    lost = np.ma.getmaskarray(section.values)[inner]
    hidden = "no control" if lost.any() or len(section.axes) == 2 else ""
    target = target_of(solution, time)
    if hidden and len(section.axes) == 1 and target is not None:
        within = at_states(target, section.states(section.coordinates))[inner] <= 0
        hidden = "target" if within[lost].all() else hidden
    idle = np.any([inside for inside, _ in decided.values()], axis=0) if decided else None
    look = Look(label, hidden, colorbar, diverging=True, cells=cells, span=span, idle=idle)
    artists = draw(ax, section, look, regions)
    artists += [each for name, found in decided.items() for each in dot_region(ax, section, *found, name, cover=True)]
    return Picture(artists, ax)


@drawing
def switching_curve(
    solution: Solution,
    *,
    input: int = 0,
    ax: Axes | None = None,
    fixed: Cuts | None = None,
    time: float | None = None,
    color: str = "black",
    label: str | None = "switching curve",
) -> Picture:
    """Plot the curve on which one input changes sign: the zero level of the feedback, linear between nodes.

    A bang-bang feedback jumps between two nodes, so the curve is accurate to half a cell. Its signs are averaged over
    the neighbours before the zero level is drawn, otherwise the curve would be a staircase of half cells. A continuous
    feedback crosses zero without a switch, and its curve is arbitrary where the feedback is nearly zero. Over one axis
    the zeros are drawn as vertical lines.

    Args:
      solution: the solution of ``solve`` or ``march``.

    Keyword Args:
      input, ax, fixed, time: as in :func:`policy`.
      color: the colour of the curve.
      label: the label of the curve in the legend; ``None`` omits it.

    Raises:
      ValueError: the input does not change sign; otherwise as in :func:`value`.
    """
    section, name = feedback(solution, input, fixed, time)
    known = section.values.compressed()
    # otherwise matplotlib warns about an empty contour and draws nothing
    if known.size == 0 or known.min() >= 0 or known.max() <= 0:
        between = f"{known.min():g} and {known.max():g}" if known.size else "no finite values"
        raise ValueError(f"switching_curve: {name} stays between {between}, so it does not change sign")
    ax = axes_of(ax)
    style: dict[str, Any] = {"color": color, "linewidth": 1.6}
    if len(section.axes) == 1:
        artists: list[Artist] = [ax.axvline(x, **style) for x in zeros(section.coordinates[0], section.values)]
    else:
        x, y = section.coordinates
        level = _mean_signs(section.values) if jumps(known) else section.values
        artists = [ax.contour(x, y, level.T, levels=[0.0], colors=color, linewidths=1.6)]
    frame(ax, section)
    if label:  # on an empty line, because contours cannot have a label
        artists += ax.plot([], [], label=label, **style)
        legend(ax)
    return Picture(artists, ax)


def _mean_signs(values: np.ma.MaskedArray) -> np.ma.MaskedArray:
    """Signs averaged over the known neighbours with Gaussian weights; the zero level at a straight line is straight."""
    from scipy.ndimage import gaussian_filter

    mask = np.ma.getmaskarray(values)
    signs = np.where(mask, 0.0, np.sign(values))
    total, weight = (gaussian_filter(field, SMOOTHING, mode="nearest") for field in (signs, 1.0 - mask))
    return np.ma.array(total / np.where(mask, 1.0, weight), mask=mask)


@drawing
def trajectory(
    path: Path,
    *,
    ax: Axes | None = None,
    axes: tuple[int, int] | None = (0, 1),
    grid: Grid | None = None,
    names: Sequence[str] | None = None,
    color: str | None = None,
    label: str | None = None,
) -> Picture:
    """Plot a path in the plane of two states, or its states over time.

    To draw on top of :func:`value` or :func:`policy`, pass the same ``ax``. A circle marks the start and a dot the end.

    Args:
      path: the path of ``simulate``: ``times`` (k+1,) and ``states`` (k+1, n).

    Keyword Args:
      ax: matplotlib axes to draw on; ``None`` makes a new figure.
      axes: the two states of the plane; ``None``, or a path with one state, plots all states over time.
      grid: a grid with the names, whose periodic axes are wrapped; the line is broken at the seam.
      names: names of the states, instead of the grid's.
      color: the colour of the line; ``None`` chooses one.
      label: the label of the line in the legend.

    Returns:
      The picture: the line first, or one line per state.

    Raises:
      ValueError: the path does not have the states in ``axes``.
    """
    from matplotlib.patheffects import Normal, Stroke

    times, states = np.asarray(path.times), np.asarray(path.states)
    count = states.shape[1]
    names = tuple(names or (grid.labels if grid is not None else (f"x{i + 1}" for i in range(count))))
    states = without_jumps(states, grid)
    if axes is None or count == 1:
        ax = axes_of(ax, wide=True)
        colours = itertools.cycle((color,) if color else COLOURS)
        artists: list[Artist] = [
            ax.plot(times, states[:, i], color=next(colours), label=names[i])[0] for i in range(count)
        ]
        label_axes(ax, time_label(grid), names[0] if count == 1 else "state")
        set_ticks(ax.xaxis, False)
        set_ticks(ax.yaxis, count == 1 and grid is not None and is_angle(grid, 0))
        return Picture(artists if count == 1 else [*artists, legend(ax)], ax)
    if len(axes) != 2 or not all(0 <= i < count for i in axes):
        raise ValueError(f"trajectory: got axes={axes!r}; the path has {count} states, wanted two of 0 to {count - 1}")
    ax = axes_of(ax)
    # the end points separately, because the folded path may begin or end with a cut at the seam
    first, last = line_in_box(states[:1], axes, grid)[0], line_in_box(states[-1:], axes, grid)[0]
    plane = line_in_box(states, axes, grid)
    color = color or COLOURS[1]
    casing = [Stroke(linewidth=3.4, foreground="white"), Normal()]  # a white border, visible on any colour
    artists = [*ax.plot(*plane.T, color=color, linewidth=1.8, label=label, path_effects=casing, zorder=4)]
    marks: dict[str, Any] = {"linestyle": "none", "marker": "o", "markeredgecolor": color, "markersize": 6, "zorder": 5}
    artists += ax.plot(*first, markerfacecolor="white", markeredgewidth=1.6, **marks)
    artists += ax.plot(*last, markerfacecolor=color, path_effects=casing, **marks)
    label_axes(ax, names[axes[0]], names[axes[1]])
    if grid is not None:
        scale_axes(ax, grid, axes)
    if label:
        legend(ax)
    return Picture(artists, ax)


@drawing
def closed_loop(
    solution: Solution,
    path: Path,
    *,
    axes: tuple[int, int] = (0, 1),
    fixed: Cuts | None = None,
    target: Callable[[State], Number] | None = None,
    figure: Figure | SubFigure | None = None,
) -> Picture:
    """Plot the path on the value function, and its states and inputs over time, in one figure.

    Args:
      solution: the solution of ``solve``; of several modes the first of the path is drawn.
      path: the path of ``simulate`` for this solution.

    Keyword Args:
      axes: the two states of the plane on the left; there is no plane for one state.
      fixed: the coordinates at which the other axes are cut; the default is the start of the path.
      target: as in :func:`value`.
      figure: matplotlib figure to draw on; ``None`` makes a pyplot figure.

    Returns:
      The picture: the artists of the value first.
    """
    if solution.grid.modes:
        solution = solution.in_mode(int(np.asarray(path.modes)[0]))
    grid = solution.grid
    artists: list[Artist] = []
    plane, driven = grid.ndim > 1, np.shape(path.controls)[1] > 0
    figure = figure or new_figure(closed_loop_size(grid))
    columns = figure.add_gridspec(1 + driven, 1 + plane, width_ratios=(1.25, 1.0)[: 1 + plane])
    if plane:
        start = np.asarray(path.states)[0]
        # the path may leave this plane in its other states; its projection is drawn on the section
        cut: Cuts = {axis: float(start[axis]) for axis in range(grid.ndim) if axis not in axes}
        ax = styled(figure.add_subplot(columns[:, 0]))
        artists += value(solution, ax=ax, fixed=cut if fixed is None else fixed, target=target)
        # a section has its axes in the order of the grid
        artists += trajectory(path, ax=ax, axes=axes if axes[0] < axes[1] else axes[::-1], grid=grid)
    upper = styled(figure.add_subplot(columns[0, -1]))
    artists += trajectory(path, ax=upper, axes=None, grid=grid)
    upper.set_xlabel("" if driven else time_label(grid, described(solution).labels))
    if driven:  # the lower axes have the label of the time
        lower = styled(figure.add_subplot(columns[1, -1], sharex=upper))
        artists += controls(path, ax=lower, solution=solution)
        upper.tick_params(labelbottom=False)
    return Picture(artists, ax if plane else upper)


def closed_loop_size(grid: Grid) -> tuple[float, float]:
    """The size of the figure of a closed loop in inches, with room for a plane if there are two states or more."""
    return (9.6 if grid.ndim > 1 else 5.4), 4.2


def _levels(values: np.ma.MaskedArray, levels: int | Sequence[float]) -> np.ndarray:
    """Contour levels strictly between the extremes, so that no contour is empty."""
    known = values.compressed()
    if known.size == 0 or is_level(known):
        return known[:0]
    # two more than requested, because those at the extremes, a point or a speck of rounding, are dropped
    places = np.linspace(known.min(), known.max(), levels + 2) if isinstance(levels, int) else np.sort(levels)
    return places[(places > known.min()) & (places < known.max())]
