"""Feedbacks from solutions: interpolated between the nodes, or the minimiser of the Hamiltonian at the state.

    u(x) = argmin_u max_d [ L(x, u, d) + f(x, u, d)·DV(x) + ½ tr(σσᵀ(x, u, d) D²V(x)) ]

with DV the interpolated central differences of ``costate_at`` and D²V from V one cell away, which beyond an end of the
box goes on as the scheme has it: mirrored at a wall, on a parabola at an open end. Where a control jumps
between two nodes, their mean is optimal for neither, and of an enumerated set not even a member; the minimiser jumps
with DV.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.schemes import Limited
from hjbjax.discretisation.stencil import Links
from hjbjax.hamiltonian.discrete import DiscreteHamiltonian
from hjbjax.hamiltonian.optimum import optimise
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_jax, as_partial, cast, front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Costate, DType, Number, Numbers, State
from hjbjax.solution.interpolation import extended
from hjbjax.solution.solution import Solution
from hjbjax.tracing.closures import settled

if TYPE_CHECKING:
    from typing_extensions import TypeIs

FEWEST = 10  # intervals between kept times that a marched feedback must have over a path
ROUNDING = 1e-9  # relative, of times: one of two that are compared may be a sum of steps

Place: TypeAlias = Numbers | Sequence  # a state, shape (n,) or (..., n), or the time that goes before it


class GridFeedback(Protocol):
    """Both players on a grid, looked up between its nodes, as a Solution or a ``greedy_feedback`` has them."""

    @property
    def grid(self) -> Grid:
        """The nodes, in whose box the players are known."""

    @property
    def times(self) -> Array | None:
        """The kept times of a march; None of a stationary feedback."""

    @property
    def disturbance(self) -> Array | None:
        """Not None exactly where the worst case is known."""

    @property
    def control_at(self) -> Callable[..., Array]:
        """The control at (x), of a marched one at (t, x); with the keyword ``clamp``."""

    @property
    def disturbance_at(self) -> Callable[..., Array]:
        """The opponent's action there."""


def is_grid_feedback(feedback: object) -> "TypeIs[GridFeedback]":
    """True for a Solution and for what answers as one does, False for a plain function of the state."""
    return hasattr(feedback, "control_at")


def check_kept(solution: GridFeedback, duration: float, name: str) -> float:
    """Refuse a marched feedback that is not known well enough up to the duration.

    Args:
      solution: a marched solution, its times known numbers.
      duration: how long it is to act, from t = 0.
      name: who asks and what it calls the duration, for refusals.

    Returns:
      The horizon up to which it was marched.

    Raises:
      ValueError: the kept times end before, or are too far apart.
    """
    times = np.asarray(solution.times, np.float64)
    horizon = float(getattr(solution, "stats", {}).get("horizon", times[-1]))
    if duration > horizon * (1 + ROUNDING):
        raise ValueError(f"{name} = {duration:g} goes beyond the horizon {horizon:g} of the solution; shorten it")
    # between two kept times the feedback is linear: with the two ends among them, no gap may be wider than a tenth
    between = np.concatenate([[0.0], times[(times > 0) & (times < duration)], [duration]])
    gap = float(np.max(np.diff(between)))
    if times[0] > 0 or times[-1] < duration * (1 - ROUNDING) or gap > duration / FEWEST * (1 + ROUNDING):
        raise ValueError(
            f"{name} = {duration:g}, but the solution was marched and kept at {times.size} times from {times[0]:g} to "
            f"{times[-1]:g}; a feedback up to t = {duration:g} wants all of that covered,\n"
            f"at most {duration / FEWEST:g} apart: march(..., times=np.linspace(0, {horizon:g}, 41))"
        )
    return horizon


def lookups(feedback: GridFeedback) -> tuple[Callable, Callable]:
    """The control and the disturbance of a Solution, or of what answers as one does, as functions of (t, x).

    A state outside the target may lie in a cell whose nodes are all in it, as beside a hollow one. There the nodes
    around the cell answer.
    """
    answers: list[GridFeedback] = [feedback]
    if isinstance(feedback, Solution):
        players = {"policy": feedback.discrete, "disturbance": feedback.discrete_disturbance}
        given = {name: getattr(feedback, name) for name in players if getattr(feedback, name) is not None}
        # nodes without a control get that of their neighbours: asked second, they answer where a whole cell is NaN
        filled = {name: extended(feedback.grid, array, players[name]) for name, array in given.items()}
        answers.append(dataclasses.replace(feedback, **filled))
    ask = _look_up if feedback.times is None else _look_up_in_time
    control, disturbance = (
        jax.tree_util.Partial(ask, tuple(as_partial(getattr(each, name)) for each in answers))
        for name in ("control_at", "disturbance_at")
    )
    return control, disturbance


