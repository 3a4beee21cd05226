"""Semilinear stochastic problems in many dimensions: ``deep_bsde``, a network trained on a backward equation.

    V_t + ½ tr(σσᵀ D²V) + min_u [L + f·DV] = βV,    V(T) = ψ

Along the closed loop dX = f(X, u) dt + σ dW with u = argmin [L + f·DV], Itô's formula gives a backward stochastic
differential equation for Y = V(t, X):

    Y_t = e^{−β(T−t)} ψ(X_T) + ∫ e^{−β(s−t)} (L ds − DV·σ dW)

The network is V itself. Its gradient controls the paths, and the loss is the mean square of V − Y at all times, where Y
is computed backwards along each path by Euler's scheme. For the exact V the right-hand side has no variance. The paths
follow the present control, so that the network is trained where they go. They begin near x₀, within the noise of one
Euler step: paths from x₀ itself would train V(0, ·) at a single state, and neither its neighbours nor DV.

After training, the mean of Y at time 0 over new paths is an unbiased estimate of the cost of the computed feedback, and
the stochastic integral only reduces its variance. The cost exceeds V by the square of the error e of DV,

    cost − V ≈ ½ E ∫ e^{−βt} e'(−H_pp)e dt,    Var Y ≈ E ∫ e^{−2βt} e'σσᵀe dt,    H(t, x, p) = min_u [L + f·p]

so the variance of Y over new paths bounds the excess if the noise reaches every direction in which H is curved.

The method is that of W. E, J. Han and A. Jentzen, Commun. Math. Stat. 5 (2017), with one network for all times.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.hamiltonian import pointwise
from hjbjax.hamiltonian.pointwise import Rule
from hjbjax.neural import ingredients
from hjbjax.neural.ansatz import HorizonAnsatz, terminal_cost
from hjbjax.neural.network import checked_layers, initial_weights
from hjbjax.neural.solution import NeuralSolution, numbers_of_guess, weights_of_guess
from hjbjax.neural.training import Training, train
from hjbjax.problem import arguments
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Control, Key, Number, State
from hjbjax.solution.checkpoints import Checkpoint, open_checkpoint
from hjbjax.solution.clock import CUT, Clock, noting_interrupts
from hjbjax.solution.placement import Path
from hjbjax.solution.solution import SolveError
from hjbjax.solution.status import Status
from hjbjax.tracing.dependence import influence

NAME = "neural.deep_bsde"
PILOT = 256  # paths under the cheapest control that give the sizes of the inputs
HELD_OUT = 256  # paths that choose the best weights
FRESH, BLOCK = 4096, 256  # paths of the final estimate, and of each block of them
FINER = 4  # steps of the final estimate per step of the training
PROBED = 64  # ends of paths at which the curvature of the Hamiltonian is compared with the noise
UNREACHED = 1e-9  # relative size of a noise or a curvature that counts as zero
EXPLAINED = 0.1  # the largest share of the variance of the cost that the costate of a converged solution leaves


@pytree_dataclass(static=("rule",))
class Plant:
    """The stochastic system with its start and horizon.

    Args:
      problem: the settled problem.
      start: x₀, shape (n,).
      horizon: T.
      rule: the method for the minimum of the Hamiltonian.
    """

    problem: Problem
    start: Any
    horizon: Any
    rule: Rule | None

    def control(self, t: Number, x: State, p: State) -> Control:
        """The control that minimises the Hamiltonian; without entries if there is none."""
        if self.rule is None:
            return jnp.zeros(0, x.dtype)
        return pointwise.minimiser(self.problem, self.rule, t, x, p)

    def near_start(self, key: Key, spread: Number) -> jax.Array:
        """A random state near x₀: x₀ and the noise over a random time up to ``spread``."""
        of_time, of_noise = jax.random.split(key)
        dw = jnp.sqrt(spread * jax.random.uniform(of_time)) * jax.random.normal(of_noise, (self.noises,))
        x, u = self.start, jnp.zeros(0 if self.problem.controls is None else self.problem.controls.dim)
        return jnp.asarray(x + jnp.asarray(self.problem.diffusion(x, u, None, 0.0), x.dtype) @ dw)

    def move(self, t: Number, h: Number, x: State, u: Control, dw: Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """One Euler step: the next state, the cost, and the random part of the step."""
        drift = jnp.asarray(self.problem.drift(*self.problem.arguments(x, u, t=t)), x.dtype)
        random = jnp.asarray(self.problem.diffusion(x, u, None, t), x.dtype) @ dw
        return jnp.asarray(x + drift * h + random), pointwise.running_cost(self.problem, t, x, u) * h, random

    @property
    def noises(self) -> int:
        """The number of independent noises."""
        n = np.shape(self.start)[0]
        u = jnp.zeros(0 if self.problem.controls is None else self.problem.controls.dim)
        return jax.eval_shape(lambda x, u: self.problem.diffusion(x, u, None, 0.0), jnp.zeros(n), u).shape[1]


@front_door
def deep_bsde(
    problem: Problem,
    x0: State | Sequence[float],
    horizon: float,
    *,
    seed: int,
    intervals: int = 20,
    steps: int = 1000,
    batch: int = 64,
    layers: Sequence[int] = (64, 64),
    rate: float = 3e-3,
    tol: float = 0.01,
    guess: NeuralSolution | None = None,
    checkpoint: Path | Checkpoint | None = None,
    resume: bool = False,
    time_limit: float | None = None,
    progress: bool | None = None,
) -> NeuralSolution:
    """Value and feedback of a stochastic problem near the paths from one start, in up to a hundred states and more.

    Args:
      problem: with noise that does not depend on the control, and a terminal cost. The minimum over the controls must
        have a formula: drift and cost are sums of quadratic polynomials of one control each, or the set is ``Finite``.
        A ``Box`` may have infinite bounds.
      x0: the state at time 0, shape (n,).
      horizon: T, in units of time.

    Keyword Args:
      seed: of the weights and of all paths; the same seed gives the same result on the same machine.
      intervals: Euler steps of a training path.
      steps: steps of the optimiser, each on new paths.
      batch: paths per step.
      layers: widths of the hidden layers.
      rate: the initial rate of Adam, which falls to zero over the steps.
      tol: for CONVERGED, ``error``, ``near_error`` and a finite ``excess`` must be at most this fraction of the value,
        or of the spread of the cost if that is larger, and ``unexplained`` at most 0.1.
      guess: a NeuralSolution of the same problem, from whose weights the training starts.
      checkpoint: a file for the state of the training, written every minute and at the end, or
        ``Checkpoint(path, every=)``.
      resume: continue from that file if it exists, with the same bits. All arguments except ``tol``, ``time_limit`` and
        ``progress`` must be the same.
      time_limit: seconds, including compilation.
      progress: show a bar of the steps after a second; ``None``: on a terminal.

    Returns:
      A NeuralSolution. Its ``validation``, from 4096 new paths with four times as many Euler steps, has ``value``, the
      cost of the computed feedback from ``x0``; ``standard_error``, its sampling error; ``time_error``, its change when
      the Euler steps are halved; ``error``, the sum of two standard errors and the time error; ``near_error``, the mean
      difference of V and the cost, with two standard errors, at states near ``x0``, within the noise of one Euler step;
      ``unexplained``, the share of the variance of the cost that the costate leaves, which is 0 for the exact value;
      and ``excess``, an estimate from above of the difference of this cost and V, which is infinite without an
      estimate: if the noise does not reach a direction that the control moves, or if the control jumps. The cost of a
      feedback is an upper bound of V. At other states V(t, ·) is valid where the paths are at the
      time t, which in many dimensions is a shell: the middle of the paths may be far from all of them.

    Raises:
      ValueError: an ingredient of the problem that is not supported, or an argument that is not admissible.
      FileExistsError: the checkpoint exists, without ``resume``.
      FileError: the checkpoint belongs to another problem or other arguments, is in use by another run, or cannot be
        written.
      SolveError: Ctrl-C or the time limit before the first step was complete.
    """
    start = ingredients.state(x0, f"{NAME}: x0")
    horizon = float(arguments.positive(horizon, f"{NAME}: horizon", "in units of time"))
    rate = float(arguments.positive(rate, f"{NAME}: rate"))
    arguments.positive(tol, f"{NAME}: tol")
    counts = [arguments.count(each, f"{NAME}: {name}") for each, name in ((intervals, "intervals"), (steps, "steps"))]
    batch = arguments.count(batch, f"{NAME}: batch", least=2)
    widths, seed = checked_layers(layers, NAME), ingredients.known_seed(seed, NAME)
    clock = Clock(seconds=time_limit, progress=progress)
    asked: Any = {
        "x0": start, "horizon": horizon, "seed": seed, "intervals": counts[0], "steps": counts[1], "batch": batch,
        "layers": widths, "rate": rate, "guess": numbers_of_guess(guess),
    }  # fmt: skip
    with noting_interrupts(clock), own_settings(x64=True):
        settled, rule = ingredients.settled_problem(
            problem, len(start), NAME, {"target": "paths that end on a target have no common horizon"}
        )
        if settled.noise is None or not influence(settled, len(start), np.dtype(np.float64)).noise.is_constant:
            raise ValueError(f"{NAME}: wanted a problem with noise that does not depend on the control")
        plant = Plant(settled, jnp.asarray(start), horizon, rule)
        with open_checkpoint(checkpoint, [settled], len(start), resume=resume, caller=NAME, **asked) as file:
            clock.journal = file and file.journal()
            ansatz = _first_ansatz(plant, counts[0], seed, widths)
            if guess is not None:
                weights_of_guess(guess, len(start) + 2, widths, NAME)
                ansatz = dataclasses.replace(guess.ansatz, horizon=horizon)
            found = _trained(plant, ansatz, counts, batch, rate, seed, clock)
        if found.status in CUT and not found.history:
            raise SolveError(f"{NAME}: {found.status}, before the first step was complete")
        return _report(plant, dataclasses.replace(ansatz, weights=found.weights), found, counts[0], seed, tol, clock)


def _first_ansatz(plant: Plant, intervals: int, seed: int, layers: tuple[int, ...]) -> HorizonAnsatz:
    """The ansatz with random weights, and inputs of size one on the paths under the cheapest control."""

    def path(key: Key) -> tuple[jax.Array, jax.Array, jax.Array]:
        h = plant.horizon / intervals
        dw = jnp.sqrt(h) * jax.random.normal(key, (intervals, plant.noises))

        def step(x: State, inputs: Any) -> Any:
            k, dw = inputs
            following, cost, _ = plant.move(k * h, h, x, plant.control(k * h, x, jnp.zeros_like(x)), dw)
            return following, (following, cost)

        _, (states, costs) = jax.lax.scan(step, plant.start, (jnp.arange(intervals), dw))
        paid = jax.vmap(lambda x: terminal_cost(plant.problem, plant.horizon, x))(states)
        return states, paid, jnp.sum(costs) + paid[-1]

    keys = jax.random.split(jax.random.key(seed), PILOT)
    states, paid, total = (np.asarray(each) for each in jax.jit(jax.vmap(path))(keys))
    if not (np.all(np.isfinite(states)) and np.all(np.isfinite(total))):
        raise ValueError(
            f"{NAME}: paths under the cheapest control are not finite; check drift and noise, or\nraise intervals"
        )
    size = np.sqrt(len(plant.start)) * np.std(states, axis=(0, 1))
    spread, middle = float(np.std(paid)), float(np.mean(total))
    sized = float(np.std(total)) + abs(middle - float(np.mean(paid[:, -1])))  # noise, and costs on the way
    return HorizonAnsatz(
        initial_weights(seed, len(size) + 2, layers), plant.horizon, np.mean(states, axis=(0, 1)),
        np.where(size > 0, size, 1.0), float(np.mean(paid)), spread or 1.0, sized or 1.0, middle, 1.0,
    )  # fmt: skip


def _trained(
    plant: Plant, ansatz: HorizonAnsatz, counts: Sequence[int], batch: int, rate: float, seed: int, clock: Clock
) -> Training:
    """The training on new paths in every step."""
    intervals, steps = counts
    held_out = jax.random.split(jax.random.key(seed + 1), HELD_OUT)

    def mean_square(weights: Any, keys: Any) -> jax.Array:
        own = dataclasses.replace(ansatz, weights=weights)
        return jnp.mean(jax.vmap(lambda key: _path_loss(plant, own, intervals, key))(keys))

    @jax.jit
    def measure(weights: Any) -> jax.Array:
        return jnp.sqrt(mean_square(weights, held_out))

    def loss(weights: Any, key: Key, data: Any) -> jax.Array:
        return mean_square(weights, jax.random.split(key, batch))

    return train(loss, measure, ansatz.weights, steps=steps, rate=rate, seed=seed, clock=clock)


def _path_loss(plant: Plant, ansatz: HorizonAnsatz, intervals: int, key: Key) -> jax.Array:
    """The mean square of (V − Y)/s at all times of one path."""
    problem, h = plant.problem, plant.horizon / intervals
    of_start, of_path = jax.random.split(key)
    dw = jnp.sqrt(h) * jax.random.normal(of_path, (intervals, plant.noises))

    def step(x: State, inputs: Any) -> Any:
        k, dw = inputs
        value, p = jax.value_and_grad(ansatz, 2)(problem, k * h, x)
        # the control minimises H, so its own derivative contributes nothing; paths are data, not parameters
        u = jax.lax.stop_gradient(plant.control(k * h, x, jax.lax.stop_gradient(p)))
        following, cost, random = plant.move(k * h, h, x, u, dw)
        factor = jnp.exp(-problem.discount * k * h)
        return jax.lax.stop_gradient(following), (value, factor, factor * (cost - p @ random))

    start = plant.near_start(of_start, h)
    x, (values, factors, gains) = jax.lax.scan(step, start, (jnp.arange(intervals), dw))
    end = jnp.exp(-problem.discount * plant.horizon) * terminal_cost(problem, plant.horizon, x)
    later = (end + jnp.cumsum(gains[::-1])[::-1]) / factors
    return jnp.mean(((values - later) / ansatz.scale) ** 2)


@jax.jit
def _costs(plant: Plant, ansatz: HorizonAnsatz, intervals: Array, spread: Array, keys: Any) -> dict[str, jax.Array]:
    """Y, the cost of closed loops, and V(0, ·) at their starts, shape (k,) each, the corners of their box, and ends.

    The starts are those of ``Plant.near_start``; x₀ itself for ``spread`` zero.
    """
    problem, h = plant.problem, plant.horizon / intervals

    def path(key: Key) -> dict[str, jax.Array]:
        def step(k: Array, carry: tuple) -> tuple:
            x, cost, gain, lo, hi = carry
            t, factor = k * h, jnp.exp(-problem.discount * k * h)
            p = jax.grad(ansatz, 2)(problem, t, x)
            dw = jnp.sqrt(h) * jax.random.normal(jax.random.fold_in(key, k), (plant.noises,))
            x, paid, random = plant.move(t, h, x, plant.control(t, x, p), dw)
            return x, cost + factor * paid, gain + factor * (p @ random), jnp.minimum(lo, x), jnp.maximum(hi, x)

        zero, start = jnp.zeros_like(plant.horizon), plant.near_start(jax.random.fold_in(key, intervals), spread)
        x, cost, gain, lo, hi = jax.lax.fori_loop(0, intervals, step, (start, zero, zero, start, start))
        total = cost + jnp.exp(-problem.discount * plant.horizon) * terminal_cost(problem, plant.horizon, x)
        found = {"cost": total, "y": total - gain, "value": ansatz(problem, 0.0, start)}
        return found | {"lo": lo, "hi": hi, "end": x}

    return jax.vmap(path)(keys)


@jax.jit
def _curvatures(plant: Plant, ansatz: HorizonAnsatz, t: Array, x: Array) -> tuple[jax.Array, jax.Array]:
    """−H_pp and σσᵀ at times (k,) and states (k, n), shape (k, n, n) each."""
    problem = plant.problem

    def one(t: Number, x: State) -> tuple[jax.Array, jax.Array]:
        p = jax.grad(ansatz, 2)(problem, t, x)
        u = plant.control(t, x, p)

        def rate(p: State) -> jax.Array:  # H_p
            return jnp.asarray(problem.drift(*problem.arguments(x, plant.control(t, x, p), t=t)), x.dtype)

        sigma = jnp.asarray(problem.diffusion(x, u, None, t), x.dtype)
        bent = -jax.jacfwd(rate)(p)
        return (bent + bent.T) / 2, sigma @ sigma.T

    return jax.vmap(one)(t, x)


def _excess(plant: Plant, ansatz: HorizonAnsatz, ends: np.ndarray, variance: float) -> float:
    """An upper estimate of the cost of the feedback minus V, from the variance of Y; infinite if there is none."""
    if plant.rule is None:
        return 0.0
    if plant.rule.jumps:
        return np.inf
    states = np.concatenate([np.asarray(plant.start)[None], ends[:PROBED]])
    times = np.append(0.0, np.full(len(states) - 1, float(plant.horizon)))
    ratios = [
        _largest_ratio(*map(np.asarray, each)) for each in zip(*_curvatures(plant, ansatz, times, states), strict=True)
    ]
    return max(ratios) / 2 * float(np.exp(plant.problem.discount * plant.horizon)) * variance


def _largest_ratio(bent: np.ndarray, noise: np.ndarray) -> float:
    """The largest e'Se / e'Ne of two positive semidefinite matrices."""
    sizes, vectors = np.linalg.eigh(noise)
    reached = sizes > UNREACHED * max(sizes[-1], np.finfo(float).tiny)
    beyond = np.abs(bent @ vectors[:, ~reached])
    if np.max(beyond, initial=0.0) > UNREACHED * np.max(np.abs(bent)):
        return np.inf
    root = vectors[:, reached] / np.sqrt(sizes[reached])
    return float(max(np.linalg.eigvalsh(root.T @ bent @ root)[-1], 0.0))


def _report(
    plant: Plant, ansatz: HorizonAnsatz, found: Training, intervals: int, seed: int, tol: float, clock: Clock
) -> NeuralSolution:
    """The solution with its errors on new paths."""
    plant, ansatz = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (plant, ansatz))

    def costs(salt: int, steps: int, spread: float) -> dict[str, np.ndarray]:
        keys = jax.random.split(jax.random.key(seed + 1 + salt), FRESH)
        parts = [_costs(plant, ansatz, steps, spread, keys[i : i + BLOCK]) for i in range(0, FRESH, BLOCK)]
        return {name: np.concatenate([np.asarray(part[name]) for part in parts]) for name in parts[0]}

    fine, coarse = (costs(finer, finer * intervals, 0.0) for finer in (FINER, FINER // 2))
    value, raw = float(np.mean(fine["y"])), float(np.var(fine["cost"]))
    sampling = float(np.std(fine["y"]) / np.sqrt(FRESH))
    by_time = abs(value - float(np.mean(coarse["y"])))
    unexplained = float(np.var(fine["y"])) / raw if raw else 0.0
    # V at the start becomes the estimate; the difference decays linearly to zero at the horizon, as in the ansatz
    ansatz = dataclasses.replace(ansatz, offset=ansatz.offset + value - ansatz(plant.problem, 0.0, plant.start))
    near = costs(1, FINER // 2 * intervals, plant.horizon / intervals)
    off = near["value"] - near["y"]
    validation = {
        "value": value, "error": 2 * sampling + by_time, "standard_error": sampling, "time_error": by_time,
        "near_error": abs(float(np.mean(off))) + 2 * float(np.std(off) / np.sqrt(FRESH)), "unexplained": unexplained,
        "excess": _excess(plant, ansatz, fine["end"], float(np.var(fine["y"]))),
    }  # fmt: skip
    status = found.status
    if status is Status.MAX_STEPS:
        known = validation["excess"] if np.isfinite(validation["excess"]) else 0.0
        largest = max(validation["error"], validation["near_error"], known)
        accurate = largest <= tol * max(abs(value), np.sqrt(raw)) and unexplained <= EXPLAINED
        status = Status.CONVERGED if accurate else Status.MAX_STEPS
    if not np.isfinite(value):
        status = Status.NONFINITE
    return NeuralSolution(
        jax.tree.map(np.asarray, ansatz), fine["lo"].min(0), fine["hi"].max(0), plant.problem, plant.rule, int(status),
        validation, np.array(found.history), clock.elapsed(),
    )  # fmt: skip
