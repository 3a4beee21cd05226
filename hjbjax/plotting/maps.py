"""Pictures over one or two axes of a value, a feedback and its switching curve; and of paths."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.plotting.histories import controls
from hjbjax.plotting.scales import is_angle, scale_axes, set_ticks
from hjbjax.plotting.shading import Look, continued, draw, frame, is_level, jumps
from hjbjax.plotting.slices import (
    Cuts,
    Region,
    Section,
    at_states,
    at_time,
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

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from hjbjax.feedback.path import Path
    from hjbjax.solution.solution import Solution


@drawing
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
    """The value function: a line over one axis, colours with contour lines over two.

    Args:
      solution: the solution of ``solve`` or ``march``.

    Keyword Args:
      ax: matplotlib axes to draw on; ``None`` takes pyplot's current ones.
      fixed: coordinates of the axes to cut at, by number or name, until at most two are free.
      time: for a marched solution, which stored time to draw (the nearest one; ``None`` is the earliest).
      levels: how many contour lines, or their values; 0 for none.
      colorbar: whether a colour scale is drawn beside two-dimensional pictures.
      target: a function of the state, ≤ 0 inside, to be outlined and hatched over two axes, since what is held there
        need not be a value; ``None`` takes that of the problem that was solved.

    Returns:
      The picture: the line or the mesh first, with ``.figure`` and ``.save(path)``.

    Raises:
      ValueError: more than two axes are free, or ``fixed`` names an axis or a place that does not exist.

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
    # .data is what the mask hides: infinity is out of reach, NaN is something else and must not be called so
    hidden = "V = ∞" if np.all(np.isposinf(section.values.data[section.values.mask])) else "V not finite"
    section, regions = _without(section, target_of(solution, time) if target is None else target)
    artists = draw(ax, section, Look("V", hidden, colorbar), regions)
    lines = _levels(section.values, levels) if len(section.axes) == 2 else ()
    if len(lines):
        shades = continued(section.values).T
        style: dict[str, Any] = {"levels": lines, "colors": "white", "linewidths": 0.6, "alpha": 0.65}
        artists.append(ax.contour(*section.coordinates, shades, **style))
    return Picture(artists, ax)


def _without(section: Section, target: Callable[[State], Number] | None) -> tuple[Section, tuple[Region, ...]]:
    """The section with the nodes of the target masked, and the target to be outlined; over two axes alone."""
    if target is None or len(section.axes) != 2:
        return section, ()
    region = region_of(target, section, "target")
    mask = np.ma.getmaskarray(section.values) | region.nodes
    return section._replace(values=np.ma.array(section.values.data, mask=mask)), (region,)


