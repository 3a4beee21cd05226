"""Costs, targets and small helpers that several ready problems share.

Everything that a Problem holds is a module-level function or a bound method of a registered dataclass, so that
its numbers are leaves: changing one recompiles nothing, and a tracer may stand in for any of them.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import as_partial, is_traced, pytree_dataclass


def unit_cost(x: Any, u: Any) -> Any:
    """One per unit time: the cost is the time."""
    return jnp.ones((), jnp.result_type(x))


@pytree_dataclass()
class QuadraticCost:
    """The running cost q·|x|² + r·|u|².

    Args:
      state: q, a number or one weight a state.
      control: r, a number or one weight an input.

    Example:
      >>> import numpy as np
      >>> float(QuadraticCost(0.5, 0.5).rate(np.array([1.0, 2.0]), np.array([3.0])))
      7.0
    """

    state: Any = 1.0
    control: Any = 1.0

    def rate(self, x: Any, u: Any) -> Any:
        """Cost per unit time."""
        return jnp.sum(self.state * (x * x)) + jnp.sum(self.control * (u * u))


@pytree_dataclass()
class QuadraticValue:
    """x'Px + c."""

    matrix: Any
    constant: Any = 0.0

    def value(self, x: Any) -> Any:
        """The value at one state."""
        x = jnp.asarray(x)
        return x @ jnp.asarray(self.matrix) @ x + self.constant


@pytree_dataclass(static=("dim",))
class Disc:
    """The Euclidean ball around the origin in the first ``dim`` states; radius 0 is the origin alone."""

    radius: Any
    dim: int

    def level(self, x: Any) -> Any:
        """|x|² − r²: ≤ 0 inside."""
        place = x[: self.dim]
        return jnp.sum(place * place) - self.radius * self.radius


@pytree_dataclass()
class OutsideCube:
    """The complement of the open cube |x_i| < half_width: the faces of a box of that size, and beyond."""

    half_width: Any

    def level(self, x: Any) -> Any:
        """Half width − max |x_i|: ≤ 0 on the faces."""
        # The faces are nodes up to the last bit only; a millionth is below any spacing and above any rounding.
        return self.half_width * (1 - 1e-6) - jnp.max(jnp.abs(x))


@pytree_dataclass()
class OutsideBall:
    """The complement of the open ball |x| < radius."""

    radius: Any

    def level(self, x: Any) -> Any:
        """r − |x|: ≤ 0 outside."""
        return self.radius * (1 - 1e-6) - jnp.sqrt(jnp.sum(x * x))


@pytree_dataclass()
class Arrival:
    """(1 − e^{−βT})/β for the time T = ``system.arrival_time``: S of (8.14) for β = 1, T itself for β = 0."""

    system: Any
    discount: Any = 1.0

    def value(self, x: Any) -> Any:
        """The value at one state."""
        return discounted(self.system.arrival_time(jnp.asarray(x)), self.discount)


def discounted(time: Any, discount: Any) -> Any:
    """∫₀ᵀ e^{−βs} ds = (1 − e^{−βT})/β, and T where β = 0."""
    rate = jnp.where(discount == 0, 1.0, discount)
    return jnp.where(discount == 0, time, -jnp.expm1(-rate * time) / rate)


def answer(method: Callable) -> Callable:
    """A bound method as a function of one state that carries its parameters through ``jit``."""
    return as_partial(method)  # type: ignore[return-value]


def noise_or_none(noise: Any) -> Any:
    """``None`` for a plain zero, so that the problem counts as deterministic."""
    return noise if is_traced(noise) or np.any(np.asarray(noise) != 0) else None


def positive(owner: str, **numbers: Any) -> None:
    """Refuse parameters that are not positive, while they are known.

    Raises:
      ValueError: a number that is zero, negative or not finite.
    """
    for name, value in numbers.items():
        if is_traced(value):
            continue
        try:
            array = np.asarray(value, np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"{owner}: got {name} = {value!r}, wanted a number") from None
        if not np.all(np.isfinite(array) & (array > 0)):
            raise ValueError(f"{owner}: got {name} = {value!r}, wanted a finite number > 0")
