"""A search for what contradicts a Lyapunov function.

A function V proves that ẋ = f(t, x) is stable at x_e in a region when there

    V(t, x) > V(t, x_e) for x ≠ x_e,      dV/dt = ∂V/∂t + (∂V/∂x) f ≤ 0

``lyapunov_check`` evaluates both at points spread evenly over the region and its corners, and climbs from the worst of
them. A violation that it returns is one, up to rounding; that it finds none is evidence: a narrow one can be missed.
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
from hjbjax.tracing.closures import settled_function

Functions: TypeAlias = tuple[Callable, Callable]  # V and f, of (x) or of (t, x)
Place: TypeAlias = tuple[Box | Ball, Array, Array | None]  # the region, the equilibrium, and two times if any

CLIMBS = 32  # starts of the local search, for each of the three measures
STEPS = 80  # its steps; a step that does not climb is halved
NEAR = 0.01  # closer to the equilibrium than this part of the region's half widths, V is not compared with zero
FLAT = 1e-9  # of the rise of V elsewhere at this distance: a rise below it may be that of a V that is 0 nearby
ROUNDING = 64  # units of eps of the largest terms of dV/dt in the region, below which their sum has no sign
AT_REST = 1e-8  # of the drift in the region; an equilibrium comes from a root finder or a rounded formula


@pytree_dataclass()
class LyapunovReport:
    """The worst points that a search for a violation found.

    Args:
      positive: whether V > V(x_e) at every point looked at, but x_e itself.
      decreasing: whether dV/dt ≤ 0 at every point looked at, up to rounding.
      worst_state: where dV/dt is largest; where it is never positive, where it is largest relative to its terms.
      worst_time: the time of that, ``None`` without times.
      rate: dV/dt there.
      lowest_state: where V − V(x_e) is smallest relative to |x − x_e|², each state in half widths of the region.
      lowest_time: the time of that, ``None`` without times.
      lowest: V − V(x_e) there.
      evaluations: how many points were looked at.
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
        """Whether no violation was found."""
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
    """dV/dt along ẋ = f, a function of ``(x)``, or of ``(t, x)`` as V and f then are.

    Args:
      V: a function that returns one number.
      f: the closed loop, returns shape (n,).

    Keyword Args:
      time_varying: whether V and f take ``(t, x)``.

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
    """Search a region for a point that contradicts V as a Lyapunov function of ẋ = f, and return the worst.

    Args:
      V: a function that returns one number.
      f: the closed loop, returns shape (n,).
      region: the states to search, a Box or a Ball around the origin.
      times: the interval of times to search, two numbers; V and f then take ``(t, x)``. ``None``: they take ``(x)``.

    Keyword Args:
      equilibrium: x_e, shape (n,); ``None`` is the origin.
      samples: how many points the search starts with.
      tolerance: how much of the terms of dV/dt counts as zero.

    Returns:
      A LyapunovReport, with ``holds``, ``worst_state`` and ``rate``.

    Raises:
      TypeError: a region that is neither Box nor Ball.
      ValueError: a number that is not admissible, an x_e outside of the region or where f is not zero, or V or f
        not finite at a point of the region.

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
    span_of_times = _check_times(times)
    rest = np.zeros(region.dim) if equilibrium is None else np.asarray(equilibrium, np.float64)
    if rest.shape != (region.dim,):
        raise ValueError(f"lyapunov_check: equilibrium has shape {rest.shape}, wanted ({region.dim},)")
    fed = {"x": rest.shape} if times is None else {"t": (), "x": rest.shape}
    checks.function_of(V, "V", (), **fed)
    checks.function_of(f, "f", rest.shape, **fed)
    # float64 whatever the session has: the default tolerance of 1e-9 is below the rounding of float32
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
            "region; give the equilibrium= of this closed loop"
        )
    numbers = {name: found[name].item() for name in ("positive", "decreasing", "rate", "lowest")}
    found |= numbers
    if times is None:
        found |= {"worst_time": None, "lowest_time": None}
    return LyapunovReport(**found, evaluations=len(starts) + 3 * min(CLIMBS, len(starts)) * STEPS)


