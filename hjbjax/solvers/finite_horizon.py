"""Finite horizons: ``march``.

At host level it validates the arguments, computes the longest stable step, steps backward in chunks of about half a
second from one kept time to the next, and reports. Under a tracer the same steps run in a scan of fixed length.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation import schemes
from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.posing import with_horizon
from hjbjax.discretisation.schemes import Limited, Upwind
from hjbjax.hamiltonian import exact
from hjbjax.iteration import adjoint, bellman, time_stepping
from hjbjax.iteration.evaluation import check_choice
from hjbjax.iteration.time_methods import Explicit, TimeMethod
from hjbjax.iteration.time_stepping import March
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid, check_spacings
from hjbjax.problem.layouts import spans_processes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, as_one_program, cast, is_traced
from hjbjax.problem.sets import Box, refuse_unbounded
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, DType, Field, Mask, Nodes, Scalar
from hjbjax.solution import checkpoints
from hjbjax.solution.checkpoints import Checkpoint
from hjbjax.solution.clock import Clock, Stopped, noting_interrupts
from hjbjax.solution.placement import Path
from hjbjax.solution.rewards import with_rewards
from hjbjax.solution.solution import Solution, SolveError, question
from hjbjax.solution.status import Status
from hjbjax.solvers import host_loop, march_run, memory, time_probes
from hjbjax.solvers.contact import contact
from hjbjax.solvers.march_errors import Marched, with_march_errors
from hjbjax.solvers.result import solution_at_start, with_last_phase
from hjbjax.solvers.setup import check_on_one_state, march_evaluation
from hjbjax.solvers.stationary import check_node_values
from hjbjax.tracing import checks
from hjbjax.tracing.closures import with_settled_functions
from hjbjax.well_posedness import admissibility, node_checks

ROUNDING = 1e-12  # relative amount by which a kept time may exceed the horizon
PROBES = 33  # times at which a given step, and constrained ends, are checked for a time-dependent problem
FEWEST = 100  # number of steps if no stability limit is known in advance: implicit, or sampled rates

RISE, RISE_GIVEN = 0.02, 0.5  # largest growth of V per step: by default, and if the caller sets implicit steps

_stable_steps = jax.jit(time_stepping.stable_steps)
_fastest_growth = jax.jit(time_stepping.fastest_growth)
_obstacles = jax.jit(bellman.obstacles)


@with_rewards
@with_horizon
@with_settled_functions
def march(
    problem: Problem,
    grid: Grid,
    horizon: float,
    *,
    times: Sequence[float] | Array | None = None,
    start: Nodes | None = None,
    scheme: Scheme | None = None,
    method: TimeMethod | None = None,
    step: float | None = None,
    inner: float | None = None,
    policy: bool = True,
    dtype: DType | None = None,
    time_limit: float | None = None,
    throw: bool = True,
    progress: bool | None = None,
    max_memory: int | None = None,
    checkpoint: Path | Checkpoint | None = None,
    resume: bool = False,
    mesh: Mesh | None = None,
) -> Solution:
    """March a finite-horizon problem backward from its terminal cost at t = horizon to t = 0.

    min{ max{ β V − V_t − H(x, DV, D²V), V − ψ }, V − g } = 0,  V(·, horizon) = terminal cost (else ψ, else g, else 0).

    The scheme has order 1 in space with ``Upwind(...)``, which is monotone and keeps V in the range of the data; where
    V is smooth, order 2 with ``Limited()`` or ``Eno2()`` and 5 with ``Weno5()``. For the order in time see ``Explicit``
    and ``Implicit``.

    Args:
      problem: the problem; its functions may depend on time.
      grid: the grid.
      horizon: T > 0, in units of time.
      times: the times to keep, increasing, in [0, horizon]; ``None`` is (0.0,). Nothing else is stored.
      start: node values at the horizon instead of the terminal cost, shape (*grid), to continue another march.
      scheme: ``Upwind(...)``, ``Limited()``, ``Eno2()`` or ``Weno5()``; ``None`` is ``Limited(split=True)``, of second
        order, or ``Upwind(split=True)`` for implicit steps: in a game whose players drive the same component, each
        player's drift is upwinded separately, see ``Upwind``.
      method: ``Explicit(...)``, the default, whose steps the grid limits, or ``Implicit(...)``, with any step.
      step: the longest time step; ``None`` is the stable one, or a hundredth of the horizon if the method is implicit
        or the fastest action may be between the samples of its set. If the functions depend on time it is a hundredth
        of the horizon, and down to a 6400th where they change faster.
      inner: for a disturbance that is bounded only by the size of its ``Box``, as in an L₂ gain: the march stops with
        DIVERGED when the worst disturbance reaches that bound in this fraction of the grid's box about its middle,
        which indicates that the value blows up. ``None`` is 0: the bound is part of the problem and never stops the
        march.
      policy: return the policy with the value; otherwise only V is stored, as in ``ValueIteration(policy=False)``.
      dtype: ``None`` is float64; ``"float32"`` for memory and accelerators.
      time_limit: seconds, including checks and compilation.
      throw: raise if the march does not finish; otherwise the status reports it.
      progress: print each phase as it begins, and show a bar of the steps after a second; ``None``: on a terminal.
      max_memory: bytes that the march may use, instead of the free memory.
      checkpoint: as in ``solve``, like ``resume``; it includes the slices at kept times.
      resume: continue from that file if it exists, with the same bits; host level.
      mesh: as in ``solve``.

    Returns:
      The solution: ``value[i]`` is V(·, times[i]), shape (k, *grid), and similarly the policy. If the march stopped
      early, it contains the kept times that were reached, and the last time reached; after a time limit or Ctrl-C the
      policy at that last time may be missing, that is, NaN. Inside ``jit``, ``vmap`` and ``grad`` the value is traced,
      and ``horizon``, ``times`` and ``step`` must be known numbers. A step above the stability limit, or any other
      fault, makes it and its derivatives NaN, unless ``throw=False``.

    Raises:
      ValueError: an argument is invalid, or the step is above the stability limit.
      MemoryError: the grid does not fit; raised before anything is compiled.
      SolveError: the march stopped early; the partial solution is ``.solution``.

    Example:
      >>> import hjbjax as hjb
      >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-4.0], [4.0]))
      >>> solution = hjb.march(problem, hjb.Grid([-2.0], [2.0], (81,)), 1.0, scheme=hjb.Weno5())
      >>> round(float(solution.value_at(0.0, [1.0])), 4)  # tanh(1)
      0.7616
    """
    method = Explicit() if method is None else method
    if scheme is None:
        implicit = isinstance(method, TimeMethod) and method.monotone_only  # ``_check`` refuses everything else
        scheme = Upwind(split=True) if implicit else Limited(split=True)
    _check(problem, grid, scheme, method, step, time_limit)
    if not isinstance(policy, bool):
        raise TypeError(f"march: policy is {policy!r}; wanted True or False")
    _check_inner(problem, inner)
    checks.check_indices(grid)
    horizon, kept = _times(horizon, times)
    traced = is_traced(problem, grid, method, start)
    if mesh is not None:
        solved = () if method.limited else (method.evaluation or march_evaluation(problem, grid, divided=True),)
        mesh = checks.over_devices(mesh, "march", problem, grid, scheme, method, *solved, traced=traced)
    if traced:
        checkpoints.refuse_checkpoint(checkpoint, resume, "march")
        on = Discretisation(problem, grid, scheme, arguments.traced_dtype(dtype, "march"))
        return _march_traced(on, horizon, kept, start, method, step, inner, throw)
    kind = arguments.as_dtype(dtype)
    _check_distinct(kept, kind)
    check_node_values(start, grid, "march: start")
    check_spacings(grid, kind)
    clock = Clock(seconds=time_limit, progress=progress, together=spans_processes(mesh))
    opened = checkpoints.open_checkpoint(
        checkpoint, [problem], grid, resume=resume, caller="march", together=clock.together, horizon=horizon,
        times=kept, start=start, method=method, scheme=scheme, step=step, inner=inner, policy=policy, dtype=kind,
    )  # fmt: skip
    # float64 for this call only: the caller's own programs, and other threads, keep their type
    with noting_interrupts(clock), host_loop.announce(clock), own_settings(x64=kind == np.float64), opened as file:
        clock.journal = file and file.journal()
        # within a second: errors visible at a single state, and a grid that does not fit
        check_on_one_state(problem, grid, scheme)
        on = Discretisation(problem, grid, scheme, kind)
        asked = _Asked(on, horizon, kept, start, method, step, inner, policy, mesh)
        needed = memory.fitting(memory.of_march(on, len(kept), method, policy=policy), grid, max_memory, mesh)
        with host_loop.with_solution(clock, needed, lambda _: _solution_at_horizon(asked, Status.INTERRUPTED)):
            solution = _with_estimates(asked, clock)
    solution = with_last_phase(solution, clock)  # after the last write of the checkpoint, which may take long
    solution.stats.update(
        seconds=clock.stepping, compile_seconds=clock.elapsed() - clock.stepping, bytes=needed, horizon=horizon,
        start=start is not None,
        **({} if mesh is None else {"mesh": mesh.devices.shape}),
    )  # fmt: skip
    if clock.journal is not None:
        solution.stats["checkpoint"] = clock.journal.file.outcome
    if throw and solution.status is not Status.CONVERGED:
        raise SolveError(f"{solution.status.name}: {solution.message}", solution)
    return solution


@with_settled_functions
def march_part(
    problem: Problem,
    grid: Grid,
    horizon: float,
    *,
    start: Nodes,
    inner: float,
    scheme: Scheme | None,
    time_limit: float | None,
) -> Solution:
    """``march(..., throw=False)`` on the host for a part of a longer march, without the box error."""
    scheme, method = Limited(split=True) if scheme is None else scheme, Explicit()
    _check(problem, grid, scheme, method, None, time_limit)
    _check_inner(problem, inner)
    horizon, kept = _times(horizon, None)
    clock = Clock(seconds=time_limit)
    with noting_interrupts(clock), host_loop.announce(clock), own_settings(x64=True):
        check_on_one_state(problem, grid, scheme)
        on = Discretisation(problem, grid, scheme, np.dtype(np.float64))
        asked = _Asked(on, horizon, kept, start, method, step=None, inner=inner, policy=True)
        memory.fitting(memory.of_march(on, len(kept), method, policy=True), grid, None)
        try:
            _, solution = _on_host(asked, clock)
        except Stopped as stop:
            solution = _solution_at_horizon(asked, stop.status)
        return with_last_phase(solution, clock)


@dataclasses.dataclass(frozen=True)
class _Asked:
    """A march at host level, with checked arguments; see ``march``."""

    on: Discretisation
    horizon: float
    kept: np.ndarray
    start: Nodes | None
    method: TimeMethod
    step: float | None
    inner: float | None
    policy: bool
    mesh: Mesh | None = None


def _with_estimates(asked: _Asked, clock: Clock) -> Solution:
    """The solution of a march as far as the clock allows, with estimates of its errors if it reaches t = 0."""
    try:
        task, solution = _on_host(asked, clock)
        if solution.status is not Status.CONVERGED:
            return solution
        return with_march_errors(solution, Marched(task, asked.method, asked.start, int(solution.steps)), clock)
    except Stopped as stop:
        return _solution_at_horizon(asked, stop.status)


def _on_host(asked: _Asked, clock: Clock) -> tuple[March, Solution]:
    """The task of a march, and its solution as far as the clock allows.

    Raises:
      Stopped: the clock stopped the march before the first step.
      ValueError: V is not finite at the horizon.
    """
    on, horizon = asked.on, asked.horizon
    _check_nodes(on, horizon, clock, asked.mesh)
    task = _prepare(on, horizon, asked.method, asked.step, asked.inner, policy=asked.policy, mesh=asked.mesh)
    slices, front, code = march_run.drive_march(task, horizon, asked.kept, asked.start, clock)
    if code is Status.NONFINITE and int(front.steps) == 0:
        _refuse_at_horizon(on.problem, np.asarray(front.value), horizon)
    return task, march_run.assemble(task, on.grid, slices, front, code)


def _check_nodes(on: Discretisation, horizon: float, clock: Clock, mesh: Mesh | None) -> None:
    """Check the values of the problem's functions at all nodes, then leave the clock at the preparation."""
    problem = on.problem
    exact.check_unbounded(on)
    node_checks.check_values(on.asking(_without_moving_target(problem)), clock, mesh)
    # a drift that depends on time may respect a constrained end at one time and not at another
    for t in np.linspace(horizon, 0.0, PROBES) if problem.time_dependent else (0.0,):
        admissibility.check_constrained_ends(problem, on.grid, on.dtype, t)
    clock.enter("the preparation")


