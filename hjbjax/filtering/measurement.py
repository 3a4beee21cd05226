"""Measurements dy = h(x) dt + r dv of a state, and checks of the plant and the data of a filter.

Records are increments dy over steps of length dt, or samples y = h(x) + s v at single times. A sensor that is sampled
once per step is also the case dy = y dt with r² = s² dt.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem import arguments, sets
from hjbjax.problem.mode_axis import refuse_modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import is_traced, numbers, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, Numbers, State
from hjbjax.tracing import checks, closures, indices

ROUNDINGS = 16  # units of eps: a matrix r with rows this close to linearly dependent counts as singular


@pytree_dataclass()
class Measurement:
    """The measured function and the strength of its noise, dy = h(x) dt + r dv.

    Args:
      h: a function of one state, returns shape (p,).
      root: r, shape (p, p), in units of y times time^½.
    """

    h: jax.tree_util.Partial
    root: Any

    @property
    def dim(self) -> int:
        """The number p of measured quantities."""
        return np.shape(self.root)[-1]

    def at(self, x: State) -> jax.Array:
        """h(x) in the type of the state, shape (p,)."""
        return jnp.asarray(self.h(x), x.dtype)

    def whitened(self, y: Array) -> jax.Array:
        """r⁻¹ y for y of shape (p, ...): the measurement in units in which its noise is 1."""
        return jnp.linalg.solve(jnp.asarray(self.root, jnp.result_type(y)), y)


def measurement(h: Callable, n: int, noise: Numbers | Sequence, name: str, *, perfect: bool = False) -> Measurement:
    """The measurement of h with noise r, after checks of both.

    Args:
      h: a function of one state of n numbers, returns shape (p,).
      n: the number of states.
      noise: r, a number, one per entry of y, or a matrix (p, p).
      name: the function the user called, for messages.
      perfect: True if r = 0 is allowed, a measurement without noise.

    Raises:
      ValueError: a result of another shape, noise that is not positive, or code that JAX cannot trace.
      TypeError: an h that cannot be called, noise that is not a number.
    """
    if not callable(h):
        raise TypeError(f"{name}: h is {h!r}, wanted a function of one state, (x) -> (p,)")
    # handled like a problem's function: changed numbers in its closure are noticed, and traced ones become leaves
    function = closures.settled(Problem(_rest, target=h), n).target
    try:
        with own_settings(x64=True):
            closed, found = jax.make_jaxpr(function, return_shape=True)(jax.ShapeDtypeStruct((n,), np.float64))
    except Exception as error:
        said = checks.refusal(error, "h(x)", {"x": (n,)})
        if said is None:  # an exception from the user's code
            raise
        raise ValueError(f"{name}: {said}") from error
    shape = getattr(found, "shape", None)
    if shape is None or len(shape) != 1 or shape[0] == 0 or not jnp.issubdtype(found.dtype, jnp.floating):
        got = f"a {type(found).__name__}" if shape is None else f"{found.dtype} numbers of shape {shape}"
        raise ValueError(
            f"{name}: h(x) returned {got}, wanted floating-point numbers of shape (p,), one entry per measured "
            "quantity: x[:1] for the first state, jnp.stack([...]) for several"
        )
    outside = indices.first_outside(closed, ("x",))
    if outside is not None:
        raise ValueError(f"{name}: h(x) reads {outside}.\nJAX would silently use the nearest entry, or none.")
    return Measurement(function, _root(noise, shape[0], name, perfect))


def sample_of(known: Measurement, y: Array, noise: Numbers | Sequence, name: str) -> Measurement:
    """The measurement of a sample y = h(x) + s v, with s instead of r.

    Args:
      known: the measurement whose h is sampled.
      y: the sample, shape (p,).
      noise: s, a number, (p,) or (p, p), in the units of h.
      name: the method the user called, for messages.
    """
    check_vector(y, f"{name}: y", known.dim, "the sample, one entry per measured quantity")
    return Measurement(known.h, _root(noise, known.dim, name, perfect=False))


def _root(noise: Numbers | Sequence, p: int, name: str, perfect: bool) -> Any:
    """r as a matrix, shape (p, p)."""
    given = numbers(noise, f"{name}: measurement_noise")
    if np.shape(given) not in ((), (p,), (p, p)):
        raise ValueError(
            f"{name}: measurement_noise has shape {np.shape(given)}, wanted a number, ({p},) or ({p}, {p}): h(x) has "
            f"shape ({p},)"
        )
    xp: Any = jnp if is_traced(given) else np
    root = given if np.ndim(given) == 2 else xp.diag(xp.broadcast_to(given, (p,)))
    if is_traced(root) or (perfect and not np.any(root)):
        return root
    size = np.linalg.norm(root, axis=1, keepdims=True)  # the rows may have different units
    sound = bool(np.all(np.isfinite(root)) and np.all(size > 0) and (np.ndim(given) == 2 or np.all(np.diag(root) > 0)))
    if not sound or np.linalg.svd(root / size, compute_uv=False)[-1] <= ROUNDINGS * p * np.finfo(np.float64).eps:
        wanted = "finite numbers > 0" if np.ndim(given) < 2 else "a finite matrix with an inverse"
        raise ValueError(
            f"{name}: got measurement_noise = {noise!r}, wanted {wanted}: it is r in dy = h(x) dt + r dv, and the "
            "likelihood divides by it. Use a small r for a sensor that is nearly exact."
        )
    return root


def plant(problem: Problem, n: int, name: str) -> Problem:
    """The drift, controls and noise of a problem, the parts that a filter uses.

    Args:
      problem: the problem.
      n: the number of states.
      name: the function the user called, for messages.

    Raises:
      TypeError: an argument that is not a Problem.
      ValueError: a game, a problem that depends on time, or functions that do not fit n states.
    """
    if not isinstance(problem, Problem):
        raise TypeError(
            f"{name}: got {type(problem).__name__} for the plant, wanted a Problem: Problem(drift, noise=...)"
        )
    refuse_modes(problem)
    if problem.time_dependent:
        raise ValueError(
            f"{name}: got time_dependent=True, wanted a plant whose functions take (x, u): an observer does not know "
            "the time. Make the time a state with drift 1."
        )
    if problem.is_game:
        raise ValueError(
            f"{name}: got a problem with disturbances, whose actions a filter cannot know; leave them out, or "
            "use noise instead"
        )
    system = closures.settled(Problem(problem.drift, controls=problem.controls, noise=problem.noise), n)
    checks.of_one_state(system, n, "the number of states")
    return system


def check_step(name: str, problem: Problem, outputs: int, told: tuple[Any, Any, Number]) -> None:
    """Refuse a control, an increment or a step length that an observer cannot use.

    Shapes are also checked inside a transformation, where a wrong shape would be broadcast or fail later. Numbers are
    checked if they are known.

    Args:
      name: the function the user called, for messages.
      problem: the plant, with its admissible set.
      outputs: the number p of measured quantities.
      told: u (m,), dy (p,) or None, and dt.
    """
    u, dy, dt = told
    m = 0 if problem.controls is None else problem.controls.dim
    check_vector(u, f"{name}: u", m, "the control over the step, one entry per input")
    if dy is not None:
        check_vector(dy, f"{name}: dy", outputs, "the increment over the step, one entry per measured quantity")
    check_admissible(problem, u, f"{name}: u")
    check_length(dt, f"{name}: dt", "the length of the step")


def check_vector(given: Any, name: str, entries: int, meaning: str) -> None:
    """Refuse an array that is not a vector of ``entries`` finite numbers."""
    array = given if is_traced(given) else numbers(given, name)
    if np.shape(array) != (entries,):
        raise ValueError(f"{name} has shape {np.shape(array)}, wanted ({entries},): {meaning}")
    if not is_traced(array) and not np.all(np.isfinite(array)):
        raise ValueError(f"{name} = {array.tolist()}, wanted finite numbers; all later estimates would be NaN")


def check_length(dt: Any, name: str, meaning: str) -> None:
    """Refuse a step length that is not a finite number > 0."""
    if np.ndim(dt) != 0:
        raise ValueError(f"{name} has shape {np.shape(dt)}, wanted one number > 0, {meaning}")
    arguments.positive(dt, name, meaning)


def check_admissible(problem: Problem, controls: Any, name: str) -> None:
    """Refuse controls (..., m) outside the admissible set, where drift and cost may be meaningless."""
    if problem.controls is None or is_traced(problem.controls, controls):
        return
    given = numbers(controls, name)
    bad = ~sets.holds(problem.controls, given)
    if np.any(bad):
        first = given[bad][0].tolist()
        raise ValueError(
            f"{name} = {first} at {int(np.sum(bad))} of {bad.size} steps, wanted elements of the admissible set, "
            f"{arguments.shown(problem.controls)}: pass the controls that were applied, or a Problem with a wider set"
        )


def record_of(given: Any, name: str, p: int, *, batches: bool) -> Any:
    """A record of finite numbers with at least one row, shape (k, p), or (batch, k, p) if ``batches``."""
    record = numbers(given, name)
    if np.ndim(record) not in ((2, 3) if batches else (2,)) or np.shape(record)[-1] != p or 0 in np.shape(record):
        many = f", or (batch, k, {p})" if batches else ""
        raise ValueError(
            f"{name} has shape {np.shape(record)}, wanted (k, {p}){many}: one row per step, one column per measured "
            "quantity"
        )
    _check_finite(record, name)
    return record


def controls_of(given: Any, name: str, problem: Problem, steps: tuple[int, ...]) -> Any:
    """The controls that were applied, shape (*steps, m), m = 0 without controls; one record works for a whole batch.

    Args:
      given: the user's argument, or ``None``.
      name: the argument's name, for messages.
      problem: the plant, with its admissible set.
      steps: (k,) or (batch, k), as in the record of measurements.
    """
    m = 0 if problem.controls is None else problem.controls.dim
    wanted = (*steps, m)
    if given is None and m > 0:
        raise ValueError(f"{name} is None, but the problem has {m} inputs; pass the applied controls, shape {wanted}")
    acts = np.zeros(wanted) if given is None else numbers(given, name)
    if np.shape(acts) == wanted[1:] and len(wanted) == 3:
        acts = jnp.broadcast_to(acts, wanted) if is_traced(acts) else np.broadcast_to(acts, wanted)
    if np.shape(acts) != wanted:
        raise ValueError(f"{name} has shape {np.shape(acts)}, wanted {wanted}: one row per step of the record")
    _check_finite(acts, name)
    check_admissible(problem, acts, name)
    return acts


def _check_finite(record: Any, name: str) -> None:
    """Refuse a record with a number that is not finite, and name its first bad row."""
    if is_traced(record) or np.all(np.isfinite(record)):
        return
    row = tuple(int(i) for i in np.argwhere(~np.all(np.isfinite(record), axis=-1))[0])
    place = ", ".join(map(str, row))
    raise ValueError(
        f"{name}[{place}] = {record[row].tolist()}, wanted finite numbers. If a measurement is missing, split the "
        "record and continue from the last state with a large measurement_noise."
    )


def _rest(x: State, u: Array) -> State:
    """A drift of zero."""
    return 0 * x
