"""``solve``: the value of a deterministic problem by a network, in more states than a grid holds.

    βV − V_t = min_u [L + f·DV]

The value contains the linear-quadratic solution exactly, see ``ansatz`` and ``riccati``. The loss has two parts. One is
the mean square of the residual of the equation at random states, where the minimum over the controls is exact. The
other compares V and DV with extremals of Pontryagin's principle. They begin at random states, and later where the
residual is largest. This follows T. Nakamura-Zimmerer, Q. Gong and W. Kang, SIAM J. Sci. Comput. 43 (2021). The
residual is relative to the sizes of the terms of the equation, so that units do not matter.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals import equilibria
from hjbjax.extremals.indirect_method import pose
from hjbjax.feedback.simulation import rollout
from hjbjax.hamiltonian import pointwise
from hjbjax.hamiltonian.pointwise import Rule
from hjbjax.neural import ingredients, riccati
from hjbjax.neural.ansatz import HorizonAnsatz, RestAnsatz, TargetAnsatz, norm_of, target_level, terminal_cost
from hjbjax.neural.extremal_samples import TOL, ExtremalSamples
from hjbjax.neural.network import checked_layers, initial_weights
from hjbjax.neural.solution import NeuralSolution, numbers_of_guess, value_of, weights_of_guess
from hjbjax.neural.training import CHUNK, Training, train
from hjbjax.problem import arguments
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast, front_door, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Key, Number, State
from hjbjax.solution.checkpoints import Checkpoint, open_checkpoint
from hjbjax.solution.clock import CUT, Clock, noting_interrupts
from hjbjax.solution.placement import Path
from hjbjax.solution.solution import SolveError
from hjbjax.solution.status import Status

NAME = "neural.solve"
FLOOR = 0.01  # fraction of the mean size of the terms: the least scale of a residual
HELD_OUT, FRESH = 1024, 4 * 1024  # states that choose the best weights, and states of the final residual
EXPONENTS, HALVINGS = (-15.0, 15.0), 44  # cost per unit of the target function, in any units, as powers of ten
CHOOSING = 4  # held-out extremals, at most, that choose the best weights; the others only validate
CANDIDATES = 64  # random states per extremal; the one with the largest residual is its start
ROUNDS = 4  # in which the extremals are computed, half of them before the training
WARM = 0.25  # fraction of the steps over which the weight of the residual grows from zero to one
POINTS = 128  # points of extremals in a batch
ENOUGH = 1e-6  # relative residual of a value that needs no training, such as the linear-quadratic one
BIAS = 0.5  # bias of a network that has to learn the quadratic part


@pytree_dataclass(static=("rule",))
class Equation:
    """The equation on a box.

    Args:
      problem: the settled problem.
      lo: lower corner.
      hi: upper corner.
      horizon: T; zero for a stationary problem.
      floor: the least size of the terms, in cost per unit time.
      rule: the method for the minimum of the Hamiltonian.
    """

    problem: Problem
    lo: Any
    hi: Any
    horizon: Any
    floor: Any
    rule: Rule

    def terms(self, ansatz: Callable, t: Number, x: State) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The residual V_t + min_u [L + f·DV] − βV and the size of its terms, in cost per unit time, and V.

        Residual and size are zero in the target.
        """
        problem = self.problem
        value, (rate, p) = jax.value_and_grad(ansatz, (1, 2))(problem, t, x)
        # the control minimises H, so its own derivative contributes nothing
        u = jax.lax.stop_gradient(pointwise.minimiser(problem, self.rule, t, x, jax.lax.stop_gradient(p)))
        paid = pointwise.running_cost(problem, t, x, u)
        moved = jnp.asarray(problem.drift(*problem.arguments(x, u, t=t)), p.dtype) @ p
        parts = jnp.stack([rate, paid, moved, -problem.discount * value])
        parts = jnp.where(target_level(problem, t, x) > 0, parts, 0)
        return jnp.sum(parts), jax.lax.stop_gradient(jnp.sum(jnp.abs(parts)) / 2), value

    def relative_residual(self, ansatz: Callable, t: Number, x: State) -> jax.Array:
        """The residual relative to its terms."""
        residual, size, _ = self.terms(ansatz, t, x)
        return residual / (size + self.floor)

    @functools.partial(jax.jit, static_argnums=2)
    def places(self, key: Key, count: int) -> tuple[jax.Array, jax.Array]:
        """Random times (count,) and states (count, n)."""
        of_time, of_state = jax.random.split(key)
        states = jax.random.uniform(of_state, (count, np.shape(self.lo)[0]), minval=self.lo, maxval=self.hi)
        return self.horizon * jax.random.uniform(of_time, (count,)), states


