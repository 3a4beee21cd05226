"""The robust information state on a grid: the states that a deterministic disturbance can explain, and their cost.

For dx/dt = f(x, u) + σw, y = h(x) + rv with unknown w and v in L₂ the information state at time t is

    p(x, t) = sup over x₀ and w leading to x(t) = x of { p₀(x₀) + ∫₀ᵗ [ L(x, u) − ½γ² (|w|² + |r⁻¹(y − h(x))|²) ] ds },

the largest cost of a path that ends in x and explains the measurements, minus what the disturbances pay. It solves

    p_t = max_w { −Dp·(f + σw) − ½γ²|w|² } + L − ½γ² |r⁻¹(y − h)|²,     p(·, 0) = p₀,

the max-plus analogue of the Zakai equation, with maxima instead of sums and sums instead of products. With y and u
constant over a step no splitting is needed, since the measurement term is a source like L. ``max_plus`` describes the
scheme. As γ grows, or if L = 0, the maximum of p is Mortensen's minimum-energy estimate.

For a linear system with cost ½ qᵀx² and p₀ = −½γ²(x − x̂)²/Y, p remains such a parabola plus a constant, and

    dY/dt = 2aY + σ² + (q/γ² − c²/r²) Y²,     dx̂/dt = a x̂ + bu + (qY/γ²) x̂ + (c/r²) Y (y − c x̂).

If γ is too small, Y becomes infinite in finite time. Then no controller attenuates the disturbance that well.
Source: M. R. James, Nonlinear Control Systems, (12.10) and (12.11).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.schemes import Weno5
from hjbjax.filtering import robust_arguments
from hjbjax.filtering.grid_filter import signal, warn_at_ends
from hjbjax.filtering.max_plus import MOST, MaxPlusMarch, refined_maximum
from hjbjax.filtering.measurement import Measurement, check_step, controls_of, measurement, record_of, sample_of
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_jax, cast, front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Control, Field, Nodes, Number, Numbers, State
from hjbjax.tracing import components
from hjbjax.tracing.closures import settled


@pytree_dataclass()
class RobustState:
    """The robust information state along a record, with its largest value.

    Attributes:
      p: the information state at the nodes after every measurement, shape (k, *grid), in the units of cost.
      worst_case: the state where p is largest, refined between the nodes, shape (k, n).
      value: the largest p, shape (k,): the worst cost so far that the record allows, in the units of cost.
      times: the time of each entry, shape (k,); p₀ at time 0 is not included.
    """

    p: Any
    worst_case: Any
    value: Any
    times: Any


@pytree_dataclass(static=("scheme",))
class RobustGridFilter:
    """The robust information state as an observer, whose state is p at the nodes, shape (*grid).

    The estimate is the worst case, the state where p is largest. Periodic axes are wrapped. At the ends of other axes
    nothing flows in, whether they are projected or constrained. Steps of any length are stable: ``update`` makes as
    many inner steps as the velocities require.

    Args:
      problem: f, L and the admissible controls, as in ``hjb.solve``; discount, target and boundary costs are ignored.
      h: the measured quantity, a function of one state that returns shape (p,).
      grid: the nodes.
      initial: p₀, a function of one state or node values (*grid), in the units of cost; defined up to a constant.
      gamma: γ > 0, in √(cost) per size of the disturbances.

    Keyword Args:
      sigma: the gain of w: a number, one per axis (n,), or a matrix (n, k) with σσᵀ diagonal. Default: the noise of
        the problem, or the identity if there is no noise.
      measurement_noise: r: a number, one per measurement (p,), or a matrix (p, p), in the units of h.
      scheme: ``Weno5()``, order 5 where p is smooth; ``Limited()``, order 2; ``Upwind()``, order 1 and monotone.

    Raises:
      ValueError: a number that is not admissible, functions or node values of the wrong shape, p₀ that is not finite,
        a matrix σ whose columns act on several axes, open ends, an opponent or a problem that depends on time.
      TypeError: an argument that is not a Problem, a Grid or a function.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u - x, None, hjb.Box([-1.0], [1.0]))
      >>> observer = RobustGridFilter(plant, lambda x: x, hjb.Grid([-3.0], [3.0], (61,)), lambda x: -x @ x, 2.0)
      >>> seen = jax.jit(observer.update)(observer.initial(), jnp.zeros(1), jnp.array([0.05]), 0.05)
      >>> 0 < float(observer.estimate(seen)[0]) < 1
      True
    """

    problem: Problem
    measurement: Measurement
    grid: Grid
    p0: Any
    gamma: Any
    sigma: Any
    scheme: Scheme

    @front_door
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
        robust_arguments.check_question(problem, grid, scheme)
        arguments.positive(gamma, "robust_filter: gamma")
        measured = measurement(h, grid.ndim, measurement_noise, "robust_filter")
        if not is_traced(measured, grid):
            with own_settings(x64=True), jax.ensure_compile_time_eval():
                signal(Discretisation(problem, grid, scheme, np.dtype(np.float64)), measured, "robust_filter")
        fields = {
            "problem": problem,
            "measurement": measured,
            "grid": grid,
            "p0": robust_arguments.initial_values(initial, grid),
            "gamma": gamma,
            "sigma": robust_arguments.gains(problem, sigma, grid.ndim),
            "scheme": scheme,
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @front_door
    def initial(self) -> Field:
        """p₀ at the nodes, shape (*grid)."""
        return jnp.asarray(self.p0, jnp.result_type(float))

    @front_door
    def update(self, state: Field, u: Control, dy: Array | None, dt: Number) -> Field:
        """p after applying the control u (m,) for dt and measuring y = dy/dt over it, dy (p,), or None."""
        self._check_state(state)
        check_step("RobustGridFilter.update", self.problem, self.measurement.dim, (u, dy, dt))
        dtype = state.dtype
        # compiled even if the caller does not compile: the loop body is a new function, which JAX would compile again
        y = None if dy is None else jnp.asarray(dy, dtype) / dt
        return _after(as_jax(self), state, jnp.asarray(u, dtype), y, dt)[0]

    @front_door
    def estimate(self, state: Field) -> State:
        """The worst case: the state where p is largest, shape (n,), refined between the nodes."""
        self._check_state(state)
        return _largest(state, cast(self.grid, state.dtype))[1]

    def _check_state(self, state: Field) -> None:
        """Refuse the state of another filter or of another grid."""
        if np.shape(state) != self.grid.shape:
            raise ValueError(
                f"RobustGridFilter: the state has shape {np.shape(state)}, wanted {self.grid.shape}: one entry per node"
            )

    @front_door
    def correct(self, state: Field, y: Array, *, measurement_noise: Numbers | Sequence) -> Field:
        """p after a sample y = h(x) + s v, shape (p,), at one time; its error costs ½γ²|v|².

        Args:
          state: p before.
          y: the sample, shape (p,), in the units of h.

        Keyword Args:
          measurement_noise: s, a number, (p,) or (p, p); a sample with an error of s costs ½γ².

        Raises:
          ValueError: a sample or a noise of the wrong shape, or not finite.
        """
        self._check_state(state)
        sampled = sample_of(self.measurement, y, measurement_noise, "RobustGridFilter.correct")
        mine = cast(self, state.dtype)
        return state - mine.gamma**2 / 2 * mine._misfit(sampled, jnp.asarray(y, state.dtype))

    def _misfit(self, measured: Measurement, y: Array) -> Field:
        """|r⁻¹(y − h)|² at the nodes, shape (*grid)."""
        dtype = y.dtype
        on = Discretisation(self.problem, self.grid, self.scheme, dtype)
        seen = components.components(measured.h, on.coordinates(), dtype=dtype)
        errors = [y[k] - at_node for k, at_node in enumerate(seen)]
        whitening = measured.whitened(jnp.eye(len(errors), dtype=dtype))  # r⁻¹
        return sum(sum(row[k] * error for k, error in enumerate(errors)) ** 2 for row in whitening)

    def _after(
        self, p: Field, u: Control, y: Array | None, dt: Number, most: int | None = None
    ) -> tuple[Field, jax.Array]:
        """p after the time dt with constant control and measurement, and the number of inner steps."""
        mine = cast(self, p.dtype)
        on = Discretisation(mine.problem, mine.grid, self.scheme, p.dtype)
        entries = [u[k] for k in range(u.shape[0])]
        misfit = 0.0 if y is None else mine._misfit(mine.measurement, y)
        # the scheme gets the problem without noise: with noise some slopes would be central, which is wrong for p
        bare = dataclasses.replace(on, problem=Problem(mine.problem.drift))
        return MaxPlusMarch(
            bare,
            on.drift(entries),
            [gain**2 / mine.gamma**2 for gain in mine.sigma],
            on.running_cost(entries) - mine.gamma**2 / 2 * misfit,
        ).after(p, dt, most)


_after, _largest = jax.jit(RobustGridFilter._after), jax.jit(refined_maximum)


@front_door
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
    """The robust information state along a record of measurements, equations (12.10) and (12.11), in float64.

    p_t = max_w { −Dp·(f + σw) − ½γ²|w|² } + L − ½γ² |r⁻¹(y − h)|², with control and measurement constant over each
    interval. In space the order is the order of the scheme where p is smooth, and 1 at kinks of p. In time, within an
    interval, it is the number of stages of the scheme, 3 for ``Weno5()``. Intervals of any length are stable. Under
    ``jit`` and ``vmap``, for example over a batch of records, values are not checked and the result has JAX's default
    float type.

    Args:
      problem: f, L and the admissible controls; discount, target and boundary costs are ignored.
      h: the measured quantity, a function of one state that returns shape (p,).
      grid: the nodes. Nothing flows in at an end that is not periodic; open ends are refused.
      y: the record, shape (k, p), in the units of h: the mean of y over each interval, dy/dt.
      dt: the length of an interval, in units of time.
      initial: p₀, a function of one state or node values (*grid), in the units of cost; finite, see below.

    Keyword Args:
      gamma: γ > 0; a smaller γ makes disturbances cheaper.
      controls: the controls that were applied, shape (k, m); required if and only if the problem has controls.
      sigma: the gain of w, as in ``RobustGridFilter``. Default: the noise of the problem, or the identity.
      measurement_noise: r: a number, one per measurement (p,), or a matrix (p, p), in the units of h.
      scheme: the scheme for the slopes.

    Returns:
      A ``RobustState`` with p after each interval, its maximum and the state at the maximum.

    Raises:
      ValueError: a record, controls or functions of the wrong shape; numbers that are not finite or not positive; p₀
        that is −∞ somewhere, since slopes need numbers (for a known state x₀ use a steep −γ²|x − x₀|²/(2Y) with √Y a
        few spacings); and p that becomes infinite because γ is too small for the horizon.
      TypeError: an argument that is not a Problem, a Grid or a function.

    Warns if the worst case is at an end of the box, which happens if γ is close to its minimum.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: -x, lambda x, u: 0.5 * x @ x)
      >>> record = np.full((20, 1), 0.5)
      >>> grid = hjb.Grid([-4.0], [4.0], (81,))
      >>> state = robust_filter(plant, lambda x: x, grid, record, 0.1, lambda x: -2 * x @ x, gamma=2.0)
      >>> state.p.shape, state.worst_case.shape, 0 < float(state.worst_case[-1, 0]) < 0.5
      ((20, 81), (20, 1), True)

    Source: M. R. James, Nonlinear Control Systems, (12.10) and (12.11).
    """
    options: Any = {"sigma": sigma, "measurement_noise": measurement_noise, "scheme": scheme}
    robust_arguments.check_question(problem, grid, scheme)
    # look for changes in the problem's functions at every call, as for h
    asked = settled(Problem(problem.drift, problem.cost, problem.controls, noise=problem.noise), grid.ndim)
    observer = RobustGridFilter(asked, h, grid, initial, gamma, **options)
    if not is_traced(dt):
        arguments.positive(dt, "robust_filter: dt", "in units of time")
    y = record_of(y, "robust_filter: y", observer.measurement.dim, batches=False)
    controls = controls_of(controls, "robust_filter: controls", problem, np.shape(y)[:1])
    if is_traced(asked, observer.measurement, grid, y, dt, observer.p0, gamma, controls, sigma):
        return _transformed(observer, jnp.asarray(y), jnp.asarray(controls), dt)
    # inside a caller's ``jit`` too, a record of known numbers is filtered at once
    with jax.core.eval_context(), own_settings(x64=True):
        found, steps = _scan_compiled(*cast((observer, y, controls, float(dt)), np.float64))
        found = jax.tree.map(np.asarray, found)
    if not np.all(np.isfinite(found.p)):
        first = int(np.argmin(np.all(np.isfinite(found.p.reshape(len(found.p), -1)), axis=1)))
        if steps >= MOST:
            raise ValueError(
                f"robust_filter: dt = {dt:g} needs more than {MOST} inner steps, because the paths cross too many "
                "cells within an interval; use a shorter interval or a coarser grid"
            )
        raise ValueError(
            f"robust_filter: p is not finite from interval {first} on, t = {first * dt:g} to {(first + 1) * dt:g}: the "
            "cost grows faster than the disturbances pay for it; use a larger gamma, a smaller box or a shorter record"
        )
    warn_at_ends("robust_filter", grid, found.worst_case, float(dt), "the worst case")
    return found


def _transformed(observer: RobustGridFilter, y: jax.Array, controls: jax.Array, dt: Any) -> RobustState:
    """The information state under a transformation, with derivatives in forward mode and, if possible, in reverse.

    A loop has a reverse derivative if the number of its steps is known. This is so under ``grad`` without ``jit``:
    counts are integers without a derivative, so they are plain numbers. Under ``jit`` and ``vmap`` they are traced.
    """
    observer = as_jax(observer)
    found, steps = _scan_compiled(observer, y, controls, dt)
    return found if is_traced(steps) else _scan_compiled(observer, y, controls, dt, int(steps))[0]


def _scan(
    observer: RobustGridFilter, y: jax.Array, controls: jax.Array, dt: Any, most: int | None = None
) -> tuple[RobustState, jax.Array]:
    """The information state after every interval, with its maximum, and the largest number of inner steps."""
    grid = observer.grid
    dtype = jnp.result_type(float)

    def step(p: Field, seen: tuple[jax.Array, jax.Array]) -> tuple[Field, tuple[jax.Array, ...]]:
        p, steps = observer._after(p, seen[0].astype(dtype), seen[1].astype(dtype), dt, most)
        value, place = refined_maximum(p, cast(grid, dtype))
        return p, (p, place, value, steps)

    _, (p, place, value, steps) = jax.lax.scan(step, observer.initial(), (controls, y))
    return RobustState(p, place, value, dt * jnp.arange(1, len(y) + 1)), jnp.max(steps)


_scan_compiled = jax.jit(_scan, static_argnums=4)
