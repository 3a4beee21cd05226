"""One-sided slopes of order 2 and 5 on equal spacings: ENO and WENO.

With the differences D on both sides of a node and their differences s, second order uses the smoother stencil,

    P⁺ = D⁺ − ½ m(s_i, s_{i+1}),    P⁻ = D⁻ + ½ m(s_i, s_{i−1}),    m(a, b) = a if |a| < |b| else b.

Fifth order weighs three stencils: with the differences v₁ … v₅ = D_{i−5/2} … D_{i+3/2} and their own differences
p, q, r, s, the slope from below is

    v₃ + [w₀ (5q − 2p) + w₁ (2r + q) + w₂ (4r − s)] / (6 (w₀ + w₁ + w₂)),      w_k = c_k / (ε + S_k)²,

    S₀ = 13/12 (q − p)² + ¼ (3q − p)²,  S₁ = 13/12 (r − q)² + ¼ (q + r)²,  S₂ = 13/12 (s − r)² + ¼ (s − 3r)²,

c = (0.1, 0.6, 0.3); the slope from above is its mirror image. At a kink the slope is as accurate as the best of three
third-order stencils. The slopes in S_k are scaled by the range of V over the width of the box, so ε = 10⁻⁶ has no unit.
Beyond an open end the value continues as a parabola, beyond a linear end as a line, and where noise reflects as its
mirror image; across a wall the slope is zero, as in every scheme here. The terms are ordered so that XLA fuses them
into one loop without temporary arrays.
Source: G.-S. Jiang and D. Peng, Weighted ENO schemes for Hamilton–Jacobi equations, SIAM J. Sci. Comput. 21.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.stencil import Links, PerNode
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Array, AtNodes, Field, Mask

Noisy: TypeAlias = Sequence[Mapping[int, Array]]  # per axis: walls where noise reflects, see ``Discretisation``
EPSILON = 1e-6  # relative to the typical squared slope: differences in smoothness below it are ignored


def eno2(values: Field, grid: Grid, noisy: Noisy | None = None) -> list[tuple[Field, Field]]:
    """The slopes from above and from below along every axis, each of shape (*grid); zero across a wall."""
    return along_states(grid, lambda axis: of_second_order(values, grid, axis, _smaller, noisy))


def along_states(grid: Grid, slopes: Callable[[int], tuple[Field, Field]]) -> list[tuple[Field, Field]]:
    """The slopes along every axis of the state; zero along an axis of modes, where nothing moves."""
    zero = jnp.zeros(())
    return [slopes(axis) if axis in grid.state_axes else (zero, zero) for axis in range(grid.ndim)]


def of_second_order(
    values: Field, grid: Grid, axis: int, mean: Callable[[Field, Field], Field], noisy: Noisy | None = None
) -> tuple[Field, Field]:
    """D⁺ − (h/2) m(s_i, s_{i+1}) and D⁻ + (h/2) m(s_i, s_{i−1}) for a mean m of second differences; zero across a wall.

    Requires equal spacings and at least three nodes. Beyond an end the second difference is extrapolated as a constant,
    or mirrored where noise reflects.
    """
    far_down, down, up, far_up = _differences(values, grid, axis, 2, 1 / grid.spacing(axis), noisy)
    bend = up - down  # h V'': half of it is h/2 V'', the leading error of a one-sided difference
    above, below = up - mean(bend, far_up - up) / 2, down + mean(bend, down - far_down) / 2
    return stencil.stopped(above, below, grid, axis)


def weno5(values: Field, grid: Grid, lost: Mask | None = None, noisy: Noisy | None = None) -> list[tuple[Field, Field]]:
    """The slopes from above and from below along every axis, each of shape (*grid); zero across a wall.

    Values at ``lost`` nodes are ignored in the scaling.
    """
    most, least = (values, values) if lost is None else (jnp.where(lost, fill, values) for fill in (-jnp.inf, jnp.inf))
    # it only sets the unit of ε, so no derivative should pass through the nodes of the largest and the least V
    extent = jax.lax.stop_gradient(grid.layout.largest(most) - grid.layout.least(least))
    extent = jnp.where(extent > 0, extent, 1)  # a constant V has slopes zero in any unit

    def slopes(axis: int) -> tuple[Field, Field]:
        typical = extent / (grid.hi[axis] - grid.lo[axis])
        steps = _differences(values, grid, axis, 3, 1 / (grid.spacing(axis) * typical), noisy)
        # six differences: the last five from above are the mirror image of the first five from below
        above, below = typical * _weighted(*steps[:0:-1]), typical * _weighted(*steps[:-1])
        return stencil.stopped(above, below, grid, axis)

    return along_states(grid, slopes)


def broken_stencils(link: Links, grid: Grid, axis: int, lost: Mask | None = None) -> AtNodes | None:
    """The nodes whose seven values along an axis are not smooth together: some are in a target or ``lost``."""
    found = None if lost is None else _spread(jnp.asarray(lost), grid, axis, 3)
    if link.meets_up is None or link.meets_down is None:
        return found
    # the second difference at the last free node before a target
    near = _spread(link.meets_up[0] | link.meets_down[0], grid, axis, 2)
    return near if found is None else found | near


def _spread(mask: AtNodes, grid: Grid, axis: int, reach: int) -> AtNodes:
    """The nodes within ``reach`` of a mask along an axis."""
    for _ in range(reach):
        up, down = (stencil.neighbour(mask, grid, stencil.unit(grid, axis, step)) for step in (1, -1))
        mask = mask | up | down
    return mask


def _smaller(a: Field, b: Field) -> Field:
    """m(a, b): the smaller of two second differences in size, which belongs to the smoother stencil."""
    return jnp.where(jnp.abs(a) < jnp.abs(b), a, b)


def _differences(values: Field, grid: Grid, axis: int, reach: int, scale: PerNode, noisy: Noisy | None) -> list[Field]:
    """The differences between neighbours times ``scale``, from ``reach`` nodes below a node to ``reach`` above."""
    # the barrier prevents fusion into the loop over the nodes, where the ends would become branches
    wide, count = jax.lax.optimization_barrier(_continued(values, grid, axis, reach, noisy)), grid.shape[axis]
    nodes = [jax.lax.slice_in_dim(wide, k, k + count, axis=axis) for k in range(2 * reach + 1)]
    return [(right - left) * scale for left, right in itertools.pairwise(nodes)]


def _continued(values: Field, grid: Grid, axis: int, reach: int, noisy: Noisy | None) -> jax.Array:
    """``values`` with ``reach`` more entries at both ends of an axis."""

    def ended(step: int) -> jax.Array:
        """The ``reach`` nearest entries beyond an end: on the parabola through its last three entries, or at a linear
        end on the line through two. Where noise reflects they are the mirror image.
        """
        a, b, c, *far = (stencil.slices(values, grid, axis, step, k) for k in range(max(3, reach + 1)))
        along = [-1 if i == axis else 1 for i in range(grid.ndim)]
        # Lagrange polynomials on the points 0, 1, 2, evaluated at −3, −2 and −1; the upper end is the mirror image
        line = (axis, step) in grid.sides("linear")
        known = [[4, -3, 0], [3, -2, 0], [2, -1, 0]] if line else [[10, -15, 6], [6, -8, 3], [3, -3, 1]]
        weights = np.array(known)[3 - reach :][::-step].T.astype(values.dtype)
        first, second, third = (w.reshape(along) * node for w, node in zip(weights, (a, b, c), strict=True))
        found = first + second + third
        if (end := stencil.sloped(grid, axis, step)) is not None:  # the mirror image with the prescribed slope
            rise = 2 * step * grid.spacing(axis) * (end.slope + end.rate * a)
            image = [node + k * rise for k, node in enumerate([b, c, *far][:reach], 1)]
            return jnp.concatenate(image[::-1] if step < 0 else image, axis).astype(values.dtype)
        if noisy is None or step not in noisy[axis]:
            return found
        image = [*far, c, b]
        return jnp.where(noisy[axis][step], jnp.concatenate(image if step < 0 else image[::-1], axis), found)

    below, above = (stencil.beyond(values, grid, axis, step, ended(step)) for step in (-1, 1))
    return stencil.joined(values, grid, axis, below, above)


def _weighted(a: Field, b: Field, c: Field, d: Field, e: Field) -> Field:
    """The weighted slope between c and d from five differences in upwind order."""
    p, q, r, s = b - a, c - b, d - c, e - d
    first = (13 / 12 * (q - p) ** 2 + (3 * q - p) ** 2 / 4 + EPSILON) ** 2
    middle = (13 / 12 * (r - q) ** 2 + (q + r) ** 2 / 4 + EPSILON) ** 2
    last = (13 / 12 * (s - r) ** 2 + (s - 3 * r) ** 2 / 4 + EPSILON) ** 2
    # c_k/(ε + S_k)² over one common denominator, so a slope takes one division instead of four
    w0, w1, w2 = 0.1 * (middle * last), 0.6 * (first * last), 0.3 * (first * middle)
    return c + _quotient(w0 * (5 * q - 2 * p) + w1 * (2 * r + q) + w2 * (4 * r - s), 6 * (w0 + w1 + w2))


@jax.custom_jvp
def _quotient(over: Field, under: Field) -> Field:
    """``over`` / ``under``. JAX's derivative squares ``under``, and ε⁸ is zero in float32."""
    return over / under


@_quotient.defjvp
def _derivative_of_the_quotient(primals: tuple[Field, Field], tangents: tuple[Field, Field]) -> tuple[Field, Field]:
    found = _quotient(*primals)
    return found, (tangents[0] - found * tangents[1]) / primals[1]