# The loop clips every state into the box before it asks; clamp=True, or one on the edge is refused for a rounding.
# An integrator traces its right-hand side some twenty times; within ``jit`` a lookup is traced once: 1 s in place of 2.


def _look_up(looks: tuple[Callable, ...], t: Number, x: State) -> Array:
    """The first of several lookups at x that is not NaN, whatever the time."""
    return _first_at(as_jax(looks), x)


def _look_up_in_time(looks: tuple[Callable, ...], t: Number, x: State) -> Array:
    """The first of several lookups at (t, x) that is not NaN."""
    return _first_at(as_jax(looks), t, x)


@functools.partial(jax.jit, inline=True)
def _first_at(looks: tuple[Callable, ...], *where: Array) -> Array:
    """The first answer, entry by entry the next one where it is NaN."""
    answer, *others = [look(*where, clamp=True) for look in looks]
    for other in others:
        answer = jnp.where(jnp.isnan(answer), other, answer)
    return answer


@pytree_dataclass()
class Greedy:
    """The feedback of ``greedy_feedback``; called with (x), of a marched solution with (t, x).

    It answers as a Solution does, so that ``simulate`` takes its grid, its times and its worst case from it.

    Args:
      problem: whose Hamiltonian is minimised.
      solution: whose value brings the slopes.
    """

    problem: Problem
    solution: Solution

    def __call__(self, *where: Place) -> Array:
        """The control, shape (m,); outside the grid that of its nearest point."""
        return self.control_at(*where, clamp=True)

    def control_at(self, *where: Place, clamp: bool = False) -> Array:
        """The minimising control, shape ``x.shape[:-1] + (m,)``; arguments and refusals as of a Solution's."""
        return self._ask(where, clamp)[0]

    def disturbance_at(self, *where: Place, clamp: bool = False) -> Array:
        """The maximising disturbance, shape ``x.shape[:-1] + (l,)``."""
        return self._ask(where, clamp)[1]

    @property
    def grid(self) -> Grid:
        """The grid of the solution."""
        return self.solution.grid

    @property
    def times(self) -> Array | None:
        """The kept times of a marched solution, or None."""
        return self.solution.times

    @property
    def stats(self) -> dict:
        """The statistics of the solution."""
        return self.solution.stats

    @property
    def disturbance(self) -> Array | None:
        """Not None in a game: the nodes' disturbances, which the solution has; they are not looked up."""
        return self.solution.disturbance

    def _ask(self, where: tuple[Place, ...], clamp: bool) -> tuple[Array, Array]:
        """Both players' actions: float64 NumPy from concrete data, else of the tracer's dtype."""
        costate = self.solution.costate_at(*where, clamp=clamp)  # refuses what is no state
        if is_traced(costate, self):  # float64 must not be switched on in the middle of somebody's trace
            with own_settings():
                return _minimax(as_jax(self), where, costate)
        with own_settings(x64=True):
            greedy, where, costate = cast((self, where, costate), np.float64)
            return jax.tree.map(np.array, _jit_minimax(greedy, where, costate))


