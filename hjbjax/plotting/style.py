"""The basis of every plot: the returned ``Picture``, its axes, one theme, labels and the legend.

Only functions import matplotlib, and they import pyplot only if no axes are given.
"""

from __future__ import annotations

import functools
import inspect
import io
import os
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, cast

import numpy as np

from hjbjax.problem.pytree import front_door
from hjbjax.problem.words import shown
from hjbjax.solution.files import Path, write_whole
from hjbjax.solution.placement import path_of

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend

GREY = "#c9c9c9"
COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#000000",
)  # Okabe and Ito: distinguishable with colour blindness
NARROW, WIDE, SOLID = (5.4, 4.2), (5.4, 3.2), (5.4, 4.8)  # inches, for planes, for lines over time, for surfaces
LINE, HANDLE = 62, 6  # characters of a line of a legend, and those that a mark and its margins take
DPI = 200  # default resolution of saved pictures
STROKES = ("-", "--", "-.", ":")  # the colours of two lines may be one grey in print
# for an argument name, or function.argument: the attributes that the argument must have, alternatives separated by
# "|", and a description of it
DRAWN: dict[str, tuple[tuple[str, ...], str]] = {
    "solution": (("grid", "value"), "the Solution of solve or march"),
    "path": (("times", "states"), "the Path of simulate"),
    "estimates.path": (("times", "estimates"), "the OutputPath of simulate_output"),
    "extremal": (("times", "costates"), "the extremal of pontryagin"),
    "grid": (("shape", "periodic"), "a Grid, such as solution.grid"),
    "residuals.solution": (("residuals",), "the Solution of solve"),
    "enclosure": (
        ("grid", "lower|inner", "upper|outer"),
        "the Enclosure of enclose, or the TubeEnclosure of enclose_tube",
    ),
    "convergence.study": (("errors", "fitted"), "the result of convergence_study"),
    "perturbation.study": (("nominal", "noise"), "the result of perturbation_study"),
}
PAIRS = ("convergence", "enclosure")  # functions that accept two axes

P = ParamSpec("P")
T = TypeVar("T")


def drawing(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function that draws, so that it refuses arguments of the wrong kind.

    Raises:
      TypeError: with the argument, the expected kind, and how to get it.
    """
    names = list(inspect.signature(function).parameters)
    checked = front_door(function)

    @functools.wraps(function)
    def drawn(*arguments: P.args, **options: P.kwargs) -> T:
        for number, (name, thing) in enumerate((*zip(names, arguments, strict=False), *options.items())):
            attributes, words = DRAWN.get(f"{function.__name__}.{name}") or DRAWN.get(name, ((), ""))
            # optional arguments may be None
            known = all(any(hasattr(thing, name) for name in each.split("|")) for each in attributes)
            if not known and (thing is not None or number == 0):
                raise TypeError(f"{function.__name__}: got {name} = {shown(thing)}, wanted {words}")
        ax = options.get("ax")
        if hasattr(ax, "add_subplot"):
            raise TypeError(f"{function.__name__}: got a figure as ax, wanted axes on it: ax=figure.add_subplot()")
        if isinstance(ax, np.ndarray) and function.__name__ not in PAIRS:
            raise TypeError(f"{function.__name__}: got {ax.size} axes as ax, wanted one of them, as in ax=ax[0]")
        return checked(*arguments, **options)

    return drawn


class Picture(list):
    """The artists that a function drew, the main one first, and their figure.

    Args:
      artists: in the order of drawing.
      ax: the axes drawn on, or the first of several axes.
    """

    def __init__(self, artists: Iterable[Artist], ax: Axes):
        super().__init__(artists)
        self.ax = ax

    @property
    def figure(self) -> Figure:
        """The whole figure, even if the axes are on a subfigure."""
        return cast("Figure", self.ax.get_figure(root=True))

    def save(self, path: Path, **options: Any) -> None:
        """Write the figure to ``path``, whole or not at all. An older file is replaced.

        Args:
          path: the file; its suffix selects the format, as in "value.png".
          options: of matplotlib's ``savefig``.

        Raises:
          FileError: the file cannot be written; an older file is left as it is.
          ValueError: matplotlib does not know the format, or cannot write it as one file.
        """
        save_figure(self.figure, path, **options)

    def __repr__(self) -> str:
        return f"Picture of {len(self)} artists"


def save_figure(figure: Figure, path: Path, *, format: str | None = None, **options: Any) -> None:
    """Write a figure to a file, whole or not at all; see ``Picture.save``."""
    name = path_of(path, "written")
    kind = format or os.path.splitext(name)[1][1:]
    if not kind:
        kind = figure.canvas.get_default_filetype()
        name = f"{name.rstrip('.')}.{kind}"
    picture = io.BytesIO()
    figure.savefig(picture, format=kind, **{"dpi": DPI, **options})
    write_whole(name, lambda stream: stream.write(picture.getbuffer()), force=True)


def axes_of(ax: Axes | None, *, wide: bool = False) -> Axes:
    """The given axes, or the axes of a new pyplot figure; pyplot's current figure is used if it is empty.

    Raises:
      ValueError: the given axes are three-dimensional.
    """
    if ax is None:
        return styled(new_figure(WIDE if wide else NARROW).add_subplot())
    if ax.name == "3d":
        raise ValueError("got three-dimensional axes for a flat picture; leave out ax, which makes a new figure")
    return ax


def solid_axes(ax: Axes | None) -> Any:
    """The given three-dimensional axes, or those of a new figure.

    Raises:
      ValueError: the given axes are flat.
    """
    if ax is None:
        return new_figure(SOLID).add_subplot(projection="3d")
    if ax.name != "3d":
        raise ValueError(
            "zero_level_set: got flat axes for three free states; pass axes of projection='3d', or cut one state with "
            "fixed={...}"
        )
    return ax


def new_figure(size: tuple[float, float]) -> Figure:
    """Pyplot's current figure if it is empty, otherwise a new one."""
    from matplotlib import pyplot

    if pyplot.get_fignums() and not pyplot.gcf().axes and not pyplot.gcf().subfigs:
        return pyplot.gcf()
    return pyplot.figure(figsize=size, layout="constrained")


def pair_of_axes(*, sharey: bool = True) -> list[Axes]:
    """Two axes side by side on a new figure; they have a common vertical scale if ``sharey``."""
    return [styled(ax) for ax in new_figure((8.0, 3.6)).subplots(1, 2, sharey=sharey)]


def logarithmic(ax: Axes, places: np.ndarray | None = None) -> None:
    """Set two logarithmic scales with few ticks, so that none overlap; the ticks of x are at ``places``."""
    from matplotlib.ticker import NullFormatter

    ax.set(xscale="log", yscale="log")
    for axis, given in ((ax.xaxis, places), (ax.yaxis, None)):
        # matplotlib's ticks are decades, so a study over one octave would have at most one
        ticks: Sequence[float] | np.ndarray = few(*axis.get_view_interval()) if given is None else given
        axis.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks])
        axis.set_minor_formatter(NullFormatter())


