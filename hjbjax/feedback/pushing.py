"""Interventions along a path: changes of the mode by choice, and pushes.

A push is a jump at the start of a path, and the reflection at the free boundary afterwards.

After every step of the integrator the state is moved along the pushes of the solution to the boundary of the push
region, and the cost of the way is paid, discounted to the start. On the grid the boundary consists of the first nodes
that are not pushed, as in the Markov chain. Between the nodes, distance and cost are multilinear.

The path overshoots the boundary by about σ√Δt within a step, so the error of its law is of order ½ in the step Δt. The
error of its mean cost is of order 1 if the boundary is optimal, since V then leaves the push region with a continuous
second derivative.
"""

import contextlib
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.schemes import Upwind
from hjbjax.discretisation.stencil import grid_links
from hjbjax.feedback.loop import Loop
from hjbjax.feedback.payments import Lookup, solution_of
from hjbjax.feedback.sudden_changes import after_choice
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, cast, is_traced
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import with_any_control
from hjbjax.problem.types import Field, Mask, Number
from hjbjax.tracing.closures import settled


def push_table(problem: Problem, feedback: object) -> Lookup | None:
    """The way to the boundary of the push region and its cost, (n + 1,), between the nodes; None without pushes.

    Raises:
      ValueError: the feedback has no Solution that knows the push region.
    """
    if not problem.push_steps:
        return None
    solution = solution_of(feedback)
    if solution is None or solution.pushing is None:
        raise ValueError(
            "simulate: the problem has pushes, and only a Solution of it knows where they are optimal; got another "
            "feedback.\nPass the Solution, or simulate the problem without pushes"
        )
    known = not is_traced(problem, solution)
    double = np.result_type(solution.value) == np.float64 if known else None
    folded: Any = jax.ensure_compile_time_eval() if known else contextlib.nullcontext()
    with folded, own_settings(x64=double):
        n, dtype = solution.grid.ndim, np.result_type(solution.value)
        only_pushes = altered(problem, switching_costs=None)  # changes of the mode are made apart
        ready = cast(settled(with_any_control(only_pushes, n), n, dtype), dtype)
        on = Discretisation(ready, cast(solution.grid, dtype), Upwind(), dtype)
        masks = jnp.moveaxis(jnp.asarray(solution.pushing), -1, 0)  # (p, *grid), or (p, k, *grid)
        if solution.times is None:
            found = _ways(on, masks)
        else:
            each = jnp.asarray(solution.times, dtype), jnp.moveaxis(masks, 1, 0)
            found = jax.lax.map(lambda both: _ways(on.at(both[0]), both[1]), each)
        return Lookup(solution.grid, np.asarray(found) if known else found, solution.times)


def _ways(on: Discretisation, masks: Mask) -> Field:
    """The displacement by all pushes that follow each other from a node, and their cost, (*grid, n + 1)."""
    pushes, grid = on.interventions(), on.grid
    left, goes = jnp.ones(grid.shape, bool), []
    for mask in masks:  # at a tie the first push
        goes.append(mask & left)
        left &= ~mask
    follow = functools.partial(pushes.without_costs.followed, goes)

    def total(amounts: list[Any]) -> Field:
        paid = jnp.sum(jnp.stack([jnp.where(go, a, 0) for go, a in zip(goes, amounts, strict=True)]), axis=0)
        return follow(paid, jnp.zeros(grid.shape, on.dtype))

    lengths = []
    for axis, step in on.problem.push_steps:
        link = grid_links(grid, axis)
        lengths.append(step * (link.up if step > 0 else link.down))
    ways = [
        total(
            [
                length if axis == along else 0.0
                for length, (along, _) in zip(lengths, on.problem.push_steps, strict=True)
            ]
        )
        for axis in range(grid.ndim)
    ]
    return jnp.stack([*ways, total(list(pushes.costs))], axis=-1)


def after_interventions(loop: Loop, t: Number, y: jax.Array, start: Number) -> jax.Array:
    """The state and the running cost after all changes of the mode and pushes that are chosen at the time t."""
    if loop.switch is None or loop.push is None:
        for _ in range(max(loop.modes - 1, 0)):  # a cheapest path of changes has at most k − 1 of them
            y = after_choice(loop, t, y, start)
        return after_pushes(loop, t, y, start)

    def again(_: int, y: jax.Array) -> jax.Array:
        return after_pushes(loop, t, after_choice(loop, t, y, start), start)

    # a push may lead to a change and a change to a push: twice through all modes
    return jax.lax.fori_loop(0, 2 * loop.modes, again, y)


def after_pushes(loop: Loop, t: Number, y: jax.Array, start: Number) -> jax.Array:
    """The state and the running cost after the pushes that are due at the time t; unchanged without pushes.

    Args:
      loop: the loop.
      t: the time.
      y: the state of the loop, then the running cost.
      start: the first time of the path, where discounting starts.
    """
    if loop.push is None:
        return y
    found = jnp.asarray(loop.push(t, loop.wrap(y[:-1])), y.dtype)  # further entries of the state are not pushed
    n = found.size - 1
    return y.at[:n].add(found[:n]).at[-1].add(loop.discount(jnp.asarray(t - start, y.dtype)) * found[n])
