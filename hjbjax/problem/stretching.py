"""Node positions along an axis: maps of [0, 1] onto itself, tables of coordinates, and periods."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, Numbers

ROUNDINGS = 16  # units of eps of the largest coordinate by which the formula may miss its table


@pytree_dataclass()
class Sinh:
    """Nodes concentrated around one place, gradually sparser away from it; smooth, so schemes keep their order.

    φ(ξ) = (sinh κ(ξ − ξ₀) + sinh κξ₀)/(sinh κ(1 − ξ₀) + sinh κξ₀) with ξ₀ such that φ(ξ₀) is the centre. The spacing at
    the centre is about κ/sinh κ of the uniform spacing for a centre at one end, κ/(2 sinh κ/2) for one in the middle.

    Args:
      strength: κ > 0; a larger κ makes the nodes denser at the centre.
      center: the centre, as a fraction of the distance from ``lo`` to ``hi``. It is a node if it is ½ and the number
        of intervals is even.

    Raises:
      ValueError: a strength that is not positive, or a centre outside [0, 1].

    Example:
      >>> np.round(Sinh(4.0).place(np.linspace(0, 1, 5)), 3).tolist()
      [0.0, 0.338, 0.5, 0.662, 1.0]
    """

    strength: Number
    center: Number = 0.5

    def __post_init__(self) -> None:
        if is_traced(self.strength, self.center):
            return
        if not (np.isfinite(self.strength) and self.strength > 0):
            raise ValueError(f"Sinh: got strength = {self.strength!r}, wanted a finite number > 0")
        if not 0 <= self.center <= 1:
            raise ValueError(f"Sinh: got center = {self.center!r}, wanted a fraction between 0 and 1")

    def _frame(self, xp: ModuleType) -> tuple[Array, Array, Array]:
        """ξ₀, sinh κξ₀ and sinh κ(1 − ξ₀); the last two scale the curve to [0, 1]."""
        k, c = self.strength, self.center
        # arctanh of tanh κξ₀ = c sinh κ/(1 − c + c cosh κ) near 1 loses up to e^(2κ) units in the last place
        middle = xp.log((1 - c + c * xp.exp(k)) / (1 - c + c * xp.exp(-k))) / (2 * k)
        middle = xp.where(c == 0.5, 0.5, middle)  # exact, so that a node is exactly at the centre
        below, above = xp.sinh(k * middle), xp.sinh(k * (1 - middle))
        return middle, below, above

    def place(self, fraction: Numbers) -> Array:
        """φ: the position in [0, 1] of the node that is at ``fraction`` with uniform spacing."""
        # NumPy for known numbers: a compiled sinh rounds differently, and nodes must not move
        xp: Any = jnp if is_traced(self, fraction) else np
        middle, below, above = self._frame(xp)
        return (xp.sinh(self.strength * (fraction - middle)) + below) / (above + below)

    def fraction(self, place: Numbers) -> Array:
        """φ⁻¹: the ``fraction`` of the node at ``place``; JAX arrays."""
        middle, below, above = self._frame(jnp)
        return middle + jnp.arcsinh(place * (above + below) - below) / self.strength


Stretching = Sinh


def checked_table(computed: Array, table: Array, farthest: Array) -> Array:
    """The table of an axis whose largest coordinate is ``farthest``, or the formula if only the corners were replaced.

    A corner replaced by a tracer, as ``grad`` does, comes with the table of the old corner.
    """
    xp: Any = jnp if is_traced(computed, table, farthest) else np
    slack = ROUNDINGS * np.finfo(table.dtype).eps * farthest
    return xp.where(xp.abs(computed - table) <= slack, table, computed)


from_table = jax.custom_jvp(checked_table)  # with the derivative of the formula


@from_table.defjvp
@own_settings()
def _derivative_of_the_formula(primals: tuple, tangents: tuple) -> tuple:
    """Value and tangent: nodes move with the corners according to the formula; the table is constant."""
    return from_table(*primals), tangents[0]


def into_period(x: Array, lo: Array, hi: Array) -> jax.Array:
    """Positions along periodic axes, wrapped into [lo, hi)."""
    moved = lo + jnp.mod(x - lo, hi - lo)
    moved = jnp.where(moved >= hi, lo, moved)  # a position just below lo can round up to a whole period
    # a position in [lo, hi) keeps its bits, because the remainder of a small difference would round
    return jnp.where((x >= lo) & (x < hi), x, moved)
