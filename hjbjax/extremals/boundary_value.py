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

import enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.hamiltonian import pointwise
from hjbjax.hamiltonian.pointwise import Rule
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.solution.clock import Clock, Stopped

FEWEST = 64  # columns to which meshes are padded, and twice as many from there on: few shapes, few compilations


class Law(enum.Enum):
    """Where the control comes from."""

    MINIMUM = "the minimum of the Hamiltonian"
    MIXTURE = "weights over the values between which it jumps"
    ARCS = "one of these values on every arc"


class Closing(enum.Enum):
    """What holds at the final time."""

    COST = "a terminal cost"
    STATE = "given states, and a terminal cost for the others"
    TARGET = "the edge of a target"
    REST = "the Riccati equation of a rest"


@pytree_dataclass()
class Rest:
    """A rest of the Hamiltonian flow and the value near it, w̄ + p̄·y + ½ y'Py with y = x − x̄."""

    state: Any
    costate: Any
    value: Any
    matrix: Any


@pytree_dataclass(static=("rule", "law", "closing", "held", "free", "seams"))
class BoundaryValueProblem:
    """One boundary-value problem.

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
    grid: Any
    start: Any
    horizon: Any
    final: Any
    ends: Any
    rest: Any
    arcs: Any
    epsilon: Any
    rule: Rule
    law: Law
    closing: Closing
    held: tuple[bool, ...]
    free: bool
    shifts: Any = None
    places: Any = None
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
        """Whether durations are sought."""
        return self.free or self.count > 1

    @property
    def unknowns(self) -> int:
        """How many numbers are sought beside the functions: durations, and ν."""
        return self.count * self.timed + (self.closing is Closing.TARGET)

    def durations(self, theta: Any) -> Any:
        """The lengths of the arcs, shape (k,)."""
        return theta[: self.count] if self.timed else jnp.reshape(jnp.asarray(self.horizon, theta.dtype), 1)

    def wrap(self, x: Any) -> Any:
        """The state with its periodic entries in the box."""
        return x if self.grid is None else self.grid.wrap(x)

    def split(self, z: Any) -> tuple[Any, Any, Any]:
        """State, costate and cost to go of one arc."""
        return z[: self.n], z[self.n : 2 * self.n], z[2 * self.n]

    def hamiltonian(self, t: Any, x: Any, p: Any, u: Any) -> Any:
        """H at one moment."""
        return pointwise.hamiltonian(self.problem, t, self.wrap(x), p, u)

    def psi(self, t: Any, x: Any) -> Any:
        """The cost at the end."""
        final = self.final
        if callable(final):
            final = final(*self.problem.state_arguments(self.wrap(x), t))
        return jnp.asarray(0.0 if final is None else final, x.dtype)

    def level(self, t: Any, x: Any) -> Any:
        """The target's function, ≤ 0 inside."""
        return jnp.asarray(self.problem.target(*self.problem.state_arguments(self.wrap(x), t)), x.dtype)

    def weighted(self, t: Any, x: Any, p: Any, corner: Any) -> tuple[Any, Any]:
        """The controls in use, shape (K, m), and their weights."""
        x = self.wrap(x)
        if self.law is Law.MINIMUM:
            return pointwise.minimiser(self.problem, self.rule, t, x, p)[None], jnp.ones(1, p.dtype)
        if self.law is Law.ARCS:
            return pointwise.at_corner(self.problem, self.rule, t, x, p, corner)[None], jnp.ones(1, p.dtype)
        values = jnp.asarray(pointwise.corners(self.problem, self.rule), p.dtype)
        at = jax.vmap(lambda value: pointwise.at_corner(self.problem, self.rule, t, x, p, value))(values)
        energies = jax.vmap(lambda u: pointwise.hamiltonian(self.problem, t, x, p, u))(at)
        return at, jax.nn.softmax(-energies / self.epsilon)

    def flow(self, t: Any, z: Any, corner: Any) -> Any:
        """(ẋ, ṗ, ẇ) at one moment."""
        x, p, w = self.split(z)
        controls, weights = self.weighted(t, x, p, corner)

        def one(u):
            here = self.wrap(x)
            drift = jnp.asarray(self.problem.drift(*self.problem.arguments(here, u, t=t)), p.dtype)
            slope = jax.grad(self.hamiltonian, 1)(t, x, p, u)
            return jnp.concatenate([drift, -slope, -pointwise.running_cost(self.problem, t, here, u)[None]])

        discount = jnp.asarray(self.problem.discount, p.dtype) * jnp.append(p, w)
        return (weights @ jax.vmap(one)(controls)).at[self.n :].add(discount)


def rates(bvp: BoundaryValueProblem, s: Any, y: Any, theta: Any) -> Any:
    """dy/ds of all arcs together, shape (k·(2n+1),)."""
    lengths = bvp.durations(theta)
    begins = jnp.cumsum(lengths) - lengths
    stacked = y.reshape(bvp.count, -1)
    return (lengths[:, None] * jax.vmap(bvp.flow)(begins + s * lengths, stacked, bvp.arcs)).reshape(-1)


