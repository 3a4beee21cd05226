"""``fit``: parameters that make a loss least, by an optimiser of optax, and the result ``Fit``.

The optimiser works on z = θ/scale, where the scale of a parameter is the size of its initial value, the width of its
bounds if that is zero, or 1. Its step lengths are therefore relative, and other units do not change its path. After
every step the parameters are moved to the nearest point within their bounds.

A checkpoint identifies the loss and the optimiser by the operations of a whole step.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hjbjax.problem import arguments
from hjbjax.problem.pytree import INTERRUPT, front_door
from hjbjax.problem.settings import own_settings
from hjbjax.solution import files
from hjbjax.solution.checkpoints import KINDS, Checkpoint, check_alike, open_checkpoint
from hjbjax.solution.clock import CUT, Clock, noting_interrupts
from hjbjax.solution.placement import Path
from hjbjax.solution.solution import SolveError
from hjbjax.solution.status import Status, warn
from hjbjax.solvers.host_loop import progress_bar
from hjbjax.tracing.closures import digest_of_program, refuse_traced

RATE = 0.05  # learning rate of the default optimiser, relative to the size of each parameter
EARLY = 1e-3  # fraction of the tolerance at which a run ends before its last step
PATIENCE = 10  # the least number of steps without improvement after which a fit has converged
DIFFERENCE = 1e-4  # relative step of the finite difference that checks the gradient
FAULTY = 0.01  # relative error of a directional derivative above which the gradient is wrong

MESSAGES = {
    Status.CONVERGED: "The loss stopped decreasing.",
    Status.MAX_STEPS: "Reached the number of steps; the loss was still decreasing. Continue from fit.parameters.",
    Status.NONFINITE: "The loss or its gradient became NaN or infinite; the best parameters are kept. Add bounds.",
    Status.INTERRUPTED: "The fit was interrupted; the best parameters are kept. Continue from fit.parameters.",
    Status.TIME_LIMIT: "Reached time_limit; the best parameters are kept. Continue from fit.parameters.",
}


@dataclasses.dataclass(frozen=True, eq=False)
class Fit(files.Saved):
    """The result of ``fit``.

    Args:
      parameters: the best parameters, of the structure of the initial ones, in NumPy. After ``Fit.load`` they are a
        dictionary of arrays by name, such as "['mass']", because a file does not store classes.
      loss: the loss at these parameters.
      history: the loss before every step of the best run, shape (k,).
      status: CONVERGED, MAX_STEPS, NONFINITE, INTERRUPTED or TIME_LIMIT.
      starts: the smallest loss of every run; one number without restarts.
      gradient_error: the relative error of the gradient along a random direction, compared with a finite difference;
        ``None`` if it was not checked.
      seconds: the duration.
    """

    FORMAT = "hjbjax.Fit"
    KINDS: ClassVar = {
        "names": (list,), "shapes": (list,), "loss": files.REAL, "status": (int,), "starts": (list,),
        "gradient_error": (*files.REAL, type(None)), "seconds": files.REAL,
    }  # fmt: skip

    parameters: Any
    loss: float
    history: np.ndarray
    status: Status
    starts: tuple[float, ...] = ()
    gradient_error: float | None = None
    seconds: float = 0.0

    @property
    def message(self) -> str:
        """The outcome and the remedy in one or two sentences."""
        return MESSAGES.get(self.status, self.status.message)

    def _contents(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        leaves, _ = jax.tree_util.tree_flatten_with_path(self.parameters)
        names = [jax.tree_util.keystr(where) for where, _ in leaves]
        arrays = {f"parameter{i}": np.asarray(leaf, float) for i, (_, leaf) in enumerate(leaves)}
        header = {
            "names": names, "shapes": [each.shape for each in arrays.values()], "loss": self.loss,
            "status": int(self.status), "starts": self.starts,
            "gradient_error": self.gradient_error, "seconds": self.seconds,
        }  # fmt: skip
        return header, {**arrays, "history": np.asarray(self.history, float)}

    @staticmethod
    def _plan(header: dict) -> dict[str, files.Expected]:
        """The arrays of a file."""
        shapes = {f"parameter{i}": tuple(each) for i, each in enumerate(header["shapes"])}
        each = {name: files.Expected((shape,), (np.float64,), optional=False) for name, shape in shapes.items()}
        return {**each, "history": files.Expected(((None,),), (np.float64,), optional=False)}

    @classmethod
    def _from_file(cls, header: dict, arrays: dict[str, np.ndarray]) -> Self:
        """The result with the header and the arrays of a file."""
        found = {name: arrays[f"parameter{i}"] for i, name in enumerate(header["names"])}
        if not all(isinstance(name, str) for name in found):
            raise files.FileError(f"its names of parameters are {list(found)}, wanted text")
        error = header["gradient_error"]
        return cls(
            found, float(header["loss"]), arrays["history"], Status(header["status"]),
            tuple(map(float, header["starts"])), None if error is None else float(error), float(header["seconds"]),
        )  # fmt: skip

    def __str__(self) -> str:
        lines = [f"{self.status.name}: loss {self.loss:.6g} after {len(self.history)} steps, {self.seconds:.3g} s"]
        leaves, _ = jax.tree_util.tree_flatten_with_path(self.parameters)
        for where, leaf in leaves:
            lines.append(f"  {jax.tree_util.keystr(where) or 'parameter':<20} {np.array2string(leaf, precision=6)}")
        if self.gradient_error is not None:
            lines.append(f"  gradient checked: relative error {self.gradient_error:.1e}")
        return "\n".join(lines)


@front_door
def fit(
    loss: Callable,
    parameters: Any,
    *,
    optimiser: Any = None,
    steps: int = 200,
    bounds: tuple[Any, Any] | None = None,
    restarts: int = 0,
    seed: int = 0,
    check_gradient: bool = False,
    tol: float = 1e-6,
    checkpoint: Path | Checkpoint | None = None,
    resume: bool = False,
    time_limit: float | None = None,
    progress: bool | None = None,
) -> Fit:
    """Find the parameters that make a loss least, in float64; the loss may contain solve, march and simulate.

    Args:
      loss: a function of the parameters that returns a number and that JAX can trace and differentiate.
      parameters: the initial parameters: a number, an array, or a dictionary, a dataclass or another pytree of them.

    Keyword Args:
      optimiser: a gradient transformation of optax, such as ``optax.adam(0.02)`` or ``optax.lbfgs()``, for parameters
        in units of their initial size. Default: Adam with a rate that falls from 0.05 to zero over the steps.
      steps: the largest number of steps of a run.
      bounds: a pair (lower, upper), each of the structure of the parameters, or one number for all; may be infinite.
      restarts: number of further runs, from random parameters: within the bounds if these are finite, otherwise around
        the initial ones. The best run counts.
      seed: of the random numbers of restarts and of the check.
      check_gradient: compare the gradient at the initial parameters with a finite difference, and warn if they differ.
      tol: a run has converged if the loss changed by less than this fraction over the last tenth of the steps, and at
        least ten. The fraction is of the decrease since the first tenth. It ends early below a thousandth of it.
      checkpoint: a file for the state of the fit, written every minute and at the end, or ``Checkpoint(path, every=)``.
      resume: continue from that file if it exists, with the same bits. The loss and all arguments except
        ``check_gradient``, ``time_limit`` and ``progress`` must be the same.
      time_limit: seconds, including compilation.
      progress: show a bar of the steps after a second; ``None``: on a terminal.

    Returns:
      A Fit with the best parameters of all steps. Ctrl-C ends the fit and keeps them.

    Raises:
      ValueError: the loss is not finite at the initial parameters, or an argument is not admissible.
      TypeError: the loss cannot be called, or a parameter is not a number.
      FileExistsError: the checkpoint exists, without ``resume``.
      FileError: the checkpoint belongs to another loss or other arguments, is in use by another run, or cannot be
        written.
      SolveError: Ctrl-C or the time limit before the first step was complete.

    Example:
      >>> found = fit(lambda p: (p["a"] - 3.0) ** 2 + (p["b"] + 1.0) ** 2, {"a": 1.0, "b": -2.0})
      >>> {name: round(float(value), 3) for name, value in found.parameters.items()}, found.status.name
      ({'a': 3.0, 'b': -1.0}, 'CONVERGED')
    """
    if not callable(loss):
        raise TypeError(f"fit: got loss = {loss!r:.100}, wanted a function of the parameters")
    refuse_traced("fit", loss, parameters)
    count = arguments.count(steps, "fit: steps")
    arguments.positive(tol, "fit: tol")
    if isinstance(restarts, bool) or not isinstance(restarts, (int, np.integer)) or restarts < 0:
        raise ValueError(f"fit: got restarts = {restarts!r}, wanted an integer ≥ 0")
    clock = Clock(seconds=time_limit, progress=progress)
    with noting_interrupts(clock), own_settings(x64=True):
        task = _task(loss, parameters, optimiser, bounds, count)
        limits = {"steps": count, "restarts": int(restarts), "seed": seed, "tol": float(tol)}
        asked = {} if checkpoint is None else _question(task) | limits
        with open_checkpoint(checkpoint, (), 0, resume=resume, caller="fit", **asked) as file:
            clock.journal = file and file.journal()
            error = _gradient_error(task, np.random.default_rng(seed)) if check_gradient else None
            draw = np.random.default_rng(seed)
            starts = [task.start, *(_random_start(task, draw) for _ in range(restarts))]
            runs = _runs(task, starts, count, tol, clock)
        best = min(runs, key=lambda run: run.loss)
        if not best.history:
            if best.status in CUT:
                raise SolveError(f"fit: {best.status}, before the first step was complete")
            raise ValueError(
                "fit: the loss or its gradient is not finite at the initial parameters. A solve that does not converge "
                "is NaN here:\ncall the loss outside of fit to see the reason"
            )
        found = jax.tree.map(np.asarray, task.parameters(best.z))
        # the best run may be an earlier one; the fit is still incomplete if any run was cut short
        status = next((run.status for run in runs if run.status in CUT), best.status)
    return Fit(
        found, best.loss, np.array(best.history), status, tuple(run.loss for run in runs), error, clock.elapsed()
    )


@dataclasses.dataclass(frozen=True)
class _Task:
    """A fit in scaled parameters.

    ``step(z, state, scale, lower, upper)`` returns loss, finite flag, new parameters and new state of the optimiser.
    """

    start: np.ndarray
    scale: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    structure: Any
    begin: Callable
    step: Callable
    loss: Callable
    value_and_grad: Callable
    parameters: Callable

    @property
    def numbers(self) -> tuple[np.ndarray, ...]:
        """The last arguments of a step."""
        return self.scale, self.lower, self.upper


@dataclasses.dataclass
class _Run:
    """One run, which is also a part of a checkpoint.

    Args:
      current: the scaled parameters before the next step, and the state of the optimiser.
      steps: the largest number of steps.
      tol: the fraction of the decrease below which the loss no longer changes.
      z: the best scaled parameters.
      loss: their loss.
      history: the losses of all steps.
      status: the reason for the end.
    """

    current: tuple[Any, Any]  # replaced as a whole, so that Ctrl-C cannot separate them
    steps: int
    tol: float
    z: np.ndarray
    loss: float = math.inf
    history: list[float] = dataclasses.field(default_factory=list)
    status: Status = Status.MAX_STEPS
    passing: ClassVar[bool] = False

    def saved(self) -> list[Any]:
        """The state before the next step."""
        history = np.full(self.steps, np.nan)
        history[: len(self.history)] = self.history
        return [np.asarray(self.loss), history, self.z, *map(np.asarray, jax.tree.leaves(self.current))]

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Continue from the arrays of ``saved``.

        Raises:
          ValueError: the arrays are not a state of this run.
        """
        check_alike(arrays, self.saved())
        self.loss, self.z = float(arrays[0]), arrays[2]
        self.history = arrays[1][np.isfinite(arrays[1])].tolist()
        self.current = jax.tree.unflatten(jax.tree.structure(self.current), map(jnp.asarray, arrays[3:]))

    def record(self, value: float) -> None:
        """Record the loss of the current parameters."""
        self.history.append(value)
        if value < self.loss:
            self.z, self.loss = np.asarray(self.current[0]), value

    def has_settled(self, fraction: float = 1.0) -> bool:
        """True if the loss changed by less than this fraction of the tolerance over the last tenth of the steps.

        It compares the range of the last losses, because an optimiser with momentum may overshoot for some steps, with
        the largest of the first losses, because a start at the optimum is the least of all losses.
        """
        patience = max(PATIENCE, self.steps // 10)
        if len(self.history) <= patience:
            return False
        moved, whole = float(np.ptp(self.history[-patience:])), max(self.history[:patience]) - self.loss
        return moved <= fraction * self.tol * whole


def _task(loss: Callable, parameters: Any, optimiser: Any, bounds: tuple[Any, Any] | None, steps: int) -> _Task:
    """The functions of a fit, after checks."""
    import optax

    try:
        initial = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), parameters)
    except (TypeError, ValueError):
        raise TypeError(f"fit: got parameters = {parameters!r:.200}, wanted a pytree of real numbers") from None
    if not jax.tree.leaves(initial):
        raise ValueError("fit: got no parameters")
    raveled, unravel = ravel_pytree(initial)
    flat = np.asarray(raveled)
    lower, upper = _bounds(bounds, initial, flat)
    width = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    scale = np.where(flat != 0, np.abs(flat), np.where(width > 0, width, 1.0))
    if optimiser is None:
        optimiser = optax.adam(optax.cosine_decay_schedule(RATE, steps))
    elif not (hasattr(optimiser, "init") and hasattr(optimiser, "update")):
        raise TypeError(f"fit: got optimiser = {optimiser!r:.100}, wanted one of optax, such as optax.adam(0.02)")
    optimiser = optax.with_extra_args_support(optimiser)

    def of_scaled(z: Any, scale: Any) -> jax.Array:
        value = jnp.asarray(loss(unravel(z * scale)))
        if value.shape != ():
            raise ValueError(f"fit: the loss returned shape {value.shape}, wanted one number")
        if jnp.iscomplexobj(value):
            raise TypeError("fit: the loss returned a complex number, wanted a real one")
        return value.astype(jnp.float64)

    @jax.jit
    def step(z: Any, state: Any, scale: Any, low: Any, high: Any) -> tuple[Any, ...]:
        value, slope = jax.value_and_grad(of_scaled)(z, scale)
        options = {"value": value, "grad": slope, "value_fn": lambda z: of_scaled(z, scale)}
        updates, state = optimiser.update(slope, state, z, **options)
        finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(slope))
        return value, finite, jnp.clip(optax.apply_updates(z, updates), low, high), state

    return _Task(
        flat / scale, scale, lower / scale, upper / scale, jax.tree.structure(initial), optimiser.init, step,
        jax.jit(of_scaled), jax.jit(jax.value_and_grad(of_scaled)), lambda z: unravel(jnp.asarray(z * scale)),
    )  # fmt: skip


