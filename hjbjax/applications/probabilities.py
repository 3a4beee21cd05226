"""Probabilities and exit times: ``reach_probability``, ``stay_probability``, ``expected_exit_time``.

They call ``solve`` and ``march`` with the problems of ``exit_problems``. Without a horizon the undiscounted equation
has several solutions if the chain may stay away from the ends indefinitely. Value iteration from zero then finds the
least solution, which is the probability. If every path must end under all actions, any method finds it. On the host the
chain is checked for this. Inside jit, vmap and grad it is not checked, and every path is assumed to end.
"""

import contextlib
import dataclasses
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.applications import exit_problems
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.posing import with_mode_axis
from hjbjax.discretisation.schemes import Upwind, check_slopes
from hjbjax.feedback.feedback import GridFeedback, Place, is_grid_feedback
from hjbjax.iteration.methods import ValueIteration
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_random
from hjbjax.problem.pytree import altered, as_partial, front_door, is_traced
from hjbjax.problem.settings import own_settings
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import keeping_warnings
from hjbjax.solvers import memory
from hjbjax.solvers.finite_horizon import march
from hjbjax.solvers.stationary import check_arguments, solve
from hjbjax.tracing import checks
from hjbjax.tracing.interpreter import FallbackWarning
from hjbjax.well_posedness import attainability, node_checks

TOL = 1e-6  # the default 1e-3 of ``solve`` would show in the third digit of a probability


@with_mode_axis("target", "obstacle", "region", "feedback")
@front_door
def reach_probability(
    problem: Problem,
    grid: Grid,
    target: Callable | None = None,
    *,
    obstacle: Callable | None = None,
    horizon: float | None = None,
    least: bool = False,
    feedback: GridFeedback | Callable | None = None,
    **options: Any,
) -> Solution:
    """Compute the greatest probability with which the control can bring the state into the target.

    V(x) = sup_u inf_d P(x(τ) in the target, τ ≤ horizon), where τ is the first time in the target or in the obstacle.
    It solves min max (V_t + f·DV + ½ tr σσᵀD²V) = 0 with V = 1 on the target and 0 on the obstacle. Accuracy and run
    time are as for ``march``, or as for ``solve`` without a horizon. There is no certificate. If the state may stay
    away from both sets indefinitely, the equation has several solutions. Value iteration from zero then finds the
    probability, but takes longer. It stops at a step of at most 1e-9 (4e-6 in float32); the error may be larger if
    steps shrink slowly.

    Without noise the probability is 0 or 1, and is derived from a minimum time or from a tube. If ``scheme`` or
    ``method`` is passed, or ``least`` together with ``obstacle``, it is instead the probability of the Markov chain,
    which moves at random by about a cell.

    Inside ``jit``, ``vmap`` and ``grad`` a problem with noise is not searched for states that may stay away
    indefinitely. If there are any, the result may be wrong.

    Args:
      problem: the system; its costs and its discount are ignored.
      grid: the grid.
      target: a function ≤ 0 inside; ``None`` is the problem's target.
      obstacle: a function ≤ 0 inside; a path that meets it first has failed, also where the two sets overlap.
      horizon: the time limit, in units of time; ``None`` is for all times.
      least: compute the least probability instead; the control tries to avoid the target.
      feedback: a Solution or a function of the state that replaces the control; then nothing is optimised. Where a
        Solution has no action the state does not move. A marched Solution must be stored at sufficiently dense
        times up to the horizon.
      options: other arguments of ``march``, or of ``solve`` without a horizon: times, scheme, method, ...; ``tol``, a
        bound on the residual and the last step of ``solve``, is 1e-6 by default. The default scheme ``Upwind()`` gives
        the probabilities of a chain.

    Returns:
      A Solution whose value is the probability and whose policy attains it.

    Raises:
      ValueError: there is no target, the grid has open ends, a feedback is given for a problem without controls, the
        modes have a switching cost, or ``march`` or ``solve`` refuse.
      SolveError: no convergence, with the partial solution.

    Example:
      >>> import hjbjax as hjb
      >>> gambler, grid = hjb.Problem(lambda x, u: 0.5 + 0 * x, noise=1.0), hjb.Grid([0.0], [1.0], (101,))
      >>> chance = hjb.reach_probability(gambler, grid, lambda x: 1 - x[0], obstacle=lambda x: x[0])
      >>> round(float(chance.value_at([0.5])), 4)  # (1 − e^{−2·½·½})/(1 − e^{−2·½})
      0.6225
    """
    name = "reach_probability"
    _refuse_open(grid, name)
    # a path pays 1 if it ends on the target, 0 if it ends in the obstacle or never ends
    problem, inside, hit = _system(problem, target, obstacle, feedback, horizon, name)
    if _has_no_chance(problem, options):
        decides = least and (problem.is_game or problem.controls is not None)
        # avoiding the target is not a tube if there is an obstacle
        if not (decides and hit is not None):
            with _no_fallback_warning(feedback):
                return _yes_or_no(problem, grid, (inside, hit), horizon, options, least=decides)
    sign = 1.0 if least else -1.0  # the control minimises, and the greatest P is minus the least −P
    question = exit_problems.exit_problem(problem, inside, hit, 0.0, sign)  # no running cost, only the exit cost
    with _no_fallback_warning(feedback):
        # over a horizon the solution is unique, so the chain need not be checked
        if horizon is None:
            question, options = _without_end(question, grid, least, options)
        return _answer(question, grid, horizon, options, sign)


