"""Robust control: the L₂-gain problem, and the least gain that a feedback can hold (H∞).

    ẋ = f(x, u) + E d,  cost L(x, u) − ½γ²|d|²,  L = ½|z|²:   0 = min_u max_d [ L − ½γ²|d|² + (f + E d)·DV ]

has a finite value V ≥ 0 exactly where some feedback keeps ∫|z|² ≤ γ²∫|d|² + 2V(x₀) for every d: the available
storage. The H∞ level is the least such γ. For a linear plant with z = (C x, u) and (C, A) detectable it is the least γ
with a stabilising P ≥ 0 of A'P + PA − P(BB' − EE'/γ²)P + C'C = 0, and V = ½x'Px. An unstable mode that z does not see
costs nothing to leave alone: V is then finite at levels that no stabilising feedback holds. So at the end the loop is
run with d = 0 from the corners of the inner box, and the answer says where it does not come back.

How infeasible is told from feasible, where a bounded set of disturbances makes every γ finite: march from V = 0. The
value V_T of the problem over the time T grows with T, since d = 0 is allowed and costs nothing, and its limit is V, so
that γ is feasible if and only if V_T stays bounded. In an inner box, away from the edge, one of three things is seen:

* V_T settles, and no d sits on its bound: from T to 2T it grows by less than a small fraction, or by not ten times as
  much and by less than a third of what it grew by before. Feasible.
* The worst disturbance comes to its bound: what would be unbounded is cut off there. Infeasible.
* V_T still grows at the horizon, be it that the worst disturbance takes the state to the edge of the grid and gains
  there at a constant rate, or that the growth is slow near the level. Not shown to be feasible.

Doubling T has no scale: a constant rate makes growth one half, in any unit. At the level itself a P that stays finite
is approached like 1/T, so that what is gained halves with each doubling; above the level it falls faster each time,
below it, behind a bottleneck, slower, and rises. A third tells them apart sooner than waiting until all has settled:
for a time constant τ of the closed loop a level that is off by the fraction e shows at T of about τ/√e. Narrow sets of
controls or disturbances, a small grid and a short horizon make the level too high; so do coarse grids where P grows
without bound at the level. ``Weno5()`` is exact on quadratics, and of all schemes feels the edge of the grid least.
Source: A. van der Schaft, L₂-gain and passivity techniques in nonlinear control; T. Başar and P. Bernhard,
H∞-optimal control and related minimax design problems.
"""

import dataclasses
import math
from collections.abc import Callable
from time import perf_counter

import numpy as np

from hjbjax.applications.l2_gain import Saturation, saturation
from hjbjax.applications.level import Level, Trial, comes_back
from hjbjax.discretisation.discretisation import Scheme
from hjbjax.discretisation.schemes import Weno5
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_discounted
from hjbjax.problem.pytree import front_door
from hjbjax.problem.sets import Ball, Box
from hjbjax.solution.clock import Clock, noting_interrupts
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status
from hjbjax.solvers.finite_horizon import march_part

DOUBLINGS = 6  # of the time marched, at most: the first look is at a 64th of the horizon
SOON = 1e-6  # seconds: a limit that ends a march after its first look
CUTS = {Status.INTERRUPTED: "interrupted", Status.TIME_LIMIT: "out of time"}
CLOSE, FALL = 10.0, 1 / 3  # growth so near settle counts as settled if it falls by this factor; at the level it halves


