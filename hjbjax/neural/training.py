"""The loop that trains weights: Adam in compiled chunks of steps, and a measurement on held-out data between them.

The weights with the smallest held-out error are kept. A chunk has a fixed number of steps, so that the result depends
on the seed and not on the speed of the machine. Ctrl-C, time limits and checkpoints act between two chunks. The random
key of a chunk depends on the seed and its number only, so a checkpoint stores the number.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.neural.extremal_samples import ExtremalSamples
from hjbjax.problem.pytree import INTERRUPT
from hjbjax.solution.checkpoints import check_alike
from hjbjax.solution.clock import Clock
from hjbjax.solution.status import Status
from hjbjax.solvers.host_loop import progress_bar

CHUNK = 25  # steps between two measurements


@dataclasses.dataclass
class Training:
    """The state of a training, which is also a part of a checkpoint.

    Args:
      weights: the best weights so far.
      current: the number of complete chunks, the weights after them, and the state of the optimiser.
      chunks: the number of all chunks.
      samples: the extremals that are collected during the training, or None.
      error: the held-out error of the best weights.
      history: the held-out errors before all chunks.
      status: the reason for the end.
    """

    weights: Any
    current: tuple[int, Any, Any]  # replaced as a whole, so that Ctrl-C cannot separate them
    chunks: int
    samples: ExtremalSamples | None = None
    error: float = math.inf
    history: list[float] = dataclasses.field(default_factory=list)
    status: Status = Status.MAX_STEPS
    passing: ClassVar[bool] = False

    def saved(self) -> list[Any]:
        """The state before the next chunk, whose measurement is repeated after ``restore``."""
        number, *trained = self.current
        history = np.full(self.chunks, np.nan)
        history[:number] = self.history[:number]
        leaves = jax.tree.leaves((self.weights, trained))
        return [np.asarray(number), np.asarray(self.error), history, *leaves, *self._samples()]

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Continue from the arrays of ``saved``.

        Raises:
          ValueError: the arrays are not a state of this training.
        """
        check_alike(arrays, self.saved())
        number = int(arrays[0])
        if not 0 <= number <= self.chunks:
            raise ValueError(f"it has {number} complete chunks of {self.chunks}")
        leaves, structure = jax.tree.flatten((self.weights, self.current[1:]))
        end = 3 + len(leaves)
        if self.samples is not None:
            self.samples.restore(arrays[end:])
        self.weights, (weights, state) = jax.tree.unflatten(structure, arrays[3:end])
        self.current = number, *jax.tree.map(jnp.asarray, (weights, state))
        self.error, self.history = float(arrays[1]), arrays[2][:number].tolist()

    def _samples(self) -> list[Any]:
        return [] if self.samples is None else self.samples.saved()

    def measured(self, error: float, weights: Any, enough: float) -> Status | None:
        """Record a held-out error; return CONVERGED or NONFINITE if the training ends with it, otherwise None."""
        if not math.isfinite(error):
            return Status.NONFINITE
        self.history.append(error)
        if error < self.error:
            self.weights, self.error = jax.tree.map(np.asarray, weights), error
        return Status.CONVERGED if error <= enough else None


def train(
    loss: Callable,
    measure: Callable,
    weights: Any,
    *,
    steps: int,
    rate: float,
    seed: int,
    clock: Clock,
    enough: float = 0.0,
    samples: ExtremalSamples | None = None,
    refresh: Callable | None = None,
) -> Training:
    """Train weights until the last step, the limits of the clock, or a held-out error of at most ``enough``.

    The journal of the clock, if any, stores the state every minute and at the end.

    Args:
      loss: a function of weights, random key and data that returns a number.
      measure: a function of the weights that returns the held-out error.
      weights: the initial weights.

    Keyword Args:
      steps: the number of steps, rounded up to whole chunks.
      rate: the initial rate of Adam, which falls to zero over the steps.
      seed: of the random keys.
      clock: the limits, and the journal.
      enough: the held-out error at which training ends.
      samples: the extremals that ``refresh`` collects; part of the stored state.
      refresh: a function of weights, chunk number and a function that stores the state if a write is due. It returns
        the data of the next chunk, a pytree of arrays. ``None``: the loss does not read data.

    Returns:
      The Training with the best weights.
    """
    import optax

    chunks = -(-steps // CHUNK)
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, chunks * CHUNK))
    weights = jax.tree.map(jnp.asarray, weights)
    run = Training(jax.tree.map(np.asarray, weights), (0, weights, optimiser.init(weights)), chunks, samples)
    journal = clock.journal
    complete = journal is not None and journal.enter(run) is not None
    try:
        run.status = _advance_to_end(run, _chunk(loss, optimiser), measure, refresh, seed, clock, enough)
    except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
        if not isinstance(error, KeyboardInterrupt) and not INTERRUPT.search(str(error)):
            raise
        run.status = Status.INTERRUPTED  # maybe in the middle of a collection, so the file keeps the earlier state
        return run
    if journal is not None and not complete:
        # all steps are done, although the error may be large; the schedule of the rate has no further ones
        journal.leave(run, Status.CONVERGED if run.status is Status.MAX_STEPS else run.status)
    return run


def _chunk(loss: Callable, optimiser: Any) -> Callable:
    """The compiled function for a chunk of steps, which returns weights and state of the optimiser."""
    import optax

    @jax.jit
    def advance(weights: Any, state: Any, key: Any, data: Any) -> tuple[Any, Any]:
        def step(carry: tuple[Any, Any], key: Any) -> tuple[tuple[Any, Any], None]:
            weights, state = carry
            slope = jax.grad(loss)(weights, key, data)
            updates, state = optimiser.update(slope, state, weights)
            return (optax.apply_updates(weights, updates), state), None

        return jax.lax.scan(step, (weights, state), jax.random.split(key, CHUNK))[0]

    return advance


def _advance_to_end(
    run: Training,
    advance: Callable,
    measure: Callable,
    refresh: Callable | None,
    seed: int,
    clock: Clock,
    enough: float,
) -> Status:
    """Advance the training chunk by chunk, and return the reason for its end."""

    def keep() -> None:
        if clock.journal is not None:
            clock.journal.keep(run)

    root, first, data = jax.random.key(seed), run.current[0], None
    bar_options = {"total": run.chunks * CHUNK, "initial": first * CHUNK, "desc": "training"}
    with progress_bar(clock.progress, bar_options) as bar:
        for number in range(first, run.chunks + 1):
            _, weights, state = run.current
            if (ended := run.measured(float(measure(weights)), weights, enough)) is not None:
                return ended
            if number == run.chunks:
                break
            if (over := clock.over()) is not None:
                return over
            if refresh is not None:
                data = refresh(weights, number, keep)
                if (over := clock.over()) is not None:  # the collection of extremals may be incomplete
                    return over
            run.current = number + 1, *advance(weights, state, jax.random.fold_in(root, number), data)
            keep()
            if bar is not None:
                bar.set_postfix_str(f"held-out error {run.error:.3g}", refresh=False)
                bar.update(CHUNK)
    return Status.MAX_STEPS