def _refuse_at_horizon(problem: Problem, value: np.ndarray, horizon: float) -> None:
    """Refuse a value at the horizon, (*grid), that is not finite."""
    count = int(np.sum(~np.isfinite(value)))
    if count:
        words = [problem.labels.word(f"a {name}_cost") for name in ("terminal", "stopping")]
        raise ValueError(
            f"march: V is NaN or infinite at {count} of {value.size} nodes at the horizon, t = {horizon:g}; wanted "
            f"finite numbers.\nWithout {words[0]}, V is {words[1]} there: pass {words[0]} that is finite"
        )


def _solution_at_horizon(asked: _Asked, code: Status) -> Solution:
    """The solution of a march that ended before its first step: its initial value; NaN if unknown."""
    on, horizon, start = asked.on, asked.horizon, asked.start
    value = np.full((1, *on.grid.shape), np.nan if start is None else np.asarray(start), on.dtype)
    message = f"The march did not leave t = {horizon:g}. {on.problem.labels.word(march_run.ADVICE[code])}"
    return altered(solution_at_start(on, value, code), times=np.array([horizon]), message=message)


def _check(problem: object, grid: object, scheme: Scheme, method: TimeMethod, step: object, time_limit: object) -> None:
    """Refuse arguments with which no march can start, without evaluating the problem's functions."""
    if not isinstance(problem, Problem) or not isinstance(grid, Grid):
        raise TypeError(f"march: got {type(problem).__name__}, {type(grid).__name__}; wanted a Problem and a Grid")
    schemes.check_scheme(scheme, "march: scheme", grid)
    check_choice(method, TimeMethod, "march: method", "hjb.Explicit(...) or hjb.Implicit(...)")
    if method.monotone_only and not scheme.monotone:
        raise ValueError(f"march: Implicit(...) solves with the matrix of a chain; got {scheme!r}, wanted Upwind(...)")
    if method.limited:
        for admissible in (problem.controls, problem.disturbances):
            refuse_unbounded(admissible, "march", "explicit steps are limited by the largest rate, Implicit() is not")
    if step is not None:
        arguments.positive(step, "march: step", "in units of time")
    if time_limit is not None:
        arguments.positive(time_limit, "march: time_limit", "in seconds", endless=True)


