"""What every picture stands on: axes that no global registry knows, one theme, and a section drawn on them.

Nothing here knows what the numbers mean. Only functions import matplotlib, and none imports pyplot.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.plotting.slices import Section

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.legend import Legend

GREY = "#c9c9c9"
FLAT = 1e-4  # a line that varies by less than this share of itself is drawn level: what a solve leaves of a constant
COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#000000",
)  # Okabe and Ito: safe for all eyes


def axes_of(ax: Axes | None, *, wide: bool = False) -> Axes:
    """The axes given, or those of a new figure that no global registry knows."""
    if ax is not None:
        return ax
    from matplotlib.figure import Figure  # pyplot would keep every figure alive until somebody closes it

    return styled(Figure(figsize=(5.4, 3.2) if wide else (5.4, 4.2), layout="constrained").add_subplot())


def pair_of_axes() -> list[Axes]:
    """Two axes side by side on a new figure, with one vertical scale."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    return [styled(ax) for ax in figure.subplots(1, 2, sharey=True)]


def logarithmic(ax: Axes, places: np.ndarray | None = None) -> None:
    """Two logarithmic scales around what is drawn, with few ticks so that none overlap; those of x at ``places``."""
    from matplotlib.ticker import NullFormatter

    ax.set(xscale="log", yscale="log")
    for axis, given in ((ax.xaxis, places), (ax.yaxis, None)):
        # matplotlib's own ticks are decades: a study over one octave would show one, or none
        ticks: Sequence[float] | np.ndarray = few(*axis.get_view_interval()) if given is None else given
        axis.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks])
        axis.set_minor_formatter(NullFormatter())


def few(lo: float, hi: float) -> list[float]:
    """Two to seven round numbers between the ends of a logarithmic scale; the ends where there are not two."""
    powers = 10.0 ** np.arange(np.floor(np.log10(lo)), np.ceil(np.log10(hi)) + 1)
    for digits in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)):
        found = [tick for tick in np.outer(powers, digits).ravel().tolist() if lo <= tick <= hi]
        if len(found) >= 2:
            return found[:: -(-len(found) // 7)]  # rounded up: every so many that seven are left at most
    return [lo, hi]


def styled(ax: Axes) -> Axes:
    """The theme of the figures made here, on ``ax``: no upper and right frame, thin ticks, a paper's text sizes."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_linewidth(0.8)
    ax.tick_params(width=0.8, length=3, labelsize=9)
    ax.xaxis.label.set_fontsize(10)
    ax.yaxis.label.set_fontsize(10)
    return ax


def draw(
    ax: Axes, section: Section, label: str, hidden: str, *, colorbar: bool, diverging: bool = False
) -> list[Artist]:
    """One section as a line or as a colour mesh, with what is hidden in grey."""
    from matplotlib import colormaps

    known, mask = section.values.compressed(), np.ma.getmaskarray(section.values)
    if len(section.axes) == 1:
        artists: list[Artist] = [*ax.plot(section.coordinates[0], section.values, color=COLOURS[0], linewidth=1.6)]
        artists += bands(ax, section.coordinates[0], mask, hidden)
        middle = np.mean(known) if known.size else 0.0
        if known.size and np.ptp(known) < FLAT * abs(middle):  # or the axis would show its rounding
            ax.set_ylim(*sorted((0.5 * middle, 1.5 * middle)))
    else:
        # zero is the middle of the diverging colours; known.any() is False without numbers and for zeros alone
        largest = np.abs(known).max() if known.any() else 1.0
        limits = (-largest, largest) if diverging else (known.min(), known.max()) if known.size else (0.0, 1.0)
        colours = colormaps["coolwarm" if diverging else "viridis"].with_extremes(bad=GREY)
        # rasterized: a mesh of 200 x 200 as vectors would make a PDF of 40 000 little rectangles
        style: dict[str, Any] = {"cmap": colours, "vmin": limits[0], "vmax": limits[1], "rasterized": True}
        # (M₁, M₂) is transposed: matplotlib's rows go upwards, and our first axis to the right
        mesh = ax.pcolormesh(*section.coordinates, section.values.T, shading="nearest", **style)
        artists = [mesh]
        if mask.any():  # an empty line, for the legend's sake
            artists += ax.plot([], [], "s", color=GREY, markersize=8, label=hidden)
        if colorbar:
            bar = ax.figure.colorbar(mesh, ax=ax, label=label, fraction=0.06, pad=0.03)
            bar.outline.set_visible(False)
            bar.ax.tick_params(width=0.8, length=3, labelsize=9)
    frame(ax, section, label)
    if mask.any():
        legend(ax)
    return artists


def bands(ax: Axes, x: np.ndarray, mask: np.ndarray, label: str) -> list[Artist]:
    """Grey bands over the runs of masked nodes, half a cell beyond each end; the first one is labelled."""
    # a zero at either end, so that every run has a beginning (even entries) and an end (odd ones)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    cells = np.diff(x) / 2 if len(x) > 1 else np.array([0.5])  # half of each; an axis may be stretched
    borders = np.concatenate([[x[0] - cells[0]], x[:-1] + cells[: len(x) - 1], [x[-1] + cells[-1]]])
    runs = zip(edges[::2], edges[1::2], strict=True)
    return [
        ax.axvspan(borders[a], borders[b], color=GREY, linewidth=0, zorder=0, label=None if k else label)
        for k, (a, b) in enumerate(runs)
    ]


def frame(ax: Axes, section: Section, label: str = "") -> None:
    """Limits of the box, names and the caption of the cut."""
    # to the outermost nodes: cells of a mesh reach half a cell beyond them
    ax.set_xlim(*section.coordinates[0][[0, -1]])
    if len(section.axes) == 2:
        ax.set_ylim(*section.coordinates[1][[0, -1]])
    label_axes(ax, *section.names if len(section.axes) == 2 else (section.names[0], label))
    if section.caption:
        ax.set_title(section.caption, loc="right", fontsize=9)


def label_axes(ax: Axes, x: str, y: str) -> None:
    """Labels, where the axes have none yet: a path on top of a value keeps the value's."""
    if not ax.get_xlabel():
        ax.set_xlabel(x)
    if not ax.get_ylabel():
        ax.set_ylabel(y)


def legend(ax: Axes) -> Legend:
    """The legend, with all that has a label so far: in a corner of a mesh, above lines, which it would hide.

    The search for a free corner is left out: it is slow on large pictures.
    """
    from matplotlib.collections import QuadMesh

    style: dict[str, Any] = {"fontsize": 8, "edgecolor": "none", "handlelength": 1.4}
    if any(isinstance(artist, QuadMesh) for artist in ax.collections):
        return ax.legend(loc="upper right", framealpha=0.85, **style)
    return ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=6, frameon=False, borderaxespad=0.2, **style)
