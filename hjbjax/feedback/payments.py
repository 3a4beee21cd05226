"""What a path pays beside its running cost, and what V promised: where it stops, what is due at its end, and tubes.

    cost = ∫ e^{−βt} L dt + e^{−βτ} · { exit cost on the target; ψ where V = ψ; V(T, ·) at the horizon T of a march }

V(T, ·) is what ``march`` assumed: ``start``, else the terminal cost, else ψ, else g, and never more than ψ. Without
running cost and noise nothing accumulates along a path, and its cost is that of the best moment to stop,

    cost = min over s of max{ e^{−βs} ψ(x(s)), max over r ≤ s of g(x(r)) },

which is the value of a tube along the path. A path need not end at that moment.
"""

import contextlib
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.path import Path, PathStatus
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, State
from hjbjax.solution.interpolation import Samples, between, query
from hjbjax.solution.solution import Solution
from hjbjax.tracing.closures import settled
from hjbjax.tracing.components import of_state

MANY = 10  # estimated errors: a path that misses V by more breaks its promise
LEAST = 0.02  # of the range of V: what a feedback between the nodes may cost more
UNKNOWN = 0.02  # of the range of V: taken for the error of a value without an estimate
STILL = 1e-6  # of the box, in the second half of a path that is at rest
RESTS, SLOWS = 1e-3, 1e-2  # of the box, and of the way in the first half, of one that comes to rest
AWAY, BACK = 0.5, 0.1  # of the extent of its second half, for a path that goes round inside of a cell
SAME = 1e-5  # two problems are one whose numbers at a state differ by no more
FAR = 1.5  # cells: a path that goes round leaves a state by more, and comes back within one


@pytree_dataclass()
class Lookup:
    """A function known at the nodes, multilinear between them; called with (t, x), outside that of the nearest point.

    Args:
      grid: the nodes.
      values: shape (*grid), with times (k, *grid).
      times: the kept times of a march, or None.
    """

    grid: Grid
    values: Any
    times: Any = None

    def __call__(self, t: Number, x: State) -> Array:
        """The value, a number."""
        when = None if self.times is None else t
        samples = Samples(self.grid, self.values, self.times)
        return query(between, samples, x, when, clamp=True, name="simulate")


def solution_of(feedback: object) -> Solution | None:
    """The solution that is a feedback, or from which one comes."""
    solution = feedback if isinstance(feedback, Solution) else getattr(feedback, "solution", None)
    return solution if isinstance(solution, Solution) else None


def is_tube(problem: Problem) -> bool:
    """True if the cost of a path is an extreme along it: a running maximum, or a price of stopping and nothing else.

    With noise the moment to stop must not depend on what follows, so that only a running maximum is an extreme.
    """
    if problem.running_max is not None:
        return True
    return problem.stopping_cost is not None and problem.cost is None and problem.noise is None


def surplus(problem: Problem, feedback: object) -> Lookup | None:
    """ψ − V between the nodes, zero where one had better stop; None where no path is stopped.

    It is zero where V = ψ at every node around, at both kept times around in a march.
    """
    solution = solution_of(feedback)
    if problem.stopping_cost is None or is_tube(problem) or solution is None:
        return None
    known = not is_traced(problem, solution)
    # inside somebody's jit a constant must come out, in the precision of the solution
    double = np.result_type(solution.value) == np.float64 if known else None
    folded: Any = jax.ensure_compile_time_eval() if known else contextlib.nullcontext()
    with folded, own_settings(x64=double):
        found = _surplus(problem, solution)
        return Lookup(solution.grid, np.asarray(found) if known else found, solution.times)


