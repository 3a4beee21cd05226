"""The loop over time steps: V_t + min max H − β V = 0 from the horizon back to 0, with targets and constraints.

A method of ``time_methods`` makes one step. If the fastest action is not at an end of its set, or the rate Q of leaving
a node changes within a step, Q is evaluated under the actions chosen in every stage, and a step that was too long is
repeated with shorter steps. Steps end exactly on the kept times; the remaining steps of an interval have equal length.
"""

import dataclasses
import functools
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from hjbjax.discretisation import correlated_noise, edges
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import jump_rates, largest_rate
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.hamiltonian.search import Action
from hjbjax.iteration import bellman, isaacs
from hjbjax.iteration.bellman import Obstacles
from hjbjax.iteration.grid_task import GridTask
from hjbjax.iteration.time_methods import TABLEAUX, Explicit, Tableau, TimeMethod, longest_step
from hjbjax.problem import sets
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Field, Mask, Nodes, Number, Numbers, Scalar, Verdict
from hjbjax.solution.status import Status

TRIES = 30  # largest number of attempts to shorten a step; the rates of its first stage do not depend on its length
# Slopes of higher order are up to 1.5 times (``Eno2``) or 1.6 times (``Limited``) as steep as one-sided differences. If
# Euler steps follow one another without a mean, they must not carry values past the next node, or V overshoots at jumps
# and loses its order where it is smooth.
STEEPER = 1.5
NEAR = 1e-3  # relative to the bound: a disturbance this close to its bound counts as saturated


@pytree_dataclass(static=("checks_rates", "checks_noise", "checks_gap", "checks_cut", "bare", "mesh"))
class March(GridTask):
    """The constants of a march: the problem on its grid, the method, and the limits of its steps.

    Args:
      on: the problem on its grid, with the slopes of a scheme.
      method: ``Explicit`` with its stages, or ``Implicit`` with its evaluation.
      obstacles: fixed nodes and constraints; ``None`` if they depend on time, or if only V is stored.
      limit: the longest stable step, inf if all are stable; ``None`` if it depends on time.
      step: the longest requested step; inf if only the limit applies. For functions of time one entry for each of
        several equal parts of the horizon, from t = 0 on, shape (parts, 1).
      horizon: the time at which the terminal cost is paid.
      watched: bool (*grid), nodes where a disturbance at its bound means that the value blows up; or ``None``.
      checks_rates: True if explicit steps evaluate Q under the chosen actions.
      checks_noise: True if steps check for correlated noise that the chain cannot represent.
      checks_gap: True if the gap between min max and max min is evaluated before every step.
      checks_cut: True if steps count the nodes at which drift out of the box is cut off.
      bare: True if only V is stored; everything else is computed where it is used.
      missed: the relative error of integrals over functions of time with these steps, if they were shortened for these
        functions; else zero.
      mesh: the devices over which the nodes are divided during the march; None: one device.
    """

    on: Discretisation
    method: TimeMethod
    obstacles: Obstacles | None
    limit: Number | None
    step: Number
    horizon: Any  # an array in the dtype of the values if the host drives the march, a float inside transformations
    watched: Mask | None
    checks_rates: bool = False
    checks_noise: bool = False
    checks_gap: bool = False
    checks_cut: bool = False
    bare: bool = False
    missed: Number = 0.0
    mesh: Mesh | None = None

    def obstacles_at(self, t: Number) -> Obstacles:
        """Fixed nodes and constraints at the time t."""
        return bellman.obstacles(self.on.at(t)) if self.obstacles is None else self.obstacles

    def longest(self, t: Number) -> Scalar:
        """The longest step that may start at the time t."""
        limit = self.limit
        if limit is None:
            limit = stable(self.on.at(t), self.method.tableau, self.method.courant)
        return jnp.minimum(self.step_at(t), limit)

    def step_at(self, t: Number) -> Scalar:
        """The longest requested step from the time t on, backwards."""
        steps = jnp.asarray(self.step)
        if steps.ndim == 0:
            return steps
        count = len(steps)
        # a time between two parts belongs to the earlier part, which comes next
        part = jnp.ceil(t / self.horizon * count - 1e-3).astype(jnp.int32) - 1
        return steps[jnp.clip(part, 0, count - 1), 0]

    def rate(self, value: Field, t: Number) -> tuple[Field, "Seen"]:
        """F = min max H − β V, cost per unit time, with the rates and the noise under the optimal actions."""
        on = self.on.at(t)
        best, u, d = optimum.optimise(dataclasses.replace(discrete.around(on, value), bare=self.bare))
        return best - on.decay * value, self.look(value, u, d, t)

    def look(self, value: Field, u: Action, d: Action, t: Number) -> "Seen":
        """The largest Q + β under these actions, the first node whose noise has no chain, and the cut-off drift."""
        on, dtype = self.on.at(t), self.on.dtype
        seen = self.nothing_seen()
        if self.checks_cut:
            found = edges.count_leaving(on, value, u, d, self.obstacles_at(t).acting(value))
            seen = dataclasses.replace(seen, cut=found)
        if self.checks_rates:  # a pass over all rates, skipped if the limit of the step is known
            rates = jump_rates(on, u, d, speed=_speed(on, self.method.tableau))
            fastest = on.grid.layout.largest(rates.total()) + _largest_decay(on)
            seen = dataclasses.replace(seen, fastest=fastest)
        if self.checks_noise:
            lacking = correlated_noise.lacking(on, on.diffusion(u, d))
            if lacking is None:
                return seen
            # at a fixed node nothing moves, so its noise does not matter
            lacking = jnp.broadcast_to(lacking, on.grid.shape) & ~self.obstacles_at(t).fixed
            first = on.grid.layout.first(lacking)
            seen = dataclasses.replace(seen, lacking=first, t=jnp.asarray(t, dtype))
        return seen

    def nothing_seen(self) -> "Seen":
        """The outcome before any evaluation: rate zero, and no node without a chain."""
        dtype = self.on.dtype
        zero = jnp.zeros((), dtype)
        return Seen(zero, jnp.full((), -1, jnp.int32), zero, jnp.zeros((self.grid.ndim, 2), jnp.int32))


