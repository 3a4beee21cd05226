"""Detection of undiscounted values of −∞: costs that are earned indefinitely.

If the chain never leaves a class of nodes under some policy, it pays the mean running cost under the stationary law of
the class, per unit time. If this mean is negative, the value is −∞ at every node of the class. An iteration that stops
by the size of its steps cannot detect this, because V falls by the same amount in each step.
"""

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.rates import Rates, jump_rates
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.markov_chain import stationary_law
from hjbjax.problem.types import Field

if TYPE_CHECKING:
    from scipy.sparse import csr_array

LARGEST = 200_000  # largest class whose stationary law is computed; in a larger class every node must earn


class Earning(NamedTuple):
    """A class of nodes in which a policy can stay and earn.

    Attributes:
      mean: the mean running cost, < 0, per unit time.
      node: the index of one of its nodes.
    """

    mean: float
    node: tuple[int, ...]


def earned(task: Task, state: State) -> Earning | None:
    """The first class of nodes in which the greedy policy earns indefinitely; ``None`` if there is none.

    Host level, for one player, because in a game the opponent would respond with another policy.
    """
    problem = task.problem
    # a certificate or a discount bounds the value, so V can fall indefinitely only without both
    bounded = task.certificate is not Certificate.NONE or problem.discount != 0
    if bounded or problem.is_game or problem.cost is None or not state.progress.has_begun:
        return None
    jumps, cost = jax.device_get(_rates_and_cost(task, state.policy.controls))
    # fixed nodes end the run: they are absorbing in the chain
    going = np.asarray(task.counted) & ~np.asarray(task.obstacles.fixed)
    # a class can earn on average only if some node earns
    if not np.all(np.isfinite(cost[going])) or not np.any(cost[going] < 0):
        return None
    # the rows of a generator sum to zero
    jumps = jumps.kept(going)
    generator = stencil.sparse(jumps.offsets, jumps.values, -jumps.total(), task.grid, jumps.landings)
    for states in stationary_law.classes(generator):
        # a fixed node is a separate class, without further payments
        if not going.flat[states[0]]:
            continue
        paid = cost.flat[states]
        # if every node earns, no law is needed: the mean is at most the largest cost
        mean = float(np.max(paid)) if np.all(paid < 0) else _mean_cost(generator, states, cost)
        if mean < 0:
            return Earning(mean, tuple(int(i) for i in np.unravel_index(states[0], task.grid.shape)))
    return None


@jax.jit
def _rates_and_cost(task: Task, controls: tuple[Field, ...]) -> tuple[Rates, Field]:
    """The rates of the chain and the running cost at the nodes under a policy."""
    cost = task.on.running_cost(list(controls))
    return jump_rates(task.on, list(controls)), jnp.broadcast_to(cost, task.grid.shape)


def _mean_cost(generator: "csr_array", states: np.ndarray, cost: np.ndarray) -> float:
    """An upper bound on the mean cost of a class, including the effect of rounding on its stationary law."""
    if len(states) > LARGEST or not np.any(cost.flat[states] < 0):
        return np.inf
    probabilities, error = stationary_law.law(generator, states)
    paid = cost.flat[states]
    # an error ‖Δp‖₁ of the law changes the mean by at most ‖Δp‖₁ max|L|; the mean must stay negative after adding it
    return float(probabilities[states] @ paid + error * np.max(np.abs(paid))) if np.isfinite(error) else np.inf
