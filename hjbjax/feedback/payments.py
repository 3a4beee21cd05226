"""The payments of a path in addition to its running cost, stopping, tubes, and a comparison of the cost with V.

    cost = ∫ e^{−βt} L dt + e^{−βτ} · { exit cost on the target; ψ where V = ψ; V(T, ·) at the horizon T of a march }

V(T, ·) is what ``march`` assumed: ``start``, else the terminal cost, else ψ, else g, and never more than ψ. Without
running cost, interventions and noise nothing accumulates along a path. Its cost is that of the best moment to stop,

    cost = min over s of max{ e^{−βs} ψ(x(s)), max over r ≤ s of g(x(r)) },

which is the value of a tube along the path. A path need not end at that moment.
"""

import contextlib
import math
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.path import Path, PathStatus
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST
from hjbjax.problem.mode_axis import over_modes
from hjbjax.problem.problem import Problem, has_interventions, is_discounted, is_random
from hjbjax.problem.pytree import cast, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import with_any_control
from hjbjax.problem.types import Array, Number, State
from hjbjax.solution.interpolation import Samples, between, query
from hjbjax.solution.rewards import in_costs
from hjbjax.solution.solution import Solution
from hjbjax.tracing.closures import settled
from hjbjax.tracing.components import of_state

MANY = 10  # a path whose cost misses V by more than this number of estimated errors breaks the promise
LEAST = 0.02  # fraction of the range of V: allowed extra cost of a feedback interpolated between the nodes
UNKNOWN = 0.02  # fraction of the range of V: the assumed error of a value without an estimate
STILL = 1e-6  # fraction of the box: a path that moves less in its second half is at rest
# a path comes to rest if its second half moves less than these shares of the box and of the motion in the first half
RESTS, SLOWS = 1e-3, 1e-2
AWAY, BACK = 0.5, 0.1  # the same for a path that circles inside a cell, as fractions of its extent
SAME = 1e-5  # two problems count as the same if their numbers at a state differ by no more than this
FAR = 1.5  # cells: a circling path moves away from a state by more than this, and returns within one


@pytree_dataclass()
class Lookup:
    """A function known at the nodes, multilinear between them; called with (t, x); outside, the nearest point counts.

    Args:
      grid: the nodes.
      values: shape (*grid), or (k, *grid) with times.
      times: the stored times of a march, or None.
    """

    grid: Grid
    values: Any
    times: Any = None

    def __call__(self, t: Number, x: State) -> Array:
        """The value, a number."""
        when = None if self.times is None else t
        samples = Samples(self.grid, self.values, self.times)
        return query(between, samples, x, when, clamp=True, name="simulate")


@runtime_checkable
class MadeFromSolution(Protocol):
    """A feedback that keeps the solution from which it was made, such as ``greedy_feedback``."""

    @property
    def solution(self) -> object:
        """The solution."""


def solution_of(feedback: object) -> Solution | None:
    """The Solution of a feedback: the feedback itself, or the Solution from which it was made; otherwise None.

    Its value is a cost, like everything in this file.
    """
    solution = feedback.solution if isinstance(feedback, MadeFromSolution) else feedback
    return in_costs(solution) if isinstance(solution, Solution) else None


def is_tube(problem: Problem) -> bool:
    """True if the cost of a path is an extreme along it: a running maximum, or only a cost of stopping.

    With noise the controller must decide to stop without knowing the rest of the path. The cost is then the cost at the
    chosen time and not the least one along the path, so only a running maximum counts. Pushes and changes of the mode
    are paid on the way, as a running cost is.
    """
    if problem.running_max is not None:
        return True
    free = problem.cost is None and not has_interventions(problem)
    return problem.stopping_cost is not None and free and not is_random(problem)


def surplus(problem: Problem, feedback: object) -> Lookup | None:
    """ψ − V between the nodes, zero where stopping is optimal; None if no path is stopped.

    It is zero where V = ψ at every surrounding node, in a march at both surrounding times.
    """
    solution = solution_of(feedback)
    if problem.stopping_cost is None or is_tube(problem) or solution is None:
        return None
    known = not is_traced(problem, solution)
    # inside a caller's jit the result must be a constant, in the precision of the solution
    double = np.result_type(solution.value) == np.float64 if known else None
    folded: Any = jax.ensure_compile_time_eval() if known else contextlib.nullcontext()
    with folded, own_settings(x64=double):
        found = _surplus(problem, solution)
        return Lookup(solution.grid, np.asarray(found) if known else found, solution.times)


