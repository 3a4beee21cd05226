"""The loop that trains weights: Adam in compiled chunks of steps, and a measurement on held-out data between them.

The weights with the smallest held-out error are kept. A chunk has a fixed number of steps, so that the result depends
on the seed and not on the speed of the machine. Ctrl-C and time limits act between two chunks.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import INTERRUPT
from hjbjax.solution.clock import Clock
from hjbjax.solution.status import Status
from hjbjax.solvers.host_loop import progress_bar

CHUNK = 25  # steps between two measurements


@dataclasses.dataclass
class Training:
    """The state of a training: the best weights so far, their held-out error, and the errors of all chunks."""

    weights: Any
    error: float = math.inf
    history: list[float] = dataclasses.field(default_factory=list)
    status: Status = Status.MAX_STEPS


def train(
    loss: Callable,
    measure: Callable,
    weights: Any,
    data: Any,
    *,
    steps: int,
    rate: float,
    seed: int,
    clock: Clock,
    enough: float = 0.0,
    refresh: Callable | None = None,
) -> Training:
    """Train weights until the last step, the limits of the clock, or a held-out error of at most ``enough``.

    Args:
      loss: a function of weights, random key and data that returns a number.
      measure: a function of the weights that returns the held-out error.
      weights: the initial weights.
      data: a pytree of arrays that the loss reads.

    Keyword Args:
      steps: the number of steps, rounded up to whole chunks.
      rate: the initial rate of Adam, which falls to zero over the steps.
      seed: of the random keys.
      clock: the limits.
      enough: the held-out error at which training ends.
      refresh: a function of weights, chunk number and data that returns the data of the next chunk.

    Returns:
      The Training with the best weights.
    """
    import optax

    chunks = -(-steps // CHUNK)
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, chunks * CHUNK))

    @jax.jit
    def advance(weights: Any, state: Any, key: Any, data: Any) -> tuple[Any, Any, Any]:
        def step(carry: tuple[Any, Any], key: Any) -> tuple[tuple[Any, Any], Any]:
            weights, state = carry
            value, slope = jax.value_and_grad(loss)(weights, key, data)
            updates, state = optimiser.update(slope, state, weights)
            return (optax.apply_updates(weights, updates), state), value

        (weights, state), values = jax.lax.scan(step, (weights, state), jax.random.split(key, CHUNK))
        return weights, state, jnp.mean(values)

    weights = jax.tree.map(jnp.asarray, weights)
    state, run = optimiser.init(weights), Training(jax.tree.map(np.asarray, weights))
    root = jax.random.key(seed)
    with progress_bar(clock.progress, {"total": chunks * CHUNK, "desc": "training"}) as bar:
        try:
            for number in range(chunks + 1):
                error = float(measure(weights))
                if not math.isfinite(error):
                    run.status = Status.NONFINITE
                    break
                run.history.append(error)
                if error < run.error:
                    run.weights, run.error = jax.tree.map(np.asarray, weights), error
                if error <= enough:
                    run.status = Status.CONVERGED
                    break
                if number == chunks:
                    break
                if (over := clock.over()) is not None:
                    run.status = over
                    break
                if refresh is not None:
                    data = refresh(weights, number, data)
                weights, state, _ = advance(weights, state, jax.random.fold_in(root, number), data)
                if bar is not None:
                    bar.set_postfix_str(f"held-out error {run.error:.3g}", refresh=False)
                    bar.update(CHUNK)
        except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
            if not isinstance(error, KeyboardInterrupt) and not INTERRUPT.search(str(error)):
                raise
            run.status = Status.INTERRUPTED
    return run
