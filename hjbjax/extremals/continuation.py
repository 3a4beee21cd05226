"""Solving the boundary-value problem of an extremal whose control is continuous: at once, or by continuation.

The collocation starts from the guess; if that fails, from easier problems on the way: starts nearer to the rest of an
infinite horizon, shorter horizons, or given final times where one is sought; and then from the path under a constant
control. An infinite horizon is lengthened until the path has settled. What comes back is held against the necessary
conditions before it counts as converged.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals import initial_guess, necessary_conditions, second_order
from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing, Limits
from hjbjax.extremals.collocation import collocate, split_at_seams
from hjbjax.extremals.necessary_conditions import Extremal, assemble, entry_time, last_iterate, only_touches
from hjbjax.problem.types import Array, Number, State
from hjbjax.solution.clock import CUT, Stopped
from hjbjax.solution.status import Status

SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)  # of the way, in a continuation
SPANS = (1.0, 2.0, 0.5, 4.0)  # given final times over the guess of a free one
HUGE = 1e6  # times the guess: what grows so much has no limit
SETTLED = 1e-3  # how far from a rest its quadratic value is trusted, relative to x₀; what is left is its cube
STILL = 1e-10  # the square of a distance from a rest, over that of x₀ and x̄ from 0, that is none
LONGER, EXTENSIONS = 1.5, 6  # factor, and how often, an infinite horizon is lengthened
GAP = 1e-6  # by how much the Hamiltonian may miss its minimum, relative to its terms
ENDINGS = {1: Status.MAX_STEPS, 2: Status.DIVERGED, 3: Status.STALLED}
ADVICE = {
    Status.MAX_STEPS: "the mesh reached max_nodes; raise max_nodes, loosen tol, or give a better guess",
    Status.DIVERGED: "its Jacobian became singular: no extremal near the guess, or none that meets the end conditions",
    Status.STALLED: "the end conditions cannot be met to tol; give another guess",
    Status.NONFINITE: "NaN or infinity on the way; look at drift, cost and terminal there, or give a better guess",
}


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The last iterate of a boundary-value problem and how its solve ended.

    Args:
      bvp: the boundary-value problem.
      s: the mesh on [0, 1].
      y: (x, p, w) of all arcs on it, shape (k·(2n+1), len(s)).
      theta: the durations, if they are sought, and ν.
      code: how it ended.
      trouble: why it was not solved, in words; empty where it was.
    """

    bvp: BoundaryValueProblem
    s: np.ndarray
    y: np.ndarray
    theta: np.ndarray
    code: Status
    trouble: str = ""

    @property
    def solved(self) -> bool:
        """Whether the collocation converged."""
        return self.code is Status.CONVERGED

    @property
    def times(self) -> np.ndarray:
        """The mesh in units of time, of one arc."""
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
    """One collocation, its ending in our words; ``Stopped`` brings along what was found by then."""
    guess = np.asarray(theta, float)
    try:
        result = collocate(bvp, s, y, guess, limits)
    except Stopped as stop:
        mesh, last, sought = stop.reached
        raise Stopped(stop.status, Outcome(bvp, mesh, last, sought, stop.status)) from None
    # None is SciPy's answer where no number is sought
    sought = np.zeros(0) if result.p is None else result.p
    code = Status.CONVERGED if result.success else ENDINGS[result.status]
    if not (np.all(np.isfinite(result.y)) and np.all(np.isfinite(sought))):
        code = Status.NONFINITE
    elif np.max(np.abs(result.y / result.units)) > HUGE * (1 + np.max(np.abs(y / result.units))):
        code = Status.DIVERGED  # a jump sharper than the mesh can look like a solution
    trouble = "" if code is Status.CONVERGED else f"the boundary-value problem was not solved: {ADVICE[code]}"
    found = Outcome(bvp, result.x, result.y, sought, code, trouble)
    # run backwards, an extremal may meet its end conditions as well; ``not >`` refuses NaN, too
    if found.solved and not found.horizon > 0:
        return dataclasses.replace(
            found, code=Status.DIVERGED, trouble=f"the final time came out as {found.horizon:.3g}; give a better guess"
        )
    return found


