"""The Markov chain as other people's solvers take it: generator, transition matrix, long-run density, decision problem.

Everything here works on the host, in float64, with the nodes in C order; ``rates`` in ``discretisation`` has the
equations of the jump rates. With Q = Σ c the rate at which the chain leaves a node, the generator 𝓛 has c beside and
−Q on its diagonal, and the transition matrix with one time step Δt for all nodes is I + Δt 𝓛.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import correlated_noise, edges, stencil
from hjbjax.discretisation.cut_cells import links
from hjbjax.discretisation.discretisation import Chain, Discretisation
from hjbjax.discretisation.rates import Rates, jump_rates
from hjbjax.discretisation.schemes import Upwind
from hjbjax.markov_chain import decision_process, stationary_law
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast
from hjbjax.problem.settings import own_settings
from hjbjax.tracing.closures import with_settled_functions


@with_settled_functions
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


@with_settled_functions
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


@with_settled_functions
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
    with own_settings(x64=True):
        on = Discretisation(*cast((problem, grid), np.float64), scheme, np.dtype(np.float64), t)
        noise = on.diffusion(*cast((u, d), np.float64))
        density = probabilities.reshape(grid.shape) / grid.volumes()
        for axis in range(grid.ndim):
            still = np.asarray(stencil.walls(grid, axis) & ~(jnp.asarray(noise.get((axis, axis), 0.0)) > 0))
            density = np.where(still, density / 2, density)
    return density / np.sum(density * grid.volumes())


@with_settled_functions
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
    grid.check_indices()
    actions = decision_process.actions(problem)
    held, given = decision_process.target(problem, grid)
    found = (
        _checked(Discretisation(problem, grid, scheme, np.float64), list(action), None, ~held, np.finfo(np.float64).eps)
        for action in actions
    )
    with own_settings(x64=True):
        cut = links(Discretisation(*cast((problem, grid), np.float64), scheme, np.dtype(np.float64)))
        surcharge = decision_process.surcharge(cut, given, grid)
    tables = (
        (jumps.offsets, jumps.values, cost + decision_process.paid(jumps, surcharge), ~leaving)
        for jumps, cost, leaving in found
    )
    return decision_process.decision_problem(tables, grid, len(actions), held, given, float(problem.discount))


def _under_policy(problem: Problem, grid: Grid, policy: Any, disturbance: Any, scheme: Chain, t: float) -> Rates:
    """The rates under a policy; zero on the target and where there is no action."""
    grid.check_indices()
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
    grid.refuse_prescribed("chain", "whose payments a table of rates and running costs does not hold")
    if grid.sides("open"):
        raise ValueError(
            "chain: a grid with open ends has no chain: a value that is continued from inside makes negative "
            "probabilities; choose edges='projected' or 'constrained'"
        )
    with own_settings(x64=True):
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
    jumps, shape = jump_rates(on, u, d), on.grid.shape
    cost, short = jnp.broadcast_to(on.running_cost(u, d), shape), correlated_noise.lacking(on, on.diffusion(u, d))
    leaving = edges.inadmissible(on, u, d, eps=eps)
    return jumps, cost, jnp.broadcast_to(jnp.zeros((), bool) if short is None else short, shape), leaving
