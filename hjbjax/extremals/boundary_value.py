"""The two-point boundary-value problem of Pontryagin's principle, (8.4) to (8.7), for SciPy's ``solve_bvp``.

Along an extremal, with the current-value costate p (the DV on a grid), the cost to go w, and H minimised over u,

    ẋ = f(t, x, u*),   ṗ = βp − H_x(t, x, p, u*),   ẇ = βw − L(t, x, u*),      x(0) = x₀

    fixed horizon          p(T) = ψ_x,  w(T) = ψ
    prescribed end states  x_i(T) = c_i instead of the i-th condition on p
    target l ≤ 0           p(T) = ψ_x + ν l_x,  l(x(T)) = 0, with the unknown number ν
    infinite horizon       p(T) = p̄ + P(x(T) − x̄), with the Riccati matrix P of the rest point (x̄, p̄)
    free final time        H = βψ − ψ_t − ν l_t at the unknown time T (ν = 0 without a target)

e^{−βt}(H − βw) is constant if neither drift nor cost depends on time. It is zero for an infinite horizon. At a free end
it is −e^{−βT}(ψ_t + ν l_t), which is zero if ψ and the target do not depend on time.

If u* jumps, the problem is solved in two stages. The first stage mixes the values u_k with the weights exp(−H_k/ε)/Σ.
Up to a constant the Hamiltonian is then −ε log Σ exp(−H_k/ε), and ε decreases. The second stage has one arc per value
in the order of the first stage. All arcs are solved at once on s ∈ [0, 1] with unknown durations, and
H(u_k) = H(u_{k+1}) at the switches. Every arc is smooth, so the switching times have the order 4 of the collocation.
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

ROUGH, COARSE = 1e-3, 1000  # tolerance and number of nodes of intermediate problems


@dataclasses.dataclass(frozen=True)
class Limits:
    """The limits of a collocation: accuracy, nodes and time.

    Args:
      tol: bound on the relative residual of the equations and of the conditions.
      max_nodes: maximal number of mesh nodes.
      clock: the limit on the run time.
    """

    tol: float
    max_nodes: int
    clock: Clock

    @property
    def rough(self) -> "Limits":
        """The limits of intermediate problems."""
        return Limits(max(ROUGH, self.tol), min(COARSE, self.max_nodes), self.clock)


class Law(enum.Enum):
    """The rule that gives the control from state and costate."""

    MINIMUM = "the minimum of the Hamiltonian"
    MIXTURE = "weights over the values between which the control jumps"
    ARCS = "one of these values on every arc"


class Closing(enum.Enum):
    """The conditions at the final time."""

    COST = "a terminal cost"
    STATE = "prescribed states, and a terminal cost for the others"
    TARGET = "the boundary of a target"
    REST = "the Riccati equation of a rest point"


@pytree_dataclass()
class Rest:
    """A rest point of the Hamiltonian flow and the value near it, w̄ + p̄·y + ½ y'Py with y = x − x̄."""

    state: State
    costate: Costate
    value: Array
    matrix: Array