def _check_inside(region: Box | Ball, rest: np.ndarray) -> None:
    """Refuse an equilibrium outside of the region: nothing near it would be looked at."""
    if not np.all(np.abs(nearest_inside(region, rest) - rest) <= AT_REST * half_widths(region)):
        raise ValueError(f"lyapunov_check: got equilibrium = {rest.tolist()}, wanted a state in {region!r}")


def _check_times(times: Sequence[float] | np.ndarray | None) -> np.ndarray | None:
    """The first and the last time in float64."""
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
    """Points of the unit cube, shape (about samples, dim): a sequence that fills it evenly, and its corners."""
    # Multiples of the powers of 1/φ, φ^(dim + 1) = φ + 1: the golden ratio's sequence, in dim dimensions.
    # The iteration shrinks the error by 0.31 a step or better: after 60 the root has settled to the last bit.
    root = 2.0
    for _ in range(60):
        root = (1 + root) ** (1 / (dim + 1))
    steps = root ** -np.arange(1.0, dim + 1)
    inner = (0.5 + np.arange(1, samples + 1)[:, None] * steps) % 1
    # dV/dt is often worst in a corner, as in the example above; with 12 axes there would be as many as samples, 4096
    return np.concatenate([inner, np.array(list(itertools.product((0.0, 1.0), repeat=dim)))]) if dim <= 10 else inner


@jax.jit
def _search(functions: Functions, place: Place, starts: Array, tolerance: float) -> dict[str, jax.Array | None]:
    """The fields of a LyapunovReport, and ``finite``: whether V and dV/dt are so at all starts."""
    region, rest, times = place
    half = half_widths(region)

    def at(z):
        return state_of(region, times, z)

    def value(z):
        return _value(functions[0], times, z, at(z)[1])

    def rates(z):
        return _terms(functions, times, z, at(z)[1])

    def relative(z):  # dV/dt over the size of its terms
        rate, terms = rates(z)
        # over 1 at the equilibrium, where 0/0 would be NaN, and its slope as well
        return rate / jnp.where(terms > 0, terms, 1)

    def low(z):
        x = at(z)[1]
        square = jnp.sum(((x - rest) / half) ** 2)
        above = value(z) - _value(functions[0], times, z, rest)
        # over the square, a quadratic form's measure of definiteness: V − V(x_e) alone is least at x_e for any good V
        return jnp.where(square > NEAR**2, -above / jnp.where(square > 0, square, 1), -jnp.inf)

    highest, nearest, lowest = (_best(f, starts) for f in (lambda z: rates(z)[0], relative, low))
    rate, terms = rates(highest)
    decreasing = rate <= tolerance * terms
    # A violation may be small where dV/dt is largest in units of V: near the equilibrium everything is. Where all terms
    # vanish at once, as far as f's own rounding allows, their sum has no sign.
    everywhere = jax.vmap(rates)(starts)
    small = ROUNDING * jnp.finfo(starts.dtype).eps * jnp.max(everywhere[1])
    close, its_terms = rates(nearest)
    decreasing &= close <= tolerance * its_terms + small
    # the point in the report is the largest rate where that is a violation, and else the clearest one
    worst = jnp.where((rate > tolerance * terms), highest, nearest)
    above, rounding, around = _compare(functions[0], place, lowest, at(lowest)[1])
    risen, rises = _rise(functions[0], place, lowest, at(lowest)[1])
    # flat beside a large V(x_e), below whose digits it rises; not so where others at this distance rise far more
    hidden = (jnp.abs(above) <= rounding) & rises & (risen > FLAT * around)
    above, rounding = jnp.where(hidden, risen, above), jnp.where(hidden, 0, rounding)
    # a sum of both, to have NaN and infinity of either
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
    """The largest |f_i(x_e)| as a part of the largest |f_i| at the points."""
    rest, (times, states) = place[1], points
    if times is None:
        rates, stay = jax.vmap(f)(states), jnp.asarray(f(rest))[None]
    else:
        rates, stay = jax.vmap(f)(times, states), jax.vmap(lambda t: f(t, rest))(times)
    largest, left = jnp.max(jnp.abs(rates), axis=0), jnp.max(jnp.abs(stay), axis=0)
    return jnp.max(left / jnp.where(largest > 0, largest, 1))


