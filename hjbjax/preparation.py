"""From a problem on a grid to a task: what is held, what counts, which certificate applies, which method runs."""

import dataclasses
import functools
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import bellman, checks, iteration, players, proper
from hjbjax.certificates import Certificate
from hjbjax.grid import Grid
from hjbjax.iteration import Method, Nested, PolicyIteration, Task, ValueIteration
from hjbjax.problem import Problem, may_be_positive
from hjbjax.pytree import cast
from hjbjax.relaxation import Direct, Krylov, Sweeps
from hjbjax.schemes import Upwind

UNREACHED = 1e8  # stands for an infinite value while iterating, large enough that no action steps into it


class SolveWarning(UserWarning):
    """The solve went through, and something about its answer deserves attention."""


NEST = 100_000  # nodes beyond which compiling coarser grids pays


def choose(problem: Problem, grid: Grid, *, traced: bool) -> Method:
    """The method that suits a problem.

    Where transport rules, a few wavefront sweeps evaluate a policy well enough. Where there is noise they are
    too slow and precondition a Krylov method; on a line a direct solve costs nothing. Large grids are nested. Tubes
    without discount have policies without a value of their own: there value iteration alone keeps to the extreme
    one of many fixed points.
    """
    if (problem.stopping_cost is not None or problem.running_max is not None) and not may_be_positive(problem.discount):
        return ValueIteration()
    if problem.noise is None:
        method = PolicyIteration(Sweeps())
    else:
        method = PolicyIteration(Direct() if grid.ndim == 1 and not traced else Krylov())
    return Nested(method) if grid.size > NEST and not traced else method


def prepare(
    problem: Problem, grid: Grid, *, method: Method, scheme: Upwind, tol: Any, dtype: Any, verdict: "Verdict"
) -> Task:
    """The task of a solve, all arrays in ``dtype``; pure, so that it may be traced, batched and differentiated."""
    problem, grid = cast(problem, dtype), cast(grid, dtype)
    rules, least = _rules(problem, grid, scheme=scheme, dtype=dtype, verdict=verdict)
    pace = None
    if isinstance(method, ValueIteration):
        rate = bellman.fastest_rate(problem, grid, scheme=scheme, dtype=dtype) + problem.discount
        pace = jnp.where(rate > 0, rate, 1)
    counted = jnp.ones(grid.shape, bool)
    if verdict.certificate is not Certificate.MULTIPLICATIVE:
        least = None
    return Task(
        problem, grid, method, rules, counted, least, pace, jnp.asarray(tol, dtype), scheme, verdict.certificate
    )


def _rules(
    problem: Problem, grid: Grid, *, scheme: Upwind, dtype: Any, verdict: "Verdict"
) -> tuple[bellman.Conditions, Any]:
    """The conditions, rest points among them, and the least running cost where it was needed."""
    rules = bellman.conditions(problem, grid, dtype)
    if not verdict.may_rest:
        return rules, None
    rests, least = iteration.rest_nodes(problem, grid, scheme=scheme, dtype=dtype)
    return dataclasses.replace(rules, held=rules.held | rests), least


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What is known of a problem before its numbers are looked at.

    Attributes:
      certificate: which bound on the error applies.
      exact: whether the minimum over the actions is exact.
      may_rest: whether rest points at zero cost close the problem (no discount, no constraint).
    """

    certificate: Certificate
    exact: bool
    may_rest: bool

    @property
    def sentence(self) -> str:
        """What certifies the error, or why nothing does."""
        if self.certificate is Certificate.NONE or self.exact:
            return self.certificate.value
        return self.certificate.value + "; for the refined sample of actions"


def judge(problem: Problem, grid: Grid, dtype: Any) -> Verdict:
    """Read the verdict from the problem's structure; a traced discount is taken for positive, which it must be."""
    how = players.setting(problem, grid.ndim, dtype)
    constrained = problem.stopping_cost is not None or problem.running_max is not None
    if may_be_positive(problem.discount):
        return Verdict(Certificate.ADDITIVE, how.exact, may_rest=False)
    fits = not constrained and problem.cost is not None and not how.disturbance_costs
    kind = Certificate.MULTIPLICATIVE if fits else Certificate.NONE
    return Verdict(kind, how.exact, may_rest=not constrained and problem.cost is not None)


prepare_jit = jax.jit(prepare, static_argnames=("scheme", "dtype", "verdict"))


@functools.partial(jax.jit, static_argnames=("scheme", "dtype", "verdict"))
def held_jit(problem: Problem, grid: Grid, *, scheme: Upwind, dtype: Any, verdict: Verdict) -> jax.Array:
    """The nodes at which the value is given, bool (*grid)."""
    return _rules(cast(problem, dtype), cast(grid, dtype), scheme=scheme, dtype=dtype, verdict=verdict)[0].held


def prepare_on_host(
    problem: Problem, grid: Grid, *, method: Method, scheme: Upwind, tol: float, dtype: Any
) -> tuple[Task, Verdict, np.ndarray | None]:
    """``prepare`` with the checks that need values: a finite solution exists, and where.

    Returns:
      The task, the verdict, and the nodes that reach the target (None where there is nothing to reach).

    Raises:
      ValueError: there is no finite solution.
    """
    verdict = judge(problem, grid, dtype)
    task = prepare_jit(problem, grid, method=method, scheme=scheme, tol=tol, dtype=dtype, verdict=verdict)
    held = np.asarray(task.rules.held)
    undiscounted = problem.discount == 0
    checks.ill_posed(problem, bool(verdict.may_rest and held.any()))
    if verdict.certificate is Certificate.MULTIPLICATIVE and not _costs_suit(task):
        verdict = dataclasses.replace(verdict, certificate=Certificate.NONE)
        task = dataclasses.replace(task, certificate=Certificate.NONE, least_cost=None)
    constrained = problem.stopping_cost is not None or problem.running_max is not None
    if problem.is_game or constrained or not held.any():
        return task, verdict, None
    reached = proper.reached(task.problem, task.grid, held, scheme=scheme, dtype=dtype, surely=undiscounted)
    if not reached.all():
        _warn_unreached(reached, undiscounted)
        if undiscounted:
            task = _without(task, reached)
    return task, verdict, reached


def _costs_suit(task: Task) -> bool:
    """Whether the running cost is positive wherever the value is not given."""
    return bool(np.all(np.asarray(task.least_cost)[~np.asarray(task.rules.held)] > 0))


def _without(task: Task, reached: np.ndarray) -> Task:
    """The nodes with an infinite value are held at a number so large that no optimal action goes there."""
    lost = jnp.asarray(~reached)
    given = jnp.where(lost, UNREACHED, task.rules.given)
    rules = dataclasses.replace(task.rules, held=task.rules.held | lost, given=given)
    return dataclasses.replace(task, rules=rules, counted=task.counted & ~lost)


def _warn_unreached(reached: np.ndarray, undiscounted: bool) -> None:
    share = 100 * (1 - float(np.mean(reached)))
    what = "their value is inf" if undiscounted else "their value is the discounted cost of never arriving"
    warnings.warn(
        f"{share:.3g} % of the nodes cannot reach the target: {what}; see Solution.reached", SolveWarning, stacklevel=4
    )
