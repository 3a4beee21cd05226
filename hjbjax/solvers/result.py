"""Construction of a Solution from the last state: NumPy arrays, masks, the Isaacs gap, the message."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import correlated_noise, edges
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.hamiltonian import discrete, exact, optimum
from hjbjax.iteration import certificates, fixed_point
from hjbjax.iteration.certificates import Certificate, ErrorBound
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.iteration.isaacs import isaacs_gap
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST, Labels
from hjbjax.problem.pytree import is_traced
from hjbjax.problem.sets import Box, Simplex, at_bounds
from hjbjax.problem.types import Field, Nodes, Scalar
from hjbjax.solution.clock import CUT, Clock
from hjbjax.solution.solution import Solution, question
from hjbjax.solution.status import Status, warn
from hjbjax.solvers import grid_error
from hjbjax.solvers.arrival import warn_of_no_arrival
from hjbjax.solvers.coarse_levels import CoarserAnswer
from hjbjax.solvers.coarser_answer import SHARE, remaining_error
from hjbjax.solvers.contact import contact_of_solve
from hjbjax.solvers.discontinuities import error_at_discontinuities
from hjbjax.solvers.rest_error import error_at_rest
from hjbjax.solvers.settle import Settled
from hjbjax.solvers.setup import BOUNDING, Assumptions
from hjbjax.well_posedness import earnings, node_checks

GAP = 0.05  # relative to the actions' influence; if Isaacs' condition holds, upwinding left 0.019 on 21 nodes
COARSE = 0.1  # fraction of the range of V: a larger grid error is worth a warning ...
NODES = 0.05  # ... at more than this fraction of the nodes
FLAT = 1e-3  # fraction of max |V|: a smaller range is not a scale for errors
MOST = 2 / 3  # fraction of an end's nodes; ½ is normal: at the end of a position half of the velocities point outwards


def finish(settled: Settled, grid: Grid, cut: bool = False) -> Solution:
    """The solution in NumPy: V is infinite where the target cannot be reached, and u is NaN where no action is taken.

    The Isaacs gap has its own program, and nothing is compiled after a ``cut``.
    """
    task, assumptions, reached, state, code, residuals, origin, _, note = settled
    stopped = cut or code in CUT
    mute = stopped or task.bare  # the actions are unknown
    if not mute:
        _refuse_noise(task, state, grid)
    # V falls by the same amount in every step, which neither the residual nor the number of steps reveals
    earning = None if mute else earnings.earned(task, state)
    code = code if earning is None else Status.DIVERGED
    gap = None if mute else _isaacs_gap(task, state)
    unanswered = mute or code in (Status.DIVERGED, Status.NONFINITE)  # there is no optimal drift
    leaving = None if unanswered else _leaving(task, state)
    touching: dict[str, Any] = {} if unanswered else contact_of_solve(task, state)
    if not mute and code is Status.CONVERGED:
        warn_of_no_arrival(task, state)
    state = jax.device_get(state)
    labels = task.problem.labels
    message = _message(code, task, state, grid) if earning is None else _unbounded_message(earning, grid, labels)
    solution = _assemble(task, state, assumptions)
    lost = ~np.asarray(task.counted)
    arrays = {name: getattr(solution, name) for name in ("value", "policy", "disturbance")}
    # arrays from the device may be read-only
    arrays = {name: None if array is None else np.require(array, requirements="W") for name, array in arrays.items()}
    arrays["value"][lost] = np.inf  # during the iteration these nodes hold a finite number above all others
    idle = lost | np.asarray(task.obstacles.ended) | (not state.progress.has_begun)  # a guess has no policy
    for array in (arrays["policy"], arrays["disturbance"]):
        if array is not None:
            array[idle] = np.nan
    return Solution(
        **arrays,
        enclosure=solution.enclosure,
        grid=grid,
        code=int(code),
        steps=state.progress.steps,
        isaacs_gap=gap,
        reached=reached,
        cut=leaving,
        **touching,
        **question(task.problem),
        residuals=residuals,
        message=" ".join(filter(None, [message, note])),
        monotone_error=None if origin is None else _certified(origin),
        stats={
            **({} if origin is None else {"from_monotone": _apart(state, origin)}),
            "scheme": repr(task.scheme),
            "device": str(jax.devices()[0].device_kind),
            "dtype": str(state.value.dtype),
            "certificate": assumptions.sentence,
            **({} if origin is None else {"high_order_tol": _allowed(task)}),
            **active_bounds(task.on, arrays["policy"]),
            "versions": {"jax": jax.__version__, "numpy": np.__version__},
        },
    )


def active_bounds(on: Discretisation, policy: np.ndarray | None, when: str = "") -> dict[str, str]:
    """The statistic "bounds": the number of nodes at which a bound holds a control that has a cost of higher order.

    A control with an affine cost is at a bound nearly everywhere, so it is left out.
    """
    box, found = on.problem.controls, []
    if policy is None or not isinstance(box, (Box, Simplex)):
        return {}
    counts = at_bounds(box, policy.reshape(-1, box.dim))
    names = on.problem.control_names or [f"u{j + 1}" for j in range(box.dim)]
    for name, pair, curved in zip(names, counts.tolist(), on.players.control.curved, strict=True):
        ends = [f"{count:,} at the {end} bound" for count, end in zip(pair, ("lower", "upper"), strict=True) if count]
        found += [f"{name}: {', '.join(ends)}"] if ends and curved else []
    return {"bounds": f"{'; '.join(found)}, of {on.grid.size:,} nodes{when}"} if found else {}


def _certified(settled: Settled) -> float | None:
    """The certified error bound of a monotone solution, or None."""
    error = _assemble(settled.task, jax.device_get(settled.state), settled.assumptions).error
    return None if error is None else float(error)


def _apart(state: State, origin: Settled) -> float:
    """The largest change from the monotone to the second-order solution, cost units."""
    counted = np.asarray(origin.task.counted)
    return float(np.max(np.abs(np.asarray(state.value) - np.asarray(origin.state.value))[counted], initial=0))


def with_grid_error(solution: Solution, settled: Settled, coarser: CoarserAnswer) -> Solution:
    """The solution with an estimate of its distance to the exact value, and a warning if this is large.

    Without a solution on a coarser grid ``stats["grid_error"]`` has the reason instead.
    """
    value, task = np.asarray(solution.value), settled.task
    if coarser.grid is None or coarser.value is None:
        solution.stats["grid_error"] = coarser.reason
        error = _between_nodes(solution, task, np.zeros_like(value))
        warn_of_grid(error[None], value[None], said="")
        return solution
    origin = settled.origin
    answers = grid_error.TwoGrids(
        solution.grid,
        coarser.grid,
        value,
        coarser.value,
        held=np.broadcast_to(np.asarray(task.obstacles.fixed), value.shape),
        chain=None if origin is None else np.asarray(origin.state.value),
        highest=_highest(settled),
    )
    error = _between_nodes(solution, task, grid_error.estimate_error(answers))
    error += _left(solution, settled, error)
    error[~np.isfinite(value)] = 0
    warn_of_grid(error[None], value[None])
    return dataclasses.replace(solution, grid_error=error)


def _between_nodes(solution: Solution, task: Task, error: np.ndarray) -> np.ndarray:
    """An estimate of the error, at least that of rest points and discontinuities between the nodes, (*grid)."""
    error = np.maximum(error, error.dtype.type(error_at_rest(solution, task, float(np.max(error)))))
    missed = error_at_discontinuities(solution, task)
    return error if missed is None else np.maximum(error, missed.astype(error.dtype))


def warn_of_grid(
    error: np.ndarray, value: np.ndarray, more: str = "nodes", said: str = " (Solution.grid_error)"
) -> None:
    """Warn if the estimated error is above a tenth of the range of V at many nodes at some time.

    Args:
      error: the estimate, (k, *grid), with k = 1 for a stationary solution.
      value: V, (k, *grid); infinite values do not count.
      more: the quantities to increase for a smaller error.
      said: where the solution has the estimate.
    """
    finite = np.isfinite(value)
    if not finite.any():
        return
    least, most = least_and_most(value, finite)
    scale = max(most - least, FLAT * max(abs(least), abs(most)))
    large, nodes = finite & (error > COARSE * scale), tuple(range(1, value.ndim))
    share = float(np.max(np.sum(large, axis=nodes) / np.maximum(np.sum(finite, axis=nodes), 1)))
    if share > NODES:
        warn(
            f"the grid is coarse for this problem: its error is above a tenth of the range of V at {share:.0%} of the "
            f"nodes{said}. Use more {more}, or concentrate nodes where V bends: Grid(..., stretch=)"
        )


def least_and_most(value: np.ndarray, where: np.ndarray) -> tuple[float, float]:
    """The least and the largest of the values at some nodes, without a copy of these values."""
    return float(np.min(value, where=where, initial=np.inf)), float(np.max(value, where=where, initial=-np.inf))


def _highest(settled: Settled) -> float:
    """The largest possible order of the error: the scheme's, or lower for a target smaller than a cell."""
    if grid_error.is_a_point(np.asarray(settled.task.obstacles.ended)):
        return grid_error.LEAST
    return grid_error.FIRST if settled.note else grid_error.SECOND


