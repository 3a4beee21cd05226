"""Questions to the parts of a jaxpr.

The types are those of ``jax.extend.core``, imported when the first function is traced and not with the package:
``jax.extend`` brings Pallas along, 15 ms of every ``import hjbjax``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeGuard

if TYPE_CHECKING:
    from jax.extend import core as jex


def is_literal(operand: jex.Var | jex.Literal) -> TypeGuard[jex.Literal]:
    """True for a number in the code, which no variable of the jaxpr stands for."""
    from jax.extend.core import Literal

    return isinstance(operand, Literal)


def is_closed(value: Any) -> TypeGuard[jex.ClosedJaxpr]:
    """True for a jaxpr that brings its constants along."""
    from jax.extend.core import ClosedJaxpr

    return isinstance(value, ClosedJaxpr)


def is_open(value: Any) -> TypeGuard[jex.Jaxpr]:
    """True for a jaxpr whose constants are somewhere else, or that has none."""
    from jax.extend.core import Jaxpr

    return isinstance(value, Jaxpr)


def closed(jaxpr: jex.Jaxpr) -> jex.ClosedJaxpr:
    """A jaxpr without constants as one that brings them along."""
    from jax.extend.core import ClosedJaxpr

    return ClosedJaxpr(jaxpr, ())