@dataclasses.dataclass(frozen=True)
class Settling:
    """Where, how far and until when V must settle.

    Args:
      inner: the share of the grid's box that is looked at, around its middle.
      settle: growth over a doubling of the time below which V has settled.
      horizon: the longest time to march.
    """

    inner: float
    settle: float
    horizon: float


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
    """The least γ that a feedback can hold, by bisection; the rule is in the module's docstring.

    Each γ takes one march, which stops as soon as it is decided. The level comes out too high where a set of controls
    or disturbances is too narrow, where worst paths from the inner box leave the grid, or where the horizon is short;
    the table says how the marches below it ended. For a level with stability every unstable mode must be seen in L
    (detectability); ``Level.stabilises`` is False where a run without a disturbance shows one that is not.

    Args:
      problem_of_gamma: γ to the game with cost L − ½γ²|d|², as ``lambda gamma: hjb.attenuation(plant, gamma, set)``.
        Where γ is a leaf, as there, nothing is compiled again.
      grid: the nodes, around the rest point.
      lo: a γ that is infeasible.
      hi: a γ that is feasible.
      tol: how close the bracket is to be, relative to γ.
      inner: the share of the grid's box, around its middle, where V must settle without saturation.
      settle: growth of V over a doubling of the time below which it has settled.
      horizon: the longest time to march, in units of time: many times the slowest of the closed loop.
      scheme: as for ``march``.
      time_limit: seconds for one γ, all of its marches together.

    Returns:
      The level with its bracket, and what was found at every γ.

    Raises:
      ValueError: not 0 < lo < hi; feasible at lo, infeasible at hi; a problem without disturbances, or with a discount,
        a target or anything else with which V tells no gain.
      TypeError: something that makes no problem.
      SolveError: it was interrupted, or a march ran out of time; ``.solution`` is the Level so far, with the bracket
        and all trials, that of the unfinished march among them.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-4.0], [4.0]))
      >>> def game(gamma):
      ...     return hjb.attenuation(plant, gamma, hjb.Box([-4.0], [4.0]))
      >>> level = hjb.hinf_level(game, hjb.Grid([-1.0], [1.0], (21,)), 0.5, 1.0)
      >>> abs(level.gamma / 0.5**0.5 - 1) < 0.02
      True
    """
    settling = Settling(inner, settle, horizon)
    _check_rule(problem_of_gamma, lo, hi, tol, settling)
    clock, trials = Clock(), []

    def at(gamma: float) -> Trial:
        problem = problem_of_gamma(gamma)
        _check_problem(problem, gamma)
        trial = _try(problem, grid, float(gamma), settling, scheme, time_limit)
        trials.append(trial)
        if trial.reason in CUTS.values():
            raise SolveError(f"hinf_level: at gamma = {gamma:g}: {trial.solution.message}", _level(trials, trial))
        return trial

    with noting_interrupts(clock):
        _bisect(at, lo, hi, tol, settle)
        level = _level(trials)
        if not clock.interrupted:
            stabilises = comes_back(problem_of_gamma(level.gamma), level.solution, inner, horizon)
            level = dataclasses.replace(level, stabilises=stabilises)
        if clock.interrupted:
            level = dataclasses.replace(level, status=Status.INTERRUPTED)
            raise SolveError(f"hinf_level: interrupted after it had come to its end: {level!r}", level)
    return level


def _bisect(at: Callable[[float], Trial], lo: float, hi: float, tol: float, settle: float) -> None:
    """Try γ after γ until the bracket is narrow enough."""
    top = at(hi)  # first: where even hi fails, sets, grid or horizon are at fault, and lo says nothing more
    if not top.feasible:
        raise ValueError(f"hinf_level: hi = {hi:g} is not feasible: {_why(top, settle)}")
    bottom = at(lo)
    if bottom.feasible:
        raise ValueError(
            f"hinf_level: lo = {lo:g} is feasible: V settles at {bottom.value:.3g} after t = {bottom.time:g}; "
            "give a smaller lo"
        )
    while top.gamma > bottom.gamma * (1 + tol):
        # the geometric mean: tol is relative, and each trial halves the logarithm of what is left
        middle = at(math.sqrt(bottom.gamma * top.gamma))
        bottom, top = (bottom, middle) if middle.feasible else (middle, top)


def _level(trials: list[Trial], cut: Trial | None = None) -> Level:
    """The level by the trials so far, of which ``cut`` came to no verdict."""
    top = min((trial.gamma for trial in trials if trial.feasible), default=math.inf)
    bottom = max((trial.gamma for trial in trials if not trial.feasible and trial is not cut), default=0.0)
    # a trial that was cut has shown nothing: it is listed, and bounds the bracket on neither side
    status = Status.CONVERGED if cut is None else cut.solution.status
    return Level(top, (bottom, top), tuple(sorted(trials, key=lambda trial: trial.gamma)), status)


def _try(
    problem: Problem,
    grid: Grid,
    gamma: float,
    settling: Settling,
    scheme: Scheme,
    time_limit: float | None,
) -> Trial:
    """The verdict on one γ: the time marched is doubled until the value settles, saturates or the horizon is there."""
    began, left = perf_counter(), time_limit
    inner, settle, horizon = settling.inner, settling.settle, settling.horizon
    # a march stops by itself where the worst case comes to the bound of a Box; of a Ball only its end is looked at
    watch = inner if isinstance(problem.disturbances, Box) else 0.0
    inside = grid.inner(inner)
    # some node of the inner box needs both of its neighbours in it
    if not np.all([np.sum(np.any(inside, axis=_others(grid, k))) >= 3 for k in range(grid.ndim)]):
        raise ValueError(f"hinf_level: inner = {inner:g} of {grid.shape} nodes holds fewer than 3 along an axis")
    # gains: of V over each doubling, the first against nothing before
    value, total, span, gains = np.zeros(grid.shape), 0.0, horizon / 2**DOUBLINGS, [math.inf]
    while True:
        # V_T goes on from where it stood: the march from V = 0 over 2T is one over T from V_T
        solution = march_part(problem, grid, span, start=value, inner=watch, scheme=scheme, time_limit=left)
        if solution.status in CUTS:
            return _no_verdict(solution, gamma, total + span - float(solution.times[0]), inner)
        # a march that was decided early stands at times[0] > 0, and less than the span has passed
        after, total = np.asarray(solution.value[0]), total + span - float(solution.times[0])
        size, gain = (float(np.max(np.abs(each[inside]))) for each in (after, after - value))
        bound = saturation(solution, problem, inner=inner)
        reason = _reason(solution.status, bound, gain / size if size else 0.0, gain / gains[-1], settle)
        if reason or total >= horizon * (1 - 1e-9):  # the total is a sum of spans, by rounding
            break
        value, span, gains = after, total, [*gains, gain]  # as long again as all before: T doubles
        # never 0 or less: march wants a positive limit, and hands back what there is after its first look
        left = time_limit and max(time_limit - (perf_counter() - began), SOON)
    kept = _as_stationary(solution, total)
    reason, growth = reason or "growing", gain / size if size else 0.0
    return Trial(gamma, reason == "settled", reason, total, growth, size, bound, kept)


