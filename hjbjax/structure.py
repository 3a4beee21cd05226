"""How the drift and the cost depend on the control: read from the jaxpr, not from a flag or from samples.

The jaxpr of a function is evaluated with polynomials in u instead of numbers. A polynomial is known only by
the set of its monomials: ``()`` is what does not depend on u, ``(0,)`` is u₀, ``(0, 1)`` is u₀u₁; anything of
degree above two, and anything that is not a polynomial, is ``NONLINEAR``. The answer is a proof: a function
that is called affine is affine at every state.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from hjbjax import fields
from hjbjax.pytree import remembered

Monomials = frozenset | None
CONSTANT: Monomials = frozenset({()})
NONLINEAR: Monomials = None

_LINEAR = frozenset({"neg", "convert_element_type", "copy", "copy_p", "real", "stop_gradient", "reduce_precision"})


@dataclass(frozen=True)
class Dependence:
    """Which monomials of the control each entry of a function's result holds.

    Attributes:
      entries: one set of monomials an entry, or ``None`` where the entry is no quadratic polynomial.
    """

    entries: tuple[Monomials, ...]

    @property
    def is_constant(self) -> bool:
        """Whether no entry depends on the control."""
        return all(entry is not None and not any(entry) for entry in self.entries)

    def affine_in(self, inputs: Sequence[int]) -> bool:
        """Whether every entry is affine in these inputs together, whatever the others are."""
        wanted = set(inputs)
        return all(entry is not None and all(sum(j in wanted for j in m) <= 1 for m in entry) for entry in self.entries)

    def separable_quadratic_in(self, inputs: Sequence[int]) -> bool:
        """Whether every entry is a sum of quadratic polynomials of one of these inputs each."""
        wanted = set(inputs)
        return all(entry is not None and all(len(wanted & set(m)) <= 1 for m in entry) for entry in self.entries)

    def free_of(self, inputs: Sequence[int]) -> bool:
        """Whether no entry depends on these inputs."""
        return not self.driven_by(inputs)

    def driven_by(self, inputs: Sequence[int]) -> tuple[int, ...]:
        """The entries that depend on one of ``inputs``."""
        wanted = set(inputs)
        return tuple(i for i, entry in enumerate(self.entries) if entry is None or any(wanted & set(m) for m in entry))

    def has_square(self, inputs: Sequence[int]) -> bool:
        """Whether some entry holds a second power of one of ``inputs``."""
        return any(entry is None or any(m == (j, j) for m in entry for j in inputs) for entry in self.entries)


@remembered
def dependence(function: Callable, *arguments: tuple[int | None, bool], dtype: Any) -> Dependence:
    """The dependence of ``function`` on those of its arguments that are controls.

    Args:
      function: a function of one state, as a problem holds it: a pytree.
      *arguments: for every argument (length, counts): its length (``None`` for a scalar), and whether its
        entries are inputs; inputs are numbered through all counted arguments.
      dtype: the floating-point type in which it is traced.
    """
    shapes = [jax.ShapeDtypeStruct(() if length is None else (length,), dtype) for length, _ in arguments]
    closed = jax.make_jaxpr(function)(*shapes)
    packed, number = [], 0
    for (_, counts), shape in zip(arguments, shapes, strict=True):
        entries = np.empty(shape.shape, dtype=object)
        for index in np.ndindex(*shape.shape):
            entries[index] = frozenset({(number,)}) if counts else CONSTANT
            number += counts
        packed.append(entries)
    (result,) = fields.evaluate(closed, packed, _POLYNOMIALS)
    if not (isinstance(result, np.ndarray) and result.dtype == object):
        return Dependence((CONSTANT,) * int(np.size(result)))
    return Dependence(tuple(result.reshape(-1)))


def _product(left: Monomials, right: Monomials) -> Monomials:
    if left is None or right is None:
        return NONLINEAR
    monomials = frozenset(tuple(sorted(p + q)) for p in left for q in right)
    return monomials if all(len(m) <= 2 for m in monomials) else NONLINEAR


def _sum(left: Monomials, right: Monomials) -> Monomials:
    return NONLINEAR if left is None or right is None else left | right


class _Polynomials:
    """Scalars that are sets of monomials."""

    def constant(self, value: Any, index: tuple[int, ...]) -> Monomials:
        return CONSTANT

    def entrywise(self, primitive: Any, params: dict, operands: list[Any], dtypes: list[Any]) -> Monomials:
        name = primitive.name
        if all(value == CONSTANT for value in operands):
            return CONSTANT
        if name == "convert_element_type" and not np.issubdtype(params["new_dtype"], np.inexact):
            return NONLINEAR  # rounds
        if name in _LINEAR:
            return operands[0]
        if name in ("add", "add_any", "sub"):
            return _sum(*operands)
        if name == "mul":
            return _product(*operands)
        if name == "div" and operands[1] == CONSTANT:
            return operands[0]
        if name == "square" or (name == "integer_pow" and params["y"] == 2):
            return _product(operands[0], operands[0])
        if name == "integer_pow" and params["y"] == 1:
            return operands[0]
        if name == "select_n" and operands[0] == CONSTANT:
            cases = operands[1:]
            return NONLINEAR if any(case is None for case in cases) else frozenset().union(*cases)
        return NONLINEAR

    def combine(self, operation: Callable, dtype: Any, left: Monomials, right: Monomials) -> Monomials:
        if operation is jax.lax.add:
            return _sum(left, right)
        if operation is jax.lax.mul:
            return _product(left, right)
        return CONSTANT if left == right == CONSTANT else NONLINEAR

    def custom_jvp(self, eqn: Any, inner: Any, operands: list[Any]) -> list[Any]:
        return fields.evaluate(inner, operands, self)

    def nodewise(self, eqn: Any, operands: list[Any]) -> list[Any]:
        varying = [v for v in operands if isinstance(v, np.ndarray) and v.dtype == object]
        known = all(entry == CONSTANT for value in varying for entry in value.flat)
        results = []
        for var in eqn.outvars:
            entries = np.empty(var.aval.shape, dtype=object)
            entries.fill(CONSTANT if known else NONLINEAR)
            results.append(entries)
        return results


_POLYNOMIALS = _Polynomials()
