"""What every picture stands on: the picture that is returned, its axes, one theme, labels and the legend.

Nothing here knows what the numbers mean. Only functions import matplotlib, and pyplot only where no axes are given.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, cast

import numpy as np

from hjbjax.problem.arguments import shown
from hjbjax.problem.pytree import front_door

if TYPE_CHECKING:
    import os

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
)  # Okabe and Ito: safe for all eyes
NARROW, WIDE, SOLID = (5.4, 4.2), (5.4, 3.2), (5.4, 4.8)  # inches: of planes, of lines over time, of surfaces
DPI = 200  # of saved pictures, unless given
# what is drawn, by the name of the argument, maybe of one function: the attributes that it must have, and what has them
DRAWN: dict[str, tuple[tuple[str, ...], str]] = {
    "solution": (("grid", "value"), "the Solution of solve or march"),
    "path": (("times", "states"), "the Path of simulate"),
    "estimates.path": (("times", "estimates"), "the OutputPath of simulate_output"),
    "extremal": (("times", "costates"), "the extremal of pontryagin"),
    "grid": (("shape", "periodic"), "a Grid, such as solution.grid"),
    "residuals.solution": (("residuals",), "the Solution of solve"),
    "convergence.study": (("errors", "fitted"), "the result of convergence_study"),
    "perturbation.study": (("nominal", "noise"), "the result of perturbation_study"),
}
PAIRS = ("convergence",)  # functions that draw on two axes, where these are given

P = ParamSpec("P")
T = TypeVar("T")


def drawing(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator of the functions that draw: what is no solution, no path or no axes is refused in their words.

    Raises:
      TypeError: with what was got, what was wanted, and how to come to it.
    """
    names = list(inspect.signature(function).parameters)
    checked = front_door(function)

    @functools.wraps(function)
    def drawn(*arguments: P.args, **options: P.kwargs) -> T:
        for number, (name, thing) in enumerate((*zip(names, arguments, strict=False), *options.items())):
            attributes, words = DRAWN.get(f"{function.__name__}.{name}") or DRAWN.get(name, ((), ""))
            # an argument that may be left out is None then
            if not all(hasattr(thing, attribute) for attribute in attributes) and (thing is not None or number == 0):
                raise TypeError(f"{function.__name__}: got {name} = {shown(thing)}, wanted {words}")
        ax = options.get("ax")
        if hasattr(ax, "add_subplot"):
            raise TypeError(f"{function.__name__}: got a figure as ax, wanted axes on it: ax=figure.add_subplot()")
        if isinstance(ax, np.ndarray) and function.__name__ not in PAIRS:
            raise TypeError(f"{function.__name__}: got {ax.size} axes as ax, wanted one of them, as in ax=ax[0]")
        return checked(*arguments, **options)

    return drawn


class Picture(list):
    """The artists that a function drew, the main one first, with the figure that they are on.

    Args:
      artists: in the order in which they were drawn.
      ax: the axes drawn on, the first of them where there are several.
    """

    def __init__(self, artists: Iterable[Artist], ax: Axes):
        super().__init__(artists)
        self.ax = ax

    @property
    def figure(self) -> Figure:
        """The whole figure, also where the axes are on a part of it."""
        return cast("Figure", self.ax.get_figure(root=True))

    def save(self, path: str | os.PathLike, **options: Any) -> None:
        """Write the figure to ``path``; the ending says the format, and ``options`` are those of ``savefig``."""
        self.figure.savefig(path, **{"dpi": DPI, **options})

    def __repr__(self) -> str:
        return f"Picture of {len(self)} artists"


def axes_of(ax: Axes | None, *, wide: bool = False) -> Axes:
    """The axes given, or pyplot's current ones; where there are none, a new figure of pyplot's."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    if not pyplot.get_fignums():
        pyplot.figure(figsize=WIDE if wide else NARROW, layout="constrained")
    return styled(pyplot.gca())


def solid_axes(ax: Axes | None) -> Any:
    """The three-dimensional axes given or pyplot's current ones; a new figure where the current ones are flat.

    Raises:
      ValueError: flat axes were given.
    """
    if ax is not None:
        if ax.name != "3d":
            raise ValueError(
                "zero_level_set: got flat axes for three free states; give axes of projection='3d', or cut one state "
                "by fixed={...}"
            )
        return ax
    from matplotlib import pyplot

    figure = pyplot.gcf() if pyplot.get_fignums() else pyplot.figure(figsize=SOLID, layout="constrained")
    if figure.axes and figure.gca().name == "3d":
        return figure.gca()
    if figure.axes:  # something flat was drawn there
        figure = pyplot.figure(figsize=SOLID, layout="constrained")
    return figure.add_subplot(projection="3d")


def new_figure(size: tuple[float, float]) -> Figure:
    """Pyplot's current figure as long as it is empty, else a new one."""
    from matplotlib import pyplot

    if pyplot.get_fignums() and not pyplot.gcf().axes and not pyplot.gcf().subfigs:
        return pyplot.gcf()
    return pyplot.figure(figsize=size, layout="constrained")


def pair_of_axes() -> list[Axes]:
    """Two axes side by side on a new figure, with one vertical scale."""
    return [styled(ax) for ax in new_figure((8.0, 3.6)).subplots(1, 2, sharey=True)]


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


def label_axes(ax: Axes, x: str, y: str) -> None:
    """Labels, where the axes have none yet: a path on top of a value keeps the value's."""
    if not ax.get_xlabel():
        ax.set_xlabel(x)
    if not ax.get_ylabel():
        ax.set_ylabel(y)


def legend(ax: Axes) -> Legend:
    """The legend, with all that has a label so far, above the axes, where it hides nothing.

    It stands above the caption where there is one: both would share a line.
    """
    height = 1.07 if ax.get_title(loc="right") else 1.0
    style: dict[str, Any] = {"fontsize": 8, "edgecolor": "none", "handlelength": 1.6, "columnspacing": 1.2}
    return ax.legend(loc="lower left", bbox_to_anchor=(0.0, height), ncols=4, frameon=False, borderaxespad=0.2, **style)
