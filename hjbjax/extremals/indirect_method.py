"""Extremals: paths that meet Pontryagin's necessary conditions, by ``pontryagin``.

The boundary-value problem and what closes it are in ``boundary_value``, the pointwise minimum in ``pointwise``, the
rest of an infinite horizon in ``equilibria``. SciPy's ``solve_bvp`` solves it by collocation of order 4 on a mesh of
its own, to a relative residual below ``tol``. An extremal is a candidate: its path is admissible, so its cost bounds
the value from above, and the value is that of the best one. A path that enters the problem's target on its way would
have stopped there and is no answer: for the problem without its target give
``dataclasses.replace(problem, target=None, exit_cost=None)``.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import numpy as np

from hjbjax.extremals import arguments, continuation, equilibria, initial_guess, switching
from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing, Law, Limits
from hjbjax.extremals.necessary_conditions import Extremal
from hjbjax.hamiltonian.pointwise import rule_of
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, State
from hjbjax.solution.clock import Clock, Stopped, noting_interrupts
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status
from hjbjax.tracing import checks, closures

SETTLED = 12.0  # time constants of the loop near a rest that an infinite horizon is followed: what is left is e⁻¹²
WAYS = 4  # ends that are tried where angles can go to rest on either side
AT_REST = 1e-6  # of a period: an angle no further from its rest has one way there
LONGEST = 20.0  # units of time that the loop of a solution is followed to a target without a guess of the time


@pytree_dataclass()
class FreeTime:
    """A final time that is sought.

    Args:
      guess: where the search starts, in units of time.

    Raises:
      ValueError: the guess is not a positive number.
    """

    guess: Number = 1.0

    def __post_init__(self):
        if np.ndim(self.guess) or not (np.isfinite(self.guess) and self.guess > 0):
            raise ValueError(f"FreeTime: got guess = {self.guess!r}, wanted a finite number > 0")


@front_door
def pontryagin(
    problem: Problem,
    x0: State | Sequence[float],
    *,
    horizon: Number | FreeTime | None = None,
    terminal: Callable | Array | Sequence[float] | None = None,
    guess: Solution | Extremal | None = None,
    rest: State | Sequence[float] | None = None,
    grid: Grid | None = None,
    tol: float = 1e-8,
    max_nodes: int = 5000,
    throw: bool = True,
) -> Extremal:
    """The extremal from ``x0`` near a first guess, in float64.

        ẋ = f(t, x, u),  ṗ = βp − H_x(t, x, p, u),  u = argmin of H = L + f·p over the admissible set

    Collocation of order 4. Where H is affine in an input of a box, or the controls are enumerated, u jumps: the order
    of its values is found with smoothed jumps, and the switching times then like any other unknown.

    Args:
      problem: deterministic, with one player, and neither ``stopping_cost`` nor ``running_max``.
      x0: the state at time 0, shape (n,), outside of the target.

    Keyword Args:
      horizon: the final time; ``FreeTime(guess)`` where it is sought. ``None``: free if the problem has a target or
        ``terminal`` gives states, otherwise infinite, closed by the Riccati costate of a rest.
      terminal: how the path ends: an array (n,) of end states, NaN for those that are free; or a function ψ, paid at
        the end in place of ``terminal_cost``. ``None``: without a horizon on the target, with ``exit_cost``. The
        problem's target ends the path all the same: end states within it need a problem without.
      guess: a Solution, whose closed loop and DV are the first guess, or another extremal. ``None``: a line to the end
        states or to the target, the loop under the Riccati costate, or a path under a constant control.
      rest: a state near the rest of an infinite horizon; ``None``: the least node of a Solution, else the origin.
      grid: its periodic axes are wrapped before the problem sees a state; a Solution brings its own. Without a guess
        and without ``rest`` an angle is brought to rest either way round, and the cheaper one is the answer.
      tol: on the relative residual of the differential equations, and on the conditions at the ends.
      max_nodes: of the mesh; each iteration of the solver costs as much as it has.
      throw: whether a failure raises.

    Returns:
      An Extremal; with ``throw=False`` its ``status`` and ``message`` tell how a failed solve ended.

    Raises:
      SolveError: the boundary-value problem was not solved; ``.solution`` is the Extremal so far. After Ctrl-C that
        is the last iterate, without controls; None, whatever ``throw`` says, on the way to a first guess.
      ValueError: an argument that is not admissible.
      TypeError: a guess, a horizon or a terminal condition of another kind.

    Example:
      >>> import jax.numpy as jnp
      >>> from hjbjax import Box, Problem
      >>> problem = Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, Box([-9.0], [9.0]))
      >>> extremal = pontryagin(problem, [1.0])
      >>> round(extremal.cost, 8), extremal.costates[0].round(6).tolist()
      (1.0, [2.0])
    """
    if is_traced(problem, x0, guess, terminal):
        raise ValueError("pontryagin: got traced values; it runs at the host: call it outside of jit, vmap and grad")
    arguments.check_problem(problem, tol, max_nodes)
    start = arguments.state_of_numbers(x0, "x0")
    # checked with ψ in place of the terminal cost, so that a ψ of the wrong shape is refused before anything compiles
    paid = dataclasses.replace(problem, terminal_cost=terminal) if callable(terminal) else problem
    checks.of_one_state(paid, len(start), "the length of x0")
    arguments.check_guess(guess, len(start), horizon)
    arguments.check_grid(grid, len(start))
    problem = closures.settled(problem, len(start))
    if callable(terminal):
        terminal = closures.settled_function(terminal, (len(start),))
    clock = Clock()
    limits = Limits(tol, max_nodes, clock)
    # float64 whatever the session has: a residual of 1e-8 is below the rounding of float32
    with noting_interrupts(clock), own_settings(x64=True):
        try:
            bvp = _pose(problem, start, horizon, terminal, guess.grid if isinstance(guess, Solution) else grid)
            arguments.check_start(bvp)
            if bvp.closing is Closing.REST:
                begun = [_to_rest(bvp, guess, rest, clock)]
                if guess is None and rest is None:  # a rest that is given is the one on its side of the circle
                    begun = _ways_round(*begun[0], clock)
            else:
                times, columns = _guess(bvp, guess, horizon)
                if not bvp.free:  # a loop that reached its end sooner, or an extremal of another horizon
                    times = times * (float(bvp.horizon) / times[-1])
                begun = [(bvp, times, columns)]
            found = _cheapest(begun, limits, trusted=guess is not None)
            # Ctrl-C after the last evaluation, which is where the clock is looked at
            if clock.interrupted:
                raise Stopped(Status.INTERRUPTED, dataclasses.replace(found, code=Status.INTERRUPTED))
            extremal = continuation.report(found)
            # the report compiles, too: an interrupt meanwhile is told, and the extremal is whole
            if clock.interrupted:
                extremal = dataclasses.replace(extremal, code=int(Status.INTERRUPTED))
        except Stopped as stop:
            if stop.reached is None:
                raise SolveError(f"pontryagin: {stop.status}: on the way to a first guess; there is no path") from None
            extremal = continuation.report(stop.reached)
    if throw and extremal.status is not Status.CONVERGED:
        raise SolveError(f"pontryagin: {extremal.status}: {extremal.message}", extremal)
    return extremal


def _pose(
    problem: Problem,
    start: np.ndarray,
    horizon: Number | FreeTime | None,
    terminal: Callable | Array | Sequence[float] | None,
    grid: Grid | None,
) -> BoundaryValueProblem:
    """The boundary-value problem that the arguments of ``pontryagin`` pose, all but its rest."""
    n = len(start)
    rule = rule_of(problem, n)
    held, ends, final = arguments.end_states(terminal, n)
    closing = Closing.STATE if any(held) else Closing.COST
    # where the call says neither when nor how the path ends, the problem does: on its target, or never
    if horizon is None and terminal is None:
        closing = Closing.REST if problem.target is None else Closing.TARGET
    free = isinstance(horizon, FreeTime) or (horizon is None and closing is not Closing.REST)
    if free and horizon is None and closing is Closing.COST:
        raise ValueError(
            "pontryagin: got a terminal cost and no horizon; give horizon=T, or FreeTime(guess) to seek it"
        )
    if isinstance(horizon, FreeTime) and terminal is None and problem.target is not None:
        closing = Closing.TARGET
    if final is None:
        final = problem.exit_cost if closing is Closing.TARGET else problem.terminal_cost
    # a rest is one of an autonomous flow, and the Riccati equation divides by H_uu, which is 0 where the control jumps
    if closing is Closing.REST and (problem.time_dependent or rule.jumps):
        why = "depends on time" if problem.time_dependent else "has controls that jump, without a Riccati equation"
        raise ValueError(f"pontryagin: got no horizon, and the problem {why}; give horizon=, or terminal= end states")
    assert problem.controls is not None
    given = None if isinstance(horizon, FreeTime) else horizon
    return BoundaryValueProblem(
        problem=problem,
        # wrapping is traced into every evaluation, and does nothing without a periodic axis
        grid=grid if grid is not None and any(grid.periodic or ()) else None,
        start=start,
        horizon=0.0 if given is None else arguments.fixed_horizon(given),
        final=final,
        ends=ends,
        rest=None,
        arcs=np.full((1, problem.controls.dim), np.nan),  # one arc that prescribes no value
        epsilon=1.0,  # of no meaning before there is a mixture, whose first ε is the size of H
        rule=rule,
        law=Law.MINIMUM,
        closing=closing,
        held=held,
        free=free,
    )


def _guess(
    bvp: BoundaryValueProblem, guess: Solution | Extremal | None, horizon: Number | FreeTime | None
) -> tuple[np.ndarray, np.ndarray]:
    """Times and columns (x, p, w) where the solver starts, for a horizon that ends."""
    if isinstance(guess, Extremal):
        return initial_guess.from_extremal(bvp, guess)
    long = float(horizon.guess) if isinstance(horizon, FreeTime) else float(bvp.horizon)
    # a free horizon is 0 in the problem, and without a guess of it the loop says how long it takes
    if guess is not None:
        return initial_guess.along_loop(bvp, guess, long or LONGEST)
    # where the control jumps no costate is to prefer a value
    if bvp.closing is Closing.TARGET and not bvp.rule.jumps:
        found = initial_guess.toward_target(bvp, long or 1.0)
        if found is not None:
            return found
    return initial_guess.straight_line(bvp, long or 1.0)


def _ways_round(
    bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, clock: Clock
) -> list[tuple[BoundaryValueProblem, np.ndarray, np.ndarray]]:
    """The problem with its rest on either side of x₀ along periodic axes, and where the solver starts for each."""
    rest = bvp.rest
    if bvp.grid is None or rest is None:
        return [(bvp, times, columns)]
    period = np.where(np.array(bvp.grid.periodic), np.asarray(bvp.grid.hi) - np.asarray(bvp.grid.lo), 0)
    turns = (bvp.start - rest.state) / np.where(period > 0, period, 1)
    # the nearest rest, and the one on the other side; an x₀ at rest in an axis has no other
    nearest = np.where(period > 0, np.round(turns), 0)
    other = np.where(np.abs(turns - nearest) > AT_REST, nearest + np.sign(turns - nearest), nearest)
    sides = np.stack([nearest, np.where(period > 0, other, nearest)], axis=1)
    ends = itertools.product(*(dict.fromkeys(side) for side in sides.tolist()))
    ways = []
    for end in itertools.islice(ends, WAYS):
        there = dataclasses.replace(rest, state=rest.state + np.array(end) * period)
        way = dataclasses.replace(bvp, rest=there)
        ways.append((way, *initial_guess.into_rest(way, bvp.start, float(bvp.horizon), clock)))
    return ways


def _cheapest(
    begun: Sequence[tuple[BoundaryValueProblem, np.ndarray, np.ndarray]], limits: Limits, *, trusted: bool
) -> continuation.Outcome:
    """The solution that costs least of all that are solved; the first failure where none is."""
    solve = switching.switching if begun[0][0].rule.jumps else continuation.smooth
    answers: list[continuation.Outcome] = []
    for bvp, times, columns in begun:
        if answers:
            continuation.carry_on(answers[-1], limits)
        answers.append(solve(bvp, times, columns, limits, trusted=trusted))
    if len(answers) == 1:
        return answers[0]
    solved = [answer for answer in answers if continuation.report(answer).status is Status.CONVERGED]
    # the cost to go is the last row of an arc, and the first arc's comes first
    return min(solved, key=lambda answer: answer.y[2 * answer.bvp.n, 0]) if solved else answers[0]


def _to_rest(
    bvp: BoundaryValueProblem,
    guess: Solution | Extremal | None,
    rest: State | Sequence[float] | None,
    clock: Clock,
) -> tuple[BoundaryValueProblem, np.ndarray, np.ndarray]:
    """The boundary-value problem with its rest, and where the solver starts."""
    n = bvp.n
    near: State = np.zeros(n) if rest is None else arguments.state_of_numbers(rest, "rest")
    if len(near) != n:
        raise ValueError(f"pontryagin: got rest = {near.tolist()}, wanted shape ({n},), like x0: a state near the rest")
    if isinstance(guess, Solution) and rest is None:  # from the least node no path has much left to pay
        least = np.unravel_index(np.nanargmin(guess.value), guess.grid.shape)
        near = guess.grid.state([int(index) for index in least])
    if isinstance(guess, Extremal) and rest is None:
        near = guess.states[-1]
    found, slowest = equilibria.find(bvp, near, np.zeros(n))
    clock.look()  # the search for the rest compiles, and SciPy's root finder looks at no clock
    bvp = dataclasses.replace(bvp, rest=found, horizon=SETTLED / slowest)
    if guess is None:
        return bvp, *initial_guess.into_rest(bvp, bvp.start, float(bvp.horizon), clock)
    if isinstance(guess, Extremal):
        times, columns = initial_guess.from_extremal(bvp, guess)
    else:
        times, columns = initial_guess.along_loop(bvp, guess, 2 * float(bvp.horizon))
        # a periodic state may come to rest a period away; the costate of the rest is the same there
        found, _ = equilibria.find(bvp, columns[:n, -1], found.costate)
    return dataclasses.replace(bvp, rest=found, horizon=float(times[-1])), times, columns
