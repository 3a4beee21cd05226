"""Costs, targets and small helpers that several ready problems share.

Every function stored in a Problem is a module-level function or a bound method of a registered dataclass, so its
numbers are leaves of the pytree. Changing one does not recompile, and any of them may be a tracer.
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

# the name of ``discounted_time`` on plots; without the number β, because names are static and would recompile
TIME = "(1 − e⁻ᵝᵀ)/β"
ROUNDING = 1e-6  # relative rounding of a best control computed in float32; a control on its bound is admissible


def unit_cost(x: State, u: Control) -> Number:
    """One per unit time, so the total cost is the elapsed time."""
    return jnp.ones((), jnp.result_type(x))  # the state's dtype, otherwise float32 solves would be promoted


@pytree_dataclass()
class QuadraticCost:
    """The running cost q·|x|² + r·|u|².

    Args:
      state: q, one number or one weight per state.
      control: r, one number or one weight per input.

    Example:
      >>> import numpy as np
      >>> float(QuadraticCost(0.5, 0.5).rate(np.array([1.0, 2.0]), np.array([3.0])))
      7.0
    """

    state: Number | State = 1.0
    control: Number | Control = 1.0

    def rate(self, x: State, u: Control) -> Number:
        """Cost per unit time."""
        # elementwise x*x instead of x'Qx, so that a solver squares each coordinate only once per node of its axis
        return jnp.sum(self.state * (x * x)) + jnp.sum(self.control * (u * u))


@pytree_dataclass()
class QuadraticValue:
    """The function x'Px + c."""

    matrix: Array
    constant: Number = 0.0

    def value(self, x: State) -> Scalar:
        """The value at one state."""
        x = jnp.asarray(x)  # x may be a plain list
        return x @ jnp.asarray(self.matrix) @ x + self.constant


@pytree_dataclass(static=("dim",))
class Disc:
    """The Euclidean ball around the origin in the first ``dim`` states; radius 0 is the origin only."""

    radius: Number
    dim: int

    def level(self, x: State) -> Number:
        """|x|² − r²: ≤ 0 inside."""
        place = x[: self.dim]  # the position; a Dubins car may arrive with any heading
        # squared distances, because the derivative of the distance is NaN at the origin
        return jnp.sum(place * place) - self.radius * self.radius


@pytree_dataclass()
class OutsideCube:
    """The complement of the open cube |x_i| < half_width, which contains the faces of a box of that size."""

    half_width: Number

    def level(self, x: State) -> Number:
        """Half width − max |x_i|: ≤ 0 on the faces."""
        # nodes on the faces are exact only up to rounding; 1e-6 is below any grid spacing and above any rounding
        return self.half_width * (1 - 1e-6) - jnp.max(jnp.abs(x))


@pytree_dataclass()
class OutsideBall:
    """The complement of the open ball |x| < radius."""

    radius: Number

    def level(self, x: State) -> Number:
        """r − |x|: ≤ 0 outside."""
        # as for the cube: nodes where the sphere touches the box are exact only up to rounding
        return self.radius * (1 - 1e-6) - root(jnp.sum(x * x))


class Traveller(Protocol):
    """A system whose least time to the target is known."""

    def arrival_time(self, x: State) -> Scalar:
        """The least time T from one state; infinite if the target is unreachable."""
        ...


@pytree_dataclass()
class Arrival:
    """(1 − e^{−βT})/β for the time T = ``system.arrival_time``: S of (8.14) if β = 1, T itself if β = 0."""

    system: Traveller
    discount: Number = 1.0

    def value(self, x: State) -> Scalar:
        """The value at one state."""
        return discounted_time(self.system.arrival_time(jnp.asarray(x)), self.discount)


def discounted_time(time: Number, discount: Number) -> Scalar:
    """∫₀ᵀ e^{−βs} ds = (1 − e^{−βT})/β, and T if β = 0."""
    # the divisor is never zero: JAX differentiates both branches of a where, and 0/0 would make the derivative NaN
    rate = jnp.where(discount == 0, 1.0, discount)
    # expm1 keeps the digits that 1 − e^{−βT} would lose to cancellation for small β; tested down to β = 1e-9
    return jnp.where(discount == 0, time, -jnp.expm1(-rate * time) / rate)


def root(square: Number) -> Scalar:
    """√max(s, 0), with the derivative 0 where s ≤ 0, for distances with a corner."""
    inside = square > 0
    # √s has an infinite derivative at 0, which turns into NaN when the chain rule multiplies it by 0
    return jnp.where(inside, jnp.sqrt(jnp.where(inside, square, 1.0)), 0 * square)


def answer(method: Callable[..., T]) -> Callable[..., T]:
    """Return a bound method as a function of one state whose parameters are pytree leaves under ``jit``."""
    return as_partial(method)  # type: ignore[return-value]  # as_partial returns None only for None


def noise_or_none(noise: Number) -> Number | None:
    """Return ``None`` for a concrete zero, so that the problem counts as deterministic."""
    # the value of a tracer is unknown, so a traced noise keeps its second derivatives
    return noise if is_traced(noise) or np.any(np.asarray(noise) != 0) else None


def two_modes(up: Number, down: Number) -> Array:
    """The table of two modes, of rates or of costs, from its entries for the changes up and down."""
    xp = jnp if is_traced(up, down) else np
    return xp.asarray([[0.0, up], [down, 0.0]])


def check_positive(owner: str, **numbers: object) -> None:
    """Check that parameters are positive; traced parameters are not checked.

    Raises:
      ValueError: a parameter is zero, negative or not finite.
    """
    for name, value in numbers.items():
        if is_traced(value):
            continue  # values are unknown under jit and grad
        try:
            array = np.asarray(value, np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"{owner}: got {name} = {value!r}, wanted a number") from None
        if not np.all(np.isfinite(array) & (array > 0)):
            raise ValueError(f"{owner}: got {name} = {value!r}, wanted a finite number > 0")


def admissible(owner: str, lo: Number, hi: Number, where: str = "", **best: Number) -> None:
    """Check that the best control of a closed form is admissible; traced numbers are not checked.

    Args:
      owner: the name of the problem.
      lo: the lower bound of the control set.
      hi: the upper bound.
      where: the states at which this control is the best one, for the message.
      **best: the best controls according to the closed form.

    Raises:
      ValueError: a control is outside [lo, hi] or NaN.
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
                f"[{low:.6g}, {high:.6g}], the set of controls; the closed form is the value only inside it"
                if array.ndim == 0
                else f"{owner}: got parameters whose best {name} lies outside the set of controls{where}"
            )
