"""The max-plus equation of the robust information state on a grid, and maxima between the nodes.

Between two measurements the worst-case cost p of paths that end in x, for dx/dt = f + σw with a = σσᵀ diagonal, obeys

    p_t = max_w { −Dp·(f + σw) − ½γ²|w|² } + L = Σ_i max_v { −v D_i p − (γ²/2a_ii) (v − f_i)² } + L,    v = f + σw,

a Hamilton–Jacobi equation without an opponent, convex in Dp. A path arrives at x with velocity v from x − v dt. So
v > 0 uses the backward slope D⁻ and v < 0 the forward slope D⁺, which gives the Godunov flux

    max{ −v⁺ D⁻ − (γ²/2a) (v⁺ − f)²,  −v⁻ D⁺ − (γ²/2a) (v⁻ − f)² },    v⁺ = (f − aD⁻/γ²)⁺,  v⁻ = (f − aD⁺/γ²)⁻.

It is monotone in all neighbours for steps up to 1/max Σ_i |v_i|/h_i. The velocities are computed from p; no bound is
needed beforehand. On an axis without noise v = f. Nothing flows in at an end of an axis: velocities that point inwards
there are set to zero, and so is the drift if no noise can oppose it.

The scheme of the slopes sets the order in space. In time a strong-stability-preserving Runge–Kutta method makes as many
steps as the velocities require. Slopes of order 2 and more are exact for a quadratic p, which then stays quadratic up
to the error in time.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Differences, Discretisation
from hjbjax.iteration.time_methods import TABLEAUX
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import cast, front_door, is_traced, numbers, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Field, Nodes, Number, Scalar

MOST = (
    100_000  # inner steps: a path crosses up to this number of cells, more than any sensible interval of a record needs
)
FRACTION = 0.8  # fraction of the monotone step limit, because later stages may have larger velocities


@pytree_dataclass()
class MaxPlusMarch:
    """The equation of p, with all terms that do not depend on p.

    Args:
      on: the grid and the scheme of the slopes; its problem is ignored.
      drift: f, n components, each with a shape that broadcasts to (*grid).
      spread: a_ii/γ² for every axis, ≥ 0.
      source: L minus the cost of the measurement, (*grid), per unit time.
    """

    on: Discretisation
    drift: Sequence[Any]
    spread: Sequence[Any]
    source: Any

    def rate(self, p: Field) -> tuple[Field, Scalar]:
        """p_t at every node, and the fastest Σ_i |v_i|/h_i."""
        on, grid = self.on, self.on.grid
        links = tuple(stencil.grid_links(grid, axis) for axis in range(grid.ndim))
        one_sided = tuple(stencil.one_sided(p, grid, axis, link) for axis, link in enumerate(links))
        slopes = on.scheme.slopes(Differences(on, on.coordinates(), p, links, one_sided))
        total, speed = jnp.broadcast_to(self.source, p.shape), jnp.zeros_like(p)
        for axis, (link, (up, down)) in enumerate(zip(links, slopes, strict=True)):
            gain, fastest = self._along(axis, up, down, link)
            total, speed = total + gain, speed + fastest
        return total, jnp.max(speed)

    def _along(self, axis: int, up: Field, down: Field, link: stencil.Links) -> tuple[Any, Any]:
        """The Godunov flux along an axis, and |v|/h."""
        f, spread = jnp.asarray(self.drift[axis]), jnp.asarray(self.spread[axis])
        noisy = spread > 0
        room = jnp.where(noisy, spread, 1)  # dividing by zero in the unused branch would make NaN derivatives
        lower, upper = (stencil.wall(self.on.grid, axis, step) for step in (-1, 1))
        rising = jnp.where(lower, 0, jnp.maximum(f - spread * down, 0))
        falling = jnp.where(upper, 0, jnp.minimum(f - spread * up, 0))
        from_below = -rising * down - jnp.where(noisy, (rising - f) ** 2 / (2 * room), 0)
        from_above = -falling * up - jnp.where(noisy, (falling - f) ** 2 / (2 * room), 0)
        # without noise the velocity is the drift and one of the two terms is zero, so the sum is the upwind difference
        gain = jnp.where(noisy, jnp.maximum(from_below, from_above), from_below + from_above)
        return gain, jnp.maximum(rising / link.down, -falling / link.up)

    def growth(self) -> Scalar:
        """The rate at which the source makes Σ_i |v_i|/h_i grow, per unit time squared."""
        source, grid = jnp.asarray(self.source), self.on.grid
        if source.ndim == 0:
            return jnp.zeros((), self.on.dtype)
        source, total = jnp.broadcast_to(source, grid.shape), jnp.zeros((), self.on.dtype)
        for axis in range(grid.ndim):
            link = stencil.grid_links(grid, axis)
            up, down = stencil.one_sided(source, grid, axis, link)
            slope = jnp.maximum(jnp.abs(up) / link.up, jnp.abs(down) / link.down)
            total = total + jnp.max(jnp.asarray(self.spread[axis]) * slope)
        return total

    def after(self, p: Field, dt: Number, most: int | None = None) -> tuple[Field, jax.Array]:
        """p after the time dt, in as many steps as the velocities require, and the number of steps.

        NaN if p is no longer finite or if more than ``MOST`` steps are needed. With ``most`` the loop makes exactly
        that number of steps, of length zero once the time is used up, and has a reverse derivative.
        """
        tableau = TABLEAUX[self.on.scheme.stages]
        # an accurate measurement bends p so fast that the velocities at the start of the step underestimate later ones
        least = jnp.sqrt(jax.lax.stop_gradient(self.growth()))  # the root has no derivative at zero
        means = jnp.asarray(tableau.means, p.dtype)

        def step(carry: tuple[Field, Scalar, Scalar]) -> tuple[Field, Scalar, Scalar]:
            p, left, count = carry
            first, speed = self.rate(p)
            whole = jnp.ceil(left * jnp.maximum(speed / FRACTION, least))
            dt = left / jnp.maximum(whole, 1)  # the steps are equal if the velocities do not change
            moved = p + dt * first  # the first mean is zero in every tableau

            def stage(k: Scalar, w: Field) -> Field:
                return means[k] * p + (1 - means[k]) * (w + dt * self.rate(w)[0])

            # a loop compiles the slopes once instead of once per stage
            moved = jax.lax.fori_loop(1, len(tableau.means), stage, moved)
            # an infinite velocity would otherwise take infinitely many steps of length zero
            fine = jnp.isfinite(speed) & jnp.all(jnp.isfinite(moved)) & (count < MOST)
            rest = jnp.where(whole <= 1, 0, left - dt)
            return jnp.where(fine, moved, jnp.nan), jnp.where(fine, rest, 0), count + (left > 0)

        carry = p, jnp.asarray(dt, p.dtype), jnp.zeros((), jnp.int32)
        if most is None:
            p, _, count = jax.lax.while_loop(lambda carry: carry[1] > 0, step, carry)
        else:  # the backward pass repeats the steps, so that only one p per step is stored
            again = jax.checkpoint(step)
            (p, _, count), _ = jax.lax.scan(lambda carry, _: (again(carry), None), carry, length=most)
        return p, count


@front_door
def sup_pairing(p: Nodes, psi: Nodes | float, grid: Grid) -> tuple[Array, Array]:
    """The maximum of p + ψ over the box and the state where it is attained: the max-plus inner product (p, ψ).

    Between the nodes p + ψ is approximated by the quadratic through the largest node and its neighbours, with cross
    terms. The order is 3 where p + ψ is smooth, and the result is exact for a concave quadratic with its maximum inside
    the box. The state is at most one spacing from the largest node. A maximum at an end of the box is not refined.

    Args:
      p: the information state at the nodes, shape (*grid); −∞ for impossible states.
      psi: a cost at the nodes, shape (*grid), or a number. If it is the value function of the control problem, the
        maximiser is the state used by certainty equivalence for games.
      grid: the nodes.

    Returns:
      The maximum, shape (), in the units of cost, and the state, shape (n,), NaN if p + ψ is −∞ at all nodes. Both
      support ``jit`` and ``vmap``.

    Raises:
      ValueError: node values of another shape than the grid, or NaN.
      TypeError: an argument that is not a Grid, or values that are not numbers.

    Example:
      >>> grid = Grid([-1.0], [1.0], (11,))
      >>> x = grid.axis(0)
      >>> value, state = sup_pairing(-2.0 * (x - 0.33) ** 2, 1.0, grid)
      >>> round(float(value), 6), round(float(state[0]), 6)
      (1.0, 0.33)

    Source: M. R. James, Nonlinear Control Systems, section 12.3.
    """
    if not isinstance(grid, Grid):
        raise TypeError(f"sup_pairing: got {type(grid).__name__} for the grid, wanted a Grid")
    given: Any = {"p": p, "psi": psi}
    for name, each in given.items():
        given[name] = values = each if is_traced(each) else numbers(each, f"sup_pairing: {name}")
        shape = np.shape(values)
        if not is_traced(values) and np.any(np.isnan(values)):
            raise ValueError(
                f"sup_pairing: {name} is NaN at {int(np.sum(np.isnan(values)))} nodes, wanted numbers or −∞"
            )
        if shape != grid.shape and not (name == "psi" and shape == ()):
            raise ValueError(f"sup_pairing: {name} has shape {shape}, wanted {grid.shape}: one number per node")
    total = given["p"] + given["psi"]
    if is_traced(total, grid):
        return refined_maximum(jnp.asarray(total), grid)
    with own_settings(x64=True):
        value, state = _refined_maximum(jnp.asarray(total), cast(grid, np.float64))
        return np.asarray(value), np.asarray(state)


def refined_maximum(values: Field, grid: Grid) -> tuple[Scalar, jax.Array]:
    """The maximum of node values and its state, refined by a quadratic around the largest node; traceable.

    Returns:
      The maximum, shape (), and the state, shape (n,), inside the box and wrapped on periodic axes.
    """
    n, dtype = grid.ndim, values.dtype
    best = jnp.unravel_index(jnp.argmax(values), grid.shape)
    top, around = values[best], _neighbours(grid, best, dtype)

    def at(steps: Sequence[int]) -> Scalar:
        return values[tuple(around[axis][0][step + 1] for axis, step in enumerate(steps))]

    def unit(*moves: tuple[int, int]) -> Scalar:
        steps = [0] * n
        for axis, step in moves:
            steps[axis] = step
        return at(steps)

    gradient, hessian = [], [[jnp.zeros((), dtype)] * n for _ in range(n)]
    for i in range(n):
        down, up = around[i][1]
        below, above = (top - unit((i, -1))) / down, (unit((i, 1)) - top) / up
        gradient.append((down * above + up * below) / (down + up))
        hessian[i][i] = 2 * (above - below) / (down + up)
        for j in range(i):
            cross = sum(p * q * unit((i, p), (j, q)) for p in (-1, 1) for q in (-1, 1))
            hessian[i][j] = hessian[j][i] = cross / (sum(around[i][1]) * sum(around[j][1]))
    widths = jnp.stack([jnp.stack(each[1]) for each in around])  # (n, 2): to the node below and to the node above
    free = jnp.stack([each[2] for each in around]) & jnp.isfinite(jnp.stack(gradient))
    shift = _climb(jnp.stack(gradient), jnp.stack([jnp.stack(row) for row in hessian]), free, widths)
    slope, bend = jnp.where(free, jnp.stack(gradient), 0), jnp.stack([jnp.stack(row) for row in hessian])
    bend = jnp.where(free[:, None] & free[None, :] & jnp.isfinite(bend), bend, 0)
    gain = slope @ shift + shift @ bend @ shift / 2
    place = jnp.stack([jnp.asarray(grid.axis(axis), dtype)[best[axis]] for axis in range(n)])
    better = gain > 0
    # argmax treats NaN as the largest value: if p is NaN somewhere, or −∞ everywhere, the state is NaN
    found = jnp.where(jnp.isnan(top) | (top == -jnp.inf), jnp.nan, place + jnp.where(better, shift, 0))
    return top + jnp.where(better, gain, 0), grid.wrap(found)


_refined_maximum = jax.jit(refined_maximum)


def _neighbours(grid: Grid, best: Sequence[jax.Array], dtype: Any) -> list[tuple[list, list, Any]]:
    """For every axis: the indices of the node below, the node and the node above; two distances; True if both exist."""
    found = []
    for axis, count in enumerate(grid.shape):
        here, x = best[axis], jnp.asarray(grid.axis(axis), dtype)
        if grid.periodic[axis]:
            numbers = [(here + step) % count for step in (-1, 0, 1)]
            spacing = jnp.asarray(grid.spacing(axis), dtype)
            found.append((numbers, [spacing, spacing], jnp.ones((), bool)))
            continue
        inside = (here > 0) & (here < count - 1)
        numbers = [jnp.clip(here + step, 0, count - 1) for step in (-1, 0, 1)]
        # a node at an end is its own neighbour; any width but zero works, because that axis is left out
        down, up = (jnp.where(inside, x[numbers[k + 1]] - x[numbers[k]], 1) for k in (0, 1))
        found.append((numbers, [down, up], inside))
    return found


def _climb(gradient: jax.Array, hessian: jax.Array, free: jax.Array, widths: jax.Array) -> jax.Array:
    """The step to the maximum of the quadratic, clipped to the neighbours; axis by axis if the quadratic has none."""
    n = gradient.shape[0]
    # in units of the spacings, so that all entries are comparable
    scale = jnp.mean(widths, axis=1)
    slope = jnp.where(free, gradient * scale, 0)
    bend = hessian * scale[:, None] * scale[None, :]
    curved = free & (jnp.diag(bend) < 0)
    kept = curved[:, None] & curved[None, :] & jnp.isfinite(bend)
    bend = jnp.where(kept, bend, -jnp.eye(n, dtype=bend.dtype))  # no step along axes without negative curvature
    slope = jnp.where(curved, slope, 0)
    # the quadratic is degenerate if an eigenvalue, after scaling the diagonal to one, is of the size of rounding
    unit = bend / jnp.sqrt(jnp.outer(jnp.diag(bend), jnp.diag(bend)))
    whole = -jnp.linalg.solve(jnp.where(jnp.all(jnp.isfinite(unit)), bend, -jnp.eye(n, dtype=bend.dtype)), slope)
    definite = jnp.all(jnp.linalg.eigvalsh(unit) < -jnp.sqrt(jnp.finfo(bend.dtype).eps))
    near = jnp.all((whole * scale <= widths[:, 1]) & (-whole * scale <= widths[:, 0]))
    alone = -slope / jnp.diag(bend)
    step = jnp.where(definite & near & jnp.all(jnp.isfinite(whole)), whole, alone) * scale
    return jnp.clip(step, -widths[:, 0], widths[:, 1])
