"""Pushes: the directions in which the controller may move the state at once, at a marginal cost."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import as_partial, is_traced, numbers, pytree_dataclass
from hjbjax.problem.types import Array, Number
from hjbjax.problem.words import shown


@pytree_dataclass(static=("direction",))
class Push:
    """A direction in which the controller may move the state, by any length and at once.

    The cost is c(x) per unit of length, so V(x) ≤ c h + V(x + h e) for the direction e. The variational inequality is

        min{ min_u [ L + f·DV + ½ tr(σσᵀ D²V) ] − β V,  c + DV·e } = 0.

    This is singular control: the state is pushed only where c + DV·e = 0. A path that starts inside this region jumps
    to its boundary, and is reflected there afterwards. On the grid a push is a jump to the next node.

    Args:
      direction: e, shape (n,): one entry is 1 or −1, all others are zero.
      cost: c, cost per unit of length; a number, or a function of x, with t first if ``time_dependent`` and the mode
        last if there are modes. Infinity forbids the push. A negative cost is a reward.
      reward: the reward per unit of length, instead of a cost, such as a dividend.

    Raises:
      ValueError: a direction that is not along an axis, or neither or both of ``cost`` and ``reward``.

    Example:
      >>> Push([0, -1], cost=2.0).step, Push([1.0], reward=0.9).step
      ((1, -1), (0, 1))
    """

    direction: tuple[int, ...]
    cost: Any = None
    reward: Any = None

    def __init__(
        self,
        direction: Sequence[float],
        cost: Callable | Number | None = None,
        *,
        reward: Callable | Number | None = None,
    ):
        if (cost is None) == (reward is None):
            found = "neither cost nor reward" if cost is None else "both cost and reward"
            raise ValueError(f"Push: got {found}, wanted one of them, per unit of length")
        object.__setattr__(self, "direction", _axis_direction(direction))
        object.__setattr__(self, "cost", _marginal(cost, "Push.cost", -np.inf))
        object.__setattr__(self, "reward", _marginal(reward, "Push.reward", np.inf))

    @property
    def step(self) -> tuple[int, int]:
        """The axis of the push, and 1 or −1."""
        axis = next(axis for axis, entry in enumerate(self.direction) if entry)
        return axis, self.direction[axis]


def check_pushes(pushes: object) -> tuple[Push, ...]:
    """The pushes of a problem as a tuple.

    Raises:
      TypeError: something that is not a sequence of pushes.
      ValueError: two pushes in the same direction, or directions of different lengths.
    """
    if isinstance(pushes, Push) or not isinstance(pushes, (list, tuple)):
        raise TypeError(f"Problem.pushes: got {shown(pushes)}, wanted a list, as in [hjb.Push([-1.0], cost=1.0)]")
    for push in pushes:
        if not isinstance(push, Push):
            raise TypeError(f"Problem.pushes: got {shown(push)} in the list, wanted hjb.Push(direction, cost)")
    directions = [push.direction for push in pushes]
    if len(set(directions)) < len(directions) or len(set(map(len, directions))) > 1:
        raise ValueError(
            f"Problem.pushes: got the directions {[list(each) for each in directions]}, wanted different directions of "
            "the same length; give one push per direction, at the least of its costs"
        )
    return tuple(pushes)


def marginal_costs(pushes: Sequence[Push]) -> jax.tree_util.Partial:
    """The costs of all pushes per unit of length, (p,), as one function of the state; rewards are negative costs."""
    paid = tuple(push.cost if push.reward is None else push.reward for push in pushes)
    signs = np.array([1.0 if push.reward is None else -1.0 for push in pushes])
    return jax.tree_util.Partial(_together, paid, signs)


def _together(paid: tuple, signs: Array, *arguments: Any) -> Array:
    """The costs, each a number or a function of the arguments, times their signs."""
    found = [jnp.asarray(each(*arguments) if callable(each) else each, float) for each in paid]
    return signs * jnp.stack(found)


def _axis_direction(direction: Sequence[float]) -> tuple[int, ...]:
    """The direction as integers, with one entry ±1."""
    if is_traced(direction):
        raise ValueError("Push.direction: got a traced direction; it must be known, because it chooses the next node")
    entries = np.asarray(direction, float)
    if entries.ndim != 1 or np.count_nonzero(entries) != 1 or abs(entries.sum()) != 1:
        raise ValueError(
            f"Push.direction: got {shown(direction)}, wanted one entry 1 or -1 and zeros: a push leads to the next "
            "node along an axis.\nFor another direction, change to coordinates in which it is an axis"
        )
    return tuple(int(entry) for entry in entries)


def _marginal(paid: Any, name: str, forbidden: float) -> Any:
    """A cost or a reward per unit of length: a function, a tracer or a number; infinite gains are refused."""
    if paid is None or callable(paid):
        return as_partial(paid, name)
    number = numbers(paid, name)
    if np.ndim(number):
        raise ValueError(f"{name}: got shape {np.shape(number)}, wanted one number, or a function of the state")
    if not isinstance(number, np.ndarray):
        return number
    if np.isnan(number) or number == forbidden:
        raise ValueError(f"{name}: got {shown(paid)}, wanted a number; infinity only as a cost, which forbids the push")
    return float(number)
