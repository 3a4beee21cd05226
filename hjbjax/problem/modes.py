"""Modes: the finitely many regimes of a system that switches, at random or by choice."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hjbjax.problem.pytree import as_partial, numbers, pytree_dataclass

Table = Any  # numbers of shape (k, k), or a function that returns them


@pytree_dataclass(static=("names",))
class Modes:
    """The modes of a system, and how it changes from one to another.

    With modes all functions of a problem take the number of the mode as their last argument, a Python integer from 0.
    So ``(0.1, 0.2)[mode]`` is a number of the mode, and every mode may have code of its own.

    In mode i the system changes to mode j at the rate λ_ij, and the controller may change to it at the cost c_ij:

        min{ min_u [ L_i + f_i·DV_i + Σ_j λ_ij (V_j − V_i) ] − β V_i,  min_j (V_j + c_ij) − V_i } = 0.

    Args:
      names: one name per mode, at least two.
      rates: λ, shape (k, k), per unit time, for k modes; or a function of (x, u), and d in a game, that returns them.
        The diagonal is ignored. ``None``: no random changes.
      switching_cost: c, shape (k, k), in cost units; or a function of x that returns it. Infinity forbids a change. The
        diagonal is ignored. A round trip must cost something. ``None``: the controller cannot change the mode. In a
        problem with rewards it is subtracted from them.

    Raises:
      ValueError: fewer than two names, equal names, or tables that are not admissible.

    Example:
      >>> Modes(("low", "high"), rates=[[0, 0.5], [0.4, 0]]).number("high")
      1
    """

    names: tuple[str, ...]
    rates: Table = None
    switching_cost: Table = None

    def __init__(self, names: Sequence[str], rates: Callable | Table = None, switching_cost: Callable | Table = None):
        if isinstance(names, str) or not all(isinstance(name, str) and name for name in names):
            raise ValueError(f"Modes: got names = {names!r}, wanted one text per mode, as in ('low', 'high')")
        names = tuple(names)
        if len(names) < 2 or len(set(names)) < len(names):
            raise ValueError(f"Modes: got names = {names!r}, wanted at least two different names")
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "rates", _table(rates, "Modes.rates", len(names)))
        object.__setattr__(
            self, "switching_cost", _table(switching_cost, "Modes.switching_cost", len(names), most=np.inf)
        )

    def number(self, mode: str | int) -> int:
        """The number of a mode, given by its name or by its number.

        Raises:
          ValueError: there is no such mode.
        """
        if isinstance(mode, (int, np.integer)) and not isinstance(mode, bool) and 0 <= mode < len(self.names):
            return int(mode)
        if isinstance(mode, str) and mode in self.names:
            return self.names.index(mode)
        raise ValueError(f"mode: got {mode!r}, wanted one of {self.names!r} or a number below {len(self.names)}")


def _table(table: Any, name: str, count: int, most: float = np.finfo(float).max) -> Any:
    """A table of k x k numbers ≥ 0 off its diagonal, or a function that returns one."""
    if table is None or callable(table):
        return as_partial(table, name)
    entries = numbers(table, name)
    if np.shape(entries) != (count, count):
        raise ValueError(f"{name}: got shape {np.shape(entries)}, wanted {(count, count)}: a row and a column per mode")
    if isinstance(entries, np.ndarray):
        off = entries[~np.eye(count, dtype=bool)]
        if not np.all((off >= 0) & (off <= most)):
            wanted = "finite numbers ≥ 0" if most < np.inf else "numbers ≥ 0, or infinity"
            raise ValueError(f"{name}: got {np.asarray(entries).tolist()}, wanted {wanted} off the diagonal")
        entries = np.where(np.eye(count, dtype=bool), 0.0, entries)
    return entries
