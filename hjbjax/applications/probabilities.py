"""Front doors of probabilities and exit times: ``reach_probability``, ``stay_probability``, ``expected_exit_time``.

The equations are those of ``solve`` and ``march`` with the exit costs of ``exit_problems``; nothing is solved here.
For all times without discount a chain that may stay away for ever has more than one solution: there value iteration
from zero finds the least one, which is the probability; where every pair of actions must end, any method does. The
chain tells at host level; inside jit, vmap and grad it is taken for granted that every pair must end.
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
from hjbjax.discretisation.schemes import Upwind
from hjbjax.feedback.feedback import GridFeedback, Place, is_grid_feedback
from hjbjax.iteration.methods import ValueIteration
from hjbjax.markov_chain import attainability, memory, node_checks
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, front_door, is_traced
from hjbjax.problem.settings import own_settings
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import keeping_warnings
from hjbjax.solvers.finite_horizon import march
from hjbjax.solvers.stationary import check_arguments, solve
from hjbjax.tracing import checks
from hjbjax.tracing.interpreter import FallbackWarning

TOL = 1e-6  # the 1e-3 of ``solve`` would show in the third digit of a probability


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
    """The greatest probability with which the control can bring the state into the target.

    V(x) = sup_u inf_d P(x(τ) in the target, τ ≤ horizon), τ the first time in the target or in the obstacle, from
    min max (V_t + f·DV + ½ tr σσᵀD²V) = 0 with V = 1 on the target and 0 on the obstacle. Order and cost are those
    of ``march``, and of ``solve`` without a horizon. There is no certificate. Where for all times the state may stay
    away from both, value iteration from zero finds the probability among several solutions, which is slower. It stops
    at a step of at most 1e-9 (4e-6 in float32), which bounds nothing: where steps shrink slowly more is left.

    Without noise the probability is 0 or 1, and is read from a minimum time or from a tube. Not so if ``scheme`` or
    ``method`` is passed, or ``least`` together with ``obstacle``: then it is the probability of the Markov chain, which
    moves at random by about a cell.

    Inside ``jit``, ``vmap`` and ``grad`` a problem with noise is not searched for states that may stay away
    indefinitely. If there are any, the answer may be wrong.

    Args:
      problem: the system; its costs and its discount play no part.
      grid: the nodes.
      target: a function ≤ 0 inside; ``None`` is the problem's own target.
      obstacle: likewise: a path that comes there first has failed, also where the two overlap.
      horizon: until when, in units of time; ``None`` is for all times.
      least: the least probability instead: the control keeps away.
      feedback: a Solution or a function of the state that acts in place of the control; then nothing is optimised.
        Where a Solution has no action the state stays for ever. A marched one must have been kept at times that
        are dense enough up to the horizon.
      options: anything else that ``march`` takes, or ``solve`` without a horizon: times, scheme, method, ...; tol is
        that of ``solve``, 1e-6 by default: a bound on the residual and the last step. By default ``Upwind()``, whose
        answers are probabilities of a chain.

    Returns:
      A Solution whose value is the probability, and whose policy attains it.

    Raises:
      ValueError: no target; open ends; a feedback without controls; and what ``march`` and ``solve`` refuse.
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
    # a path that ends on the target gets 1, one that ends in the obstacle 0, one that never ends 0
    problem, inside, hit = _system(problem, target, obstacle, feedback, horizon, name)
    if _has_no_chance(problem, options):
        decides = least and (problem.is_game or problem.controls is not None)
        # to be kept out of the target by an obstacle is no tube
        if not (decides and hit is not None):
            with _no_fallback_warning(feedback):
                return _yes_or_no(problem, grid, (inside, hit), horizon, options, least=decides)
    sign = 1.0 if least else -1.0  # the control minimises: the greatest probability is minus the least of −P
    question = exit_problems.exit_problem(problem, inside, hit, 0.0, sign)  # no running cost: V is the exit cost alone
    with _no_fallback_warning(feedback):
        # over a horizon every path ends: the solution is unique, and no chain has to be surveyed
        if horizon is None:
            question, options = _without_end(question, grid, least, options)
        return _answer(question, grid, horizon, options, sign)


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
    """The greatest probability with which the control can keep the state in a region.

    V(x) = sup_u inf_d P(x(s) in the region for all s ≤ horizon), one minus the least probability of leaving it.

    Args:
      problem: the system; its costs, its discount and its target play no part.
      grid: the nodes; the region must not cover all of them, since at the edge of the box noise reflects.
      region: a function ≤ 0 inside; its boundary counts as outside.
      horizon: as in ``reach_probability``.
      least: the least probability instead: the control wants to get out.
      feedback: as in ``reach_probability``.
      options: as in ``reach_probability``.

    Returns:
      A Solution whose value is the probability, and whose policy attains it.

    Raises:
      ValueError: as ``reach_probability``.
      SolveError: no convergence, with the partial solution.

    Example:
      >>> import jax.numpy as jnp
      >>> import hjbjax as hjb
      >>> walk, grid = hjb.Problem(lambda x, u: 0 * x, noise=1.0), hjb.Grid([-1.0], [1.0], (41,))
      >>> kept = hjb.stay_probability(walk, grid, lambda x: jnp.abs(x[0]) - 1, horizon=1.0)
      >>> round(float(kept.value_at(0.0, [0.0])), 2)  # (4/π) e^{−π²/8} − ...
      0.37
    """
    # r ≤ 0 inside becomes −r ≤ 0 outside; both hold on the boundary, which so counts as left
    leaving = jax.tree_util.Partial(exit_problems.complement, as_partial(region, "stay_probability: region"))
    # P(stays) = 1 − P(leaves), also of a partial solution; the least probability of leaving is the greatest of staying
    with _map_errors(1.0, -1.0):
        left = reach_probability(problem, grid, leaving, horizon=horizon, least=not least, feedback=feedback, **options)
    # the policy needs no change: what makes leaving least likely makes staying most likely
    return _affine(left, 1.0, -1.0)


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
    """The least expected time in which the control can bring the state into the target.

    V(x) = inf_u sup_d E τ, τ the first time in the target: min max (1 + f·DV + ½ tr σσᵀD²V) = 0, V = 0 there. The
    bound on |V − V_h| is certified, except for the greatest time. Without noise and disturbance the scheme and the
    certificate are those of ``solve``, unless ``scheme`` or ``method`` is passed.

    Args:
      problem: the system; its costs and its discount play no part.
      grid: the nodes.
      target: a function ≤ 0 inside; ``None`` is the problem's own. To leave a region r ≤ 0 give −r.
      horizon: E min(τ, horizon) instead, by ``march``.
      greatest: the greatest expected time instead: the control stays as long as it can.
      feedback: as in ``reach_probability``.
      options: anything else that ``solve`` takes, or ``march`` with a horizon.

    Returns:
      A Solution whose value is the time, inf where the target is not reached for certain.

    Raises:
      ValueError: no target; open ends; asked for the greatest time, a control that may stay away for ever, in a game
        also if it needs the disturbance's help, which is not looked for inside ``jit``; and what ``solve`` and
        ``march`` refuse.
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
    sign = -1.0 if greatest else 1.0  # max E τ = −min E(−τ): a cost of −1 per unit time
    question = exit_problems.exit_problem(problem, inside, None, sign, 0.0)  # no exit cost: V is the time alone
    with _no_fallback_warning(feedback):
        if horizon is None:
            # what the user gives wins; a march has no tolerance
            options = {"tol": TOL} | options
            # the least time is inf where the target is out of reach, and is found; the greatest would grow without end
            if greatest:
                _refuse_staying(question, grid, options)
            elif _has_no_chance(problem, options) and not problem.is_game:
                options = {"scheme": None} | options  # the one that suits a path, as the chain may miss the target
        return _answer(question, grid, horizon, options, sign)


def _refuse_open(grid: object, name: str) -> None:
    """Refuse a grid with open ends; what is no grid is refused by ``solve``."""
    if isinstance(grid, Grid):
        grid.refuse_prescribed(name, "which prescribe V and not a probability or a time")
    if isinstance(grid, Grid) and grid.sides("open"):
        raise ValueError(
            f"{name}: beyond an open end a value is continued from inside, which makes no probability and no time of "
            "it;\nuse edges='projected' or 'constrained', or a box whose ends lie in the target or in the obstacle"
        )


def _system(
    problem: Problem,
    target: Callable | None,
    obstacle: Callable | None,
    feedback: GridFeedback | Callable | None,
    horizon: float | None,
    name: str,
) -> tuple[Problem, Callable, Callable | None]:
    """The system that runs, with its loop closed if there is a feedback, its target and its obstacle."""
    # here, since its target is read before ``solve`` would look at it
    if not isinstance(problem, Problem):
        raise TypeError(f"{name}: got {type(problem).__name__}, wanted a Problem")
    inside = problem.target if target is None else as_partial(target, f"{name}: target")
    if inside is None:
        raise ValueError(f"{name}: there is nothing to reach: give target=, a function ≤ 0 inside, or problem.target")
    hit = as_partial(obstacle, f"{name}: obstacle")  # the problem has no obstacle of its own
    if feedback is None:
        return problem, inside, hit
    loop = exit_problems.close_loop(problem, feedback, horizon, name)
    # a marched feedback makes the loop depend on the time, which the user's sets do not know of
    needs_time = loop.time_dependent and not problem.time_dependent
    return loop, exit_problems.with_time(inside, needs_time), exit_problems.with_time(hit, needs_time)


@contextlib.contextmanager
def _no_fallback_warning(feedback: GridFeedback | Callable | None) -> Iterator[None]:
    """No warning while a Solution closes the loop: its lookup node by node is no fault of the user's functions."""
    if not is_grid_feedback(feedback):  # filters of warnings belong to the whole process: not touched without need
        yield
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FallbackWarning)
        yield


