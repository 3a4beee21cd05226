"""Controls whose bounds depend on the state, lo(x) ≤ u ≤ hi(x), as controls in a fixed box.

    u = ½ (1 − v) lo(x) + ½ (1 + v) hi(x),    −1 ≤ v ≤ 1 for every input.

The map is affine in v, so a drift or cost that is affine or quadratic in u is affine or quadratic in v. If the minimum
is exact over a fixed box, it is therefore also exact over the bounds at every node. v = ±1 gives the bounds to the last
bit. The solvers only need to support fixed boxes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.jump_terms import OF_JUMPS
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered
from hjbjax.problem.sets import AnyControl, Box
from hjbjax.problem.types import Array, Control


def count_of(problem: Problem, n: int) -> int:
    """The number of inputs of a problem with ``n`` states whose ``controls`` are a function of the state.

    Raises:
      ValueError: the function does not return a ``Box``, or cannot be traced.
    """
    said = f"controls({', '.join(problem.state_arguments('x', 't'))})"
    word = jnp.result_type(float)  # of the caller: newer JAX warns about float64 where 64-bit types are off
    state = problem.state_arguments(*(jax.ShapeDtypeStruct(shape, word) for shape in ((n,), ())))
    found: list[Any] = []
    try:
        jax.eval_shape(lambda *where: found.append(problem.controls(*where)), *state)
    except (TypeError, ValueError) as error:
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ValueError(
            f"Problem.controls: {said} failed on one state, with x of shape ({n},): {first[:300]};\n"
            "wanted a function of the state that returns hjb.Box(lo, hi), as in lambda x: hjb.Box(-x, x)"
        ) from error
    if not isinstance(found[0], Box):
        raise ValueError(f"Problem.controls: {said} returned {found[0]!r:.60}, wanted hjb.Box(lo, hi)")
    return found[0].dim


def bounds_at(controls: Callable, *where: Any) -> tuple[Array, Array]:
    """lo(x) and hi(x) at one state, each (m,); NaN where no control is admissible."""
    box = controls(*where)
    lo, hi = jnp.asarray(box.lo), jnp.asarray(box.hi)
    empty = ~(lo <= hi)
    return jnp.where(empty, jnp.nan, lo), jnp.where(empty, jnp.nan, hi)


def control_of(bounds: tuple[Array, Array], v: Array) -> Control:
    """The control u that belongs to v, each component of v from −1 to 1."""
    lo, hi = bounds
    return ((1 - v) * lo + (1 + v) * hi) / 2


def in_unit_box(problem: Problem, n: int) -> Problem:
    """The problem with v as its control; unchanged if its bounds do not depend on the state.

    Example:
      >>> problem = Problem(lambda x, u: u, lambda x, u: u[0], lambda x: Box(-x, 3 * x), discount=1.0)
      >>> fixed = in_unit_box(problem, 1)
      >>> [fixed.drift(2 * jnp.ones(1), v * jnp.ones(1)).tolist() for v in (-1.0, 0.0, 1.0)]
      [[-2.0], [2.0], [6.0]]
    """
    if not callable(problem.controls):
        return problem
    m = count_of(problem, n)
    named = {name: getattr(problem, name) for name in ("drift", "cost", "noise", "growth", "mode_rates", *OF_JUMPS)}
    changed = {name: _of_v(each, problem) for name, each in named.items() if callable(each)}
    return altered(problem, controls=Box(-np.ones(m), np.ones(m)), **changed)


def with_any_control(problem: Problem, n: int) -> Problem:
    """The problem without bounds, to evaluate its functions at a given control; unchanged if its set is fixed."""
    return altered(problem, controls=AnyControl(count_of(problem, n))) if callable(problem.controls) else problem


def _of_v(function: jax.tree_util.Partial, problem: Problem) -> jax.tree_util.Partial:
    """A function of (x, u) as a function of (x, v), with the leaves of the function and of the bounds.

    It is a closure, not an object, because the search for numbers that a function reads from outside follows closures.
    """
    above: Callable = function.func
    below: Callable = problem.controls.func
    place = int(problem.time_dependent)  # position of the state among the arguments

    def steered(mine: tuple, theirs: tuple, *arguments: Any) -> Array:
        (known, options), (numbers, others) = mine, theirs
        where, v = arguments[: place + 1], arguments[place + 1]
        u = control_of(bounds_at(lambda *where: below(*numbers, *where, **others), *where), v)
        return above(*known, *where, u, *arguments[place + 2 :], **options)

    leaves = (function.args, function.keywords), (problem.controls.args, problem.controls.keywords)
    return jax.tree_util.Partial(steered, *leaves)
