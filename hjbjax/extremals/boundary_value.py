"""The two-point boundary-value problem of Pontryagin's principle, (8.4) to (8.7), for SciPy's ``solve_bvp``.

Along an extremal, with the current-value costate p (the DV of the grid), the cost to go w, and H minimised over u,

    ẋ = f(t, x, u*),   ṗ = βp − H_x(t, x, p, u*),   ẇ = βw − L(t, x, u*),      x(0) = x₀

    fixed horizon        p(T) = ψ_x,  w(T) = ψ
    given end states     x_i(T) = c_i instead of the i-th condition on p
    target l ≤ 0         p(T) = ψ_x + ν l_x,  l(x(T)) = 0, with a number ν that is sought
    infinite horizon     p(T) = p̄ + P(x(T) − x̄), from there on by the Riccati equation of the rest (x̄, p̄)
    free final time      H = βψ − ψ_t − ν l_t at T, which is sought (ν = 0 without a target)

e^{−βt}(H − βw) is constant where neither drift nor cost depends on time. It is zero for an infinite horizon; at a free
end it is −e^{−βT}(ψ_t + ν l_t), zero unless what ends the path depends on time.

Where u* jumps, the problem is solved twice. First with weights exp(−H_k/ε)/Σ over the values u_k between which it
jumps, which makes the Hamiltonian −ε log Σ exp(−H_k/ε), up to a constant, for smaller and smaller ε. Then with one arc
for every value in the order found, all arcs on s ∈ [0, 1] at once, their durations sought, and H(u_k) = H(u_{k+1}) at
the switches: on an arc everything is smooth, so the switching times have the accuracy of the collocation (order 4).
"""

import dataclasses
import enum
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.hamiltonian import pointwise
from hjbjax.hamiltonian.pointwise import Rule
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, Control, Costate, Number, State
from hjbjax.solution.clock import Clock

ROUGH, COARSE = 1e-3, 1000  # tolerance and nodes on the way


@dataclasses.dataclass(frozen=True)
class Limits:
    """The limits of a collocation: its accuracy, its nodes and its time.

    Args:
      tol: on the relative residual of the equations and on the conditions.
      max_nodes: of the mesh.
      clock: when it is over.
    """

    tol: float
    max_nodes: int
    clock: Clock

    @property
    def rough(self) -> "Limits":
        """Limits of problems on the way to the one asked for."""
        return Limits(max(ROUGH, self.tol), min(COARSE, self.max_nodes), self.clock)


class Law(enum.Enum):
    """The law by which the control follows from state and costate."""

    MINIMUM = "the minimum of the Hamiltonian"
    MIXTURE = "weights over the values between which it jumps"
    ARCS = "one of these values on every arc"


class Closing(enum.Enum):
    """The conditions that hold at the final time."""

    COST = "a terminal cost"
    STATE = "given states, and a terminal cost for the others"
    TARGET = "the edge of a target"
    REST = "the Riccati equation of a rest"


@pytree_dataclass()
class Rest:
    """A rest of the Hamiltonian flow and the value near it, w̄ + p̄·y + ½ y'Py with y = x − x̄."""

    state: State
    costate: Costate
    value: Array
    matrix: Array