def _surplus(problem: Problem, solution: Solution) -> jax.Array:
    """ψ − V at the nodes and at all stored times; its square root with noise."""
    value, grid = jnp.asarray(solution.value), solution.grid
    # cast as in a solve: 1 + c in single precision is a different number, and V would not equal ψ
    problem = cast(settled(with_any_control(problem, grid.ndim), grid.ndim, value.dtype), value.dtype)
    x = grid.components(value.dtype)

    def price(t: Number) -> jax.Array:
        found = of_state(problem, problem.stopping_cost, x, t, value.dtype)
        return jnp.broadcast_to(jnp.asarray(found, value.dtype), grid.shape)

    moving = problem.time_dependent and solution.times is not None
    paid = jax.lax.map(price, jnp.asarray(solution.times, value.dtype)) if moving else price(0.0)
    rounding = 16 * jnp.finfo(value.dtype).eps * jnp.max(jnp.where(jnp.isfinite(value), jnp.abs(value), 0))
    left = paid - value - rounding
    left = jnp.where(jnp.isnan(left), jnp.inf, left)  # NaN neither stops nor reaches a target
    if problem.noise is None:
        return left
    # V touches ψ smoothly, so ψ − V grows as the square of the distance; the bridge between steps needs the distance
    return jnp.sqrt(jnp.maximum(left, 0))


def value_at_horizon(solution: object) -> Lookup | None:
    """V at the horizon of a march with ``start=``; None if the problem itself defines it."""
    found = solution_of(solution)
    if found is None or not found.stats.get("start", False):
        return None
    return Lookup(found.grid, found.value[-1])


def promise(feedback: object, start: Array, t: float = 0.0) -> float | None:
    """V at a state, from the Solution of a feedback; None without one."""
    solution = solution_of(feedback)
    if solution is None:
        return None
    where = (start,) if solution.times is None else (t, start)
    value = float(solution.value_at(*where, clamp=True))
    return value if math.isfinite(value) else None


def still_ahead(problem: Problem, feedback: object, path: Path, weight: float, *, to_horizon: bool) -> float | None:
    """The cost that V predicts after the end of a short path, discounted to the start of the path.

    An undiscounted path that rests or circles outside the target never achieves the V that was promised, so nothing is
    added. None if V does not predict the cost that follows.

    Args:
      problem: the simulated problem.
      feedback: the feedback, with a Solution that holds V.
      path: NumPy arrays.
      weight: the discount factor at the end of the path, e^{−∫ β dt}.
      to_horizon: True if the path is as long as the horizon of a march.
    """
    if path.status is PathStatus.TARGET or to_horizon:
        return 0.0
    if path.status is not PathStatus.DURATION:
        return None
    solution, end = solution_of(feedback), float(path.times[-1])
    assert solution is not None
    if (
        is_discounted(problem) is False
        and solution.times is None
        and (_rests(path, solution.grid) or _goes_round(path, solution))
    ):
        return 0.0
    value = promise(feedback, path.states[-1], end)
    return None if value is None else weight * value


def _rests(path: Path, grid: Grid) -> bool:
    """True if a path comes to rest: its second half hardly moves, relative to the box and to its first half."""
    middle, box = len(path.states) // 2, np.asarray(grid.hi) - np.asarray(grid.lo)
    early, late = (np.max(np.ptp(part, axis=0) / box) for part in (path.states[: middle + 1], path.states[middle:]))
    return bool(late <= STILL or (late <= RESTS and late <= SLOWS * early))