@pytree_dataclass()
class Front:
    """State of a march.

    Args:
      value: V at the time t.
      t: the time, for functions of it; rounded, so steps are not computed from it.
      left: the time from t back to the end of the interval, as a number and its rounding error. With a single float32
        number at t = 1e5 a march took 896,657 steps instead of 223.
      steps: the number of steps taken.
      code: a Status number.
      seen: the rates and the noise of the last step.
      gap: the largest gap between min max and max min so far, and the influence of the actions there, (2,).
      cut: the largest numbers of nodes at each end where drift was cut off, since the last kept time, (n, 2).
    """

    value: Field
    t: Scalar
    left: jax.Array
    steps: Scalar
    code: Scalar
    seen: "Seen"
    gap: jax.Array
    cut: jax.Array


@pytree_dataclass()
class Seen:
    """Rates and noise under the actions of a step; zero and −1 where they are not evaluated.

    Args:
      fastest: the largest Q + β under the chosen actions, per unit time.
      lacking: the flat index of the first node where noise is correlated more than the spacings allow, or −1.
      t: the time at which this noise was found.
      cut: the number of nodes at each end of the box where drift is cut off, (n, 2).
    """

    fastest: Scalar
    lacking: Scalar
    t: Scalar
    cut: jax.Array

    def joined(self, other: "Seen") -> "Seen":
        """The larger rate of two outcomes, and the fault of the noise that was found first."""
        first = self.lacking >= 0
        return Seen(
            jnp.maximum(self.fastest, other.fastest),
            jnp.where(first, self.lacking, other.lacking),
            jnp.where(first, self.t, other.t),
            jnp.maximum(self.cut, other.cut),
        )


def stable(on: Discretisation, tableau: Tableau = TABLEAUX[1], share: Numbers = 1.0) -> jax.Array:
    """The longest step at the time of ``on``, see ``longest_step``, of Euler's method by default."""
    rate = largest_rate(on, _speed(on, tableau)) + _largest_decay(on)
    return longest_step(rate, on.problem, share, tableau)