def _value(V: Callable, times: Array | None, z: Array, x: State) -> jax.Array:
    """V at a state, and at the time that ``z`` stands for if V depends on it."""
    return jnp.asarray(V(x) if times is None else V(time_of(times, z), x), x.dtype)


def _terms(functions: Functions, times: Array | None, z: Array, x: State) -> tuple[jax.Array, jax.Array]:
    """dV/dt = ∂V/∂t + Σ (∂V/∂x_i) f_i, and the sum of the absolute values of these terms."""
    V, f = functions
    # the terms one by one: their sum may vanish by cancellation, and rounding is relative to them and not to it
    if times is None:
        parts = jax.grad(lambda x: jnp.asarray(V(x), x.dtype))(x) * jnp.asarray(f(x), x.dtype)
        return jnp.sum(parts), jnp.sum(jnp.abs(parts))
    t = time_of(times, z)
    slope, slopes = jax.grad(lambda t, x: jnp.asarray(V(t, x), x.dtype), argnums=(0, 1))(t, x)
    parts = slopes * jnp.asarray(f(t, x), x.dtype)
    return slope + jnp.sum(parts), jnp.abs(slope) + jnp.sum(jnp.abs(parts))


def _best(measure: Callable[[Array], jax.Array], starts: Array) -> jax.Array:
    """The point of the unit cube where a measure is largest, by climbing from the best starts."""
    values = jax.vmap(measure)(starts)  # (starts,)
    # NaN last: top_k takes it for the largest, and no step of a climb would ever be better
    _, order = jax.lax.top_k(jnp.where(jnp.isnan(values), -jnp.inf, values), min(CLIMBS, starts.shape[0]))

    def climb(carry, _):
        z, best, step = carry
        # a step of given length: the measures have no common scale, and a gradient step would need one
        slope = jax.grad(measure)(z)
        length = jnp.sqrt(jnp.sum(slope * slope))
        moved = jnp.clip(z + step * slope / jnp.where(length > 0, length, 1), 0.0, 1.0)
        there = measure(moved)
        better = there > best
        return (jnp.where(better, moved, z), jnp.where(better, there, best), jnp.where(better, step, step / 2)), None

    def run(z):
        # a tenth of the cube; 80 halvings would make it 1e-25 of that, so a climb ends by itself
        first = (z, measure(z), jnp.asarray(0.1, z.dtype))
        (z, best, _), _ = jax.lax.scan(climb, first, length=STEPS)
        return z, best

    points, heights = jax.vmap(run)(starts[order])
    return points[jnp.argmax(heights)]


def _compare(V: Callable, place: Place, z: Array, x: State) -> tuple[jax.Array, jax.Array, jax.Array]:
    """V − V(x_e) at a point, the rounding of V, and |V − V(x_e)| along the axes as many half widths from x_e."""
    region, rest, times = place
    axes = np.concatenate([np.eye(region.dim), -np.eye(region.dim)])
    here, base = _value(V, times, z, x), _value(V, times, z, rest)
    half = half_widths(region)
    # The terms of V are as large as V is elsewhere at this distance: 2n points, those inside of the region.
    distance = jnp.sqrt(jnp.sum(((x - rest) / half) ** 2))
    ring = jax.vmap(lambda y: nearest_inside(region, y))(rest + distance * half * axes)
    around = jax.vmap(lambda y: jnp.abs(_value(V, times, z, y) - base))(ring)
    beside = jnp.max(jnp.where(jnp.isfinite(around), around, 0))
    return here - base, 4 * jnp.finfo(beside.dtype).eps * (beside + jnp.abs(here) + jnp.abs(base)), beside


def _rise(V: Callable, place: Place, z: Array, x: State) -> tuple[jax.Array, jax.Array]:
    """V − V(x_e) as the integral of its slope along the line from x_e, and whether V rises all the way."""
    _, rest, times = place
    # no difference of two values of V: what is constant in it takes no digits away
    at, weights = np.polynomial.legendre.leggauss(8)
    slopes = jax.vmap(lambda part: jax.jvp(lambda s: _value(V, times, z, rest + s * (x - rest)), (part,), (1.0,))[1])(
        jnp.asarray((at + 1) / 2)
    )
    return jnp.asarray(weights / 2) @ slopes, jnp.all(slopes >= 0) & jnp.any(slopes > 0)
