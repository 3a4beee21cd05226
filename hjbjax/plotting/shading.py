"""Draw one section: a line over one axis or colours over two, with outlines of sets and hatches for missing values.

Values are shaded smoothly between the nodes, and so are controls, unless they jump. Controls that jump are drawn as
cells. Sets are outlined on a raster finer than the nodes, so that a disc is round on any grid.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.plotting.scales import number_text, scale_axes
from hjbjax.plotting.slices import Region, Section
from hjbjax.plotting.style import COLOURS, GREY, label_axes, legend
from hjbjax.solution.free_boundary import points_of, segments_of

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

CLEARANCE = 8.0  # points from the top of a colour bar to its label; a tick label at the top takes half of them
WORDY = 10  # characters next to each other above a colour bar; more are broken at the equals sign
FLAT = 1e-4  # relative variation below which a field is drawn as constant, as left by a solve of a constant V
OBSTACLE = "obstacle"  # the label of a set that is drawn solid
HATCH, CROSSES, STROKE = "////", "xx", "#909090"
# the patterns of sets where the state stops or is pushed, one per name; lines along a graph would hide it
DOTS = ("..", "oo", "++", r"\\\\")
EXTREME = 1e-6  # fraction of the range: a control closer to its end counts as being there
JUMPING = 0.9  # fraction of nodes at an end of the range, or at zero, that identifies a feedback that jumps


@dataclasses.dataclass(frozen=True)
class Look:
    """The options for drawing a section.

    Args:
      label: the label of the numbers.
      hidden: the legend for nodes without a number; empty to leave them unmarked over one axis.
      colorbar: draw a colour bar.
      diverging: put zero in the middle of the colours, grey, if both signs occur.
      cells: draw nodes as cells instead of shading smoothly.
      span: the range of the numbers; a variation below ``FLAT`` times the span counts as zero. 0 if unknown.
      idle: the nodes whose numbers are not shown because no control acts there, bool, in the shape of the section.
    """

    label: str
    hidden: str
    colorbar: bool = True
    diverging: bool = False
    cells: bool = False
    span: float = 0.0
    idle: np.ndarray | None = None

    def shown(self, section: Section) -> np.ma.MaskedArray:
        """The numbers to show, with idle nodes masked."""
        values = section.values
        return values if self.idle is None else np.ma.array(values, mask=np.ma.getmaskarray(values) | self.idle)


def draw(ax: Axes, section: Section, look: Look, regions: tuple[Region, ...] = ()) -> list[Artist]:
    """Draw one section as a line or as a colour mesh, hatch hidden nodes, and outline the regions."""
    mask = np.ma.getmaskarray(section.values)
    if len(section.axes) == 1:
        line = look.shown(section)
        steps = "steps-mid" if look.cells else "default"  # a slope over one cell would be a control that is not used
        artists: list[Artist] = [
            *ax.plot(section.coordinates[0], line, color=COLOURS[0], linewidth=1.6, drawstyle=steps)
        ]
        artists += bands(ax, section.coordinates[0], mask, look.hidden) if look.hidden else []
        known = line.compressed()
        if known.size and is_level(known, look.span):  # otherwise the axis would show rounding errors
            ax.set_ylim(*limits_around(float(np.mean(known)), look.span))
        frame(ax, section, look.label)
    else:
        frame(ax, section)
        artists = _mesh(ax, section, look, regions)
    if ax.get_legend_handles_labels()[1]:
        legend(ax)
    return artists


def is_level(known: np.ndarray, span: float = 0.0) -> bool:
    """True if the numbers vary only by rounding, relative to themselves or to the span."""
    return bool(np.ptp(known) < FLAT * max(abs(float(np.mean(known))), span))


def limits_around(middle: float, span: float = 0.0) -> tuple[float, float]:
    """The limits of the scale for a constant: half of it, or half of the span, on either side."""
    room = 0.5 * max(abs(middle), 0.0 if abs(middle) > FLAT * span else span)
    return middle - room, middle + room


def jumps(known: np.ndarray) -> bool:
    """True for a feedback that jumps: 90 % of its entries are zero or at an end of their range."""
    if known.size == 0 or is_level(known):
        return False
    lo, hi, near = known.min(), known.max(), EXTREME * np.ptp(known)
    settled = (known <= lo + near) | (known >= hi - near) | (np.abs(known) <= near)
    return bool(np.mean(settled) > JUMPING)


def _mesh(ax: Axes, section: Section, look: Look, regions: tuple[Region, ...]) -> list[Artist]:
    """Draw a section over two axes; the mesh is the first artist, then hatches and outlines."""
    values, mask = section.values, np.ma.getmaskarray(section.values)
    known = look.shown(section).compressed()
    lo, hi, colours = _colours(known, look)
    # rasterized, because a mesh of 200 x 200 as vectors gives a PDF with 40 000 rectangles
    style: dict[str, Any] = {"cmap": colours, "vmin": lo, "vmax": hi, "rasterized": True}
    shading: Any = "nearest" if look.cells else "gouraud"
    # transposed, because matplotlib's rows go upwards and our first axis goes to the right
    mesh = ax.pcolormesh(*section.coordinates, fill_missing(values).T, shading=shading, **style)
    # outlined sets already cover their nodes, whose cells would extend beyond the outline
    unknown = mask & ~np.any([region.nodes for region in regions], axis=0) if regions else mask
    artists: list[Artist] = [mesh]
    if unknown.any():
        artists += hatched(ax, section.coordinates, unknown.astype(float) - 0.5, look.hidden)
    for region in regions:
        artists += outlined(ax, region)
    if look.colorbar and known.size:
        add_colorbar(ax, mesh, look.label)
    return artists


def _colours(known: np.ndarray, look: Look) -> tuple[float, float, Colormap]:
    """The limits of the colours and their map.

    Both maps rise in lightness, so a picture printed in grey does not show two numbers as one shade. The map for both
    signs goes from blue over grey at zero to yellow.
    """
    from matplotlib import colormaps

    if known.size == 0:
        return 0.0, 1.0, colormaps["viridis"]
    lo, hi = float(known.min()), float(known.max())
    level = is_level(known, look.span)
    largest = max(abs(lo), abs(hi)) or look.span or 1.0
    if not look.diverging:
        if level:
            lo, hi = limits_around((lo + hi) / 2, look.span)
        return lo, hi if hi > lo else lo + 1.0, colormaps["viridis"]
    if lo < -EXTREME * largest and hi > EXTREME * largest:
        return -largest, largest, colormaps["cividis"]
    if hi > EXTREME * largest:
        return 0.0, largest, colormaps["viridis"]
    if lo < -EXTREME * largest:
        return -largest, 0.0, colormaps["viridis"]
    return -largest, largest, colormaps["cividis"]


def fill_missing(values: np.ma.MaskedArray) -> np.ndarray:
    """The values, with missing ones replaced by the nearest known value, so that the shading has no gaps."""
    mask, data = np.ma.getmaskarray(values), np.asarray(values.data, float)
    lost = ~np.isfinite(data)
    if mask.all() or not lost.any():
        return np.zeros_like(data) if lost.any() else data
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(lost, return_distances=False, return_indices=True)
    return data[tuple(nearest)]


def hatched(ax: Axes, coordinates: tuple[np.ndarray, ...], level: np.ndarray, label: str) -> list[Artist]:
    """Hatch the area where ``level``, (M₁, M₂), is positive, and add a patch to the legend."""
    from matplotlib.patches import Rectangle

    if not level.max() > 0:
        return []
    style: dict[str, Any] = {"levels": [0.0, float(level.max()) + 1.0], "colors": ["white"], "hatches": [HATCH]}
    area = ax.contourf(*coordinates, level.T, zorder=2, **style)
    area.set(edgecolor=STROKE, linewidth=0.0)
    # contours cannot have a label, so an empty rectangle stands for them in the legend, once
    if label not in ax.get_legend_handles_labels()[1]:
        corner = (float(coordinates[0][0]), float(coordinates[1][0]))
        ax.add_patch(
            Rectangle(corner, 0, 0, facecolor="white", edgecolor=STROKE, hatch=HATCH, linewidth=0.6, label=label)
        )
    return [area]


def outlined(ax: Axes, region: Region, *, inside: bool = True) -> list[Artist]:
    """Outline a set, and hatch it if ``inside``; a set that is too thin for an outline is drawn by its nodes."""
    from matplotlib.patches import Rectangle

    if not region.visible:
        return _marked(ax, region)
    artists: list[Artist] = []
    new = region.label not in ax.get_legend_handles_labels()[1]
    if region.label == OBSTACLE:  # solid, and not hatched or empty like a target
        area: dict[str, Any] = {"facecolor": GREY, "edgecolor": "black", "linewidth": 0.6}
        if region.level.min() < 0:
            top = [0.0, float(-region.level.min()) + 1.0]
            artists.append(ax.contourf(*region.coordinates, -region.level.T, levels=top, colors=[GREY], zorder=2))
        if new:
            corner = (float(region.coordinates[0][0]), float(region.coordinates[1][0]))
            ax.add_patch(Rectangle(corner, 0, 0, label=region.label, **area))
    elif inside:
        artists += hatched(ax, region.coordinates, -region.level, region.label)
    elif new:
        ax.plot([], [], color="black", linewidth=1.0, label=region.label)
    if region.level.max() > 0:  # otherwise the set fills the picture, and matplotlib would warn about an empty contour
        artists.append(
            ax.contour(*region.coordinates, region.level.T, levels=[0.0], colors="black", linewidths=1.0, zorder=2.5)
        )
    return artists


def _marked(ax: Axes, region: Region) -> list[Artist]:
    """Mark the nodes of a set that is a point or thinner than a line; draws nothing if it has none."""
    if not len(region.points):
        return []
    label = region.label if region.label not in ax.get_legend_handles_labels()[1] else None
    style: dict[str, Any] = {"marker": "D", "color": "black", "markersize": 4, "markeredgecolor": "white"}
    return [*ax.plot(*region.points.T, linestyle="none", markeredgewidth=0.6, zorder=3, label=label, **style)]


def dot_region(
    ax: Axes, section: Section, inside: np.ndarray, values: np.ndarray, name: str, *, cover: bool = False
) -> list[Artist]:
    """Dot the part of a section where it is optimal to stop or push, up to the free boundary, and name it.

    A second set on the same axes has another pattern than dots.

    Args:
      inside: True for nodes of the set, of the shape of the section.
      values: V at the same nodes.
      name: the label of the set.

    Keyword Args:
      cover: hide the colours under the dots.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    if not inside.any():
        return []
    pattern = _pattern(ax)
    style: dict[str, Any] = {"facecolor": "none", "edgecolor": STROKE, "hatch": pattern}
    artists: list[Artist] = []
    if len(section.axes) == 1:
        (x,) = section.coordinates
        ends = [*x[:1][inside[:1]], *points_of(x, values, inside, None), *x[-1:][inside[-1:]]]
        for k, (left, right) in enumerate(zip(ends[::2], ends[1::2], strict=True)):
            artists.append(ax.axvspan(left, right, linewidth=0.6, zorder=0, label=None if k else name, **style))
    else:
        area: Any = {"levels": [0.0, 1.0], "colors": "white" if cover else "none", "hatches": [pattern], "zorder": 2}
        dots = ax.contourf(*section.coordinates, inside.T - 0.5, **area)
        dots.set(edgecolor=STROKE, linewidth=0.0)
        segments = segments_of(section.coordinates, values, inside, (None, None))
        artists += [dots, ax.add_collection(LineCollection(list(segments), colors="black", linewidths=1.0, zorder=2.5))]
        corner = (float(section.coordinates[0][0]), float(section.coordinates[1][0]))
        ax.add_patch(Rectangle(corner, 0, 0, linewidth=0.6, label=name, **style))
    legend(ax)
    return artists


