"""The Kushner–Dupuis Markov chain of a controlled diffusion.

On axis i with spacing h (h⁺ up, h⁻ down), drift f_i and diffusion a = σσᵀ the chain leaves a node at the rates

    c_i^+ = (e_i + h⁻ f_i) / (h⁺ (h⁺ + h⁻)),     c_i^- = (e_i − h⁺ f_i) / (h⁻ (h⁺ + h⁻))

with e_i = a_ii + h⁺ f_i⁺ + h⁻ f_i⁻ for the plain upwind chain, so that on a uniform grid
c_i^± = f_i^±/h + a_ii/(2h²), and with e_i = max(a_ii, h⁺ f_i, −h⁻ f_i) where central differences are allowed as
far as they stay monotone. Correlated noise moves along diagonals: a pair i, j gives
c^{±(e_i + e_j)} = a_ij⁺/(2 h_i h_j), c^{±(e_i − e_j)} = a_ij⁻/(2 h_i h_j), and takes |a_ij| h_i/h_j from a_ii.

Q = Σ c, Δt = 1/max_u Q, the transition probabilities are c Δt, and the self-transition is 1 − Q Δt (the chapter
prints (13.3) without the "1 −"). At a wall drift that points out of the box is cut off and noise reflects on the node:
inwards at (e(n⁺) − h n)/h², n the drift outwards, see ``schemes``; a diagonal jump across goes to its mirror image.
Source: H. J. Kushner and P. Dupuis, Numerical Methods for Stochastic Control Problems in Continuous Time.
"""

import dataclasses
import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import correlated_noise, schemes, stencil
from hjbjax.discretisation.cut_cells import links
from hjbjax.discretisation.discretisation import Chain, Discretisation
from hjbjax.discretisation.schemes import Upwind
from hjbjax.markov_chain import decision_process, edges, stationary_law
from hjbjax.problem import sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast, pytree_dataclass

Offset = tuple[int, ...]


@pytree_dataclass(static=("offsets", "one_way"))
class Rates:
    """The generator of the chain under one policy, matrix-free: (𝓛V)(x) = Σ_o c_o(x) (V(x + o) − V(x)).

    Args:
      offsets: the jumps o, each a tuple of −1, 0, 1, one entry an axis.
      values: for each offset the rates c_o ≥ 0 per unit time, shape (*grid); none leads out of the box.
      one_way: whether of two opposite jumps at most one has a positive rate, as without noise.
    """

    offsets: tuple[Offset, ...]
    values: tuple[Any, ...]
    one_way: bool = False

    def total(self) -> Any:
        """Q = Σ_o c_o, the rate at which the chain leaves each node, shape (*grid)."""
        return sum(self.values[1:], start=self.values[0])  # no 0 to start from, which would be one more array

    def apply(self, grid: Grid, values: jax.Array) -> jax.Array:
        """𝓛V for node values V, shape (*grid); cost per unit time."""
        jumps = zip(self.offsets, self.values, strict=True)
        # differences first: c V(x + o) and c V(x) are both large where h is small, and their difference is not
        terms = [c * (stencil.continued(values, grid, offset) - values) for offset, c in jumps]
        return sum(terms[1:], start=terms[0])

    def scaled(self, factor: Any) -> "Rates":
        """Every rate times ``factor``, shape (*grid) or a number."""
        return dataclasses.replace(self, values=tuple(factor * c for c in self.values))

    def inflow(self, grid: Grid) -> "Rates":
        """The off-diagonal part of the transposed generator: what flows into x from x + o, as rates."""
        opposite = [tuple(-step for step in offset) for offset in self.offsets]
        arriving = [
            stencil.neighbour(c, grid, offset, ghost=False) for offset, c in zip(opposite, self.values, strict=True)
        ]
        return Rates(tuple(opposite), tuple(arriving))


def rates(on: Discretisation, u: list, d: list | None = None) -> Rates:
    """The jump rates under a policy of the monotone chain that goes with the scheme.

    Args:
      on: the chain; of its problem only drift and noise matter.
      u: the m components of the control, each of a shape that broadcasts to (*grid).
      d: likewise of the disturbance, in a game.
    """
    grid = on.grid
    x, u, d = jax.lax.optimization_barrier((on.coordinates(), u, d))  # or loops keep drift that u does not move
    first, *others = on.drifts(u, d, x)
    table = _table(on, first, on.diffusion(u, d, x))
    for other in others:  # jumps of one chain or of the other
        for offset, rate in _table(on, other, {}).items():
            table[offset] = table[offset] + rate
    values = tuple(jnp.broadcast_to(jnp.asarray(rate, on.dtype), grid.shape) for rate in table.values())
    return Rates(tuple(table), values, one_way=on.problem.noise is None and on.scheme.chain.one_way and not others)


