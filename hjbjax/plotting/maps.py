"""Plots of a value, a feedback and its switching curve over one or two axes, and of paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.plotting.histories import inputs_over_time, modes_over_time, states_over_time
from hjbjax.plotting.modes import by_mode, name_mode
from hjbjax.plotting.scales import scale_axes, time_label
from hjbjax.plotting.shading import (
    EXTREME,
    FLAT,
    Look,
    cross_out,
    dot_region,
    draw,
    fill_missing,
    frame,
    is_level,
    jumps,
)
from hjbjax.plotting.slices import (
    Cuts,
    Region,
    Section,
    at_states,
    at_time,
    closed_field,
    decided_sets,
    described,
    feedback,
    line_in_box,
    near_ends,
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

SMOOTHING = 0.015  # width of the mean of signs at a switching curve, as a fraction of the axis
CELLS = (1.5, 3.0)  # its limits in cells; a staircase takes 1.5, and beyond 3 the mean would move a curved line
TIE = 0.3  # relative difference between the neighbours of an extremum of V that is within 0.15 cells of the node
BANG_BANG = 0.98  # fraction of nodes at an end of the range; the others are on a switching curve
SURE = 0.999  # mean of signs beyond which all neighbours have one sign
DIGITS = 9  # of a mean of signs

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
    Over two axes the nodes where the ends of the box change V by more than 1 % of its range are crossed out; see
    ``Solution.box_error``.

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
    artists += cross_out(ax, section, near_ends(solution, section, time) & ~np.ma.getmaskarray(section.values))
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
    if cells and not described(solution).discrete and len(section.axes) == 2:
        artists += _smooth_edge(ax, artists[0], section, _ties(solution, section, time))
    artists += [each for name, found in decided.items() for each in dot_region(ax, section, *found, name, cover=True)]
    artists += cross_out(ax, section, near_ends(solution, section, time) & ~np.ma.getmaskarray(section.values))
    return Picture(artists, ax)


def _smooth_edge(ax: Axes, mesh: Any, section: Section, tied: np.ndarray) -> list[Artist]:
    """Draw the edge between the cells of the two controls of a bang-bang feedback smoothly, as ``switching_curve``."""
    known = section.values.compressed()
    lo, hi = float(known.min()), float(known.max())
    near = EXTREME * (hi - lo)
    if not lo < 0 < hi or np.mean((known <= lo + near) | (known >= hi - near)) < BANG_BANG:
        return []
    colours = [mesh.cmap(mesh.norm(end)) for end in (lo, hi)]
    level = _mean_signs(section, tied)
    return [ax.contourf(*section.coordinates, level.T, levels=[-SURE, 0.0, SURE], colors=colours, zorder=1)]


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
    feedback crosses zero without a switch, and its curve is arbitrary where the feedback is nearly zero. A node that is
    a maximum or a minimum of V between two signs is on the curve: there both signs are equally good. Over one axis the
    zeros are drawn as vertical lines.

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
        level = _mean_signs(section, _ties(solution, section, time)) if jumps(known) else section.values
        artists = [ax.contour(x, y, level.T, levels=[0.0], colors=color, linewidths=1.6)]
    frame(ax, section)
    if label:  # on an empty line, because contours cannot have a label
        artists += ax.plot([], [], label=label, **style)
        legend(ax)
    return Picture(artists, ax)


def _ties(solution: Solution, section: Section, time: float | None) -> np.ndarray:
    """The nodes of a section over two axes that are an extremum of V along an axis, between different signs; bool."""
    field = at_time(solution, solution.value, time)[0]
    value = section_of("value", field, section.grid, section.cuts, "").values.filled(np.nan)
    signs = np.sign(section.values.filled(np.nan))
    tied = np.zeros(value.shape, bool)
    for position, axis in enumerate(section.axes):
        periodic = bool(section.grid.periodic[axis])
        (below, above), (left, right) = (_neighbours(each, position, periodic) for each in (value, signs))
        steps = np.abs(value - below) + np.abs(value - above)
        extreme = ((value - below) * (value - above) > 0) & (np.abs(above - below) <= TIE * steps)
        tied |= extreme & (left * right < 0)  # False for NaN
    return tied


def _neighbours(values: np.ndarray, axis: int, periodic: bool) -> tuple[np.ndarray, np.ndarray]:
    """The values at both neighbours along an axis; NaN beyond an end."""
    places = np.arange(values.shape[axis])
    if periodic:  # the last row repeats the first one
        cells = len(places) - 1
        return np.take(values, (places - 1) % cells, axis), np.take(values, (places + 1) % cells, axis)
    wide = np.pad(values, [(1, 1) if i == axis else (0, 0) for i in range(values.ndim)], constant_values=np.nan)
    return np.take(wide, places, axis), np.take(wide, places + 2, axis)


def _mean_signs(section: Section, tied: np.ndarray) -> np.ma.MaskedArray:
    """Signs averaged over the known neighbours with Gaussian weights; the zero level at a straight line is straight."""
    from scipy.ndimage import gaussian_filter

    values, mask = section.values, np.ma.getmaskarray(section.values)
    signs = np.where(mask | tied, 0.0, np.sign(values.filled(0.0)))
    modes = ["grid-wrap" if section.grid.periodic[axis] else "nearest" for axis in section.axes]
    widths = [float(np.clip(SMOOTHING * section.grid.shape[axis], *CELLS)) for axis in section.axes]
    total, weight = (
        closed_field(gaussian_filter(_open(field, section), widths, mode=modes), section.grid, section.axes)
        for field in (signs, 1.0 - mask)
    )
    # rounded, otherwise a curve along a face of the box would be broken by rounding errors
    means = np.round(total / np.where(mask, 1.0, weight), DIGITS)
    for position, axis in enumerate(section.axes):
        if section.grid.periodic[axis]:
            rows = np.moveaxis(means, position, 0)
            # a curve along the seam is drawn at both ends; matplotlib draws a zero there only below a positive number
            for seam, inner in ((0, 1), (-1, -2)):
                rows[seam] = np.where(rows[seam] == 0, -(0.1**DIGITS) * rows[inner], rows[seam])
    return np.ma.array(means, mask=mask)


def _open(field: np.ndarray, section: Section) -> np.ndarray:
    """A field over two axes without the repeated row at the upper end of each periodic axis."""
    return field[tuple(slice(None, -1 if section.grid.periodic[axis] else None) for axis in section.axes)]


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

    states = np.asarray(path.states)
    count = states.shape[1]
    names = tuple(names or (grid.labels if grid is not None else (f"x{i + 1}" for i in range(count))))
    states = without_jumps(states, grid)
    if axes is None or count == 1:
        ax = axes_of(ax, wide=True)
        return Picture(states_over_time(ax, path, names, range(count), grid, color), ax)
    if len(axes) != 2 or not all(0 <= i < count for i in axes):
        raise ValueError(f"trajectory: got axes={axes!r}; the path has {count} states, wanted two of 0 to {count - 1}")
    ax = axes_of(ax)
    # the end points separately, because the folded path may begin or end with a cut at the seam
    first, last = line_in_box(states[:1], axes, grid)[0], line_in_box(states[-1:], axes, grid)[0]
    plane = line_in_box(states, axes, grid)
    color = color or COLOURS[1]
    casing = [Stroke(linewidth=3.4, foreground="white"), Normal()]  # a white border, visible on any colour
    artists: list[Artist] = [*ax.plot(*plane.T, color=color, linewidth=1.8, label=label, path_effects=casing, zorder=4)]
    marks: dict[str, Any] = {"linestyle": "none", "marker": "o", "markeredgecolor": color, "markersize": 6, "zorder": 5}
    marks["clip_on"] = grid is None  # on a face of the box all of the mark is drawn
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
    modes = solution.grid.modes
    if modes:
        solution = solution.in_mode(int(np.asarray(path.modes)[0]))
    grid = solution.grid
    artists: list[Artist] = []
    figure = figure or new_figure(closed_loop_size(solution, path))
    rows = _rows(solution, path)
    plane = grid.ndim > 1
    columns = figure.add_gridspec(len(rows), 1 + plane, width_ratios=(1.25, 1.0)[: 1 + plane])
    if plane:
        start = np.asarray(path.states)[0]
        # the path may leave this plane in its other states; its projection is drawn on the section
        cut: Cuts = {axis: float(start[axis]) for axis in range(grid.ndim) if axis not in axes}
        ax = styled(figure.add_subplot(columns[:, 0]))
        artists += value(solution, ax=ax, fixed=cut if fixed is None else fixed, target=target)
        if modes:
            name_mode(ax, modes[int(np.asarray(path.modes)[0])])
        # a section has its axes in the order of the grid
        drawn = trajectory(path, ax=ax, axes=axes if axes[0] < axes[1] else axes[::-1], grid=grid)
        for mark, name in zip(drawn, (_path_name(path, grid, axes), "start", "end"), strict=True):
            mark.set_label(name)
        legend(ax)
        artists += drawn
    panels: list[Axes] = []
    for number, (kind, chosen) in enumerate(rows):
        panels.append(styled(figure.add_subplot(columns[number, -1], sharex=panels[0] if panels else None)))
        if kind == "state":
            artists += states_over_time(panels[-1], path, grid.labels, chosen, grid)
        elif kind == "control":
            artists += inputs_over_time(panels[-1], path, chosen, solution)
        else:
            artists += modes_over_time(panels[-1], path, modes)
    for panel in panels:  # a label with its unit is longer than one of several axes is high
        panel.set_ylabel(panel.get_ylabel().replace(" [", "\n[") if len(panels) > 2 else panel.get_ylabel())
    figure.align_ylabels(panels)
    for panel in panels[:-1]:  # the lowest axes have the label of the time
        panel.set_xlabel("")
        panel.tick_params(labelbottom=False)
    panels[-1].set_xlabel(time_label(grid, described(solution).labels))
    return Picture(artists, ax if plane else panels[0])


def _path_name(path: Path, grid: Grid, axes: tuple[int, int]) -> str:
    """The label of a path in the plane of two axes; it is a projection if another state varies."""
    states = np.asarray(path.states)
    spans = np.asarray(grid.hi) - np.asarray(grid.lo)
    moves = [np.ptp(states[:, axis]) > FLAT * spans[axis] for axis in range(grid.ndim) if axis not in axes]
    return "path, projected" if any(moves) else "path"


def _rows(solution: Solution, path: Path) -> list[tuple[str, list[int]]]:
    """The plots over time from top to bottom: the states and then the inputs of each unit, and the mode."""
    units = described(solution).labels.control_units
    count = np.shape(path.controls)[1]
    groups = {"state": solution.grid.units, "control": units or ("",) * count}
    rows = []
    for kind, names in groups.items():
        for unit in dict.fromkeys(names):  # in the order in which they appear
            rows.append((kind, [i for i, name in enumerate(names) if name == unit]))
    return rows + [("mode", [])] * (getattr(path, "modes", None) is not None)


def closed_loop_size(solution: Solution, path: Path) -> tuple[float, float]:
    """The size of the figure of a closed loop in inches, with room for a plane if there are two states or more."""
    states = len(solution.grid.state_axes)
    return (9.6 if states > 1 else 5.4), max(4.2, 1.4 * len(_rows(solution, path)))


def _levels(values: np.ma.MaskedArray, levels: int | Sequence[float]) -> np.ndarray:
    """Contour levels strictly between the extremes, so that no contour is empty."""
    known = values.compressed()
    if known.size == 0 or is_level(known):
        return known[:0]
    # two more than requested, because those at the extremes, a point or a speck of rounding, are dropped
    places = np.linspace(known.min(), known.max(), levels + 2) if isinstance(levels, int) else np.sort(levels)
    return places[(places > known.min()) & (places < known.max())]