def _surplus(problem: Problem, solution: Solution) -> jax.Array:
    """ψ − V at the nodes, and at all kept times; with noise its root."""
    value, grid = jnp.asarray(solution.value), solution.grid
    # as in a solve: 1 + c in single precision is another number, and V is not ψ
    problem = cast(settled(problem, grid.ndim, value.dtype), value.dtype)
    x = grid.components(value.dtype)

    def price(t: Number) -> jax.Array:
        found = of_state(problem, problem.stopping_cost, x, t, value.dtype)
        return jnp.broadcast_to(jnp.asarray(found, value.dtype), grid.shape)

    moving = problem.time_dependent and solution.times is not None
    paid = jax.lax.map(price, jnp.asarray(solution.times, value.dtype)) if moving else price(0.0)
    rounding = 16 * jnp.finfo(value.dtype).eps * jnp.max(jnp.where(jnp.isfinite(value), jnp.abs(value), 0))
    left = paid - value - rounding
    left = jnp.where(jnp.isnan(left), jnp.inf, left)  # neither stops nor arrives
    if problem.noise is None:
        return left
    # V fits ψ smoothly, so that ψ − V grows as the square of the distance, of which a bridge between two steps asks
    return jnp.sqrt(jnp.maximum(left, 0))


def value_at_horizon(solution: object) -> Lookup | None:
    """V at the horizon of a march from ``start=``; None where the problem itself says what is due there."""
    found = solution_of(solution)
    if found is None or not found.stats.get("start", False):
        return None
    return Lookup(found.grid, found.value[-1])


def promise(feedback: object, start: Array, t: float = 0.0) -> float | None:
    """V at a state, by the solution of a feedback; None where there is none."""
    solution = solution_of(feedback)
    if solution is None:
        return None
    where = (start,) if solution.times is None else (t, start)
    value = float(solution.value_at(*where, clamp=True))
    return value if math.isfinite(value) else None


def still_ahead(problem: Problem, feedback: object, path: Path, *, to_horizon: bool) -> float | None:
    """What V says is still to be paid after a path that is cut short, discounted to its start.

    A path that rests or goes round outside the target, without a discount, never gets what V promised: nothing is
    ahead. None where V says nothing of what follows.

    Args:
      problem: what is simulated.
      feedback: whose solution knows V.
      path: NumPy arrays.
      to_horizon: True if it lasts as long as the horizon of a march.
    """
    if path.status is PathStatus.TARGET or to_horizon:
        return 0.0
    if path.status is not PathStatus.DURATION:
        return None
    solution, end, beta = solution_of(feedback), float(path.times[-1]), float(problem.discount)
    assert solution is not None
    if beta == 0 and solution.times is None and (_rests(path, solution.grid) or _goes_round(path, solution)):
        return 0.0
    value = promise(feedback, path.states[-1], end)
    return None if value is None else math.exp(-beta * end) * value


def _rests(path: Path, grid: Grid) -> bool:
    """True if a path comes to rest: in its second half it hardly moves, next to the box and to its first half."""
    middle, box = len(path.states) // 2, np.asarray(grid.hi) - np.asarray(grid.lo)
    early, late = (np.max(np.ptp(part, axis=0) / box) for part in (path.states[: middle + 1], path.states[middle:]))
    return bool(late <= STILL or (late <= RESTS and late <= SLOWS * early))