def _speed(on: Discretisation, tableau: Tableau) -> float:
    """The factor of the drift in the limit of a step: how much steeper slopes are than one-sided differences."""
    return STEEPER if tableau.in_succession and not on.scheme.monotone else 1.0


def stable_steps(on: Discretisation, method: Explicit) -> jax.Array:
    """The longest step of each Euler stage of an explicit method, and of the method, at the time of ``on``, (2,)."""
    # the Euler steps inside a stage have length c Δt, and are monotone if c Δt (max Q + β) ≤ 1
    shares = jnp.stack([jnp.asarray(share, on.dtype) for share in (1 / method.tableau.euler, method.courant)])
    return stable(on, method.tableau, shares)


def fastest_growth(on: Discretisation) -> Scalar:
    """The largest g − β over nodes and actions at the time of ``on``, at which V may grow with the distance in time."""
    growth = -jnp.asarray(on.decay, on.dtype)
    if on.problem.growth is not None:
        sets_of = (on.problem.controls, on.problem.disturbances)
        pairs = itertools.product(*(sets.probes(each, on.dtype) for each in sets_of))
        growth = growth + functools.reduce(jnp.maximum, (on.growth(u, d)[0] for u, d in pairs))
    return on.grid.layout.largest(jnp.broadcast_to(growth, on.grid.shape))


def _largest_decay(on: Discretisation) -> Scalar:
    """The largest β, over the nodes if it is a function of the state."""
    decay = jnp.asarray(on.decay, on.dtype)
    return decay if on.problem.killing is None else on.grid.layout.largest(decay)


def terminal(on: Discretisation, start: Nodes | None = None) -> Field:
    """V at the horizon, the time of ``on``: ``start`` or the terminal cost, with fixed values and constraints imposed.

    Without either, V is the stopping cost, which must be paid at the horizon, or the running maximum g, or else zero.
    """
    obstacles, problem = bellman.obstacles(on), on.problem
    if start is not None:  # the user's start need not satisfy the constraints
        return obstacles.impose(jnp.asarray(start, on.dtype))
    cost = problem.terminal_cost
    if cost is None:
        cost = problem.running_max if problem.stopping_cost is None else problem.stopping_cost
    return obstacles.impose(on.at_nodes(cost))


def begin(march: March, value: Field, left: Number) -> Front:
    """The front at the horizon, with the time to the end of the first interval."""
    zero = jnp.zeros((), jnp.int32)
    t, none = jnp.asarray(march.horizon, value.dtype), jnp.zeros((2,), value.dtype)
    clock = jnp.asarray([left, 0], value.dtype)
    seen = march.nothing_seen()
    return Front(value, t, clock, zero, zero + int(Status.RUNNING), seen, none, seen.cut)


def run(march: March, front: Front, until: Number, most: Number) -> Front:
    """Take at most ``most`` steps towards the time ``until``, as long as the values are finite."""

    def goes_on(carry: tuple[Front, Scalar]) -> Verdict:
        front, left = carry
        return (front.code == Status.RUNNING) & (front.left[0] > 0) & (left > 0)

    def step(carry: tuple[Front, Scalar]) -> tuple[Front, Scalar]:
        front, left = carry
        if march.bare:  # made loop-variant, otherwise XLA stores arrays that depend only on the grid
            grid, front = jax.lax.optimization_barrier((march.grid, front))
            return _advance(dataclasses.replace(march, on=march.on.on_grid(grid)), front, until), left - 1
        return _advance(march, front, until), left - 1

    return jax.lax.while_loop(goes_on, step, (front, jnp.asarray(most, jnp.int32)))[0]


def _moved(front: Front, until: Scalar, count: Scalar) -> tuple[Scalar, Scalar, jax.Array]:
    """The length of the first of ``count`` equal steps to ``until``, the time at its end, and the remaining time."""
    left, rest = front.left
    dt = left / count
    less = left - dt
    rest = rest + ((left - less) - dt)  # the rounding error of the difference, exactly
    total = less + rest
    # the last step, count = 1, ends on ``until`` to the bit
    after = jnp.where(count > 1, jnp.stack([total, rest - (total - less)]), 0)
    return dt, until + after[0], after