def _left(solution: Solution, settled: Settled, error: np.ndarray) -> np.ndarray | float:
    """The algebraic error of the iteration, cost units, (*grid) or one number; ``error`` estimates the grid's."""
    known = float(np.asarray(settled.state.progress.best)[0]) if solution.error is None else float(solution.error)
    left = min(known, float(settled.task.tol))
    if solution.error is None and settled.task.weights is not None:
        return remaining_error(settled.task, left, error)
    return left


def solution_at_start(on: Discretisation, value: Nodes, code: Status) -> Solution:
    """The solution of a run that ended before its first step: its initial value, without a policy."""
    problem, value = on.problem, np.asarray(value, on.dtype)
    inputs = [0 if admissible is None else admissible.dim for admissible in (problem.controls, problem.disturbances)]
    nan = np.array(np.nan, value.dtype)  # a broadcast scalar: for 85 million nodes filling an array takes seconds
    policy, disturbance = (np.broadcast_to(nan, (*value.shape, m)) for m in inputs)
    return Solution(
        on.grid, value, policy, disturbance if problem.is_game else None, code=code,
        message=problem.labels.word(code.message),
        **question(problem),
        stats={
            "scheme": repr(on.scheme),
            "device": str(jax.devices()[0].device_kind),
            "dtype": str(value.dtype),
            "certificate": "the value was not evaluated",
            "versions": {"jax": jax.__version__, "numpy": np.__version__},
        },
    )  # fmt: skip


