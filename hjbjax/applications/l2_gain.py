"""The L₂-gain problem of a plant, and whether the bound on its disturbances is felt.

    ẋ = f(x, u) + E d,   cost L(x, u) − ½γ²|d|²,   L = ½|z|²

with z the output to be kept small. The equation wants d without a bound; a grid wants a bounded set, which must be wide
enough to be inactive: ``saturation`` tells.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, front_door, numbers
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Finite
from hjbjax.problem.types import Array, Number, Numbers
from hjbjax.solution.solution import Solution

NEAR = 2e-3  # of the half width: a disturbance so near its bound sits on it

InputMatrix: TypeAlias = Callable | Numbers | Sequence | None  # E, a number or a matrix (n, l), perhaps of the state


@front_door
def attenuation(
    problem: Problem, gamma: Numbers, disturbances: AdmissibleSet, *, enters: InputMatrix = None
) -> Problem:
    """The L₂-gain problem of a problem without disturbances: drift f + E d, cost L − ½γ²|d|².

    Args:
      problem: drift f, cost L = ½|z|² and the rest.
      gamma: the level γ > 0; a leaf, so that another one compiles nothing.
      disturbances: the admissible set of d, wide enough to be inactive where the answer matters.
      enters: E, shape (n, l), or a function of the state that returns it; ``None``: d is added to the drift.

    Returns:
      The game; the disturbance sees the control, which makes no difference here.

    Raises:
      ValueError: a problem that has disturbances, no cost, or a level that is not positive.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-4.0], [4.0]))
      >>> game = attenuation(plant, 2.0, hjb.Box([-4.0], [4.0]))
      >>> float(game.cost(jnp.ones(1), jnp.zeros(1), jnp.ones(1)))
      -1.5
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"attenuation: got {type(problem).__name__}, wanted a Problem without disturbances")
    if problem.is_game:
        raise ValueError(f"attenuation: the problem already has disturbances, {problem.disturbances!r}; leave them out")
    if problem.cost is None:
        raise ValueError("attenuation: the problem has no cost; wanted L = ½|z|² of the output z to be kept small")
    level = numbers(gamma, "attenuation: gamma")  # a tracer goes through: its sign is not known yet
    if np.ndim(level) or (isinstance(level, np.ndarray) and not 0 < level < math.inf):
        raise ValueError(f"attenuation: got gamma = {gamma!r}, wanted a finite number > 0")
    level = float(level) if isinstance(level, np.ndarray) else level
    enters = as_partial(enters) if callable(enters) else None if enters is None else numbers(enters, "enters")
    # Partials that hold γ and E as leaves: another level is another number in the same compiled program
    # the problem keeps its isaacs: u and d stand in separate terms, so that min max and max min agree
    return dataclasses.replace(
        problem,
        drift=jax.tree_util.Partial(_drift, problem.drift, enters),
        cost=jax.tree_util.Partial(_cost, problem.cost, level),
        noise=jax.tree_util.Partial(_noise, problem.noise) if callable(problem.noise) else problem.noise,
        disturbances=disturbances,
    )


def _drift(drift: Callable, enters: Callable | Array | None, *arguments: Array) -> Array:
    """f(x, u) + E(x) d; the time may go first."""
    *seen, d = arguments
    if enters is None:
        return drift(*seen) + d  # E = I: as many disturbances as states
    # the state is the last but one of (t, x, u) and of (x, u)
    return drift(*seen) + jnp.matmul(enters(seen[-2]) if callable(enters) else enters, d)


def _cost(cost: Callable, gamma: Number, *arguments: Array) -> Array:
    """L(x, u) − ½γ²|d|²."""
    *seen, d = arguments
    # unbounded, the worst d is E'DV/γ²: the lower the level, the wider the set has to be
    return cost(*seen) - 0.5 * gamma**2 * (d @ d)


def _noise(noise: Callable, *arguments: Array) -> Array:
    """σ(x, u), which the disturbance does not move."""
    return noise(*arguments[:-1])


@dataclasses.dataclass(frozen=True)
class Saturation:
    """How near the worst disturbance comes to its bound in an inner box.

    Args:
      share: of the nodes there, those where an input of d sits on its bound.
      largest: the largest distance of d from the middle of its set over that of the bound, 1 on it.
      state: where that is, shape (n,).
      inner: the share of the grid's box that was looked at.
    """

    share: float
    largest: float
    state: np.ndarray
    inner: float

    def __str__(self) -> str:
        where = ", ".join(f"{x:.3g}" for x in self.state)
        return (
            f"the worst disturbance sits on its bound at {100 * self.share:.3g} % of the nodes of the inner "
            f"{self.inner:g} of the box, and comes to {self.largest:.3g} of it at ({where})"
        )


@front_door
def saturation(solution: Solution, problem: Problem, *, inner: float = 0.5) -> Saturation:
    """How near the worst disturbance comes to its bound, which is meant to be inactive, in an inner box.

    Where it sits on the bound the answer is that of the set and not of the equation: widen the set, or take the
    level γ for infeasible.

    Args:
      solution: of the problem; of a marched one the earliest kept time counts.
      problem: a game whose disturbances form a Box or a Ball.
      inner: the share of the box, around its middle, along every axis that is not periodic.

    Returns:
      The share of nodes on the bound, the largest |d| relative to it, and where.

    Raises:
      ValueError: no disturbances, a finite set, a share outside (0, 1], or no node with a disturbance.
    """
    admissible = problem.disturbances
    if admissible is None or solution.disturbance is None:
        raise ValueError("saturation: the problem has no disturbances; give Problem(disturbances=hjb.Box(...))")
    # points have no bound that could be wide enough: of a finite set every worst case is one of them
    if isinstance(admissible, Finite):
        raise ValueError(f"saturation: the disturbances are {len(admissible.points)} points; wanted a Box or a Ball")
    if not 0 < inner <= 1:
        raise ValueError(f"saturation: got inner = {inner!r}; wanted a share of the box in (0, 1]")
    # a march is judged where it has come to, the earliest kept time: there the worst case has the longest way ahead
    d = np.asarray(solution.disturbance if solution.times is None else solution.disturbance[0], np.float64)
    # nodes without a disturbance, as those of a target, do not count
    inside = solution.grid.inner(inner) & np.all(np.isfinite(d), axis=-1)
    if not inside.any():
        raise ValueError(f"saturation: no node with a disturbance in the inner {inner:g} of the box; enlarge it")
    # −1 outside: an argmax finds a node of the inner box, also where d is zero in all of it
    size = np.where(inside, _share_of_bound(admissible, d), -1.0)
    index = np.unravel_index(int(np.argmax(size)), size.shape)
    share = float(np.mean(size[inside] >= 1 - NEAR))
    return Saturation(share, float(size[index]), solution.grid.state([int(i) for i in index]), float(inner))


def _share_of_bound(admissible: Box | Ball, d: np.ndarray) -> np.ndarray:
    """|d| over its bound at every node; inputs that cannot move do not count."""
    if isinstance(admissible, Ball):
        # d has shape (*grid, l), the share (*grid)
        return np.linalg.norm(d, axis=-1) / np.where(admissible.radius > 0, admissible.radius, np.inf)
    # of a box the nearest bound decides, input by input, and d is measured from the middle
    lo, hi = np.asarray(admissible.lo), np.asarray(admissible.hi)
    return np.max(np.abs(d - (lo + hi) / 2) / np.where(hi > lo, (hi - lo) / 2, np.inf), axis=-1)
