"""The damping of a high-order iteration by the sizes of its corrections.

Corrections are halved, at most three times, if V turned back and neither of the last two corrections was smaller than
all earlier ones. This ends limit cycles of the limiter. Halving from the start would take a third more steps. Halving
during slow monotone convergence would take 135 steps instead of 33 for the Dubins car on 41³ nodes.
"""

import jax
import jax.numpy as jnp

from hjbjax.problem.layouts import Layout
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Field, Scalar

LEAST_SHARE, CALM = 0.125, 5
SLOWEST = 0.95  # upper limit of the contraction rate ρ; the distance is then estimated as 20 times the step


@pytree_dataclass()
class Moves:
    """The sizes of the corrections, cost units, and the resulting damping.

    Args:
      last: the sizes of the last two full corrections, before damping, latest first; infinite if there was none.
      least: the smallest size before the last two.
      share: the damping, the fraction of a correction that is applied.
      since: the number of steps since ``share`` changed.
    """

    last: jax.Array
    least: Scalar
    share: Scalar
    since: Scalar

    def after(self, moved: Scalar, turned: jax.Array) -> "Moves":
        """The damping after a step of size ``moved``, which is infinite if there was no step.

        Corrections that no longer shrink are halved if they turn back, as in a cycle, and restored if they continue in
        one direction, as in slow convergence.
        """
        whole = moved / self.share
        last, least = jnp.stack([whole, self.last[0]]), jnp.minimum(self.least, self.last[1])
        stuck = (jnp.minimum(whole, self.last[0]) >= least) & (self.since >= CALM)
        fitting = jnp.where(turned, jnp.maximum(self.share / 2, LEAST_SHARE), jnp.minimum(2 * self.share, 1))
        new = Moves(last, least, jnp.where(stuck, fitting, self.share), jnp.where(stuck, 0, self.since + 1))
        return jax.tree.map(lambda after, before: jnp.where(jnp.isinf(moved), before, after), new, self)

    def distance(self, moved: Scalar, rounding: Scalar) -> Scalar:
        """The distance from V to the limit of its iteration, cost units: step/(1 − ρ), with the observed contraction ρ.

        Args:
          moved: the size of the last correction as applied; ``last`` has the sizes of the two before it.
          rounding: a smaller step is a rounding error, which does not contract and is not counted, cost units.
        """
        step, before = moved / self.share, self.last
        known = jnp.isfinite(before) & (before > 0)
        # over one step and over two, because eigenvalues of opposite signs make every other step short
        ratios = jnp.where(known, step / jnp.where(known, before, 1), 0) ** jnp.array([1.0, 0.5], step.dtype)
        rate = jnp.where(jnp.isfinite(before[0]), jnp.max(ratios), SLOWEST)
        rate = jnp.clip(rate, 0, SLOWEST)
        return moved + jnp.maximum(moved - rounding, 0) * rate / (1 - rate)


def turns_back(layout: Layout, change: Field, defect: Field) -> jax.Array:
    """True if a correction overshot: where V changed most, its equation now requires the opposite change.

    Args:
      layout: the layout of the nodes.
      change: the last change of V, zero at nodes that do not count, cost units, (*grid).
      defect: the residual at the new V, positive where V should increase, cost per unit time, (*grid).
    """
    most = jnp.abs(change) > layout.largest(jnp.abs(change)) / 2
    onwards = jnp.where(most, jnp.sign(change) * defect, 0)
    return layout.largest(-onwards) > layout.largest(onwards)