def _without_end(question: Problem, grid: Grid, least: bool, options: dict) -> tuple[Problem, dict]:
    """The question for all times, and options by which the least of its solutions is found where it has several.

    Zero, a bound of the value, is given as a running maximum, or for the greatest probability, which comes with its
    sign changed, as a stopping cost: so that the iteration starts there, and no node is taken for one without a value.
    """
    options = {"tol": TOL} | options
    if not _count_staying(question, grid, options):
        # no node can stay away: the equation has one solution, and the user's or the default method finds it
        return question, options
    # +P is never below zero and −P never above it: neither bound changes the value
    bound: dict[str, Any] = {"running_max" if least else "stopping_cost": jax.tree_util.Partial(_zero)}
    # another method may find another of the solutions; who asks for one by name gets it
    return dataclasses.replace(question, **bound), {"method": ValueIteration()} | options


def _has_no_chance(problem: Problem, options: dict) -> bool:
    """True if the system has no noise, and the caller left scheme and method to the package."""
    return problem.noise is None and options.get("scheme") is None and options.get("method") is None


def _yes_or_no(
    problem: Problem, grid: Grid, sets: tuple[Callable, Callable | None], horizon: float | None, options: dict,
    *, least: bool,
) -> Solution:  # fmt: skip
    """The probability, 0 or 1, with which a system without noise comes into the target and not into the obstacle.

    The chain of such a system moves at random all the same, and would give a probability of its own. A minimum time is
    finite, or a tube has the sign, where the answer is yes.
    """
    if horizon is None and not (problem.is_game or least):
        question, is_one = exit_problems.arrival(problem, *sets), _is_finite
    else:
        question, is_one = exit_problems.tube(problem, *sets, least=least), _above if least else _below
    # warnings about that question, such as infinite times, do not apply to the probability
    with keeping_warnings(), _map_partial(lambda partial: _decided(partial, is_one)):
        found = solve(question, grid, **options) if horizon is None else march(question, grid, horizon, **options)
    return _decided(found, is_one)


