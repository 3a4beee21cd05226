"""Prescribed ends of the box: the value, the slope or the growth rate of V there.

Pass one per end in ``Grid(edges=...)``. Each is a number or a function of the state, which is
evaluated at the nodes of that end when the grid is made. Values and slopes have the sign of V, a cost or a reward.
Slopes and rates are derivatives along the coordinate, not along the outward normal: if V increases, the slope is
positive at both ends.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, State

Prescription = Callable[[State], Any] | Number


@pytree_dataclass()
class Dirichlet:
    """V = ``value`` at an end of the box, in cost units: paths that reach the end stop there and pay it.

    Args:
      value: a number, or a function of the state.

    Example:
      >>> import hjbjax as hjb
      >>> grid = hjb.Grid([0.0], [1.0], (11,), edges=((hjb.Dirichlet(0.0), hjb.Dirichlet(2.0)),))
      >>> grid.edges
      (('dirichlet', 'dirichlet'),)
    """

    value: Any
    kind = "dirichlet"


@pytree_dataclass()
class Neumann:
    """∂V/∂x_i = ``slope`` at an end of axis i, in cost units per unit of the state: V is mirrored with that slope.

    A slope of zero is a wall that reflects drift and noise.

    Args:
      slope: a number, or a function of the state.
    """

    slope: Any = 0.0
    rate = 0.0  # not a field: Robin's equation with a rate of zero
    kind = "neumann"


@pytree_dataclass()
class Robin:
    """∂V/∂x_i = ``rate`` · V + ``slope`` at an end of axis i: V continues as an exponential with that growth rate.

    Args:
      rate: per unit of the state, a number or a function of the state.
      slope: in cost units per unit of the state, a number or a function of the state.
    """

    rate: Any
    slope: Any = 0.0
    kind = "robin"


PRESCRIBED = (Dirichlet, Neumann, Robin)
KINDS = tuple(each.kind for each in PRESCRIBED)


def on_face(prescription: Any, nodes: Array, name: str) -> Any:
    """A number, or a function of the state at the nodes of one end.

    Args:
      prescription: the number or the function.
      nodes: the states at that end, (*face, n), with one node along the axis of the end.
      name: for messages.

    Returns:
      An array of the shape of the face, or of shape () for a number.

    Raises:
      TypeError: neither a number nor a function.
      ValueError: a function that does not return one finite number per state.
    """
    if not callable(prescription):
        if not is_traced(prescription) and (np.ndim(prescription) or np.asarray(prescription).dtype.kind not in "fiu"):
            raise TypeError(f"{name}: got {prescription!r:.80}; wanted a number or a function of the state")
        found = prescription
    elif isinstance(jnp.zeros(()), jax.core.Tracer):  # inside jit the floating-point type is the caller's choice
        found = _at(prescription, nodes)
    else:
        with own_settings(x64=True):
            found = _at(prescription, nodes)
            found = found if is_traced(found) else np.asarray(found)
    if callable(prescription) and np.shape(found) != nodes.shape[:-1]:
        raise ValueError(
            f"{name}: the function returned shape {np.shape(found)[nodes.ndim - 1 :]} for one state, wanted ()"
        )
    if not is_traced(found) and not np.all(np.isfinite(np.asarray(found))):
        raise ValueError(f"{name}: got a value that is not finite; wanted finite numbers at every node of the end")
    return found


def _at(function: Callable, nodes: Array) -> jax.Array:
    """A function of one state at the states of an array (..., n)."""
    flat = jnp.asarray(nodes.reshape(-1, nodes.shape[-1]))
    found = jax.vmap(function)(flat)
    return jnp.reshape(found, nodes.shape[:-1] + jnp.shape(found)[1:])