@drawing
def policy(
    solution: Solution,
    *,
    input: int = 0,
    ax: Axes | None = None,
    fixed: Cuts | None = None,
    time: float | None = None,
    colorbar: bool = True,
) -> Picture:
    """One input of the feedback u(x): a line over one axis, over two colours that part at zero where the sign changes.

    A feedback that jumps, or is enumerated, is drawn as cells, any other one smoothly. Where no control is defined or
    the value is not finite the picture is hatched.

    Args:
      solution: the solution of ``solve`` or ``march``.

    Keyword Args:
      input: which of the m inputs, from 0.
      ax, fixed, time, colorbar: as for :func:`value`, with its result and its refusals.
    """
    section, label = feedback(solution, input, fixed, time)
    ax = axes_of(ax)
    section, regions = _without(section, target_of(solution, time))
    cells = getattr(solution, "discrete", False) or jumps(section.values.compressed())
    span = span_of(solution, input)
    inner = (slice(1, -1),) if len(section.axes) == 1 else ()
    # the run ends at the two ends of a line: a hatch half a cell wide would tell nothing
    lost = np.ma.getmaskarray(section.values)[inner]
    hidden = "no control" if lost.any() or len(section.axes) == 2 else ""
    target = target_of(solution, time)
    if hidden and len(section.axes) == 1 and target is not None:
        within = at_states(target, section.states(section.coordinates))[inner] <= 0
        hidden = "target" if within[lost].all() else hidden
    look = Look(label, hidden, colorbar, diverging=True, cells=cells, span=span)
    return Picture(draw(ax, section, look, regions), ax)


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
    """The curve on which one input changes sign: the zero level of the feedback, linear between nodes.

    A bang-bang feedback jumps between two nodes, so its curve is known to half a cell, as it is drawn. Over
    one axis the places are vertical lines.

    Args:
      solution: the solution of ``solve`` or ``march``.

    Keyword Args:
      input, ax, fixed, time: as for :func:`policy`.
      color: of the curve.
      label: of the curve in the legend; ``None`` leaves it out.

    Raises:
      ValueError: the input keeps its sign, or as for :func:`value`.
    """
    section, name = feedback(solution, input, fixed, time)
    known = section.values.compressed()
    # refused here: matplotlib would warn of a contour that does not exist and draw nothing
    if known.size == 0 or known.min() >= 0 or known.max() <= 0:
        between = f"{known.min():g} and {known.max():g}" if known.size else "no finite values"
        raise ValueError(f"switching_curve: {name} stays between {between}; there is no change of sign to draw")
    ax = axes_of(ax)
    style: dict[str, Any] = {"color": color, "linewidth": 1.6}
    if len(section.axes) == 1:
        artists: list[Artist] = [ax.axvline(x, **style) for x in zeros(section.coordinates[0], section.values)]
    else:
        x, y = section.coordinates
        artists = [ax.contour(x, y, section.values.T, levels=[0.0], colors=color, linewidths=1.6)]
    frame(ax, section)
    if label:  # on an empty line: contours take none
        artists += ax.plot([], [], label=label, **style)
        legend(ax)
    return Picture(artists, ax)


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
    """A path in the plane of two states, or its states over time.

    Works on top of :func:`value` or :func:`policy`: pass their ``ax``. A ring marks the start, a dot the end.

    Args:
      path: the path of ``simulate``: ``times`` (k+1,) and ``states`` (k+1, n).

    Keyword Args:
      ax: matplotlib axes to draw on; ``None`` takes pyplot's current ones.
      axes: the two states of the plane; ``None``, or a path with one state, draws all states over time.
      grid: gives the names, and where periodic states are wrapped: the line is broken at the seam.
      names: names of the states, in place of the grid's.
      color: of the line, ``None`` chooses.
      label: of the line in the legend.

    Returns:
      The picture: the line first, or one line a state.

    Raises:
      ValueError: ``axes`` asks for states that the path does not have.
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
        label_axes(ax, "t", names[0] if count == 1 else "state")
        set_ticks(ax.xaxis, False)
        set_ticks(ax.yaxis, count == 1 and grid is not None and is_angle(grid, 0))
        return Picture(artists if count == 1 else [*artists, legend(ax)], ax)
    if len(axes) != 2 or not all(0 <= i < count for i in axes):
        raise ValueError(f"trajectory: got axes={axes!r}; the path has {count} states, wanted two of 0 to {count - 1}")
    ax = axes_of(ax)
    # the ends each for themselves: the rows of the folded path may begin or end with a cut at the seam
    first, last = line_in_box(states[:1], axes, grid)[0], line_in_box(states[-1:], axes, grid)[0]
    plane = line_in_box(states, axes, grid)
    color = color or COLOURS[1]
    casing = [Stroke(linewidth=3.4, foreground="white"), Normal()]  # a white edge: it reads on any colour
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
    """One figure: the path on the value function, and its states and inputs over time.

    Args:
      solution: the solution of ``solve``.
      path: the path of ``simulate`` for it.

    Keyword Args:
      axes: the two states of the plane on the left; left out for one state.
      fixed: where the other axes are cut, by default at the path's start.
      target: as for :func:`value`.
      figure: matplotlib figure to draw on; ``None`` makes one of pyplot's.

    Returns:
      The picture: the artists of the value first.
    """
    grid = solution.grid
    artists: list[Artist] = []
    plane, driven = grid.ndim > 1, np.shape(path.controls)[1] > 0
    figure = figure or new_figure(closed_loop_size(grid))
    columns = figure.add_gridspec(1 + driven, 1 + plane, width_ratios=(1.25, 1.0)[: 1 + plane])
    if plane:
        start = np.asarray(path.states)[0]
        # the path leaves this plane in its other states: it is its shadow that is drawn on the section
        cut: Cuts = {axis: float(start[axis]) for axis in range(grid.ndim) if axis not in axes}
        ax = styled(figure.add_subplot(columns[:, 0]))
        artists += value(solution, ax=ax, fixed=cut if fixed is None else fixed, target=target)
        # a section has its axes in the order of the grid
        artists += trajectory(path, ax=ax, axes=axes if axes[0] < axes[1] else axes[::-1], grid=grid)
    upper = styled(figure.add_subplot(columns[0, -1]))
    artists += trajectory(path, ax=upper, axes=None, grid=grid)
    if driven:
        upper.set_xlabel("")  # time is written once, below
        lower = styled(figure.add_subplot(columns[1, -1], sharex=upper))
        artists += controls(path, ax=lower, solution=solution)
        upper.tick_params(labelbottom=False)
    return Picture(artists, ax if plane else upper)


def closed_loop_size(grid: Grid) -> tuple[float, float]:
    """The size of a closed loop's figure in inches: a plane beside the lines over time where there is one."""
    return (9.6 if grid.ndim > 1 else 5.4), 4.2


def _levels(values: np.ma.MaskedArray, levels: int | Sequence[float]) -> np.ndarray:
    """Contour levels strictly between the extremes, so that none is empty."""
    known = values.compressed()
    if known.size == 0 or is_level(known):
        return known[:0]
    # two more than wanted: those at the extremes are dropped, where a contour is a point or a speck of rounding
    places = np.linspace(known.min(), known.max(), levels + 2) if isinstance(levels, int) else np.sort(levels)
    return places[(places > known.min()) & (places < known.max())]