def with_last_phase(solution: Solution, clock: Clock) -> Solution:
    """The solution with the phase in which its run was cut short; also records a late Ctrl-C."""
    if clock.interrupted and solution.status is Status.CONVERGED:
        message = f"It was interrupted after it had finished; the result is complete. {solution.message}"
        return dataclasses.replace(solution, code=int(Status.INTERRUPTED), message=message)
    if solution.status not in CUT:
        return solution
    return dataclasses.replace(solution, message=f"{solution.message} It stopped during {clock.phase}.")


def _assemble(task: Task, state: State, assumptions: Assumptions) -> Solution:
    """The solution for a state, without the parts that require the host; pure, so that it may be traced."""
    problem = task.problem
    controls, disturbances = state.policy.controls, state.policy.disturbances
    xp: Any = jnp if is_traced(state) else np
    policy = xp.stack(controls, axis=-1) if controls else xp.zeros((*task.grid.shape, 0), state.value.dtype)
    return Solution(
        value=state.value,
        policy=None if task.bare else policy,
        disturbance=xp.stack(disturbances, axis=-1) if disturbances else None,
        code=state.progress.code,
        steps=state.progress.steps,
        enclosure=_enclosure(task, state, assumptions),
        grid=task.grid,
        **question(problem),
    )


def _enclosure(task: Task, state: State, assumptions: Assumptions) -> Any:
    """The bounds on V_h, including errors of the optima; None if these are searched, and without a certificate."""
    kind, bound, discount = assumptions.certificate, state.bound, task.problem.discount
    if kind not in BOUNDING or not assumptions.exact:
        return None
    traced = is_traced(state)  # before a solve, the host has checked that costs are convex where they must be
    if any(each.programmed for each in task.on.players.both) or (traced and exact.needs_convexity(task.on)):
        bound = _widened(task, state.value, bound, kind)
        bound = bound if traced else jax.device_get(bound)
    if task.problem.growth is not None:  # a constant shift of V changes the residual by at least the discount
        xp: Any = jnp if traced else np
        bound = dataclasses.replace(bound, below=xp.minimum(bound.below, 0), above=xp.maximum(bound.above, 0))
    return certificates.affine_bounds(kind, bound, discount)


