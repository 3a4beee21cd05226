"""Where the nodes of an axis stand: maps of [0, 1] onto itself, tables of coordinates, and periods."""

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
    """Nodes gathered around one place, ever sparser away from it: smooth, so that schemes keep their order.

    φ(ξ) = (sinh κ(ξ − ξ₀) + sinh κξ₀)/(sinh κ(1 − ξ₀) + sinh κξ₀) with ξ₀ such that φ(ξ₀) is the centre. Spacings at
    the centre are about κ/sinh κ of the uniform ones when it is at one end, κ/(2 sinh κ/2) when in the middle.

    Args:
      strength: κ > 0; the larger, the denser.
      center: the place, as a fraction of the way from ``lo`` to ``hi``. A node stands on it when it is ½ and the
        number of intervals is even.

    Raises:
      ValueError: a strength that is not positive, or a centre outside [0, 1].

    Example:
      >>> np.round(Sinh(4.0).place(np.linspace(0, 1, 5)), 3).tolist()
      [0.0, 0.338, 0.5, 0.662, 1.0]
    """

    strength: Number
    center: Number = 0.5

    def __post_init__(self):
        if is_traced(self.strength, self.center):
            return
        if not (np.isfinite(self.strength) and self.strength > 0):
            raise ValueError(f"Sinh: got strength = {self.strength!r}, wanted a finite number > 0")
        if not 0 <= self.center <= 1:
            raise ValueError(f"Sinh: got center = {self.center!r}, wanted a fraction between 0 and 1")

    def _frame(self, xp: ModuleType) -> tuple[Array, Array, Array]:
        """ξ₀, and sinh κξ₀ and sinh κ(1 − ξ₀), the two ends of the curve that is scaled to [0, 1]."""
        k, c = self.strength, self.center
        # tanh κξ₀ = c sinh κ/(1 − c + c cosh κ) may be near 1, where arctanh loses up to e^(2κ) units in the last place
        middle = xp.log((1 - c + c * xp.exp(k)) / (1 - c + c * xp.exp(-k))) / (2 * k)
        middle = xp.where(c == 0.5, 0.5, middle)  # to the last bit, so that a node stands exactly there
        below, above = xp.sinh(k * middle), xp.sinh(k * (1 - middle))
        return middle, below, above

    def place(self, fraction: Numbers) -> Array:
        """φ: the place, in [0, 1], of the node that uniform spacing would put at ``fraction``."""
        # NumPy where numbers are known: a compiled sinh rounds otherwise, and nodes must not move
        xp: Any = jnp if is_traced(self, fraction) else np
        middle, below, above = self._frame(xp)
        return (xp.sinh(self.strength * (fraction - middle)) + below) / (above + below)

    def fraction(self, place: Numbers) -> Array:
        """φ⁻¹: the ``fraction`` whose node stands at ``place``; JAX arrays."""
        middle, below, above = self._frame(jnp)
        return middle + jnp.arcsinh(place * (above + below) - below) / self.strength


Stretching = Sinh


def checked_table(computed: Array, table: Array, farthest: Array) -> Array:
    """The table of an axis whose largest coordinate is ``farthest``; the formula where the corners were changed alone.

    A corner that was swapped for a tracer, as ``grad`` does, comes with the table of the old one.
    """
    xp: Any = jnp if is_traced(computed, table, farthest) else np
    slack = ROUNDINGS * np.finfo(table.dtype).eps * farthest
    return xp.where(xp.abs(computed - table) <= slack, table, computed)


from_table = jax.custom_jvp(checked_table)  # with the derivative of the formula


@from_table.defjvp
@own_settings()
def _derivative_of_the_formula(primals: tuple, tangents: tuple) -> tuple:
    """Value and tangent: nodes move with the corners as the formula says; the table is constant."""
    return from_table(*primals), tangents[0]


def into_period(x: Array, lo: Array, hi: Array) -> jax.Array:
    """Places along periodic axes, brought into [lo, hi)."""
    moved = lo + jnp.mod(x - lo, hi - lo)
    moved = jnp.where(moved >= hi, lo, moved)  # just below lo, the remainder rounds up to a whole period
    # a place in [lo, hi) keeps its bits: the remainder of a small difference would be rounded
    return jnp.where((x >= lo) & (x < hi), x, moved)