@front_door
def greedy_feedback(problem: Problem, solution: Solution) -> Greedy:
    """A feedback that minimises the Hamiltonian at the state, with the slopes of the solution's value there.

    u(x) = argmin_u max_d [L + f·DV + ½ tr(σσᵀ D²V)], exact where ``solve`` minimises exactly, and always admissible.
    The controls of a Solution between the nodes are means of those at the nodes: cheaper, smoother, and not optimal
    where the control jumps. The path of the minimiser costs V, as far as V is right: of the double integrator, whose V
    is off by a fifth on 101 x 101 nodes, it is no better than that, but with exact V seven times nearer to the least
    time than the means. Where the control jumps, give ``simulate`` a sampling interval, ``hold=``: at a switching
    curve the control then changes at the samples alone, and a path that the curve attracts follows it in a zigzag as
    wide as a sample; without a hold an adaptive step is cut at every crossing, thousands of times. In the cells at a
    constrained end it is the solution's own control, which does not leave. NaN where the value has no finite slope.

    Args:
      problem: what was solved; it has controls.
      solution: what ``solve`` or ``march`` returned for it.

    Returns:
      A function of the state, of (t, x) if the solution was marched, that ``jit`` and ``vmap`` accept, a pytree, and
      a feedback for ``simulate`` and wherever else one is wanted.

    Raises:
      TypeError: no Problem or no Solution.
      ValueError: a problem without controls, or a solution on another number of states.

    Example:
      >>> import hjbjax as hjb
      >>> problem, grid = hjb.zoo.eikonal(shape=(21, 21))
      >>> feedback = hjb.greedy_feedback(problem, hjb.solve(problem, grid))
      >>> round(float(feedback(np.array([0.6, 0.0]))[0]), 3), feedback(np.array([[0.0, 0.6], [0.5, 0.5]])).shape
      (-1.0, (2, 2))
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"greedy_feedback: got {type(problem).__name__}, wanted a Problem")
    if not isinstance(solution, Solution):
        raise TypeError(f"greedy_feedback: got {type(solution).__name__}, wanted a Solution")
    if problem.controls is None:
        raise ValueError("greedy_feedback: problem.controls is None, so that there is nothing to choose")
    wanted = (*np.shape(solution.times), *solution.grid.shape)
    if np.shape(solution.value) != wanted:
        raise ValueError(f"greedy_feedback: the value has shape {np.shape(solution.value)}, wanted {wanted}: no batch")
    m = np.shape(solution.policy)[-1:] if solution.policy is not None else (problem.controls.dim,)
    if m != (problem.controls.dim,) or (problem.is_game and solution.disturbance is None):
        raise ValueError("greedy_feedback: the solution is not one of this problem; its players are others")
    return Greedy(settled(problem, solution.grid.ndim), solution)


def _minimax(greedy: Greedy, where: tuple, costate: Array) -> tuple[Array, Array]:
    """Both players' actions at states of shape (..., n), one by one, shapes (..., m) and (..., l)."""
    times, shape = where[:-1], jnp.shape(costate)  # the time and the states broadcast to the shape of the costates
    states = jnp.broadcast_to(jnp.asarray(where[-1], costate.dtype), shape).reshape(-1, shape[-1])
    moments = [jnp.broadcast_to(jnp.asarray(t, costate.dtype), shape[:-1]).reshape(-1) for t in times]
    answers = list(jax.vmap(lambda x, p, *t: _at(greedy, t, x, p))(states, costate.reshape(-1, shape[-1]), *moments))
    if greedy.grid.sides("constrained"):
        # the block around a state has no wall, so that its minimiser may leave; the nodes' own controls do not
        beside = _beside_a_wall(greedy.grid, states)[:, None]
        looks = [greedy.solution.control_at, greedy.solution.disturbance_at][: 1 + greedy.problem.is_game]
        for player, look in enumerate(looks):
            answers[player] = jnp.where(beside, look(*moments, states, clamp=True), answers[player])
    control, disturbance = (each.reshape(*shape[:-1], each.shape[-1]) for each in answers)
    return control, disturbance


_jit_minimax = jax.jit(_minimax)


def _beside_a_wall(grid: Grid, states: Array) -> jax.Array:
    """A mask (k,) of the states (k, n) that lie in a cell at a constrained end."""
    found = jnp.zeros(states.shape[:1], bool)
    for axis, step in grid.sides("constrained"):
        nodes = np.arange(grid.shape[axis])[[-2, 1][step < 0]]  # the first node inside, from either end
        inner = jnp.asarray(grid.axis(axis), states.dtype)[nodes]
        found |= step * (states[:, axis] - inner) > 0
    return found


