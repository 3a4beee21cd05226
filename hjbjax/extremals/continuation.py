"""Solve the boundary-value problem of an extremal with a continuous control, directly or by continuation.

The collocation starts from the initial guess. If it fails, it starts from the solution of easier problems: a start
closer to the rest point of an infinite horizon, a shorter horizon, or a prescribed final time instead of a free one.
The last attempt starts from the path under a constant control. An infinite horizon is extended until the path has
settled. A solution is checked against the necessary conditions before it counts as converged.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals import initial_guess, necessary_conditions, second_order
from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing, Limits
from hjbjax.extremals.collocation import collocate, split_at_seams
from hjbjax.extremals.necessary_conditions import Extremal, assemble_extremal, entry_time, last_iterate, only_touches
from hjbjax.problem.labels import COST
from hjbjax.problem.types import Array, Number, State
from hjbjax.solution.clock import CUT, Stopped
from hjbjax.solution.status import Status

SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)  # steps of the continuation
SPANS = (1.0, 2.0, 0.5, 4.0)  # prescribed final times over the guess of a free one
HUGE = 1e6  # times the guess: a solution that grows so much has diverged
SETTLED = 1e-3  # distance to rest relative to x₀ at which the quadratic value is trusted; its error is cubic
STILL = 1e-10  # squared distance to rest, relative to |x₀|² and |x̄|², that counts as zero
LONGER, EXTENSIONS = 1.5, 6  # factor and maximal number of extensions of an infinite horizon
GAP = 1e-6  # tolerance for the excess of the Hamiltonian over its minimum, relative to its terms
ENDINGS = {1: Status.MAX_STEPS, 2: Status.DIVERGED, 3: Status.STALLED}
ADVICE = {
    Status.MAX_STEPS: "the mesh reached max_nodes; raise max_nodes, loosen tol, or give a better guess",
    Status.DIVERGED: "its Jacobian became singular: there is no extremal near the guess that meets the end conditions",
    Status.STALLED: "the end conditions cannot be met to tol; give another guess",
    Status.NONFINITE: "NaN or infinity occurred; check drift, cost and terminal there, or give a better guess",
}


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The last iterate of a boundary-value problem, and how its solve ended.

    Args:
      bvp: the boundary-value problem.
      s: the mesh on [0, 1].
      y: (x, p, w) of all arcs on the mesh, shape (k·(2n+1), len(s)).
      theta: the unknown parameters: durations, and ν.
      code: the status.
      trouble: the reason for a failure, in words; empty if solved.
    """

    bvp: BoundaryValueProblem
    s: np.ndarray
    y: np.ndarray
    theta: np.ndarray
    code: Status
    trouble: str = ""

    @property
    def solved(self) -> bool:
        """True if the collocation converged."""
        return self.code is Status.CONVERGED

    @property
    def times(self) -> np.ndarray:
        """The mesh in units of time, for one arc."""
        return self.s * self.horizon

    @property
    def lengths(self) -> np.ndarray:
        """The durations of the arcs."""
        return np.asarray(self.bvp.durations(np.asarray(self.theta)))

    @property
    def horizon(self) -> float:
        """The final time."""
        return float(np.sum(self.lengths))


def attempt(bvp: BoundaryValueProblem, s: Array, y: Array, theta: Array, limits: Limits) -> Outcome:
    """Run one collocation and translate its status; ``Stopped`` carries the last iterate."""
    guess = np.asarray(theta, float)
    try:
        result = collocate(bvp, s, y, guess, limits)
    except Stopped as stop:
        mesh, last, sought = stop.reached
        raise Stopped(stop.status, Outcome(bvp, mesh, last, sought, stop.status)) from None
    # SciPy returns None if there are no unknown parameters
    sought = np.zeros(0) if result.p is None else result.p
    code = Status.CONVERGED if result.success else ENDINGS[result.status]
    if not (np.all(np.isfinite(result.y)) and np.all(np.isfinite(sought))):
        code = Status.NONFINITE
    elif np.max(np.abs(result.y / result.units)) > HUGE * (1 + np.max(np.abs(y / result.units))):
        code = Status.DIVERGED  # a jump that the mesh cannot resolve may look like a solution
    trouble = "" if code is Status.CONVERGED else f"the boundary-value problem was not solved: {ADVICE[code]}"
    found = Outcome(bvp, result.x, result.y, sought, code, trouble)
    # an extremal with negative time may meet its end conditions as well; ``not >`` catches NaN, too
    if found.solved and not found.horizon > 0:
        return dataclasses.replace(
            found, code=Status.DIVERGED, trouble=f"the final time came out as {found.horizon:.3g}; give a better guess"
        )
    return found


def carry_on(found: Outcome, limits: Limits) -> None:
    """Check the clock between two programs that need compilation; ``Stopped`` carries the outcome."""
    code = limits.clock.over()
    if code is not None:
        raise Stopped(code, dataclasses.replace(found, code=code))