@with_mode_axis("target", "obstacle", "region", "feedback")
@front_door
def stay_probability(
    problem: Problem,
    grid: Grid,
    region: Callable,
    *,
    horizon: float | None = None,
    least: bool = False,
    feedback: GridFeedback | Callable | None = None,
    **options: Any,
) -> Solution:
    """Compute the greatest probability with which the control can keep the state in a region.

    V(x) = sup_u inf_d P(x(s) in the region for all s ≤ horizon), one minus the least probability of leaving it.

    Args:
      problem: the system; its costs, its discount and its target are ignored.
      grid: the grid; the region must not cover all of it, because noise reflects at the boundary of the box.
      region: a function ≤ 0 inside; its boundary counts as outside.
      horizon: as in ``reach_probability``.
      least: compute the least probability instead; the control tries to leave.
      feedback: as in ``reach_probability``.
      options: as in ``reach_probability``.

    Returns:
      A Solution whose value is the probability and whose policy attains it.

    Raises:
      ValueError: as in ``reach_probability``.
      SolveError: no convergence, with the partial solution.

    Example:
      >>> import jax.numpy as jnp
      >>> import hjbjax as hjb
      >>> walk, grid = hjb.Problem(lambda x, u: 0 * x, noise=1.0), hjb.Grid([-1.0], [1.0], (41,))
      >>> kept = hjb.stay_probability(walk, grid, lambda x: jnp.abs(x[0]) - 1, horizon=1.0)
      >>> round(float(kept.value_at(0.0, [0.0])), 2)  # (4/π) e^{−π²/8} − ...
      0.37
    """
    # r ≤ 0 inside becomes −r ≤ 0 outside; both hold on the boundary, so it counts as outside
    leaving = jax.tree_util.Partial(exit_problems.complement, as_partial(region, "stay_probability: region"))
    # P(stays) = 1 − P(leaves), also for a partial solution; the least P(leaves) is the greatest P(stays)
    with _map_errors(1.0, -1.0):
        left = reach_probability(problem, grid, leaving, horizon=horizon, least=not least, feedback=feedback, **options)
    # the policy is the same, because minimising P(leaves) is maximising P(stays)
    return _affine(left, 1.0, -1.0)