def _decided(solution: Solution, is_one: Callable[[Any], Any]) -> Solution:
    """The solution with 1 where its value says so and 0 elsewhere; nothing said of the value holds of these."""
    value: Any = solution.value
    xp: Any = jnp if is_traced(value) else np
    one = xp.asarray(is_one(value), value.dtype)
    return dataclasses.replace(
        solution, value=xp.where(xp.isnan(value), value, one), enclosure=None, monotone_error=None, grid_error=None,
        box_error=None,
    )  # fmt: skip


def _is_finite(value: Any) -> Any:
    """Where a time is finite."""
    return value < np.inf


def _below(value: Any) -> Any:
    """The tube of what is reached."""
    return value <= 0


def _above(value: Any) -> Any:
    """The tube of what cannot be avoided."""
    return value >= 0


def _zero(*where: Place) -> jax.Array:
    """Zero, a bound of every probability."""
    return jnp.zeros(())


def _count_staying(question: Problem, grid: Grid, options: dict) -> int:
    """The number of nodes at which some actions keep the state away from every end for ever; 0 while traced."""
    # the checks of ``solve``, in its order: the survey of all nodes must not be the first to meet a bad argument
    scheme, kind = options.get("scheme", Upwind()), arguments.as_dtype(options.get("dtype"))
    check_arguments(question, grid, options.get("method"), scheme, options["tol"])
    # as the docstring of the module says: then it is taken for granted that every pair must end
    if is_traced(question, grid):  # values of the problem's functions are needed, which there are none of
        return 0
    method = options.get("method") or ValueIteration()  # needs the least; solve asks again for what it takes
    with own_settings(x64=kind == np.float64):
        memory.require(question, grid, method, kind, options.get("max_memory"))
        checks.shapes(question, grid, scheme)
        on = Discretisation(question, grid, scheme, kind)
        node_checks.values(on)
        # of the chain beneath the scheme: slopes of higher order make no transition probabilities
        kept = attainability.refuge(on.chain)
        return int(np.sum(np.asarray(kept)))