def _times(horizon: float, times: Sequence[float] | Array | None) -> tuple[float, np.ndarray]:
    """The horizon as a number, and the kept times as an increasing array in [0, horizon]; refuse all others."""
    if is_traced(horizon, times):
        raise ValueError("march: horizon and times set the number of steps and must be known numbers, not traced ones")
    arguments.positive(horizon, "march: horizon", "in units of time")
    try:
        kept = np.array((0.0,) if times is None else times, np.float64)
    except (TypeError, ValueError):
        kept = np.zeros(())
    if kept.ndim != 1 or kept.size == 0 or not np.all(np.isfinite(kept)):
        raise ValueError(f"march: times = {times!r}; wanted numbers in [0, horizon], e.g. np.linspace(0, horizon, 21)")
    if np.any(np.diff(kept) <= 0):
        first = int(np.argmax(np.diff(kept) <= 0))
        raise ValueError(
            f"march: times are not increasing: times[{first}] = {kept[first]:g}, times[{first + 1}] = "
            f"{kept[first + 1]:g}; sort them, for example with np.unique(times)"
        )
    if kept[-1] > horizon >= kept[-1] * (1 - ROUNDING):  # 3 × 0.1 is more than 0.3
        kept[-1] = horizon
    if kept[0] < 0 or kept[-1] > horizon:
        raise ValueError(f"march: times run from {kept[0]:g} to {kept[-1]:g}; wanted them in [0, {horizon:g}]")
    return float(horizon), kept