def _advance(march: March, front: Front, until: Number) -> Front:
    """One step towards ``until``: the first of equal steps in the remaining time."""
    until = jnp.asarray(until, front.value.dtype)
    longest = march.longest(front.t)
    if march.checks_rates:  # a step like the last one is better than one that must be repeated
        longest = jnp.minimum(longest, _allowed(march, front.seen, march.method.courant))
    # 1e-4 of a step: a remainder that is rounding of the time does not get its own step
    count = jnp.maximum(jnp.ceil(front.left[0] / longest - 1e-4), 1)
    gap = _larger_gap(march, front) if march.checks_gap else front.gap
    if march.checks_rates:
        value, (t, left), ok, seen = _short_enough(march, front, until, count)
    else:
        dt, t, left = _moved(front, until, count)
        value, ok, seen = march.method.step(march, front.value, front.t, t, dt)
    # high − low is finite only if all values are finite, because ∞ − ∞ is NaN
    low, high = march.layout.least(value), march.layout.largest(value)
    # later faults override earlier ones
    code = jnp.where(ok, Status.RUNNING, Status.STALLED)
    if march.watched is not None:
        code = jnp.where(_saturates(march, value, t), Status.DIVERGED, code)
    code = jnp.where(jnp.isfinite(high - low), code, Status.NONFINITE)
    if march.checks_noise:  # such a step is not accepted
        taken = seen.lacking < 0
        value, t, left = (
            jnp.where(taken, new, old) for new, old in ((value, front.value), (t, front.t), (left, front.left))
        )
        code = jnp.where(taken, code, Status.STALLED)
    cut = jnp.maximum(front.cut, seen.cut)
    return Front(value, t, left, front.steps + 1, code.astype(jnp.int32), seen, gap, cut)


def _larger_gap(march: March, front: Front) -> jax.Array:
    """The gap between min max and max min before a step, if it is larger than the previous ones; (2,)."""
    hamiltonian = discrete.around(march.on.at(front.t), front.value)
    free = ~march.obstacles_at(front.t).fixed
    upper, lower = isaacs.minmax_and_maxmin(hamiltonian)
    gap = isaacs.gap_between(hamiltonian, free, upper, lower)

    def weigh() -> jax.Array:  # 81 pairs of actions, evaluated only if the gap is larger
        return jnp.stack([gap, isaacs.weight_of_actions(hamiltonian, free, upper, lower)])

    return jax.lax.cond(gap > front.gap[0], weigh, lambda: front.gap)


def _allowed(march: March, seen: Seen, share: Number) -> Scalar:
    """The longest step at the evaluated rates."""
    return longest_step(seen.fastest, march.problem, share, march.method.tableau)


def _short_enough(
    march: March, front: Front, until: Scalar, count: Scalar
) -> tuple[Field, tuple[Scalar, jax.Array], jax.Array, Seen]:
    """V after one of ``count`` or more equal steps, its clock, true if every stage was stable, and the rates."""
    left = front.left[0]

    def too_long(carry: tuple[Scalar, Scalar | int, Field, Seen]) -> Verdict:
        count, tries, _, seen = carry
        # initially Q = ∞, so this is true; 1e-6 is rounding of the product, not instability
        most = _allowed(march, seen, 1 / march.method.tableau.euler)
        return (left / count > most * (1 + 1e-6)) & (tries < TRIES)

    def attempt(carry: tuple[Scalar, Scalar, Field, Seen]) -> tuple[Scalar, Scalar, Field, Seen]:
        count, tries, _, seen = carry
        # from the rates just evaluated, with at least one more step, so that every attempt is shorter
        more = jnp.maximum(jnp.ceil(left / _allowed(march, seen, march.method.courant) - 1e-4), count + 1)
        count = jnp.where(tries > 0, more, count)
        dt, t, _ = _moved(front, until, count)
        value, _, seen = march.method.step(march, front.value, front.t, t, dt)
        return count, tries + 1, value, seen

    nothing = march.nothing_seen()
    endless = dataclasses.replace(nothing, fastest=jnp.full_like(nothing.fastest, jnp.inf))
    start = (count, jnp.zeros((), jnp.int32), front.value, endless)
    carry = jax.lax.while_loop(too_long, attempt, start)
    # tries = 0 here: true if the last attempt was short enough, false if the attempts ran out
    return carry[2], _moved(front, until, carry[0])[1:], ~too_long((carry[0], 0, *carry[2:])), carry[3]


