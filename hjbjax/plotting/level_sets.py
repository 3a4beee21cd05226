"""Zero level sets of values in two and three dimensions, as slices or projections, and animations.

If a set {V ≤ 0} has more states than the picture, it is cut at the values in ``fixed``, or projected. A point belongs
to the projection if some state above it belongs to the set. The value is therefore minimised over the removed axes, or
maximised for {V ≥ 0}.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from hjbjax.plotting.scales import angle_step, angle_text, box_sides, is_angle, place_text, set_ticks
from hjbjax.plotting.shading import frame, outlined
from hjbjax.plotting.slices import (
    Cuts,
    Section,
    at_time,
    axis_number,
    closed_axis,
    closed_field,
    cut_field,
    described,
    region_of,
    section_of,
    sets_of,
)
from hjbjax.plotting.style import COLOURS, Picture, axes_of, drawing, legend, solid_axes
from hjbjax.plotting.surfaces import level_surface, lit, thinned
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import SIDES
from hjbjax.problem.pytree import keywords, refuse_misspelt
from hjbjax.solution.files import Path, write_whole

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from hjbjax.solution.solution import Solution

T = TypeVar("T")

OPACITY = 0.55  # opacity of a surface, so that objects behind it are visible


@dataclasses.dataclass(frozen=True)
class Field:
    """Values at the nodes of a grid, (*grid), and a caption with their time."""

    values: np.ndarray
    grid: Grid
    caption: str

    def section(self, fixed: Mapping[str, float]) -> Section:
        """Cut the field at the coordinates of the named axes."""
        return section_of("zero_level_set", self.values, self.grid, fixed, self.caption)


@drawing
def zero_level_set(
    solution: Solution,
    *,
    ax: Axes | None = None,
    fixed: Cuts | None = None,
    project: int | str | Sequence[int | str] = (),
    inside: str | None = None,
    time: float | None = None,
    color: str = COLOURS[0],
    label: str | None = None,
    fill: bool = True,
) -> Picture:
    """Plot the boundary of {V ≤ 0}: a curve over two axes, or a lit, translucent surface over three.

    Args:
      solution: the solution of ``solve`` or ``march``.

    Keyword Args:
      ax: matplotlib axes to draw on, three-dimensional for three free axes; ``None`` makes a new figure.
      fixed: coordinates at which axes are cut, by number or name.
      project: axes, by number or name, along which the set is projected.
      inside: ``"below"`` for {V ≤ 0}, as in ``reach``, ``"above"`` for {V ≥ 0}, as in ``avoid``; ``None`` follows the
        solved problem.
      time: for a solution of ``march``, the time to draw. The nearest stored time is used; ``None`` is the earliest.
      color: the colour of the curve.
      label: the label of the curve in the legend; ``None`` omits it.
      fill: shade the set, over two axes.

    Returns:
      The picture: the curve or the surface first; without artists if the set is empty.

    Raises:
      ValueError: fewer than two or more than three axes are free, or an axis does not exist.

    Example:
      >>> from types import SimpleNamespace
      >>> grid = Grid(lo=[-1.0, -1.0], hi=[1.0, 1.0], shape=(21, 21))
      >>> disc = np.sum(grid.nodes() ** 2, axis=-1) - 0.25
      >>> len(zero_level_set(SimpleNamespace(grid=grid, value=disc, times=None), fill=False))
      1
    """
    field = _projection(_field(solution, inside, time), project)
    # axes by name, because a projection removes axes and renumbers the others
    cuts = {field.grid.names[axis_number(key, field.grid)]: place for key, place in dict(fixed or {}).items()}
    if field.grid.ndim - len(cuts) == 3:
        return _surface(field, cuts, solid_axes(ax), color, label)
    section = field.section(cuts)
    if len(section.axes) != 2:
        raise ValueError("zero_level_set: one axis is free; a level set needs two or three free axes")
    ax = axes_of(ax)
    artists = _curve(ax, section, color, fill)
    frame(ax, section)
    artists += _outlines(ax, solution, section, time, bool(project))
    if label and artists:  # contours cannot have a label, so an empty line stands for them in the legend
        ax.plot([], [], color=color, linewidth=1.6, label=label)
    if label or ax.get_legend_handles_labels()[1]:
        legend(ax)
    return Picture(artists, ax)


@drawing
def turning_surface(
    solution: Solution,
    *,
    fixed: Cuts | None = None,
    project: int | str | Sequence[int | str] = (),
    inside: str | None = None,
    time: float | None = None,
    color: str = COLOURS[0],
) -> Scene:
    """Make a web page with the boundary of {V ≤ 0} over three axes, which the mouse can turn and zoom.

    This requires plotly, ``pip install 'hjbjax[plot3d]'``.

    Args:
      solution: the solution of ``solve`` or ``march``.

    Keyword Args:
      fixed, project, inside, time, color: as in :func:`zero_level_set`.

    Returns:
      The scene: ``.figure`` is the plotly figure, and ``.save("tube.html")`` writes a self-contained page.

    Raises:
      ValueError: the number of free axes is not three.
      ImportError: plotly is not installed.
    """
    from matplotlib.colors import to_hex

    try:
        from plotly import graph_objects
    except ModuleNotFoundError as error:
        raise ImportError(
            "turning_surface: plotly is not installed: pip install 'hjbjax[plot3d]'; zero_level_set works without it"
        ) from error
    field = _projection(_field(solution, inside, time), project)
    cuts = {field.grid.names[axis_number(key, field.grid)]: place for key, place in dict(fixed or {}).items()}
    count = field.grid.ndim - len(cuts)
    if count != 3:
        raise ValueError(f"turning_surface: {count} axes are free, wanted three: cut with fixed= or use project=")
    free, values, lines = _cube(field, cuts)
    triangles = level_surface(values, lines)
    corners = triangles.reshape(-1, 3)
    # merge the corners that triangles share, up to rounding
    spans = np.array([line[-1] - line[0] for line in lines])
    _, first, index = np.unique(np.round(corners / spans, 9), axis=0, return_index=True, return_inverse=True)
    (x, y, z), (i, j, k) = corners[first].T, index.reshape(-1, 3).T
    # use our lighting, because plotly's depends on the order of corners, which is arbitrary here
    faces = [to_hex(shade) for shade in lit(triangles, values, lines, color)]
    light = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
    mesh = graph_objects.Mesh3d(x=x, y=y, z=z, i=i, j=j, k=k, facecolor=faces, opacity=OPACITY, lighting=light)
    scene: dict[str, Any] = {
        f"{name}axis": {"title": field.grid.labels[axis], "range": [float(line[0]), float(line[-1])]}
        for name, axis, line in zip("xyz", free, lines, strict=True)
    }
    for name, axis, line in zip("xyz", free, lines, strict=True):
        if is_angle(field.grid, axis) and (step := angle_step(line[0], line[-1])):
            ticks = step * np.arange(np.ceil(line[0] / step - 1e-9), np.floor(line[-1] / step + 1e-9) + 1)
            scene[f"{name}axis"] |= {"tickvals": ticks, "ticktext": [angle_text(tick) for tick in ticks]}
    sides = dict(zip("xyz", box_sides(field.grid, free), strict=True))
    scene |= {"aspectmode": "manual", "aspectratio": sides}
    caption = _caption(field, cuts)
    margin = {"l": 0, "r": 0, "b": 0, "t": 40 * bool(caption)}
    return Scene(graph_objects.Figure(data=[mesh], layout={"scene": scene, "title": caption, "margin": margin}))


@dataclasses.dataclass(frozen=True)
class Scene:
    """A plotly figure."""

    figure: Any

    def save(self, path: Path) -> None:
        """Write a self-contained page of about 5 MB, most of it plotly itself, whole or not at all.

        Raises:
          FileError: the file cannot be written; an older file is left as it is.
        """
        page = self.figure.to_html(include_plotlyjs=True).encode()
        write_whole(path, lambda stream: stream.write(page), force=True)


def _field(solution: Solution, inside: str | None, time: float | None) -> Field:
    """The value at one time, with its sign flipped if the set is {V ≥ 0}."""
    if inside is None:
        inside = described(solution).labels.inside
    if inside not in SIDES:
        raise ValueError(f"zero_level_set: got inside = {inside!r}, wanted 'below' (V ≤ 0) or 'above' (V ≥ 0)")
    values, caption = at_time(solution, solution.value, time)
    return Field(values if inside == "below" else -values, solution.grid, caption)


def _projection(field: Field, project: int | str | Sequence[int | str]) -> Field:
    """The minimum of the value over the removed axes, on the grid of the remaining axes."""
    grid = field.grid
    if isinstance(project, (str, int)):
        project = (project,)
    gone = sorted({axis_number(key, grid) for key in project})
    if not gone:
        return field
    stay = [axis for axis in range(grid.ndim) if axis not in gone]
    if len(stay) < 2:
        raise ValueError("zero_level_set: project leaves fewer than two axes")

    def pick(entries: Sequence[T]) -> tuple[T, ...]:
        return tuple(entries[axis] for axis in stay)

    smaller = Grid(
        np.asarray(grid.lo)[stay], np.asarray(grid.hi)[stay], pick(grid.shape), pick(grid.periodic), pick(grid.names),
        pick(grid.stretch), units=pick(grid.units),
    )  # fmt: skip
    # the minimum is NaN, and so masked, if any value above the point is NaN
    return Field(np.min(field.values, axis=tuple(gone)), smaller, field.caption)


def _curve(ax: Axes, section: Section, color: str, fill: bool) -> list[Artist]:
    """Draw the curve V = 0 over two axes and shade V ≤ 0; draws nothing if the set is empty."""
    known = section.values.compressed()
    if known.size == 0 or known.min() > 0:
        return []
    x, y = section.coordinates
    artists: list[Artist] = []
    if known.max() > 0:  # otherwise the set is the whole box, and matplotlib would warn about an empty contour
        artists.append(ax.contour(x, y, section.values.T, levels=[0.0], colors=color, linewidths=1.6))
    if fill:  # matplotlib requires two levels; the lower one is below all values
        artists.append(ax.contourf(x, y, section.values.T, levels=[known.min() - 1, 0.0], colors=color, alpha=0.15))
    return artists


def _outlines(ax: Axes, solution: Solution, section: Section, time: float | None, projected: bool) -> list[Artist]:
    """Draw the outlines of the sets of the problem if they are known; not for projections."""
    if projected:
        return []
    regions = (region_of(function, section, name) for name, function in sets_of(solution, time).items())
    return [artist for region in regions for artist in outlined(ax, region, inside=False)]


def _cube(field: Field, fixed: Mapping[str, float]) -> tuple[list[int], np.ndarray, list[np.ndarray]]:
    """The numbers of the three free axes, the field over them, and their coordinates."""
    grid = field.grid
    free = [axis for axis in range(grid.ndim) if grid.names[axis] not in fixed]
    cuts = {grid.names.index(name): float(place) for name, place in fixed.items()}
    closed = closed_field(cut_field("zero_level_set", field.values, grid, cuts), grid, free)
    return free, *thinned(closed, [closed_axis(grid, axis) for axis in free])


def _caption(field: Field, fixed: Mapping[str, float]) -> str:
    """The time of a field, and the coordinates at which it is cut."""
    grid = field.grid
    places = [f"{name} = {place_text(grid, grid.names.index(name), place)}" for name, place in fixed.items()]
    return ", ".join([field.caption] * bool(field.caption) + places)


def _surface(field: Field, fixed: Mapping[str, float], ax: Any, color: str, label: str | None) -> Picture:
    """Draw the surface V = 0 over the three free axes."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    grid = field.grid
    free, closed, lines = _cube(field, fixed)
    triangles = level_surface(closed, lines)
    artists: list[Artist] = []
    if len(triangles):
        colours = np.column_stack([lit(triangles, closed, lines, color), np.full(len(triangles), OPACITY)])
        surface = Poly3DCollection(triangles, facecolors=colours, edgecolors="none", linewidths=0, antialiased=True)
        surface.set(rasterized=True)  # as vectors the edge of each triangle would be visible
        artists.append(ax.add_collection3d(surface))
    ends = [(float(line[0]), float(line[-1])) for line in lines]
    ax.set(xlim=ends[0], ylim=ends[1], zlim=ends[2])
    for axis, number, text in zip((ax.xaxis, ax.yaxis, ax.zaxis), free, "xyz", strict=True):
        # few ticks, because from the side more would overlap, as would the last one of x and the first one of y
        set_ticks(axis, is_angle(grid, number), nbins=4, prune="upper" if text == "x" else None)
        getattr(ax, f"set_{text}label")(grid.labels[number], labelpad=8)
    # smaller than its frame, otherwise the label on the right would be cut off
    ax.set_box_aspect(box_sides(grid, free), zoom=0.86)
    if caption := _caption(field, fixed):
        ax.set_title(caption, loc="right", fontsize=9, y=0.9)  # next to the box, which does not fill the axes
    if label and artists:
        ax.plot([], [], [], color=color, linewidth=4, alpha=OPACITY, label=label)
        ax.legend(frameon=False, fontsize=8)
    return Picture(artists, ax)


