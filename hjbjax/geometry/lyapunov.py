"""Search for violations of a Lyapunov function.

A function V proves that ẋ = f(t, x) is stable at x_e if, in a region around x_e,

    V(t, x) > V(t, x_e) for x ≠ x_e,      dV/dt = ∂V/∂t + (∂V/∂x) f ≤ 0

``lyapunov_check`` evaluates both conditions at points spread evenly over the region and at its corners, and climbs from
the worst points. A reported violation is a violation, up to rounding. A search without violations is only evidence,
because it can miss a narrow one.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.geometry.unit_cube import half_widths, nearest_inside, state_of, time_of
from hjbjax.problem.pytree import cast, front_door, pytree_dataclass
from hjbjax.problem.sets import Ball, Box
from hjbjax.problem.settings import own_settings
from hjbjax.problem.streams import encodable
from hjbjax.problem.types import Array, Number, State
from hjbjax.tracing import checks
from hjbjax.tracing.closures import refuse_traced, settled_function

Functions: TypeAlias = tuple[Callable, Callable]  # V and f, functions of (x) or (t, x)
Climb: TypeAlias = tuple[jax.Array, jax.Array, jax.Array]  # the point, the measure there, and the length of a step
Place: TypeAlias = tuple[Box | Ball, Array, Array | None]  # the region, the equilibrium, and the interval of times

CLIMBS = 32  # number of starts of the local search for each of the three measures
STEPS = 80  # number of steps per climb; a step that does not climb is halved
NEAR = 0.01  # in half widths of the region: V is not compared with V(x_e) closer to the equilibrium than this
FLAT = 1e-9  # relative to the rise of V elsewhere at this distance; a smaller rise may mean that V is flat here
ROUNDING = 64  # times eps and the largest terms of dV/dt in the region: below this their sum has no sign
AT_REST = 1e-8  # relative to the drift in the region; an equilibrium comes from a root finder or a rounded formula


@pytree_dataclass()
class LyapunovReport:
    """The worst points that the search found.

    Args:
      positive: True if V > V(x_e) at every evaluated point except x_e.
      decreasing: True if dV/dt ≤ 0 at every evaluated point, up to rounding.
      worst_state: the state with the largest dV/dt; if it is never positive, the largest relative to its terms.
      worst_time: the time at ``worst_state``; ``None`` without times.
      rate: dV/dt at ``worst_state``.
      lowest_state: the state with the smallest (V − V(x_e))/|x − x_e|², in half widths of the region.
      lowest_time: the time at ``lowest_state``; ``None`` without times.
      lowest: V − V(x_e) at ``lowest_state``.
      evaluations: the number of evaluated points.
    """

    positive: bool
    decreasing: bool
    worst_state: np.ndarray
    worst_time: np.ndarray | None
    rate: float
    lowest_state: np.ndarray
    lowest_time: np.ndarray | None
    lowest: float
    evaluations: int

    @property
    def holds(self) -> bool:
        """True if no violation was found."""
        return self.positive and self.decreasing

    def __str__(self) -> str:
        if not self.positive:
            return encodable(
                f"violated: V − V(x_e) = {self.lowest:.3g} at {_place_in_words(self.lowest_state, self.lowest_time)}"
            )
        if not self.decreasing:
            return f"violated: dV/dt = {self.rate:.3g} at {_place_in_words(self.worst_state, self.worst_time)}"
        return f"no violation found at {self.evaluations:,} points; the search proves nothing"


@front_door
def lyapunov_derivative(V: Callable, f: Callable, *, time_varying: bool = False) -> Callable:
    """The function dV/dt along ẋ = f, of ``(x)``, or of ``(t, x)`` if V and f are time-varying.

    Args:
      V: a function that returns one number.
      f: the closed loop, a function that returns shape (n,).

    Keyword Args:
      time_varying: True if V and f take ``(t, x)``.

    Example:
      >>> decay = lyapunov_derivative(lambda x: x @ x, lambda x: -x)
      >>> float(decay(jnp.array([1.0, 2.0])))
      -10.0
    """
    # one jvp along (1, f): ∂V/∂t and (∂V/∂x) f together
    if time_varying:
        return own_settings()(lambda t, x: jax.jvp(V, (t, x), (jnp.ones_like(t), f(t, x)))[1])
    return own_settings()(lambda x: jax.jvp(V, (x,), (f(x),))[1])


@front_door
def lyapunov_check(
    V: Callable,
    f: Callable,
    region: Box | Ball,
    times: Sequence[float] | np.ndarray | None = None,
    *,
    equilibrium: State | Sequence[float] | None = None,
    samples: int = 4096,
    tolerance: float = 1e-9,
) -> LyapunovReport:
    """Search a region for violations of V as a Lyapunov function of ẋ = f, and report the worst points.

    Args:
      V: a function that returns one number.
      f: the closed loop, a function that returns shape (n,).
      region: the states to search, a Box, or a Ball around the origin.
      times: the first and the last time to search; V and f then take ``(t, x)``. With ``None`` they take ``(x)``.

    Keyword Args:
      equilibrium: x_e, shape (n,); ``None`` is the origin.
      samples: number of initial points.
      tolerance: dV/dt counts as zero below this fraction of its terms.

    Returns:
      A LyapunovReport, with ``holds``, ``worst_state`` and ``rate``.

    Raises:
      TypeError: the region is neither a Box nor a Ball.
      ValueError: an argument is not admissible, x_e is outside the region or f is not zero there, or V or f is not
        finite at a point of the region.

    Example:
      >>> oscillator = lambda x: jnp.stack([x[1], -x[0] - (1 - x[0] ** 2) * x[1]])      # unstable beyond |x| = 1
      >>> energy = lambda x: 0.5 * (x @ x)
      >>> lyapunov_check(energy, oscillator, Box([-0.9, -0.9], [0.9, 0.9])).holds
      True
      >>> report = lyapunov_check(energy, oscillator, Box([-2.0, -2.0], [2.0, 2.0]))
      >>> report.holds, np.abs(report.worst_state).tolist(), report.rate
      (False, [2.0, 2.0], 12.0)
    """
    if not isinstance(region, (Box, Ball)):
        raise TypeError(f"lyapunov_check: region is {region!r}, wanted a Box or a Ball of states")
    if isinstance(samples, bool) or not isinstance(samples, (int, np.integer)) or samples < 1:
        raise ValueError(f"lyapunov_check: samples is {samples!r}, wanted a positive integer")
    if not 0 < tolerance < 1:
        raise ValueError(f"lyapunov_check: tolerance is {tolerance!r}, wanted a number between 0 and 1")
    refuse_traced("lyapunov_check", V, f, region, times, equilibrium)
    span_of_times = _check_times(times)
    rest = np.zeros(region.dim) if equilibrium is None else np.asarray(equilibrium, np.float64)
    if rest.shape != (region.dim,):
        raise ValueError(f"lyapunov_check: equilibrium has shape {rest.shape}, wanted ({region.dim},)")
    fed = {"x": rest.shape} if times is None else {"t": (), "x": rest.shape}
    checks.function_of(V, "V", (), **fed)
    checks.function_of(f, "f", rest.shape, **fed)
    # always float64: the default tolerance of 1e-9 is below the rounding of float32
    with own_settings(x64=True):
        place = cast((region, rest, span_of_times), np.float64)
        _check_inside(place[0], rest)
        starts = _starts(region.dim + (times is not None), int(samples))
        shapes = [()] * (times is not None) + [(region.dim,)]
        asked = [settled_function(each, *shapes) for each in (V, f)]
        functions = cast(tuple(asked), np.float64)
        found = jax.tree.map(np.asarray, _search(functions, place, starts, tolerance))
    if not found.pop("finite"):
        raise ValueError(
            "lyapunov_check: V or f is not finite at a point of the region; choose a region where both are"
        )
    if not (moved := found.pop("moved").item()) <= AT_REST:
        raise ValueError(
            f"lyapunov_check: f is not zero at the equilibrium {rest.tolist()}: it is {moved:.2g} of its size in the "
            "region; pass the equilibrium= of this closed loop"
        )
    numbers = {name: found[name].item() for name in ("positive", "decreasing", "rate", "lowest")}
    found |= numbers
    if times is None:
        found |= {"worst_time": None, "lowest_time": None}
    return LyapunovReport(**found, evaluations=len(starts) + 3 * min(CLIMBS, len(starts)) * STEPS)


def _check_inside(region: Box | Ball, rest: np.ndarray) -> None:
    """Raise ValueError if the equilibrium is outside the region, where the search would not see its neighbourhood."""
    if not np.all(np.abs(nearest_inside(region, rest) - rest) <= AT_REST * half_widths(region)):
        raise ValueError(f"lyapunov_check: got equilibrium = {rest.tolist()}, wanted a state in {region!r}")


def _check_times(times: Sequence[float] | np.ndarray | None) -> np.ndarray | None:
    """Check the first and the last time and return them in float64."""
    if times is None:
        return None
    ends = np.asarray(times, np.float64)
    if ends.shape != (2,) or not np.all(np.isfinite(ends)) or ends[0] > ends[1]:
        raise ValueError(f"lyapunov_check: times is {times!r}, wanted two numbers, the first and the last time")
    return ends


def _place_in_words(state: Array, time: Number | None) -> str:
    where = "x = [" + ", ".join(f"{number:.4g}" for number in np.asarray(state)) + "]"
    return where if time is None else f"t = {float(time):.4g}, {where}"


def _starts(dim: int, samples: int) -> np.ndarray:
    """Points of the unit cube, shape (about samples, dim): a low-discrepancy sequence and the corners."""
    # multiples of the powers of 1/φ modulo 1 with φ^(dim + 1) = φ + 1, the golden ratio sequence in dim dimensions;
    # the iteration for φ reduces its error by a factor of 0.31 or better, so 60 iterations reach full precision
    root = 2.0
    for _ in range(60):
        root = (1 + root) ** (1 / (dim + 1))
    steps = root ** -np.arange(1.0, dim + 1)
    inner = (0.5 + np.arange(1, samples + 1)[:, None] * steps) % 1
    # dV/dt is often worst in a corner, as in the example above; 12 axes would have 4096 corners, as many as samples
    return np.concatenate([inner, np.array(list(itertools.product((0.0, 1.0), repeat=dim)))]) if dim <= 10 else inner


@jax.jit
def _search(functions: Functions, place: Place, starts: Array, tolerance: float) -> dict[str, jax.Array | None]:
    """The fields of a LyapunovReport, and ``finite`` (True if V and dV/dt are finite at all starts) and ``moved``."""
    region, rest, times = place
    half = half_widths(region)

    def at(z: Array) -> tuple[jax.Array | None, jax.Array]:
        return state_of(region, times, z)

    def value(z: Array) -> jax.Array:
        return _value(functions[0], times, z, at(z)[1])

    def rates(z: Array) -> tuple[jax.Array, jax.Array]:
        return _terms(functions, times, z, at(z)[1])

    def relative(z: Array) -> jax.Array:  # dV/dt relative to its terms
        rate, terms = rates(z)
        # divide by 1 at the equilibrium, where 0/0 would make the value and the derivative NaN
        return rate / jnp.where(terms > 0, terms, 1)

    def low(z: Array) -> jax.Array:
        x = at(z)[1]
        square = jnp.sum(((x - rest) / half) ** 2)
        above = value(z) - _value(functions[0], times, z, rest)
        # divided by |x − x_e|², as for a quadratic form; V − V(x_e) itself is least at x_e for every good V
        return jnp.where(square > NEAR**2, -above / jnp.where(square > 0, square, 1), -jnp.inf)

    highest, nearest, lowest = (_best(f, starts) for f in (lambda z: rates(z)[0], relative, low))
    rate, terms = rates(highest)
    decreasing = rate <= tolerance * terms
    # near the equilibrium dV/dt is small, so a violation there shows only relative to its terms; where all terms are
    # smaller than the rounding of f, their sum has no sign
    everywhere = jax.vmap(rates)(starts)
    small = ROUNDING * jnp.finfo(starts.dtype).eps * jnp.max(everywhere[1])
    close, its_terms = rates(nearest)
    decreasing &= close <= tolerance * its_terms + small
    # report the point with the largest rate if it is a violation, otherwise the point with the largest relative rate
    worst = jnp.where((rate > tolerance * terms), highest, nearest)
    above, rounding, around = _compare(functions[0], place, lowest, at(lowest)[1])
    risen, rises = _rise(functions[0], place, lowest, at(lowest)[1])
    # rounding hides the rise of V here if V(x_e) is large and V does not rise far more elsewhere at this distance
    hidden = (jnp.abs(above) <= rounding) & rises & (risen > FLAT * around)
    above, rounding = jnp.where(hidden, risen, above), jnp.where(hidden, 0, rounding)
    # the sum is not finite if either is not finite
    looked = jax.vmap(value)(starts) + everywhere[0]
    moved = _share_of_drift(functions[1], place, jax.vmap(at)(starts))
    (worst_time, worst_state), (lowest_time, lowest_state) = at(worst), at(lowest)
    return {
        "finite": jnp.all(jnp.isfinite(looked)) & jnp.isfinite(moved), "moved": moved,
        "positive": above > rounding, "decreasing": decreasing,
        "worst_state": worst_state, "worst_time": worst_time, "rate": rates(worst)[0],
        "lowest_state": lowest_state, "lowest_time": lowest_time, "lowest": above,
    }  # fmt: skip


def _share_of_drift(f: Callable, place: Place, points: tuple[Array | None, Array]) -> jax.Array:
    """The largest |f_i(x_e)| relative to the largest |f_i| at the points."""
    rest, (times, states) = place[1], points
    if times is None:
        rates, stay = jax.vmap(f)(states), jnp.asarray(f(rest))[None]
    else:
        rates, stay = jax.vmap(f)(times, states), jax.vmap(lambda t: f(t, rest))(times)
    largest, left = jnp.max(jnp.abs(rates), axis=0), jnp.max(jnp.abs(stay), axis=0)
    return jnp.max(left / jnp.where(largest > 0, largest, 1))


def _value(V: Callable, times: Array | None, z: Array, x: State) -> jax.Array:
    """V at a state, and at the time coordinate of ``z`` if V depends on time."""
    return jnp.asarray(V(x) if times is None else V(time_of(times, z), x), x.dtype)


def _terms(functions: Functions, times: Array | None, z: Array, x: State) -> tuple[jax.Array, jax.Array]:
    """dV/dt = ∂V/∂t + Σ (∂V/∂x_i) f_i, and the sum of the absolute values of its terms."""
    V, f = functions
    # the terms individually, because they may cancel in the sum, and rounding is relative to the terms
    if times is None:
        parts = jax.grad(lambda x: jnp.asarray(V(x), x.dtype))(x) * jnp.asarray(f(x), x.dtype)
        return jnp.sum(parts), jnp.sum(jnp.abs(parts))
    t = time_of(times, z)
    slope, slopes = jax.grad(lambda t, x: jnp.asarray(V(t, x), x.dtype), argnums=(0, 1))(t, x)
    parts = slopes * jnp.asarray(f(t, x), x.dtype)
    return slope + jnp.sum(parts), jnp.abs(slope) + jnp.sum(jnp.abs(parts))


def _best(measure: Callable[[Array], jax.Array], starts: Array) -> jax.Array:
    """The point of the unit cube where a measure is largest, found by climbing from the best starts."""
    values = jax.vmap(measure)(starts)  # (starts,)
    # top_k ranks NaN highest, and no climb would ever improve on it
    _, order = jax.lax.top_k(jnp.where(jnp.isnan(values), -jnp.inf, values), min(CLIMBS, starts.shape[0]))

    def climb(carry: Climb, _: None) -> tuple[Climb, None]:
        z, best, step = carry
        # steps of a fixed length, because the measures have no common scale for a gradient step
        slope = jax.grad(measure)(z)
        length = jnp.sqrt(jnp.sum(slope * slope))
        moved = jnp.clip(z + step * slope / jnp.where(length > 0, length, 1), 0.0, 1.0)
        there = measure(moved)
        better = there > best
        return (jnp.where(better, moved, z), jnp.where(better, there, best), jnp.where(better, step, step / 2)), None

    def run(z: jax.Array) -> tuple[jax.Array, jax.Array]:
        # the first step is a tenth of the cube; 80 halvings leave 1e-25 of it, so no stopping criterion is needed
        first = (z, measure(z), jnp.asarray(0.1, z.dtype))
        (z, best, _), _ = jax.lax.scan(climb, first, length=STEPS)
        return z, best

    points, heights = jax.vmap(run)(starts[order])
    return points[jnp.argmax(heights)]


def _compare(V: Callable, place: Place, z: Array, x: State) -> tuple[jax.Array, jax.Array, jax.Array]:
    """V − V(x_e) at a point, the rounding error of V, and the largest |V − V(x_e)| on the axes at the same distance."""
    region, rest, times = place
    axes = np.concatenate([np.eye(region.dim), -np.eye(region.dim)])
    here, base = _value(V, times, z, x), _value(V, times, z, rest)
    half = half_widths(region)
    # V elsewhere at this distance shows the size of its terms: 2n points, moved into the region
    distance = jnp.sqrt(jnp.sum(((x - rest) / half) ** 2))
    ring = jax.vmap(lambda y: nearest_inside(region, y))(rest + distance * half * axes)
    around = jax.vmap(lambda y: jnp.abs(_value(V, times, z, y) - base))(ring)
    beside = jnp.max(jnp.where(jnp.isfinite(around), around, 0))
    return here - base, 4 * jnp.finfo(beside.dtype).eps * (beside + jnp.abs(here) + jnp.abs(base)), beside


def _rise(V: Callable, place: Place, z: Array, x: State) -> tuple[jax.Array, jax.Array]:
    """V − V(x_e) as the integral of its slope along the line from x_e, and True if V rises all the way."""
    _, rest, times = place
    # no difference of two values of V, so a large constant in V does not cost any digits
    at, weights = np.polynomial.legendre.leggauss(8)
    slopes = jax.vmap(lambda part: jax.jvp(lambda s: _value(V, times, z, rest + s * (x - rest)), (part,), (1.0,))[1])(
        jnp.asarray((at + 1) / 2)
    )
    return jnp.asarray(weights / 2) @ slopes, jnp.all(slopes >= 0) & jnp.any(slopes > 0)
