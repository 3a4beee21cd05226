"""Costs, targets and small helpers that several ready problems share.

Everything that a Problem holds is a module-level function or a bound method of a registered dataclass, so that
its numbers are leaves: changing one recompiles nothing, and a tracer may stand in for any of them.
"""

from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Num

from hjbjax.problem.pytree import as_partial, is_traced, pytree_dataclass
from hjbjax.problem.types import Array, Control, Number, State

T = TypeVar("T")
Scalar: TypeAlias = Num[Array, ""]
Exact: TypeAlias = Callable[[State | Sequence[float]], Scalar]  # V at one state, an array or a plain list
Feedback: TypeAlias = Callable[[State], Control]

ROUNDING = 1e-6  # relative, of a best control that was computed in float32: one on its bound is admissible


def unit_cost(x: State, u: Control) -> Number:
    """One per unit time: the cost is the time."""
    return jnp.ones((), jnp.result_type(x))  # in the state's precision, or float32 solves would be promoted


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

    state: Number | State = 1.0
    control: Number | Control = 1.0

    def rate(self, x: State, u: Control) -> Number:
        """Cost per unit time."""
        # x*x and no x'Qx: elementwise, so that a solver squares each coordinate once per node of its own axis
        return jnp.sum(self.state * (x * x)) + jnp.sum(self.control * (u * u))


@pytree_dataclass()
class QuadraticValue:
    """x'Px + c."""

    matrix: Array
    constant: Number = 0.0

    def value(self, x: State) -> Scalar:
        """The value at one state."""
        x = jnp.asarray(x)  # an answer may be asked with a plain list
        return x @ jnp.asarray(self.matrix) @ x + self.constant


@pytree_dataclass(static=("dim",))
class Disc:
    """The Euclidean ball around the origin in the first ``dim`` states; radius 0 is the origin alone."""

    radius: Number
    dim: int

    def level(self, x: State) -> Number:
        """|x|² − r²: ≤ 0 inside."""
        place = x[: self.dim]  # a Dubins car arrives in any heading, which comes after them
        # squares, no root: at the origin, which is all there is for radius 0, the root's derivative is NaN
        return jnp.sum(place * place) - self.radius * self.radius


@pytree_dataclass()
class OutsideCube:
    """The complement of the open cube |x_i| < half_width: the faces of a box of that size, and beyond."""

    half_width: Number

    def level(self, x: State) -> Number:
        """Half width − max |x_i|: ≤ 0 on the faces."""
        # The faces are nodes up to the last bit only; a millionth is below any spacing and above any rounding.
        return self.half_width * (1 - 1e-6) - jnp.max(jnp.abs(x))


@pytree_dataclass()
class OutsideBall:
    """The complement of the open ball |x| < radius."""

    radius: Number

    def level(self, x: State) -> Number:
        """r − |x|: ≤ 0 outside."""
        # as of the cube: nodes of the box's faces lie on the sphere up to their last bit
        return self.radius * (1 - 1e-6) - root(jnp.sum(x * x))


class Traveller(Protocol):
    """A system whose least time to the target is known."""

    def arrival_time(self, x: State) -> Scalar:
        """T from one state; infinite where the target is out of reach."""
        ...


@pytree_dataclass()
class Arrival:
    """(1 − e^{−βT})/β for the time T = ``system.arrival_time``: S of (8.14) for β = 1, T itself for β = 0."""

    system: Traveller
    discount: Number = 1.0

    def value(self, x: State) -> Scalar:
        """The value at one state."""
        return discounted_time(self.system.arrival_time(jnp.asarray(x)), self.discount)


def discounted_time(time: Number, discount: Number) -> Scalar:
    """∫₀ᵀ e^{−βs} ds = (1 − e^{−βT})/β, and T where β = 0."""
    # a divisor that is never zero: the branch not taken is evaluated too, and 0/0 there would make derivatives NaN
    rate = jnp.where(discount == 0, 1.0, discount)
    # expm1 keeps the digits that 1 − e^{−βT} would lose for small β, down to β = 1e-9
    return jnp.where(discount == 0, time, -jnp.expm1(-rate * time) / rate)


def root(square: Number) -> Scalar:
    """√max(s, 0), with the derivative 0 where the root is 0: at a corner of a distance no number moves it."""
    inside = square > 0
    # the derivative of √s at 0 is infinite, and times what is not asked for it would be NaN
    return jnp.where(inside, jnp.sqrt(jnp.where(inside, square, 1.0)), 0 * square)


def answer(method: Callable[..., T]) -> Callable[..., T]:
    """A bound method as a function of one state that carries its parameters through ``jit``."""
    return as_partial(method)  # type: ignore[return-value]  # None comes of None alone


def noise_or_none(noise: Number) -> Number | None:
    """``None`` for a plain zero, so that the problem counts as deterministic."""
    # a tracer may be zero for all we know, so it stays, and with it the second derivatives
    return noise if is_traced(noise) or np.any(np.asarray(noise) != 0) else None


def positive(owner: str, **numbers: object) -> None:
    """Refuse parameters that are not positive, while they are known.

    Raises:
      ValueError: a number that is zero, negative or not finite.
    """
    for name, value in numbers.items():
        if is_traced(value):
            continue  # under jit and grad no value can be looked at
        try:
            array = np.asarray(value, np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"{owner}: got {name} = {value!r}, wanted a number") from None
        if not np.all(np.isfinite(array) & (array > 0)):
            raise ValueError(f"{owner}: got {name} = {value!r}, wanted a finite number > 0")


def admissible(owner: str, lo: Number, hi: Number, where: str = "", **best: Number) -> None:
    """Refuse a closed form whose best control lies outside its set, while the numbers are known.

    Args:
      owner: the name of the problem.
      lo: the lower bound of the set.
      hi: the upper one.
      where: the states at which the control is the best one, for the message.
      **best: the control that the closed form rests on.

    Raises:
      ValueError: a number outside of [lo, hi], or NaN.
    """
    if is_traced(lo, hi, best):
        return
    low, high = np.asarray(lo, np.float64), np.asarray(hi, np.float64)
    slack = ROUNDING * (np.abs(low) + np.abs(high))
    for name, number in best.items():
        array = np.asarray(number, np.float64)
        if not np.all((array >= low - slack) & (array <= high + slack)):
            raise ValueError(
                f"{owner}: got parameters whose best {name} is {array:.6g}{where}, wanted one within "
                f"[{low:.6g}, {high:.6g}], the set of controls: beyond it the closed form is not the value"
                if array.ndim == 0
                else f"{owner}: got parameters whose best {name} lies outside the set of controls{where}"
            )