@pytree_dataclass(static=("rule", "law", "closing", "held", "free", "seams"))
class BoundaryValueProblem:
    """A boundary-value problem of Pontryagin's principle.

    Args:
      problem: the system and its costs.
      grid: whose periodic axes are wrapped, or None.
      start: x₀, shape (n,).
      horizon: T where it is given.
      final: ψ, as a function, a number or None.
      ends: the given end states, shape (n,).
      rest: of an infinite horizon.
      arcs: the value of the jumping inputs on every arc, shape (k, m); (1, m) without arcs.
      epsilon: ε of a mixture, in cost units per unit time.
      shifts: what is to be added to the states of every arc, shape (k, n): whole periods, between arcs that end at the
        seam of a periodic axis; ``None`` for zero.
      places: where on its axis every such arc but the last ends, shape (k−1,).
      rule: how the Hamiltonian is minimised.
      law: where the control comes from.
      closing: what holds at the end.
      held: which end states are given.
      free: whether the final time is sought.
      seams: the axis along which every arc but the last meets its end; empty where arcs end by a switch.
    """

    problem: Problem
    grid: Grid | None
    start: State
    horizon: Number
    final: Callable | Number | None
    ends: State
    rest: Rest | None
    arcs: Array
    epsilon: Number
    rule: Rule
    law: Law
    closing: Closing
    held: tuple[bool, ...]
    free: bool
    shifts: Array | None = None
    places: Array | None = None
    seams: tuple[int, ...] = ()

    @property
    def count(self) -> int:
        """The number of arcs."""
        return np.shape(self.arcs)[0]

    @property
    def n(self) -> int:
        """The number of states."""
        return np.shape(self.start)[0]

    @property
    def timed(self) -> bool:
        """Whether the durations of the arcs are sought."""
        return self.free or self.count > 1

    @property
    def unknowns(self) -> int:
        """The number of numbers that are sought beside the functions: durations, and ν."""
        return self.count * self.timed + (self.closing is Closing.TARGET)

    def durations(self, theta: Array) -> Array:
        """The lengths of the arcs, shape (k,)."""
        return theta[: self.count] if self.timed else jnp.reshape(jnp.asarray(self.horizon, theta.dtype), 1)

    def wrap(self, x: State) -> State:
        """The state with its periodic entries in the box."""
        return x if self.grid is None else self.grid.wrap(x)

    def split(self, z: Array) -> tuple[State, Costate, Array]:
        """State, costate and cost to go of one arc at one moment, from (x, p, w) of shape (2n+1,)."""
        return z[: self.n], z[self.n : 2 * self.n], z[2 * self.n]

    def hamiltonian(self, t: Number, x: State, p: Costate, u: Control) -> jax.Array:
        """H(t, x, p, u), a number."""
        return pointwise.hamiltonian(self.problem, t, self.wrap(x), p, u)

    def psi(self, t: Number, x: State) -> jax.Array:
        """ψ(t, x), the cost at the end."""
        final = self.final
        if callable(final):
            final = final(*self.problem.state_arguments(self.wrap(x), t))
        return jnp.asarray(0.0 if final is None else final, x.dtype)

    def level(self, t: Number, x: State) -> jax.Array:
        """l(t, x), the target's function, ≤ 0 inside."""
        target = self.problem.target
        assert target is not None
        return jnp.asarray(target(*self.problem.state_arguments(self.wrap(x), t)), x.dtype)

    def mixture(self, t: Number, x: State, p: Costate, corner: Array) -> tuple[jax.Array, jax.Array]:
        """The controls in use, shape (K, m), and their weights, shape (K,); one of weight 1 but in a mixture."""
        x = self.wrap(x)
        if self.law is Law.MINIMUM:
            return pointwise.minimiser(self.problem, self.rule, t, x, p)[None], jnp.ones(1, p.dtype)
        if self.law is Law.ARCS:
            return pointwise.at_corner(self.problem, self.rule, t, x, p, corner)[None], jnp.ones(1, p.dtype)
        values = jnp.asarray(pointwise.corners(self.problem, self.rule), p.dtype)
        at = jax.vmap(lambda value: pointwise.at_corner(self.problem, self.rule, t, x, p, value))(values)
        energies = jax.vmap(lambda u: pointwise.hamiltonian(self.problem, t, x, p, u))(at)
        # the gradient of −ε log Σ exp(−H_k/ε) is Σ w_k ∇H_k with these weights, so that weighted flows are Hamiltonian;
        # ``softmax`` takes the largest exponent out, without which e^{−H/ε} overflows as ε falls
        return at, jax.nn.softmax(-energies / self.epsilon)

    def flow(self, t: Number, z: Array, corner: Array) -> jax.Array:
        """(ẋ, ṗ, ẇ) at one moment, shape (2n+1,)."""
        x, p, w = self.split(z)
        controls, weights = self.mixture(t, x, p, corner)

        # u is held while H is differentiated in x: its own slope meets H_u = 0, or a bound that does not move
        def one(u):
            here = self.wrap(x)
            drift = jnp.asarray(self.problem.drift(*self.problem.arguments(here, u, t=t)), p.dtype)
            slope = jax.grad(self.hamiltonian, 1)(t, x, p, u)
            return jnp.concatenate([drift, -slope, -pointwise.running_cost(self.problem, t, here, u)[None]])

        # βp and βw, once and not in every part of a mixture: the weights add up to 1
        discount = jnp.asarray(self.problem.discount, p.dtype) * jnp.append(p, w)
        return (weights @ jax.vmap(one)(controls)).at[self.n :].add(discount)