def _check_distinct(kept: np.ndarray, kind: np.dtype) -> None:
    """Refuse kept times that are the same number in the precision of the march."""
    if np.any(np.diff(kept.astype(kind)) <= 0):
        raise ValueError(f"march: two of the times {kept.tolist()} are the same number in {kind}; remove one")


def _without_moving_target(problem: Problem) -> Problem:
    """The problem without a target that depends on time, which may be outside the box at the time of the check."""
    if not problem.time_dependent or problem.target is None:
        return problem
    return altered(problem, target=None, exit_cost=None)


def _prepare(
    on: Discretisation,
    horizon: float,
    method: TimeMethod,
    step: float | None,
    inner: float | None,
    *,
    policy: bool,
    mesh: Mesh | None = None,
) -> March:
    """The task of a march, all arrays in its dtype, with a given step checked against the limit."""
    on, dtype = cast(on, on.dtype), on.dtype
    problem, grid = on.problem, on.grid
    moving = problem.time_dependent
    limit: Scalar = jnp.asarray(jnp.inf, dtype)
    method = method.filled(on, march_evaluation(problem, grid, divided=mesh is not None))
    if method.limited:
        # If functions depend on time, so does the limit 1/(max Q + β). A step that the caller passes is checked against
        # the limit at many times; otherwise the length is computed before every step.
        probes = np.linspace(horizon, 0.0, PROBES) if moving else [horizon]
        if step is not None or not moving:
            limits = [np.asarray(_stable_steps(on.at(np.asarray(t, dtype)), method)) for t in probes]
            stable, own = np.min(limits, axis=0)
            _check_step(step, float(stable))
            limit = own if step is None else stable
    looks = _checks(on, method)
    longest: Array | float = math.inf if step is None else step
    left = 0.0
    if moving:
        found = time_probes.resolution(problem, grid, horizon, dtype)
        time_probes.warn_of_fast_changes(found, horizon, step)
        longest, left = (found.lengths[:, None], found.left) if step is None else (step, 0.0)
    elif step is None and (looks[0] or not method.limited or _grows(problem)):
        # rates found during the march do not limit its first steps, and only a constant discount is integrated exactly
        longest = horizon / FEWEST
    if _grows(problem):
        longest = _within_growth(on, horizon, method, step, longest)
    obstacles = None if moving or not policy else _obstacles(on)
    return March(
        on, method, obstacles, None if moving and method.limited else limit, jnp.asarray(longest, dtype),
        jnp.asarray(horizon, dtype), _blow_up_nodes(on, inner),
        checks_rates=looks[0], checks_noise=looks[1], checks_gap=looks[2] and policy,
        checks_cut=_checks_cut(on) and policy and mesh is None, bare=not policy,
        missed=jnp.asarray(left, dtype), mesh=mesh,
    )  # fmt: skip


