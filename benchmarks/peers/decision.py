"""Solvers of Markov decision problems, on the chain that hjbjax exports.

QuantEcon's ``DiscreteDP`` takes pairs of state and action, and mdpsolver takes lists. Both maximise. QuantEcon's
modified policy iteration stops at half of ``epsilon``, so it gets twice the tolerance. Its policy iteration has no
tolerance and solves to rounding.

The exported chain is uniform in time, as these solvers require. So its steps are very short and its factor is near one,
which makes their value iteration and sweeps slow. hjbjax uses the time step of each node instead. mdpsolver's value
iteration takes minutes, and its Gauss–Seidel modified policy iteration takes seconds.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

Chain = tuple[np.ndarray, Any, np.ndarray, np.ndarray, float]


def quantecon(pairs: Chain, tol: float) -> dict[str, Callable[[], np.ndarray]]:
    """The two suitable methods of QuantEcon, as functions that return the value, shape (nodes,)."""
    from quantecon.markov import DiscreteDP

    costs, probabilities, states, actions, factor = pairs
    process = DiscreteDP(-costs, probabilities, factor, states, actions)
    return {
        "QuantEcon policy iteration": lambda: -process.solve("policy_iteration", max_iter=10_000).v,
        "QuantEcon modified policy iteration": lambda: (
            -process.solve("modified_policy_iteration", epsilon=2 * tol, max_iter=100_000).v
        ),
    }


def mdpsolver(pairs: Chain, tol: float) -> tuple[Callable[[], None], Callable[[], np.ndarray]]:
    """Modified policy iteration with Gauss–Seidel: a function that resets the solver, and the solve."""
    import mdpsolver

    costs, probabilities, states, _, factor = pairs
    count = int(states[-1]) + 1
    starts, entries, ends = probabilities.indptr, probabilities.data.tolist(), probabilities.indices.tolist()
    rows = [slice(*pair) for pair in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True)]
    each = len(rows) // count
    chance, columns = (
        [[numbers[row] for row in rows[s * each : (s + 1) * each]] for s in range(count)] for numbers in (entries, ends)
    )
    rewards = (-costs).reshape(count, each).tolist()
    model: list[Any] = []

    def afresh():
        model[:] = [mdpsolver.model()]
        model[0].mdp(discount=factor, rewards=rewards, tranMatProbs=chance, tranMatColumns=columns)

    def solve():
        model[0].solve(algorithm="mpi", update="gs", tolerance=tol)
        return -np.array(model[0].getValueVector())

    return afresh, solve