def cross_out(ax: Axes, section: Section, nodes: np.ndarray) -> list[Artist]:
    """Cross out the part of a section over two axes where the ends of the box change V, and name it."""
    from matplotlib.patches import Rectangle

    if len(section.axes) == 1 or not nodes.any():
        return []
    area = ax.contourf(
        *section.coordinates, nodes.T - 0.5, levels=[0.0, 1.0], colors="none", hatches=[CROSSES], zorder=2
    )
    area.set(edgecolor=STROKE, linewidth=0.0)
    corner = (float(section.coordinates[0][0]), float(section.coordinates[1][0]))
    style: dict[str, Any] = {"facecolor": "none", "edgecolor": STROKE, "hatch": CROSSES, "linewidth": 0.6}
    ax.add_patch(Rectangle(corner, 0, 0, label="depends on the box", **style))
    legend(ax)
    return [area]


def _pattern(ax: Axes) -> str:
    """The first pattern that no set in the legend has."""
    used = [handle.get_hatch() for handle in ax.get_legend_handles_labels()[0] if hasattr(handle, "get_hatch")]
    return next((pattern for pattern in DOTS if pattern not in used), DOTS[0])


def add_colorbar(ax: Axes, mesh: Any, label: str) -> Any:
    """Draw the colour bar of a mesh, with a horizontal label above it."""
    from matplotlib.ticker import FuncFormatter
    from matplotlib.transforms import offset_copy

    bar = ax.figure.colorbar(mesh, ax=ax, fraction=0.06, pad=0.03, format=FuncFormatter(number_text))
    bar.outline.set_visible(False)
    bar.ax.tick_params(width=0.8, length=3, labelsize=9)
    # a text, because the layout reserves room for it but not for a title; the unit goes below the name, to save width
    above = label.replace(" [", "\n[")
    above = above.replace(" = ", " =\n") if max(map(len, above.split("\n"))) > WORDY else above
    # in points, because a tick at the upper end is half as high as its digits on any bar
    place = offset_copy(bar.ax.transAxes, fig=bar.ax.get_figure(root=True), y=CLEARANCE, units="points")
    bar.ax.text(0.0, 1.0, above, transform=place, ha="left", va="bottom", fontsize=9, gid="label")
    return bar