def _grows(problem: Problem) -> bool:
    """True if V may grow with the distance in time: its discount is a function, or its payments have a growth rate."""
    return problem.killing is not None or problem.growth is not None


def _within_growth(
    on: Discretisation, horizon: float, method: TimeMethod, step: float | None, longest: Array | float
) -> Array | float:
    """The longest step, limited by the growth of V; refuse a given implicit step that is too long for it."""
    moments = np.linspace(horizon, 0.0, PROBES) if on.problem.time_dependent else [horizon]
    growth = max(float(_fastest_growth(on.at(jnp.asarray(t, on.dtype)))) for t in moments)
    if growth <= 0:
        return longest
    if step is None:
        return np.minimum(longest, RISE / growth)
    if not method.limited and step * growth > RISE_GIVEN:
        raise ValueError(
            f"march: step = {step:g} is too long for a discount of {-growth:.6g} per unit time; wanted at most "
            f"{RISE_GIVEN / growth:.3g}.\nV grows by the factor 1/(1 + step · discount) per implicit step; remove step"
        )
    return longest


def _checks(on: Discretisation, method: TimeMethod) -> tuple[bool, bool, bool]:
    """Three flags, true if steps must check: the rates, correlated noise under their actions, and the Isaacs gap."""
    problem = on.problem
    players, moving = on.players, problem.time_dependent
    # Q is known in advance if it is largest at an end of the sets; otherwise only under the chosen actions
    sampled = not (players.control.fastest_at_ends and players.disturbance.fastest_at_ends)
    # a stage after the first is at a later time, at which Q may exceed the limit of the first
    rates = method.limited and (sampled or (moving and len(method.tableau.means) > 1))
    # if the players are decoupled, min max equals max min at every node
    gap = problem.is_game and not players.decoupled
    return rates, callable(problem.noise) and (moving or players.steers_noise), gap


