"""Beliefs of a hidden Markov chain as states of a control problem.

A chain of S states jumps with the generator A(u), where A_ij is the rate from i to j. It is measured through
dy = h(x) dt + r dv. The belief π_i = P(x = i | measurements) is a diffusion on the simplex (W. M. Wonham's filter):

    dπ = A(u)ᵀ π dt + Σ_l π (h_l − ĥ_l)/r_l dν_l,     ĥ = Σ_i π_i h_i,     ν the innovation.

A control costs Σ_i π_i c_i(u). This is a problem for ``hjb.solve`` whose state π is known. If h depends on u, the
control also chooses the quality of the measurement (dual control).

Two states: x = π₁ in [0, 1] with dx = (Aᵀπ)₁ dt + x(1 − x) |h₁ − h₂|/r dν. The noise vanishes at both ends, and the
drift there points inwards or is zero.

Three or more states: one noise channel moves all of π at once. This noise is degenerate, and its direction turns with
π, so no chain on a grid in π can represent it. In logarithms the noise is constant. With H = h/r and an orthonormal
basis B of the vectors with sum zero that makes B H Hᵀ Bᵀ = diag(a₁, …) diagonal, the state is

    ζ = B log π,     dζ = B μ dt + √a dw,     μ_i = (Aᵀπ)_i/π_i − ½ Σ_l (H_il − Ĥ_l)²,     π = softmax(Bᵀ ζ).

The second term of μ is the Itô correction. The noise acts along the axes, so the chain is monotone for any spacings.
The faces of the simplex lie at infinity; the box ends where the smallest π is ``floor`` times the largest. This
changes the value by about as much as a belief of size ``floor`` does. The drift near the end is fast, about a rate
divided by ``floor``. If the default scheme stalls there and reports it, use ``scheme=hjb.Upwind()``.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem import arguments, sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, front_door, is_traced, numbers, pytree_dataclass
from hjbjax.problem.sets import AdmissibleSet
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Control, Number, Numbers, State

ROUNDING = 1e-12  # relative to the size of a generator or a diffusion: smaller entries count as zero
LOOKS = 9  # samples of a continuous control set at which the generator, h and the cost are checked


@pytree_dataclass()
class BeliefCoordinates:
    """The map between beliefs, shape (S,), and the states of a belief problem, shape (S − 1,).

    Args:
      basis: B, shape (S − 1, S), for three or more states; ``None`` for two, where the coordinate is π₁.
    """

    basis: Any = None

    @front_door
    def to_belief(self, x: State) -> jax.Array:
        """π at a state, shape (S,), entries ≥ 0 with sum one; states (..., S − 1) give shape (..., S)."""
        x = jnp.asarray(x)
        if self.basis is None:
            return jnp.concatenate([x, 1 - x], axis=-1)  # no clip: on the grid x is in [0, 1]
        return jax.nn.softmax(x @ jnp.asarray(self.basis, x.dtype), axis=-1)

    @front_door
    def from_belief(self, belief: Array) -> jax.Array:
        """The state of a belief, shape (S − 1,); beliefs (..., S) give shape (..., S − 1).

        In logarithmic coordinates a belief of zero is replaced by the smallest normal number.
        """
        belief = jnp.asarray(belief)
        if self.basis is None:
            return belief[..., :1]
        logs = jnp.log(jnp.maximum(belief, jnp.finfo(belief.dtype).tiny))
        return logs @ jnp.asarray(self.basis, belief.dtype).T


@pytree_dataclass()
class BeliefDynamics:
    """Drift, noise and cost of a belief at one state, with the numbers of the chain as leaves.

    Args:
      coordinates: the map between states and beliefs.
      generator: A, a function of u that returns shape (S, S).
      h: the sensor, a function of u that returns h/r, shape (S, p).
      running: c, a function of u that returns shape (S,).
    """

    coordinates: BeliefCoordinates
    generator: Any
    h: "Sensor"
    running: Any

    def drift(self, x: State, u: Control) -> jax.Array:
        """The rate of change of the state, shape (S − 1,)."""
        rates, belief = self.generator(u), self.coordinates.to_belief(x)
        if self.coordinates.basis is None:
            # each term has a fixed sign, so rounding cannot make the drift at an end point outwards
            return jnp.stack([rates[1, 0] * belief[1] - rates[0, 1] * belief[0]])
        basis, gains = jnp.asarray(self.coordinates.basis), self.h(u)
        logs = x @ basis  # log π up to a constant, which cancels in the quotients π_j/π_i
        inflow = jnp.sum(rates * jnp.exp(logs[:, None] - logs[None, :]), axis=0)
        ito = jnp.sum((gains - belief @ gains) ** 2, axis=1) / 2
        return basis @ (inflow - ito)

    def noise(self, x: State, u: Control) -> jax.Array:
        """The standard deviation along each axis, shape (S − 1,)."""
        gains = self.h(u)
        if self.coordinates.basis is None:
            return jnp.stack([x[0] * (1 - x[0]) * jnp.sqrt(jnp.sum((gains[0] - gains[1]) ** 2))])
        return jnp.sqrt(jnp.sum((jnp.asarray(self.coordinates.basis) @ gains) ** 2, axis=1))

    def cost(self, x: State, u: Control) -> jax.Array:
        """The expected cost per unit time, a scalar."""
        return self.coordinates.to_belief(x) @ self.running(u)


@pytree_dataclass(static=("varies",))
class Sensor:
    """h over r as a function of the control, shape (S, p).

    Args:
      h: shape (S,) or (S, p), or a function of u that returns one of these.
      measurement_noise: r, a number or one per measurement (p,).
      varies: True if h is a function of u.
    """

    h: Any
    measurement_noise: Any
    varies: bool

    def values(self, u: Control) -> jax.Array:
        """h(u), shape (S, p)."""
        found = jnp.asarray(self.h(u) if self.varies else self.h)
        return found[:, None] if found.ndim == 1 else found

    def __call__(self, u: Control) -> jax.Array:
        """h(u)/r, shape (S, p)."""
        return self.values(u) / self.measurement_noise

    def check(self, name: str, u: Control) -> None:
        """Refuse a measurement noise with the wrong number of entries; ``name`` opens the message."""
        wanted = jax.eval_shape(self.values, u).shape[1:]
        if (got := np.shape(self.measurement_noise)) not in ((), wanted):
            raise ValueError(f"{name}: measurement_noise has shape {got}, wanted () or {wanted}: one per column of h")


class BeliefProblem(NamedTuple):
    """A control problem whose state is a belief, its grid, and the map from its states to beliefs."""

    problem: Problem
    grid: Grid
    coordinates: BeliefCoordinates


@front_door
def belief_problem(
    generator: Callable | Numbers,
    h: Callable | Numbers | Sequence,
    cost: Callable,
    *,
    controls: AdmissibleSet | None = None,
    discount: Number,
    measurement_noise: Numbers | Sequence = 1.0,
    nodes: int | Sequence[int] | None = None,
    floor: float = 1e-3,
) -> BeliefProblem:
    """The control problem of the belief of a hidden chain, its grid, and the map between beliefs and states.

    β V = min_u { Σ_i π_i c_i(u) + (generator of dπ under u) V }. V is a concave function of π. It is at least
    Σ_i π_i V_i, the mean value of a controller that knows the state, and at most the value without measurements.

    Args:
      generator: A(u), a function of one control that returns shape (S, S), or the matrix itself: rates per unit time
        from row to column, rows sum to zero.
      h: the measured quantity in each state, shape (S,) or (S, p), or a function of u that returns one of these.
      cost: c, a function of one control that returns the cost per unit time in every state, shape (S,).

    Keyword Args:
      controls: the admissible set of u; ``None`` for a chain without a control.
      discount: β > 0, per unit time.
      measurement_noise: r in dy = h dt + r dv, a number or one per measurement (p,), in the units of h √time.
      nodes: the number of nodes, or one number per axis. Default: 201 for two states, 81 per axis for more.
      floor: for three or more states, the smallest belief in the box relative to the largest.

    Returns:
      ``BeliefProblem(problem, grid, coordinates)``.

    Raises:
      ValueError: rates that are negative or rows that do not sum to zero, at some admissible control; shapes that do
        not fit; numbers that are not finite or not positive; for three or more states an h(u) whose noises have no
        common axes, for example two sensors between which the control switches.
      TypeError: a cost that is not a function.

    Example:
      >>> import hjbjax as hjb
      >>> def generator(u):  # a machine fails at rate 0.2 and is repaired at rate u
      ...     return jnp.stack([jnp.stack([-0.2, 0.2]), jnp.stack([u[0], -u[0]])])
      >>> machine = belief_problem(
      ...     generator, [1.0, 0.0], lambda u: jnp.stack([2 * u[0], 1 + 0 * u[0]]),
      ...     controls=hjb.Finite([[0.0], [2.0]]), discount=0.5, nodes=101,
      ... )  # repairing a working machine costs 4 per unit time, a failure 1
      >>> solution = hjb.solve(machine.problem, machine.grid)
      >>> solution.control_at([0.95]).tolist(), solution.control_at([0.05]).tolist()
      ([0.0], [2.0])

    Source: M. R. James, Nonlinear Control Systems, section 12; W. M. Wonham, SIAM J. Control 2, 1965.
    """
    arguments.positive(discount, "belief_problem: discount", "per unit time")
    if not 0 < floor < 1:
        raise ValueError(f"belief_problem: floor = {arguments.shown(floor)}; wanted a number between 0 and 1")
    if not callable(cost):
        raise TypeError(
            f"belief_problem: cost is {arguments.shown(cost)}, wanted a function of u that returns shape (S,)"
        )
    rates, sensor = chain_functions(generator, h, measurement_noise, "belief_problem")
    chain = BeliefDynamics(BeliefCoordinates(), rates, sensor, as_partial(cost))
    with own_settings(x64=True):
        looks = _looks(controls)
        states = _check_chain(chain, looks)
        basis = None if states == 2 else _common_axes(sensor, looks, states)
    dynamics = dataclasses.replace(chain, coordinates=BeliefCoordinates(basis))
    problem = Problem(dynamics.drift, dynamics.cost, controls, noise=dynamics.noise, discount=discount)
    return BeliefProblem(problem, _box(basis, states, nodes, floor), dynamics.coordinates)


def chain_functions(generator: Any, h: Any, noise: Any, name: str) -> tuple[Any, Sensor]:
    """The generator as a function of u, and h/r, with their numbers as leaves; ``name`` opens the messages."""
    spread: Any = numbers(noise, f"{name}: measurement_noise")
    if not is_traced(spread) and not (spread.ndim <= 1 and np.all(np.isfinite(spread) & (spread > 0))):
        raise ValueError(
            f"{name}: measurement_noise = {arguments.shown(noise)}; wanted finite numbers > 0, one or one per "
            "measurement. Without noise the state is known: solve the problem of the chain itself."
        )
    rates = generator if callable(generator) else Constant(numbers(generator, f"{name}: generator"))
    values = as_partial(h) if callable(h) else numbers(h, f"{name}: h")
    return as_partial(rates), Sensor(values, spread, callable(h))


@pytree_dataclass()
class Constant:
    """A function of the control that always returns the same array."""

    value: Any

    def __call__(self, u: Control) -> jax.Array:
        """The array."""
        return jnp.asarray(self.value)


def _looks(controls: AdmissibleSet | None) -> jax.Array:
    """Controls at which the functions are checked, shape (K, m): all of a finite set, samples of a continuous one."""
    return jnp.asarray(np.zeros((1, 0)) if controls is None else sets.samples(controls, LOOKS))


def _check_chain(chain: BeliefDynamics, looks: jax.Array) -> int:
    """The number of states S, after checks at each control. Of traced arrays only the shapes are checked."""
    states = 0
    for u in looks:
        rates = chain.generator(u)
        states = rates.shape[0] if np.ndim(rates) else 0
        if np.shape(rates) != (states, states) or states < 2:
            raise ValueError(f"belief_problem: generator returns shape {np.shape(rates)}, wanted (S, S) with S ≥ 2")
        _check_rows("generator", rates, ((states, states),), u)
        _check_rows("cost", chain.running(u), ((states,),), u)
        h = chain.h.h(u) if chain.h.varies else chain.h.h
        _check_rows("h", h, ((states,), (states, np.shape(h)[-1] if np.ndim(h) else 1)), u)
        chain.h.check("belief_problem", u)
        if not is_traced(rates):
            check_generator(np.asarray(rates), f"belief_problem: the generator at u = {np.asarray(u).tolist()}")
    return states


def _check_rows(name: str, array: Any, wanted: tuple, u: jax.Array) -> None:
    """Refuse an array with a shape not in ``wanted`` or with numbers that are not finite."""
    if np.shape(array) not in wanted:
        shapes = " or ".join(str(each) for each in wanted)
        raise ValueError(f"belief_problem: {name} has shape {np.shape(array)}, wanted {shapes}: one row per state")
    if not is_traced(array) and not np.all(np.isfinite(np.asarray(array))):
        raise ValueError(f"belief_problem: {name} is not finite at u = {np.asarray(u).tolist()}")


def check_generator(rates: np.ndarray, name: str) -> None:
    """Refuse a matrix that is not a generator.

    Raises:
      ValueError: another shape, numbers that are not finite, a negative rate, or a row that does not sum to zero.
    """
    if rates.ndim != 2 or rates.shape[0] != rates.shape[1] or len(rates) < 2:
        raise ValueError(f"{name} has shape {rates.shape}, wanted (S, S) with S ≥ 2: rates from row to column")
    if not np.all(np.isfinite(rates)):
        raise ValueError(f"{name} = {arguments.shown(rates.tolist())}, wanted finite numbers")
    slack = ROUNDING * np.max(np.abs(rates))
    off = rates - np.diag(np.diag(rates))
    if np.any(off < 0):
        i, j = np.argwhere(off < 0)[0]
        raise ValueError(
            f"{name} has the rate {rates[i, j]:g} from state {i} to {j}; wanted rates ≥ 0 off the diagonal"
        )
    if np.any(np.abs(rates.sum(axis=1)) > len(rates) * slack):
        row = int(np.argmax(np.abs(rates.sum(axis=1))))
        raise ValueError(
            f"{name} has a row {row} that sums to {rates[row].sum():g}, wanted zero: the diagonal is minus the sum of "
            "the rates out of a state"
        )


def _common_axes(sensor: Sensor, looks: jax.Array, states: int) -> np.ndarray:
    """B, shape (S − 1, S): an orthonormal basis of the vectors with sum zero along which the noise is uncorrelated."""
    seen = [sensor(u) for u in looks]
    if is_traced(seen):
        raise ValueError(
            f"belief_problem: h or measurement_noise is traced; with {states} states they set the axes of the grid, so "
            "they must be known numbers"
        )
    # h and h + const carry the same information: only differences between states count
    centring = np.eye(states) - 1 / states
    covariances = [centring @ gains @ gains.T @ centring for gains in map(np.asarray, seen)]
    # unequal weights, so that differences between two covariances cannot cancel in the sum
    weights = [1 / np.sqrt(2 + k) for k in range(len(covariances))]
    size = max(max(np.abs(each).max() for each in covariances), np.finfo(float).tiny)
    mixed = sum(w * c for w, c in zip(weights, covariances, strict=True)) / size
    # subtracting a matrix of ones moves the eigenvalue of the vector of ones far below all others, so it comes first
    # and can be left out
    _, vectors = np.linalg.eigh(mixed - np.ones((states, states)))
    basis = vectors[:, 1:].T[::-1].copy()
    # the sign of an eigenvector is arbitrary and depends on the machine: make the largest entry positive
    basis *= np.sign(basis[np.arange(states - 1), np.argmax(np.abs(basis), axis=1)])[:, None]
    for covariance, u in zip(covariances, looks, strict=True):
        turned = basis @ covariance @ basis.T
        if np.any(np.abs(turned - np.diag(np.diag(turned))) > 1e3 * ROUNDING * size):
            raise ValueError(
                f"belief_problem: the noises of h at u = {u.tolist()} and at other controls have no common axes, "
                f"wanted matrices h(u) h(u)ᵀ/r² that commute. With {states} states let the control change only the "
                "gain of a sensor, h(u) = k(u) h₀, or use two states."
            )
    return basis


def _box(basis: np.ndarray | None, states: int, nodes: Any, floor: float) -> Grid:
    """The grid of a belief problem."""
    axes = states - 1
    given = (201 if states == 2 else 81) if nodes is None else nodes
    shape = (given,) * axes if not isinstance(given, (Sequence, np.ndarray)) else tuple(given)
    if len(shape) != axes:
        raise ValueError(f"belief_problem: nodes = {arguments.shown(nodes)}; wanted a count or {axes} of them")
    shape = tuple(arguments.count(each, "belief_problem: nodes", 3) for each in shape)
    if basis is None:
        return Grid([0.0], [1.0], shape, names=("π1",))
    # the largest b·log π over beliefs with π_i ≥ floor·π_j has log π = log(1/floor) where b > 0, and 0 elsewhere
    reach = np.log(1 / floor) * np.maximum(basis, 0).sum(axis=1)
    return Grid(-reach, reach, shape, names=tuple(f"ζ{axis + 1}" for axis in range(axes)))
