"""Plots of bounds on the true value."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from hjbjax.plotting.shading import Look, draw, frame
from hjbjax.plotting.slices import Cuts, Section, section_of
from hjbjax.plotting.style import COLOURS, GREY, Picture, axes_of, drawing, legend, pair_of_axes

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from hjbjax.enclosure.bounds import Enclosure
    from hjbjax.enclosure.tubes import TubeEnclosure

LINES = 7  # contour lines of each bound
LARGE = 0.5  # fraction of the largest shift from which on a node is marked
SIDES = ("lower", "upper")
SETS = ("inner", "outer")
FINER = 50  # points per cell of the states over one axis between two sets


@drawing
def enclosure(
    enclosure: Enclosure | TubeEnclosure,
    *,
    ax: Axes | Sequence[Axes] | np.ndarray | None = None,
    fixed: Cuts | None = None,
    colorbar: bool = True,
) -> Picture:
    """Plot two bounds on the true value, their width, and where the width is lost; or the two sets of a tube.

    Over one axis the first picture has both bounds as lines with the area between them. The second one has the width
    and, for each bound, the shift that the cells require. Over two axes the first picture has contour lines of both
    bounds, and the second one the width in colours. Dots mark the nodes whose cells require at least half of the
    largest shift: more nodes help most there.

    The picture of a tube has the functions of the inner and the outer set over one axis, each at most zero in its set,
    or the boundaries of both sets over two axes. The states between them are grey: nothing is proved there.

    Args:
      enclosure: the result of ``enclose`` or ``enclose_tube``.

    Keyword Args:
      ax: matplotlib axes to draw on: one for the bounds or for the sets, or two, the second for the width; ``None``
        makes a pyplot figure.
      fixed: coordinates at which axes are cut, by number or name; at most two axes may remain free.
      colorbar: draw a colour bar of the width over two axes.

    Returns:
      The artists, first the lower bound, then the upper bound; for a tube first the inner set, then the outer one. A
      set without a boundary has no artist over two axes.

    Raises:
      ValueError: more than two axes are free, or ``fixed`` has an axis or a coordinate that does not exist.
    """

    def cut(field: np.ndarray) -> Section:
        return section_of("enclosure", np.asarray(field, float), enclosure.grid, fixed, "")

    if hasattr(enclosure, "inner"):
        sets = cast("TubeEnclosure", enclosure)
        return _sets(ax, [cut(sets.inner), cut(sets.outer)])
    bounds, width = [cut(enclosure.lower), cut(enclosure.upper)], cut(enclosure.upper - enclosure.lower)
    required = [cut(each) for each in enclosure.required]
    axes: list[Axes] = pair_of_axes(sharey=False) if ax is None else list(np.ravel(cast(Any, ax)))
    flat = len(width.axes) == 1
    artists = _lines(axes[0], bounds) if flat else _contours(axes[0], bounds)
    if len(axes) > 1:
        artists += _shifts(axes[1], width, required) if flat else _losses(axes[1], width, required, colorbar)
    return Picture(artists, axes[0])


def _sets(ax: Any, sets: list[Section]) -> Picture:
    """The inner and the outer set of a tube."""
    own = axes_of(None if ax is None else np.ravel(ax)[0])
    artists: list[Artist] = []
    if len(sets[0].axes) == 1:
        (x,) = sets[0].coordinates
        for name, each, color in zip(SETS, sets, COLOURS, strict=False):
            artists += own.plot(x, each.values, color=color, linewidth=1.2, label=f"{name} set")
        artists.append(own.axhline(0.0, color="black", linewidth=0.6))
        artists.append(_between(own, x, sets))
        frame(own, sets[0], "function of the set")
    else:
        for name, each, color, style in zip(SETS, sets, COLOURS, ("-", "--"), strict=False):
            drawn: dict[str, Any] = {"colors": color, "linewidths": 1.2, "linestyles": style}
            known = each.values.compressed()
            if known.size and known.min() <= 0 <= known.max():
                artists.append(own.contour(*each.coordinates, each.values.T, levels=[0.0], **drawn))
            own.plot([], [], color=color, linestyle=style, linewidth=1.2, label=f"{name} set")  # for the legend
        artists += _unproved(own, sets)
        frame(own, sets[0])
    legend(own)
    return Picture(artists, own)


def _between(ax: Axes, x: np.ndarray, sets: list[Section]) -> Artist:
    """The states over one axis that are in the outer and not in the inner set."""
    place = np.linspace(0, len(x) - 1, FINER * (len(x) - 1) + 1)  # the boundaries are between the nodes
    fine, inner, outer = (
        np.interp(place, np.arange(len(x)), each)
        for each in (x, sets[0].values.filled(np.inf), sets[1].values.filled(-np.inf))
    )
    lines = ax.get_xaxis_transform()
    where = (outer <= 0) & (inner > 0)
    return ax.fill_between(fine, 0, 1, where=where, color=GREY, linewidth=0, zorder=0, transform=lines)


def _unproved(ax: Axes, sets: list[Section]) -> list[Artist]:
    """The states over two axes that are in the outer and not in the inner set."""
    inner, outer = sets[0].values.filled(np.inf), sets[1].values.filled(-np.inf)
    # negative where a state is in the outer and not in the inner set
    margin = np.maximum(outer, -inner)
    if not np.any(margin < 0):
        return []
    lowest = float(np.min(margin[np.isfinite(margin)], initial=-1.0))
    shown = np.clip(margin, lowest, None)
    levels = [2 * lowest, 0.0]
    return [ax.contourf(*sets[0].coordinates, shown.T, levels=levels, colors=[GREY], zorder=0)]


def _lines(ax: Axes, bounds: list[Section]) -> list[Artist]:
    """Two bounds over one axis, and the area between them."""
    (x,) = bounds[0].coordinates
    artists: list[Artist] = []
    for name, bound, color in zip(SIDES, bounds, COLOURS, strict=False):
        artists += ax.plot(x, bound.values, color=color, linewidth=1.2, label=f"{name} bound")
    low, high = (bound.values for bound in bounds)
    artists.append(ax.fill_between(x, low, high, color=GREY, linewidth=0, zorder=0))
    frame(ax, bounds[0], "V")
    legend(ax)
    return artists


def _contours(ax: Axes, bounds: list[Section]) -> list[Artist]:
    """Contour lines of two bounds over two axes, at the same levels."""
    known = np.concatenate([bound.values.compressed() for bound in bounds])
    varies = known.size > 0 and np.ptp(known) > 0
    levels = np.linspace(known.min(), known.max(), LINES + 2)[1:-1] if varies else np.zeros(0)
    artists: list[Artist] = []
    for name, bound, color, style in zip(SIDES, bounds, COLOURS, ("-", "--"), strict=False):
        drawn: dict[str, Any] = {"colors": color, "linewidths": 1.0, "linestyles": style}
        lines = ax.contour(*bound.coordinates, bound.values.T, levels=levels, **drawn) if len(levels) else None
        artists += [] if lines is None else [lines]
        ax.plot([], [], color=color, linestyle=style, linewidth=1.0, label=f"{name} bound")  # for the legend
    frame(ax, bounds[0])
    legend(ax)
    return artists


def _shifts(ax: Axes, width: Section, required: list[Section]) -> list[Artist]:
    """The width and the shifts that cells require, over one axis."""
    (x,) = width.coordinates
    artists: list[Artist] = [*ax.plot(x, width.values, color="black", linewidth=1.6, label="width")]
    for name, each, color in zip(SIDES, required, COLOURS, strict=False):
        shift = np.maximum(each.values, 0.0)
        artists += ax.plot(x, shift, color=color, linewidth=0.9, label=f"required, {name}")
    frame(ax, width, "width")
    ax.set_ylim(bottom=0.0)
    legend(ax)
    return artists


def _losses(ax: Axes, width: Section, required: list[Section], colorbar: bool) -> list[Artist]:
    """The width in colours, with dots where cells require large shifts."""
    artists = draw(ax, width, Look("width", "∞", colorbar))
    for name, each, color in zip(SIDES, required, COLOURS, strict=False):
        shift = each.values.filled(np.inf)
        if np.max(shift) > 0:
            states = each.states(each.coordinates)[shift >= LARGE * np.max(shift)]
            dots: dict[str, Any] = {"color": color, "marker": ".", "markersize": 3, "linestyle": "none"}
            artists += ax.plot(*states[:, list(each.axes)].T, label=f"required, {name}", **dots)
    legend(ax)
    return artists
