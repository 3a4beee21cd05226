"""Pictures of solutions with modes: one mode, which the caption names, or over one state all modes in one picture.

Over one state each mode has its own line, and its sets, such as a push region, have the colour of the line and a
name that includes the mode.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar, cast

from hjbjax.plotting.slices import Cuts
from hjbjax.plotting.style import Picture, axes_of, legend, line_look
from hjbjax.solution.modes import mode_number

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from hjbjax.solution.solution import Solution

T = TypeVar("T", bound="Callable[..., Picture]")
MODE = "mode"  # the name of the axis of modes
PALE = 0.4  # opacity of the pattern of a set


def in_fixed_mode(solution: Solution, fixed: Cuts | None) -> tuple[Solution, Cuts | None]:
    """The solution in the mode that ``fixed`` gives by name or number, and the other cuts.

    Raises:
      ValueError: ``fixed`` gives no mode.
    """
    if not solution.grid.modes:
        return solution, fixed
    cuts: dict[Any, Any] = dict(fixed or {})
    if MODE not in cuts:
        names = ", ".join(map(repr, solution.grid.modes))
        raise ValueError(
            f"a picture over two states shows one mode; choose one of {names}, as in "
            f"fixed={{'mode': {solution.grid.modes[0]!r}}}"
        )
    mode: Any = cuts.pop(MODE)
    return solution.in_mode(mode), cuts


def by_mode(draw: T) -> T:
    """Decorator of a picture of a solution: over one state it has one line per mode, over two states one mode."""

    @functools.wraps(draw)
    def drawn(solution: Any, *arguments: Any, **options: Any) -> Picture:
        fixed: Any = options.get("fixed")
        modes, cuts = solution.grid.modes, dict(fixed or {})
        if not modes:
            return draw(solution, *arguments, **options)
        if MODE in cuts or solution.grid.ndim - 1 - len(cuts) != 1:
            one, rest = in_fixed_mode(solution, fixed)
            drawn_mode = draw(one, *arguments, **(options | {"fixed": rest}))
            name_mode(drawn_mode.ax, modes[mode_number(solution.grid, cuts[MODE], "fixed")])
            return drawn_mode
        ax, artists = axes_of(options.get("ax")), []
        for number, name in enumerate(modes):
            picture: Any = draw(solution.in_mode(number), *arguments, **(options | {"ax": ax}))
            line, *sets = picture
            line.set(label=name, **line_look(number))
            for each in sets:
                _name_set(each, name, number)
            artists += list(picture)
        ax.relim()
        ax.autoscale(axis="y")
        return Picture([*artists, legend(ax)], ax)

    return cast(T, drawn)


def name_mode(ax: Axes, mode: str) -> None:
    """Write the mode of a picture in front of its caption, at the right end, since the legend is at the left one."""
    caption, words = ax.get_title("right"), f"{MODE} {mode}"
    if not caption.startswith(words):  # several pictures may share these axes
        ax.set_title(f"{words}, {caption}" if caption else words, loc="right", fontsize=9)


def _name_set(band: Artist, mode: str, number: int) -> None:
    """Give a set of one mode the colour of its line, and add the mode to its name, if it has one."""
    # without a face, because the sets of two modes may overlap; pale, because the line has the same colour
    band.set(facecolor="none", edgecolor=(line_look(number)["color"], PALE))
    label = str(band.get_label())
    if not label.startswith("_"):  # matplotlib's own labels, which are not in a legend
        band.set_label(f"{label}, {mode}")
