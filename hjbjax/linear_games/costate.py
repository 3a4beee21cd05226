"""The costate of one state: a convex problem in n unknowns, solved by Newton's method along a path of barriers.

With s = time to go, Φ_s = e^{As} and x̄ = Φ_τ x + ∫₀^τ Φ_s c ds, the value of a game with a convex terminal cost J is

    V(x) = max_p [ p·x̄ − J*(p) − ∫₀^τ σ_U(−B'Φ_s'p) − σ_D(C'Φ_s'p) ds ]

For controls that are constant on N intervals, and with barriers of size μ for the dual point θ of p and for the
controls, this is a smooth concave maximum over θ, see ``convex`` and ``support``. μ falls from the size of the effect
of the control to rounding. The last θ gives two bounds of V without any discretisation error:

    upper: J at the end of the path under the piecewise constant controls, which are admissible
    lower: the formula at p, with an upper bound of the integral. B'Φ_s'p is interpolated linearly between nodes; the
           integral of σ over a line is known or bounded by convexity, and the interpolation error by the second
           derivative.

The barriers are those of interior point methods.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.linear_games.linear_dynamics import LinearGame
from hjbjax.linear_games.support import integral_over_line, largest_entries, smooth_support, support
from hjbjax.problem.types import Array, Number, State

FALL = 0.2  # factor of μ from one barrier to the next
NEAR = 0.1  # Newton's predicted gain, in units of μ, at which μ falls
EXACT = 3  # Newton steps after which a point at which μ may fall is exact for derivatives
STEPS = 200  # the largest number of Newton steps; ten to sixty are usual
SHORTEST = 2.0**-12  # the shortest step of a line search
FINER = 8  # nodes of the integral per interval of the control
TERMS = 17  # terms of a Taylor series: 1/18! is below the rounding of float64
REPLIES = 30  # best responses of the disturbance that are computed where the Hamiltonian is not convex


class Flow(NamedTuple):
    """The dynamics over the time to go τ.

    Attributes:
      tau: τ.
      end: Φ_τ, shape (n, n).
      drift: ∫ Φ_s c ds, shape (n,).
      own, other: the means of Φ_s B and Φ_s C on every interval of s, shapes (N, n, m) and (N, n, k).
      nodes: Φ_s B at the nodes of the integral, shape (FINER N + 1, n, m).
    """

    tau: Any
    end: Any
    drift: Any
    own: Any
    other: Any
    nodes: Any


class StateSolution(NamedTuple):
    """The result for one state, of the game in which the minimising player is ``own``.

    Attributes:
      value: the formula.
      lower, upper: bounds of the value; ``upper`` is infinite if the formula is only a lower bound.
      costate: p at the end of the path, shape (n,); Φ_τ'p is the costate at its start.
      mu: the last μ per unit of time.
      gap: the difference of the two bounds for piecewise constant controls, in units of the effect of the control.
      steps: the number of Newton steps.
    """

    value: Any
    lower: Any
    upper: Any
    costate: Any
    mu: Any
    gap: Any
    steps: Any


class _Iterate(NamedTuple):
    """State of the iteration: the dual point, μ, the number of steps, and True if it is done."""

    theta: Any
    mu: Any
    count: Any
    done: Any


def flow_over(game: LinearGame, tau: Number, intervals: int, dtype: Any) -> Flow:
    """Tables of the dynamics over the time to go ``tau``."""
    a = jnp.asarray(game.drift, dtype)
    n, fine = a.shape[0], FINER * intervals
    h = jnp.asarray(tau, dtype) / fine
    # Taylor series of Φ_h and of the mean (1/h) ∫ Φ_s ds; |A h| is below 1 unless e^{|A| τ} overflows
    eye, small = jnp.eye(n, dtype=dtype), a * h
    mean = jax.lax.fori_loop(0, TERMS, lambda k, total: eye + small @ total / (TERMS + 1 - k), eye)
    step = eye + small @ mean
    powers = jax.lax.scan(lambda total, _: (step @ total, total), eye, None, fine + 1)[1]
    means = jnp.mean((powers[:-1] @ mean).reshape(intervals, FINER, n, n), axis=1)
    own, other = (jnp.asarray(each, dtype) for each in (game.own, game.other))
    return Flow(
        tau=jnp.asarray(tau, dtype),
        end=powers[-1],
        drift=tau * jnp.mean(means, axis=0) @ jnp.asarray(game.constant, dtype),
        own=means @ own,
        other=means @ other,
        nodes=powers @ own,
    )


def solve_state(game: LinearGame, along: Flow, x: State) -> StateSolution:
    """Value, bounds and costate at one state."""
    center = along.end @ x + along.drift
    if not game.playing:
        return _one_player(game, along, center)

    # any disturbance known in advance gives a lower bound; the best reply to each costate raises the bound
    def reply(_: int, so_far: tuple) -> tuple:
        best, p = so_far
        d = jax.vmap(lambda w: smooth_support(game.other_set, w, best.mu)[1])(jnp.einsum("kim,i->km", along.other, p))
        push = along.tau * jnp.mean(jnp.einsum("kim,km->ki", along.other, d), axis=0)
        found = _one_player(game, along, center + push)
        better = found.lower > best.lower
        # the best reply to p does not change the bound to first order
        following = jax.lax.stop_gradient(found.costate)
        return jax.tree.map(lambda new, old: jnp.where(better, new, old), found, best), following

    first = _one_player(game, along, center)
    nothing = first._replace(value=jnp.full_like(first.value, -jnp.inf), lower=jnp.full_like(first.lower, -jnp.inf))
    best, _ = jax.lax.fori_loop(0, REPLIES, reply, (nothing, jax.lax.stop_gradient(first.costate)))
    return best._replace(upper=jnp.full_like(best.upper, jnp.inf))


def _one_player(game: LinearGame, along: Flow, center: State) -> StateSolution:
    """The answer for one player, or for a game in which the player can undo the disturbance."""
    size, largest = _sizes(game, along, center)
    eps = float(jnp.finfo(center.dtype).eps)
    rounding = 64 * eps * largest
    smallest = size * eps**0.57 + rounding
    # where the control has hardly any effect, the dual point still has to find the largest of the functions in J
    begun = _Iterate(game.terminal.start(center)[0], jnp.maximum(size, largest), 0, False)
    found = jax.lax.while_loop(
        lambda now: ~now.done & (now.count < STEPS), lambda now: _step(game, along, center, smallest, now), begun
    )
    theta, mu = jax.lax.stop_gradient((found.theta, found.mu))
    upper, discrete = _bounds(game, along, center, theta, mu)
    p, fixed, _ = game.terminal.dual(theta, mu)
    integral, slack = _integral(game, along, p)
    terms = jnp.abs(integral) + jnp.abs(fixed) + jnp.abs(p) @ jnp.abs(center)
    slack = slack + 8 * eps * terms
    theta = _maximiser(game, along, center, theta, mu)
    value = _formula(game, along, center, theta, mu)
    value = value + jax.lax.stop_gradient(jnp.minimum(upper - value, 0))
    # less than the rounding of the terminal cost cannot be reached where the control has hardly any effect
    gap = jnp.maximum(upper - discrete - 4 * _degree(game, along) * rounding, 0) / jnp.where(size > 0, size, 1)
    p = game.terminal.dual(theta, mu)[0]
    return StateSolution(value, value - slack, jnp.maximum(upper, value - slack), p, _pace(along, mu), gap, found.count)


@jax.custom_jvp
def _maximiser(game: LinearGame, along: Flow, center: State, theta: Array, mu: Number) -> Array:
    """The dual point θ that the iteration found, with the derivative of the maximiser by the implicit function theorem.

    The derivative is that of the maximum with barriers, so it is large and finite where the maximiser jumps.
    """
    return theta


@_maximiser.defjvp
def _maximiser_derivative(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    game, along, center, theta, mu = primals
    row = game.terminal.start(center)[1]
    # the iteration ends when it is near enough for the value; its last steps matter for derivatives only
    for _ in range(EXACT):
        rising = jax.grad(_merit(game, along, center, mu))(theta)
        theta = theta + _constrained(_curvature(game, along, theta, mu), rising, row, theta)
    # again with its derivative, for derivatives of higher order
    theta = _maximiser(game, along, center, jax.lax.stop_gradient(theta), mu)

    def slope(game: LinearGame, along: Flow, center: State) -> Array:
        return jax.grad(_merit(game, along, center, mu))(theta)

    change = jax.jvp(slope, (game, along, center), tangents[:3])[1]
    matrix = _curvature(game, along, theta, mu)
    return theta, _constrained(matrix, change, row, jax.lax.stop_gradient(theta))


def _formula_at(game: LinearGame, along: Flow, center: State, theta: Array, mu: Number) -> Array:
    """The formula at a dual point."""
    p, fixed, _ = game.terminal.dual(theta, mu)
    return fixed + p @ center - _integral(game, along, p)[0]


@jax.custom_jvp
def _formula(game: LinearGame, along: Flow, center: State, theta: Array, mu: Number) -> Array:
    """The formula at its maximiser θ, whose own derivative contributes nothing to the derivative of the maximum."""
    return _formula_at(game, along, center, theta, mu)


@_formula.defjvp
def _formula_derivative(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    theta, mu = primals[3:]

    def at(game: LinearGame, along: Flow, center: State) -> Array:
        return _formula_at(game, along, center, theta, mu)

    return jax.jvp(at, primals[:3], tangents[:3])


def _pace(along: Flow, mu: Number) -> Array:
    """μ per unit of time."""
    return mu / jnp.where(along.tau > 0, along.tau, 1)


def _degree(game: LinearGame, along: Flow) -> int:
    """The duality gap of the maximum with barriers is this number times μ."""
    return game.terminal.degree + 2 * np.shape(along.own)[2]


def _bounds(game: LinearGame, along: Flow, center: State, theta: Array, mu: Number) -> tuple[Array, Array]:
    """Cost of the piecewise constant control at θ, and the dual value."""
    p, fixed, _ = game.terminal.dual(theta, mu)
    upper = game.terminal(center + _under(game, along, _pace(along, mu), p)[1])
    w = -jnp.einsum("kim,i->km", along.own, p)
    return upper, fixed + p @ center - along.tau * jnp.mean(support(game.effective, w))


def _sizes(game: LinearGame, along: Flow, center: State) -> tuple[jax.Array, jax.Array]:
    """The effect of the control on the terminal cost, and the size of the terms of the terminal cost."""
    eye = jnp.eye(len(center), dtype=center.dtype)
    reach = along.tau * jnp.mean(
        jax.vmap(lambda b: jnp.stack([support(game.effective, eye @ b), support(game.effective, -eye @ b)]))(along.own),
        axis=0,
    )
    here = game.terminal(center)
    ends = jnp.concatenate([center + reach[0][:, None] * eye, center - reach[1][:, None] * eye])
    size = jnp.max(jnp.abs(jax.vmap(game.terminal)(ends) - here))
    eps, tiny = (float(getattr(jnp.finfo(center.dtype), name)) for name in ("eps", "tiny"))
    largest = jnp.asarray(game.terminal.magnitude(center), center.dtype)
    # without any effect the smallest positive number keeps the divisions finite
    return jax.lax.stop_gradient((jnp.maximum(size, eps * largest + tiny**0.5), largest))


def _under(game: LinearGame, along: Flow, pace: Number, p: Array) -> tuple[jax.Array, jax.Array]:
    """τ times the means of σ_μ and of the velocity over the intervals."""
    values, controls = jax.vmap(lambda b: smooth_support(game.effective, -p @ b, pace))(along.own)
    mean = jnp.mean(jnp.einsum("kim,km->ki", along.own, controls), axis=0)
    return along.tau * jnp.mean(values), along.tau * mean


def _merit(game: LinearGame, along: Flow, center: State, mu: Number) -> Callable:
    """The function of θ with barriers whose maximum is computed."""

    def merit(theta: Array) -> Array:
        p, fixed, barrier = game.terminal.dual(theta, mu)
        return fixed + barrier + p @ center - _under(game, along, _pace(along, mu), p)[0]

    return merit


def _curvature(game: LinearGame, along: Flow, theta: Array, mu: Number) -> jax.Array:
    """Minus the second derivative of the merit."""
    to_p, p = jax.jacfwd(lambda theta: 2 * (game.terminal.dual(theta, mu)[0],), has_aux=True)(theta)
    give = jax.jacfwd(lambda p: _under(game, along, _pace(along, mu), p)[1])(p)  # −give is positive semidefinite
    return game.terminal.curvature(theta, mu) - to_p.T @ give @ to_p


def _step(game: LinearGame, along: Flow, center: State, smallest: Array, now: _Iterate) -> _Iterate:
    """One Newton step with a line search, or a smaller μ."""
    mu, theta = now.mu, now.theta
    merit = _merit(game, along, center, mu)
    here, slope = jax.value_and_grad(merit)(theta)
    step = _constrained(_curvature(game, along, theta, mu), slope, game.terminal.start(center)[1], theta)
    gain = slope @ step

    def too_long(share: Array) -> jax.Array:
        # a comparison with NaN is false, and NaN, outside the domain of a barrier, must shorten the step
        return (share > SHORTEST) & ~(merit(theta + share * step) >= here + 1e-4 * share * gain)

    share = jax.lax.while_loop(too_long, lambda share: share / 2, jnp.ones((), theta.dtype))
    moved = merit(theta + share * step)
    near = gain <= NEAR * mu
    upper, discrete = _bounds(game, along, center, theta, mu)
    last = near & (mu <= smallest) & (upper - discrete <= 4 * _degree(game, along) * mu)
    fallen = jnp.where(near & ~last, jnp.maximum(FALL * mu, smallest), mu)
    keep = last | ~jnp.isfinite(moved)
    return _Iterate(jnp.where(keep, theta, theta + share * step), fallen, now.count + 1, last)


def _constrained(matrix: Array, slope: Array, row: Array, theta: Array) -> jax.Array:
    """The Newton step for a positive definite matrix, with row·step = 0.

    The largest weight is eliminated; its curvature is the smallest, so the others keep theirs.
    """
    eye = jnp.eye(len(row), dtype=matrix.dtype)
    largest = eye[jnp.argmax(theta * row)] * jnp.max(row)  # 0 without a constraint
    basis = (eye - largest[:, None] * row) * (1 - largest)
    reduced = basis.T @ matrix @ basis + jnp.diag(largest)
    # entries differ by the square of μ, so scale the diagonal to 1, and add a ridge of the size of rounding for costs
    # that do not depend on some direction
    diagonal = jnp.diagonal(reduced)
    scale = jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1)), 1)
    scaled = reduced * scale[:, None] * scale + 4 * jnp.finfo(matrix.dtype).eps * eye
    return basis @ (scale * jnp.linalg.solve(scaled, scale * (slope @ basis)))


def _integral(game: LinearGame, along: Flow, p: Array) -> tuple[jax.Array, jax.Array]:
    """∫ σ(−B'Φ_s'p) ds with B'Φ_s'p linear between the nodes, and a bound of the error of this interpolation."""
    w = -jnp.einsum("kim,i->km", along.nodes, p)
    fine = w.shape[0] - 1
    h = along.tau / fine
    integral = h * jnp.sum(integral_over_line(game.effective, w[:-1], w[1:]))
    a = jnp.asarray(game.drift, p.dtype)
    twice = p @ a @ a
    size = jnp.sqrt(jnp.sum(a * a))
    curved = jnp.abs(jnp.einsum("kim,i->km", along.nodes, twice))
    # |w''| on the interval after a node: its value there, and the largest third derivative times the length
    lengths = jnp.sqrt(jnp.sum(along.nodes**2, axis=1))
    curved = curved + h * size * jnp.exp(size * h) * lengths * jnp.sqrt(twice @ twice)
    slack = h**3 / 8 * jnp.sum(curved[:-1] @ largest_entries(game.effective, p.dtype))
    return integral, slack