def _goes_round(path: Path, solution: Solution) -> bool:
    """True if a path returns to an earlier state in its second half, and V fell in between by at most its error."""
    grid, late = solution.grid, path.states[len(path.states) // 2 :]
    value = solution.value_at(late, clamp=True)
    if not value[0] - value[-1] <= _grid_error(solution):
        return False
    width = np.asarray(grid.hi) - np.asarray(grid.lo)
    apart = np.abs(late - late[-1])
    apart = np.where(np.array(grid.periodic), np.minimum(apart % width, -apart % width), apart)
    cells = np.max(apart / (width / (np.array(grid.shape) - 1)), axis=1)
    # a small orbit inside a cell is measured relative to its own size
    return _comes_back(cells, FAR, 1) or _comes_back(cells / max(np.max(cells), 1e-300), AWAY, BACK)


def _comes_back(apart: np.ndarray, far: float, near: float) -> bool:
    """True if the path was close to its last state, then far from it, and came back."""
    away = np.flatnonzero(apart > far)
    return bool(away.size and np.any(apart[: away[-1]] <= near))


def broken_promise(
    problem: Problem, feedback: object, path: Path, weight: float, *, to_horizon: bool, worst_case: bool = True
) -> str | None:
    """A sentence about a path whose cost differs from V by many times the estimated error; otherwise None.

    Args:
      problem: the simulated problem.
      feedback: the feedback, with a Solution that holds V.
      path: NumPy arrays, with ``promised``.
      weight: the discount factor at the end of the path, e^{−∫ β dt}.
      to_horizon: True if the path is as long as the horizon of a march.
      worst_case: True if the disturbance is the Solution's own; under another one the path may cost less.
    """
    solution = solution_of(feedback)
    # one noisy path says nothing about the mean cost
    if path.promised is None or solution is None or is_random(problem):
        return None
    states = path.states
    free = np.array(solution.grid.periodic)
    inside = (states >= solution.grid.lo) & (states <= solution.grid.hi) | free
    ahead = still_ahead(problem, feedback, path, weight, to_horizon=to_horizon)
    if ahead is None or not np.all(inside[:-1]):
        return None
    promised = path.promised if path.payoff == COST else 0 - path.promised
    off = _combined(problem, float(path.cost), ahead) - promised
    if off <= 0 and not worst_case:
        return None
    if abs(off) <= _allowed(solution) or abs(off) <= LEAST * _range_of_extremes(problem, solution):
        return None
    if not _is_answer_to(problem, solution, path):
        return None
    word, sign, verb = (COST, 1, "costs") if path.payoff == COST else (path.payoff, -1, "earns")
    further = "" if ahead == 0 else f" with the {word} that V predicts afterwards, {sign * ahead:.4g},"
    advice = (
        f"the feedback does not achieve V; use a finer grid, another scheme, a running {word} or a discount"
        if off > 0
        else f"V is too {'large' if sign > 0 else 'small'} there; use a finer grid or a larger box"
    )
    return f"the path {verb} {sign * path.cost:.6g},{further} and V promised {path.promised:.6g}: {advice}"


def _is_answer_to(problem: Problem, solution: Solution, path: Path) -> bool:
    """True if V belongs to the simulated problem: both problems have the same numbers at the first state of the path.

    V of another problem, for example with a nominal drift or another cost, promises nothing.
    """
    if solution.problem is None:  # loaded from a file or constructed by hand
        return True
    posed = over_modes(solution.problem, len(solution.grid.state_axes))
    if (posed.is_game, posed.time_dependent) != (problem.is_game, problem.time_dependent) or not len(path.controls):
        return False
    x, d = jnp.asarray(path.states[0]), None if path.disturbances is None else jnp.asarray(path.disturbances[0])
    played = problem.arguments(x, jnp.asarray(path.controls[0]), d, 0.0)
    alone = problem.state_arguments(x, 0.0)
    for arguments, names in (
        (played, ("drift", "cost", "growth")),
        (alone, ("stopping_cost", "running_max", "target", "exit_cost", "terminal_cost", "discount")),
    ):
        for name in names:
            mine, theirs = (_number_of(getattr(each, name), arguments) for each in (problem, posed))
            if not np.allclose(mine, theirs, rtol=SAME, atol=SAME, equal_nan=True):
                return False
    return True


def _number_of(ingredient: Any, arguments: tuple) -> np.ndarray:
    """An ingredient of a problem at its arguments: a function, a number, or None for zero."""
    found = ingredient(*arguments) if callable(ingredient) else ingredient
    return np.asarray(0.0 if found is None else found, float)


def _combined(problem: Problem, cost: float, ahead: float) -> float:
    """The total cost of a path and its continuation."""
    if not is_tube(problem) or ahead == 0:
        return cost + ahead
    if problem.stopping_cost is None:
        return max(cost, ahead)
    return min(cost, ahead) if problem.running_max is None else cost


def _allowed(solution: Solution) -> float:
    """The allowed difference between cost and V: many estimated errors, plus the cost of interpolating the feedback."""
    extent = _extent(solution)
    if extent == 0:  # a policy without its value, for example constructed by hand
        return math.inf
    algebraic = solution.error
    algebraic = 0.0 if algebraic is None or not math.isfinite(algebraic) else float(algebraic)
    return MANY * (_grid_error(solution) + algebraic) + LEAST * extent


def _extent(solution: Solution) -> float:
    """The range of V at the earliest time."""
    value = np.asarray(solution.value if solution.times is None else solution.value[0])
    finite = value[np.isfinite(value)]
    return float(np.ptp(finite)) if finite.size else math.inf


def _range_of_extremes(problem: Problem, solution: Solution) -> float:
    """The range of ψ and g at the nodes, whose extremes define a tube; V may be constant there."""
    dtype = np.result_type(solution.value)
    when = 0.0 if solution.times is None else float(solution.times[0])
    x = solution.grid.components(dtype)
    ranges = [0.0]
    for ingredient in (problem.stopping_cost, problem.running_max):
        if ingredient is not None and is_tube(problem):
            ranges.append(float(np.ptp(np.asarray(of_state(problem, ingredient, x, when, dtype)))))
    return max(ranges)


def _grid_error(solution: Solution) -> float:
    """The largest estimated discretisation error, or a share of the range of V without an estimate."""
    found = None if solution.grid_error is None else np.asarray(solution.grid_error)
    if found is None or not np.any(np.isfinite(found)):
        return UNKNOWN * _extent(solution)
    return float(np.max(found, where=np.isfinite(found), initial=0.0))
