"""The dissipation inequality of a robust feedback, checked along simulated paths.

    ∫ L(x, u, 0) dt ≤ ∫ [L(x, u, 0) − L(x, u, d)] dt + V(x₀)    for every d, with u the feedback of the solution.

For the cost ½|z|² − ½γ²|d|² of an L₂ gain this is half of ∫|z|² ≤ γ²∫|d|² + β₀(x₀) with β₀ = 2V. The left side is the
energy of the output, the integral on the right is the energy that the disturbance supplies, and V is the energy stored
at the start. The inequality holds for any final time, since V ≥ 0 at the end. Under the worst disturbance it becomes an
equality as time goes on; a random disturbance leaves a margin. V and u have discretisation errors, so the margin of the
worst case may be negative by their size. If the bounds on the disturbances were active (see ``saturation``), the result
says nothing about larger disturbances.

The integrator of ``simulate`` computes both integrals to its accuracy. Random disturbances are linear between
independent points at equally spaced times. The points are uniform in the set, scaled by a strength between 0.01 and 1,
so that the disturbances are neither all weak nor all so strong that the inequality is trivial. A box without 0 is
scaled about its point nearest to 0, so that the disturbances stay in it.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.path import Path, PathStatus
from hjbjax.feedback.simulation import rollout
from hjbjax.problem import arguments
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, cast, front_door, pytree_dataclass
from hjbjax.problem.rewards import refuse_rewards
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Finite, Simplex, refuse_unbounded
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Key, Number, Numbers, State
from hjbjax.solution.solution import Solution
from hjbjax.tracing import closures

POINTS = 33  # per random disturbance
STEPS = 64  # output intervals per path: two between neighbouring points, so that no step crosses a kink
WEAKEST = 0.01  # strength of the weakest random disturbance relative to the set

Energies: TypeAlias = tuple[jax.Array, jax.Array, jax.Array, jax.Array]  # output, whole cost, last state, PathStatus


@pytree_dataclass()
class _Lanes:
    """Paths under the worst case or under a random signal, one row per path.

    Args:
      starts: x₀, shape (p, n).
      weights: the weight of the worst case, shape (p,): 1 or 0.
      points: the points of the added signal, shape (p, POINTS, l).
    """

    starts: Array
    weights: Array
    points: Array


@dataclasses.dataclass(frozen=True, eq=False)
class Dissipation:
    """Energies along paths, one entry per path, in cost units (halves of squares for the cost ½|z|² − ½γ²|d|²).

    Args:
      starts: x₀, shape (p, n).
      disturbances: "worst case", "random" or "given", p words.
      output: the energy of the output, ∫ L(x, u, 0) dt, shape (p,).
      supplied: the energy supplied by the disturbance, ∫ [L(x, u, 0) − L(x, u, d)] dt, shape (p,).
      stored: V(x₀), shape (p,).
      ends: the state at the end, shape (p, n).
      statuses: the reason why each path ends.
    """

    starts: np.ndarray
    disturbances: tuple[str, ...]
    output: np.ndarray
    supplied: np.ndarray
    stored: np.ndarray
    ends: np.ndarray
    statuses: tuple[PathStatus, ...]

    @property
    def margin(self) -> np.ndarray:
        """stored + supplied − output, shape (p,): ≥ 0 if the inequality holds; NaN if the path failed."""
        return self.stored + self.supplied - self.output

    @property
    def worst(self) -> float:
        """The smallest margin; NaN if any margin is NaN."""
        return float(np.min(self.margin))

    def __str__(self) -> str:
        lines = [f"{len(self.output)} paths, smallest margin {self.worst:.3g}"]
        lines.append(f"{'disturbance':<12} {'paths':>5} {'output':>9} {'supplied':>9} {'stored':>9} {'margin':>9}")
        for kind in dict.fromkeys(self.disturbances):
            rows = np.flatnonzero(np.array(self.disturbances) == kind)
            tight = rows[np.argmin(self.margin[rows])]
            numbers = (self.output[tight], self.supplied[tight], self.stored[tight], self.margin[tight])
            lines.append(f"{kind:<12} {len(rows):>5} " + " ".join(f"{number:>9.3g}" for number in numbers))
        return "\n".join(lines)


@front_door
def dissipation(
    problem: Problem,
    solution: Solution,
    x0s: Numbers | Sequence,
    duration: float,
    *,
    disturbances: Sequence[Callable] = (),
    random: int = 8,
    key: Key | int = 0,
    rtol: float = 1e-6,
) -> Dissipation:
    """Check ∫|z|² ≤ γ²∫|d|² + β₀(x₀) along paths with the worst, with random and with given disturbances.

    Args:
      problem: the game, with a cost such as ½|z|² − ½γ²|d|².
      solution: its stationary solution, such as ``hinf_level(...).solution``, with V, feedback and worst case.
      x0s: the initial states, shape (k, n), or (n,) for one; inside the grid.
      duration: the length of each path, in units of time, unless it leaves the grid earlier.
      disturbances: more signals, functions (t, x) -> (l,).
      random: the number of random disturbances per initial state; must be 0 for a finite set.
      key: a JAX random key or an integer.
      rtol: relative error of an internal step.

    Returns:
      The energies of k (1 + random + given) paths and their margins; ``print`` shows the tightest margin of each kind.

    Raises:
      ValueError: the problem has no disturbances, or has noise; random disturbances are requested from a finite set;
        the solution was marched; or a start is outside the grid.
      TypeError: a signal that cannot be called.

    Example:
      >>> import hjbjax as hjb
      >>> problem, grid = hjb.zoo.lq_game(shape=(41,))
      >>> x, p = grid.nodes(), 2 / 3**0.5  # V = px², u = −px, d = px/γ² with γ = 2, as ``solve`` finds them
      >>> solution = hjb.Solution(grid, p * x[..., 0] ** 2, -p * x, p * x / 4)
      >>> bool(hjb.dissipation(problem, solution, [[0.5]], 3.0, random=3).worst > -1e-3)
      True
    """
    starts = _check(problem, solution, x0s, duration, disturbances, random)
    key = arguments.random_key(key, "dissipation: key")
    import diffrax  # noqa: F401  # before the first compilation, see simulate

    with own_settings(x64=True):  # the margin is a difference of energies, near zero in the worst case
        n = starts.shape[1]
        problem, solution = cast(closures.settled(problem, n), np.float64), cast(solution, np.float64)
        times = np.linspace(0.0, float(duration), STEPS + 1)
        lanes, kinds = _lanes(problem, starts, random, key)
        found = [_energies(problem, solution, lanes, times, rtol)]
        for signal in disturbances:
            given = closures.settled_function(signal, (), (n,))
            found.append(_energies_under(problem, solution, given, starts, times, rtol))
        output, total, ends, codes = (np.concatenate(each) for each in zip(*jax.device_get(found), strict=True))
        stored = np.asarray(solution.value_at(starts))
    count = len(output) // len(starts)  # paths per initial state; each disturbance has one path from every state
    statuses = tuple(PathStatus(int(code)) for code in codes)
    # a path that becomes infinite ends at its last finite state, whose energies do not cover the whole duration
    output = np.where([status is PathStatus.NONFINITE for status in statuses], np.nan, output)
    return Dissipation(
        np.tile(starts, (count, 1)),
        tuple(kinds) + ("given",) * (len(output) - len(kinds)),
        output,
        output - total,  # ∫ L(x, u, 0) − ∫ L(x, u, d)
        np.tile(stored, count),
        ends,
        statuses,
    )


def _lanes(problem: Problem, starts: np.ndarray, random: int, key: Key) -> tuple[_Lanes, list[str]]:
    """The paths with the worst case and with random disturbances, in this order, and the kind of each."""
    admissible, count = problem.disturbances, random * len(starts)
    assert admissible is not None
    # equally spaced in the logarithm: each decade down to WEAKEST gets its share, and the last covers the whole set
    strength = np.geomspace(WEAKEST, 1.0, random) if random > 1 else np.ones(random)
    # the point of the set nearest to 0, about which the set is scaled
    least = _nearest_zero(admissible)
    away = np.zeros((0, POINTS, admissible.dim))
    if count:
        assert not isinstance(admissible, Finite)  # refused together with random > 0
        away = np.asarray(_sample(admissible, key, (count, POINTS))) - least
    points = least + np.repeat(strength, len(starts))[:, None, None] * away
    still = np.zeros((len(starts), POINTS, admissible.dim))
    weight = np.repeat([1.0, 0.0], [len(starts), count])
    lanes = _Lanes(np.tile(starts, (1 + random, 1)), weight, np.concatenate([still, points]))
    return lanes, ["worst case"] * len(starts) + ["random"] * count


def _nearest_zero(admissible: AdmissibleSet) -> np.ndarray:
    """The admissible disturbance nearest to zero, shape (l,)."""
    if isinstance(admissible, Box):
        return np.clip(0.0, admissible.lo, admissible.hi)
    if isinstance(admissible, Simplex) and not admissible.at_most:
        return np.full(admissible.dim, np.asarray(admissible.total) / admissible.dim)
    return np.zeros(admissible.dim)


def _sample(admissible: Box | Ball | Simplex, key: Key, shape: tuple[int, ...]) -> jax.Array:
    """Independent points, uniform in a set, shape (*shape, l)."""
    if isinstance(admissible, Box):
        return jax.random.uniform(key, (*shape, admissible.dim), minval=admissible.lo, maxval=admissible.hi)
    if isinstance(admissible, Simplex):  # with at_most the rest of the total is one more part
        parts = jax.random.dirichlet(key, jnp.ones(admissible.freedom + 1), shape)
        return admissible.total * parts[..., : admissible.dim]
    return admissible.radius * jax.random.ball(key, admissible.dim, shape=shape)


def _disturbance(look: Callable, weight: Number, points: Array, duration: Number, t: Number, x: State) -> Array:
    """The worst case times ``weight``, plus a signal that is linear between its points."""
    # interpolate by index, because the points are equally spaced; the last cell extends past the end of the path
    place = jnp.clip(t / duration, 0, 1) * (POINTS - 1)
    cell = jnp.clip(jnp.floor(place).astype(int), 0, POINTS - 2)
    signal = points[cell] + (place - cell) * (points[cell + 1] - points[cell])
    # nan_to_num, because weight 0 times NaN, where the solution knows no worst case, would be NaN
    return weight * jnp.nan_to_num(look(x, clamp=True)) + signal


def _running_cost(cost: Callable, share: Number, *arguments: Array) -> jax.Array:
    """L(x, u, d) for share = 1, L(x, u, 0) for share = 0."""
    *seen, d = arguments
    still = cost(*seen, jnp.zeros_like(d))
    return still + share * (cost(*arguments) - still)


@jax.jit
def _energies(problem: Problem, solution: Solution, lanes: _Lanes, times: Array, rtol: Number) -> Energies:
    """The energy of the output, the whole cost, the last state and the status, for every lane."""

    def lane(each: _Lanes) -> Energies:
        worst = as_partial(solution.disturbance_at)
        opponent = jax.tree_util.Partial(_disturbance, worst, each.weights, each.points, times[-1])
        return _path_energies(problem, solution, opponent, each.starts, times, rtol)

    return jax.vmap(lane)(lanes)


@jax.jit
def _energies_under(
    problem: Problem, solution: Solution, signal: Callable, starts: Array, times: Array, rtol: Number
) -> Energies:
    """The energies of the paths from all starts under one user-supplied signal."""
    return jax.vmap(lambda start: _path_energies(problem, solution, signal, start, times, rtol))(starts)


def _path_energies(
    problem: Problem, solution: Solution, opponent: Callable, start: State, times: Array, rtol: Number
) -> Energies:
    """The energies of one path, integrated twice side by side, because an integrator carries one running cost."""

    def run(share: jax.Array) -> Path:
        measured = dataclasses.replace(problem, cost=jax.tree_util.Partial(_running_cost, problem.cost, share))
        return rollout(measured, solution, start, times, disturbance=opponent, time_varying=True, rtol=rtol)

    path = jax.vmap(run)(jnp.arange(2.0))  # share 0 and share 1
    return path.cost[0], path.cost[1], path.states[0, -1], path.code[0]


def _check(
    problem: Problem,
    solution: Solution,
    x0s: Numbers | Sequence,
    duration: object,
    signals: Sequence[object],
    random: object,
) -> np.ndarray:
    """The initial states, shape (k, n), after checks that the inequality applies to these paths."""
    closures.refuse_traced("dissipation", problem, solution, x0s)
    refuse_rewards(problem, "dissipation", "the inequality is about the energy of an output, which is a cost")
    if problem.disturbances is None or solution.disturbance is None or problem.cost is None:
        raise ValueError("dissipation: wanted a game with a cost, as hjb.attenuation(plant, gamma, hjb.Box(...))")
    if problem.noise is not None:
        raise ValueError("dissipation: with noise the inequality holds in the mean only; leave out the noise")
    if solution.times is not None or problem.time_dependent:
        raise ValueError("dissipation: wanted a stationary problem and solution, of hjb.solve or hjb.hinf_level")
    if isinstance(duration, bool) or not isinstance(duration, (int, float)) or not 0 < duration < np.inf:
        raise ValueError(f"dissipation: duration is {duration!r}, wanted a finite number > 0")
    if isinstance(random, bool) or not isinstance(random, int) or random < 0:
        raise ValueError(f"dissipation: random is {random!r}, wanted the number of random disturbances, an integer ≥ 0")
    if random:
        refuse_unbounded(problem.disturbances, "dissipation", "random disturbances are uniform between them")
    if random and isinstance(problem.disturbances, Finite):
        raise ValueError(
            f"dissipation: the disturbances are {len(problem.disturbances.points)} points, and random ones would run "
            "between them; wanted a Box, a Ball or a Simplex, or random=0"
        )
    for signal in signals:
        if not callable(signal):
            raise TypeError(f"dissipation: got {signal!r} among the disturbances, wanted functions (t, x) -> (l,)")
    starts = np.atleast_2d(np.asarray(x0s, np.float64))
    if starts.ndim != 2 or starts.shape[1] != solution.grid.ndim:
        raise ValueError(f"dissipation: x0s has shape {np.shape(x0s)}, wanted (k, {solution.grid.ndim})")
    if np.any(solution.grid.beyond(starts)) or not np.all(np.isfinite(solution.value_at(starts))):
        raise ValueError("dissipation: a start is outside the grid, or where the value is not finite; start inside")
    return starts