@functools.partial(jax.jit, static_argnames="kind")
def _widened(task: Task, value: Field, bound: ErrorBound, kind: Certificate) -> ErrorBound:
    """The bounds widened by the errors of the optima at free nodes; infinite where costs are not convex."""
    free, lost = task.counted & ~task.given.fixed, exact.may_miss(task.on)
    control, disturbance = (
        jnp.where(free, jnp.where(lost, jnp.inf, each), 0)
        for each in optimum.missed(discrete.around(task.on, value, task.lost))
    )
    missed = (control, disturbance)
    return certificates.widen_bounds(kind, bound, missed, discount=task.problem.discount, least_cost=task.least_cost)


def _leaving(task: Task, state: State) -> np.ndarray:
    """The number of nodes at which the optimal drift is cut off, (n, 2)."""
    value, policy, obstacles, counted = jax.device_get((state.value, state.policy, task.obstacles, task.counted))
    u, d = (list(players) for players in (policy.controls, policy.disturbances))
    return edges.cut(task.problem, task.grid, value, (u, d), counted & obstacles.acting(value))[0]


def warn_of_cuts(cut: np.ndarray, ends: np.ndarray, grid: Grid) -> None:
    """Warn of ends at more than ``MOST`` of whose nodes the optimal drift is cut off; both arrays (n, 2)."""
    most = [
        f"the {('lower', 'upper')[side]} end of {grid.names[axis]} ({cut[axis, side]} of {ends[axis, side]} nodes)"
        for axis, side in np.argwhere(cut > MOST * ends)
    ]
    if most:
        warn(
            f"the optimal drift leaves the box and is cut off at {', '.join(most)}, as if there were a wall. "
            "Near this boundary the value does not solve your problem. Use a larger box, or "
            "Grid(..., edges='constrained') or 'open'"
        )


@jax.jit
def _lacking(task: Task, controls: tuple, disturbances: tuple) -> jax.Array:
    """The flat index of the first node where the policy's noise is correlated more than the spacings allow, or −1."""
    lacking = correlated_noise.lacking(task.on, task.on.diffusion(list(controls), list(disturbances)))
    if lacking is None:
        return jnp.full((), -1)
    lacking = jnp.broadcast_to(lacking, task.grid.shape) & task.counted & ~task.obstacles.fixed
    return jnp.where(jnp.any(lacking), jnp.argmax(lacking), -1)


def _refuse_noise(task: Task, state: State, grid: Grid) -> None:
    """Refuse noise that no chain can represent under the optimal actions; the samples may not have included these."""
    if not callable(task.problem.noise) or not task.on.players.steers_noise:
        return
    policy = state.policy
    # the checks before a solve use samples of the actions; the exact minimum may lie between them
    first = int(_lacking(task, policy.controls, policy.disturbances))
    if first < 0:
        return
    index = tuple(int(i) for i in np.unravel_index(first, grid.shape))
    x, u, d = (
        grid.state(index),
        *(np.array([a[index] for a in each]) for each in (policy.controls, policy.disturbances)),
    )
    sigma = np.asarray(task.problem.diffusion(x, u, d, 0.0), dtype=float)
    played = "".join(f", {letter} = {action.tolist()}" for letter, action in (("u", u), ("d", d)) if action.size)
    raise ValueError(
        "noise: correlated noise that the chain cannot represent with non-negative probabilities under the policy "
        f"that was found, first at node {index}, x = {np.asarray(x).tolist()}{played}.\n"
        + correlated_noise.advice(task.on, sigma @ sigma.T, node_checks.representatives(task.problem, u, d))
    )


def warn_of_gap(gap: float, matter: float, isaacs: str) -> None:
    """Warn of a gap that is large relative to the influence of the actions; upwinding causes a gap of order h."""
    if gap > GAP * matter:
        warn(
            f"the Isaacs condition fails: min max and max min of the Hamiltonian differ by up to {gap:.3g} per unit "
            f"time, {gap / matter:.0%} of the influence of the actions; the value is the {isaacs} one, isaacs= selects "
            "the other"
        )


@jax.jit
def _gap_at(task: Task, value: Field) -> tuple[Scalar, Scalar]:
    """The Isaacs gap of a stationary game at V, and the influence of the actions, at free nodes."""
    hamiltonian = discrete.around(task.on, value, task.lost)
    return isaacs_gap(hamiltonian, task.counted & ~task.obstacles.fixed)


def _isaacs_gap(task: Task, state: State) -> float | None:
    """The gap at the last state, with a warning if it is large; None without a game."""
    if not task.problem.is_game:
        return None
    gap, matter = (float(number) for number in _gap_at(task, state.value))
    warn_of_gap(gap, matter, task.problem.isaacs)
    return gap