def carry_on(found: Outcome, limits: Limits) -> None:
    """Look at the clock with something to hand back: between two programs that have to be compiled."""
    code = limits.clock.over()
    if code is not None:
        raise Stopped(code, dataclasses.replace(found, code=code))


def smooth(
    bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, limits: Limits, *, trusted: bool
) -> Outcome:
    """The extremal of a Hamiltonian whose minimiser is continuous.

    Args:
      bvp: the boundary-value problem.
      times: increasing from 0.
      columns: the guess at these times, shape (2n+1, len(times)).
      limits: how far to go.
      trusted: whether the guess is of the very problem, so that easier ones would lead away from it.
    """
    apart = split_at_seams(bvp, times, columns)
    if apart is not None:
        # ν alone: in place of one final time, if it is sought, there are the durations of all arcs
        multiplier = unknowns(bvp, times, columns)[int(bvp.timed) :]
        return _refuse_unsettled(attempt(*apart[:3], np.append(apart[3], multiplier), limits))
    found = _attempt_by_times(bvp, times, columns, limits, trusted=trusted)
    # the direct attempt first: a continuation costs up to five solves
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
    """One collocation from a guess; if it fails with an end to be met, from those with other, given final times.

    With a given time the costate is determined even where it is far off, as in linear equations; the condition of a
    free one has no slope under a costate of zero.
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
    """First guesses of the final time and of ν, whatever the guess makes of p(T) = ψ_x + ν l_x."""
    theta = [times[-1]] * bvp.timed
    if bvp.closing is Closing.TARGET:
        theta.append(float(_multiplier(bvp, times[-1], columns[:, -1])))
    return np.array(theta)


@jax.jit
def _multiplier(bvp: BoundaryValueProblem, t: Number, z: Array) -> jax.Array:
    """The ν by which p − ψ_x − ν l_x is least at the end of a guess."""
    x, p, _ = bvp.split(z)
    slope, normal = jax.grad(bvp.psi, 1)(t, x), jax.grad(bvp.level, 1)(t, x)
    # a target's function may be flat, or not differentiable, at an end that is not on its edge: then ν = 0
    return jnp.nan_to_num((p - slope) @ normal / jnp.maximum(normal @ normal, 1e-300))


def _by_continuation(failed: Outcome, limits: Limits) -> Outcome:
    """The problem's solution by way of easier ones; the failure itself where there are none, or they fail, too."""
    bvp = failed.bvp
    # given end states and targets have no easier problem that surely has a solution: less time may be too little
    if bvp.closing not in (Closing.REST, Closing.COST) or bvp.free:
        return failed
    found = None
    for share in SHARES:
        last = share == 1
        if bvp.closing is Closing.REST:  # near the rest the Riccati costate is right up to the square of the distance
            assert bvp.rest is not None
            start = bvp.rest.state + share * (bvp.start - bvp.rest.state)
            easier = dataclasses.replace(bvp, start=start)
            times, columns = initial_guess.into_rest(easier, start, float(bvp.horizon), limits.clock)
        else:  # over a short horizon the costate hardly leaves ψ_x, of which the line's is made
            easier = dataclasses.replace(bvp, horizon=share * bvp.horizon)
            times, columns = initial_guess.straight_line(easier, float(easier.horizon))
        # on s ∈ [0, 1] the last solution is a guess of the next one as it is
        s, y = (times / times[-1], columns) if found is None else (found.s, found.y)
        found = attempt(easier, s, y, np.zeros(0), limits if last else limits.rough)
        if not found.solved:
            return failed
    return found or failed


def _refuse_unsettled(found: Outcome) -> Outcome:
    """The outcome, as a failure where an infinite horizon has not come near its rest."""
    bvp = found.bvp
    last = found.y.reshape(bvp.count, -1, len(found.s))[-1, : bvp.n, -1]
    if bvp.closing is not Closing.REST or not found.solved or _is_near_rest(bvp, last):
        return found
    trouble = f"the path has not settled at its rest by t = {found.horizon:.3g}; give another guess"
    return dataclasses.replace(found, code=Status.STALLED, trouble=trouble)