def _refuse_staying(question: Problem, grid: Grid, options: dict) -> None:
    """Refuse to ask for the greatest time where it may be infinite, which no iteration would find."""
    count = _count_staying(question, grid, options)
    if count:
        # in a game the players may have to help each other to stay: then the time need not be infinite
        how, who = ("may be", "actions of both players keep") if question.is_game else ("is", "action keeps")
        raise ValueError(
            f"expected_exit_time: the greatest time {how} infinite: at {count} of {grid.size} nodes some {who} the "
            "state away from the target for ever;\ngive horizon= for E min(τ, horizon), or noise that drives it out"
        )


def _answer(question: Problem, grid: Grid, horizon: float | None, options: dict, sign: float) -> Solution:
    """sign · V of the question, also for a partial solution."""
    # the chain's, unless it is asked for: slopes of high order may leave the range of a probability by a little
    options = {"scheme": Upwind(split=horizon is not None)} | options
    # a partial solution is handed to the user, who must not see the changed sign of the question
    with _map_errors(0.0, sign):
        found = solve(question, grid, **options) if horizon is None else march(question, grid, horizon, **options)
    return _affine(found, 0.0, sign)


def _map_errors(offset: float, sign: float) -> contextlib.AbstractContextManager[None]:
    """An error raised inside has offset + sign · V for V in its partial solution."""
    return _map_partial(lambda partial: _affine(partial, offset, sign))


@contextlib.contextmanager
def _map_partial(change: Callable[[Solution], Solution]) -> Iterator[None]:
    """An error raised inside leaves with its partial solution changed."""
    try:
        yield
    except SolveError as error:
        if error.solution is not None:
            error.solution = change(error.solution)  # in place: the traceback stays what it is
        raise


def _affine(solution: Solution, offset: float, sign: float) -> Solution:
    """The solution with offset + sign · V for V; no certificate holds for a cost that is negative."""
    if sign > 0:
        return dataclasses.replace(solution, value=offset + solution.value)
    return dataclasses.replace(solution, value=offset - solution.value, enclosure=None)