def _at(greedy: Greedy, when: tuple[Number, ...], x: State, p: Costate) -> tuple[jax.Array, jax.Array]:
    """Both players' actions at one state with the costate p."""
    problem, grid = greedy.problem, greedy.grid
    n, t = grid.ndim, (when[0] if when else 0.0)
    x = grid.wrap(x)
    # clipped as the costate was: outside of the box the Hamiltonian is that of the nearest point
    x = jnp.where(np.array(grid.periodic), x, jnp.clip(x, jnp.asarray(grid.lo, x.dtype), jnp.asarray(grid.hi, x.dtype)))
    # V is looked up one mean cell away, also on a stretched axis: for D²V a cell is the least that the nodes resolve
    widths = [jnp.asarray(grid.spacing(axis), x.dtype) for axis in range(n)]
    h = jnp.stack([jnp.mean(width) for width in widths])
    # without noise no second difference is asked for, and zeros stand in for V at the 3^n nodes
    value, bends = jnp.zeros((3,) * n, x.dtype), (jnp.zeros((), x.dtype),) * n
    if problem.noise is not None:
        steps = np.stack(np.meshgrid(*[(-1, 0, 1)] * n, indexing="ij"), axis=-1)
        points = _reflected(jnp.asarray(x + h * steps), grid)
        look = functools.partial(greedy.solution.value_at, *when, clamp=True)
        value = beyond_ends(look, points, grid, continuing_sides(grid))
        center = (1,) * n
        # D⁺ − D⁻ along every axis, the second difference times h: the form in which the Hamiltonian takes noise
        bends = tuple(
            sum(value[(*center[:axis], side, *center[axis + 1 :])] - value[center] for side in (0, 2)) / h[axis]
            for axis in range(n)
        )
    # A block of nodes around the state, of which only the middle one is looked at; no upwinding: both slopes are DV.
    block = Grid(x - h, x + h, (3,) * n)
    slopes, links = tuple(p), tuple(Links(width, width) for width in h)
    on = Discretisation(problem, block, Limited(), x.dtype, t)
    hamiltonian = DiscreteHamiltonian(on, list(x), value, slopes, slopes, bends, links)
    _, u, d = optimise(hamiltonian)
    known = jnp.all(jnp.isfinite(p))  # a minimum over slopes of NaN would still be some admissible action
    control, disturbance = (jnp.where(known, _middle(action, x.dtype, n), jnp.nan) for action in (u, d))
    return control, disturbance


def _reflected(points: jax.Array, grid: Grid) -> jax.Array:
    """Points (..., n) with those beyond a wall at their mirror image, where noise sees V."""
    for axis, step in grid.sides("projected") + grid.sides("constrained"):
        wall = jnp.asarray((grid.hi if step > 0 else grid.lo)[axis], points.dtype)
        along = points[..., axis]
        points = points.at[..., axis].set(jnp.where(step * (along - wall) > 0, 2 * wall - along, along))
    return points


def beyond_ends(look: Callable, points: jax.Array, grid: Grid, sides: Sequence[tuple[int, int]]) -> jax.Array:
    """V at points (..., n) that may lie beyond ends where the scheme continues it.

    The node beyond an end has the scheme's own value, see ``stencil.continuation``; V is linear up to there.

    Args:
      look: V inside the box, as a function of points (..., n).
      points: where.
      grid: the nodes.
      sides: the ends, pairs of an axis and a step, in the order of ``continuing_sides``.
    """
    if not sides:
        return look(points)
    (axis, step), further = sides[0], sides[1:]
    along, nodes = points[..., axis], jnp.asarray(grid.axis(axis), points.dtype)
    inwards = nodes if step < 0 else nodes[::-1]
    gap = jnp.abs(inwards[1] - inwards[0])
    share = step * (along - inwards[0]) / gap
    outside, total = share > 0, jnp.zeros(points.shape[:-1], points.dtype)
    for k, weight in enumerate(stencil.continuation(grid, axis, step)):
        inside = 0 if k else 1  # the weight of this node for a point that is not beyond
        weight = jnp.where(outside, share * jnp.asarray(weight, points.dtype) + inside * (1 - share), inside)
        place = points.at[..., axis].set(jnp.where(outside, inwards[k], along))
        value = beyond_ends(look, place, grid, further)
        total = total + jnp.where(weight == 0, 0, weight * value)  # a node without weight has no say, be it infinite
    if (end := stencil.sloped(grid, axis, step)) is None:
        return total
    slope = jnp.broadcast_to(jnp.asarray(end.slope, points.dtype), grid.shape)
    added = step * 2 * gap * share * grid.interpolate(slope, points, clamp=True)
    return total + jnp.where(outside, added, 0)


def continuing_sides(grid: Grid) -> list[tuple[int, int]]:
    """The ends beyond which V continues: pairs of an axis and a step, −1 lower and 1 upper."""
    sides = itertools.product(range(grid.ndim), (-1, 1))
    return [side for side in sides if not grid.periodic[side[0]] and not stencil.has_wall(grid, *side)]


def _middle(action: list[Array], dtype: DType, n: int) -> jax.Array:
    """An action at the middle node of the block of 3^n, as one array of shape (m,)."""
    if not action:
        return jnp.zeros(0, dtype)
    # an input that does not depend on the node comes as a number, one that varies along an axis broadcasts
    return jnp.stack([jnp.broadcast_to(jnp.asarray(entry, dtype), (3,) * n)[(1,) * n] for entry in action])