def _no_verdict(solution: Solution, gamma: float, total: float, inner: float) -> Trial:
    """A trial without a verdict, from a march that was cut short."""
    kept = _as_stationary(solution, total)
    size = float(np.max(np.abs(kept.value[kept.grid.inner(inner)])))
    unknown = Saturation(math.nan, math.nan, np.full(kept.grid.ndim, math.nan), inner)
    return Trial(gamma, False, CUTS[solution.status], total, math.nan, size, unknown, kept)


def _as_stationary(solution: Solution, total: float) -> Solution:
    """The last slice of a march over the time ``total`` as a stationary solution."""
    # of the kept times, the leading axis, the first is the last that was marched
    first = {name: getattr(solution, name)[0] for name in ("value", "policy", "disturbance")}
    return dataclasses.replace(solution, times=None, stats={**solution.stats, "horizon": total}, **first)


def _reason(status: Status, bound: Saturation, growth: float, ratio: float, settle: float) -> str:
    """The verdict after a march, as ``Trial.reason`` has it; empty to go on."""
    # DIVERGED is what the march calls a disturbance that came to its bound while it watched
    # first of all: where d is cut off V settles too, at a value that is the set's and no gain
    if status is Status.DIVERGED or bound.share > 0:
        return "saturated"
    if status is not Status.CONVERGED:
        return "not finite"
    falls = growth <= CLOSE * settle and ratio <= FALL
    return "settled" if growth <= settle or falls else ""


def _why(trial: Trial, settle: float) -> str:
    """The end of a trial that is not feasible and advice, in words."""
    if trial.reason == "saturated":
        return f"{trial.saturation};\ngive a larger hi, wider sets of controls and disturbances, or a smaller inner"
    if trial.reason == "growing":
        return (
            f"V still grew by {trial.growth:.2g} of itself over the last doubling of the time to {trial.time:g}, "
            f"settle = {settle:g};\ngive a larger hi, a longer horizon, or a larger grid if worst paths leave it"
        )
    return f"{trial.solution.message}\nLook at drift and cost, or give a larger hi"


def _others(grid: Grid, axis: int) -> tuple[int, ...]:
    """All axes but one."""
    return tuple(k for k in range(grid.ndim) if k != axis)


def _check_rule(make: object, lo: float, hi: float, tol: float, settling: Settling) -> None:
    """Refuse numbers by which nothing can be bisected."""
    if not callable(make):
        raise TypeError(f"hinf_level: problem_of_gamma is {make!r}, wanted a function of gamma that returns a Problem")
    for name, number, most in (
        ("lo", lo, math.inf),
        ("hi", hi, math.inf),
        ("tol", tol, 1),
        ("inner", settling.inner, 1),
        ("settle", settling.settle, 0.5),  # a constant rate makes one half of growth, at any T
        ("horizon", settling.horizon, math.inf),
    ):
        arguments.positive(number, f"hinf_level: {name}", most=most)
    if lo >= hi:
        raise ValueError(f"hinf_level: got lo = {lo:g} and hi = {hi:g}, wanted lo < hi")


def _check_problem(problem: object, gamma: float) -> None:
    """Refuse a problem whose V tells no gain."""
    if not isinstance(problem, Problem):
        raise TypeError(f"hinf_level: problem_of_gamma({gamma:g}) returned {problem!r:.60}, wanted a Problem")
    if not isinstance(problem.disturbances, (Box, Ball)):
        raise ValueError(
            f"hinf_level: problem_of_gamma({gamma:g}) has disturbances {problem.disturbances!r:.60}; wanted a Box or a "
            "Ball, as hjb.attenuation(plant, gamma, hjb.Box(...)) makes one"
        )
    for name in ("noise", "terminal_cost", "stopping_cost", "running_max", "target"):
        if getattr(problem, name) is not None:
            raise ValueError(f"hinf_level: the problem has a {name}, with which V no longer tells a gain; leave it out")
    if is_discounted(problem) is not False:
        raise ValueError(
            f"hinf_level: the problem has discount = {problem.discount}, with which V settles also where the gain is "
            "violated; leave it out"
        )
    if problem.time_dependent or problem.cost is None:
        raise ValueError("hinf_level: wanted a problem that has a cost and does not depend on the time")
