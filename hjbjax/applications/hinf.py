"""Robust control: the L₂-gain problem, and the least gain that a feedback can guarantee (H∞).

    ẋ = f(x, u) + E d,  cost L(x, u) − ½γ²|d|²,  L = ½|z|²:   0 = min_u max_d [ L − ½γ²|d|² + (f + E d)·DV ]

has a finite value V ≥ 0 if and only if some feedback keeps ∫|z|² ≤ γ²∫|d|² + 2V(x₀) for every d. V is the available
storage. The H∞ level is the least such γ. For a linear plant with z = (C x, u) and (C, A) detectable, it is the least γ
with a stabilising P ≥ 0 of A'P + PA − P(BB' − EE'/γ²)P + C'C = 0, and V = ½x'Px. An unstable mode that does not appear
in z costs nothing, so V may be finite at levels that no stabilising feedback attains. Therefore the closed loop is
simulated with d = 0 from the corners of the inner box at the end, and the result reports whether it comes back.

A bounded set of disturbances makes V finite for every γ, so infeasible levels are recognised by growth. The march
starts from V = 0. Its value V_T for the horizon T increases with T, because d = 0 is allowed and costs nothing, and its
limit is V. So γ is feasible if and only if V_T stays bounded. There are three outcomes:

* V_T settles in an inner box and in the whole box, and no d in the inner box is at its bound: feasible. V_T has settled
  if its growth from T to 2T is below a small fraction. It has also settled if the growth is below ten times this
  fraction and below a third of the previous growth.
* The worst disturbance reaches its bound in the inner box. The set then hides unbounded growth: infeasible.
* V_T still grows at the horizon, because the worst disturbance keeps the state where V grows at a constant rate, or
  because growth ends slowly near the level. This γ is not shown to be feasible.

The whole box counts because a nonlinear plant may have its largest gain away from the rest point. V near the rest point
then stays on a plateau until the worst path has reached that place. The plateau does not show how long this takes. The
level therefore depends on the box; use a smaller box for a local level. Because a plateau may end late, the marches for
the reported γ, and for a ``lo`` that has settled, continue to the horizon.

Doubling T makes the rule independent of the unit of time: a constant rate gives a growth of one half. At the level
itself V_T approaches a finite P like 1/T, so the growth halves per doubling. Above the level it falls faster. Below the
level, behind a bottleneck, it falls more slowly and then rises. The factor of a third decides earlier than waiting
until V stops growing. If τ is the time constant of the closed loop, a relative error e of the level is detected at
about T = τ/√e. Narrow sets of controls or disturbances, a small grid and a short horizon make the level too high, and
so do coarse grids if P grows without bound at the level. ``Weno5()`` is exact on quadratics and depends least on the
boundary of the grid. Sources: A. van der Schaft, L₂-gain and passivity techniques in nonlinear control; T. Başar and P.
Bernhard, H∞-optimal control and related minimax design problems.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable
from time import perf_counter

import numpy as np

from hjbjax.applications.l2_gain import Saturation, saturation
from hjbjax.applications.level import Growth, Level, Trial, comes_back
from hjbjax.discretisation.discretisation import Scheme
from hjbjax.discretisation.schemes import Weno5
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_discounted
from hjbjax.problem.pytree import front_door
from hjbjax.problem.rewards import refuse_rewards
from hjbjax.problem.sets import Ball, Box
from hjbjax.solution.clock import Clock, noting_interrupts
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status, keeping_warnings, warn
from hjbjax.solvers.finite_horizon import march_part
from hjbjax.tracing.closures import refuse_traced

DOUBLINGS = 6  # at most this number, so the first march covers a 64th of the horizon
SOON = 1e-6  # seconds: a time limit that ends a march after its initial evaluation
CUTS = {Status.INTERRUPTED: "interrupted", Status.TIME_LIMIT: "out of time"}
CLOSE, FALL = 10.0, 1 / 3  # growth below CLOSE * settle counts as settled if it fell by FALL; at the level it halves


@dataclasses.dataclass(frozen=True)
class Settling:
    """The rule by which V must settle, and the march that checks it.

    Args:
      inner: the fraction of the grid's box around its centre in which no disturbance may saturate.
      settle: growth per doubling of the time below which V has settled.
      horizon: the longest time to march.
      scheme: the scheme of the march.
      time_limit: seconds per γ, or None.
    """

    inner: float
    settle: float
    horizon: float
    scheme: Scheme
    time_limit: float | None


@front_door
def hinf_level(
    problem_of_gamma: Callable[[float], Problem],
    grid: Grid,
    lo: float,
    hi: float,
    *,
    tol: float = 0.01,
    inner: float = 0.25,
    settle: float = 3e-3,
    horizon: float = 64.0,
    scheme: Scheme = Weno5(),
    time_limit: float | None = None,
) -> Level:
    """Find the least γ that a feedback can guarantee in the box, by bisection; see the module docstring for the rule.

    Each γ takes one march, which stops as soon as it is decided. The march of the reported γ continues to the horizon.
    V must settle over the whole box, so the level of a nonlinear plant depends on the box. The level is too high if a
    set of controls or disturbances is too narrow, if worst paths leave the grid, or if the horizon is short. The table
    shows how the marches below the level ended. The level of a stabilising feedback requires that L detects every
    unstable mode; ``Level.stabilises`` is False if a simulation without a disturbance shows that it does not.

    Args:
      problem_of_gamma: a function of γ that returns the game with cost L − ½γ²|d|², for example
        ``lambda gamma: hjb.attenuation(plant, gamma, set)``. If γ is a leaf, as there, nothing is compiled again.
      grid: a grid around the rest point.
      lo: an infeasible γ.
      hi: a feasible γ.
      tol: relative width of the final bracket.
      inner: the fraction of the grid's box, around its centre, where V must settle without saturation. In the rest of
        the box V must settle as well, but disturbances may be at their bound.
      settle: growth of V per doubling of the time below which it has settled.
      horizon: the longest time to march, in units of time; use many times the slowest time constant of the closed loop.
      scheme: as in ``march``.
      time_limit: seconds per γ, for all of its marches together.

    Returns:
      The level with its bracket, and the result at every γ.

    Raises:
      ValueError: not 0 < lo < hi; ``lo`` is feasible or ``hi`` infeasible; the problem has no disturbances, or has a
        discount, a target or another part that makes V differ from a gain.
      TypeError: ``problem_of_gamma`` does not return a problem.
      SolveError: the search was interrupted, or a march ran out of time; ``.solution`` is the Level so far, with the
        bracket and all trials, including the one of the unfinished march.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-4.0], [4.0]))
      >>> def game(gamma):
      ...     return hjb.attenuation(plant, gamma, hjb.Box([-4.0], [4.0]))
      >>> level = hjb.hinf_level(game, hjb.Grid([-1.0], [1.0], (21,)), 0.5, 1.0)
      >>> abs(level.gamma / 0.5**0.5 - 1) < 0.02
      True
    """
    if not isinstance(grid, Grid):
        raise TypeError(f"hinf_level: got {type(grid).__name__} for the grid, wanted a Grid")
    settling = Settling(inner, settle, horizon, scheme, time_limit)
    _check_rule(problem_of_gamma, lo, hi, tol, settling)
    trials: dict[float, Trial] = {}
    said: dict[float, list[str]] = {}
    clock = Clock()

    def at(gamma: float, before: Trial | None = None) -> Trial:
        problem = problem_of_gamma(gamma)
        _check_problem(problem, gamma)
        # V has no limit at an infeasible γ, so warnings of its march do not concern the level
        with keeping_warnings() as said[gamma]:
            trial = _try(problem, grid, float(gamma), settling, before)
        trials[gamma] = trial
        if trial.reason in CUTS.values():
            level = _level(list(trials.values()), trial)
            raise SolveError(f"hinf_level: at gamma = {gamma:g}: {trial.solution.message}", level)
        return trial

    with noting_interrupts(clock):
        _bisect(at, lo, hi, tol, settle)
        level = _level(list(trials.values()))
        if not clock.interrupted:
            stabilises = comes_back(problem_of_gamma(level.gamma), level.solution, inner, horizon)
            level = dataclasses.replace(level, stabilises=stabilises)
        if clock.interrupted:
            level = dataclasses.replace(level, status=Status.INTERRUPTED)
            raise SolveError(f"hinf_level: interrupted after the search had finished: {level!r}", level)
    for message in dict.fromkeys(said[level.gamma]):
        warn(message)
    return level


def _bisect(at: Callable[..., Trial], lo: float, hi: float, tol: float, settle: float) -> None:
    """Try values of γ until the bracket is narrow enough and its upper end is feasible up to the horizon."""
    # hi first: if even hi fails, the sets, the grid or the horizon are the cause, and lo is irrelevant
    feasible: tuple[Trial, ...] = (at(hi),)
    if not feasible[0].feasible:
        raise ValueError(f"hinf_level: hi = {hi:g} is not feasible: {_why(feasible[0], settle)}")
    bottom = at(lo)
    if bottom.feasible and (bottom := at(lo, bottom)).feasible:
        raise ValueError(
            f"hinf_level: lo = {lo:g} is feasible: V settles at {bottom.value:.3g} after t = {bottom.time:g}; "
            "use a smaller lo"
        )
    while feasible:
        bottom, feasible = _narrowed(at, bottom, feasible, tol)
        # continue to the horizon, because V may have been on a plateau
        bottom = at(feasible[-1].gamma, feasible[-1])
        if bottom.feasible:
            return
        feasible = feasible[:-1]
    raise ValueError(f"hinf_level: hi = {hi:g} is not feasible: {_why(bottom, settle)}")


def _narrowed(
    at: Callable[..., Trial], bottom: Trial, feasible: tuple[Trial, ...], tol: float
) -> tuple[Trial, tuple[Trial, ...]]:
    """Bisect the bracket: return its lower end, and all feasible trials with the least γ last."""
    while feasible[-1].gamma > bottom.gamma * (1 + tol):
        # the geometric mean, because tol is relative
        middle = at(math.sqrt(bottom.gamma * feasible[-1].gamma))
        if middle.feasible:
            feasible = (*feasible, middle)
        else:
            bottom = middle
    return bottom, feasible


def _level(trials: list[Trial], cut: Trial | None = None) -> Level:
    """The level from the trials so far; the trial ``cut`` has no verdict."""
    top = min((trial.gamma for trial in trials if trial.feasible), default=math.inf)
    bottom = max((trial.gamma for trial in trials if not trial.feasible and trial is not cut), default=0.0)
    # a trial that was cut short is listed, but does not move an end of the bracket
    status = Status.CONVERGED if cut is None else cut.solution.status
    return Level(top, (bottom, top), tuple(sorted(trials, key=lambda trial: trial.gamma)), status)


def _try(problem: Problem, grid: Grid, gamma: float, settling: Settling, before: Trial | None) -> Trial:
    """Decide one γ: double the time of the march until V settles, until d saturates, or up to the horizon.

    Args:
      problem: the game at γ.
      grid: the grid.
      gamma: γ.
      settling: the rule.
      before: a settled trial of the same γ, whose march continues to the horizon.
    """
    going_on = ("growing",) if before is None else ("growing", "settled")
    trial = before
    so_far = Growth((np.zeros(grid.shape),)) if before is None else before.march
    # the sum of the spans equals the horizon only up to rounding
    while trial is None or (trial.reason in going_on and so_far.time < settling.horizon * (1 - 1e-9)):
        trial = _longer(problem, grid, gamma, so_far, settling)
        so_far = trial.march
    return trial


def _longer(problem: Problem, grid: Grid, gamma: float, so_far: Growth, settling: Settling) -> Trial:
    """Decide one γ after a march over twice the time."""
    began, inner, inside = perf_counter(), settling.inner, _inner_nodes(grid, settling.inner)
    # the march stops early if the worst disturbance reaches the bound of a Box; for a Ball only the end is checked
    watch = inner if isinstance(problem.disturbances, Box) else 0.0
    span = so_far.time or settling.horizon / 2**DOUBLINGS
    # never ≤ 0: march requires a positive limit, and returns after its initial evaluation
    left = settling.time_limit and max(settling.time_limit - so_far.seconds, SOON)
    # the march from V = 0 over 2T equals a march from V_T over T
    solution = march_part(
        problem, grid, span, start=so_far.values[-1], inner=watch, scheme=settling.scheme, time_limit=left
    )
    # a march that stopped early ends at times[0] > 0, so less than the span has passed
    time = so_far.time + span - float(solution.times[0])
    if solution.status in CUTS:
        return _no_verdict(solution, gamma, so_far, time, inner)
    values = (*so_far.values, np.asarray(solution.value[0]))[-3:]
    bound = saturation(solution, problem, inner=inner)
    grew = [_grew(values, nodes, settling.settle) for nodes in (inside, np.ones_like(inside))]
    reason = _reason(solution.status, bound, all(settled for _, settled in grew))
    size = float(np.max(np.abs(values[-1][inside])))
    growth = max(share for share, _ in grew)
    later = Growth(values, time, so_far.seconds + perf_counter() - began)
    return Trial(gamma, reason == "settled", reason, time, growth, size, bound, _as_stationary(solution, time), later)


def _grew(values: tuple[np.ndarray, ...], nodes: np.ndarray, settle: float) -> tuple[float, bool]:
    """The relative growth of V over the last doubling in a part of the box, and True if V has settled there."""
    size = float(np.max(np.abs(values[-1][nodes])))
    # there is no growth before the first doubling
    gains = [math.inf, *(float(np.max(np.abs(after - before)[nodes])) for before, after in itertools.pairwise(values))]
    growth = gains[-1] / size if size else 0.0
    return growth, growth <= settle or (growth <= CLOSE * settle and gains[-1] <= FALL * gains[-2])


def _no_verdict(solution: Solution, gamma: float, so_far: Growth, time: float, inner: float) -> Trial:
    """A trial without a verdict, for a march that was cut short."""
    kept = _as_stationary(solution, time)
    size = float(np.max(np.abs(kept.value[kept.grid.inner(inner)])))
    unknown = Saturation(math.nan, math.nan, np.full(kept.grid.ndim, math.nan), inner)
    return Trial(gamma, False, CUTS[solution.status], time, math.nan, size, unknown, kept, so_far)


def _as_stationary(solution: Solution, total: float) -> Solution:
    """The last slice of a march over the time ``total``, as a stationary solution."""
    # the first of the stored times is the last one that was marched
    first = {name: getattr(solution, name)[0] for name in ("value", "policy", "disturbance")}
    return dataclasses.replace(solution, times=None, stats={**solution.stats, "horizon": total}, **first)


def _reason(status: Status, bound: Saturation, settled: bool) -> str:
    """The value of ``Trial.reason`` after a march."""
    # the march reports DIVERGED if a watched disturbance reached its bound; check saturation first, because with
    # saturated d V also settles, at a value determined by the set
    if status is Status.DIVERGED or bound.share > 0:
        return "saturated"
    if status is not Status.CONVERGED:
        return "not finite"
    return "settled" if settled else "growing"


def _why(trial: Trial, settle: float) -> str:
    """Explain the end of an infeasible trial, with advice."""
    if trial.reason == "saturated":
        return f"{trial.saturation};\nuse a larger hi, wider sets of controls and disturbances, or a smaller inner"
    if trial.reason == "growing":
        return (
            f"V still grew by {trial.growth:.2g} of itself over the last doubling of the time to {trial.time:g}, "
            f"settle = {settle:g};\nuse a larger hi or a longer horizon, a larger grid if worst paths leave it, or a "
            "smaller one if the gain is large only far from the rest point"
        )
    return f"{trial.solution.message}\nCheck drift and cost, or use a larger hi"


def _inner_nodes(grid: Grid, inner: float) -> np.ndarray:
    """The nodes of the inner box, bool (*grid); raises ValueError if an axis has fewer than 3 of them."""
    inside = grid.inner(inner)
    if not np.all([np.sum(np.any(inside, axis=_others(grid, k))) >= 3 for k in range(grid.ndim)]):
        raise ValueError(f"hinf_level: inner = {inner:g} of {grid.shape} nodes contains fewer than 3 along an axis")
    return inside


def _others(grid: Grid, axis: int) -> tuple[int, ...]:
    """All axes but one."""
    return tuple(k for k in range(grid.ndim) if k != axis)


def _check_rule(make: object, lo: float, hi: float, tol: float, settling: Settling) -> None:
    """Raise if the numbers do not allow a bisection."""
    if not callable(make):
        raise TypeError(f"hinf_level: problem_of_gamma is {make!r}, wanted a function of gamma that returns a Problem")
    for name, number, most in (
        ("lo", lo, math.inf),
        ("hi", hi, math.inf),
        ("tol", tol, 1),
        ("inner", settling.inner, 1),
        ("settle", settling.settle, 0.5),  # growth at a constant rate is one half for every T
        ("horizon", settling.horizon, math.inf),
    ):
        arguments.positive(number, f"hinf_level: {name}", most=most)
    if lo >= hi:
        raise ValueError(f"hinf_level: got lo = {lo:g} and hi = {hi:g}, wanted lo < hi")


def _check_problem(problem: object, gamma: float) -> None:
    """Raise if the value of the problem is not determined by a gain."""
    if not isinstance(problem, Problem):
        raise TypeError(f"hinf_level: problem_of_gamma({gamma:g}) returned {problem!r:.60}, wanted a Problem")
    refuse_traced("hinf_level", problem)
    refuse_rewards(problem, "hinf_level", "V shows a gain by the energy of an output, which is a cost")
    if not isinstance(problem.disturbances, (Box, Ball)):
        raise ValueError(
            f"hinf_level: problem_of_gamma({gamma:g}) has disturbances {problem.disturbances!r:.60}; wanted a Box or a "
            "Ball, as in hjb.attenuation(plant, gamma, hjb.Box(...))"
        )
    for name in ("noise", "terminal_cost", "stopping_cost", "running_max", "target"):
        if getattr(problem, name) is not None:
            raise ValueError(f"hinf_level: the problem has a {name}, with which V does not show a gain; remove it")
    if is_discounted(problem) is not False:
        raise ValueError(
            f"hinf_level: the problem has discount = {problem.discount}, with which V settles even if the gain is "
            "violated; remove it"
        )
    if problem.time_dependent or problem.cost is None:
        raise ValueError("hinf_level: wanted a problem that has a cost and does not depend on time")
