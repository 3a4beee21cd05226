"""Jumps: sudden moves of the state at random times, such as a default, a breakdown or a catastrophe."""

from collections.abc import Callable
from typing import Any

import numpy as np

from hjbjax.problem.pytree import as_partial, numbers, pytree_dataclass
from hjbjax.problem.types import Number
from hjbjax.problem.words import shown


@pytree_dataclass()
class Jump:
    """A jump of the state, x → y(x, u), at the rate λ(x, u), which costs c(x, u) each time it happens.

    Every jump of a problem adds a term to its Hamiltonian, and V may be evaluated anywhere in the box:

        H = min_u [ L + f·DV + ½ tr(σσᵀ D²V) + Σ λ(x, u) (V(y(x, u)) − V(x) + c(x, u)) ].

    All functions take ``(x, u)``; also the disturbance in a game, the time first if the problem depends on it, and the
    mode last in a problem with modes. A jump keeps the mode. The minimum over u is exact if λ is affine and λ c
    quadratic in u, and y does not depend on u; otherwise it is searched.

    Between the nodes V(y) is interpolated linearly, with non-negative weights, so the scheme remains a Markov chain. A
    jump that would leave the box ends on its boundary; at open, linear and Neumann ends V continues with its slope. A
    jump across a constrained or a Robin end is refused. ``simulate`` makes the jump as given.

    Args:
      rate: λ ≥ 0, the expected number of jumps per unit time; a number or a function.
      landing: y, a function that returns the state after the jump, shape (n,).
      cost: c, in cost units; a number or a function. In a problem with rewards it is subtracted from them. Default: 0.
      reward: the reward for each jump, instead of a cost, such as the profit from a sale.

    Raises:
      ValueError: a rate that is negative, numbers of the wrong shape, or both ``cost`` and ``reward``.
      TypeError: a landing that is not a function.

    Example:
      >>> import hjbjax as hjb
      >>> import jax.numpy as jnp
      >>> crash = hjb.Jump(rate=0.1, landing=lambda x, u: 0.5 * x)  # halves the wealth every ten years
      >>> invested = hjb.Problem(
      ...     lambda x, u: 0.05 * x - u, reward=lambda x, u: jnp.sqrt(u[0]), controls=hjb.Box([0.0], [1.0]),
      ...     discount=0.1, jumps=[crash],
      ... )
      >>> hjb.solve(invested, hjb.Grid([0.0], [4.0], (81,), edges="constrained")).status.name
      'CONVERGED'
    """

    rate: Any
    landing: Any
    cost: Any = None
    reward: Any = None

    def __init__(
        self,
        rate: Callable | Number,
        landing: Callable,
        cost: Callable | Number | None = None,
        *,
        reward: Callable | Number | None = None,
    ):
        if not callable(landing):
            raise TypeError(
                f"Jump.landing: got {shown(landing)}, wanted a function (x, u) -> (n,), the state after the jump"
            )
        object.__setattr__(self, "rate", _number_or_function(rate, "Jump.rate"))
        object.__setattr__(self, "landing", as_partial(landing, "Jump.landing"))
        if isinstance(self.rate, np.ndarray) and not 0 <= self.rate < np.inf:
            raise ValueError(f"Jump.rate: got {shown(rate)}, wanted a finite number ≥ 0, per unit time, or a function")
        if cost is not None and reward is not None:
            raise ValueError("Jump: got both cost and reward, wanted at most one of them, for each jump")
        for name, given in {"cost": cost, "reward": reward}.items():
            paid = None if given is None else _number_or_function(given, f"Jump.{name}")
            if isinstance(paid, np.ndarray) and not np.isfinite(paid):
                raise ValueError(f"Jump.{name}: got {shown(given)}, wanted a finite number, or a function")
            object.__setattr__(self, name, paid)


def check_jumps(jumps: object) -> tuple[Jump, ...]:
    """The jumps of a problem as a tuple.

    Raises:
      TypeError: something that is not a list of jumps.
    """
    if not isinstance(jumps, (list, tuple)) or not all(isinstance(jump, Jump) for jump in jumps):
        raise TypeError(f"Problem.jumps: got {shown(jumps)}, wanted a list, as in [hjb.Jump(rate, landing)]")
    return tuple(jumps)


def _number_or_function(value: Any, name: str) -> Any:
    """A function as a pytree, or one number as an array."""
    if callable(value):
        return as_partial(value, name)
    found = numbers(value, name)
    if np.ndim(found):
        raise ValueError(f"{name}: got shape {np.shape(found)}, wanted one number or a function of (x, u)")
    return found
