"""Plots of bounds on the true value."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from hjbjax.plotting.shading import Look, draw, frame
from hjbjax.plotting.slices import Cuts, Section, section_of
from hjbjax.plotting.style import COLOURS, GREY, Picture, drawing, legend, pair_of_axes

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from hjbjax.enclosure.bounds import Enclosure

LINES = 7  # contour lines of each bound
LARGE = 0.5  # fraction of the largest shift from which on a node is marked
SIDES = ("lower", "upper")


@drawing
def enclosure(
    enclosure: Enclosure,
    *,
    ax: Axes | Sequence[Axes] | np.ndarray | None = None,
    fixed: Cuts | None = None,
    colorbar: bool = True,
) -> Picture:
    """Plot two bounds on the true value, their width, and where the width is lost.

    Over one axis the first picture has both bounds as lines with the area between them. The second one has the width
    and, for each bound, the shift that the cells require. Over two axes the first picture has contour lines of both
    bounds, and the second one the width in colours. Dots mark the nodes whose cells require at least half of the
    largest shift: more nodes help most there.

    Args:
      enclosure: the result of ``enclose``.

    Keyword Args:
      ax: matplotlib axes to draw on: one for the bounds, or two, the second for the width; ``None`` makes a pyplot
        figure with both.
      fixed: coordinates at which axes are cut, by number or name; at most two axes may remain free.
      colorbar: draw a colour bar of the width over two axes.

    Returns:
      The artists, first the lower bound, then the upper bound.

    Raises:
      ValueError: more than two axes are free, or ``fixed`` has an axis or a coordinate that does not exist.
    """

    def cut(field: np.ndarray) -> Section:
        return section_of("enclosure", np.asarray(field, float), enclosure.grid, fixed, "")

    bounds, width = [cut(enclosure.lower), cut(enclosure.upper)], cut(enclosure.upper - enclosure.lower)
    required = [cut(each) for each in enclosure.required]
    axes: list[Axes] = pair_of_axes(sharey=False) if ax is None else list(np.ravel(cast(Any, ax)))
    flat = len(width.axes) == 1
    artists = _lines(axes[0], bounds) if flat else _contours(axes[0], bounds)
    if len(axes) > 1:
        artists += _shifts(axes[1], width, required) if flat else _losses(axes[1], width, required, colorbar)
    return Picture(artists, axes[0])


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
