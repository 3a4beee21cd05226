"""The Hamiltonian of a game in two halves, one a player, each upwinded by itself.

Where drift and cost are sums f = f₁(x, u) + f₂(x, d), L = L₁ + L₂ and noise is nobody's,

    H = min_u [L₁ + Σ_i f₁ᵢ⁺ P_i⁺ + f₁ᵢ⁻ P_i⁻ + noise]  +  max_d [L₂ + Σ_i f₂ᵢ⁺ P_i⁺ + f₂ᵢ⁻ P_i⁻]

is consistent and monotone in the neighbours, like upwinding the sum f, and costs two optimisations of one player in
place of a nested one. Only where both drive one component do the two differ: there |f₁| + |f₂| takes the place
of |f₁ + f₂| in the dissipation, as it does in a Lax–Friedrichs flux. Upwinding the sum can break the Isaacs
condition at a node (f = u + d, D⁺ = 1, D⁻ = −1: min max 1, max min 0); the halves keep it.
"""

from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.discretisation import chain
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.hamiltonian import discrete
from hjbjax.hamiltonian.players import players_of
from hjbjax.hamiltonian.search import Action
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.tracing import dependence


def optimise(on: Discretisation, value: jax.Array) -> tuple[jax.Array, Action, Action]:
    """min max of H around ``value``: the value at every node, the control and the disturbance."""
    hamiltonian = discrete.around(on, value)
    best, actions = [], []
    for part in halves(on):
        total, u, d = discrete.optimise(hamiltonian.asking(part))
        best.append(total)
        actions.append((u, d))
    return sum(best[1:], start=best[0]), actions[0][0], actions[-1][1]


def fastest_rate(on: Discretisation) -> jax.Array:
    """max over the actions of the rate at which value flows out of each node, (*grid), per unit time."""
    rates = [chain.fastest_rate(on.asking(part)) for part in halves(on)]
    return rates[0] if len(rates) == 1 else rates[0] + rates[1]


def rate(on: Discretisation, u: Action, d: Action) -> jax.Array:
    """The rate at which value flows out of each node under given actions, (*grid), per unit time."""
    parts = halves(on)
    players = [(u, d)] if len(parts) == 1 else [(u, []), ([], d)]
    rates = [chain.rates(on.asking(part), *actions).total() for part, actions in zip(parts, players, strict=True)]
    return sum(rates[1:], start=rates[0])


def halves(on: Discretisation) -> list[Problem]:
    """The problems of the two players where they share components and can be told apart; else the problem itself."""
    problem, grid, dtype = on.problem, on.grid, on.dtype
    if not problem.is_game or grid.sides("constrained"):  # what is admissible depends on both players' sum
        return [problem]
    players = players_of(on)
    if players.decoupled or not players.separable:
        return [problem]
    m = 0 if problem.controls is None else problem.controls.dim
    assert problem.disturbances is not None
    no_u, no_d = jnp.zeros(m, dtype), jnp.zeros(problem.disturbances.dim, dtype)
    mine = Problem(
        _Alone(problem.drift, no_d),
        None if problem.cost is None else _Alone(problem.cost, no_d),
        problem.controls,
        noise=_Alone(problem.noise, no_d) if callable(problem.noise) else problem.noise,
        target=problem.target,
        exit_cost=problem.exit_cost,
        time_dependent=problem.time_dependent,
    )
    theirs = Problem(
        _Added(problem.drift, no_u, no_d, _driven(problem.drift, problem, grid.ndim, m, no_d.size, dtype)),
        None if problem.cost is None else _Added(problem.cost, no_u, no_d),
        disturbances=problem.disturbances,
        target=problem.target,
        exit_cost=problem.exit_cost,
        time_dependent=problem.time_dependent,
    )
    return [mine, theirs]


def _driven(function: Any, problem: Problem, n: int, m: int, k: int, dtype: Any) -> tuple[int, ...]:
    """The components that the disturbance drives."""
    time = ((None, False),) * problem.time_dependent
    return dependence.dependence(function, *time, (n, False), (m, True), (k, True), dtype=dtype).driven_by(
        range(m, m + k)
    )


@pytree_dataclass()
class _Alone:
    """What a function of (t), x, u, d is without the disturbance, f(x, u, 0)."""

    function: Any
    no_d: Any

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments, self.no_d)


@pytree_dataclass(static=("driven",))
class _Added:
    """What the disturbance adds, f(x, 0, d) − f(x, 0, 0); an exact zero in the components that it does not drive."""

    function: Any
    no_u: Any
    no_d: Any
    driven: tuple[int, ...] | None = None

    def __call__(self, *arguments: Any) -> Any:
        *rest, _, d = arguments  # (t), x, u, d
        added = self.function(*rest, self.no_u, d) - self.function(*rest, self.no_u, self.no_d)
        if self.driven is None:
            return added
        return jnp.stack([added[i] if i in self.driven else jnp.zeros((), added.dtype) for i in range(added.shape[0])])