def _table(on: Discretisation, f: list, a: dict[tuple[int, int], Any]) -> dict[Offset, Any]:
    """The rate of every jump for a drift f and a diffusion a."""
    grid = on.grid
    table: dict[Offset, Any] = {}
    for axis, link in enumerate(links(on.chain)):
        left = correlated_noise.along_axis(a, grid, axis)
        upward, downward = schemes.weights(on.scheme.chain, f[axis], left, link, grid, axis)
        for step, weight, length in ((1, upward, link.up), (-1, downward, link.down)):
            beyond = stencil.wall(grid, axis, step)
            table[stencil.unit(grid, axis, step)] = jnp.where(beyond, 0, weight / length)
    for (i, j), entry in a.items():
        if i != j:
            _add_diagonal_jumps(table, entry, grid, i, j)
    return table


def fastest_rate(on: Discretisation) -> jax.Array:
    """max over the actions of Q at every node, (*grid): with Δt = 1/(Q + β) value iteration is monotone.

    Q is convex in u for a drift affine in u, so that corners of the sets suffice; samples are added for others.
    """
    result = jnp.zeros(on.grid.shape, on.dtype)
    us, ds = (list(sets.probes(each, on.dtype)) for each in (on.problem.controls, on.problem.disturbances))
    if on.apart:  # Q is a sum of what each player adds: pairs of probes would take twice the time to compile
        mine = (_table(on, on.drifts(u, ds[0])[0], on.diffusion(u, ds[0])) for u in us)
        theirs = (_table(on, on.drifts(us[0], d)[1], {}) for d in ds)
        tables = ([sum(table.values()) for table in each] for each in (mine, theirs))
        return result + sum(functools.reduce(jnp.maximum, totals) for totals in tables)
    for u, d in itertools.product(us, ds):
        result = jnp.maximum(result, rates(on, u, d).total())
    return result


def _add_diagonal_jumps(table: dict[Offset, Any], entry: Any, grid: Grid, i: int, j: int) -> None:
    """A diagonal jump that would leave the box goes to the mirror image of its end: noise reflects."""
    scale = 2 * grid.spacing(i) * grid.spacing(j)
    pairs = list(itertools.product((1, -1), repeat=2))
    # a_ij⁺ along the diagonal, a_ij⁻ across it
    rate = {(p, q): jnp.maximum(entry * (p * q), 0) / scale for p, q in pairs}
    for p, q in pairs:  # first across the walls of axis i, then, at a corner once more, across those of axis j
        off = stencil.wall(grid, i, p)
        rate[-p, q], rate[p, q] = rate[-p, q] + jnp.where(off, rate[p, q], 0), jnp.where(off, 0, rate[p, q])
    for p, q in pairs:
        off = stencil.wall(grid, j, q)
        rate[p, -q], rate[p, q] = rate[p, -q] + jnp.where(off, rate[p, q], 0), jnp.where(off, 0, rate[p, q])
    for p, q in pairs:
        table[tuple(p * (k == i) + q * (k == j) for k in range(grid.ndim))] = rate[p, q]


# --- exports, for other people's solvers: host level, float64, nodes in C order ---


def generator(
    problem: Problem,
    grid: Grid,
    policy: Any = None,
    *,
    disturbance: Any = None,
    scheme: Chain = Upwind(),
    t: float = 0.0,
) -> Any:
    """The generator of the chain under one policy as a sparse matrix; its rows sum to zero.

    (𝓛V)(x) = Σ_o c_o(x) (V(x + o) − V(x)) is ``generator(...) @ V.ravel()``; the transpose moves densities,
    dμ/dt = 𝓛*μ. The chain stays where it is on the target, and where the policy is NaN, which is how a
    ``Solution`` marks nodes without an action.

    Args:
      problem: the problem; its drift, its noise and its target matter.
      grid: the grid, S nodes.
      policy: the control at every node, shape (*grid, m); ``None`` without controls.
      disturbance: the disturbance at every node, shape (*grid, l), in a game.
      scheme: how the rates are made.
      t: the time, if the problem depends on it.

    Returns:
      A SciPy CSR array of shape (S, S), per unit time.

    Raises:
      ValueError: a policy of the wrong shape, rates that are not finite, or noise that the chain cannot represent.
    """
    jumps = _under_policy(problem, grid, policy, disturbance, scheme, t)
    return stencil.sparse(jumps.offsets, jumps.values, -jumps.total(), grid)