def _checks_cut(on: Discretisation) -> bool:
    """True if time-dependent drift may leave between two kept times."""
    return on.problem.time_dependent and bool(on.grid.sides("projected"))


def _check_step(step: float | None, limit: float) -> None:
    """Refuse a step longer than the stability limit."""
    # allow for rounding in a limit computed by the caller, some 1e-7 in float32
    if step is not None and step > limit * (1 + 1e-6):
        raise ValueError(
            f"march: step = {step:g} is above the stability limit 1/(max Q + β) = {limit:.6g} of explicit steps "
            "on this grid;\nremove step, or use method=hjb.Implicit()"
        )


def _blow_up_nodes(on: Discretisation, share: float | None) -> Mask | None:
    """The nodes where a disturbance at its bound indicates a blow-up; or None."""
    return jnp.asarray(on.grid.inner(share)) if share else None


def _check_inner(problem: Problem, share: float | None) -> None:
    """Refuse ``inner`` outside [0, 1], and ``inner`` for a problem without a ``Box`` of disturbances."""
    share = 0.0 if share is None else share
    if not arguments.is_number(share) or not 0 <= share <= 1:
        raise ValueError(f"march: inner = {share!r}; wanted the fraction of the box to watch, from 0 (none) to 1")
    if share and not isinstance(problem.disturbances, Box):
        raise ValueError(f"march: inner = {share:g} requires disturbances in a Box; got {problem.disturbances!r}")


@as_one_program
def _march_traced(
    on: Discretisation,
    horizon: float,
    kept: np.ndarray,
    start: Nodes | None,
    method: TimeMethod,
    step: float | None,
    inner: float | None,
    throw: bool,
) -> Solution:
    """The solution of a march inside a JAX transformation, in a scan of fixed length: no chunks, fewer checks."""
    if step is None:
        raise ValueError(
            "march: inside jit, vmap and grad the number of steps must be known: pass step=, for explicit steps at "
            "most 1/(max Q + β) of every problem"
        )
    kind, problem, grid = on.dtype, on.problem, on.grid
    on, method = cast(on, kind), method.filled(on, march_evaluation(problem, grid))
    obstacles = None if problem.time_dependent else bellman.obstacles(on)
    checks_rates, checks_noise, _ = _checks(on, method)
    task = March(
        on, method, obstacles, jnp.inf, step, horizon, _blow_up_nodes(on, inner),
        checks_rates=checks_rates, checks_noise=checks_noise,
    )  # fmt: skip
    unmoved = on.asking(_without_moving_target(on.problem))  # with the numbers of the cast above
    fine = _is_stable(on, method, horizon, step) & ~node_checks.state_fails(jax.lax.stop_gradient(unmoved))
    reached = time_stepping.terminal(on.at(horizon), start), fine
    slices: list[Any] = []
    counts, ends = _intervals(horizon, kept, step)
    for steps, group in itertools.groupby(zip(counts, ends, strict=True), key=lambda each: each[0]):
        # one loop over intervals with the same number of steps, because a program per interval compiles for minutes
        rows = jnp.asarray([row for _, row in group], kind)
        reached, found = jax.lax.scan(functools.partial(_interval, task, steps), reached, rows)
        slices.append(found)
    fine = reached[1]
    found, sets = jax.tree.map(lambda *parts: jnp.concatenate(parts)[::-1], *slices)
    if throw:  # a factor instead of `where`, so that derivatives are NaN too
        found = jax.tree.map(lambda array: array * jnp.where(fine, 1, jnp.nan).astype(kind), found)
    code = jnp.where(fine, Status.CONVERGED, Status.STALLED if method.monotone_only else Status.DIVERGED)
    return Solution(
        grid, found[0], found[1], found[2] if problem.is_game else None, code=code, steps=sum(counts), times=kept,
        **sets,
        **question(problem),
    )  # fmt: skip


