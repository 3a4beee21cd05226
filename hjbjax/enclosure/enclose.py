"""``enclose``: two functions between which the value of the continuous problem lies, with proof."""

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hjbjax.enclosure import branches, checks, correction, defect, exits
from hjbjax.enclosure.bounds import Enclosure
from hjbjax.enclosure.discounted import DiscountTask
from hjbjax.enclosure.interpolant import LARGEST, Spline
from hjbjax.enclosure.undiscounted import exit_task
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import REWARD
from hjbjax.problem.problem import Problem, is_constrained, is_discounted
from hjbjax.problem.pytree import front_door
from hjbjax.problem.rewards import costs_of
from hjbjax.problem.sets import Finite
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import in_unit_box
from hjbjax.solution.rewards import in_costs
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status
from hjbjax.solvers import memory
from hjbjax.tracing import closures
from hjbjax.tracing.operations import operations
from hjbjax.tracing.taylor_forms import traced


@front_door
def enclose(
    problem: Problem,
    solution: Solution,
    *,
    region: Sequence | np.ndarray | None = None,
    tol: float = 1e-3,
    rounds: int = 8,
    max_memory: int | None = None,
) -> Enclosure:
    """Bounds on the value of the continuous problem, with proof: neither the grid nor rounding is neglected.

    A spline W near the solution has the defect β W − H(x, DW). If it is at most β k everywhere, V ≥ W − k; if it is at
    least −β k, V ≤ W + k. The defect is bounded over whole cells by interval arithmetic with outward rounding. Then W
    is corrected where its defect is large, separately for both bounds, and checked again.

    Without a discount the paths must end at a target, and the running cost must be positive elsewhere. The defect then
    counts relative to the running cost, and the bounds are functions of W with slopes near one.

    The bounds are those of the problem with the ends of its grid: projected ends are walls that stop outward motion.

    Args:
      problem: one player or a game, either a discount or a target, no noise, jumps, modes or obstacles. In a game drift
        and cost must be quadratic polynomials of the inputs, or the sets finite. Drift, costs and discount must be
        Lipschitz functions of the state that are defined on the whole box. On a periodic axis they must be periodic.
      solution: a solution of this problem by ``solve``. The bounds hold for any solution; they are narrow for a good
        one.

    Keyword Args:
      region: where narrow bounds are wanted: a pair (lower corner, upper corner), or a mask of the nodes, bool (*grid).
        Corrections are chosen for this region and end once the bounds are narrow there. The bounds hold everywhere.
      tol: the wanted mean width in the region, relative to the range of V there.
      rounds: the largest number of corrections per bound.
      max_memory: the number of bytes that count as free.

    Returns:
      An Enclosure.

    Raises:
      ValueError: the problem has an ingredient for which there is no proof, or a function without an interval rule.
      MemoryError: the estimated memory is not free.

    Example:
      >>> import hjbjax as hjb
      >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-2.0], [2.0]), discount=1.0)
      >>> found = hjb.enclose(problem, hjb.solve(problem, hjb.Grid([-1.0], [1.0], (41,))))
      >>> exact = (5**0.5 - 1) / 2 * 0.5**2  # the Riccati equation
      >>> bool(found.lower_at([0.5]) <= exact <= found.upper_at([0.5]))
      True
    """
    start = time.perf_counter()
    own, value, grid = _checked(problem, solution)
    arguments.positive(tol, "enclose: tol")
    count = arguments.count(rounds, "enclose: rounds")
    needed = memory.fitting(_peak_bytes(own, grid, count), grid, max_memory)
    chosen = _chosen(region, grid)
    scale = float(np.ptp(value[chosen])) or 1.0
    with own_settings(x64=True):
        spline = Spline.on(grid)
        if own.target is None:
            blocks = defect.blocks(own, grid, spline, defect.all_cells(spline), 0)
            task = DiscountTask(own, grid, spline, blocks, scale * tol, chosen)
            bound: Callable[..., Any] = functools.partial(branches.bound, task)
        else:
            task = exit_task(own, grid, spline, value, chosen, scale * tol)
            bound = task.bound
        first, move = task.corrected(value)
        bounds = [bound(first, move, sign, count) for sign in (1, -1)]
        remaining = task.remaining(bounds[1][0])
    if problem.payoff == REWARD:
        bounds = [(each.negative(), sizes) for each, sizes in reversed(bounds)]
    (lower, below), (upper, above) = bounds
    nodes = grid.nodes().reshape(-1, grid.ndim)
    low, high = (each.at(nodes).reshape(grid.shape) for each in (lower, upper))
    width = (high - low)[chosen]
    known = np.isfinite(width)
    share, infinite = float(np.mean(width[known])) / scale if np.any(known) else np.inf, float(np.mean(~known))
    stats = {"seconds": time.perf_counter() - start, "bytes": needed, "corrections": len(lower.levels + upper.levels)}
    status = Status.CONVERGED if share <= tol and not infinite else Status.MAX_STEPS
    message = _message(solution.grid, share, infinite, tol, region is not None)
    return Enclosure(
        solution.grid, low, high, status, message, stats, remaining,
        np.stack([below, above]), (lower, upper),
    )  # fmt: skip