def _is_near_rest(bvp: BoundaryValueProblem, last: State) -> bool:
    """Whether the last state is so near to the rest that its quadratic value may be trusted."""
    rest = bvp.rest
    assert rest is not None
    # distances by the value itself: lengths and speeds have no common unit, and what does not cost does not matter
    begun, left, far = bvp.start - rest.state, last - rest.state, np.abs(bvp.start) + np.abs(rest.state)
    size = abs(begun @ rest.matrix @ begun) + STILL * (far @ np.abs(rest.matrix) @ far)
    return bool(abs(left @ rest.matrix @ left) <= SETTLED**2 * size)


def _lengthen(found: Outcome, limits: Limits) -> Outcome:
    """The outcome of an infinite horizon, lengthened until the path is near enough to its rest."""
    for _ in range(EXTENSIONS):
        bvp = found.bvp
        last = found.y[: bvp.n, -1]
        if _is_near_rest(bvp, last) or not found.solved:
            return found
        more = float(bvp.horizon) * (LONGER - 1)
        # the path so far, and from its end the loop under the Riccati costate
        times, columns = initial_guess.into_rest(bvp, last, more, limits.clock)
        longer = dataclasses.replace(bvp, horizon=float(bvp.horizon) * LONGER)
        t = np.concatenate([found.times, float(bvp.horizon) + times[1:]])
        found = attempt(longer, t / t[-1], np.concatenate([found.y, columns[:, 1:]], 1), np.zeros(0), limits)
    trouble = f"the path has not settled at its rest by t = {found.horizon:.3g}; give horizon, or rest="
    return found if not found.solved else dataclasses.replace(found, code=Status.STALLED, trouble=trouble)


def report(found: Outcome) -> Extremal:
    """The extremal, held against the necessary conditions; not so the last iterate of a run that was cut short."""
    if found.code in CUT:
        return last_iterate(found.bvp, found.s, found.y, found.lengths, found.code)
    extremal = assemble(found.bvp, found.s, found.y, found.theta, found.code, found.trouble)
    check = extremal.optimality_check
    if not found.solved:
        return dataclasses.replace(extremal, message=found.trouble + necessary_conditions.way_out(found.bvp))
    # durations are sought without a sign, and an arc run backwards meets all equations
    if np.min(found.lengths) < -GAP * found.horizon:
        missed = "an arc came out with a negative duration; give another guess"
        return dataclasses.replace(extremal, code=int(Status.STALLED), message=missed)
    entered = entry_time(found.bvp, found.s, found.y, np.asarray(found.theta))
    if entered is not None:
        missed = _entry(found.bvp, entered)
        return dataclasses.replace(extremal, code=int(Status.STALLED), message=missed)
    # Pontryagin's principle wants the global minimum, and a search may have followed a local one
    if not check.gap <= GAP * check.scale:
        missed = f"the Hamiltonian misses its minimum by {check.gap:.3g}: no extremal; give another guess"
        return dataclasses.replace(extremal, code=int(Status.STALLED), message=missed)
    if found.bvp.closing is Closing.TARGET and only_touches(found.bvp, found.s, found.y, np.asarray(found.theta)):
        grazed = "an extremal, not a minimum: it touches the edge of the target and does not enter; give another guess"
        return dataclasses.replace(extremal, code=int(Status.STALLED), message=grazed)
    worse = second_order.verdict(found.bvp, found.s, found.y, np.asarray(found.theta), float(check.scale))
    if worse:
        return dataclasses.replace(extremal, code=int(Status.STALLED), message=worse)
    count = len(extremal.switches)
    jumps = f", {count} switch{'es' * (count != 1)}" if found.bvp.rule.jumps else ""
    said = f"an extremal of cost {extremal.cost:.6g} over {extremal.horizon:.6g}{jumps}, {len(found.s)} nodes"
    return dataclasses.replace(extremal, message=said)


def _entry(bvp: BoundaryValueProblem, time: float) -> str:
    """The verdict on a path that enters the target before its end."""
    if bvp.closing is Closing.TARGET:
        return (
            f"the path crosses the target before its end, at t = {time:.4g}, where it would have stopped; "
            "give another guess"
        )
    return (
        f"the path enters the problem's target at t = {time:.4g}, where it would have stopped; give another guess, or "
        "leave the target out: dataclasses.replace(problem, target=None, exit_cost=None)"
    )