def repeat(march: March, value: Field, start: Number, dt: Number, count: int) -> tuple[Field, jax.Array]:
    """V after ``count`` steps of length ``dt`` back from the time ``start``; differentiable in both modes.

    Reverse mode stores V before each of √count chunks, and recomputes the steps of one chunk at a time, twice. For K
    steps it stores about 2 √K values, plus the memory of one step.

    Returns:
      V, and true if every step passed the checks of host level.
    """
    fine = jnp.ones((), bool)
    if count == 0:
        return value, fine
    width = math.isqrt(count - 1) + 1
    numbers = jnp.arange(-(-count // width) * width).reshape(-1, width)

    def move(carry: tuple[Field, jax.Array], k: jax.Array) -> tuple[Field, jax.Array]:
        value, fine = carry
        t = start - k.astype(value.dtype) * dt  # from the start, so that rounding errors of Δt do not add up
        value, ok, seen = march.method.step(march, value, t, t - dt, jnp.asarray(dt, value.dtype))
        return value, fine & ok & _faultless(march, value, t - dt, dt, seen)

    @functools.partial(jax.checkpoint, prevent_cse=False)  # a scan keeps its iterations apart anyway
    def step(carry: tuple[Field, jax.Array], k: jax.Array) -> tuple[tuple[Field, jax.Array], None]:
        # the last chunk is padded with steps that are not taken
        return jax.lax.cond(k < count, move, lambda carry, k: carry, carry, k), None

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def chunk(carry: tuple[Field, jax.Array], numbers: jax.Array) -> tuple[tuple[Field, jax.Array], None]:
        return jax.lax.scan(step, carry, numbers)

    # a scan, because a while loop has no reverse mode
    return jax.lax.scan(chunk, (value, fine), numbers)[0]


def _faultless(march: March, value: Field, t: Number, dt: Number, seen: Seen) -> jax.Array:
    """True if a step of fixed length was stable, its noise has a chain, and no watched disturbance is at its bound."""
    value, seen = jax.lax.stop_gradient((value, seen))
    fine = jnp.ones((), bool)
    if march.checks_rates:
        fine &= dt <= _allowed(march, seen, 1 / march.method.tableau.euler) * (1 + 1e-6)
    if march.checks_noise:
        fine &= seen.lacking < 0
    if march.watched is not None:
        fine &= ~_saturates(march, value, t)
    return fine


def greedy_actions(march: March, value: Field, t: Number) -> tuple[tuple[Field, ...], tuple[Field, ...]]:
    """The control and the disturbance at the time t, components of shape (*grid), for the Hamiltonian of the steps."""
    on = march.on.at(t)
    _, u, d = optimum.optimise(discrete.around(on, value))

    def full(action: Action) -> tuple[Field, ...]:
        return tuple(jnp.broadcast_to(jnp.asarray(entry, value.dtype), march.grid.shape) for entry in action)

    return full(u), full(d)


def _saturates(march: March, value: Field, t: Number) -> jax.Array:
    """True if the worst disturbance is at its bound at a watched node."""
    admissible = march.problem.disturbances
    assert isinstance(admissible, Box)
    assert march.watched is not None
    on_bound: jax.Array | bool = False
    for j, entry in enumerate(greedy_actions(march, value, t)[1]):
        slack = NEAR * (admissible.hi[j] - admissible.lo[j])
        on_bound |= (entry <= admissible.lo[j] + slack) | (entry >= admissible.hi[j] - slack)
    return march.layout.some(on_bound & march.watched & ~march.obstacles_at(t).fixed)
