"""The Markov chain: generator, transition matrix, stationary and transient laws, and exports as a decision problem.

Everything here runs on the host in float64, with the nodes in C order. ``stationary_law`` and ``evolve`` also run
inside ``jit`` and ``vmap``, and can be differentiated. ``rates`` in ``discretisation`` has the equations of the jump
rates c. Let Q = Σ c be the rate at which the chain leaves a node. The generator 𝓛 has the rates c
off the diagonal and −Q on it. The transition matrix with one time step Δt for all nodes is I + Δt 𝓛.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Chain, Discretisation
from hjbjax.discretisation.posing import in_time_of_discount, with_mode_axis
from hjbjax.discretisation.rates import Rates
from hjbjax.discretisation.schemes import Upwind
from hjbjax.markov_chain import decision_process, laws, policy_rates
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_one_program, cast, is_traced
from hjbjax.problem.settings import own_settings
from hjbjax.tracing import checks
from hjbjax.tracing.closures import with_settled_functions

__all__ = ["evolve", "generator", "matrix", "stationary_density", "stationary_law", "transition_arrays"]


@with_mode_axis()
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
    """The generator of the chain under a policy as a sparse matrix; its rows sum to zero.

    (𝓛V)(x) = Σ_o c_o(x) (V(x + o) − V(x)) is ``generator(...) @ V.ravel()``; the transpose evolves densities,
    dμ/dt = 𝓛*μ. The chain stays where it is on the target, and at nodes without an action, where the policy of a
    ``Solution`` is NaN.

    Args:
      problem: the problem; only drift, noise and target are used.
      grid: the grid, S nodes.
      policy: the control at every node, shape (*grid, m); ``None`` without controls.
      disturbance: the disturbance at every node, shape (*grid, l), in a game.
      scheme: the chain that defines the rates.
      t: the time, if the problem depends on it.

    Returns:
      A SciPy CSR array of shape (S, S), per unit time.

    Raises:
      ValueError: the policy has the wrong shape, rates are not finite, the chain cannot represent the noise, or the
        modes have a switching cost.
    """
    jumps = policy_rates.rates_under(problem, grid, policy, disturbance, scheme, t)
    return laws.sparse_generator(jumps, grid)


@with_mode_axis()
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
    """The transition matrix of the chain under a policy.

    P = I + Δt 𝓛 with one time step for all nodes, Δt = 1/max Q over the nodes under this policy, which is
    ``1 / -generator(...).diagonal().min()`` (1 if nothing moves). Arguments and errors as for ``generator``.

    Returns:
      A SciPy CSR array of shape (S, S); all entries are non-negative, every row sums to one.

    Example:
      >>> import numpy as np
      >>> from hjbjax.problem.sets import Box
      >>> problem = Problem(lambda x, u: u, None, Box([-1.0], [1.0]), discount=1.0)
      >>> matrix(problem, Grid([0.0], [3.0], (4,)), np.array([[1.0], [0.5], [1.0], [1.0]])).toarray().tolist()
      [[0.0, 1.0, 0.0, 0.0], [0.0, 0.5, 0.5, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
    """
    jumps = policy_rates.rates_under(problem, grid, policy, disturbance, scheme, t)
    steps = jumps.scaled(decision_process.time_step(jumps.total()))
    return stencil.sparse(steps.offsets, steps.values, np.maximum(1 - steps.total(), 0), grid, steps.landings)


@with_mode_axis()
@with_settled_functions
def stationary_law(
    problem: Problem,
    grid: Grid,
    policy: Any = None,
    *,
    disturbance: Any = None,
    scheme: Chain = Upwind(),
    t: float = 0.0,
) -> Any:
    """The stationary law of the chain under a policy: 𝓛*μ = 0 with Σ μ = 1, one probability per node.

    Means under the law are sums: ``np.sum(law * values)``. A mass at one point, such as the households at a borrowing
    limit, is the probability of its node. ``stationary_density`` divides the law by the cells.

    Computed by a sparse LU factorisation. Inside ``jit``, ``vmap`` and ``grad`` the law is traced, and has a first
    derivative with respect to every number in the problem, the grid and the policy, at the cost of one more
    factorisation. It is NaN there if one of the errors below would be raised.

    Args:
      problem: the problem without a target; only drift and noise are used.
      grid: the grid.
      policy: the control at every node, shape (*grid, m); ``None`` without controls.
      disturbance: the disturbance at every node, shape (*grid, l), in a game.
      scheme: the chain that defines the rates.
      t: the time, if the problem depends on it.

    Returns:
      The probabilities, shape (*grid), zero at transient nodes; in NumPy at host level. In a problem with k modes the
      shape is (k, *grid), as for the value.

    Raises:
      ValueError: the problem has a target, where paths end; there are several recurrent classes, or one that is
        connected only by rates of the size of rounding, so that the distribution depends on the start; or ``generator``
        raises.

    Example:
      >>> import hjbjax as hjb
      >>> spend = hjb.Problem(lambda x, u: -x, noise=lambda x, u: 0.1 * x)  # nothing leaves the end at zero
      >>> law = stationary_law(spend, Grid([0.0], [1.0], (11,)))
      >>> float(law[0])
      1.0
    """
    return _stationary("stationary_law", problem, grid, policy, disturbance, scheme, t)


@with_mode_axis()
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
    """The stationary density of the chain under a policy: ``stationary_law`` per volume, with integral one.

    It is the probability of each node divided by the volume of its cell, and scaled so that
    ``np.sum(density * grid.volumes())`` is one. The cell of a node on a wall that reflects noise is half
    as wide. At an end of an axis without noise it is a whole cell, where drift enters and leaves at the rate |f|/h, as
    inside the box. The density is second order, also at walls, where central differences are monotone, and first order
    elsewhere. Host level. Arguments and errors as for ``stationary_law``.

    Returns:
      The density at the nodes, shape (*grid), in 1/(units of the states); zero at transient nodes.

    Example:
      >>> import numpy as np
      >>> grid = Grid([-4.0], [4.0], (161,))
      >>> density = stationary_density(Problem(lambda x, u: -x, noise=1.0), grid)
      >>> float(round(density[80], 3)), float(round(np.sum(density * grid.volumes()), 12))  # 1/√π
      (0.564, 1.0)
    """
    law = _stationary("stationary_density", problem, grid, policy, disturbance, scheme, t)
    u, d, _ = decision_process.policy_components(problem, grid, policy, disturbance)
    with own_settings(x64=True):
        on = Discretisation(*cast((problem, grid), np.float64), scheme, np.dtype(np.float64), t)
        noise = on.diffusion(*cast((u, d), np.float64))
        density = law / grid.volumes()
        for axis in range(grid.ndim):
            still = np.asarray(stencil.walls(grid, axis) & ~(jnp.asarray(noise.get((axis, axis), 0.0)) > 0))
            density = np.where(still, density / 2, density)
    return density / np.sum(density * grid.volumes())


@with_mode_axis()
@with_settled_functions
def evolve(
    problem: Problem,
    grid: Grid,
    policy: Any,
    law: Any,
    horizon: float,
    *,
    times: Any = None,
    policy_times: Any = None,
    disturbance: Any = None,
    scheme: Chain = Upwind(),
) -> Any:
    """The law of the chain forward in time under a policy: dμ/dt = 𝓛*μ from ``law`` at t = 0.

    Non-negative, with the same sum. Without ``policy_times`` the result is exp(t𝓛*) μ to rounding, by uniformisation,
    for any horizon; the cost is about ``horizon`` · max Q products with the transition matrix. A policy that
    depends on time, as from ``march``, is given at ``policy_times``. The rates are interpolated linearly between them,
    and constant during a step between two times, so the error is second order in the distance of the times. Nodes on
    the target, and nodes without an action, keep their mass.

    Args:
      problem: the problem; only drift, noise and target are used.
      grid: the grid.
      policy: the control at every node, shape (*grid, m), or (k, *grid, m) at k ``policy_times``; ``None`` without
        controls.
      law: μ at t = 0, one non-negative number per node, shape (*grid); a density times the cells.
      horizon: T > 0, in units of time.
      times: the times of the result, increasing, in [0, horizon]; ``None`` is (horizon,).
      policy_times: k increasing times that cover [0, horizon], such as ``solution.times`` of a march. Required if the
        problem depends on time.
      disturbance: the disturbance in a game, in the form of ``policy``.
      scheme: the chain that defines the rates.

    Returns:
      The laws, shape (number of times, *grid); in NumPy at host level. Inside ``jit`` and ``vmap`` they are traced.
      They have forward derivatives (``jax.jvp`` and ``jax.jacfwd``). ``horizon`` and all times must be known numbers.
      The result is NaN there if ``generator`` would raise.

    Raises:
      ValueError: an argument is invalid, or ``generator`` raises.

    Example:
      >>> import numpy as np
      >>> grid = Grid([-4.0], [4.0], (81,))  # noise 1 from the middle: the variance is the time
      >>> wander = evolve(Problem(lambda x, u: 0 * x, noise=1.0), grid, None, np.eye(81)[40], 1.0, times=[0.5, 1.0])
      >>> (wander @ np.asarray(grid.axis(0)) ** 2).round(2).tolist()
      [0.5, 1.0]
    """
    plan = laws.plan_steps(horizon, times, policy_times)
    if problem.time_dependent and policy_times is None:
        raise ValueError(
            "evolve: got a time-dependent problem without policy_times, wanted the times at which its rates are "
            "evaluated;\npass policy_times=solution.times with the policy of a march, or np.linspace(0, horizon, k)"
        )
    if is_traced(problem, grid, policy, disturbance, law):
        return _evolve_traced(problem, grid, scheme, (policy, disturbance), law, plan)
    law = laws.check_law(law, grid)
    actions = _with_times((policy, disturbance), plan)

    @functools.lru_cache(2)  # each time but the first and the last belongs to two steps
    def rates_at(k: int) -> Rates:
        u, d = (_at(each, k) for each in actions)
        return policy_rates.rates_under(problem, grid, u, d, scheme, plan.moments[k])

    found = np.empty((plan.count, *law.shape))
    with own_settings(x64=True):
        for k, weight, duration, slot in zip(*plan.steps, strict=True):
            rates = rates_at(k) if weight == 0 else _mixed(rates_at(k), rates_at(k + 1), weight)
            law = _advanced(rates, grid, law, duration)
            found[slot] = law
    return found


@in_time_of_discount
@with_settled_functions
def transition_arrays(
    problem: Problem, grid: Grid, *, scheme: Chain = Upwind()
) -> tuple[np.ndarray, Any, np.ndarray, np.ndarray, float]:
    """The controlled chain as a discounted Markov decision problem over pairs of state and action.

    With one Δt = 1/max Q over states and actions, the equation (β − 𝓛^u)V = L^u minimised over u is

        V = min_u [ L^u Δt + P^u V ] / (1 + βΔt),

    so the decision problem with cost L Δt/(1 + βΔt) and factor 1/(1 + βΔt) has exactly the value V_h. For a problem
    with rewards the first array holds rewards instead of costs, with max instead of min. A target node keeps its state,
    at a cost of (1 − factor) times its exit cost. If ``scheme.subcell`` ends a jump on the boundary of the target, L
    includes the difference between the exit costs at the boundary and at the node. Requires about 20 (2n + 2) bytes per
    pair.

    QuantEcon maximises. ``DiscreteDP(rewards, probabilities, factor, state_index, action_index)`` has the value V_h of
    a problem with rewards, and with ``-costs`` it has the value −V_h of a problem with costs.

    If the discount is a function β(x) of the state, the arrays use the time τ with dτ = β(x) dt, in which the discount
    is one. Drift and costs are divided by β and the noise by √β, so that all states have the same factor. With growth
    g(x, u) of the payments they are divided by β − g.

    Args:
      problem: discounted, without disturbances, constraints or switching costs of modes, with K ``Finite`` controls, or
        None (K = 1).
      grid: the grid, S nodes.
      scheme: the chain that defines the rates.

    Returns:
      ``(costs (S*K,), probabilities CSR (S*K, S), state_index (S*K,), action_index (S*K,), discount_factor)``,
      sorted by state, then by action; rewards instead of costs for a problem with rewards. Pairs that lead out of the
      box across a constrained end are left out.

    Raises:
      ValueError: the problem is not such a decision problem, rates or costs are not finite, or the chain cannot
        represent the noise.
    """
    checks.check_indices(grid)
    actions = decision_process.action_table(problem)
    held, given = decision_process.target(problem, grid)
    found = (
        policy_rates.checked_rates(
            Discretisation(problem, grid, scheme, np.float64), list(action), None, ~held, np.finfo(np.float64).eps
        )
        for action in actions
    )
    with own_settings(x64=True):
        cut = Discretisation(*cast((problem, grid), np.float64), scheme, np.dtype(np.float64)).links
        surcharge = decision_process.surcharge(cut, given, grid)
    tables = ((jumps, cost + decision_process.paid(jumps, surcharge), ~leaving) for jumps, cost, leaving in found)
    costs, *chain = decision_process.decision_problem(tables, grid, len(actions), held, given, float(problem.discount))
    return (costs if problem.payoff == COST else 0 - costs, *chain)


def _stationary(name: str, problem: Problem, grid: Grid, policy: Any, disturbance: Any, scheme: Chain, t: Any) -> Any:
    """The stationary law, shape (*grid); ``name`` is the function named in a message."""
    if problem.target is not None:  # the stationary law would be a point mass on the target
        raise ValueError(
            f"{name}: got a problem with a target, where paths end, so no law is stationary; leave "
            "it out, or use hjb.reach_probability or hjb.expected_exit_time"
        )
    if is_traced(problem, grid, policy, disturbance, t):
        return _stationary_traced(problem, grid, policy, disturbance, scheme, t)
    jumps = policy_rates.rates_under(problem, grid, policy, disturbance, scheme, t)
    moves = laws.sparse_generator(jumps, grid)
    return decision_process.single_law(moves, grid, name).reshape(grid.shape)


@as_one_program
def _stationary_traced(problem: Problem, grid: Grid, policy: Any, disturbance: Any, scheme: Chain, t: Any) -> jax.Array:
    """The stationary law inside a JAX transformation; NaN instead of an error."""
    return laws.stationary(policy_rates.rates_in_program(problem, grid, (policy, disturbance), scheme, t), grid)


@as_one_program
def _evolve_traced(
    problem: Problem, grid: Grid, scheme: Chain, actions: tuple, law: Any, plan: laws.LawSteps
) -> jax.Array:
    """The laws at the times of a plan inside a JAX transformation; NaN instead of an error."""
    actions = _with_times(actions, plan)
    moments = jnp.asarray(plan.moments)

    def rates_at(k: Any) -> Rates:
        return policy_rates.rates_in_program(problem, grid, tuple(_at(each, k) for each in actions), scheme, moments[k])

    only = rates_at(0) if len(plan.moments) == 1 else None

    def step(carry: tuple, entry: tuple) -> tuple[tuple, None]:
        law, found = carry
        k, weight, duration, slot = entry
        rates = only or _mixed(rates_at(k), rates_at(k + 1), weight)
        law = laws.after_duration(rates, grid, law, duration)
        return (law, found.at[slot].set(law)), None

    law = jnp.asarray(law, jnp.result_type(float))
    start = law, jnp.zeros((plan.count, *law.shape), law.dtype)
    return jax.lax.scan(step, start, jax.tree.map(jnp.asarray, plan.steps))[0][1]


_advanced = jax.jit(laws.after_duration)


def _mixed(first: Rates, second: Rates, weight: Any) -> Rates:
    """The rates between two times, the mean with ``weight`` for the second."""
    pairs = zip(first.values, second.values, strict=True)
    # jumps may land elsewhere at the second time
    landings = (*first.scaled(1 - weight).landings, *second.scaled(weight).landings)
    return Rates(first.offsets, tuple((1 - weight) * a + weight * b for a, b in pairs), landings=landings)


def _with_times(actions: tuple, plan: laws.LawSteps) -> tuple:
    """The actions of control and disturbance with an axis of times in front; None if there is no such player."""
    found = []
    for name, action in zip(("policy", "disturbance"), actions, strict=True):
        kept = action if action is None or is_traced(action) else np.asarray(action)
        if kept is not None and plan.timed and np.shape(kept)[:1] != (len(plan.moments),):
            raise ValueError(
                f"evolve: got a {name} of shape {kept.shape} for {len(plan.moments)} policy_times; wanted one {name} "
                "per time, shape (k, *grid, m)"
            )
        found.append(kept if kept is None or plan.timed else kept[None])
    return tuple(found)


def _at(action: Any, k: Any) -> Any:
    """A player's actions at one time."""
    return None if action is None else action[k]