def solve_smooth(
    bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, limits: Limits, *, trusted: bool
) -> Outcome:
    """Solve for the extremal of a Hamiltonian whose minimiser is continuous.

    Args:
      bvp: the boundary-value problem.
      times: increasing from 0.
      columns: the guess at these times, shape (2n+1, len(times)).
      limits: the limits of the solve.
      trusted: True if the user gave the guess, so that easier problems would lead away from it.
    """
    apart = split_at_seams(bvp, times, columns)
    if apart is not None:
        # keep only ν, because the durations of all arcs replace a free final time
        multiplier = unknowns(bvp, times, columns)[int(bvp.timed) :]
        return _refuse_unsettled(attempt(*apart[:3], np.append(apart[3], multiplier), limits))
    found = _attempt_by_times(bvp, times, columns, limits, trusted=trusted)
    # the direct attempt comes first, because a continuation costs up to five solves
    if not found.solved and not trusted:
        found = _by_continuation(found, limits)
    reaching = bvp.closing in (Closing.STATE, Closing.TARGET) and not trusted
    if not found.solved and reaching and necessary_conditions.is_smooth_at_start(bvp):
        carry_on(found, limits)
        other = initial_guess.under_constant_control(bvp, times[-1])
        again = _attempt_by_times(bvp, *other, limits, trusted=False)
        found = again if again.solved else found
    if bvp.closing is Closing.REST:
        found = _lengthen(found, limits)
    return found


def _attempt_by_times(
    bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, limits: Limits, *, trusted: bool
) -> Outcome:
    """Run one collocation from a guess; if it fails, start from solutions with prescribed final times.

    With a prescribed time the costate is determined even from a bad guess, as in linear equations. The condition of a
    free time has no slope at a zero costate.
    """
    s, failed = times / times[-1], attempt(bvp, times / times[-1], columns, unknowns(bvp, times, columns), limits)
    if failed.solved or trusted or not (bvp.free or bvp.closing is Closing.STATE):
        return failed
    for span in SPANS[not bvp.free :]:
        carry_on(failed, limits)
        given = dataclasses.replace(bvp, free=False, horizon=span * times[-1])
        found = attempt(given, s, columns, unknowns(given, times, columns), limits.rough)
        if found.solved:
            theta = np.append([found.horizon] * bvp.free, found.theta)
            found = attempt(bvp, found.s, found.y, theta, limits)
            if found.solved:
                return found
    return failed