@with_mode_axis("target", "obstacle", "region", "feedback")
@front_door
def expected_exit_time(
    problem: Problem,
    grid: Grid,
    target: Callable | None = None,
    *,
    horizon: float | None = None,
    greatest: bool = False,
    feedback: GridFeedback | Callable | None = None,
    **options: Any,
) -> Solution:
    """Compute the least expected time in which the control can bring the state into the target.

    V(x) = inf_u sup_d E τ, where τ is the first time in the target: min max (1 + f·DV + ½ tr σσᵀD²V) = 0, V = 0 on the
    target. The bound on |V − V_h| is certified, except for the greatest time. Without noise and disturbance, scheme and
    certificate are as for ``solve``, unless ``scheme`` or ``method`` is passed.

    Args:
      problem: the system; its costs and its discount are ignored.
      grid: the grid.
      target: a function ≤ 0 inside; ``None`` is the problem's target. For the exit from a region r ≤ 0 pass −r.
      horizon: compute E min(τ, horizon) instead, by ``march``.
      greatest: compute the greatest expected time instead; the control stays as long as it can.
      feedback: as in ``reach_probability``.
      options: other arguments of ``solve``, or of ``march`` with a horizon.

    Returns:
      A Solution whose value is the time, inf where the target is not reached with certainty.

    Raises:
      ValueError: there is no target, the grid has open ends, the modes have a switching cost, or ``solve`` or ``march``
        refuse. With ``greatest``: the control can stay away indefinitely, in a game possibly with the help of the
        disturbance; this is not checked inside ``jit``.
      SolveError: no convergence, with the partial solution.

    Example:
      >>> import jax.numpy as jnp
      >>> import hjbjax as hjb
      >>> walk, grid = hjb.Problem(lambda x, u: 0 * x, noise=2.0), hjb.Grid([-1.0], [1.0], (41,))
      >>> time = hjb.expected_exit_time(walk, grid, lambda x: 1 - jnp.abs(x[0]))
      >>> round(float(time.value_at([0.5])), 6)  # (1 − x²)/σ²
      0.1875
    """
    name = "expected_exit_time"
    _refuse_open(grid, name)
    problem, inside, _ = _system(problem, target, None, feedback, horizon, name)
    sign = -1.0 if greatest else 1.0  # max E τ = −min E(−τ), with a cost of −1 per unit time
    question = exit_problems.exit_problem(problem, inside, None, sign, 0.0)  # no exit cost, only the time
    with _no_fallback_warning(feedback):
        if horizon is None:
            # the user's options take precedence; march has no tolerance
            options = {"tol": TOL} | options
            # an infinite least time is found; the greatest time would grow indefinitely
            if greatest:
                _refuse_staying(question, grid, options)
            elif _has_no_chance(problem, options) and not problem.is_game:
                options = {"scheme": None} | options  # for deterministic paths; the chain may miss the target
        return _answer(question, grid, horizon, options, sign)


def _refuse_open(grid: object, name: str) -> None:
    """Raise if a grid has open ends; ``solve`` refuses other objects."""
    if isinstance(grid, Grid):
        checks.refuse_prescribed(grid, name, "which prescribe V and not a probability or a time")
    if isinstance(grid, Grid) and grid.sides("open"):
        raise ValueError(
            f"{name}: an open end extrapolates the value from inside, so it is not a probability or a time;\n"
            "use edges='projected' or 'constrained', or a box whose ends are in the target or in the obstacle"
        )


