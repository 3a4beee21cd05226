"""Ways out of a boundary-value problem that was not solved: what stands in the way of the method, in words.

Looked for in the problem itself and only after a failure: a start at which the equations have no slope, such as the
√y of a body at rest; a cost with kinks in u, such as |u|, under which u jumps where the method expects it to bend; and
ends on the edge of a target.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing
from hjbjax.problem.sets import Ball, samples
from hjbjax.problem.types import Array

BUDGET = 64  # controls at which H is differentiated
STRAIGHT = 1e-9  # |H_uu u²| over the spread of H that counts as no curvature


def way_out(bvp: BoundaryValueProblem) -> str:
    """What to do about a problem that was not solved, as the rest of a sentence; empty where nothing is known."""
    arrays = jax.tree.map(jnp.asarray, bvp)
    if not is_smooth_at_start(bvp):
        return (
            f"; at x0 = {np.asarray(bvp.start).tolist()} drift or cost has no finite slope: start a little off, or "
            "write it in states in which it has one (a speed as a state instead of √(2gy))"
        )
    if not bvp.rule.jumps and not bvp.rule.exact and (kinked := _kinked(arrays)):
        return kinked
    # sought from 1 on without a guess, whatever the unit of time
    sought = "; give horizon=FreeTime(guess) with the size of the final time" if bvp.free else ""
    if bvp.closing is Closing.TARGET:
        return sought + (
            "; where the end in the target is known give it as terminal=, without the target: "
            "dataclasses.replace(problem, target=None, exit_cost=None)"
        )
    return sought


def is_smooth_at_start(bvp: BoundaryValueProblem) -> bool:
    """Whether the equations are finite at x₀, where every path has to begin."""
    return bool(np.all(np.isfinite(_slopes_at_start(jax.tree.map(jnp.asarray, bvp)))))


def _kinked(bvp: BoundaryValueProblem) -> str:
    """Advice for inputs in which H is piecewise affine; empty where it bends in all of them."""
    bends, along, spread = (np.asarray(part) for part in _curvature(bvp))
    if isinstance(bvp.problem.controls, Ball) and len(bends) > 1:
        if along > STRAIGHT * spread:
            return ""
        return (
            "; the cost is a multiple of |u|, and u jumps between nothing and the sphere: write u as a size times a "
            "direction, two inputs of a Box, or enumerate the controls with Finite"
        )
    straight = np.flatnonzero(bends <= STRAIGHT * spread)
    if not len(straight):
        return ""
    names = ", ".join(f"u[{j}]" for j in straight)
    return (
        f"; in {names} cost and drift are pieces of straight lines, as |u| is, and u jumps between their ends: write "
        "u = u⁺ − u⁻ with two inputs ≥ 0 and the cost u⁺ + u⁻, or enumerate ends and kinks with Finite"
    )


@jax.jit
def _slopes_at_start(bvp: BoundaryValueProblem) -> jax.Array:
    """The slopes of H in the state at x₀ under a few controls, with a costate of ones."""
    assert bvp.problem.controls is not None
    x = jnp.asarray(bvp.start)
    tried = jnp.asarray(samples(bvp.problem.controls, BUDGET), x.dtype)
    return jax.vmap(lambda u: jax.grad(bvp.hamiltonian, 1)(0.0, x, jnp.ones_like(x), u))(tried)


@jax.jit
def _curvature(bvp: BoundaryValueProblem) -> tuple[Array, Array, Array]:
    """The largest |H_uu| of every input times its width squared, (m,); that of u'H_uu u; and the spread of H."""
    assert bvp.problem.controls is not None
    x = jnp.asarray(bvp.start)
    tried = jnp.asarray(samples(bvp.problem.controls, BUDGET), x.dtype)
    middle = (jnp.max(tried, axis=0) + jnp.min(tried, axis=0)) / 2
    width = jnp.max(tried, axis=0) - jnp.min(tried, axis=0)
    # off the grid of the samples, which holds the kinks: zero and the middle of the set
    tried = middle + (tried - middle) * 0.917 + 0.0123 * width

    def energy(u):
        return bvp.hamiltonian(0.0, x, jnp.ones_like(x), u)

    bends = jax.vmap(jax.hessian(energy))(tried)  # (samples, m, m)
    sizes = jnp.max(jnp.abs(bends) * width, axis=(0, 1)) * width
    along = jnp.max(jnp.abs(jnp.einsum("ki,kij,kj->k", tried, bends, tried)))
    energies = jax.vmap(energy)(tried)
    return sizes, along, jnp.max(energies) - jnp.min(energies)