def _unbounded_message(earning: earnings.Earning, grid: Grid, labels: Labels) -> str:
    """The message for a value of −∞, or a reward of ∞, with a place where a policy earns indefinitely."""
    state = ", ".join(f"{x:.4g}" for x in grid.state(earning.node))
    costs = labels.payoff == COST
    infinite, mean, sign = ("−∞", earning.mean, "negative") if costs else ("∞", -earning.mean, "positive")
    return (
        f"The value is {infinite}: without discount, a policy can stay indefinitely where its mean {labels.payoff} is "
        f"{mean:.3g} per unit time, for example near x = ({state}). Add a discount > 0, a horizon (march), or a "
        f"running {labels.payoff} that is not {sign} there."
    )


_broken = jax.jit(fixed_point.nonfinite_nodes)


def _not_finite_message(task: Task, state: State, grid: Grid) -> str:
    """The message for NaN or infinity, with the place, found by repeating the step that caused it."""
    # the state holds the last finite value, which does not show where the fault began
    bad = np.asarray(_broken(task, state))
    steps = state.progress.steps
    when = f"in step {steps}" if steps else "at the guess"
    kept = "the last finite value is kept"
    discount, left = float(np.asarray(task.problem.discount)), float(np.max(np.abs(state.policy.defect)))
    if 0 < discount < 1 and left > discount * float(np.finfo(np.float32).max):  # sweeps run in single precision
        return (
            f"Infinity appeared {when} and {kept}: discount = {discount:.3g} is so small that the remaining residual, "
            f"{left:.3g} per unit time, divided by it overflows; use a larger discount, or 0 and a target."
        )
    if not np.any(bad):
        return f"NaN or infinity appeared {when} and {kept}; check drift and {task.problem.payoff}."
    index = tuple(int(i) for i in np.unravel_index(int(np.argmax(bad)), bad.shape))
    x = ", ".join(f"{entry:.6g}" for entry in grid.state(index))
    return (
        f"NaN or infinity appeared {when} and {kept}: at {int(bad.sum())} of {bad.size} nodes, first at node {index}, "
        f"x = [{x}]; check drift and {task.problem.payoff} there."
    )


def within_reach(best: float) -> str:
    """The sentence for a certified solve that stalled, with a tolerance that is within reach."""
    return f"{Status.STALLED.message} The smallest error was {best:.2g}: a tolerance of {2 * best:.2g} is within reach."


def _allowed(task: Task) -> str:
    """The tolerance of a high-order solution: a number, or a share of the grid error."""
    tol, strict = float(task.tol), float(np.asarray(task.weights)[0]) == 1
    return f"{tol:.2g}" if strict else f"{SHARE:.0%} of the estimated grid error"


def _message(code: Status, task: Task, state: State, grid: Grid) -> str:
    """The sentence with the outcome of a solve and a remedy."""
    if code is Status.NONFINITE:
        return _not_finite_message(task, state, grid)
    # the certificates that do not bound the error cannot promise that a smaller tolerance is within reach
    best, tol = float(np.asarray(state.progress.best)[0]), float(task.tol)
    certified = task.certificate not in (Certificate.NONE, Certificate.RESIDUAL, Certificate.OPEN)
    if code is Status.STALLED and np.isfinite(best) and certified:
        return within_reach(best)
    if code is Status.STALLED and np.isfinite(best):
        wider = "" if np.asarray(state.progress.best).itemsize == 8 else ", or compute in float64"
        return (
            f"Residual and last step stopped decreasing at {best:.2g}, above the tolerance, and no certificate bounds "
            f"the error; add a discount, some noise or a better guess, increase tol{wider}."
        )
    if code is Status.CONVERGED and task.certificate is Certificate.NONE and task.constrained:
        return "The value no longer changes, up to rounding; no certificate bounds the error."
    if code is Status.CONVERGED and task.certificate in (Certificate.NONE, Certificate.OPEN):
        return f"Residual and last step are at most {tol:.2g}; no certificate bounds the error."
    if code is Status.CONVERGED and task.certificate is Certificate.RESIDUAL:
        return (
            f"Residual of the high-order equation and distance to its limit are at most {_allowed(task)} in "
            f"{task.problem.payoff} units."
        )
    return task.problem.labels.word(code.message)