def _system(
    problem: Problem,
    target: Callable | None,
    obstacle: Callable | None,
    feedback: GridFeedback | Callable | None,
    horizon: float | None,
    name: str,
) -> tuple[Problem, Callable, Callable | None]:
    """The system, with a closed loop if there is a feedback, its target and its obstacle."""
    # check here, because its target is read before ``solve`` checks the problem
    if not isinstance(problem, Problem):
        raise TypeError(f"{name}: got {type(problem).__name__}, wanted a Problem")
    if problem.push_steps or problem.pushes:
        raise ValueError(
            f"{name}: got a problem with pushes; wanted one without, because a probability or a time cannot be added "
            "to a\ncost. Leave out pushes, or bound the speed of the motion by a control"
        )
    if problem.switching_costs is not None:
        raise ValueError(
            f"{name}: got modes with a switching_cost; wanted modes that change only at random, because a probability "
            "or a time\ncannot be added to a cost. Leave out switching_cost, or let the control set the rates: "
            "Modes(names, rates=lambda x, u: ...)"
        )
    inside = problem.target if target is None else as_partial(target, f"{name}: target")
    if inside is None:
        raise ValueError(f"{name}: there is nothing to reach: pass target=, a function ≤ 0 inside, or problem.target")
    hit = as_partial(obstacle, f"{name}: obstacle")  # a problem has no obstacle
    if feedback is None:
        return problem, inside, hit
    loop = exit_problems.close_loop(problem, feedback, horizon, name)
    # a marched feedback makes the loop depend on time, but the user's sets do not
    needs_time = loop.time_dependent and not problem.time_dependent
    return loop, exit_problems.with_time(inside, needs_time), exit_problems.with_time(hit, needs_time)


@contextlib.contextmanager
def _no_fallback_warning(feedback: GridFeedback | Callable | None) -> Iterator[None]:
    """Suppress the fallback warning if a Solution closes the loop, because its lookup per node is expected."""
    if not is_grid_feedback(feedback):  # warning filters are global, so change them only if necessary
        yield
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FallbackWarning)
        yield


def _without_end(question: Problem, grid: Grid, least: bool, options: dict) -> tuple[Problem, dict]:
    """The problem for all times, with options that find the least solution if there are several.

    Zero bounds the value. It is passed as a running maximum, or as a stopping cost for the greatest probability, whose
    sign is changed. The iteration then starts from zero, and no node counts as having no value.
    """
    options = {"tol": TOL} | options
    if not _count_staying(question, grid, options):
        # no node can stay away, so the solution is unique and any method finds it
        return question, options
    # P is at least zero and −P at most zero, so the bound does not change the value
    bound: dict[str, Any] = {"running_max" if least else "stopping_cost": jax.tree_util.Partial(_zero)}
    # another method may find another solution; a method that the caller passes is used all the same
    return altered(question, **bound), {"method": ValueIteration()} | options


def _has_no_chance(problem: Problem, options: dict) -> bool:
    """True if nothing in the system is random, and the caller passed neither scheme nor method."""
    return not is_random(problem) and options.get("scheme") is None and options.get("method") is None


def _yes_or_no(
    problem: Problem, grid: Grid, sets: tuple[Callable, Callable | None], horizon: float | None, options: dict,
    *, least: bool,
) -> Solution:  # fmt: skip
    """The probability, 0 or 1, with which a system without noise reaches the target and not the obstacle.

    The Markov chain of the scheme moves at random even without noise, so it is not used. The probability is 1 where a
    minimum time is finite, or where a tube contains the state.
    """
    if horizon is None and not (problem.is_game or least):
        question, is_one = exit_problems.arrival(problem, *sets), _is_finite
    else:
        question, is_one = exit_problems.tube(problem, *sets, least=least), _above if least else _below
    # warnings about the auxiliary problem, such as infinite times, do not apply to the probability
    with keeping_warnings(), _map_partial(lambda partial: _decided(partial, is_one)):
        found = solve(question, grid, **options) if horizon is None else march(question, grid, horizon, **options)
    return _decided(found, is_one)


def _decided(solution: Solution, is_one: Callable[[Any], Any]) -> Solution:
    """The solution with 1 where ``is_one`` and 0 elsewhere; error bounds of the old value are removed."""
    value: Any = solution.value
    xp: Any = jnp if is_traced(value) else np
    one = xp.asarray(is_one(value), value.dtype)
    return dataclasses.replace(
        solution, value=xp.where(xp.isnan(value), value, one), enclosure=None, monotone_error=None, grid_error=None,
        box_error=None,
    )  # fmt: skip