def matrix(
    problem: Problem,
    grid: Grid,
    policy: Any = None,
    *,
    disturbance: Any = None,
    scheme: Chain = Upwind(),
    t: float = 0.0,
) -> Any:
    """The transition matrix of the chain under one policy.

    P = I + Δt 𝓛 with one time step for all nodes, Δt = 1/max Q over the nodes under this policy (1 where
    nothing moves), which is ``1 / -generator(...).diagonal().min()``. Arguments and errors are those of
    ``generator``.

    Returns:
      A SciPy CSR array of shape (S, S); no entry is negative, every row sums to one.

    Example:
      >>> import numpy as np
      >>> from hjbjax.problem.sets import Box
      >>> problem = Problem(lambda x, u: u, None, Box([-1.0], [1.0]), discount=1.0)
      >>> matrix(problem, Grid([0.0], [3.0], (4,)), np.array([[1.0], [0.5], [1.0], [1.0]])).toarray().tolist()
      [[0.0, 1.0, 0.0, 0.0], [0.0, 0.5, 0.5, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
    """
    jumps = _under_policy(problem, grid, policy, disturbance, scheme, t)
    steps = jumps.scaled(decision_process.time_step(jumps.total()))
    return stencil.sparse(steps.offsets, steps.values, np.maximum(1 - steps.total(), 0), grid)


def stationary_density(
    problem: Problem,
    grid: Grid,
    policy: Any = None,
    *,
    disturbance: Any = None,
    scheme: Chain = Upwind(),
    t: float = 0.0,
) -> np.ndarray:
    """The density in which the chain under one policy is found after a long time: 𝓛*p = 0, integral one.

    The chain's law over the nodes, divided by the cells that its rates belong to: half cells at a wall on which noise
    reflects, whole ones at an end of an axis without noise, which drift enters and leaves at |f|/h as inside. Then
    scaled to the integral one over the box, ``np.sum(density * grid.volumes())``. Second order, up to the walls, where
    central differences are monotone, first elsewhere; by a sparse LU factorisation, see ``stationary_law``. Arguments
    are those of ``generator``.

    Returns:
      The density at the nodes, shape (*grid), in 1/(units of the states); zero where the chain never comes back.

    Raises:
      ValueError: a target, where paths end; several recurrent classes, or one that hangs together by no more than
        rounding: then where the chain is found depends on where it started; and what ``generator`` refuses.

    Example:
      >>> import numpy as np
      >>> grid = Grid([-4.0], [4.0], (161,))
      >>> density = stationary_density(Problem(lambda x, u: -x, noise=1.0), grid)
      >>> float(round(density[80], 3)), float(round(np.sum(density * grid.volumes()), 12))  # 1/√π
      (0.564, 1.0)
    """
    if problem.target is not None:  # the law would be a point at the target, which is no density
        raise ValueError(
            "stationary_density: got a problem with a target, where paths end, so that nothing goes on for ever; leave "
            "it out, or ask for hjb.reach_probability or hjb.expected_exit_time"
        )
    jumps = _under_policy(problem, grid, policy, disturbance, scheme, t)
    moves = stencil.sparse(jumps.offsets, jumps.values, -jumps.total(), grid)
    probabilities = decision_process.single_law(stationary_law.classes(moves), moves, grid)
    u, d, _ = decision_process.policies(problem, grid, policy, disturbance)
    with jax.enable_x64(True):
        on = Discretisation(*cast((problem, grid), np.float64), scheme, np.dtype(np.float64), t)
        noise = on.diffusion(*cast((u, d), np.float64))
        density = probabilities.reshape(grid.shape) / grid.volumes()
        for axis in range(grid.ndim):
            still = np.asarray(stencil.walls(grid, axis) & ~(jnp.asarray(noise.get((axis, axis), 0.0)) > 0))
            density = np.where(still, density / 2, density)
    return density / np.sum(density * grid.volumes())


