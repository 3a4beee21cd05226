"""The robust information state on a grid: which states a deterministic disturbance can explain, and at what cost.

For dx/dt = f(x, u) + σw, y = h(x) + rv with unknown w and v in L₂ the information state at time t is

    p(x, t) = sup over x₀ and w leading to x(t) = x of { p₀(x₀) + ∫₀ᵗ [ L(x, u) − ½γ² (|w|² + |r⁻¹(y − h(x))|²) ] ds },

the largest cost of a path that ends in x and explains what was seen, less what the disturbances pay. It solves

    p_t = max_w { −Dp·(f + σw) − ½γ²|w|² } + L − ½γ² |r⁻¹(y − h)|²,     p(·, 0) = p₀,

the max-plus twin of the Zakai equation: sums are maxima, products are sums. With y and u held over a step no splitting
is needed, since what a measurement costs is a source like L: see ``max_plus`` for the scheme. As γ grows, or with
L = 0, the largest p belongs to Mortensen's minimum-energy estimate.

For a linear system with cost ½ qᵀx² and p₀ = −½γ²(x − x̂)²/Y, p stays such a parabola plus a constant, and

    dY/dt = 2aY + σ² + (q/γ² − c²/r²) Y²,     dx̂/dt = a x̂ + bu + (qY/γ²) x̂ + (c/r²) Y (y − c x̂),

so that a small γ lets Y escape to infinity in finite time: then no controller attenuates that well.
Source: M. R. James, Nonlinear Control Systems, (12.10) and (12.11).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import schemes
from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.schemes import Weno5
from hjbjax.filtering.max_plus import MaxPlusMarch, refined_maximum
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, cast, is_traced, numbers, pytree_dataclass
from hjbjax.problem.types import Array, Control, Field, Nodes, Number, Numbers, State
from hjbjax.tracing import checks, components


@pytree_dataclass()
class RobustState:
    """The robust information state along a record, with its largest value.

    Attributes:
      p: the information state at the nodes after every measurement, shape (k, *grid), in the units of cost.
      worst_case: the state where p is largest, refined between the nodes, shape (k, n).
      value: the largest p, shape (k,): the worst cost so far that the record admits, in the units of cost.
      times: the times at which these hold, shape (k,); p₀ at time 0 is not among them.
    """

    p: Any
    worst_case: Any
    value: Any
    times: Any


@pytree_dataclass(static=("scheme",))
class RobustGridFilter:
    """The robust information state as an observer: its state is p at the nodes, shape (*grid).

    The estimate is the worst case, the state where p is largest. Periodic axes are wrapped; at the ends of the others
    nothing flows in, be they projected or constrained. Steps of any length are stable: ``update`` makes as many inner
    ones as the velocities want.

    Args:
      problem: f, L and the admissible controls, as in ``hjb.solve``; discount, target and costs at the end are not read.
      h: the measured quantity, a function of one state that returns shape (p,).
      grid: the nodes.
      initial: p₀, a function of one state or node values (*grid), in the units of cost; defined up to a constant.
      gamma: γ > 0, in √(cost) over the size of the disturbances.

    Keyword Args:
      sigma: the gain of w: a number, one an axis (n,), or a matrix (n, k) with σσᵀ diagonal. ``None``: the noise of the
        problem, and without noise the identity.
      measurement_noise: r, a number or one a measurement (p,), in the units of h.
      scheme: slopes: ``Weno5()``, fifth order where p is smooth; ``Limited()``, second; ``Upwind()``, first, monotone.

    Raises:
      ValueError: a number that is not admissible, functions or node values of the wrong shape, p₀ that is not finite,
        a matrix σ whose columns act on several axes, open ends, an opponent or a problem that depends on time.
      TypeError: something else than a Problem, a Grid or a function.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u - x, None, hjb.Box([-1.0], [1.0]))
      >>> observer = RobustGridFilter(plant, lambda x: x, hjb.Grid([-3.0], [3.0], (61,)), lambda x: -x @ x, 2.0)
      >>> seen = jax.jit(observer.update)(observer.initial(), jnp.zeros(1), jnp.array([0.05]), 0.05)
      >>> 0 < float(observer.estimate(seen)[0]) < 1
      True
    """

    problem: Problem
    h: Any
    grid: Grid
    p0: Any
    gamma: Any
    sigma: Any
    measurement_noise: Any
    scheme: Scheme

    def __init__(
        self,
        problem: Problem,
        h: Callable,
        grid: Grid,
        initial: Callable | Nodes,
        gamma: Number,
        *,
        sigma: Numbers | Sequence | None = None,
        measurement_noise: Numbers | Sequence = 1.0,
        scheme: Scheme = Weno5(),
    ):
        _check_question(problem, grid, scheme)
        h = as_partial(h, "robust_filter: h")
        arguments.positive(gamma, "robust_filter: gamma")
        count = _measurements(h, grid.ndim)
        fields = {
            "problem": problem,
            "h": h,
            "grid": grid,
            "p0": _initial(initial, grid),
            "gamma": gamma,
            "sigma": _gains(problem, sigma, grid.ndim),
            "measurement_noise": _spread(measurement_noise, count),
            "scheme": scheme,
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def initial(self) -> Field:
        """p₀ at the nodes, shape (*grid)."""
        return jnp.asarray(self.p0, jnp.result_type(float))

    def update(self, state: Field, u: Control, dy: Array, dt: Number) -> Field:
        """p after holding the control u, shape (m,), for a time dt, over which y = dy/dt was seen, dy (p,)."""
        dtype = state.dtype
        return self._after(state, jnp.asarray(u, dtype), jnp.asarray(dy, dtype) / dt, dt)

    def estimate(self, state: Field) -> State:
        """The worst case: the state where p is largest, shape (n,), refined between the nodes."""
        return refined_maximum(state, cast(self.grid, state.dtype))[1]

    def _after(self, p: Field, u: Control, y: Array, dt: Number) -> Field:
        """p a time dt later, with control and measurement held."""
        mine = cast(self, p.dtype)
        on = Discretisation(mine.problem, mine.grid, self.scheme, p.dtype)
        entries = [u[k] for k in range(u.shape[0])]
        seen = components.components(mine.h, on.coordinates(), dtype=p.dtype)
        misfit: Any = 0.0
        for k, at_node in enumerate(seen):
            misfit = misfit + ((y[k] - at_node) / mine.measurement_noise[k]) ** 2
        # slopes alone are asked of the scheme: noise would make some of them central, which suits no first-order equation
        bare = dataclasses.replace(on, problem=Problem(mine.problem.drift))
        return MaxPlusMarch(
            bare,
            on.drift(entries),
            [gain**2 / mine.gamma**2 for gain in mine.sigma],
            on.running_cost(entries) - mine.gamma**2 / 2 * misfit,
        ).after(p, dt)


def robust_filter(
    problem: Problem,
    h: Callable,
    grid: Grid,
    y: Numbers | Sequence,
    dt: float,
    initial: Callable | Nodes,
    *,
    gamma: Number,
    controls: Numbers | Sequence | None = None,
    sigma: Numbers | Sequence | None = None,
    measurement_noise: Numbers | Sequence = 1.0,
    scheme: Scheme = Weno5(),
) -> RobustState:
    """The robust information state along a record of measurements, (12.10) and (12.11) of the chapter, in float64.

    p_t = max_w { −Dp·(f + σw) − ½γ²|w|² } + L − ½γ² |r⁻¹(y − h)|², with control and measurement held over each interval.
    In space of the order of the scheme where p is smooth, at its kinks of first order; in time of order 3 inside an
    interval; stable for intervals of any length. Under ``jit`` and ``vmap``, as over a batch of records, no values are
    checked, and the answer has the type of the arrays that JAX is set to.

    Args:
      problem: f, L and the admissible controls; discount, target and costs at the end are not read.
      h: the measured quantity, a function of one state that returns shape (p,).
      grid: the nodes. At an end that is not periodic nothing flows in; open ends are refused.
      y: the record, shape (k, p), in the units of h: y over each interval, as its mean or dy/dt.
      dt: the length of an interval, in units of time.
      initial: p₀, a function of one state or node values (*grid), in the units of cost; finite, see below.

    Keyword Args:
      gamma: γ > 0: a smaller one gives the disturbances more room.
      controls: the controls that were held, shape (k, m); wanted exactly when the problem has controls.
      sigma: the gain of w, as in ``RobustGridFilter``; ``None``: the noise of the problem, else the identity.
      measurement_noise: r, a number or one a measurement (p,), in the units of h.
      scheme: how slopes are made.

    Returns:
      A ``RobustState``: p after each interval, where it is largest, and how large.

    Raises:
      ValueError: a record, controls or functions of the wrong shape, numbers that are not finite or not positive; p₀
        that is −∞ somewhere, since slopes need numbers: a known state x₀ is a steep −γ²|x − x₀|²/(2Y) with Y from a few
        spacings squared on; and p that becomes infinite, where γ is too small for the horizon.
      TypeError: something else than a Problem, a Grid or a function.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: -x, lambda x, u: 0.5 * x @ x)
      >>> record = np.full((20, 1), 0.5)
      >>> state = robust_filter(plant, lambda x: x, hjb.Grid([-4.0], [4.0], (81,)), record, 0.1, lambda x: -2 * x @ x, gamma=2.0)
      >>> state.p.shape, state.worst_case.shape, 0 < float(state.worst_case[-1, 0]) < 0.5
      ((20, 81), (20, 1), True)

    Source: M. R. James, Nonlinear Control Systems, (12.10) and (12.11).
    """
    options: Any = {"sigma": sigma, "measurement_noise": measurement_noise, "scheme": scheme}
    observer = RobustGridFilter(problem, h, grid, initial, gamma, **options)
    if not is_traced(dt):
        arguments.positive(dt, "robust_filter: dt", "in units of time")
    y, controls = _record(y, len(np.atleast_1d(observer.measurement_noise))), _controls(problem, controls, np.shape(y))
    if is_traced(problem, h, grid, y, dt, observer.p0, gamma, controls, sigma, measurement_noise):
        return _scan(observer, jnp.asarray(y), jnp.asarray(controls), dt)
    with jax.enable_x64(True):
        found = _scan_compiled(*cast((observer, y, controls, float(dt)), np.float64))
        found = jax.tree.map(np.asarray, found)
    if not np.all(np.isfinite(found.p)):
        first = int(np.argmin(np.all(np.isfinite(found.p.reshape(len(y), -1)), axis=1)))
        raise ValueError(
            f"robust_filter: p is not finite from interval {first} on, t = {first * dt:g} to {(first + 1) * dt:g}: the "
            "cost grows faster than the disturbances pay for it; take a larger gamma, a smaller box or a shorter record"
        )
    return found


def _scan(observer: RobustGridFilter, y: jax.Array, controls: jax.Array, dt: Any) -> RobustState:
    """The information state after every interval, with its maximum."""
    grid = observer.grid
    dtype = jnp.result_type(float)

    def step(p, seen):
        p = observer._after(p, seen[0].astype(dtype), seen[1].astype(dtype), dt)
        value, place = refined_maximum(p, cast(grid, dtype))
        return p, (p, place, value)

    _, (p, place, value) = jax.lax.scan(step, observer.initial(), (controls, y))
    return RobustState(p, place, value, dt * jnp.arange(1, len(y) + 1))


_scan_compiled = jax.jit(_scan)


def _check_question(problem: object, grid: object, scheme: Any) -> None:
    """Refuse what has no robust information state on a grid."""
    if not isinstance(problem, Problem) or not isinstance(grid, Grid):
        raise TypeError(f"robust_filter: got {type(problem).__name__}, {type(grid).__name__}; wanted a Problem and a Grid")
    if problem.is_game or problem.time_dependent:
        what = "an opponent" if problem.is_game else "functions that depend on time"
        raise ValueError(
            f"robust_filter: got a problem with {what}, wanted drift (x, u) and cost (x, u): the disturbance of the filter "
            "is w, which pays ½γ²|w|²; leave the other out"
        )
    if grid.sides("open"):
        raise ValueError(
            "robust_filter: got a grid with open ends, through which p would flow in from where nothing is known; choose "
            "edges='projected' or 'constrained'"
        )
    schemes.check(scheme, "robust_filter: scheme", grid)
    checks.of_one_state(Problem(problem.drift, problem.cost, problem.controls), grid.ndim, "the number of axes of the grid")
    for axis, count in enumerate(grid.shape):
        if count < scheme.points:
            raise ValueError(
                f"robust_filter: axis {axis} has {count} points; {type(scheme).__name__} needs at least {scheme.points}"
            )


def _measurements(h: Callable, n: int) -> int:
    """The number of measurements p, by a trace of h on one state."""
    with jax.enable_x64(True):
        shape = jax.eval_shape(h, jax.ShapeDtypeStruct((n,), np.float64)).shape
    if len(shape) != 1 or shape[0] == 0:
        raise ValueError(f"robust_filter: h returns shape {shape}, wanted (p,): one number a measurement, as in x[:1]")
    return shape[0]


def _initial(initial: Any, grid: Grid) -> Any:
    """p₀ at the nodes, refused where it is not finite."""
    if callable(initial):
        with jax.enable_x64(True):
            x = cast(grid, np.float64).components(np.float64)
            values = components.scalar(as_partial(initial), x, dtype=np.dtype(np.float64))
            values = jnp.broadcast_to(values, grid.shape)
            values = values if is_traced(values) else np.asarray(values)
    else:
        values = numbers(initial, "robust_filter: initial")
    if np.shape(values) != grid.shape:
        raise ValueError(f"robust_filter: initial has shape {np.shape(values)}, wanted {grid.shape}: one number a node")
    if not is_traced(values) and not np.all(np.isfinite(values)):
        bad = np.asarray(values)[~np.isfinite(values)][0]
        raise ValueError(
            f"robust_filter: initial is {bad} at some node, wanted finite numbers: slopes are made of differences; for a "
            "state known to lie in a set take a steep −γ² dist²/(2Y) outside, with √Y a few spacings"
        )
    return values


def _gains(problem: Problem, sigma: Any, n: int) -> Any:
    """The square roots of diag σσᵀ, shape (n,)."""
    given = problem.noise if sigma is None else sigma
    if callable(given):
        raise ValueError(
            "robust_filter: got a noise that is a function of the state, wanted numbers; give sigma=, a number, (n,) or "
            "(n, k)"
        )
    array: Any = numbers(1.0 if given is None else given, "robust_filter: sigma")
    if array.ndim > 2 or (array.ndim and array.shape[0] != n):
        raise ValueError(f"robust_filter: sigma has shape {array.shape}, wanted (), ({n},) or ({n}, k)")
    if is_traced(array):
        if array.ndim == 2:
            raise ValueError("robust_filter: inside a transformation sigma must be a number or one an axis, (n,)")
        return jnp.broadcast_to(array, (n,))
    if not np.all(np.isfinite(array)) or (array.ndim < 2 and np.any(array < 0)):
        raise ValueError(f"robust_filter: sigma = {arguments.shown(array.tolist())}; wanted finite numbers ≥ 0")
    if array.ndim < 2:
        return np.broadcast_to(array, (n,)).copy()
    a = array @ array.T
    size = np.sqrt(np.outer(np.diag(a), np.diag(a)))
    if np.any(np.abs(a - np.diag(np.diag(a))) > 16 * np.finfo(float).eps * size):
        raise ValueError(
            f"robust_filter: sigma = {arguments.shown(array.tolist())} has σσᵀ = {arguments.shown(a.tolist())}, wanted a "
            "diagonal one: each column of σ acts on one axis; turn the state's axes so that it does"
        )
    return np.sqrt(np.diag(a))


def _spread(noise: Any, count: int) -> Any:
    """r for each of the measurements, shape (p,)."""
    array: Any = numbers(noise, "robust_filter: measurement_noise")
    if array.ndim > 1 or (array.ndim == 1 and array.shape != (count,)):
        raise ValueError(f"robust_filter: measurement_noise has shape {array.shape}, wanted () or ({count},)")
    if is_traced(array):
        return jnp.broadcast_to(array, (count,))
    if not np.all(np.isfinite(array) & (array > 0)):
        raise ValueError(f"robust_filter: measurement_noise = {array.tolist()}; wanted finite numbers > 0, as h is measured")
    return np.broadcast_to(array, (count,)).copy()


def _record(y: Any, count: int) -> Any:
    """The record, shape (k, p), of finite numbers."""
    array = numbers(y, "robust_filter: y")
    if array.ndim != 2 or array.shape[0] == 0 or array.shape[1] != count:
        raise ValueError(
            f"robust_filter: y has shape {array.shape}, wanted (k, {count}): one row an interval, one column a component "
            "of h"
        )
    if not is_traced(array) and not np.all(np.isfinite(array)):
        row = int(np.argmin(np.all(np.isfinite(array), axis=1)))
        raise ValueError(
            f"robust_filter: y[{row}] = {array[row].tolist()}, wanted finite numbers; an interval without a measurement "
            "is one of its own, with measurement_noise large"
        )
    return array


def _controls(problem: Problem, controls: Any, record: tuple) -> Any:
    """The controls of every interval, shape (k, m), m = 0 where the problem has none."""
    dim = 0 if problem.controls is None else problem.controls.dim
    if controls is None and dim == 0:
        return np.zeros((record[0], 0))
    array = np.zeros(()) if controls is None else numbers(controls, "robust_filter: controls")
    if array.shape != (record[0], dim):
        got = "none" if controls is None else f"shape {array.shape}"
        raise ValueError(f"robust_filter: got controls {got}, wanted ({record[0]}, {dim}): one row an interval")
    if not is_traced(array) and not np.all(np.isfinite(array)):
        raise ValueError("robust_filter: controls hold numbers that are not finite")
    return array