def few(lo: float, hi: float) -> list[float]:
    """Three to seven round numbers between the ends of a logarithmic scale, or the ends and their middle."""
    powers = 10.0 ** np.arange(np.floor(np.log10(lo)), np.ceil(np.log10(hi)) + 1)
    for digits in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0), range(1, 10)):
        found = [tick for tick in np.outer(powers, digits).ravel().tolist() if lo <= tick <= hi]
        if len(found) >= 3:
            return found[:: -(-len(found) // 7)]  # rounded up, so that at most seven remain
    return [lo, float(np.sqrt(lo * hi)), hi]


def styled(ax: Axes) -> Axes:
    """Apply the theme to ``ax``: no upper and right spine, thin ticks, small text."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_linewidth(0.8)
    ax.tick_params(width=0.8, length=3, labelsize=9)
    ax.tick_params(axis="x", pad=5.5)  # otherwise the first tick labels of both axes nearly touch
    ax.xaxis.label.set_fontsize(10)
    ax.yaxis.label.set_fontsize(10)
    return ax


def line_look(number: int) -> dict[str, Any]:
    """The colour and the stroke of one of several lines; neighbouring lines differ in both."""
    return {"color": COLOURS[number % len(COLOURS)], "linestyle": STROKES[number % len(STROKES)]}


def label_axes(ax: Axes, x: str, y: str) -> None:
    """Label the axes unless they have labels, so that a path drawn on top of a value keeps the value's labels."""
    if not ax.get_xlabel():
        ax.set_xlabel(x)
    if not ax.get_ylabel():
        ax.set_ylabel(y)


def legend(ax: Axes) -> Legend:
    """Draw the legend of all labelled artists above the axes, where it hides nothing.

    If there is a caption, the legend is above it, because both would share a line.
    """
    height = 1.07 if ax.get_title(loc="right") else 1.0
    style: dict[str, Any] = {"fontsize": 8, "edgecolor": "none", "handlelength": 1.6, "columnspacing": 1.2}
    style |= {"ncols": _columns(ax.get_legend_handles_labels()[1])}
    return ax.legend(loc="lower left", bbox_to_anchor=(0.0, height), frameon=False, borderaxespad=0.2, **style)


def _columns(labels: Sequence[str]) -> int:
    """The largest number of columns, at most four, that fits into a line of a legend."""
    for columns in (4, 3, 2):
        # matplotlib fills one column after the other, and the first ones may have one more
        parts = np.array_split([len(label) + HANDLE for label in labels], min(columns, max(len(labels), 1)))
        if sum(int(part.max(initial=0)) for part in parts) <= LINE:
            return columns
    return 1
