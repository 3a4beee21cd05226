"""Ticks and scales: multiples of π for angles, numbers without an offset, equal scales for positions on both axes."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import Labels, with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PER_TIME = re.compile(r"/ ?(s|min|h|hour|day|week|month|year)\b")  # a rate, but not m/s²
LENGTHS = ("m", "km", "cm", "mm", "µm", "um", "nm", "ft", "in", "mi", "nmi", "nautical miles", "au", "AU")
ANGLES = ("rad", "radian", "radians")
ROUND = (1, 2, 5, 10)  # leading digits of tick spacings; with 2.5 labels such as −0.75 and −0.5 touch
NAMELESS = Labels()
FEWEST, MOST = 3, 7  # ticks of an axis; an angle with fewer multiples of π has decimals
STEPS = [Fraction(1, 4), Fraction(1, 2), *(Fraction(2**k) for k in range(12))]  # tick spacings, in multiples of π


def number_text(value: float, _position: int | None = None) -> str:
    """The label of a tick: no offset, no trailing zeros, a true minus, and 2·10⁶ for a large number.

    Example:
      >>> number_text(0.1 + 0.2), number_text(-2.0), number_text(3e-7), number_text(-0.0)
      ('0.3', '−2', '3·10⁻⁷', '0')
    """
    digits, _, power = f"{value + 0.0:.9g}".partition("e")  # −0.0 + 0.0 is 0.0
    if power:
        raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        digits = f"{digits}·10{raised}"
    return digits.replace("-", "−")


def angle_text(value: float, _position: int | None = None) -> str:
    """The label of a tick at a multiple of π.

    Example:
      >>> [angle_text(k * math.pi / 4) for k in (-4, -1, 0, 2, 3, 8)]
      ['−π', '−π/4', '0', 'π/2', '3π/4', '2π']
    """
    share = Fraction(value / math.pi).limit_denominator(8)
    if share == 0:
        return "0"
    top = "" if abs(share.numerator) == 1 else str(abs(share.numerator))
    bottom = "" if share.denominator == 1 else f"/{share.denominator}"
    return ("−" if share < 0 else "") + f"{top}π{bottom}"


def is_angle(grid: Grid, axis: int) -> bool:
    """True for an axis in radians, by its unit, or if it has no unit and the period 2π."""
    unit = grid.units[axis]
    if unit or not grid.periodic[axis]:
        return unit in ANGLES
    # to 1e-6, because periods may come from float32
    return math.isclose(float(grid.hi[axis]) - float(grid.lo[axis]), 2 * math.pi, rel_tol=1e-6)


def place_text(grid: Grid, axis: int, place: float) -> str:
    """A coordinate with its unit, for a caption; simple fractions of π are written as such.

    Example:
      >>> place_text(Grid([0.0], [math.tau], (4,), (True,), units=("rad",)), 0, math.pi / 2)
      'π/2 rad'
    """
    unit = f" {grid.units[axis]}" if grid.units[axis] else ""
    eighths = 8 * place / math.pi
    simple = is_angle(grid, axis) and math.isclose(eighths, round(eighths), abs_tol=1e-6)
    return (angle_text(place) if simple else f"{place:.4g}") + unit


def time_label(grid: Grid | None, labels: Labels = NAMELESS) -> str:
    """The label of a time axis, with the unit of the problem, or of a state or a control such as m/s or 1/year.

    Example:
      >>> time_label(Grid([0.0], [1.0], (4,), units=("m/s",))), time_label(Grid([0.0], [1.0], (4,)))
      ('t [s]', 't')
      >>> time_label(None, Labels(("consumption",), ("1/year",))), time_label(None, Labels(time_unit="h"))
      ('t [year]', 't [h]')
    """
    if labels.time_unit:
        return with_unit("t", labels.time_unit)
    for unit in (*(() if grid is None else grid.units), *labels.control_units):
        found = PER_TIME.search(unit)
        if found:
            return f"t [{found[1]}]"
    return "t"


def are_positions(grid: Grid, axes: Sequence[int]) -> bool:
    """True for two axes with the same unit of length, on which a circle must look round."""
    units = {grid.units[axis] for axis in axes}
    return len(axes) == 2 and len(units) == 1 and units <= set(LENGTHS)


def box_sides(grid: Grid, axes: Sequence[int]) -> tuple[float, ...]:
    """The side lengths of a box for three axes; axes with the same unit of length have the same scale.

    Example:
      >>> box_sides(Grid([0.0] * 3, [4.0, 2.0, 9.0], (2, 2, 2), units=("m", "m", "rad")), (0, 1, 2))
      (1.0, 0.5, 0.8)
    """
    spans = [float(grid.hi[axis] - grid.lo[axis]) for axis in axes]
    units = [grid.units[axis] for axis in axes]
    alike = [unit in LENGTHS and units.count(unit) > 1 for unit in units]
    longest = max((span for span, one in zip(spans, alike, strict=True) if one), default=1.0)
    return tuple(
        span / longest if one else usual for span, one, usual in zip(spans, alike, (1.0, 1.0, 0.8), strict=True)
    )


def set_ticks(axis: Any, angle: bool, **options: Any) -> None:
    """Format a matplotlib axis with numbers without an offset, or multiples of π if it is an angle and long enough.

    The options are those of matplotlib's ``MaxNLocator``, for numbers.
    """
    from matplotlib.ticker import FuncFormatter, MaxNLocator, MultipleLocator

    usual: dict[str, Any] = {"nbins": "auto", "steps": ROUND, "min_n_ticks": FEWEST}
    axis.set_major_locator(MaxNLocator(**(usual | options)))
    axis.set_major_formatter(FuncFormatter(number_text))
    room = min(max(axis.get_tick_space(), FEWEST), MOST)  # ticks that fit on the axis
    lo, hi = axis.get_view_interval()
    step = angle_step(lo, hi, room) if angle else None
    if step is not None:
        axis.set_major_locator(MultipleLocator(step))
        axis.set_major_formatter(FuncFormatter(angle_text))


def angle_step(lo: float, hi: float, most: int = MOST) -> float | None:
    """The spacing of up to ``most`` ticks of an angle, a multiple of π; ``None`` if there would be too few or too many.

    Example:
      >>> angle_step(-math.pi, math.pi) == math.pi / 2
      True
    """
    turns = abs(hi - lo) / math.pi
    fitting = [step for step in STEPS if FEWEST <= math.floor(turns / step + 1e-9) + 1 <= most]
    return float(fitting[0]) * math.pi if fitting else None


def scale_axes(ax: Axes, grid: Grid, axes: Sequence[int]) -> None:
    """Set the ticks for the axes of a grid, and equal scales if both are positions."""
    for axis, number in zip((ax.xaxis, ax.yaxis), axes, strict=False):
        set_ticks(axis, is_angle(grid, number))
    if len(axes) == 1:
        set_ticks(ax.yaxis, False)
    if are_positions(grid, axes):
        ax.set_aspect("equal", adjustable="box")
