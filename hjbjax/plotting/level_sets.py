"""Zero level sets of values, in two and in three dimensions, as slices or as projections; and pictures that move.

A set {V ≤ 0} of more states than are drawn is cut by ``fixed`` or projected: a point belongs to the projection if
some state above it belongs to the set, so that the value is minimised over the axes that go (maximised for {V ≥ 0}).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from hjbjax.plotting.slices import Cuts, Section, at_time, axis_number, section_of
from hjbjax.plotting.style import COLOURS, axes_of, frame, label_axes, legend
from hjbjax.problem.grid import Grid

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from hjbjax.solution.solution import Solution

LAYERS = 25  # cuts through the third axis


@dataclasses.dataclass(frozen=True)
class Field:
    """Numbers at the nodes of a grid, (*grid), and the caption that names their time."""

    values: np.ndarray
    grid: Grid
    caption: str

    def section(self, fixed: Mapping[str, float]) -> Section:
        """The field cut at the coordinates of the axes named."""
        return section_of("zero_level_set", self.values, self.grid, fixed, self.caption)


def zero_level_set(
    solution: Solution,
    *,
    ax: Axes | None = None,
    fixed: Cuts | None = None,
    project: int | str | Sequence[int | str] = (),
    inside: str = "below",
    time: float | None = None,
    color: str = COLOURS[0],
    label: str | None = None,
    fill: bool = True,
) -> list[Artist]:
    """The boundary of {V ≤ 0}: a curve over two axes, a stack of curves over three.

    Args:
      solution: the solution of ``solve`` or ``march``.

    Keyword Args:
      ax: matplotlib axes to draw on, three-dimensional for three free axes; ``None`` makes a figure.
      fixed: coordinates of axes to cut at, by number or name.
      project: axes, by number or name, along which the set is projected.
      inside: ``"below"`` for {V ≤ 0}, as of ``reach``; ``"above"`` for {V ≥ 0}, as of ``avoid``.
      time: for a marched solution, which stored time to draw (the nearest one; ``None`` is the earliest).
      color: of the curve.
      label: of the curve in the legend; ``None`` leaves it out.
      fill: whether the set is shaded, over two axes.

    Returns:
      The artists: the curve first, or the lowest of the stack; an empty list where the set is empty.

    Raises:
      ValueError: fewer than two or more than three axes are free, or an axis that does not exist.

    Example:
      >>> from types import SimpleNamespace
      >>> grid = Grid(lo=[-1.0, -1.0], hi=[1.0, 1.0], shape=(21, 21))
      >>> disc = np.sum(grid.nodes() ** 2, axis=-1) - 0.25
      >>> len(zero_level_set(SimpleNamespace(grid=grid, value=disc, times=None), fill=False))
      1
    """
    if inside not in ("below", "above"):
        raise ValueError(f"zero_level_set: got inside = {inside!r}, wanted 'below' (V ≤ 0) or 'above' (V ≥ 0)")
    values, caption = at_time(solution, solution.value, time)
    sign = 1 if inside == "below" else -1  # from here on the set is {V ≤ 0} in either case
    field = _projection(Field(sign * values, solution.grid, caption), project)
    # by name: a projection has taken axes out, and the numbers of the others have changed
    cuts = {field.grid.names[axis_number(key, field.grid)]: place for key, place in dict(fixed or {}).items()}
    if field.grid.ndim - len(cuts) == 3:
        return _stack(field, cuts, ax, color, label)
    section = field.section(cuts)
    if len(section.axes) != 2:
        raise ValueError("zero_level_set: one axis is free; a level set is drawn over two or three")
    ax = axes_of(ax)
    artists = _curve(ax, section, color, fill)
    frame(ax, section)
    if label and artists:  # contours take no label: an empty line stands for them in the legend
        ax.plot([], [], color=color, linewidth=1.6, label=label)
        legend(ax)
    return artists


def _projection(field: Field, project: int | str | Sequence[int | str]) -> Field:
    """The least value over the axes that go, on the grid of those that stay."""
    grid = field.grid
    if isinstance(project, (str, int)):
        project = (project,)
    gone = sorted({axis_number(key, grid) for key in project})
    if not gone:
        return field
    stay = [axis for axis in range(grid.ndim) if axis not in gone]
    if len(stay) < 2:
        raise ValueError("zero_level_set: project leaves fewer than two axes")

    def pick(entries):
        return tuple(entries[axis] for axis in stay)

    smaller = Grid(
        np.asarray(grid.lo)[stay], np.asarray(grid.hi)[stay], pick(grid.shape), pick(grid.periodic), pick(grid.names),
        pick(grid.stretch),
    )  # fmt: skip
    # a NaN above a point makes its minimum NaN, which is masked: nothing is said where something is unknown
    return Field(np.min(field.values, axis=tuple(gone)), smaller, field.caption)


def _curve(ax: Axes, section: Section, color: str, fill: bool) -> list[Artist]:
    """The curve V = 0 over two axes, and the shade of V ≤ 0; nothing where the set is empty."""
    known = section.values.compressed()
    if known.size == 0 or known.min() > 0:
        return []
    x, y = section.coordinates
    artists: list[Artist] = []
    if known.max() > 0:  # a set that is the whole box has no boundary in it, and matplotlib would warn
        artists.append(ax.contour(x, y, section.values.T, levels=[0.0], colors=color, linewidths=1.6))
    if fill:  # matplotlib wants two levels: the lower one is below all values
        artists.append(ax.contourf(x, y, section.values.T, levels=[known.min() - 1, 0.0], colors=color, alpha=0.15))
    return artists


def _stack(field: Field, fixed: Mapping[str, float], ax: Axes | None, color: str, label: str | None) -> list[Artist]:
    """Curves at many places of the third free axis, each in its own plane."""
    if ax is None:
        from matplotlib.figure import Figure

        ax = Figure(figsize=(5.4, 4.6), layout="constrained").add_subplot(projection="3d")
    grid = field.grid
    free = [axis for axis in range(grid.ndim) if grid.names[axis] not in fixed]
    third = free[2]
    nodes = np.asarray(grid.axis(third))
    # at nodes, all of them where there are fewer than so many; between nodes the values would have to be interpolated
    places = nodes[np.unique(np.linspace(0, len(nodes) - 1, min(LAYERS, len(nodes))).round().astype(int))]
    names = [grid.names[axis] for axis in free]
    artists: list[Artist] = []
    for place in places:
        section = field.section({**fixed, names[2]: place})
        known = section.values.compressed()
        if known.size and known.min() < 0 < known.max():
            x, y = section.coordinates
            style: dict[str, Any] = {"levels": [0.0], "colors": color, "linewidths": 0.8, "zdir": "z", "offset": place}
            artists.append(ax.contour(x, y, section.values.T, **style))
    ax.set(xlim=_ends(grid, free[0]), ylim=_ends(grid, free[1]), zlim=_ends(grid, third), zlabel=names[2])
    label_axes(ax, *names[:2])
    if label and artists:
        ax.plot([], [], [], color=color, label=label)
        ax.legend(frameon=False, fontsize=8)
    return artists


def _ends(grid: Grid, axis: int) -> tuple[float, float]:
    """The two ends of an axis of the box."""
    return float(grid.lo[axis]), float(grid.hi[axis])


def animation(
    solution: Solution,
    draw: Callable[..., list[Artist]] = zero_level_set,
    *,
    ax: Axes | None = None,
    interval: float = 100.0,
    **options: Any,
) -> FuncAnimation:
    """A marched solution over time, from the horizon backwards as it was found.

    Args:
      solution: the solution of ``march``, with the times that become the frames.
      draw: what draws one frame: ``zero_level_set``, ``value`` or ``policy`` of this module, or a function that
        takes the solution, ``ax=`` and ``time=``.

    Keyword Args:
      ax: matplotlib axes to draw on, wiped for every frame; ``None`` makes a figure.
      interval: milliseconds a frame.
      options: for ``draw``.

    Returns:
      A matplotlib ``FuncAnimation``; keep it, and ``.save("tube.gif", writer="pillow")`` it.

    Raises:
      ValueError: a stationary solution.
    """
    from matplotlib.animation import FuncAnimation

    if getattr(solution, "times", None) is None:
        raise ValueError("animation: the solution is stationary; march(..., times=np.linspace(0, horizon, 41)) moves")
    axes = axes_of(ax)

    def frame_at(time: float) -> list[Artist]:
        axes.clear()  # contours have no data that could be replaced: every frame is drawn anew
        draw(solution, ax=axes, time=float(time), **options)
        axes.set_title(f"t = {time:.3g}", loc="left", fontsize=9)
        return axes.get_children()

    # backwards: the horizon, where the march began, comes first
    frames = np.asarray(solution.times)[::-1]
    return FuncAnimation(cast("Figure", axes.get_figure()), frame_at, frames=frames, interval=interval)
