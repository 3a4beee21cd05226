"""The L₂-gain problem of a plant, and a check that the bound on its disturbances is not active.

    ẋ = f(x, u) + E d,   cost L(x, u) − ½γ²|d|²,   L = ½|z|²

where z is the output to be kept small. The equation has no bound on d, but a solve requires a bounded set. The set must
be so wide that its bound is not active. ``saturation`` checks this.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.mode_axis import refuse_modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, front_door, numbers
from hjbjax.problem.rewards import refuse_rewards
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Finite, Simplex, refuse_unbounded
from hjbjax.problem.types import Array, Number, Numbers
from hjbjax.solution.solution import Solution

NEAR = 2e-3  # fraction of the half width: a disturbance closer to its bound counts as saturated

InputMatrix: TypeAlias = Callable | Numbers | Sequence | None  # E, a number or a matrix (n, l) or a function of x


@front_door
def attenuation(
    problem: Problem, gamma: Numbers, disturbances: AdmissibleSet, *, enters: InputMatrix = None
) -> Problem:
    """Construct the L₂-gain problem of a problem without disturbances: drift f + E d, cost L − ½γ²|d|².

    Args:
      problem: the plant with drift f and cost L = ½|z|².
      gamma: the level γ > 0; a leaf, so another level does not recompile.
      disturbances: the admissible set of d, wide enough to be inactive in the region of interest.
      enters: E, shape (n, l), or a function of the state that returns it; ``None``: d is added to the drift.

    Returns:
      The game. The disturbance chooses after the control, which makes no difference here.

    Raises:
      ValueError: the problem has modes, disturbances or no cost, or the level is not positive.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-4.0], [4.0]))
      >>> game = attenuation(plant, 2.0, hjb.Box([-4.0], [4.0]))
      >>> float(game.cost(jnp.ones(1), jnp.zeros(1), jnp.ones(1)))
      -1.5
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"attenuation: got {type(problem).__name__}, wanted a Problem without disturbances")
    refuse_modes(problem)
    refuse_rewards(
        problem, "attenuation", "an L₂ gain is about the energy ½|z|² of an output, which the control keeps small"
    )
    if problem.is_game:
        raise ValueError(f"attenuation: the problem already has disturbances, {problem.disturbances!r}; remove them")
    if problem.cost is None:
        raise ValueError("attenuation: the problem has no cost; wanted L = ½|z|² of the output z to be kept small")
    level = numbers(gamma, "attenuation: gamma")  # the sign of a tracer is unknown and not checked
    if np.ndim(level) or (isinstance(level, np.ndarray) and not 0 < level < math.inf):
        raise ValueError(f"attenuation: got gamma = {gamma!r}, wanted a finite number > 0")
    level = float(level) if isinstance(level, np.ndarray) else level
    enters = as_partial(enters) if callable(enters) else None if enters is None else numbers(enters, "enters")
    # Partials keep γ and E as leaves, so another level uses the same compiled program; isaacs stays the same, because
    # u and d are in separate terms, so min max and max min agree
    return dataclasses.replace(
        problem,
        drift=jax.tree_util.Partial(_drift, problem.drift, enters),
        cost=jax.tree_util.Partial(_cost, problem.cost, level),
        noise=jax.tree_util.Partial(_noise, problem.noise) if callable(problem.noise) else problem.noise,
        disturbances=disturbances,
    )


def _drift(drift: Callable, enters: Callable | Array | None, *arguments: Array) -> Array:
    """f(x, u) + E(x) d, with an optional time as the first argument."""
    *seen, d = arguments
    if enters is None:
        return drift(*seen) + d  # E = I: one disturbance per state
    # the state is the last but one of (t, x, u) and of (x, u)
    return drift(*seen) + jnp.matmul(enters(seen[-2]) if callable(enters) else enters, d)


def _cost(cost: Callable, gamma: Number, *arguments: Array) -> Array:
    """L(x, u) − ½γ²|d|²."""
    *seen, d = arguments
    # without a bound the worst d is E'DV/γ², so a lower level needs a wider set
    return cost(*seen) - 0.5 * gamma**2 * (d @ d)


