"""Zero level sets of values, in two and in three dimensions, as slices or as projections; and pictures that move.

A set {V ≤ 0} of more states than are drawn is cut by ``fixed`` or projected: a point belongs to the projection if
some state above it belongs to the set, so that the value is minimised over the axes that go (maximised for {V ≥ 0}).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from hjbjax.plotting.slices import Section, at_time, axis_number, section_of
from hjbjax.plotting.style import COLOURS, axes_of, frame, label_axes, legend
from hjbjax.problem.grid import Grid

LAYERS = 25  # cuts through the third axis


def zero_level_set(
    solution: Any,
    *,
    ax: Any = None,
    fixed: Mapping[Any, float] | None = None,
    project: Sequence[Any] = (),
    inside: str = "below",
    time: float | None = None,
    color: str = COLOURS[0],
    label: str | None = None,
    fill: bool = True,
) -> list[Any]:
    """The boundary of {V ≤ 0}: a curve over two axes, a stack of curves over three.

    Args:
      solution: what ``solve`` or ``march`` returned.

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
    field, caption = at_time(solution, solution.value, time)
    sign = 1 if inside == "below" else -1
    field, grid = _projected(sign * field, solution.grid, project)
    fixed = {grid.names[axis_number(key, grid)]: place for key, place in dict(fixed or {}).items()}
    free = [axis for axis in range(grid.ndim) if grid.names[axis] not in fixed]
    if len(free) == 3:
        return _stack(field, grid, fixed, free, ax, color, label, caption)
    section = section_of("zero_level_set", field, grid, fixed, caption)
    if len(section.axes) != 2:
        raise ValueError("zero_level_set: one axis is free; a level set is drawn over two or three")
    ax = axes_of(ax)
    artists = _curve(ax, section, color, fill)
    frame(ax, section, grid)
    if label and artists:
        ax.plot([], [], color=color, linewidth=1.6, label=label)
        legend(ax)
    return artists


def _projected(field: np.ndarray, grid: Grid, project: Sequence[Any]) -> tuple[np.ndarray, Grid]:
    """The least value over the axes that go, and the grid of those that stay."""
    if isinstance(project, (str, int)):
        project = (project,)
    gone = sorted({axis_number(key, grid) for key in project})
    if not gone:
        return field, grid
    stay = [axis for axis in range(grid.ndim) if axis not in gone]
    if len(stay) < 2:
        raise ValueError("zero_level_set: project leaves fewer than two axes")

    def pick(entries):
        return tuple(entries[axis] for axis in stay)

    smaller = Grid(
        np.asarray(grid.lo)[stay], np.asarray(grid.hi)[stay], pick(grid.shape), pick(grid.periodic), pick(grid.names),
        pick(grid.stretch),
    )  # fmt: skip
    return np.min(field, axis=tuple(gone)), smaller


def _curve(ax: Any, section: Section, color: str, fill: bool) -> list[Any]:
    known = section.values.compressed()
    if known.size == 0 or known.min() > 0:
        return []
    x, y = section.coordinates
    artists = []
    if known.max() > 0:
        artists.append(ax.contour(x, y, section.values.T, levels=[0.0], colors=color, linewidths=1.6))
    if fill:
        artists.append(ax.contourf(x, y, section.values.T, levels=[known.min() - 1, 0.0], colors=color, alpha=0.15))
    return artists


def _stack(
    field: np.ndarray,
    grid: Grid,
    fixed: Mapping[Any, float],
    free: list[int],
    ax: Any,
    color: str,
    label: str | None,
    caption: str,
) -> list[Any]:
    """Curves at many places of the third free axis, each in its own plane."""
    if ax is None:
        from matplotlib.figure import Figure

        ax = Figure(figsize=(5.4, 4.6), layout="constrained").add_subplot(projection="3d")
    third = free[2]
    nodes = np.asarray(grid.axis(third))
    places = nodes[np.unique(np.linspace(0, len(nodes) - 1, min(LAYERS, len(nodes))).round().astype(int))]
    artists, names = [], [grid.names[axis] for axis in free]
    for place in places:
        section = section_of("zero_level_set", field, grid, {**fixed, names[2]: place}, caption)
        known = section.values.compressed()
        if known.size and known.min() < 0 < known.max():
            x, y = section.coordinates
            style = {"levels": [0.0], "colors": color, "linewidths": 0.8, "zdir": "z", "offset": place}
            artists.append(ax.contour(x, y, section.values.T, **style))
    ax.set(xlim=_ends(grid, free[0]), ylim=_ends(grid, free[1]), zlim=_ends(grid, third), zlabel=names[2])
    label_axes(ax, *names[:2])
    if label and artists:
        ax.plot([], [], [], color=color, label=label)
        ax.legend(frameon=False, fontsize=8)
    return artists


def _ends(grid: Grid, axis: int) -> tuple[float, float]:
    return float(grid.lo[axis]), float(grid.hi[axis])


def animation(
    solution: Any,
    draw: Callable[..., list[Any]] = zero_level_set,
    *,
    ax: Any = None,
    interval: float = 100.0,
    **options: Any,
) -> Any:
    """A marched solution over time, from the horizon backwards as it was found.

    Args:
      solution: what ``march`` returned, with the times that become the frames.
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
    ax = axes_of(ax)

    def frame_at(time):
        ax.clear()
        draw(solution, ax=ax, time=float(time), **options)
        ax.set_title(f"t = {time:.3g}", loc="left", fontsize=9)
        return ax.get_children()

    return FuncAnimation(ax.get_figure(), frame_at, frames=np.asarray(solution.times)[::-1], interval=interval)
