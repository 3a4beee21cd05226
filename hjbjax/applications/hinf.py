"""Robust control: the L₂-gain problem, and the least gain that a feedback can hold (H∞).

    ẋ = f(x, u) + E d,  cost L(x, u) − ½γ²|d|²,  L = ½|z|²:   0 = min_u max_d [ L − ½γ²|d|² + (f + E d)·DV ]

has a finite value V ≥ 0 exactly where some feedback keeps ∫|z|² ≤ γ²∫|d|² + 2V(x₀) for every d: the available
storage. The H∞ level is the least such γ. For a linear plant with z = (C x, u) and (C, A) detectable it is the least γ
with a stabilising P ≥ 0 of A'P + PA − P(BB' − EE'/γ²)P + C'C = 0, and V = ½x'Px. An unstable mode that z does not see
costs nothing to leave alone: V is then finite at levels that no stabilising feedback holds. So at the end the loop is
run with d = 0 from the corners of the inner box, and the answer says where it does not come back.

A bounded set of disturbances makes every γ finite, so infeasible levels are recognised by growth. March from V = 0: the
value V_T of the problem over the time T grows with T, since d = 0 is allowed and costs nothing, and its limit is V. So
γ is feasible if and only if V_T stays bounded. One of three things happens:

* V_T settles in an inner box and in the whole box, and no d of the inner box sits on its bound: feasible. Settled means
  that from T to 2T it grows by less than a small fraction, or by less than ten times that fraction and by less than a
  third of the growth before.
* The worst disturbance comes to its bound in the inner box: the set cuts off what would be unbounded. Infeasible.
* V_T still grows at the horizon. The worst disturbance may take the state to a place where it gains at a constant rate,
  or growth is slow near the level. Not shown to be feasible.

The whole box counts because a nonlinear plant may have its largest gain away from the rest point. Near the rest point V
then stays on a plateau until the worst path has crept out to that place, and nothing on the plateau shows for how long.
The level is that of the box: take a smaller box for a local level. A plateau may also end late. So the march of the
reported γ, and of a ``lo`` that has settled, goes on to the horizon.

Doubling T has no scale: a constant rate makes growth one half, in any unit. At the level itself a P that stays finite
is approached like 1/T, so that the gain halves with each doubling. Above the level it falls faster each time. Below it,
behind a bottleneck, it falls more slowly and then rises. A third separates the two sooner than waiting until all has
settled: for a time constant τ of the closed loop a level that is off by the fraction e shows at T of about τ/√e.
Narrow sets of controls or disturbances, a small grid and a short horizon make the level too high. So do coarse grids
where P grows without bound at the level. ``Weno5()`` is exact on quadratics and depends least on the edge of the grid.
Source: A. van der Schaft, L₂-gain and passivity techniques in nonlinear control; T. Başar and P. Bernhard,
H∞-optimal control and related minimax design problems.
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
from hjbjax.problem.sets import Ball, Box
from hjbjax.solution.clock import Clock, noting_interrupts
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status, keeping_warnings, warn
from hjbjax.solvers.finite_horizon import march_part

DOUBLINGS = 6  # of the time marched, at most: the first look is at a 64th of the horizon
SOON = 1e-6  # seconds: a limit that ends a march after its first look
CUTS = {Status.INTERRUPTED: "interrupted", Status.TIME_LIMIT: "out of time"}
CLOSE, FALL = 10.0, 1 / 3  # growth so near settle counts as settled if it falls by this factor; at the level it halves


@dataclasses.dataclass(frozen=True)
class Settling:
    """Where, how far and until when V must settle, and the march that shows it.

    Args:
      inner: the share of the grid's box around its middle in which no disturbance may saturate.
      settle: growth over a doubling of the time below which V has settled.
      horizon: the longest time to march.
      scheme: of the march.
      time_limit: seconds for one γ, or None.
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
    """The least γ that a feedback can hold in the box, by bisection; the rule is in the module's docstring.

    Each γ takes one march, which stops as soon as it is decided. The march of the reported γ goes on to the horizon. V
    must settle over the whole box, so the level of a nonlinear plant depends on the box. It comes out too high if a set
    of controls or disturbances is too narrow, if worst paths leave the grid, or if the horizon is short; the table says
    how the marches below it ended. For a level with stability every unstable mode must be seen in L (detectability).
    ``Level.stabilises`` is False where a run without a disturbance shows one that is not.

    Args:
      problem_of_gamma: γ to the game with cost L − ½γ²|d|², as ``lambda gamma: hjb.attenuation(plant, gamma, set)``.
        Where γ is a leaf, as there, nothing is compiled again.
      grid: the nodes, around the rest point.
      lo: a γ that is infeasible.
      hi: a γ that is feasible.
      tol: how close the bracket is to be, relative to γ.
      inner: the share of the grid's box, around its middle, where V must settle without saturation. In the rest of the
        box V must settle, too, but disturbances may sit on their bound.
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
    settling = Settling(inner, settle, horizon, scheme, time_limit)
    _check_rule(problem_of_gamma, lo, hi, tol, settling)
    trials: dict[float, Trial] = {}
    said: dict[float, list[str]] = {}
    clock = Clock()

    def at(gamma: float, before: Trial | None = None) -> Trial:
        problem = problem_of_gamma(gamma)
        _check_problem(problem, gamma)
        # an infeasible V has no limit: what its march warns of says nothing about the level
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
            raise SolveError(f"hinf_level: interrupted after it had come to its end: {level!r}", level)
    for message in dict.fromkeys(said[level.gamma]):
        warn(message)
    return level


def _bisect(at: Callable[..., Trial], lo: float, hi: float, tol: float, settle: float) -> None:
    """Try γ after γ until the bracket is narrow enough and its upper end is feasible up to the horizon."""
    feasible: tuple[Trial, ...] = (
        at(hi),
    )  # first: if even hi fails, sets, grid or horizon are at fault, and lo adds nothing
    if not feasible[0].feasible:
        raise ValueError(f"hinf_level: hi = {hi:g} is not feasible: {_why(feasible[0], settle)}")
    bottom = at(lo)
    if bottom.feasible and (bottom := at(lo, bottom)).feasible:
        raise ValueError(
            f"hinf_level: lo = {lo:g} is feasible: V settles at {bottom.value:.3g} after t = {bottom.time:g}; "
            "give a smaller lo"
        )
    while feasible:
        bottom, feasible = _narrowed(at, bottom, feasible, tol)
        # V may have been on a plateau when its march stopped
        bottom = at(feasible[-1].gamma, feasible[-1])
        if bottom.feasible:
            return
        feasible = feasible[:-1]
    raise ValueError(f"hinf_level: hi = {hi:g} is not feasible: {_why(bottom, settle)}")


def _narrowed(
    at: Callable[..., Trial], bottom: Trial, feasible: tuple[Trial, ...], tol: float
) -> tuple[Trial, tuple[Trial, ...]]:
    """The bracket after bisection: its lower end, and all feasible trials with the least γ at the end."""
    while feasible[-1].gamma > bottom.gamma * (1 + tol):
        # the geometric mean: tol is relative, and each trial halves the logarithm of the ratio
        middle = at(math.sqrt(bottom.gamma * feasible[-1].gamma))
        if middle.feasible:
            feasible = (*feasible, middle)
        else:
            bottom = middle
    return bottom, feasible


def _level(trials: list[Trial], cut: Trial | None = None) -> Level:
    """The level by the trials so far, of which ``cut`` came to no verdict."""
    top = min((trial.gamma for trial in trials if trial.feasible), default=math.inf)
    bottom = max((trial.gamma for trial in trials if not trial.feasible and trial is not cut), default=0.0)
    # a trial that was cut has shown nothing: it is listed, and bounds the bracket on neither side
    status = Status.CONVERGED if cut is None else cut.solution.status
    return Level(top, (bottom, top), tuple(sorted(trials, key=lambda trial: trial.gamma)), status)


def _try(problem: Problem, grid: Grid, gamma: float, settling: Settling, before: Trial | None) -> Trial:
    """The verdict on one γ: double the time marched until V settles or d saturates, or until the horizon.

    Args:
      problem: the game at γ.
      grid: the nodes.
      gamma: γ.
      settling: the rule.
      before: a trial of the same γ that has settled. Its march goes on to the horizon.
    """
    going_on = ("growing",) if before is None else ("growing", "settled")
    trial = before
    so_far = Growth((np.zeros(grid.shape),)) if before is None else before.march
    # the time is a sum of spans, by rounding
    while trial is None or (trial.reason in going_on and so_far.time < settling.horizon * (1 - 1e-9)):
        trial = _longer(problem, grid, gamma, so_far, settling)
        so_far = trial.march
    return trial


def _longer(problem: Problem, grid: Grid, gamma: float, so_far: Growth, settling: Settling) -> Trial:
    """The verdict on one γ after a march over twice the time."""
    began, inner, inside = perf_counter(), settling.inner, _inner_nodes(grid, settling.inner)
    # a march stops early if the worst case comes to the bound of a Box; of a Ball only the end is checked
    watch = inner if isinstance(problem.disturbances, Box) else 0.0
    span = so_far.time or settling.horizon / 2**DOUBLINGS
    # never 0 or less: march requires a positive limit, and returns what there is after its initial evaluation
    left = settling.time_limit and max(settling.time_limit - so_far.seconds, SOON)
    # V_T goes on from its last value: the march from V = 0 over 2T is one over T from V_T
    solution = march_part(
        problem, grid, span, start=so_far.values[-1], inner=watch, scheme=settling.scheme, time_limit=left
    )
    # a march that stopped early is at times[0] > 0, and less than the span has passed
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
    """The growth of V over the last doubling relative to its size in a part of the box, and True if V has settled."""
    size = float(np.max(np.abs(values[-1][nodes])))
    # the first doubling has none before it
    gains = [math.inf, *(float(np.max(np.abs(after - before)[nodes])) for before, after in itertools.pairwise(values))]
    growth = gains[-1] / size if size else 0.0
    return growth, growth <= settle or (growth <= CLOSE * settle and gains[-1] <= FALL * gains[-2])


def _no_verdict(solution: Solution, gamma: float, so_far: Growth, time: float, inner: float) -> Trial:
    """A trial without a verdict, from a march that was cut short."""
    kept = _as_stationary(solution, time)
    size = float(np.max(np.abs(kept.value[kept.grid.inner(inner)])))
    unknown = Saturation(math.nan, math.nan, np.full(kept.grid.ndim, math.nan), inner)
    return Trial(gamma, False, CUTS[solution.status], time, math.nan, size, unknown, kept, so_far)


def _as_stationary(solution: Solution, total: float) -> Solution:
    """The last slice of a march over the time ``total`` as a stationary solution."""
    # of the kept times, the leading axis, the first is the last that was marched
    first = {name: getattr(solution, name)[0] for name in ("value", "policy", "disturbance")}
    return dataclasses.replace(solution, times=None, stats={**solution.stats, "horizon": total}, **first)


def _reason(status: Status, bound: Saturation, settled: bool) -> str:
    """The verdict after a march, as ``Trial.reason`` has it."""
    # DIVERGED is what the march calls a disturbance that came to its bound while it watched
    # first of all: where d is cut off V settles too, at a value that is the set's and no gain
    if status is Status.DIVERGED or bound.share > 0:
        return "saturated"
    if status is not Status.CONVERGED:
        return "not finite"
    return "settled" if settled else "growing"


def _why(trial: Trial, settle: float) -> str:
    """The end of a trial that is not feasible and advice, in words."""
    if trial.reason == "saturated":
        return f"{trial.saturation};\ngive a larger hi, wider sets of controls and disturbances, or a smaller inner"
    if trial.reason == "growing":
        return (
            f"V still grew by {trial.growth:.2g} of itself over the last doubling of the time to {trial.time:g}, "
            f"settle = {settle:g};\ngive a larger hi or a longer horizon, a larger grid if worst paths leave it, or a "
            "smaller one if the gain is large only far from the rest point"
        )
    return f"{trial.solution.message}\nLook at drift and cost, or give a larger hi"


def _inner_nodes(grid: Grid, inner: float) -> np.ndarray:
    """The nodes of the inner box, bool (*grid); refused where no node has both of its neighbours in it."""
    inside = grid.inner(inner)
    if not np.all([np.sum(np.any(inside, axis=_others(grid, k))) >= 3 for k in range(grid.ndim)]):
        raise ValueError(f"hinf_level: inner = {inner:g} of {grid.shape} nodes holds fewer than 3 along an axis")
    return inside


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
