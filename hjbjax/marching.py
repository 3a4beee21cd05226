"""Many steps in time: V_t + min max H − β V = 0 from the horizon back to 0, with targets and constraints.

Explicit: strong-stability-preserving Runge–Kutta methods of Shu and Osher, with F = min max H − β V,

    W ← a_k V + (1 − a_k) (W + Δt F(W)),    a = (0), (0, ½) or (0, ¾, ⅓),

each stage a mean of Euler steps, so that what one Euler step keeps, they keep: V ← max(g, min(ψ, ·)) and the given
values after every stage, and for the monotone chain the order of two values and the range of the data, as long as
Δt (max Q + β) ≤ 1 with Q the rate at which the chain leaves a node. Order 1, 2, 3 in time.

Implicit (Euler): min{ max{ (β + 1/Δt) W − V/Δt − min max H(W), W − ψ }, W − g } = 0, a discounted stationary problem
for W by policy iteration, any Δt, order 1. Against the other player's own solved problem, as in ``iteration``.

Steps end on the kept times exactly: those that are left are of equal length.
"""

from typing import Any

import jax
import jax.numpy as jnp

from hjbjax import bellman, implicit, splitting
from hjbjax.bellman import Conditions
from hjbjax.grid import Grid
from hjbjax.problem import Problem
from hjbjax.pytree import node
from hjbjax.relaxation import Evaluation
from hjbjax.schemes import Scheme
from hjbjax.sets import Box
from hjbjax.status import Status

MEANS = {1: (0.0,), 2: (0.0, 1 / 2), 3: (0.0, 3 / 4, 1 / 3)}  # a_k: the share of V in a stage
STARTS = {1: (0.0,), 2: (0.0, 1.0), 3: (0.0, 1.0, 0.5)}  # where a stage evaluates F, in steps
ENDS = {1: (1.0,), 2: (1.0, 1.0), 3: (1.0, 0.5, 1.0)}  # the time of its result
NEAR = 1e-3  # of a bound's distance: a disturbance so near its bound sits on it


@node(static=("stages",))
class Explicit:
    """Explicit steps: the SSP Runge–Kutta method with ``stages`` stages, which is also its order in time.

    Args:
      stages: 1 (Euler), 2 or 3; ``None`` takes what goes with the scheme: 1 for ``Upwind``, 3 for ``Weno5``, else 2.
      fraction: the length of a step over the stability limit 1/(max Q + β), at most 1.
    """

    stages: int | None = None
    fraction: Any = 0.9

    def __post_init__(self):
        if self.stages not in (None, *MEANS):
            raise ValueError(f"Explicit: got stages = {self.stages!r}, wanted 1, 2, 3 or None")
        if not isinstance(self.fraction, jax.core.Tracer) and not 0 < self.fraction <= 1:
            raise ValueError(f"Explicit: got fraction = {self.fraction!r}, wanted a number in (0, 1]")


@node(static=("max_steps",))
class Implicit:
    """Implicit Euler steps, each by policy iteration: any length, first order in time.

    Args:
      evaluation: how a policy is evaluated; ``None`` is ``Krylov()`` with noise and ``Sweeps()`` without.
      tol: bound on what the policy iterations leave over the whole march, in cost units.
      max_steps: policy improvements in one step, at most.
    """

    evaluation: Evaluation | None = None
    tol: Any = 1e-6
    max_steps: int = 100


@node(static=("scheme",))
class March:
    """All that stays the same during a march.

    Args:
      problem, grid: the question.
      method: ``Explicit`` with its stages, or ``Implicit`` with its evaluation.
      rules: held nodes and constraints; ``None`` where they depend on the time.
      limit: the longest stable step of an explicit method; ``None`` where it depends on the time, and if implicit.
      step: the longest step wanted; inf where the limit alone counts.
      horizon: the time at which the terminal cost is paid.
      watched: bool (*grid), nodes where a disturbance at its bound means that the value blows up; or ``None``.
      scheme: the slopes.
    """

    problem: Problem
    grid: Grid
    method: Any
    rules: Conditions | None
    limit: Any
    step: Any
    horizon: Any
    watched: Any
    scheme: Scheme

    def rules_at(self, t: Any, dtype: Any) -> Conditions:
        """Held nodes and constraints at the time t."""
        return bellman.conditions(self.problem, self.grid, dtype, t) if self.rules is None else self.rules

    def longest(self, t: Any, dtype: Any) -> Any:
        """The longest step that may start at the time t."""
        if isinstance(self.method, Implicit):
            return self.step
        limit = self.limit
        if limit is None:
            limit = self.method.fraction * stable(self.problem, self.grid, self.scheme, t, dtype)
        return jnp.minimum(self.step, limit)


@node()
class Front:
    """Where a march stands: V at the time t, the steps so far, and how it is going."""

    value: jax.Array
    t: jax.Array
    steps: jax.Array
    code: jax.Array


def stable(problem: Problem, grid: Grid, scheme: Scheme, t: Any, dtype: Any) -> jax.Array:
    """The longest step for which explicit Euler is monotone, 1/(max Q + β); inf where nothing moves."""
    rate = jnp.max(splitting.fastest_rate(problem, grid, scheme=scheme, dtype=dtype, t=t)) + problem.discount
    return jnp.where(rate > 0, 1 / jnp.where(rate > 0, rate, 1), jnp.inf)