def _goes_round(path: Path, solution: Solution) -> bool:
    """True if a path comes back in its second half to where it was, and V fell by no more than its error since."""
    grid, late = solution.grid, path.states[len(path.states) // 2 :]
    value = solution.value_at(late, clamp=True)
    if not value[0] - value[-1] <= _grid_error(solution):
        return False
    width = np.asarray(grid.hi) - np.asarray(grid.lo)
    apart = np.abs(late - late[-1])
    apart = np.where(np.array(grid.periodic), np.minimum(apart % width, -apart % width), apart)
    cells = np.max(apart / (width / (np.array(grid.shape) - 1)), axis=1)
    # a small orbit, inside of a cell, is measured by its own size
    return _comes_back(cells, FAR, 1) or _comes_back(cells / max(np.max(cells), 1e-300), AWAY, BACK)


def _comes_back(apart: np.ndarray, far: float, near: float) -> bool:
    """True if distances from the last state were small before the last time that they were large."""
    away = np.flatnonzero(apart > far)
    return bool(away.size and np.any(apart[: away[-1]] <= near))


def broken_promise(
    problem: Problem, feedback: object, path: Path, *, to_horizon: bool, worst_case: bool = True
) -> str | None:
    """A sentence on a path whose cost is not what V promised, by many times the estimated error; or None.

    Args:
      problem: what is simulated.
      feedback: whose solution knows V.
      path: NumPy arrays, with ``promised``.
      to_horizon: True if it lasts as long as the horizon of a march.
      worst_case: True if the disturbance is the solution's own: another one may leave a path cheaper.
    """
    solution = solution_of(feedback)
    # one noisy path says nothing of a mean
    if path.promised is None or solution is None or problem.noise is not None:
        return None
    states = path.states
    free = np.array(solution.grid.periodic)
    inside = (states >= solution.grid.lo) & (states <= solution.grid.hi) | free
    ahead = still_ahead(problem, feedback, path, to_horizon=to_horizon)
    if ahead is None or not np.all(inside[:-1]):
        return None
    total = _combined(problem, float(path.cost), ahead)
    off = total - path.promised
    if off <= 0 and not worst_case:
        return None
    if abs(off) <= _allowed(solution) or abs(off) <= LEAST * _range_of_extremes(problem, solution):
        return None
    if not _is_answer_to(problem, solution, path):
        return None
    further = "" if ahead == 0 else f" with what V says of the time after, {ahead:.4g},"
    advice = (
        "the feedback does not do what V assumes: a finer grid, another scheme, a running cost or a discount helps"
        if off > 0
        else "V is too large there: a finer grid or a larger box helps"
    )
    return f"the path costs {path.cost:.6g},{further} and V promised {path.promised:.6g}: {advice}"


def _is_answer_to(problem: Problem, solution: Solution, path: Path) -> bool:
    """True if V belongs to the problem that is simulated: both problems say the same of the first state of the path.

    V of another problem, such as one with a nominal drift or another cost, promises nothing.
    """
    posed = solution.problem
    if posed is None:  # of a file, or made by hand
        return True
    if (posed.is_game, posed.time_dependent) != (problem.is_game, problem.time_dependent) or not len(path.controls):
        return False
    x, d = jnp.asarray(path.states[0]), None if path.disturbances is None else jnp.asarray(path.disturbances[0])
    played = problem.arguments(x, jnp.asarray(path.controls[0]), d, 0.0)
    alone = problem.state_arguments(x, 0.0)
    for arguments, names in (
        (played, ("drift", "cost")),
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
    """The cost of a path with what follows it."""
    if not is_tube(problem) or ahead == 0:
        return cost + ahead
    if problem.stopping_cost is None:
        return max(cost, ahead)
    return min(cost, ahead) if problem.running_max is None else cost


def _allowed(solution: Solution) -> float:
    """By how much a path may miss V: many times the estimated error, and what a feedback between the nodes costs."""
    extent = _extent(solution)
    if extent == 0:  # of a policy without its value, as one made by hand
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
    """The range of ψ and g at the nodes, of which a tube takes extremes: V may be the same at all of them."""
    dtype = np.result_type(solution.value)
    when = 0.0 if solution.times is None else float(solution.times[0])
    x = solution.grid.components(dtype)
    ranges = [0.0]
    for ingredient in (problem.stopping_cost, problem.running_max):
        if ingredient is not None and is_tube(problem):
            ranges.append(float(np.ptp(np.asarray(of_state(problem, ingredient, x, when, dtype)))))
    return max(ranges)


def _grid_error(solution: Solution) -> float:
    """The largest estimated error of the spacing, or a share of the range of V without an estimate."""
    found = None if solution.grid_error is None else np.asarray(solution.grid_error)
    if found is None or not np.any(np.isfinite(found)):
        return UNKNOWN * _extent(solution)
    return float(np.max(found, where=np.isfinite(found), initial=0.0))