@front_door
def solve(
    problem: Problem,
    lo: State | Sequence[float],
    hi: State | Sequence[float],
    *,
    seed: int,
    horizon: float | None = None,
    rest: State | Sequence[float] | None = None,
    quadratic: bool = True,
    extremals: int = 48,
    held_out: int = 16,
    steps: int = 3000,
    batch: int = 256,
    layers: Sequence[int] = (64, 64),
    rate: float = 0.01,
    tol: float = 0.02,
    guess: NeuralSolution | None = None,
    checkpoint: Path | Checkpoint | None = None,
    resume: bool = False,
    time_limit: float | None = None,
    progress: bool | None = None,
) -> NeuralSolution:
    """Value and feedback of a deterministic problem on a box in about 5 to 20 states, by a network.

    Args:
      problem: deterministic, with one player, costs, controls in a ``Box`` or a ``Ball`` with finite bounds, and a rest
        point inside the box, a horizon, or a target. The minimum over the controls must have a formula: drift and cost
        are sums of quadratic polynomials of one control each. The target function must have a nonzero gradient on the
        boundary, such as a signed distance, and V must be above the exit cost near the target in proportion to it.
      lo: lower corner of the box, shape (n,).
      hi: upper corner, shape (n,).

    Keyword Args:
      seed: of the weights and of all random states; the same seed gives the same result on the same machine.
      horizon: T, in units of time; the value then depends on (t, x) and is the terminal cost at T. ``None``: infinite.
      rest: a state near the rest point of an infinite horizon. ``None``: the origin.
      quadratic: False leaves the linear-quadratic solution out of the value, for comparison. With few extremals the
        training may then end at another solution of the equation, such as a negative one. Over a horizon this solution
        belongs to the middle of the box, and is left out if its Riccati equation has none.
      extremals: number of extremals for the training; 0 trains on the residual of the equation only.
      held_out: number of further extremals. At most 4 of them, and at most half, choose the best weights, together with
        the residual; the others are for the validation.
      steps: steps of the optimiser.
      batch: random states per step.
      layers: widths of the hidden layers.
      rate: the initial rate of Adam, which falls to zero over the steps.
      tol: for CONVERGED, the errors of value and costs must be at most tol; without held-out extremals the residual.
      guess: a NeuralSolution of the same problem and box, from whose weights the training starts.
      checkpoint: a file for the state of the training, written every minute and at the end, or
        ``Checkpoint(path, every=)``.
      resume: continue from that file if it exists, with the same bits. All arguments except ``tol``, ``time_limit`` and
        ``progress`` must be the same.
      time_limit: seconds, including compilation.
      progress: show a bar of the steps after a second; ``None``: on a terminal.

    Returns:
      A NeuralSolution. Its ``validation`` has ``residual``, the root mean square of the relative residual at 4096 new
      states; ``value_error`` and ``costate_error``, the relative L2 errors along held-out extremals; ``excess_cost``,
      the mean relative excess of the costs of closed loops over the costs of these extremals; ``worst_excess``, the
      largest; and ``failed``, the number of starts without an extremal.

    Raises:
      ValueError: an ingredient of the problem that is not supported, no rest point, or an argument that is not
        admissible.
      FileExistsError: the checkpoint exists, without ``resume``.
      FileError: the checkpoint belongs to another problem or other arguments, is in use by another run, or cannot be
        written.
      SolveError: Ctrl-C or the time limit before the training began.
    """
    corners = ingredients.box_corners(lo, hi, NAME)
    counts = [arguments.count(each, f"{NAME}: {name}") for each, name in ((steps, "steps"), (batch, "batch"))]
    for number, name in ((extremals, "extremals"), (held_out, "held_out")):
        arguments.count(number, f"{NAME}: {name}", least=0)
    rate = float(arguments.positive(rate, f"{NAME}: rate"))
    if horizon is not None:
        horizon = float(arguments.positive(horizon, f"{NAME}: horizon", "in units of time"))
    arguments.positive(tol, f"{NAME}: tol")
    widths, seed = checked_layers(layers, NAME), ingredients.known_seed(seed, NAME)
    clock, n = Clock(seconds=time_limit, progress=progress), len(corners[0])
    asked: Any = {
        "lo": corners[0], "hi": corners[1], "seed": seed, "horizon": horizon,
        "rest": None if rest is None else np.asarray(rest).tolist(), "quadratic": bool(quadratic),
        "extremals": int(extremals), "held_out": int(held_out), "steps": counts[0], "batch": counts[1],
        "layers": widths, "rate": rate, "guess": numbers_of_guess(guess),
    }  # fmt: skip
    with noting_interrupts(clock), own_settings(x64=True):
        settled, rule = ingredients.settled_problem(problem, n, NAME, {"noise": "see deep_bsde"})
        assert rule is not None
        equation = Equation(settled, jnp.asarray(corners[0]), jnp.asarray(corners[1]), 0.0, 0.0, rule)
        with open_checkpoint(checkpoint, [settled], n, resume=resume, caller=NAME, **asked) as file:
            clock.journal = file and file.journal()
            equation, ansatz, options = _begun(equation, horizon, rest, quadratic, seed, widths)
            if guess is not None:
                begun = weights_of_guess(guess, np.shape(ansatz.weights[0][0])[0], widths, NAME)
                ansatz = dataclasses.replace(ansatz, weights=begun)
            seen, chosen, unseen = _samples(settled, corners, options, (extremals, held_out), seed, clock)
            found = _trained(equation, ansatz, (seen, chosen), counts, rate, seed, clock)
        if found.status in CUT and not found.history:
            raise SolveError(f"{NAME}: {found.status}, before the training began")
        ansatz = jax.tree.map(np.asarray, dataclasses.replace(ansatz, weights=found.weights))
        solution = NeuralSolution(ansatz, *corners, settled, rule)
        failed = {"failed": float(seen.failed + chosen.failed + unseen.failed)}
        validation = _validation(equation, solution, unseen, seed) | failed
        status = found.status
        if status in (Status.MAX_STEPS, Status.CONVERGED):
            judged = ("value_error", "excess_cost") if unseen.starts else ("residual",)
            status = Status.CONVERGED if all(abs(validation[name]) <= tol for name in judged) else Status.MAX_STEPS
        return dataclasses.replace(
            solution, code=int(status), validation=validation, history=np.array(found.history), seconds=clock.elapsed()
        )