def _is_finite(value: Any) -> Any:
    """True where a time is finite."""
    return value < np.inf


def _below(value: Any) -> Any:
    """True in the tube of states that reach the target."""
    return value <= 0


def _above(value: Any) -> Any:
    """True in the tube of states that cannot avoid the target."""
    return value >= 0


def _zero(*where: Place) -> jax.Array:
    """Zero, a lower bound of every probability."""
    return jnp.zeros(())


def _count_staying(question: Problem, grid: Grid, options: dict) -> int:
    """The number of nodes at which some actions keep the state away from every end indefinitely; 0 while traced."""
    # the checks of ``solve`` in the same order, so that bad arguments are reported before all nodes are evaluated
    scheme, kind = options.get("scheme", Upwind()), arguments.as_dtype(options.get("dtype"))
    check_arguments(question, grid, options.get("method"), scheme, options["tol"])
    check_slopes(scheme, "probability: scheme")
    # the values of traced functions are unknown; see the module docstring
    if is_traced(question, grid):
        return 0
    # without a method, the one that takes the least memory; ``solve`` checks the memory of the method that it uses
    method = options.get("method") or ValueIteration()
    with own_settings(x64=kind == np.float64):
        memory.require(question, grid, method, kind, options.get("max_memory"))
        checks.shapes(question, grid, scheme)
        on = Discretisation(question, grid, scheme, kind)
        node_checks.check_values(on)
        # the monotone chain of the scheme, because slopes of higher order have no transition probabilities
        kept = attainability.refuge(on.chain)
        return int(np.sum(np.asarray(kept)))


def _refuse_staying(question: Problem, grid: Grid, options: dict) -> None:
    """Raise if the greatest time may be infinite, because no iteration would find it."""
    count = _count_staying(question, grid, options)
    if count:
        # in a game staying may need both players, so the time may be finite
        how, who = ("may be", "actions of both players keep") if question.is_game else ("is", "action keeps")
        raise ValueError(
            f"expected_exit_time: the greatest time {how} infinite: at {count} of {grid.size} nodes some {who} the "
            "state away from the target indefinitely;\ngive horizon= for E min(τ, horizon), or noise that drives it out"
        )


def _answer(question: Problem, grid: Grid, horizon: float | None, options: dict, sign: float) -> Solution:
    """sign · V of the problem, also for a partial solution."""
    # the chain by default, because slopes of higher order may slightly leave the range of a probability
    options = {"scheme": Upwind(split=horizon is not None)} | options
    # undo the change of sign in partial solutions, too
    with _map_errors(0.0, sign):
        found = solve(question, grid, **options) if horizon is None else march(question, grid, horizon, **options)
    return _affine(found, 0.0, sign)


def _map_errors(offset: float, sign: float) -> contextlib.AbstractContextManager[None]:
    """Replace V by offset + sign · V in the partial solution of an error raised inside."""
    return _map_partial(lambda partial: _affine(partial, offset, sign))


@contextlib.contextmanager
def _map_partial(change: Callable[[Solution], Solution]) -> Iterator[None]:
    """Apply ``change`` to the partial solution of an error raised inside."""
    try:
        yield
    except SolveError as error:
        if error.solution is not None:
            error.solution = change(error.solution)  # in place, so that the traceback stays the same
        raise


def _affine(solution: Solution, offset: float, sign: float) -> Solution:
    """Replace V by offset + sign · V; certificates do not hold for a negative cost and are removed."""
    if sign > 0:
        return dataclasses.replace(solution, value=offset + solution.value, stopping=None, active=None)
    return dataclasses.replace(solution, value=offset - solution.value, enclosure=None, stopping=None, active=None)
