"""One section drawn: a line over one axis, colours over two, with outlines of sets and hatches where nothing is known.

Values are shaded smoothly between the nodes, and so are controls, unless they jump: those are drawn as cells. Sets
are outlined where their function is zero, on a raster finer than the nodes, so that a disc is round on any grid.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.plotting.scales import number_text, scale_axes
from hjbjax.plotting.slices import Region, Section
from hjbjax.plotting.style import COLOURS, label_axes, legend

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

FLAT = 1e-4  # a field that varies by less than this share of itself is drawn level: what a solve leaves of a constant
HATCH, STROKE = "////", "#909090"
EXTREME = 1e-6  # of the range: how near to an end of it a control counts as being there
JUMPING = 0.9  # of the nodes at either end of the range or at rest make a feedback that jumps


@dataclasses.dataclass(frozen=True)
class Look:
    """How a section is drawn.

    Args:
      label: of the numbers.
      hidden: what the legend says of nodes without a number; empty where they are not to be marked over one axis.
      colorbar: whether a colour scale is drawn.
      diverging: whether zero is the middle of the colours, where both signs occur.
      cells: whether nodes are drawn as cells and not shaded smoothly.
      span: a length of the numbers' scale, of which a variation below ``FLAT`` is none; 0 where none is known.
    """

    label: str
    hidden: str
    colorbar: bool = True
    diverging: bool = False
    cells: bool = False
    span: float = 0.0


def draw(ax: Axes, section: Section, look: Look, regions: tuple[Region, ...] = ()) -> list[Artist]:
    """One section as a line or as a colour mesh, with what is hidden hatched, and the outlines of the regions."""
    mask = np.ma.getmaskarray(section.values)
    if len(section.axes) == 1:
        artists: list[Artist] = [*ax.plot(section.coordinates[0], section.values, color=COLOURS[0], linewidth=1.6)]
        artists += bands(ax, section.coordinates[0], mask, look.hidden) if look.hidden else []
        known = section.values.compressed()
        if known.size and is_level(known, look.span):  # or the axis would show its rounding
            ax.set_ylim(*around(float(np.mean(known)), look.span))
        frame(ax, section, look.label)
    else:
        frame(ax, section)
        artists = _mesh(ax, section, look, regions)
    if (look.hidden and mask.any()) or any(region.visible for region in regions):
        legend(ax)
    return artists


def is_level(known: np.ndarray, span: float = 0.0) -> bool:
    """True for numbers that vary by rounding alone, against themselves or against the span given."""
    return bool(np.ptp(known) < FLAT * max(abs(float(np.mean(known))), span))


def around(middle: float, span: float = 0.0) -> tuple[float, float]:
    """Limits of a scale on which a constant is drawn: half of it, or of the span, on either side."""
    room = 0.5 * max(abs(middle), 0.0 if abs(middle) > FLAT * span else span)
    return middle - room, middle + room


def jumps(known: np.ndarray) -> bool:
    """True for a feedback that jumps: nine of ten of its entries are at an end of their range, or zero."""
    if known.size == 0 or is_level(known):
        return False
    lo, hi, near = known.min(), known.max(), EXTREME * np.ptp(known)
    settled = (known <= lo + near) | (known >= hi - near) | (np.abs(known) <= near)
    return bool(np.mean(settled) > JUMPING)


def _mesh(ax: Axes, section: Section, look: Look, regions: tuple[Region, ...]) -> list[Artist]:
    """A section over two axes: the mesh first, then hatches and outlines."""
    values, mask = section.values, np.ma.getmaskarray(section.values)
    known = values.compressed()
    lo, hi, colours = _colours(known, look)
    # rasterized: a mesh of 200 x 200 as vectors would make a PDF of 40 000 little rectangles
    style: dict[str, Any] = {"cmap": colours, "vmin": lo, "vmax": hi, "rasterized": True}
    shading: Any = "nearest" if look.cells else "gouraud"
    # (M₁, M₂) is transposed: matplotlib's rows go upwards, and our first axis to the right
    mesh = ax.pcolormesh(*section.coordinates, continued(values).T, shading=shading, **style)
    # nodes within an outlined set are covered by it, and their cells reach beyond it
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
    """The limits of the colours and their map: diverging ones for both signs, half of them for one."""
    from matplotlib import colormaps
    from matplotlib.colors import LinearSegmentedColormap

    if known.size == 0:
        return 0.0, 1.0, colormaps["viridis"]
    lo, hi = float(known.min()), float(known.max())
    level = is_level(known, look.span)
    largest = max(abs(lo), abs(hi)) or look.span or 1.0
    both = colormaps["coolwarm"]
    if not look.diverging:
        if level:
            lo, hi = around((lo + hi) / 2, look.span)
        return lo, hi if hi > lo else lo + 1.0, colormaps["viridis"]
    if lo < -EXTREME * largest and hi > EXTREME * largest:
        return -largest, largest, both
    # one sign: half of the scale would stand for numbers that do not occur
    if hi > EXTREME * largest:
        return 0.0, largest, LinearSegmentedColormap.from_list("warm", both(np.linspace(0.5, 1.0, 128)))
    if lo < -EXTREME * largest:
        return -largest, 0.0, LinearSegmentedColormap.from_list("cool", both(np.linspace(0.0, 0.5, 128)))
    return -largest, largest, both


def continued(values: np.ma.MaskedArray) -> np.ndarray:
    """The numbers, and at masked nodes what is held there or else the nearest known one, so that shades have no gap."""
    mask, data = np.ma.getmaskarray(values), np.asarray(values.data, float)
    lost = ~np.isfinite(data)
    if mask.all() or not lost.any():
        return np.zeros_like(data) if lost.any() else data
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(lost, return_distances=False, return_indices=True)
    return data[tuple(nearest)]


def hatched(ax: Axes, coordinates: tuple[np.ndarray, ...], level: np.ndarray, label: str) -> list[Artist]:
    """White and hatched where ``level``, (M₁, M₂), is positive, with a patch for the legend."""
    from matplotlib.patches import Rectangle

    if not level.max() > 0:
        return []
    style: dict[str, Any] = {"levels": [0.0, float(level.max()) + 1.0], "colors": ["white"], "hatches": [HATCH]}
    area = ax.contourf(*coordinates, level.T, zorder=2, **style)
    area.set(edgecolor=STROKE, linewidth=0.0)
    # contours take no label: an empty rectangle stands for them in the legend, once
    if label not in ax.get_legend_handles_labels()[1]:
        corner = (float(coordinates[0][0]), float(coordinates[1][0]))
        ax.add_patch(
            Rectangle(corner, 0, 0, facecolor="white", edgecolor=STROKE, hatch=HATCH, linewidth=0.6, label=label)
        )
    return [area]


def outlined(ax: Axes, region: Region, *, inside: bool = True) -> list[Artist]:
    """A set: its outline, and hatches ``inside`` of it; nothing where none of it is in the picture."""
    if not region.visible:
        return []
    artists: list[Artist] = []
    if inside:
        artists += hatched(ax, region.coordinates, -region.level, region.label)
    elif region.label not in ax.get_legend_handles_labels()[1]:
        ax.plot([], [], color="black", linewidth=1.0, label=region.label)
    if region.level.max() > 0:  # the whole picture has no outline in it, and matplotlib would warn
        artists.append(
            ax.contour(*region.coordinates, region.level.T, levels=[0.0], colors="black", linewidths=1.0, zorder=2.5)
        )
    return artists


def add_colorbar(ax: Axes, mesh: Any, label: str) -> Any:
    """The colour scale beside a mesh, with its label upright above it."""
    from matplotlib.ticker import FuncFormatter

    bar = ax.figure.colorbar(mesh, ax=ax, fraction=0.06, pad=0.03, format=FuncFormatter(number_text))
    bar.outline.set_visible(False)
    bar.ax.tick_params(width=0.8, length=3, labelsize=9)
    # a text, as the layout leaves room for it, but none for the width of a title; the unit below the name is narrower
    above = label.replace(" [", "\n[")
    bar.ax.text(0.0, 1.02, above, transform=bar.ax.transAxes, ha="left", va="bottom", fontsize=9, gid="label")
    return bar


def bands(ax: Axes, x: np.ndarray, mask: np.ndarray, label: str) -> list[Artist]:
    """Hatched bands over the runs of masked nodes, half a cell beyond each end; the first one is labelled."""
    # a zero at either end, so that every run has a beginning (even entries) and an end (odd ones)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    cells = np.diff(x) / 2 if len(x) > 1 else np.array([0.5])  # half of each; an axis may be stretched
    borders = np.concatenate([[x[0] - cells[0]], x[:-1] + cells[: len(x) - 1], [x[-1] + cells[-1]]])
    runs = zip(edges[::2], edges[1::2], strict=True)
    style: dict[str, Any] = {"facecolor": "white", "edgecolor": STROKE, "hatch": HATCH, "linewidth": 0, "zorder": 0}
    return [ax.axvspan(borders[a], borders[b], label=None if k else label, **style) for k, (a, b) in enumerate(runs)]


def frame(ax: Axes, section: Section, label: str = "") -> None:
    """Limits of the box, labels, ticks, and the caption of the cut."""
    # to the outermost nodes: cells of a mesh reach half a cell beyond them
    ax.set_xlim(*section.coordinates[0][[0, -1]])
    if len(section.axes) == 2:
        ax.set_ylim(*section.coordinates[1][[0, -1]])
    label_axes(ax, *section.labels if len(section.axes) == 2 else (section.labels[0], label))
    scale_axes(ax, section.grid, section.axes)
    if section.caption:
        ax.set_title(section.caption, loc="right", fontsize=9)
