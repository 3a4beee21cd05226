"""Output feedback: a plant controlled through an observer of its measurements."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.feedback import GridFeedback, check_kept, is_grid_feedback, lookups
from hjbjax.feedback.loop import Loop
from hjbjax.feedback.path import PathStatus
from hjbjax.filtering.measurement import Measurement, measurement
from hjbjax.filtering.output_loop import (
    CertaintyEquivalence,
    GridObserver,
    Judge,
    Observer,
    OutputLoop,
    OutputPath,
    no_control,
    of_information,
    output_path,
)
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, check_constant_discount
from hjbjax.problem.pytree import altered, as_partial, cast, front_door, is_traced, numbers
from hjbjax.problem.rewards import costs_of
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import with_any_control
from hjbjax.problem.types import Array, Key, Numbers
from hjbjax.solution.status import warn
from hjbjax.tracing import checks, closures

ROUNDING = 1e-9  # relative: a duration of 0.3 is three steps of 0.1
MOST = 10**7  # intervals of a path: 80 MB per state


@front_door
def simulate_output(
    problem: Problem,
    observer: Observer,
    control: GridFeedback | Callable | None,
    *,
    h: Callable,
    x0: Numbers | Sequence,
    duration: float,
    dt: float,
    key: Key | int,
    measurement_noise: Numbers | Sequence = 1.0,
    paths: int | None = None,
    substeps: int = 4,
    grid: Grid | None = None,
) -> OutputPath:
    """Paths of the plant under a control that depends only on the observer's information state.

        dx = f(x, u) dt + σ dw,    dy = h(x) dt + r dv,    u = control(information state)

    The control is held over dt; then the observer receives u, the increment dy and dt, and nothing else. The plant
    makes sub-steps of weak order 1, or order 2 without noise. A path ends in the target of the problem, even if
    ``observer`` and ``control`` do not use the target. If a grid is known, periodic states are wrapped into it before
    they are passed to any function, so h should be periodic too. Computes in float64. Under a tracer (``jit``,
    ``vmap``) it computes in the type of x0, without checks, and has forward derivatives (``jacfwd``).

    Args:
      problem: the plant and its costs or rewards; not a game.
      observer: an ``Observer``, for example ``ExtendedKalman``, ``Luenberger`` or ``GridFilter``.
      control: a function of the observer's state that returns the control, shape (m,), or a Solution or
        ``greedy_feedback``, which is evaluated at the observer's estimate (certainty equivalence). Where a Solution has
        no control, as in its target, the previous control is kept. ``None`` without controls. If the control has a
        method ``judge(path)``, it is called with the result and may warn, as ``minimum_stress`` does.

    Keyword Args:
      h: the measured function of one state, returns shape (p,). It belongs to the plant; the h of the observer may
        differ.
      x0: the state of the plant at t = 0, shape (n,), or (batch, n) with one state per path.
      duration: the length of the paths, in units of time.
      dt: the time between two updates; the last interval may be shorter.
      key: a JAX random key or an integer, or an array of keys, shape (batch,), one per path.
      measurement_noise: r: a number, (p,) or (p, p); 0 for a measurement without noise.
      paths: the number of paths to make from one key; ``None`` for one path without a batch axis.
      substeps: steps of the plant between two updates.
      grid: the grid whose periodic axes are wrapped. Default: the grid of the Solution or of the observer, if any.

    Returns:
      An ``OutputPath``. Paths that end early, except in the target, cause a warning and have a ``code`` that says why.

    Raises:
      ValueError: an argument that is not admissible, or a function that returns the wrong shape.
      TypeError: an observer without one of its three methods, a control that cannot be called.

    Example:
      >>> from hjbjax.filtering.observers import ExtendedKalman
      >>> problem = Problem(lambda x, u: x, lambda x, u: x @ x, noise=0.1)
      >>> observer = ExtendedKalman(problem, lambda x: x, [0.0], [1.0], measurement_noise=0.1)
      >>> path = simulate_output(
      ...     problem, observer, None, h=lambda x: x, x0=[1.0], duration=1.0, dt=0.1, key=0, measurement_noise=0.1
      ... )
      >>> path.times.shape, path.estimates.shape, bool(abs(path.estimates - path.states)[-1] < 0.5)
      ((11,), (11, 1), True)
    """
    times = _times(duration, dt)
    start = _initial_states(x0)
    n = np.shape(start)[-1]
    measured = measurement(h, n, measurement_noise, "simulate_output", perfect=True)
    keys = _keys(key, paths, np.shape(start)[:-1])
    arguments.count(substeps, "simulate_output: substeps")
    plant = _plant(problem, observer, n)
    loop = _closed(plant, observer, control, measured, _box(grid, control, observer, n), float(times[-1]))
    if is_traced(loop, start, keys) or _sees_tracers(loop):
        start = jnp.asarray(start)
        return _paths(loop, start, jnp.asarray(times, start.dtype), keys, substeps)
    with jax.core.eval_context(), own_settings(x64=True):
        loop = cast(loop, np.float64)
        _check_shapes(loop, np.zeros(n))
        path = _jit_paths(loop, start, times, keys, substeps)
        path = jax.tree.map(np.asarray, path)
    _report(path)
    if isinstance(control, Judge):
        control.judge(path)
    return path


def _paths(loop: OutputLoop, x0: Array, times: Array, keys: Key, substeps: int) -> OutputPath:
    """One path, or one for each of a batch of starts or keys."""

    def one(x0: Array, key: Key) -> OutputPath:
        return output_path(loop, x0, times, key, substeps=substeps)

    axes = (0 if jnp.ndim(x0) == 2 else None, 0 if _count(keys) else None)
    return one(x0, keys) if axes == (None, None) else jax.vmap(one, axes)(x0, keys)


_jit_paths = jax.jit(_paths, static_argnums=4)


def _sees_tracers(loop: OutputLoop) -> bool:
    """True if the control closes over traced numbers, for example a gain that is being differentiated."""
    m = 0 if loop.plant.problem.controls is None else loop.plant.problem.controls.dim
    try:
        closed = jax.make_jaxpr(lambda u: loop.control(jnp.zeros(()), loop.initial(), u))(jnp.zeros(m))
    except (TypeError, ValueError):  # the checks report the reason later
        return False
    return is_traced(closed.consts)


def _times(duration: float, dt: float) -> np.ndarray:
    """The times of the updates, shape (k+1,)."""
    end = float(arguments.positive(duration, "simulate_output: duration", "in units of time"))
    step = float(arguments.positive(dt, "simulate_output: dt", "the time between two updates"))
    wanted = max(1.0, end / step * (1 - ROUNDING))
    if wanted > MOST:
        raise ValueError(f"simulate_output: dt = {dt} makes {wanted:.3g} intervals of {duration:g}, wanted at most 1e7")
    return np.append(np.arange(int(np.ceil(wanted))) * step, end)


def _initial_states(x0: object) -> Any:
    """x0 as an array (n,) or (batch, n)."""
    state = jnp.asarray(x0) if is_traced(x0) else numbers(x0, "simulate_output: x0")
    if np.ndim(state) not in (1, 2) or 0 in np.shape(state):
        raise ValueError(f"simulate_output: x0 has shape {np.shape(state)}, wanted (n,), or (batch, n), one per path")
    if not is_traced(state) and not np.all(np.isfinite(state)):
        raise ValueError(f"simulate_output: x0 is {arguments.shown(x0)}, wanted finite numbers")
    return state


def _count(keys: Key) -> int:
    """The length of an array of keys; 0 for one key."""
    return sum(arguments.keys_shape(keys))


def _keys(given: Any, paths: int | None, batch: tuple[int, ...]) -> Key:
    """One key, or one key per path."""
    key = arguments.random_key(given, "simulate_output: key", batch=True)
    count = _count(key)
    if paths is not None:
        if count:
            raise ValueError(f"simulate_output: got {count} keys and paths = {paths}; leave out one of them")
        count = arguments.count(paths, "simulate_output: paths")
    if batch and count not in (0, batch[0]):
        raise ValueError(f"simulate_output: got {batch[0]} states and {count} paths, wanted the same number of both")
    wanted = count or (batch[0] if batch else 0)  # each initial state gets its own key
    return key if _count(key) or not wanted else jax.random.split(key, wanted)


def _plant(problem: Problem, observer: Observer, n: int) -> Problem:
    """Check that a problem is a plant of n states with an observer; return it with its functions as they are now."""
    if not isinstance(problem, Problem):
        raise TypeError(f"simulate_output: got {type(problem).__name__}, wanted a Problem")
    if problem.is_game or problem.running_max is not None:
        what = "disturbances" if problem.is_game else "a running_max"
        fix = "use noise instead" if problem.is_game else "leave it out, and take the maximum along path.states"
        raise ValueError(f"simulate_output: got a problem with {what}, wanted one player and a running cost; {fix}")
    check_constant_discount(problem, "simulate_output")
    missing = [name for name in ("initial", "update", "estimate") if not callable(getattr(observer, name, None))]
    if missing:
        raise TypeError(
            f"simulate_output: the observer is a {type(observer).__name__} without {' and '.join(missing)}, wanted an "
            "Observer, with initial(), update(state, u, dy, dt) and estimate(state)"
        )
    problem = closures.settled(with_any_control(costs_of(problem), n), n)
    checks.of_one_state(problem, n, "the number of states in x0")
    return problem


def _box(grid: Grid | None, control: Any, observer: Observer, n: int) -> Grid | None:
    """The grid that defines the periodic states: the argument, or the grid of the feedback or the observer."""
    if grid is None and is_grid_feedback(control):
        grid = control.grid
    if grid is None and isinstance(observer, GridObserver):
        grid = observer.grid
    if grid is not None and not (isinstance(grid, Grid) and grid.ndim == n):
        raise ValueError(f"simulate_output: grid is {arguments.shown(grid)}, wanted a Grid of {n} axes, as x0 has")
    return grid


def _closed(
    problem: Problem, observer: Observer, control: Any, measured: Measurement, grid: Grid | None, duration: float
) -> OutputLoop:
    """The loop through an observer and a function, or a feedback at its estimate."""
    # the numbers of a pytree become leaves of its bound methods; the numbers of another object are compiled in
    initial, update, estimate = (_method(observer, name) for name in ("initial", "update", "estimate"))
    acts: Any
    if problem.controls is None:
        if control is not None:
            raise ValueError("simulate_output: got a control, but problem.controls is None; give an admissible set")
        acts = jax.tree_util.Partial(no_control)
    elif is_grid_feedback(control):
        if control.times is not None:
            problem = _within_horizon(problem, control, duration)
        acts = CertaintyEquivalence(estimate, lookups(control)[0], control.grid)
    elif callable(control):
        acts = jax.tree_util.Partial(of_information, as_partial(control))
    else:
        raise TypeError(
            f"simulate_output: control is {arguments.shown(control)}, wanted a function of the observer's state, or a "
            "Solution, which is evaluated at its estimate"
        )
    return OutputLoop(Loop(problem, None, None, grid, clamp=True), measured, initial, update, estimate, acts)


def _method(observer: Observer, name: str) -> jax.tree_util.Partial:
    """One of the observer's functions as a pytree."""
    function = as_partial(getattr(observer, name))
    assert function is not None
    return function


