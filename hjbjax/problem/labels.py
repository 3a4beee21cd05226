"""Names and units of states and controls for plots and printed tables, and the side of a level set.

These texts do not enter a computation. They are static, so that they survive ``jit`` and ``vmap``.
"""

from collections.abc import Sequence
from typing import NamedTuple

SIDES = ("below", "above")


class Labels(NamedTuple):
    """The texts of a problem: names and units of its controls, and the inside of its level set.

    Args:
      controls: one name per control, or empty.
      control_units: one unit per control, or empty; an empty text for a control without a unit.
      inside: "below" if {V ≤ 0} is the set of interest, "above" if it is {V ≥ 0}.

    Example:
      >>> Labels(("torque",), ("N m",)).control(0, 1), Labels().control(1, 2)
      ('torque [N m]', 'u2')
    """

    controls: tuple[str, ...] = ()
    control_units: tuple[str, ...] = ()
    inside: str = "below"

    def control(self, index: int, count: int) -> str:
        """The name and unit of one of ``count`` controls; u, or u1, u2, ... without a name."""
        name = self.controls[index] if index < len(self.controls) else "u" if count == 1 else f"u{index + 1}"
        return with_unit(name, self.control_units[index] if index < len(self.control_units) else "")


def with_unit(name: str, unit: str) -> str:
    """A name with its unit in brackets; only the name if there is no unit."""
    return f"{name} [{unit}]" if unit else name


def words(given: object, count: int | None, what: str) -> tuple[str, ...]:
    """Names or units as a tuple of ``count`` texts; empty if there are none."""
    # a single text would be read as a list of its letters
    if isinstance(given, str) or not isinstance(given, Sequence) or not all(isinstance(each, str) for each in given):
        raise TypeError(f"{what}: got {given!r}, wanted a tuple of texts, one for each, as in ('m', 'm/s')")
    if given and count is not None and len(given) != count:
        raise ValueError(f"{what}: got {tuple(given)!r}, {len(given)} texts for {count}; wanted one for each")
    return tuple(given)


def checked(controls: object, units: object, inside: object, count: int | None) -> Labels:
    """The labels of a problem with ``count`` controls, or with an unknown number, after checks."""
    if inside not in SIDES:
        raise ValueError(f"Problem.inside: got {inside!r}, wanted 'below' (the set is V ≤ 0) or 'above' (V ≥ 0)")
    names = words(controls, count, "Problem.control_names")
    return Labels(names, words(units, count, "Problem.control_units"), str(inside))