def _samples(
    problem: Problem,
    corners: tuple[np.ndarray, np.ndarray],
    options: dict[str, Any],
    counts: tuple[int, int],
    seed: int,
    clock: Clock,
) -> tuple[ExtremalSamples, ExtremalSamples, ExtremalSamples]:
    """Empty samples for the training, and the held-out ones that choose the best weights and that validate."""
    extremals, held_out = counts
    choosing, draw = min(CHOOSING, held_out // 2), np.random.default_rng(seed)
    sizes = (extremals, choosing, held_out - choosing)
    seen, chosen, unseen = (ExtremalSamples(*corners, size, options) for size in sizes)
    for held in (unseen, chosen):
        held.collect_all(problem, draw.uniform(*corners, (2 * held.capacity, len(corners[0]))), clock)
    return seen, chosen, unseen


def _begun(
    equation: Equation, horizon: float | None, rest: Any, quadratic: bool, seed: int, widths: tuple[int, ...]
) -> tuple[Equation, Any, dict[str, Any]]:
    """The equation with its floor, the ansatz before the training, and the options of its extremals."""
    n = len(np.asarray(equation.lo))
    if equation.problem.target is not None:
        if horizon is not None or equation.problem.time_dependent:
            raise ValueError(
                f"{NAME}: got a target together with a horizon or a dependence on time, wanted a problem that runs\n"
                "until it reaches the target. Leave out horizon=, or solve it on a grid"
            )
        return *_to_target(equation, initial_weights(seed, n, widths)), {}
    if horizon is None:
        weights = initial_weights(seed, n, widths, bias=0.0 if quadratic else BIAS)
        equation, at_rest = _at_rest(equation, rest, quadratic, weights)
        return equation, at_rest, {"rest": at_rest.state}
    return *_over_horizon(equation, horizon, quadratic, initial_weights(seed, n + 2, widths)), {"horizon": horizon}


def _to_target(equation: Equation, weights: Any) -> tuple[Equation, TargetAnsatz]:
    """The equation with its floor, and a cost to the target proportional to l, whose residual has the median zero."""
    places = equation.places(jax.random.key(0), HELD_OUT)
    levels = np.asarray(jax.jit(jax.vmap(lambda t, x: target_level(equation.problem, t, x)))(*places))
    if not np.any(levels > 0):
        raise ValueError(f"{NAME}: all of {HELD_OUT} random states of the box are in the target; wanted a larger box")
    ansatz = TargetAnsatz(weights, (equation.lo + equation.hi) / 2, (equation.hi - equation.lo) / 2, 0.0)
    low, high, size = *EXPONENTS, 0.0
    for _ in range(HALVINGS):  # at half of the states the residual is positive: V grows too slowly there
        middle = (low + high) / 2
        ansatz = dataclasses.replace(ansatz, scale=10.0**middle)
        residuals, sizes, _ = _terms_at(equation, ansatz, places)
        low, high = (middle, high) if np.median(residuals[levels > 0]) > 0 else (low, middle)
        size = float(np.mean(sizes[levels > 0]))
    if min(high - EXPONENTS[0], EXPONENTS[1] - low) < 1:
        raise ValueError(f"{NAME}: found no cost that grows with the distance from the target; check cost and drift")
    return dataclasses.replace(equation, floor=FLOOR * size), ansatz


def _at_rest(equation: Equation, near: Any, quadratic: bool, weights: Any) -> tuple[Equation, RestAnsatz]:
    """The equation with its floor, and the linear-quadratic solution at the rest point with a network."""
    lo, hi = np.asarray(equation.lo), np.asarray(equation.hi)
    near = np.zeros(len(lo)) if near is None else ingredients.state(near, f"{NAME}: rest")
    rest, _ = equilibria.find(pose(equation.problem, hi, None, None, None), near, np.zeros(len(lo)))
    state, matrix, size = np.asarray(rest.state), np.asarray(rest.matrix), (hi - lo) / 2
    if np.any((state < lo) | (state > hi)):
        raise ValueError(f"{NAME}: the rest point {state.tolist()} is outside the box; wanted it inside")
    ansatz = RestAnsatz(
        weights, state, np.asarray(rest.costate), np.asarray(rest.value), matrix, norm_of(matrix, size), size
    )
    _, sizes, _ = _terms_at(equation, ansatz, equation.places(jax.random.key(0), HELD_OUT))
    equation = dataclasses.replace(equation, floor=FLOOR * np.mean(sizes))
    return equation, ansatz if quadratic else dataclasses.replace(ansatz, matrix=0 * matrix, quadratic=False)


def _over_horizon(equation: Equation, horizon: float, quadratic: bool, weights: Any) -> tuple[Equation, HorizonAnsatz]:
    """The equation with its horizon and floor, and terminal cost and linear-quadratic solution with a network."""
    equation = dataclasses.replace(equation, horizon=horizon)
    lo, hi = np.asarray(equation.lo), np.asarray(equation.hi)
    places = equation.places(jax.random.key(0), HELD_OUT)
    paid = np.asarray(jax.jit(jax.vmap(lambda x: terminal_cost(equation.problem, horizon, x)))(places[1]))
    spread = float(np.std(paid)) or 1.0
    ansatz = HorizonAnsatz(weights, horizon, (lo + hi) / 2, (hi - lo) / 2, float(np.mean(paid)), spread, spread, 0.0)
    found = riccati.coefficients(equation.problem, equation.rule, ansatz.center, horizon) if quadratic else None
    if found is not None:
        ansatz = dataclasses.replace(ansatz, **found._asdict())
    residuals, sizes, _ = _terms_at(equation, ansatz, places)
    equation = dataclasses.replace(equation, floor=FLOOR * np.mean(sizes))
    # the residual adds up along a path to the difference of V and the linear-quadratic solution
    rate = float(np.mean(sizes if found is None else np.abs(residuals)))
    return equation, dataclasses.replace(ansatz, scale=horizon * rate or spread)


@jax.jit
def _terms(equation: Equation, ansatz: Any, t: Array, x: Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """``Equation.terms`` at times (k,) and states (k, n)."""
    return jax.vmap(lambda t, x: equation.terms(ansatz, t, x))(t, x)


def _terms_at(equation: Equation, ansatz: Any, places: tuple[Array, Array]) -> list[np.ndarray]:
    """``Equation.terms`` at some places, in blocks of the same size, so that one program serves all."""
    t, x = (np.asarray(each) for each in places)
    equation, ansatz = cast((equation, ansatz), np.float64)
    blocks = []
    for first in range(0, len(t), HELD_OUT):
        rows = np.resize(np.arange(first, min(first + HELD_OUT, len(t))), HELD_OUT)
        blocks.append([np.asarray(each) for each in _terms(equation, ansatz, t[rows], x[rows])])
    return [np.concatenate(parts)[: len(t)] for parts in zip(*blocks, strict=True)]


def _relative_residuals(equation: Equation, ansatz: Any, places: tuple[Array, Array]) -> np.ndarray:
    """The residuals relative to their terms, shape (k,)."""
    residuals, sizes, _ = _terms_at(equation, ansatz, places)
    return residuals / (sizes + float(equation.floor))


def _loss(equation: Equation, ansatz: Any, key: Key, data: Any, least: float, batch: int) -> jax.Array:
    """The mean square of the residual at random states and of the errors along extremals.

    Args:
      equation: the equation.
      ansatz: the value.
      key: of the states and of the points of extremals.
      data: points of extremals, and the weights of both parts.
      least: the size of values below which errors are not relative, cost units.
      batch: the number of random states.
    """
    of_states, of_points = jax.random.split(key)
    size = (equation.hi - equation.lo) / 2
    rows = jax.random.randint(of_points, (POINTS,), 0, data["count"])

    def misfit(t: Number, x: State, value: Number, costate: State) -> jax.Array:
        found, p = jax.value_and_grad(ansatz, 2)(equation.problem, t, x)
        scale = jnp.abs(value) + least
        return ((found - value) / scale) ** 2 + jnp.mean(((p - costate) * size / scale) ** 2)

    apart = jax.vmap(misfit)(*(data[name][rows] for name in ("times", "states", "values", "costates")))
    places = equation.places(of_states, batch)
    residuals = jax.vmap(lambda t, x: equation.relative_residual(ansatz, t, x))(*places)
    return data["share"] * jnp.mean(residuals**2) + data["weight"] * jnp.mean(apart)


def _held_out_error(equation: Equation, ansatz: Any, places: tuple[Array, Array], chosen: ExtremalSamples) -> float:
    """The root of the sum of the squares of the relative residual and of the error of V along held-out extremals.

    The equation has several solutions, so the residual does not show a wrong one.
    """
    residual = np.sqrt(np.mean(_relative_residuals(equation, ansatz, places) ** 2))
    if not chosen.count:
        return float(residual)
    rows = slice(0, chosen.count)
    _, _, found = _terms_at(equation, ansatz, (chosen.times[rows], chosen.states[rows]))
    # the extremals themselves are exact to about TOL
    apart = max(_relative(found - chosen.values[rows], chosen.values[rows]) - TOL, 0.0)
    return float(np.hypot(residual, apart))


def _trained(
    equation: Equation,
    ansatz: Any,
    samples: tuple[ExtremalSamples, ExtremalSamples],
    counts: Sequence[int],
    rate: float,
    seed: int,
    clock: Clock,
) -> Training:
    """The training on the residual and on extremals, some of which are added on the way."""
    (seen, chosen), (steps, batch) = samples, counts
    pure = isinstance(ansatz, RestAnsatz) and not ansatz.quadratic
    _, _, values = _terms_at(equation, ansatz, equation.places(jax.random.key(0), HELD_OUT))
    # without its quadratic part the initial value may be zero everywhere; the mean of |y|² is as large as the exact one
    typical = np.sum(np.diagonal(ansatz.norm) * ansatz.size**2) / 3 if pure else np.mean(np.abs(values))
    least = max(FLOOR * typical, np.finfo(float).tiny)

    def of(weights: Any) -> Any:
        return dataclasses.replace(ansatz, weights=weights)

    def loss(weights: Any, key: Key, data: Any) -> jax.Array:
        return _loss(equation, of(weights), key, data, least, batch)

    held_out = equation.places(jax.random.key(seed + 1), HELD_OUT)

    def measure(weights: Any) -> float:
        return _held_out_error(equation, of(weights), held_out, chosen)

    chunks = -(-steps // CHUNK)
    rounds = {chunks * k // ROUNDS: -(-seen.capacity // (2 * (ROUNDS - 1))) for k in range(1, ROUNDS)}
    rounds[0] = seen.capacity // 2 + seen.capacity % 2
    if pure:  # the Riccati equation alone has up to 2ⁿ solutions: compute all extremals before the residual counts
        rounds = {0: seen.capacity}

    def refresh(weights: Any, number: int, keep: Callable) -> Any:
        if (share := rounds.get(number, 0)) and len(seen.starts) < seen.capacity:
            places = equation.places(jax.random.key(seed + 2 + number), CANDIDATES * share)
            # at the start of a pure network the residual only measures the distance to the rest point
            large = np.zeros(share * CANDIDATES) if pure else np.abs(_relative_residuals(equation, of(weights), places))
            worst = np.argmax(large.reshape(share, CANDIDATES), axis=1)
            starts = np.asarray(places[1]).reshape(share, CANDIDATES, -1)[np.arange(share), worst]
            earlier = sum(size for begun, size in rounds.items() if begun < number)
            seen.collect(equation.problem, starts, clock, earlier=earlier, keep=keep)
        # the equation has other solutions, also negative ones; begin with the extremals, which are near the value
        weight = min(1.0, number / (WARM * chunks)) if seen.count else 1.0
        return seen.arrays() | {"share": jnp.asarray(weight)}

    return train(
        loss, measure, ansatz.weights, steps=steps, rate=rate, seed=seed, clock=clock, enough=ENOUGH, samples=seen,
        refresh=refresh,
    )  # fmt: skip


def _validation(equation: Equation, solution: NeuralSolution, unseen: ExtremalSamples, seed: int) -> dict[str, float]:
    """Errors at states and along extremals that training has not seen."""
    places = equation.places(jax.random.key(seed + 1_000_000), FRESH)
    found = {"residual": float(np.sqrt(np.mean(_relative_residuals(equation, solution.ansatz, places) ** 2)))}
    if not unseen.starts:
        return found
    rows, size = slice(0, unseen.count), np.asarray(equation.hi - equation.lo)
    values, slopes, states = unseen.values[rows], unseen.costates[rows] * size, unseen.states[rows]
    where = (states,) if solution.horizon is None else (unseen.times[rows], states)
    found["value_error"] = _relative(solution.value_at(*where, extrapolate=True) - values, values)
    found["costate_error"] = _relative(solution.costate_at(*where, extrapolate=True) * size - slopes, slopes)
    excess = closed_loop_costs(solution, np.stack(unseen.starts), unseen.longest) / np.array(unseen.costs) - 1
    return found | {"excess_cost": float(np.mean(excess)), "worst_excess": float(np.max(excess))}


def _relative(error: np.ndarray, exact: np.ndarray) -> float:
    """The relative error in the root mean square."""
    return float(np.sqrt(np.sum(error**2) / np.sum(exact**2)))


def closed_loop_costs(solution: NeuralSolution, starts: np.ndarray, duration: float) -> np.ndarray:
    """The costs of closed loops from some starts (k, n), shape (k,).

    Args:
      solution: the solution; a stationary one pays V at the end of a path, which is near the rest point.
      starts: the states at time 0.
      duration: the length of the paths; the horizon if there is one.
    """

    def cost(solution: NeuralSolution, start: State) -> jax.Array:
        problem = solution.problem
        assert problem is not None
        timed = solution.horizon is not None
        path = rollout(
            problem, solution.control_at, start, jnp.asarray([0.0, duration]), max_step=duration, time_varying=timed,
            due="terminal cost" if timed else "nothing",
        )  # fmt: skip
        left = 0.0 if timed else jnp.exp(-problem.discount * duration) * value_of(solution, 0.0, path.states[-1])
        # a path that reached its target has paid the exit cost
        return path.cost + jnp.where(jnp.isfinite(path.reached), 0.0, left)

    return np.asarray(jax.jit(jax.vmap(cost, (None, 0)))(solution, jnp.asarray(starts)))