def bands(ax: Axes, x: np.ndarray, mask: np.ndarray, label: str) -> list[Artist]:
    """Draw hatched bands over the runs of masked nodes, half a cell beyond each end; the first band has the label."""
    # zeros at both ends, so that every run has a start (even entries) and an end (odd entries)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    cells = np.diff(x) / 2 if len(x) > 1 else np.array([0.5])  # half of each cell, because an axis may be stretched
    borders = np.concatenate([[x[0] - cells[0]], x[:-1] + cells[: len(x) - 1], [x[-1] + cells[-1]]])
    runs = zip(edges[::2], edges[1::2], strict=True)
    style: dict[str, Any] = {"facecolor": "white", "edgecolor": STROKE, "hatch": HATCH, "linewidth": 1.0, "zorder": 0}
    return [ax.axvspan(borders[a], borders[b], label=None if k else label, **style) for k, (a, b) in enumerate(runs)]


def frame(ax: Axes, section: Section, label: str = "") -> None:
    """Set the limits, labels and ticks, and the caption of the cut."""
    # up to the outermost nodes, because the cells of a mesh extend half a cell beyond them
    ax.set_xlim(*section.coordinates[0][[0, -1]])
    if len(section.axes) == 2:
        ax.set_ylim(*section.coordinates[1][[0, -1]])
    label_axes(ax, *section.labels if len(section.axes) == 2 else (section.labels[0], label))
    scale_axes(ax, section.grid, section.axes)
    if section.caption:
        ax.set_title(section.caption, loc="right", fontsize=9)