def _within_horizon(problem: Problem, solution: GridFeedback, duration: float) -> Problem:
    """The problem under a marched feedback, without its terminal cost if the path ends before the horizon."""
    horizon = check_kept(solution, duration, "simulate_output: duration")
    return altered(problem, terminal_cost=None) if duration < horizon * (1 - ROUNDING) else problem


def _check_shapes(loop: OutputLoop, x0: np.ndarray) -> None:
    """Trace observer and control once, abstractly, and compare the shapes they return with the required shapes."""
    m = 0 if loop.plant.problem.controls is None else loop.plant.problem.controls.dim
    u, dy, dt = np.zeros(m), np.zeros(loop.measurement.dim), np.zeros(())
    information = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, loop.initial()))
    try:
        # passed as arguments rather than closed over, because an observer would check concrete values
        told = jax.eval_shape(lambda *seen: jax.tree.map(jnp.asarray, loop.update(loop.initial(), *seen)), u, dy, dt)
    except (TypeError, ValueError) as error:
        said = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ValueError(
            f"simulate_output: the observer does not take a control of shape {u.shape} and an increment of shape "
            f"{dy.shape}, which problem and h have: {said[:400]}"
        ) from error
    forms: list[Any] = [jax.tree.structure(each) for each in (information, told)]
    before, after = ([leaf.shape for leaf in jax.tree.leaves(each)] for each in (information, told))
    if forms[0] != forms[1] or before != after:
        raise ValueError(
            f"simulate_output: update(state, u, dy, dt) returned a pytree of arrays of shapes {after}, wanted the one "
            f"that initial() returns, {before}: {arguments.shown(forms[0])}"
        )
    for name, found, wanted in (
        ("the observer's estimate", jax.eval_shape(lambda: jnp.asarray(loop.estimate(loop.initial()))), x0.shape),
        ("control", jax.eval_shape(lambda: loop.control(0.0, loop.initial(), u)), (m,)),
    ):
        if found.shape != wanted:
            raise ValueError(f"simulate_output: {name} has shape {found.shape}, wanted {wanted}")


def _report(path: OutputPath) -> None:
    """Warn about paths that end early, except in the target."""
    codes = np.atleast_1d(path.code)
    for code in np.unique(codes):
        status = PathStatus(int(code))
        if status not in (PathStatus.DURATION, PathStatus.TARGET):
            ends = np.atleast_2d(path.times)[codes == code, -1]
            many = f"{ends.size} of {codes.size} paths" if codes.size > 1 else "the path"
            message = ADVICE[status]
            warn(f"simulate_output: {many} {message}; the first at t = {ends.min():.6g}", UserWarning)


ADVICE = {
    PathStatus.NONFINITE: "stopped before a state or estimate that is not finite; try a shorter dt or more substeps",
    PathStatus.UNDEFINED: "stopped where the control is not finite",
}