def conditions(bvp: BoundaryValueProblem, first: Any, last: Any, theta: Any) -> Any:
    """What has to vanish at the ends of the arcs, shape (k·(2n+1) + unknowns,)."""
    first, last = first.reshape(bvp.count, -1), last.reshape(bvp.count, -1)
    times = jnp.cumsum(bvp.durations(theta))
    joints = last[:-1] - first[1:]
    if bvp.seams:
        joints = joints.at[:, : bvp.n].add(bvp.shifts[:-1] - bvp.shifts[1:])
    left = [first[0, : bvp.n] - bvp.start, joints.reshape(-1)]
    left += [(last[i, axis] - bvp.places[i])[None] for i, axis in enumerate(bvp.seams)]
    for i in range(bvp.count - 1 if not bvp.seams else 0):
        x, p, _ = bvp.split(last[i])
        before, after = (_energy(bvp, times[i], x, p, bvp.arcs[i + j]) for j in (0, 1))
        left.append((before - after)[None])
    return jnp.concatenate([*left, _closing(bvp, times[-1], last[-1], theta)])


def _energy(bvp: BoundaryValueProblem, t: Any, x: Any, p: Any, corner: Any) -> Any:
    controls, weights = bvp.weighted(t, x, p, corner)
    return weights @ jax.vmap(lambda u: bvp.hamiltonian(t, x, p, u))(controls)


def _closing(bvp: BoundaryValueProblem, t: Any, z: Any, theta: Any) -> Any:
    """The conditions at the final time, shape (n + 1 + free or arcs + target,)."""
    x, p, w = bvp.split(z)
    if bvp.closing is Closing.REST:
        away, rest = x - bvp.rest.state, bvp.rest
        bent = rest.matrix @ away
        left = [p - rest.costate - bent, (w - rest.value - (rest.costate + bent / 2) @ away)[None]]
        return jnp.concatenate([*left, (t - bvp.horizon)[None]] if bvp.count > 1 else left)
    given = [bvp.ends[i] if held else x[i] for i, held in enumerate(bvp.held)]
    # A value that is only Hölder at a given end must not be differentiated there.
    end = jax.lax.stop_gradient(bvp.ends) if all(bvp.held) else jnp.stack(given)
    psi, slope = jax.value_and_grad(bvp.psi, 1)(t, end)
    if bvp.closing is Closing.TARGET:
        level, (sliding, normal) = jax.value_and_grad(bvp.level, (0, 1))(t, x)
        left = [p - slope - theta[-1] * normal, (w - psi)[None], level[None]]
    else:
        held = [x[i] - bvp.ends[i] if known else p[i] - slope[i] for i, known in enumerate(bvp.held)]
        left = [jnp.stack(held), (w - psi)[None]]
    if bvp.free:
        waiting = jax.grad(bvp.psi, 0)(t, end) if bvp.problem.time_dependent and callable(bvp.final) else 0.0
        waiting += theta[-1] * sliding if bvp.closing is Closing.TARGET else 0.0
        left.append((_energy(bvp, t, x, p, bvp.arcs[-1]) - bvp.problem.discount * psi + waiting)[None])
    elif bvp.count > 1:
        left.append((t - bvp.horizon)[None])
    return jnp.concatenate(left)


_rates = jax.jit(jax.vmap(rates, (None, 0, 1, None), 1))
_slopes = jax.jit(jax.vmap(jax.jacfwd(rates, (2, 3)), (None, 0, 1, None), 2))
_conditions = jax.jit(conditions)
_condition_slopes = jax.jit(jax.jacfwd(conditions, (1, 2, 3)))


def _padded(s: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with its last column repeated."""
    width = FEWEST
    while width < len(s):
        width *= 2
    more = width - len(s)
    return np.append(s, np.full(more, s[-1])), np.concatenate([y, np.repeat(y[:, -1:], more, 1)], 1)


def collocate(
    bvp: BoundaryValueProblem, s: Any, y: Any, theta: Any, *, tol: float, max_nodes: int, clock: Clock
) -> Any:
    """SciPy's answer from a first guess; float64 has to be on.

    Every call of the right-hand side looks at the clock; ``Stopped`` brings the last iterate along, (s, y, theta).

    Args:
      ask: the boundary-value problem.
      s: the first mesh on [0, 1].
      y: the first guess on it, shape (k·(2n+1), len(s)).
      theta: the first guess of what else is sought.
      tol: on the relative residual of the equations and on the conditions.
      max_nodes: of the mesh.
      clock: whether to go on.
    """
    from scipy.integrate import solve_bvp

    arrays = jax.tree.map(jnp.asarray, bvp)
    nothing = np.zeros(0)
    last = (np.asarray(s), np.asarray(y), np.asarray(theta))

    def function(s, y, theta=nothing):
        nonlocal last
        if s[0] == 0 and s[-1] == 1:  # else between the nodes of the mesh
            last = (np.array(s), np.array(y), np.array(theta))
        clock.look()
        return np.asarray(_rates(arrays, *_padded(s, y), theta))[:, : len(s)]

    def function_slopes(s, y, theta=nothing):
        clock.look()
        by_state, by_theta = (np.array(part)[..., : len(s)] for part in _slopes(arrays, *_padded(s, y), theta))
        return (by_state, by_theta) if len(theta) else by_state

    def ends(first, last, theta=nothing):
        return np.asarray(_conditions(arrays, first, last, theta))

    def end_slopes(first, last, theta=nothing):
        parts = tuple(np.array(part) for part in _condition_slopes(arrays, first, last, theta))
        return parts if len(theta) else parts[:2]

    try:
        with np.errstate(all="ignore"):  # what is not finite is looked for in the answer
            return solve_bvp(
                function, ends, s, y, p=theta if len(theta) else None, fun_jac=function_slopes, bc_jac=end_slopes,
                tol=tol, max_nodes=max_nodes,
            )  # fmt: skip
    except Stopped as stop:
        raise Stopped(stop.status, last) from None