def rates(bvp: BoundaryValueProblem, s: Number, y: Array, theta: Array) -> jax.Array:
    """dy/ds of all arcs together, shape (k·(2n+1),)."""
    lengths = jnp.asarray(bvp.durations(theta))
    begins = jnp.cumsum(lengths) - lengths
    stacked = y.reshape(bvp.count, -1)  # (k, 2n+1)
    # dz/ds = T_i dz/dt at the time t_i + s T_i, all arcs at one s
    return (lengths[:, None] * jax.vmap(bvp.flow)(begins + s * lengths, stacked, bvp.arcs)).reshape(-1)


def conditions(bvp: BoundaryValueProblem, first: Array, last: Array, theta: Array) -> jax.Array:
    """Residuals of the conditions at the ends of the arcs, shape (k·(2n+1) + unknowns,)."""
    # n at the start, (k − 1)(2n + 1) joints, one for each of the k − 1 switches or seams, the others at the end
    first, last = first.reshape(bvp.count, -1), last.reshape(bvp.count, -1)
    times = jnp.cumsum(bvp.durations(theta))
    joints = jnp.asarray(last[:-1] - first[1:])
    if bvp.seams:  # every arc has the coordinates of the box, and it is the unwound path that is continuous
        assert bvp.shifts is not None
        joints = joints.at[:, : bvp.n].add(bvp.shifts[:-1] - bvp.shifts[1:])
    left = [first[0, : bvp.n] - bvp.start, joints.reshape(-1)]
    if bvp.places is not None:
        left += [jnp.asarray(last[i, axis] - bvp.places[i])[None] for i, axis in enumerate(bvp.seams)]
    for i in range(bvp.count - 1 if not bvp.seams else 0):
        x, p, _ = bvp.split(last[i])
        # at a switch both values are minimisers, which fixes its time; x, p and w are the same on either side
        before, after = (_energy(bvp, times[i], x, p, bvp.arcs[i + j]) for j in (0, 1))
        left.append((before - after)[None])
    return jnp.concatenate([*left, _closing(bvp, times[-1], last[-1], theta)])


def _energy(bvp: BoundaryValueProblem, t: Number, x: State, p: Costate, corner: Array) -> jax.Array:
    """H under the law of the control, which weighs the values of a mixture."""
    controls, weights = bvp.mixture(t, x, p, corner)
    return weights @ jax.vmap(lambda u: bvp.hamiltonian(t, x, p, u))(controls)


def _closing(bvp: BoundaryValueProblem, t: Number, z: Array, theta: Array) -> jax.Array:
    """Residuals of the conditions at the final time, shape (n + 1 + free or arcs + target,)."""
    x, p, w = bvp.split(z)
    if bvp.closing is Closing.REST:
        rest = bvp.rest
        assert rest is not None
        away = x - rest.state
        bent = rest.matrix @ away
        # p = p̄ + P(x − x̄), and w by the quadratic form of which that is the slope
        left = [p - rest.costate - bent, (w - rest.value - (rest.costate + bent / 2) @ away)[None]]
        return jnp.concatenate([*left, jnp.reshape(t - bvp.horizon, 1)] if bvp.count > 1 else left)
    # ψ and its slope at the end that is given, where the iterate need not be yet
    given = [bvp.ends[i] if held else x[i] for i, held in enumerate(bvp.held)]
    # A value that is only Hölder at a given end must not be differentiated there.
    end = jax.lax.stop_gradient(bvp.ends) if all(bvp.held) else jnp.stack(given)
    psi, slope = jax.value_and_grad(bvp.psi, 1)(t, end)
    if bvp.closing is Closing.TARGET:
        level, (sliding, normal) = jax.value_and_grad(bvp.level, (0, 1))(t, x)
        left = [p - slope - theta[-1] * normal, (w - psi)[None], level[None]]
    else:
        # a state is given, or free, and then its costate is
        held = [x[i] - bvp.ends[i] if known else p[i] - slope[i] for i, known in enumerate(bvp.held)]
        left = [jnp.stack(held), (w - psi)[None]]
    if bvp.free:  # H = βψ − ψ_t − ν l_t: nothing is gained by stopping a moment later
        waiting = jax.grad(bvp.psi, 0)(t, end) if bvp.problem.time_dependent and callable(bvp.final) else 0.0
        waiting += theta[-1] * sliding if bvp.closing is Closing.TARGET else 0.0
        left.append((_energy(bvp, t, x, p, bvp.arcs[-1]) - bvp.problem.discount * psi + waiting)[None])
    elif bvp.count > 1:  # the durations are sought, and only their sum is given
        left.append(jnp.reshape(t - bvp.horizon, 1))
    return jnp.concatenate(left)