def _question(task: _Task) -> dict[str, Any]:
    """The task of a checkpoint by parts."""
    z = jnp.asarray(task.start)
    state = task.begin(z)
    for leaf in jax.tree.leaves(state):
        if (dtype := jnp.asarray(leaf).dtype) not in KINDS:
            raise ValueError(
                f"fit: the state of the optimiser has an array of dtype {dtype}, which a checkpoint cannot store; use\n"
                "another optimiser, or leave out checkpoint="
            )
    return {
        "loss or optimiser": digest_of_program(task.step, z, state, *task.numbers),
        "first state of the optimiser": [np.asarray(leaf) for leaf in jax.tree.leaves(state)],
        "parameters": np.concatenate([task.start, task.scale]), "structure of the parameters": task.structure,
        "bounds": np.concatenate([task.lower, task.upper]),
    }  # fmt: skip


def _bounds(bounds: Any, initial: Any, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of the flat parameters."""
    if bounds is None:
        return np.full(flat.shape, -np.inf), np.full(flat.shape, np.inf)
    if not isinstance(bounds, Sequence) or len(bounds) != 2:
        raise ValueError(f"fit: got bounds = {bounds!r:.200}, wanted a pair (lower, upper)")
    ends = []
    for end in bounds:
        structures: list[Any] = [jax.tree.structure(end), jax.tree.structure(initial)]
        if structures[0] == jax.tree.structure(0.0) and np.ndim(end) == 0:
            ends.append(np.full(flat.shape, float(end)))
            continue
        if structures[0] != structures[1]:
            raise ValueError("fit: the bounds and the parameters have different structures; wanted one per parameter")
        each = jax.tree.map(lambda bound, leaf: np.broadcast_to(np.asarray(bound, float), leaf.shape), end, initial)
        ends.append(np.asarray(ravel_pytree(each)[0]))
    lower, upper = ends
    if np.any(np.isnan(lower) | np.isnan(upper)) or np.any((flat < lower) | (flat > upper)):
        raise ValueError(
            f"fit: the initial parameters {flat.tolist()} are not within the bounds from {lower.tolist()} to "
            f"{upper.tolist()}; move them inside"
        )
    return lower, upper


def _random_start(task: _Task, draw: np.random.Generator) -> np.ndarray:
    """Random scaled parameters."""
    finite = np.isfinite(task.lower) & np.isfinite(task.upper)
    low, high = np.where(finite, task.lower, 0.0), np.where(finite, task.upper, 1.0)
    uniform = low + (high - low) * draw.uniform(size=task.start.shape)
    apart = draw.normal(size=task.start.shape)
    around = np.where(task.start != 0, task.start * np.exp(apart), apart)  # a zero has the scale 1
    return np.clip(np.where(finite, uniform, around), task.lower, task.upper)


def _runs(task: _Task, starts: Sequence[np.ndarray], steps: int, tol: float, clock: Clock) -> list[_Run]:
    """The runs of the optimiser from all starts, until one of them is cut short."""
    runs: list[_Run] = []
    with progress_bar(clock.progress, {"total": steps * len(starts), "desc": "fit"}) as bar:
        for start in starts:
            begun = jnp.asarray(start), task.begin(jnp.asarray(start))
            runs.append(_Run(begun, steps, tol, np.full(start.shape, np.nan)))
            _complete(runs[-1], task, clock, bar)
            if runs[-1].status in CUT:
                break
    return runs


def _complete(run: _Run, task: _Task, clock: Clock, bar: Any) -> None:
    """Advance a run to its end, or bring it to its recorded state first."""
    journal = clock.journal
    recorded = None if journal is None else journal.enter(run)
    if bar is not None:
        bar.update(len(run.history))
    if recorded is None:
        run.status = _advance(run, task, clock, bar)
        if journal is not None:
            # all steps are done, although the loss may still decrease; the default rate has fallen to zero
            journal.leave(run, Status.CONVERGED if run.status is Status.MAX_STEPS else run.status)
    else:
        run.status = recorded
    if run.status in (Status.CONVERGED, Status.MAX_STEPS):
        run.status = Status.CONVERGED if run.has_settled() else Status.MAX_STEPS


def _advance(run: _Run, task: _Task, clock: Clock, bar: Any) -> Status:
    """Advance a run step by step, and return the reason for its end."""
    for _ in range(len(run.history), run.steps):
        if (over := clock.over()) is not None:
            return over
        try:
            value, finite, *following = task.step(*run.current, *task.numbers)
            value, finite = float(value), bool(finite)
        except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
            if not isinstance(error, KeyboardInterrupt) and not INTERRUPT.search(str(error)):
                raise
            return Status.INTERRUPTED
        if clock.interrupted:  # a solve in the loss was cut short, so this loss is not one
            return Status.INTERRUPTED
        if not finite:
            return Status.NONFINITE
        run.record(value)
        if bar is not None:
            bar.set_postfix_str(f"loss {run.loss:.3g}", refresh=False)
            bar.update(1)
        if run.has_settled(EARLY):
            break
        run.current = following[0], following[1]
        if clock.journal is not None:
            clock.journal.keep(run)
    return Status.MAX_STEPS


def _gradient_error(task: _Task, draw: np.random.Generator) -> float:
    """The relative difference of the slope along a random direction from a central difference; warns if it is large."""
    # inside the bounds, outside of which the loss may have no value
    reach = np.minimum(DIFFERENCE, (task.upper - task.lower) / 2)
    z = jnp.asarray(np.clip(task.start, task.lower + reach, task.upper - reach))
    direction = draw.choice([-1.0, 1.0], task.start.shape) * reach / DIFFERENCE
    slope = float(task.value_and_grad(z, task.scale)[1] @ direction)
    above, below = (float(task.loss(z + sign * DIFFERENCE * direction, task.scale)) for sign in (1, -1))
    difference = (above - below) / (2 * DIFFERENCE)
    error = abs(slope - difference) / max(abs(slope), abs(difference), np.finfo(float).tiny)
    if not error <= FAULTY:
        warn(
            f"fit: the gradient along a random direction is {slope:.6g}, a finite difference gives {difference:.6g}. "
            "Kinks, targets between nodes and coarse tolerances of a solve cause this; a smaller tol= may help"
        )
    return error
