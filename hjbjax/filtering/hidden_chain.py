"""Hidden Markov chains with a few states: their exact filter as an observer, and closed-loop simulation.

The chain jumps with the generator A(u) and is measured through dy = h(x, u) dt + r dv. W. M. Wonham's filter over a
step dt, with constant control and the increment dy, is

    π ← P½ᵀ π,     π_i ← π_i exp(h_i·R⁻¹dy − ½ h_i·R⁻¹h_i dt) / (sum over i),     π ← P½ᵀ π,

where P½ = exp(A dt/2) and R = r². It is Bayes' rule for a chain that jumps only at the two ends of the step. Entries
are never negative and their sum is one for steps of any length. Without measurements π is exact. The transition matrix
is a Taylor series of A + qI ≥ 0 over 2^−s of the step, squared s times, with q the fastest rate. Its terms are all
nonnegative, so nothing cancels.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.filtering.beliefs import Sensor, chain_functions, check_generator
from hjbjax.filtering.measurement import check_length, check_vector
from hjbjax.problem import arguments
from hjbjax.problem.pytree import as_jax, as_partial, cast, front_door, is_traced, numbers, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Control, Key, Number, Numbers, Scalar

TERMS = 19  # terms of the Taylor series: 1/19! is below the rounding of float64 if q dt ≤ 1


def transition_matrix(rates: Array, dt: Number) -> jax.Array:
    """exp(A dt) of a generator A, shape (S, S), with entries ≥ 0 and rows that sum to one, for any dt ≥ 0.

    Example:
      >>> matrix = transition_matrix(np.array([[-1.0, 1.0], [0.0, 0.0]]), 1.0)
      >>> [round(float(entry), 4) for entry in matrix.ravel()]
      [0.3679, 0.6321, 0.0, 1.0]
    """
    rates = jnp.asarray(rates)
    fastest = jnp.max(-jnp.diag(rates))
    # q dt ≤ 1 in each part, so nineteen terms are enough; all terms are ≥ 0, so nothing cancels
    squarings = jnp.ceil(jnp.log2(jnp.maximum(fastest * dt, 1)))
    short = dt / 2**squarings
    one = jnp.eye(rates.shape[0], dtype=rates.dtype)
    raised = jnp.maximum(rates + fastest * one, 0) * short  # the smallest diagonal entry is zero up to rounding

    def add(k: Scalar, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        total, term = carry
        term = term @ raised / k
        return total + term, term

    total, _ = jax.lax.fori_loop(1, TERMS, add, (one, one))

    # replaces the factor e^{−q dt}, and keeps rounding from growing with the squarings
    def normal(matrix: jax.Array) -> jax.Array:
        return matrix / jnp.sum(matrix, axis=1, keepdims=True)

    return jax.lax.fori_loop(0, squarings.astype(int), lambda _, matrix: normal(matrix @ matrix), normal(total))


@pytree_dataclass()
class WonhamFilter:
    """The belief of a hidden chain as an observer, whose state is π, shape (S,).

    The estimate is the conditional mean of the chain's indicator, π itself. A controller is a function of π; with a
    ``belief_problem`` it is ``lambda belief: solution.control_at(coordinates.from_belief(belief), clamp=True)``.

    Args:
      generator: A(u), a function of one control that returns shape (S, S), or the matrix itself, per unit time.
      h: the measured quantity in each state, shape (S,) or (S, p), or a function of u that returns one of these.
      prior: π at time 0, shape (S,), ≥ 0; it need not be normalised.

    Keyword Args:
      measurement_noise: r in dy = h dt + r dv, a number or one per measurement (p,).

    Raises:
      ValueError: a prior that is negative or zero, or rates that are not a generator.

    Example:
      >>> observer = WonhamFilter(np.array([[-1.0, 1.0], [1.0, -1.0]]), [1.0, -1.0], [0.5, 0.5])
      >>> belief = observer.update(observer.initial(), jnp.zeros(0), jnp.array([0.3]), 0.1)
      >>> bool(belief[0] > belief[1]), round(float(belief.sum()), 6)
      (True, 1.0)

    Source: W. M. Wonham, Some applications of stochastic differential equations to optimal nonlinear filtering, 1965.
    """

    generator: Any
    sensor: Sensor
    prior: Any

    @front_door
    def __init__(
        self,
        generator: Callable | Numbers,
        h: Callable | Numbers | Sequence,
        prior: Numbers | Sequence,
        *,
        measurement_noise: Numbers | Sequence = 1.0,
    ):
        fixed, sensor = chain_functions(generator, h, measurement_noise, "WonhamFilter")
        if not callable(generator) and not is_traced(generator):
            check_generator(np.asarray(generator, float), "WonhamFilter: the generator")
        law: Any = numbers(prior, "WonhamFilter: prior")
        if not is_traced(law):
            if law.ndim != 1 or not np.all(np.isfinite(law)) or np.any(law < 0) or not law.sum() > 0:
                raise ValueError(
                    f"WonhamFilter: prior = {arguments.shown(law.tolist())}; wanted (S,) numbers ≥ 0, not all zero: "
                    "the probability of each state at time 0"
                )
            law = law / law.sum()  # frequencies are allowed
        _check_shapes(generator, h, sensor, len(law))
        for name, value in {"generator": fixed, "sensor": sensor, "prior": law}.items():
            object.__setattr__(self, name, value)

    @front_door
    def initial(self) -> jax.Array:
        """The prior, shape (S,), sum one."""
        law = jnp.asarray(self.prior, jnp.result_type(float))
        return law / jnp.sum(law)

    @front_door
    def update(self, state: Array, u: Control, dy: Array | None, dt: Number) -> jax.Array:
        """π after applying the control u (m,) for dt and measuring the increment dy (p,), or None."""
        check_vector(state, "WonhamFilter.update: the belief", len(self.prior), "one entry per state")
        check_vector(u, "WonhamFilter.update: u", np.size(u), "the control over the step, one entry per input")
        check_length(dt, "WonhamFilter.update: dt", "the length of the step")
        if dy is not None:
            outputs = jax.eval_shape(self.sensor.values, jnp.asarray(u)).shape[1]
            check_vector(dy, "WonhamFilter.update: dy", outputs, "the increment over dt, one entry per measurement")
            dy = jnp.asarray(dy)
        return _updated(as_jax(self), jnp.asarray(state), jnp.asarray(u), dy, dt)

    def _after(self, belief: jax.Array, u: jax.Array, dy: jax.Array | None, dt: Number) -> jax.Array:
        """π after a step."""
        mine, u = cast(self, belief.dtype), jnp.asarray(u, belief.dtype)
        if dy is None:
            belief = belief @ transition_matrix(jnp.asarray(mine.generator(u), belief.dtype), dt)
            return belief / jnp.sum(belief)
        # half a step of jumps before and after the evidence: Strang splitting, order 2
        half = transition_matrix(jnp.asarray(mine.generator(u), belief.dtype), dt / 2)
        gains = mine.sensor(u)
        # dy/r and h/r: unit noise in every measurement
        seen = jnp.asarray(dy, belief.dtype) / mine.sensor.measurement_noise
        evidence = gains @ jnp.broadcast_to(seen, gains.shape[1:]) - jnp.sum(gains**2, axis=1) * dt / 2
        belief = belief @ half
        # the largest exponent among the possible states becomes 0: nothing overflows, and one entry does not underflow
        top = jnp.max(jnp.where(belief > 0, evidence, -jnp.inf))
        belief = belief * jnp.exp(jnp.minimum(evidence - top, 0))
        belief = belief @ half
        return belief / jnp.sum(belief)  # the factor e^{top} cancels

    @front_door
    def estimate(self, state: Array) -> jax.Array:
        """The conditional mean of the indicator of the hidden state: π, shape (S,)."""
        return jnp.asarray(state)


_updated = jax.jit(WonhamFilter._after)


@pytree_dataclass()
class HiddenPath:
    """A simulated hidden chain with its measurements and beliefs; several keys add a leading axis to every array.

    Attributes:
      times: shape (k + 1,).
      hidden: the index of the state at each time, shape (k + 1,), integers.
      beliefs: π at each time, shape (k + 1, S).
      controls: the control over each step, shape (k, m).
      measurements: the increments dy, shape (k, p).
      cost: ∫ e^{−βt} c dt over the path, shape ().
    """

    times: Any
    hidden: Any
    beliefs: Any
    controls: Any
    measurements: Any
    cost: Any


def _check_shapes(generator: Any, h: Any, sensor: Sensor, states: int) -> None:
    """Refuse arrays whose number of states differs from the prior; functions are checked once a control is known."""
    if not callable(generator) and np.shape(generator) != (states, states):
        raise ValueError(
            f"WonhamFilter: generator has shape {np.shape(generator)}, wanted {(states, states)}: the prior has "
            f"{states} states"
        )
    if callable(h):
        return
    if np.ndim(h) not in (1, 2) or np.shape(h)[0] != states:
        raise ValueError(
            f"WonhamFilter: h has shape {np.shape(h)}, wanted ({states},) or ({states}, p): one row per state"
        )
    if not is_traced(h) and not np.all(np.isfinite(np.asarray(h, float))):
        raise ValueError(f"WonhamFilter: h = {arguments.shown(np.asarray(h).tolist())}, wanted finite numbers")
    sensor.check("WonhamFilter", np.zeros(0))


@front_door
def simulate_hidden(
    observer: WonhamFilter,
    control: Callable | None,
    cost: Callable,
    *,
    duration: float,
    dt: float,
    key: Key | int,
    discount: Number = 0.0,
    start: int | None = None,
) -> HiddenPath:
    """Paths of a hidden chain under a control that depends only on the belief, in float64; batched over keys.

    At the ends of the steps the chain has its exact law under the control of each step. In a step with a jump the
    measurement and the cost are averaged over the two states. The error of this is of order dt² in the mean.

    Args:
      observer: the filter, with the generator and the sensor of the chain.
      control: a function of the belief (S,) that returns u, shape (m,); ``None`` if there is no control, m = 0.
      cost: c, a function of u that returns the cost per unit time in every state, shape (S,).

    Keyword Args:
      duration: the length of the simulation, in units of time; it omits e^{−β duration} of an infinite-horizon cost.
      dt: the length of a step with constant control; shortened slightly so that the steps fill the duration.
      key: a JAX random key, an integer, or an array of K keys for K paths.
      discount: β ≥ 0, per unit time.
      start: the hidden state at time 0. Default: drawn from the prior.

    Returns:
      A ``HiddenPath``.

    Raises:
      ValueError: a duration or step that is not positive, a start that is not a state, a control, cost, generator or h
        with the wrong shape or values that are not finite.

    Example:
      >>> observer = WonhamFilter(np.array([[-1.0, 1.0], [1.0, -1.0]]), [1.0, -1.0], [0.5, 0.5])
      >>> keys = jax.random.split(jax.random.key(0), 100)
      >>> path = simulate_hidden(observer, None, lambda u: jnp.array([1.0, 0.0]), duration=2.0, dt=0.1, key=keys)
      >>> path.hidden.shape, path.beliefs.shape, bool(abs(path.cost.mean() - 1) < 0.2)
      ((100, 21), (100, 21, 2), True)
    """
    if not isinstance(observer, WonhamFilter):
        raise TypeError(f"simulate_hidden: got {type(observer).__name__}, wanted a WonhamFilter")
    arguments.positive(duration, "simulate_hidden: duration", "in units of time")
    arguments.positive(dt, "simulate_hidden: dt", "in units of time", most=float(duration))
    if not (arguments.is_number(discount) and 0 <= discount < np.inf):
        raise ValueError(f"simulate_hidden: discount = {arguments.shown(discount)}; wanted a finite number ≥ 0")
    states = len(observer.prior)
    if start is not None and not (isinstance(start, (int, np.integer)) and 0 <= start < states):
        raise ValueError(
            f"simulate_hidden: start = {arguments.shown(start)}; wanted a state, 0 to {states - 1}, or None"
        )
    # 1e-9: rounding must not add a step to a duration that is a whole number of steps
    steps = int(np.ceil(duration / dt * (1 - 1e-9)))
    keys = arguments.random_key(key, "simulate_hidden: key", batch=True)
    # float64, because float32 would round away beliefs near a corner over thousands of steps
    with own_settings(x64=True):
        law = np.asarray(observer.prior) if start is None else np.eye(states)[start]
        loop = cast(_Loop(observer, as_partial(control or _nothing), as_partial(cost), float(discount)), np.float64)
        _check_loop(loop, states)
        run = _many_paths if arguments.keys_shape(keys) else _paths
        path = jax.tree.map(np.asarray, run(loop, jnp.asarray(law), keys, duration / steps, steps))
    for name, found in {"control": path.controls, "h": path.measurements, "cost": path.cost}.items():
        if not np.all(np.isfinite(found)):
            raise ValueError(
                f"simulate_hidden: {name} returned numbers that are not finite along a path; wanted finite numbers for "
                "every belief and every control"
            )
    return path


@pytree_dataclass()
class _Loop:
    """The numbers and functions of a simulation."""

    observer: WonhamFilter
    control: Any
    cost: Any
    discount: Any


def _nothing(belief: Array) -> jax.Array:
    """An empty control."""
    return jnp.zeros(0)


def _check_loop(loop: _Loop, states: int) -> None:
    """Refuse a control or a cost of the wrong shape before anything is compiled."""
    belief = jax.ShapeDtypeStruct((states,), np.float64)
    u = jax.eval_shape(_array_of(loop.control), belief)
    if len(u.shape) != 1:
        raise ValueError(f"simulate_hidden: control returns shape {u.shape}, wanted (m,)")
    sensor = loop.observer.sensor
    for name, function, columns in (
        ("cost", loop.cost, ()),
        ("the generator", loop.observer.generator, (states,)),
        ("h", sensor.values, None),
    ):
        shape = jax.eval_shape(_array_of(function), u).shape
        wanted = (states, *(columns if columns is not None else shape[1:2]))
        if shape != wanted:
            raise ValueError(
                f"simulate_hidden: {name} returns shape {shape}, wanted {wanted}: the prior has {states} states"
            )
    sensor.check("simulate_hidden", u)
    first = jnp.asarray(loop.control(loop.observer.initial()))
    check_generator(np.asarray(loop.observer.generator(first)), f"simulate_hidden: the generator at u = {first}")
    if not np.all(np.isfinite(paid := np.asarray(loop.cost(first)))):
        raise ValueError(f"simulate_hidden: cost at u = {first} is {paid.tolist()}, wanted finite numbers")


def _array_of(function: Callable) -> Callable:
    """The function with its result converted to an array."""
    return lambda argument: jnp.asarray(function(argument))


def _simulated(loop: _Loop, law: jax.Array, key: Key, dt: Any, steps: int) -> HiddenPath:
    """One path."""
    observer = loop.observer
    key, first = jax.random.split(key)
    hidden, belief = jax.random.choice(first, len(law), p=law), observer.initial()
    # ∫ e^{−βs} ds over a step; equal to dt without a discount
    beta = loop.discount
    length = jnp.where(beta * dt > 0, -jnp.expm1(-beta * dt) / jnp.where(beta > 0, beta, 1), dt)

    def step(carry: tuple[Scalar, jax.Array], inputs: tuple[Scalar, Key]) -> tuple[tuple, tuple[jax.Array, ...]]:
        hidden, belief = carry
        number, key = inputs
        u = jnp.asarray(loop.control(belief), belief.dtype)  # a function of the belief only: the state is hidden
        jump, shake = jax.random.split(key)
        # the law of the state at the end of the step, with any number of jumps in between
        row = transition_matrix(jnp.asarray(observer.generator(u), belief.dtype), dt)[hidden]
        after = jax.random.choice(jump, len(row), p=row)
        gains = observer.sensor(u)
        noise = jax.random.normal(shake, gains.shape[1:], belief.dtype)
        dy = ((gains[hidden] + gains[after]) / 2 * dt + jnp.sqrt(dt) * noise) * observer.sensor.measurement_noise
        rates = jnp.asarray(loop.cost(u))
        paid = jnp.exp(-beta * number * dt) * length * (rates[hidden] + rates[after]) / 2
        belief = observer.update(belief, u, dy, dt)
        return (after, belief), (after, belief, u, dy, paid)

    inputs = (jnp.arange(steps), jax.random.split(key, steps))
    _, (states, beliefs, controls, measurements, paid) = jax.lax.scan(step, (hidden, belief), inputs)
    return HiddenPath(
        dt * jnp.arange(steps + 1), jnp.append(hidden, states), jnp.concatenate([belief[None], beliefs]),
        controls, measurements, jnp.sum(paid),
    )  # fmt: skip


_paths = jax.jit(_simulated, static_argnames="steps")
_many_paths = jax.jit(
    lambda loop, law, keys, dt, steps: jax.vmap(lambda key: _simulated(loop, law, key, dt, steps))(keys),
    static_argnames="steps",
)
