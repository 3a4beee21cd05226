"""Costs that are earned for ever: what makes an undiscounted value −∞.

A policy under which the chain, once in a class of nodes, never leaves it pays there the mean of the running cost under
the stationary law of the class, per unit time. If that is negative the value is −∞ at every node of the class: no
iteration that is stopped by the size of its steps can say so, since V falls by the same amount in each of them.
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

LARGEST = 200_000  # nodes of a class whose stationary law is solved for; of a larger one every node must earn


class Earning(NamedTuple):
    """A class of nodes in which a policy can stay and earn.

    Attributes:
      mean: the mean running cost, < 0, per unit time.
      node: the index of one of its nodes.
    """

    mean: float
    node: tuple[int, ...]


def earned(task: Task, state: State) -> Earning | None:
    """The first class of nodes in which the greedy policy earns for ever; ``None`` if it has none.

    Host level, for one player; a game's answer to it would be another policy.
    """
    problem = task.problem
    # a certificate bounds the value, and so does a discount: only what has neither can fall for ever
    bounded = task.certificate is not Certificate.NONE or problem.discount != 0
    if bounded or problem.is_game or problem.cost is None or int(state.step) < 0:
        return None
    jumps, cost = jax.device_get(_rates_and_cost(task, state.policy.controls))
    # held nodes end the run: in the chain they are absorbing
    going = np.asarray(task.counted) & ~np.asarray(task.obstacles.fixed)
    # only a class in which some node earns can earn on the average
    if not np.all(np.isfinite(cost[going])) or not np.any(cost[going] < 0):
        return None
    # rows sum to zero, which is what makes it a generator
    values = [np.where(going, rate, 0) for rate in jumps.values]
    generator = stencil.sparse(jumps.offsets, values, -np.sum(values, axis=0), task.grid)
    for states in stationary_law.classes(generator):
        # a held node is a class of its own, where nothing is paid any more
        if not going.flat[states[0]]:
            continue
        paid = cost.flat[states]
        # where every node earns no law is needed: the mean is at most the largest cost
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
    """An upper bound on the mean cost of a class: with what rounding may do to its stationary law."""
    if len(states) > LARGEST or not np.any(cost.flat[states] < 0):
        return np.inf
    probabilities, error = stationary_law.law(generator, states)
    paid = cost.flat[states]
    # a law off by ‖Δp‖₁ changes the mean by ‖Δp‖₁ max|L| at most: −∞ is claimed only if that leaves it negative
    return float(probabilities[states] @ paid + error * np.max(np.abs(paid))) if np.isfinite(error) else np.inf