@pytree_dataclass(static=("rule", "law", "closing", "held", "free", "seams"))
class BoundaryValueProblem:
    """A boundary-value problem of Pontryagin's principle.

    Args:
      problem: the system and its costs.
      grid: a grid with periodic axes to wrap, or None.
      start: x₀, shape (n,).
      horizon: T, unless it is free.
      final: ψ, as a function, a number or None.
      ends: the prescribed end states, shape (n,).
      rest: the rest point of an infinite horizon.
      arcs: the value of the jumping inputs on every arc, shape (k, m); (1, m) without arcs.
      epsilon: ε of a mixture, in cost units per unit time.
      shifts: whole periods to add to the states of every arc, shape (k, n), if the arcs end at the seam of a periodic
        axis; ``None`` for zero.
      places: the coordinates of these seams, one per arc except the last, shape (k−1,).
      rule: how to minimise the Hamiltonian.
      law: the rule that gives the control.
      closing: the conditions at the end.
      held: a mask of the prescribed end states.
      free: True if the final time is unknown.
      seams: the axes of these seams, one per arc except the last; empty if the arcs end at switches.
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
        """True if the durations of the arcs are unknown."""
        return self.free or self.count > 1

    @property
    def unknowns(self) -> int:
        """The number of unknown parameters: durations, and ν."""
        return self.count * self.timed + (self.closing is Closing.TARGET)

    def durations(self, theta: Array) -> Array:
        """The lengths of the arcs, shape (k,)."""
        return theta[: self.count] if self.timed else jnp.reshape(jnp.asarray(self.horizon, theta.dtype), 1)

    def wrap(self, x: State) -> State:
        """The state with its periodic entries inside the box."""
        return x if self.grid is None else self.grid.wrap(x)

    def split(self, z: Array) -> tuple[State, Costate, Array]:
        """State, costate and cost to go from (x, p, w) of one arc at one time, shape (2n+1,)."""
        return z[: self.n], z[self.n : 2 * self.n], z[2 * self.n]

    def hamiltonian(self, t: Number, x: State, p: Costate, u: Control) -> jax.Array:
        """H(t, x, p, u), a scalar."""
        return pointwise.hamiltonian(self.problem, t, self.wrap(x), p, u)

    def psi(self, t: Number, x: State) -> jax.Array:
        """ψ(t, x), the cost at the end."""
        final = self.final
        if callable(final):
            final = final(*self.problem.state_arguments(self.wrap(x), t))
        return jnp.asarray(0.0 if final is None else final, x.dtype)

    def level(self, t: Number, x: State) -> jax.Array:
        """l(t, x), the target function, ≤ 0 inside the target."""
        target = self.problem.target
        assert target is not None
        return jnp.asarray(target(*self.problem.state_arguments(self.wrap(x), t)), x.dtype)

    def mixture(self, t: Number, x: State, p: Costate, corner: Array) -> tuple[jax.Array, jax.Array]:
        """The controls, shape (K, m), and their weights, shape (K,); only a mixture has K > 1."""
        x = self.wrap(x)
        if self.law is Law.MINIMUM:
            return pointwise.minimiser(self.problem, self.rule, t, x, p)[None], jnp.ones(1, p.dtype)
        if self.law is Law.ARCS:
            return pointwise.at_corner(self.problem, self.rule, t, x, p, corner)[None], jnp.ones(1, p.dtype)
        values = jnp.asarray(pointwise.corners(self.problem, self.rule), p.dtype)
        at = jax.vmap(lambda value: pointwise.at_corner(self.problem, self.rule, t, x, p, value))(values)
        energies = jax.vmap(lambda u: pointwise.hamiltonian(self.problem, t, x, p, u))(at)
        # these weights are the derivatives of −ε log Σ exp(−H_k/ε) by H_k, so the weighted flow is Hamiltonian;
        # ``softmax`` factors out the largest exponent, otherwise e^{−H/ε} overflows as ε falls
        return at, jax.nn.softmax(-energies / self.epsilon)

    def flow(self, t: Number, z: Array, corner: Array) -> jax.Array:
        """(ẋ, ṗ, ẇ) at one time, shape (2n+1,)."""
        x, p, w = self.split(z)
        controls, weights = self.mixture(t, x, p, corner)

        # u is constant in H_x: its own derivative contributes nothing, because H_u = 0 or u is at a fixed bound
        def one(u: Control) -> jax.Array:
            here = self.wrap(x)
            drift = jnp.asarray(self.problem.drift(*self.problem.arguments(here, u, t=t)), p.dtype)
            slope = jax.grad(self.hamiltonian, 1)(t, x, p, u)
            return jnp.concatenate([drift, -slope, -pointwise.running_cost(self.problem, t, here, u)[None]])

        # add βp and βw once, because the weights of a mixture sum to 1
        discount = jnp.asarray(self.problem.discount, p.dtype) * jnp.append(p, w)
        return (weights @ jax.vmap(one)(controls)).at[self.n :].add(discount)


def rates(bvp: BoundaryValueProblem, s: Number, y: Array, theta: Array) -> jax.Array:
    """dy/ds of all arcs, shape (k·(2n+1),)."""
    lengths = jnp.asarray(bvp.durations(theta))
    begins = jnp.cumsum(lengths) - lengths
    stacked = y.reshape(bvp.count, -1)  # (k, 2n+1)
    # dz/ds = T_i dz/dt at the time t_i + s T_i, for all arcs at the same s
    return (lengths[:, None] * jax.vmap(bvp.flow)(begins + s * lengths, stacked, bvp.arcs)).reshape(-1)


def conditions(bvp: BoundaryValueProblem, first: Array, last: Array, theta: Array) -> jax.Array:
    """Residuals of the conditions at the ends of the arcs, shape (k·(2n+1) + unknowns,)."""
    # n at the start, (k − 1)(2n + 1) at joints, one for each of the k − 1 switches or seams, the others at the end
    first, last = first.reshape(bvp.count, -1), last.reshape(bvp.count, -1)
    times = jnp.cumsum(bvp.durations(theta))
    joints = jnp.asarray(last[:-1] - first[1:])
    if bvp.seams:  # states have the coordinates of the box on every arc, and the unwound path is continuous
        assert bvp.shifts is not None
        joints = joints.at[:, : bvp.n].add(bvp.shifts[:-1] - bvp.shifts[1:])
    left = [first[0, : bvp.n] - bvp.start, joints.reshape(-1)]
    if bvp.places is not None:
        left += [jnp.asarray(last[i, axis] - bvp.places[i])[None] for i, axis in enumerate(bvp.seams)]
    for i in range(bvp.count - 1 if not bvp.seams else 0):
        x, p, _ = bvp.split(last[i])
        # at a switch both values minimise H, which determines its time; x, p and w are continuous
        before, after = (_energy(bvp, times[i], x, p, bvp.arcs[i + j]) for j in (0, 1))
        left.append((before - after)[None])
    return jnp.concatenate([*left, _closing(bvp, times[-1], last[-1], theta)])


def _energy(bvp: BoundaryValueProblem, t: Number, x: State, p: Costate, corner: Array) -> jax.Array:
    """H under the law of the control; in a mixture, the weighted sum."""
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
        # p = p̄ + P(x − x̄), and w is the quadratic form with this gradient
        left = [p - rest.costate - bent, (w - rest.value - (rest.costate + bent / 2) @ away)[None]]
        return jnp.concatenate([*left, jnp.reshape(t - bvp.horizon, 1)] if bvp.count > 1 else left)
    # evaluate ψ and its gradient at the prescribed end, which the iterate may not have reached
    given = [bvp.ends[i] if held else x[i] for i, held in enumerate(bvp.held)]
    # a value that is only Hölder continuous at a prescribed end must not be differentiated there
    end = jax.lax.stop_gradient(bvp.ends) if all(bvp.held) else jnp.stack(given)
    psi, slope = jax.value_and_grad(bvp.psi, 1)(t, end)
    if bvp.closing is Closing.TARGET:
        level, (sliding, normal) = jax.value_and_grad(bvp.level, (0, 1))(t, x)
        left = [p - slope - theta[-1] * normal, (w - psi)[None], level[None]]
    else:
        # either the end state or its costate is prescribed
        held = [x[i] - bvp.ends[i] if known else p[i] - slope[i] for i, known in enumerate(bvp.held)]
        left = [jnp.stack(held), (w - psi)[None]]
    if bvp.free:  # H = βψ − ψ_t − ν l_t: stopping a moment later does not reduce the cost
        waiting = jax.grad(bvp.psi, 0)(t, end) if bvp.problem.time_dependent and callable(bvp.final) else 0.0
        waiting += theta[-1] * sliding if bvp.closing is Closing.TARGET else 0.0
        left.append((_energy(bvp, t, x, p, bvp.arcs[-1]) - bvp.problem.discount * psi + waiting)[None])
    elif bvp.count > 1:  # the durations are unknown, but their sum is fixed
        left.append(jnp.reshape(t - bvp.horizon, 1))
    return jnp.concatenate(left)