def unknowns(bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Initial guesses of the final time and of ν; ν fits p(T) = ψ_x + ν l_x to the guess."""
    theta = [times[-1]] * bvp.timed
    if bvp.closing is Closing.TARGET:
        theta.append(float(_multiplier(bvp, times[-1], columns[:, -1])))
    return np.array(theta)


@jax.jit
def _multiplier(bvp: BoundaryValueProblem, t: Number, z: Array) -> jax.Array:
    """The ν that minimises |p − ψ_x − ν l_x| at the end of a guess."""
    x, p, _ = bvp.split(z)
    slope, normal = jax.grad(bvp.psi, 1)(t, x), jax.grad(bvp.level, 1)(t, x)
    # at an end off the boundary of the target, l may be flat or not differentiable: then ν = 0
    return jnp.nan_to_num((p - slope) @ normal / jnp.maximum(normal @ normal, 1e-300))


def _by_continuation(failed: Outcome, limits: Limits) -> Outcome:
    """Solve the problem through a sequence of easier ones; return the failure if there are none or if they fail."""
    bvp = failed.bvp
    # prescribed end states and targets have no easier problem that always has a solution: less time may be too little
    if bvp.closing not in (Closing.REST, Closing.COST) or bvp.free:
        return failed
    found = None
    for share in SHARES:
        last = share == 1
        if bvp.closing is Closing.REST:  # near rest the error of the Riccati costate is quadratic in the distance
            assert bvp.rest is not None
            start = bvp.rest.state + share * (bvp.start - bvp.rest.state)
            easier = dataclasses.replace(bvp, start=start)
            times, columns = initial_guess.into_rest(easier, start, float(bvp.horizon), limits.clock)
        else:  # over a short horizon the costate stays close to ψ_x, the costate of the line
            easier = dataclasses.replace(bvp, horizon=share * bvp.horizon)
            times, columns = initial_guess.straight_line(easier, float(easier.horizon))
        # on s ∈ [0, 1] the last solution is directly a guess for the next one
        s, y = (times / times[-1], columns) if found is None else (found.s, found.y)
        found = attempt(easier, s, y, np.zeros(0), limits if last else limits.rough)
        if not found.solved:
            return failed
    return found or failed


def _refuse_unsettled(found: Outcome) -> Outcome:
    """Turn the outcome into a failure if an infinite horizon has not settled at its rest point."""
    bvp = found.bvp
    last = found.y.reshape(bvp.count, -1, len(found.s))[-1, : bvp.n, -1]
    if bvp.closing is not Closing.REST or not found.solved or _is_near_rest(bvp, last):
        return found
    trouble = f"the path has not settled at its rest point by t = {found.horizon:.3g}; give another guess"
    return dataclasses.replace(found, code=Status.STALLED, trouble=trouble)


def _is_near_rest(bvp: BoundaryValueProblem, last: State) -> bool:
    """True if the last state is so near the rest point that its quadratic value can be trusted."""
    rest = bvp.rest
    assert rest is not None
    # measure distances by the value, because states have different units, and states without cost do not matter
    begun, left, far = bvp.start - rest.state, last - rest.state, np.abs(bvp.start) + np.abs(rest.state)
    size = abs(begun @ rest.matrix @ begun) + STILL * (far @ np.abs(rest.matrix) @ far)
    return bool(abs(left @ rest.matrix @ left) <= SETTLED**2 * size)


def _lengthen(found: Outcome, limits: Limits) -> Outcome:
    """Extend an infinite horizon until the path is near its rest point."""
    for _ in range(EXTENSIONS):
        bvp = found.bvp
        last = found.y[: bvp.n, -1]
        if _is_near_rest(bvp, last) or not found.solved:
            return found
        more = float(bvp.horizon) * (LONGER - 1)
        # append the closed loop under the Riccati costate to the path
        times, columns = initial_guess.into_rest(bvp, last, more, limits.clock)
        longer = dataclasses.replace(bvp, horizon=float(bvp.horizon) * LONGER)
        t = np.concatenate([found.times, float(bvp.horizon) + times[1:]])
        found = attempt(longer, t / t[-1], np.concatenate([found.y, columns[:, 1:]], 1), np.zeros(0), limits)
    trouble = f"the path has not settled at its rest point by t = {found.horizon:.3g}; give horizon=, or rest="
    return found if not found.solved else dataclasses.replace(found, code=Status.STALLED, trouble=trouble)


def report(found: Outcome) -> Extremal:
    """The extremal, checked against the necessary conditions unless the run was cut short."""
    if found.code in CUT:
        return last_iterate(found.bvp, found.s, found.y, found.lengths, found.code)
    extremal = assemble_extremal(found.bvp, found.s, found.y, found.theta, found.code, found.trouble)
    check = extremal.optimality_check
    if not found.solved:
        return dataclasses.replace(extremal, message=found.trouble + necessary_conditions.way_out(found.bvp))
    # durations have no sign constraint, and an arc with negative duration meets all equations
    if np.min(found.lengths) < -GAP * found.horizon:
        missed = "an arc came out with a negative duration; give another guess"
        return dataclasses.replace(extremal, code=int(Status.STALLED), message=missed)
    entered = entry_time(found.bvp, found.s, found.y, np.asarray(found.theta))
    if entered is not None:
        missed = _entry(found.bvp, entered)
        return dataclasses.replace(extremal, code=int(Status.STALLED), message=missed)
    # Pontryagin's principle requires the global minimum, but a search may have found a local one
    if not check.gap <= GAP * check.scale:
        missed = f"the Hamiltonian exceeds its minimum by {check.gap:.3g}, so it is not an extremal; give another guess"
        return dataclasses.replace(extremal, code=int(Status.STALLED), message=missed)
    if found.bvp.closing is Closing.TARGET and only_touches(found.bvp, found.s, found.y, np.asarray(found.theta)):
        grazed = "an extremal, not a minimum: it touches the target without entering it; give another guess"
        return dataclasses.replace(extremal, code=int(Status.STALLED), message=grazed)
    worse = second_order.verdict(found.bvp, found.s, found.y, np.asarray(found.theta), float(check.scale))
    if worse:
        return dataclasses.replace(extremal, code=int(Status.STALLED), message=worse)
    count = len(extremal.switches)
    jumps = f", {count} switch{'es' * (count != 1)}" if found.bvp.rule.jumps else ""
    payoff = found.bvp.problem.payoff
    paid = extremal.cost if payoff == COST else extremal.reward
    said = f"an extremal of {payoff} {paid:.6g} over {extremal.horizon:.6g}{jumps}, {len(found.s)} nodes"
    return dataclasses.replace(extremal, message=said)


def _entry(bvp: BoundaryValueProblem, time: float) -> str:
    """The message for a path that enters the target before its end."""
    if bvp.closing is Closing.TARGET:
        return (
            f"the path crosses the target before its end, at t = {time:.4g}, where it would have stopped; "
            "give another guess"
        )
    return (
        f"the path enters the problem's target at t = {time:.4g}, where it would have stopped; give another guess, or "
        "remove the target: dataclasses.replace(problem, target=None, exit_cost=None)"
    )
