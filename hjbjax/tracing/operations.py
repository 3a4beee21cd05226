"""The length of a function's program, counted on its jaxpr before anything is compiled.

By components, a sum of two vectors with three entries is three operations, each on an array over the nodes. A long
vector in ``stacks`` is one operation and its own kernel. XLA takes about a millisecond per operation of the first kind,
even when they are fused, and a search over the actions writes each of them out about eighty times.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from hjbjax.tracing import jaxprs, stacks
from hjbjax.tracing.jaxprs import CALLS, CUMULATIVE, ENTRYWISE, MOVES, REDUCTIONS, SCATTERS, array_type

if TYPE_CHECKING:
    from jax.extend import core as jex

UNIFORM, COMPONENTS, STACK = range(3)  # kinds of values: numbers that hold at all nodes, one array per entry, one array


@dataclasses.dataclass(frozen=True)
class Operations:
    """The operations in one evaluation of a function, over all nodes at once.

    Attributes:
      single: operations on one component each.
      whole: operations on all entries of a long vector.
    """

    single: int = 0
    whole: int = 0

    def __add__(self, other: Operations) -> Operations:
        return Operations(self.single + other.single, self.whole + other.whole)


NONE = Operations()


def operations(closed: jex.ClosedJaxpr) -> Operations:
    """The operations of a function of one state whose arguments all vary from node to node.

    Args:
      closed: its jaxpr.

    Returns:
      Their numbers, as ``components`` writes them out; a loop inside the function counts as one.
    """
    return _walk(closed.jaxpr, [COMPONENTS] * len(closed.jaxpr.invars))[0]


def _walk(jaxpr: jex.Jaxpr, inputs: Sequence[int]) -> tuple[Operations, list[int]]:
    """The operations of a jaxpr and the kinds of its outputs."""
    kinds: dict[jex.Var | jex.Literal, int] = dict(
        zip(jaxpr.invars, inputs, strict=True)
    )  # other variables are constants

    def kind(var: jex.Var | jex.Literal) -> int:
        return UNIFORM if jaxprs.is_literal(var) else kinds.get(var, UNIFORM)  # a literal has no hash

    total = Operations()
    for eqn in jaxpr.eqns:
        found, results = _one(eqn, [kind(var) for var in eqn.invars])
        total += found
        kinds |= dict(zip(eqn.outvars, results, strict=True))
    return total, [kind(var) for var in jaxpr.outvars]


def _one(eqn: jex.JaxprEqn, operands: Sequence[int]) -> tuple[Operations, list[int]]:
    """The operations of an equation and the kinds of its results, by the rules of ``interpreter``."""
    name, by_entries = eqn.primitive.name, [COMPONENTS] * len(eqn.outvars)
    if not any(operands):
        return Operations(), [UNIFORM] * len(eqn.outvars)  # computed once, not at every node
    is_whole = stacks.is_whole(eqn, STACK in operands)
    if name in CALLS and CALLS[name] in eqn.params and not (name == "custom_jvp_call" and is_whole):
        inner = eqn.params[CALLS[name]]
        return _walk(inner.jaxpr if jaxprs.is_closed(inner) else inner, operands)
    if is_whole:
        return Operations(whole=1), [stacks.is_long(array_type(var).shape) + COMPONENTS for var in eqn.outvars]
    if name == "cond":  # all branches, and a choice among their results
        branches = [_walk(branch.jaxpr, operands[1:])[0] for branch in eqn.params["branches"]]
        return sum(branches, Operations(sum(array_type(var).size for var in eqn.outvars))), by_entries
    return Operations(_by_entries(eqn)), by_entries


def _by_entries(eqn: jex.JaxprEqn) -> int:
    """The operations of an equation by components."""
    name = eqn.primitive.name
    if name in MOVES:  # moves entries without computing
        return 0
    if name in REDUCTIONS or name in CUMULATIVE:
        return array_type(eqn.invars[0]).size
    if name in SCATTERS:
        return array_type(eqn.invars[2]).size
    size = sum(array_type(var).size for var in eqn.outvars)
    if name == "dot_general":  # each entry takes one product and one sum per index of the contracted axes
        (contracted, _), _ = eqn.params["dimension_numbers"]
        return 2 * size * math.prod(array_type(eqn.invars[0]).shape[axis] for axis in contracted)
    return size if name in ENTRYWISE else 1
