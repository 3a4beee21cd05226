"""Extremals, paths that meet Pontryagin's necessary conditions, by ``pontryagin``.

``boundary_value`` has the boundary-value problem and its end conditions, ``pointwise`` the minimum over u, and
``equilibria`` the rest point of an infinite horizon. SciPy's ``solve_bvp`` solves the problem by collocation of order 4
on an adaptive mesh, to a relative residual below ``tol``. An extremal is a candidate. Its path is admissible, so its
cost is an upper bound of the value; the value is the cost of the best extremal. A path that enters the problem's target
before its end is rejected, because the run would have stopped there. To solve the problem without its target, pass
``dataclasses.replace(problem, target=None, exit_cost=None)``.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import numpy as np

from hjbjax.extremals import arguments, continuation, equilibria, initial_guess, switching
from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing, Law, Limits
from hjbjax.extremals.necessary_conditions import Extremal, with_payoff
from hjbjax.hamiltonian.pointwise import rule_of
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, as_partial, front_door, pytree_dataclass
from hjbjax.problem.rewards import costs_of, negative
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, State
from hjbjax.solution.clock import Clock, Stopped, noting_interrupts
from hjbjax.solution.rewards import in_costs
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status
from hjbjax.tracing import checks, closures

SETTLED = 12.0  # length of an infinite horizon in time constants of the loop near rest; the remainder is e⁻¹²
WAYS = 4  # maximal number of ends that are tried if angles can come to rest on either side
AT_REST = 1e-6  # fraction of a period: an angle closer to rest has only one way there
LONGEST = 20.0  # units of time for simulating the guess to a target if no time is given


@pytree_dataclass()
class FreeTime:
    """A free final time, determined by ``pontryagin``.

    Args:
      guess: the initial guess, in units of time.

    Raises:
      ValueError: the guess is not a positive finite number.
    """

    guess: Number = 1.0

    def __post_init__(self) -> None:
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
    time_limit: float | None = None,
    throw: bool = True,
) -> Extremal:
    """Solve for the extremal from ``x0`` near an initial guess, in float64.

        ẋ = f(t, x, u),  ṗ = βp − H_x(t, x, p, u),  u = argmin of H = L + f·p over the admissible set

    The method is collocation of order 4. If H is affine in an input of a box, or if the controls are enumerated, then u
    jumps. In this case smoothing finds the order of the values, and the switching times are additional unknowns.

    Args:
      problem: deterministic, with one player, costs or rewards, and without ``stopping_cost`` and ``running_max``.
      x0: the state at time 0, shape (n,), outside the target.

    Keyword Args:
      horizon: the final time, or ``FreeTime(guess)`` to determine it. With ``None`` it is free if the problem has a
        target or ``terminal`` prescribes states, and infinite otherwise, with the Riccati costate of a rest point.
      terminal: the end of the path: an array (n,) of end states, NaN for free states, or a function ψ that replaces
        ``terminal_cost``. With ``None`` and without a horizon the path ends on the target and pays ``exit_cost``.
        The target ends the path in any case, so end states inside it require a problem without a target.
      guess: a Solution, whose closed loop and DV are the initial guess, or another extremal. ``None``: a line to the
        end states or to the target, the closed loop under the Riccati costate, or a path under a constant control.
      rest: a state near the rest point of an infinite horizon. ``None``: the minimum of a Solution, or the origin.
      grid: a grid whose periodic axes are wrapped before the problem sees a state; a Solution brings its own grid.
        Without ``guess`` and ``rest``, angles are brought to rest in both directions and the cheaper path is returned.
      tol: bound on the relative residual of the differential equations and of the conditions at the ends.
      max_nodes: maximal number of mesh nodes; the cost per iteration is proportional to the number of nodes.
      time_limit: seconds, including compilation; one compilation or factorisation is not interrupted.
      throw: raise an error after a failure.

    Returns:
      An Extremal. With ``throw=False``, ``status`` and ``message`` report how a failed solve ended.

    Raises:
      SolveError: the boundary-value problem was not solved; ``.solution`` is the last Extremal. After Ctrl-C or the
        time limit it is the last iterate, without controls. If either comes before the initial guess is ready,
        ``.solution`` is None and the error is raised even with ``throw=False``.
      ValueError: an argument is not admissible.
      TypeError: a guess, a horizon or a terminal condition has the wrong type.

    Example:
      >>> import jax.numpy as jnp
      >>> from hjbjax import Box, Problem
      >>> problem = Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, Box([-9.0], [9.0]))
      >>> extremal = pontryagin(problem, [1.0])
      >>> round(extremal.cost, 8), extremal.costates[0].round(6).tolist()
      (1.0, [2.0])
    """
    closures.refuse_traced("pontryagin", problem, x0, guess, terminal, horizon)
    arguments.check_problem(problem, tol, max_nodes, time_limit)
    start = arguments.state_of_numbers(x0, "x0")
    arguments.check_guess(guess, len(start), horizon)
    problem, guess = costs_of(problem), _guess_in_costs(guess)
    if callable(terminal):
        terminal = terminal if problem.payoff == COST else negative(terminal)
    # check with ψ as the terminal cost, so that a ψ of the wrong shape is refused before anything compiles
    paid = altered(problem, terminal_cost=as_partial(terminal)) if callable(terminal) else problem
    checks.of_one_state(paid, len(start), "the length of x0")
    arguments.check_grid(grid, len(start))
    problem = closures.settled(problem, len(start))
    if callable(terminal):
        terminal = closures.settled_function(terminal, (len(start),))
    clock = Clock(seconds=time_limit)
    limits = Limits(tol, max_nodes, clock)
    # always float64: a residual of 1e-8 is below the rounding of float32
    with noting_interrupts(clock), own_settings(x64=True):
        try:
            bvp = pose(problem, start, horizon, terminal, guess.grid if isinstance(guess, Solution) else grid)
            arguments.check_start(bvp)
            if bvp.closing is Closing.REST:
                begun = [_to_rest(bvp, guess, rest, clock)]
                if guess is None and rest is None:  # a prescribed rest point also prescribes the direction
                    begun = _ways_round(*begun[0], clock)
            else:
                times, columns = _guess(bvp, guess, horizon)
                if not bvp.free:  # stretch a loop that reached its end sooner, or an extremal of another horizon
                    times = times * (float(bvp.horizon) / times[-1])
                begun = [(bvp, times, columns)]
            found = _cheapest(begun, limits, trusted=guess is not None)
            # Ctrl-C after the last check of the clock
            if clock.interrupted:
                raise Stopped(Status.INTERRUPTED, dataclasses.replace(found, code=Status.INTERRUPTED))
            extremal = continuation.report(found)
            # report compiles as well: an interrupt meanwhile sets the status, but the extremal is complete
            if clock.interrupted:
                extremal = dataclasses.replace(extremal, code=int(Status.INTERRUPTED))
        except Stopped as stop:
            if stop.reached is None:
                raise SolveError(f"pontryagin: {stop.status} before there was an initial guess or a path") from None
            extremal = continuation.report(stop.reached)
    extremal = with_payoff(extremal, problem.payoff)
    if throw and extremal.status is not Status.CONVERGED:
        raise SolveError(f"pontryagin: {extremal.status}: {extremal.message}", extremal)
    return extremal


def _guess_in_costs(guess: Solution | Extremal | None) -> Solution | Extremal | None:
    """The guess with its value or its costates as costs."""
    return in_costs(guess) if isinstance(guess, Solution) else guess and with_payoff(guess, COST)


def pose(
    problem: Problem,
    start: np.ndarray,
    horizon: Number | FreeTime | None,
    terminal: Callable | Array | Sequence[float] | None,
    grid: Grid | None,
) -> BoundaryValueProblem:
    """The boundary-value problem for the arguments of ``pontryagin``, without its rest point."""
    n = len(start)
    rule = rule_of(problem, n)
    held, ends, final = arguments.end_states(terminal, n)
    closing = Closing.STATE if any(held) else Closing.COST
    # if the call gives neither horizon nor terminal, the path ends on the target, or never
    if horizon is None and terminal is None:
        closing = Closing.REST if problem.target is None else Closing.TARGET
    free = isinstance(horizon, FreeTime) or (horizon is None and closing is not Closing.REST)
    if free and horizon is None and closing is Closing.COST:
        raise ValueError(
            f"pontryagin: got a terminal {problem.payoff} and no horizon; pass horizon=T, or FreeTime(guess) to "
            "determine it"
        )
    if isinstance(horizon, FreeTime) and terminal is None and problem.target is not None:
        closing = Closing.TARGET
    if final is None:
        final = problem.exit_cost if closing is Closing.TARGET else problem.terminal_cost
    # a rest point needs an autonomous flow, and the Riccati equation divides by H_uu, which is 0 if the control jumps
    if closing is Closing.REST and (problem.time_dependent or rule.jumps):
        why = "depends on time" if problem.time_dependent else "has controls that jump, without a Riccati equation"
        raise ValueError(f"pontryagin: got no horizon, and the problem {why}; pass horizon=, or terminal= end states")
    assert problem.controls is not None
    given = None if isinstance(horizon, FreeTime) else horizon
    return BoundaryValueProblem(
        problem=problem,
        # wrapping is traced into every evaluation, so leave the grid out if no axis is periodic
        grid=grid if grid is not None and any(grid.periodic) else None,
        start=start,
        horizon=0.0 if given is None else arguments.fixed_horizon(given),
        final=final,
        ends=ends,
        rest=None,
        arcs=np.full((1, problem.controls.dim), np.nan),  # one arc without a prescribed value
        epsilon=1.0,  # unused until there is a mixture, whose initial ε is the size of H
        rule=rule,
        law=Law.MINIMUM,
        closing=closing,
        held=held,
        free=free,
    )


def _guess(
    bvp: BoundaryValueProblem, guess: Solution | Extremal | None, horizon: Number | FreeTime | None
) -> tuple[np.ndarray, np.ndarray]:
    """Times and columns (x, p, w) of the initial guess, for a finite horizon."""
    if isinstance(guess, Extremal):
        return initial_guess.from_extremal(bvp, guess)
    long = float(horizon.guess) if isinstance(horizon, FreeTime) else float(bvp.horizon)
    # a free horizon without a guess is 0 here; simulate the loop for LONGEST then
    if guess is not None:
        return initial_guess.along_loop(bvp, guess, long or LONGEST)
    # if the control jumps, a zero costate is better because it does not prefer any value
    if bvp.closing is Closing.TARGET and not bvp.rule.jumps:
        found = initial_guess.toward_target(bvp, long or 1.0)
        if found is not None:
            return found
    return initial_guess.straight_line(bvp, long or 1.0)


def _ways_round(
    bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, clock: Clock
) -> list[tuple[BoundaryValueProblem, np.ndarray, np.ndarray]]:
    """Problems with the rest point on either side of x₀ along periodic axes, each with its initial guess."""
    rest = bvp.rest
    if bvp.grid is None or rest is None:
        return [(bvp, times, columns)]
    period = np.where(np.array(bvp.grid.periodic), np.asarray(bvp.grid.hi) - np.asarray(bvp.grid.lo), 0)
    turns = (bvp.start - rest.state) / np.where(period > 0, period, 1)
    # the nearest rest point and the one on the other side, unless x₀ is at rest on this axis
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
    """The cheapest of the solved problems, or the first failure if none is solved."""
    solve = switching.switching if begun[0][0].rule.jumps else continuation.solve_smooth
    answers: list[continuation.Outcome] = []
    for bvp, times, columns in begun:
        if answers:
            continuation.carry_on(answers[-1], limits)
        answers.append(solve(bvp, times, columns, limits, trusted=trusted))
    if len(answers) == 1:
        return answers[0]
    solved = [answer for answer in answers if continuation.report(answer).status is Status.CONVERGED]
    # the cost to go is the last of the 2n+1 rows of the first arc
    return min(solved, key=lambda answer: answer.y[2 * answer.bvp.n, 0]) if solved else answers[0]


def _to_rest(
    bvp: BoundaryValueProblem,
    guess: Solution | Extremal | None,
    rest: State | Sequence[float] | None,
    clock: Clock,
) -> tuple[BoundaryValueProblem, np.ndarray, np.ndarray]:
    """The boundary-value problem with its rest point, and the initial guess."""
    n = bvp.n
    near: State = np.zeros(n) if rest is None else arguments.state_of_numbers(rest, "rest")
    if len(near) != n:
        raise ValueError(f"pontryagin: got rest = {near.tolist()}, wanted shape ({n},), like x0: a state near rest")
    if isinstance(guess, Solution) and rest is None:  # the value is smallest near the rest point
        least = np.unravel_index(np.nanargmin(guess.value), guess.grid.shape)
        near = guess.grid.state([int(index) for index in least])
    if isinstance(guess, Extremal) and rest is None:
        near = guess.states[-1]
    found, slowest = equilibria.find(bvp, near, np.zeros(n))
    clock.look()  # the search for the rest point compiles, and SciPy's root finder does not check the clock
    bvp = dataclasses.replace(bvp, rest=found, horizon=SETTLED / slowest)
    if guess is None:
        return bvp, *initial_guess.into_rest(bvp, bvp.start, float(bvp.horizon), clock)
    if isinstance(guess, Extremal):
        times, columns = initial_guess.from_extremal(bvp, guess)
    else:
        times, columns = initial_guess.along_loop(bvp, guess, 2 * float(bvp.horizon))
        # a periodic state may come to rest a period away, with the same costate
        found, _ = equilibria.find(bvp, columns[:n, -1], found.costate)
    return dataclasses.replace(bvp, rest=found, horizon=float(times[-1])), times, columns