def _noise(noise: Callable, *arguments: Array) -> Array:
    """σ(x, u), which does not depend on the disturbance."""
    return noise(*arguments[:-1])


@dataclasses.dataclass(frozen=True)
class Saturation:
    """The distance of the worst disturbance from its bound in an inner box.

    Args:
      share: the fraction of the nodes there where an input of d is at its bound.
      largest: the largest ratio of |d − centre of its set| to the bound; 1 at the bound.
      state: the state where it is largest, shape (n,).
      inner: the fraction of the grid's box that was checked.
    """

    share: float
    largest: float
    state: np.ndarray
    inner: float

    def __str__(self) -> str:
        where = ", ".join(f"{x:.3g}" for x in self.state)
        return (
            f"the worst disturbance is at its bound at {100 * self.share:.3g} % of the nodes of the inner "
            f"{self.inner:g} of the box, and reaches {self.largest:.3g} of it at ({where})"
        )


@front_door
def saturation(solution: Solution, problem: Problem, *, inner: float = 0.5) -> Saturation:
    """Check that the bound of the worst disturbance is inactive in an inner box.

    At nodes where the disturbance is at its bound, the solution depends on the set: widen the set, or regard the level
    γ as infeasible.

    Args:
      solution: a solution of the problem; for a solution of ``march`` the earliest stored time counts.
      problem: a game whose disturbances form a Box or a Ball.
      inner: the fraction of the box, around its centre, along every axis that is not periodic.

    Returns:
      The fraction of nodes at the bound, the largest |d| relative to it, and its state.

    Raises:
      ValueError: there are no disturbances or finitely many, ``inner`` is outside (0, 1], or no node has a disturbance.
    """
    admissible = problem.disturbances
    if admissible is None or solution.disturbance is None:
        raise ValueError("saturation: the problem has no disturbances; give Problem(disturbances=hjb.Box(...))")
    # the points of a finite set have no bound; every worst case is one of them
    if isinstance(admissible, Finite):
        raise ValueError(f"saturation: the disturbances are {len(admissible.points)} points; wanted a Box or a Ball")
    if isinstance(admissible, Simplex):  # its disturbances have a sum, not a size
        raise ValueError(f"saturation: got disturbances in {admissible!r}; wanted a Box or a Ball")
    refuse_unbounded(admissible, "saturation", "the worst case is compared with them")
    if not 0 < inner <= 1:
        raise ValueError(f"saturation: got inner = {inner!r}; wanted a share of the box in (0, 1]")
    # the earliest time of a march, where the worst case has the longest time ahead
    d = np.asarray(solution.disturbance if solution.times is None else solution.disturbance[0], np.float64)
    # nodes without a disturbance, for example in a target, do not count
    inside = solution.grid.inner(inner) & np.all(np.isfinite(d), axis=-1)
    if not inside.any():
        raise ValueError(f"saturation: no node with a disturbance in the inner {inner:g} of the box; enlarge it")
    # −1 outside, so that argmax finds a node of the inner box even if d is zero in all of it
    size = np.where(inside, _share_of_bound(admissible, d), -1.0)
    index = np.unravel_index(int(np.argmax(size)), size.shape)
    share = float(np.mean(size[inside] >= 1 - NEAR))
    return Saturation(share, float(size[index]), solution.grid.state([int(i) for i in index]), float(inner))


def _share_of_bound(admissible: Box | Ball, d: np.ndarray) -> np.ndarray:
    """|d| relative to its bound at every node; inputs that cannot move do not count."""
    if isinstance(admissible, Ball):
        # d has shape (*grid, l), the result (*grid)
        return np.linalg.norm(d, axis=-1) / np.where(admissible.radius > 0, admissible.radius, np.inf)
    # for a box the nearest bound of any input decides, and d is measured from the centre
    lo, hi = np.asarray(admissible.lo), np.asarray(admissible.hi)
    return np.max(np.abs(d - (lo + hi) / 2) / np.where(hi > lo, (hi - lo) / 2, np.inf), axis=-1)