def terminal(problem: Problem, grid: Grid, horizon: Any, dtype: Any, start: Any = None) -> jax.Array:
    """V at the horizon: ``start`` or the terminal cost, with given values and constraints put in.

    Without either a stopping cost is paid at the latest then, and a running maximum is g itself; else nothing is paid.
    """
    rules = bellman.conditions(problem, grid, dtype, horizon)
    if start is not None:
        return rules.impose(jnp.asarray(start, dtype))
    cost = problem.terminal_cost
    if cost is None:
        cost = problem.running_max if problem.stopping_cost is None else problem.stopping_cost
    return rules.impose(bellman.at_nodes(problem, grid, cost, dtype, horizon))


def begin(march: March, value: jax.Array) -> Front:
    """The front at the horizon."""
    zero = jnp.zeros((), jnp.int32)
    return Front(value, jnp.asarray(march.horizon, value.dtype), zero, zero + int(Status.RUNNING))


def run(march: March, front: Front, until: Any, most: Any) -> Front:
    """At most ``most`` steps towards the time ``until``, as long as the values are finite."""

    def goes_on(carry):
        front, left = carry
        return (front.code == Status.RUNNING) & (front.t > until) & (left > 0)

    def step(carry):
        front, left = carry
        return advance(march, front, until), left - 1

    return jax.lax.while_loop(goes_on, step, (front, jnp.asarray(most, jnp.int32)))[0]


def advance(march: March, front: Front, until: Any) -> Front:
    """One step towards ``until``; what is left is cut into equal steps."""
    dtype = front.value.dtype
    until, left = jnp.asarray(until, dtype), front.t - until
    count = jnp.maximum(jnp.ceil(left / march.longest(front.t, dtype) - 1e-4), 1)
    t = until + left * ((count - 1) / count)
    ok: Any = True
    if isinstance(march.method, Implicit):
        value, ok = _implicit(march, front.value, t, front.t - t)
    else:
        value = explicit(march, front.value, front.t, front.t - t)
    low, high = jnp.min(value), jnp.max(value)
    code = jnp.where(ok, Status.RUNNING, Status.STALLED)
    if march.watched is not None:
        code = jnp.where(_saturates(march, value, t), Status.DIVERGED, code)
    code = jnp.where(jnp.isfinite(high - low), code, Status.NONFINITE)
    return Front(value, t, front.steps + 1, code.astype(jnp.int32))


def repeat(march: March, value: jax.Array, start: float, end: float, count: int) -> jax.Array:
    """``count`` equal steps from the time ``start`` to ``end``, with known numbers: differentiable both ways."""
    dt = (start - end) / max(count, 1)

    def step(value, k):
        t = jnp.asarray(start, value.dtype) - k * dt
        if isinstance(march.method, Implicit):
            return _implicit(march, value, t - dt, jnp.asarray(dt, value.dtype))[0], None
        return explicit(march, value, t, dt), None

    return jax.lax.scan(step, value, jnp.arange(count).astype(value.dtype))[0]


def explicit(march: March, value: jax.Array, t: Any, dt: Any) -> jax.Array:
    """V at t − Δt from V at t."""
    dtype, stages = value.dtype, march.method.stages
    if stages == 1:
        return march.rules_at(t - dt, dtype).impose(value + dt * _rate(march, value, t))
    means, starts, ends = (jnp.asarray(table[stages], dtype) for table in (MEANS, STARTS, ENDS))

    def stage(k, w):
        moved = means[k] * value + (1 - means[k]) * (w + dt * _rate(march, w, t - starts[k] * dt))
        return march.rules_at(t - ends[k] * dt, dtype).impose(moved)

    return jax.lax.fori_loop(0, stages, stage, value)


def _implicit(march: March, value: jax.Array, t: Any, dt: Any) -> tuple[jax.Array, jax.Array]:
    """V at t from V at t + Δt, and whether the policy iteration came to its end."""
    method, rules = march.method, march.rules_at(t, value.dtype)
    return implicit.advance(
        march.problem, march.grid, rules, value, t, dt, scheme=march.scheme, evaluation=method.evaluation,
        tol=method.tol * dt / march.horizon, max_steps=method.max_steps,
    )  # fmt: skip


def _rate(march: March, value: jax.Array, t: Any) -> jax.Array:
    """F = min max H − β V, cost per unit time."""
    best, _, _ = splitting.optimise(march.problem, march.grid, value, scheme=march.scheme, t=t)
    return best - march.problem.discount * value


def greedy(march: March, value: jax.Array, t: Any) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
    """The control and the disturbance at the time t, each component of shape (*grid)."""
    _, u, d = splitting.optimise(march.problem, march.grid, value, scheme=march.scheme, t=t)

    def full(action):
        return tuple(jnp.broadcast_to(jnp.asarray(entry, value.dtype), march.grid.shape) for entry in action)

    return full(u), full(d)


def _saturates(march: March, value: jax.Array, t: Any) -> jax.Array:
    """Whether the worst disturbance sits on its bound at a watched node."""
    choices = march.problem.disturbances
    assert isinstance(choices, Box)
    on_bound: Any = False
    for j, entry in enumerate(greedy(march, value, t)[1]):
        slack = NEAR * (choices.hi[j] - choices.lo[j])
        on_bound |= (entry <= choices.lo[j] + slack) | (entry >= choices.hi[j] - slack)
    return jnp.any(on_bound & march.watched & ~march.rules_at(t, value.dtype).held)
