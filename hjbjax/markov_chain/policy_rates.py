"""The jump rates of the chain under a policy, on the host and inside JAX transformations.

On the host a problem or a policy without a chain is refused; inside a transformation the rates are then NaN.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import correlated_noise, edges
from hjbjax.discretisation.discretisation import Chain, Discretisation
from hjbjax.discretisation.posing import with_mode_axis
from hjbjax.discretisation.rates import Rates, jump_rates
from hjbjax.markov_chain import decision_process
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, cast
from hjbjax.problem.settings import own_settings
from hjbjax.tracing import checks
from hjbjax.tracing.closures import with_settled_functions


@with_mode_axis()
@with_settled_functions
def traced_rates(problem: Problem, grid: Grid, policy: Any, disturbance: Any, scheme: Chain) -> Rates:
    """The jump rates of a user's problem under a policy inside a JAX transformation."""
    return rates_in_program(problem, grid, (policy, disturbance), scheme, 0.0)


def rates_in_program(problem: Problem, grid: Grid, actions: tuple, scheme: Chain, t: Any) -> Rates:
    """The rates under a policy inside a JAX transformation; NaN if they are refused at host level."""
    _refuse_ends(grid)
    _refuse_changes(problem)
    problem = altered(problem, growth=None)
    u, d, active = decision_process.policy_components(problem, grid, *actions)
    dtype = np.dtype(jnp.result_type(float))
    on, u, d = cast((Discretisation(problem, grid, scheme, dtype, t), u, d), dtype)
    if problem.target is not None:
        active = active & ~(on.level <= 0)
    jumps, _, lacking, leaving = _evaluate(on, u, d, jnp.finfo(dtype).eps)
    faulty = jnp.any(active & (lacking | leaving | ~jnp.isfinite(jumps.total())))
    return cast(jumps.kept(active).scaled(jnp.where(faulty, jnp.nan, 1)), dtype)


def _refuse_changes(problem: Problem) -> None:
    """Refuse pushes, and changes of the mode by the controller, which a policy does not hold."""
    if problem.push_steps:
        raise ValueError(
            "chain: got a problem with pushes, which move the state at once; a policy does not hold them, so the rates "
            "would\nlack them. Leave out pushes"
        )
    if problem.switching_costs is not None:
        raise ValueError(
            "chain: got modes with a switching_cost; a policy does not hold changes of the mode by the controller,\n"
            "so the rates would lack them. Wanted modes that change only at random: leave out switching_cost"
        )


def rates_under(problem: Problem, grid: Grid, policy: Any, disturbance: Any, scheme: Chain, t: float) -> Rates:
    """The rates under a policy; zero on the target and at nodes without an action."""
    checks.check_indices(grid)
    _refuse_changes(problem)
    problem = altered(problem, growth=None)  # the growth scales the payments and does not change the motion
    u, d, active = decision_process.policy_components(problem, grid, policy, disturbance)
    active &= ~decision_process.target(problem, grid, t)[0]
    # the dtype of the policy determines what counts as rounding: float32 is off by 1e-7 at an end
    kinds = [np.asarray(array).dtype for array in (policy, disturbance) if array is not None]
    eps = max([np.finfo(kind).eps for kind in kinds if kind.kind == "f"], default=np.finfo(np.float64).eps)
    jumps, _, leaving = checked_rates(Discretisation(problem, grid, scheme, np.float64, t), u, d, active, eps)
    decision_process.refuse("the policy leaves the box across a constrained end", leaving, grid)
    return jumps


def checked_rates(
    on: Discretisation, u: list, d: list | None, active: np.ndarray, eps: Any
) -> tuple[Rates, np.ndarray, np.ndarray]:
    """Rates and running cost at the ``active`` nodes, zero elsewhere, and the nodes where an end forbids the actions.

    Refuses rates and costs that cannot be exported.
    """
    grid = on.grid
    _refuse_ends(grid)
    with own_settings(x64=True):
        jumps, cost, lacking, leaving = jax.device_get(_evaluate(*cast((on, u, d), np.float64), eps))
    decision_process.refuse(f"the running {on.problem.payoff} is not finite", active & ~np.isfinite(cost), grid)
    decision_process.refuse(
        "a jump rate, made of drift and noise, is not finite", active & ~np.isfinite(jumps.total()), grid
    )
    decision_process.refuse("the noise is correlated more than the spacings allow", active & lacking, grid)
    return jumps.kept(active), np.where(active, cost, 0), active & leaving


def _refuse_ends(grid: Grid) -> None:
    """Refuse ends at which the scheme is not a chain."""
    checks.refuse_prescribed(grid, "chain", "whose payments do not fit into a table of rates and running costs")
    if grid.sides("open"):
        raise ValueError(
            "chain: a grid with open ends has no chain: extrapolating the value beyond them gives negative "
            "probabilities; choose edges='projected' or 'constrained'"
        )


@jax.jit
def _evaluate(on: Discretisation, u: list, d: list | None, eps: Any) -> Any:
    """Rates, running cost, the nodes where the noise leaves a negative rate, and the nodes that cross an end."""
    jumps, shape = jump_rates(on, u, d), on.grid.shape
    cost, short = jnp.broadcast_to(on.running_cost(u, d), shape), correlated_noise.lacking(on, on.diffusion(u, d))
    leaving = edges.inadmissible(on, u, d, eps=eps)
    return jumps, cost, jnp.broadcast_to(jnp.zeros((), bool) if short is None else short, shape), leaving
