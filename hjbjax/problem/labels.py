"""Names and units of states, controls, value and time for plots and tables, the side of a level set, cost or reward.

These texts do not enter a computation. They are static, so that they survive ``jit`` and ``vmap``.
"""

from collections.abc import Sequence
from typing import NamedTuple

SIDES = ("below", "above")
EXAMPLES = {"value_name": "V = 1 − e⁻ᵀ", "time_unit": "s"}
COST, REWARD = "cost", "reward"  # the words for what the control minimises or maximises


class Labels(NamedTuple):
    """The texts of a problem: names and units of its controls, and the inside of its level set.

    Args:
      controls: one name per control, or empty.
      control_units: one unit per control, or empty; an empty text for a control without a unit.
      inside: "below" if {V ≤ 0} is the set of interest, "above" if it is {V ≥ 0}.
      payoff: "cost" if the control minimises, "reward" if it maximises. The labels of a ``Solution`` say which of the
        two its value is.
      value: V in a formula, as in "V = 1 − e⁻ᵀ", or empty.
      time_unit: the unit of time, or empty.

    Example:
      >>> Labels(("torque",), ("N m",)).control(0, 1), Labels().control(1, 2)
      ('torque [N m]', 'u2')
      >>> Labels(payoff="reward").word("terminal_cost")
      'terminal_reward'
    """

    controls: tuple[str, ...] = ()
    control_units: tuple[str, ...] = ()
    inside: str = "below"
    payoff: str = COST
    value: str = ""
    time_unit: str = ""

    @property
    def long_name(self) -> str:
        """V in words, for files of other tools."""
        return "value function" if self.payoff == COST else f"value function, a {self.payoff}"

    @property
    def of_value(self) -> str:
        """The name of V on axes and colour bars."""
        return self.value or ("V" if self.payoff == COST else f"V, {self.payoff}")

    def word(self, text: str) -> str:
        """A name or a phrase about costs, in the words of the problem."""
        return text.replace(COST, self.payoff)

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


def checked(
    controls: object, units: object, inside: object, count: int | None, value: object = "", time_unit: object = ""
) -> Labels:
    """The labels of a problem with ``count`` controls, or with an unknown number, after checks."""
    if inside not in SIDES:
        raise ValueError(f"Problem.inside: got {inside!r}, wanted 'below' (the set is V ≤ 0) or 'above' (V ≥ 0)")
    for name, text in {"value_name": value, "time_unit": time_unit}.items():
        if not isinstance(text, str):
            raise TypeError(f"Problem.{name}: got {text!r}, wanted a text, as in {name}={EXAMPLES[name]!r}")
    names = words(controls, count, "Problem.control_names")
    units = words(units, count, "Problem.control_units")
    return Labels(names, units, str(inside), value=str(value), time_unit=str(time_unit))


def of_file(stored: Sequence) -> Labels:
    """The labels in the header of a file, after checks; older files have fewer of them."""
    names, units, inside, payoff, value, time_unit = (*stored, *Labels()[len(stored) :])[:6]
    if payoff not in (COST, REWARD) or len(stored) > 6:
        raise ValueError(f"labels: got {payoff!r:.60}, wanted {COST!r} or {REWARD!r}")
    return checked(names, units, inside, None, value, time_unit)._replace(payoff=str(payoff))