@drawing
def animation(
    solution: Solution,
    draw: Callable[..., Picture] = zero_level_set,
    *,
    ax: Axes | None = None,
    interval: float = 100.0,
    **options: Any,
) -> FuncAnimation:
    """Animate a solution of ``march`` over time, backward from the horizon.

    Args:
      solution: the solution of ``march``, whose stored times become the frames.
      draw: draws one frame: ``zero_level_set``, ``value`` or ``policy`` of this module, or a function that takes the
        solution, ``ax=`` and ``time=``.

    Keyword Args:
      ax: matplotlib axes to draw on, cleared for every frame; ``None`` makes a new figure.
      interval: milliseconds per frame.
      options: passed to ``draw``.

    Returns:
      A matplotlib ``FuncAnimation`` with a ``.figure``. Keep a reference; ``.save("tube.gif", writer="pillow")`` saves.

    Raises:
      ValueError: the solution is stationary.
    """
    from matplotlib.animation import FuncAnimation

    if described(solution).times is None:
        raise ValueError("animation: the solution is stationary; use march(..., times=np.linspace(0, horizon, 41))")
    if not callable(draw):
        raise TypeError(f"animation: got draw = {draw!r}, wanted a function such as hjb.plotting.value")
    # check now, because the frames are drawn later or never
    refuse_misspelt(options, {*(keywords(draw) or options), "interval"}, "animation")
    axes = _moving_axes(solution, draw, ax, options)

    def frame_at(time: float) -> list[Artist]:
        axes.clear()  # contours cannot be updated, so every frame is drawn again
        draw(solution, ax=axes, time=float(time), **options)
        if not axes.get_title(loc="right"):  # if a custom function does not show the time
            axes.set_title(f"t = {time:.3g}", loc="right", fontsize=9)
        return axes.get_children()

    # backward, because march starts at the horizon
    frames = np.asarray(solution.times)[::-1]
    moving = FuncAnimation(cast("Figure", axes.get_figure()), frame_at, frames=frames, interval=interval)
    setattr(moving, "figure", axes.get_figure())  # noqa: B010, as for every other picture; FuncAnimation has no figure
    return moving


def _moving_axes(solution: Solution, draw: Callable[..., Any], ax: Axes | None, options: Mapping[str, Any]) -> Axes:
    """The axes of an animation, three-dimensional for a surface."""
    gone = options.get("project") or ()
    gone = [gone] if isinstance(gone, (str, int)) else gone
    free = solution.grid.ndim - len(options.get("fixed") or ()) - len(gone)
    return solid_axes(ax) if draw is zero_level_set and free == 3 else axes_of(ax)