def transition_arrays(
    problem: Problem, grid: Grid, *, scheme: Chain = Upwind()
) -> tuple[np.ndarray, Any, np.ndarray, np.ndarray, float]:
    """The controlled chain as a discounted Markov decision problem over pairs of state and action.

    On one Δt = 1/max Q, over states and actions, the equation (β − 𝓛^u)V = L^u minimised over u is

        V = min_u [ L^u Δt + P^u V ] / (1 + βΔt),

    so that with cost L Δt/(1 + βΔt) and factor 1/(1 + βΔt) the decision problem has our value V_h exactly. A
    target keeps its state, at a cost of (1 − factor) times its exit cost; where ``scheme.subcell`` ends a jump on the
    boundary, the difference of the exit costs there and at the node is part of L. QuantEcon maximises: its
    ``DiscreteDP(-costs, probabilities, factor, state_index, action_index)`` has the value −V_h. Works in about
    20 (2n + 2) bytes a pair.

    Args:
      problem: discounted, without opponent or constraints, with K ``Finite`` controls, or None (K = 1).
      grid: the grid, S nodes.
      scheme: how the rates are made.

    Returns:
      ``(costs (S*K,), probabilities CSR (S*K, S), state_index (S*K,), action_index (S*K,), discount_factor)``,
      sorted by state, then by action; pairs that lead out of the box across a constrained end are left out.

    Raises:
      ValueError: a problem that is no such decision problem, rates or costs that are not finite, or noise that
        the chain cannot represent.
    """
    actions = decision_process.actions(problem)
    held, given = decision_process.target(problem, grid)
    found = (
        _checked(Discretisation(problem, grid, scheme, np.float64), list(action), None, ~held, np.finfo(np.float64).eps)
        for action in actions
    )
    with jax.enable_x64(True):
        cut = links(Discretisation(*cast((problem, grid), np.float64), scheme, np.dtype(np.float64)))
        surcharge = decision_process.surcharge(cut, given, grid)
    tables = (
        (jumps.offsets, jumps.values, cost + decision_process.paid(jumps, surcharge), ~leaving)
        for jumps, cost, leaving in found
    )
    return decision_process.decision_problem(tables, grid, len(actions), held, given, float(problem.discount))


def _under_policy(problem: Problem, grid: Grid, policy: Any, disturbance: Any, scheme: Chain, t: float) -> Rates:
    """The rates under a policy; zero on the target and where there is no action."""
    u, d, active = decision_process.policies(problem, grid, policy, disturbance)
    active &= ~decision_process.target(problem, grid, t)[0]
    # what is rounding is told by the type in which the policy was found: one of float32 is off by 1e-7 at an end
    kinds = [np.asarray(array).dtype for array in (policy, disturbance) if array is not None]
    eps = max([np.finfo(kind).eps for kind in kinds if kind.kind == "f"], default=np.finfo(np.float64).eps)
    jumps, _, leaving = _checked(Discretisation(problem, grid, scheme, np.float64, t), u, d, active, eps)
    decision_process.refuse("the policy leaves the box across a constrained end", leaving, grid)
    return jumps


def _checked(
    on: Discretisation, u: list, d: list | None, active: np.ndarray, eps: Any
) -> tuple[Rates, np.ndarray, np.ndarray]:
    """Rates and running cost at the ``active`` nodes, zero elsewhere, and where an end forbids the actions there.

    Refuses what is not usable.
    """
    grid = on.grid
    if grid.sides("open"):
        raise ValueError(
            "chain: a grid with open ends has no chain: a value that is continued from inside makes negative "
            "probabilities; choose edges='projected' or 'constrained'"
        )
    with jax.enable_x64(True):
        jumps, cost, lacking, leaving = jax.device_get(_evaluate(*cast((on, u, d), np.float64), eps))
    decision_process.refuse("the running cost is not finite", active & ~np.isfinite(cost), grid)
    decision_process.refuse(
        "a jump rate, made of drift and noise, is not finite", active & ~np.isfinite(jumps.total()), grid
    )
    decision_process.refuse("the noise is correlated more than the spacings allow", active & lacking, grid)
    kept = Rates(jumps.offsets, tuple(np.where(active, c, 0) for c in jumps.values))
    return kept, np.where(active, cost, 0), active & leaving


@jax.jit
def _evaluate(on: Discretisation, u: list, d: list | None, eps: Any) -> Any:
    """Rates and running cost at the nodes, where the noise leaves a negative rate, and where an end is crossed."""
    jumps, shape = rates(on, u, d), on.grid.shape
    cost, short = jnp.broadcast_to(on.running_cost(u, d), shape), correlated_noise.lacking(on, on.diffusion(u, d))
    leaving = edges.inadmissible(on, u, d, eps=eps)
    return jumps, cost, jnp.broadcast_to(jnp.zeros((), bool) if short is None else short, shape), leaving