def _intervals(horizon: float, kept: np.ndarray, step: float) -> tuple[list[int], list[tuple[float, float, float]]]:
    """The number of steps of each interval from the horizon back, and its beginning, its end and the length of a step.

    The first interval has no steps if the last kept time is the horizon.
    """
    ends = list(itertools.pairwise([horizon, *kept[::-1].tolist()]))
    # without 1e-6 rounding could add a step to a whole number of steps
    counts = [max(math.ceil((begin - end) / step - 1e-6), int(begin > end)) for begin, end in ends]
    return counts, [(begin, end, (begin - end) / max(n, 1)) for (begin, end), n in zip(ends, counts, strict=True)]


def _interval(
    task: March, steps: int, reached: tuple[Field, jax.Array], row: jax.Array
) -> tuple[tuple[Field, jax.Array], tuple[tuple[jax.Array, ...], dict[str, jax.Array]]]:
    """Steps from one kept time to the next: V and the flag of no fault, then the slice and the sets of ``contact``.

    Args:
      task: the constants of the march.
      steps: the number of steps.
      reached: V at the beginning of the interval, and true if there was no fault.
      row: beginning and end of the interval, and the length of its steps.
    """
    on, (begin, end, dt) = task.on, row
    (value, ok), grid = time_stepping.repeat(task, reached[0], begin, dt, steps), task.grid
    obstacles = task.obstacles_at(end)
    pair = time_stepping.greedy_actions(task, value, end)
    if not on.players.exact:  # the result of a search has no derivative of its own, that of a formula has all
        pair = adjoint.attach_actions(on.at(end), pair, value, jnp.logical_not(obstacles.ended))
    u, d = (jnp.stack(each, -1) if each else jnp.zeros((*grid.shape, 0), value.dtype) for each in pair)
    fine = reached[1] & ok & jnp.all(jnp.isfinite(value))
    return (value, fine), ((value, u, d), contact(task.problem, grid, obstacles, value))


def _is_stable(on: Discretisation, method: TimeMethod, horizon: float, step: float) -> jax.Array:
    """True if steps of this length are stable at the checked times, as far as rates are known."""
    on, moving = jax.lax.stop_gradient(on), on.problem.time_dependent
    if not method.limited and not _grows(on.problem):
        return jnp.ones((), bool)

    def limit(t: Scalar | float) -> Scalar:
        if method.limited:
            return time_stepping.stable(on.at(t), method.tableau, 1 / method.tableau.euler)
        growth = time_stepping.fastest_growth(on.at(t))
        return jnp.where(growth > 0, RISE_GIVEN / jnp.where(growth > 0, growth, 1), jnp.inf)

    limits = jax.lax.map(limit, jnp.linspace(horizon, 0.0, PROBES, dtype=on.dtype)) if moving else limit(horizon)
    return step <= jnp.min(limits) * (1 + 1e-6)
