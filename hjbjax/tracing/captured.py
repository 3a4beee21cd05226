"""Numbers that a function reads from outside, as an argument of it.

``for mass in masses: solve(Problem(lambda x, u: u / mass, ...), grid)`` would compile a program for every mass, since a
number that a function closes over is part of its code. Here the cells and the globals that hold a number are found, and
the function is written again with these as an argument, so that they are leaves of the problem like any other.

A number stays where it is if the function does more with it than arithmetic: an exponent decides how a cost depends on
the control, an integer may be a shape, a comparison may choose between two branches.
"""

from __future__ import annotations

import dis
import inspect
import types
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, cast

import jax
import numpy as np

from hjbjax.problem.pytree import is_traced
from hjbjax.tracing import jaxprs
from hjbjax.tracing.identity import names_read

if TYPE_CHECKING:
    from jax.extend import core as jex

# what a number may do to a state or a control without a say in how the result depends on these
ARITHMETIC = frozenset({"add", "add_any", "sub", "mul", "div", "max", "min", "atan2", "dot_general", "concatenate"})
CALLS = frozenset({"jit", "pjit"})  # JAX renamed the one to the other
FLOATS = (float, np.floating)
NUMBERS = (int, float, np.integer, np.floating)


class OfNumbers:
    """A function of the numbers that it reads under ``names``, and of its own arguments."""

    def __init__(self, function: Callable, names: Sequence[str]):
        assert isinstance(function, types.FunctionType)  # others read nothing by name
        self.function, self.names = function, tuple(names)
        self.__code__ = function.__code__  # which tells it from others, beside its mark
        own = inspect.signature(function)
        first = inspect.Parameter("numbers", inspect.Parameter.POSITIONAL_ONLY)
        self.__signature__ = own.replace(parameters=[first, *own.parameters.values()])

    def __call__(self, numbers: tuple, *arguments: Any, **options: Any) -> Any:
        """What the function returns where it reads ``numbers``."""
        values = dict(zip(self.names, numbers, strict=True))
        inner = self.function.__code__.co_freevars
        cells = self.function.__closure__ or ()
        changed = types.FunctionType(
            self.function.__code__,
            self.function.__globals__ | {name: values[name] for name in self.names if name not in inner},
            self.function.__name__,
            self.function.__defaults__,
            tuple(types.CellType(values[n]) if n in values else c for n, c in zip(inner, cells, strict=True)),
        )
        changed.__kwdefaults__ = self.function.__kwdefaults__
        return changed(*arguments, **options)


def numbers_read(function: Callable, kinds: tuple[type, ...]) -> dict[str, np.ndarray]:
    """Numbers of these kinds and real arrays in the cells and globals that a function's own code names."""
    if not isinstance(function, types.FunctionType) or _writes(function.__code__):
        return {}
    # a global whose name is an attribute's in the code is found as well, and then not read: no harm
    found = {name: function.__globals__.get(name) for name in names_read(function.__code__)}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        found[name] = _content(cell)
    return {name: np.asarray(each, float) for name, each in sorted(found.items()) if _is_number(each, kinds)}


def _writes(code: types.CodeType) -> bool:
    """True if code rebinds a global or a name of the functions around it, of which copies would know nothing."""
    for each in dis.get_instructions(code):
        if each.opname in ("STORE_GLOBAL", "DELETE_GLOBAL"):
            return True
        if each.opname in ("STORE_DEREF", "DELETE_DEREF") and each.argval in code.co_freevars:
            return True
    return any(_writes(each) for each in code.co_consts if isinstance(each, types.CodeType))


def _content(cell: types.CellType) -> object:
    """What a cell holds; None while it is empty."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


def _is_number(thing: object, kinds: tuple[type, ...]) -> bool:
    """True for a number of these kinds, and for an array of real numbers that is known."""
    if isinstance(thing, (np.ndarray, jax.Array)):
        return not is_traced(thing) and np.issubdtype(thing.dtype, np.floating)
    return isinstance(thing, kinds) and not isinstance(thing, bool)


def decisive(jaxpr: jex.Jaxpr, variables: Sequence[jex.Var]) -> set[int]:
    """Positions of the variables that do more than arithmetic to the jaxpr's other arguments."""
    owners = {var: frozenset([position]) for position, var in enumerate(variables)}
    return set(_follow(jaxpr, owners)[0])


def _follow(jaxpr: jex.Jaxpr, owners: dict[jex.Var, frozenset[int]]) -> tuple[set[int], list[frozenset[int]]]:
    """Positions that decide something, and those that each output is a number of.

    ``owners``: for each variable that is a number, known before any state is, the positions it was made from.
    """
    deciding: set[int] = set()
    for eqn in jaxpr.eqns:
        read = [owners.get(cast("jex.Var", each), frozenset()) for each in eqn.invars if not jaxprs.is_literal(each)]
        touched: frozenset[int] = frozenset().union(*read)
        if touched and all(read):  # a number made from numbers
            owners |= dict.fromkeys(eqn.outvars, touched)
            continue
        inner = eqn.params.get("jaxpr")
        if touched and eqn.primitive.name in CALLS and jaxprs.is_closed(inner):
            known = zip(inner.jaxpr.invars, eqn.invars, strict=True)
            pairs = {mine: owners[its] for mine, its in known if not jaxprs.is_literal(its) and its in owners}
            inside, results = _follow(inner.jaxpr, pairs)
            deciding |= inside
            owners |= {var: each for var, each in zip(eqn.outvars, results, strict=True) if each}
        elif touched and eqn.primitive.name not in ARITHMETIC:
            deciding |= touched
    ends = [owners.get(cast("jex.Var", each), frozenset()) for each in jaxpr.outvars]  # literals own nothing
    return deciding, ends