def _checked(problem: Problem, solution: Solution) -> tuple[Problem, np.ndarray, Grid]:
    """The problem with costs and its numbers settled, the value as a cost, and the grid.

    Raises:
      ValueError: there is no proof for the problem, its grid or its solution.
    """
    checks.check_types("enclose", problem, solution)
    grid, costs = solution.grid, in_costs(solution)
    others = {
        "a target with a discount": problem.target is not None and bool(is_discounted(problem)),
        "time_dependent=True": problem.time_dependent,
        "a stopping_cost, a stopping_reward or a running_max": is_constrained(problem)
        or problem.stopping_reward is not None,
        "no discount and no target": problem.target is None and not is_discounted(problem),
        "a marched solution": solution.times is not None,
    }
    wanted = (
        "a stationary problem whose paths are not random,\n"
        "with a discount or with a target. Bounds on the true value are proved only for these problems;\n"
        "Solution.grid_error and box_error are estimates for the others"
    )
    advice = (
        ". Solve on a larger box\nwith edges='projected': the bounds are those of the problem with walls at its ends"
    )
    checks.check_ingredients("enclose", problem, grid, others, wanted, advice)
    value = np.asarray(costs.value, float)
    if problem.target is not None and value.shape == grid.shape and np.any(np.isfinite(value)):
        value = correction.nearest_known(value, np.isfinite(value), grid)  # infinite where no path meets the target
    if value.shape != grid.shape or not np.all(np.abs(value) <= LARGEST):
        raise ValueError(
            f"enclose: got a value of shape {value.shape}; wanted {grid.shape}, without numbers that are not finite\n"
            f"or above {LARGEST:g}"
        )
    known = in_unit_box(closures.settled(costs_of(problem), grid.ndim), grid.ndim)
    return known, value, grid


def _chosen(region: Any, grid: Grid) -> np.ndarray:
    """True at the nodes of a region, shape (*grid).

    Raises:
      ValueError: the region is neither a box nor a mask of the nodes, or has no nodes.
    """
    if region is None:
        return np.ones(grid.shape, bool)
    array = np.asarray(region)
    if array.dtype == bool and array.shape == grid.shape:
        found = array
    elif array.dtype != bool and array.shape == (2, grid.ndim):
        nodes = grid.nodes()
        found = np.all((nodes >= array[0]) & (nodes <= array[1]), axis=-1)
    else:
        raise ValueError(
            f"enclose: got a region of shape {array.shape} and type {array.dtype}; wanted a pair of corners (lo, hi)\n"
            f"of {grid.ndim} numbers each, or a mask of the nodes, bool {grid.shape}"
        )
    if not np.any(found):
        raise ValueError("enclose: got a region that contains no node; wanted a larger one")
    return found


def _peak_bytes(problem: Problem, grid: Grid, rounds: int) -> int:
    """Bytes that ``enclose`` uses at its peak: all scalars of one block of cells, and arrays at all nodes.

    These are the weights of the spline, the functions of the problem, the factors of the chain and the candidates.
    """
    n, m = grid.ndim, 0 if problem.controls is None else problem.controls.dim
    arguments: list[list[float]] = [[0.0] * n, [0.0] * m]
    if problem.disturbances is not None:
        arguments.append([0.0] * problem.disturbances.dim)
    counts = [operations(traced(each, *arguments)) for each in (problem.drift, problem.cost) if each is not None]
    scalars = 60 + sum(each.single + each.whole for each in counts)
    # range, centre, slopes, gradient and second derivatives, each with two bounds
    scalar = 8 * 2 * (2 + 2 * n + n * (n + 1) // 2)
    block = scalar * min(grid.size, defect.BLOCK) * scalars
    terms = 1
    for each in (problem.controls, problem.disturbances):
        terms *= len(each.points) if isinstance(each, Finite) else 1 + (0 if each is None else each.dim)
    known = scalar * (2 + (n + 1) * terms) + 8 * 27 * n
    if problem.target is not None:  # the parts of the cells along a boundary as large as that of the box
        known *= 1 + 2 ** (exits.DEPTH * n) * 2 * n / min(grid.shape)
    fill = 31 * np.log2(grid.size + 2) if n <= correction.DIRECT else 20
    candidates = rounds * (2 + 2 * n * branches.MORE)
    return int(block + grid.size * (12 * fill + 8 * (30 + candidates) + known))


def _message(grid: Grid, share: float, infinite: float, tol: float, is_part: bool) -> str:
    """The statement that is proved, and its width."""
    with_walls = bool(grid.sides("projected"))
    which = "the problem with walls at the projected ends of the box" if with_walls else "the continuous problem"
    end = "" if share <= tol else f", above tol = {tol:g}: use more nodes, or a better solution"
    width = f"their mean width{' in the region' * is_part} is {share:.2g} of the range of V"
    if infinite:
        width += f" where both are finite; one of them is infinite at {100 * infinite:.2g} % of the nodes"
    return f"The value of {which} lies between the bounds; {width}{end}."
