"""What every picture stands on: axes that no global registry knows, one theme, and a section drawn on them.

Nothing here knows what the numbers mean. Only functions import matplotlib, and none imports pyplot.
"""

from typing import Any

import numpy as np

from hjbjax.plotting.slices import Section
from hjbjax.problem.grid import Grid

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


def axes_of(ax: Any, *, wide: bool = False) -> Any:
    """The axes given, or those of a new figure that no global registry knows."""
    if ax is not None:
        return ax
    from matplotlib.figure import Figure

    return styled(Figure(figsize=(5.4, 3.2) if wide else (5.4, 4.2), layout="constrained").add_subplot())


def pair_of_axes() -> list[Any]:
    """Two axes side by side on a new figure, with one vertical scale."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    return [styled(ax) for ax in figure.subplots(1, 2, sharey=True)]


def logarithmic(ax: Any, places: Any = None) -> None:
    """Two logarithmic scales around what is drawn, with few ticks so that none overlap; those of x at ``places``."""
    from matplotlib.ticker import NullFormatter

    ax.set(xscale="log", yscale="log")
    for axis, ticks in ((ax.xaxis, places), (ax.yaxis, None)):
        ticks = few(*axis.get_view_interval()) if ticks is None else ticks
        axis.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks])
        axis.set_minor_formatter(NullFormatter())


def few(lo: float, hi: float) -> list[float]:
    """Two to seven round numbers between the ends of a logarithmic scale; the ends where there are not two."""
    powers = 10.0 ** np.arange(np.floor(np.log10(lo)), np.ceil(np.log10(hi)) + 1)
    for digits in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)):
        found = [tick for tick in np.outer(powers, digits).ravel().tolist() if lo <= tick <= hi]
        if len(found) >= 2:
            return found[:: -(-len(found) // 7)]
    return [lo, hi]


def styled(ax: Any) -> Any:
    """The theme of the figures made here, on ``ax``: no upper and right frame, thin ticks, a paper's text sizes."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_linewidth(0.8)
    ax.tick_params(width=0.8, length=3, labelsize=9)
    ax.xaxis.label.set_size(10)
    ax.yaxis.label.set_size(10)
    return ax


def draw(
    ax: Any, section: Section, grid: Grid, label: str, hidden: str, *, colorbar: bool, diverging: bool = False
) -> list[Any]:
    """One section as a line or as a colour mesh, with what is hidden in grey."""
    from matplotlib import colormaps

    known, mask = section.values.compressed(), np.ma.getmaskarray(section.values)
    if len(section.axes) == 1:
        artists = ax.plot(section.coordinates[0], section.values, color=COLOURS[0], linewidth=1.6)
        artists += bands(ax, section.coordinates[0], mask, hidden)
        middle = np.mean(known) if known.size else 0.0
        if known.size and np.ptp(known) < FLAT * abs(middle):  # or the axis would show its rounding
            ax.set_ylim(*sorted((0.5 * middle, 1.5 * middle)))
    else:
        largest = np.abs(known).max() if known.any() else 1.0
        limits = (-largest, largest) if diverging else (known.min(), known.max()) if known.size else (0.0, 1.0)
        colours = colormaps["coolwarm" if diverging else "viridis"].with_extremes(bad=GREY)
        style = {"cmap": colours, "vmin": limits[0], "vmax": limits[1], "rasterized": True}
        artists = [ax.pcolormesh(*section.coordinates, section.values.T, shading="nearest", **style)]
        if mask.any():
            artists += ax.plot([], [], "s", color=GREY, markersize=8, label=hidden)
        if colorbar:
            bar = ax.figure.colorbar(artists[0], ax=ax, label=label, fraction=0.06, pad=0.03)
            bar.outline.set_visible(False)
            bar.ax.tick_params(width=0.8, length=3, labelsize=9)
    frame(ax, section, grid, label)
    if mask.any():
        legend(ax)
    return artists


def bands(ax: Any, x: np.ndarray, mask: np.ndarray, label: str) -> list[Any]:
    """Grey bands over the runs of masked nodes, half a cell beyond each end; the first one is labelled."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    half = (x[1] - x[0]) / 2 if len(x) > 1 else 0.5
    runs = zip(edges[::2], edges[1::2], strict=True)
    return [
        ax.axvspan(x[a] - half, x[b - 1] + half, color=GREY, linewidth=0, zorder=0, label=None if k else label)
        for k, (a, b) in enumerate(runs)
    ]


def frame(ax: Any, section: Section, grid: Grid, label: str = "") -> None:
    """Limits of the box, names and the caption of the cut."""
    ax.set_xlim(section.coordinates[0][[0, -1]])
    if len(section.axes) == 2:
        ax.set_ylim(section.coordinates[1][[0, -1]])
    label_axes(ax, grid.names[section.axes[0]], grid.names[section.axes[1]] if len(section.axes) == 2 else label)
    if section.caption:
        ax.set_title(section.caption, loc="right", fontsize=9)


def label_axes(ax: Any, x: str, y: str) -> None:
    """Labels, where the axes have none yet: a path on top of a value keeps the value's."""
    if not ax.get_xlabel():
        ax.set_xlabel(x)
    if not ax.get_ylabel():
        ax.set_ylabel(y)


def legend(ax: Any) -> Any:
    """The legend, with all that has a label so far: in a corner of a mesh, above lines, which it would hide.

    The search for a free corner is left out: it is slow on large pictures.
    """
    from matplotlib.collections import QuadMesh

    style: dict[str, Any] = {"fontsize": 8, "edgecolor": "none", "handlelength": 1.4}
    if any(isinstance(artist, QuadMesh) for artist in ax.collections):
        return ax.legend(loc="upper right", framealpha=0.85, **style)
    return ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=6, frameon=False, borderaxespad=0.2, **style)
