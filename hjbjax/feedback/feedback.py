"""Feedbacks from solutions: interpolated between the nodes, or the minimiser of the Hamiltonian at the state.

    u(x) = argmin_u max_d [ L(x, u, d) + f(x, u, d)·DV(x) + ½ tr(σσᵀ(x, u, d) D²V(x)) ]

DV is interpolated from the central differences of ``costate_at``. D²V uses V one cell away, which is extended beyond an
end of the box as the scheme does: mirrored at a wall, by a parabola at an open end. If a control jumps between two
nodes, their mean is optimal for neither, and may not even belong to an enumerated set. The minimiser jumps with DV.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.posing import for_solvers
from hjbjax.discretisation.schemes import Limited
from hjbjax.discretisation.stencil import Links
from hjbjax.feedback.costate_feedback import CostateFeedback, GridFreeFeedback, GridFreeSolution, costate_feedback
from hjbjax.hamiltonian.discrete import DiscreteHamiltonian
from hjbjax.hamiltonian.optimum import optimise
from hjbjax.problem.grid import Grid
from hjbjax.problem.mode_axis import without_modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, as_jax, as_partial, cast, front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import bounds_at, control_of, in_unit_box
from hjbjax.problem.types import Array, Costate, DType, Number, Numbers, State
from hjbjax.solution.interpolation import extended
from hjbjax.solution.modes import states_in_mode
from hjbjax.solution.rewards import in_costs
from hjbjax.solution.solution import Solution
from hjbjax.tracing.closures import settled, settled_function
from hjbjax.tracing.dependence import influence

if TYPE_CHECKING:
    from typing_extensions import TypeIs

# fields that no lookup reads; a solution without an estimate would compile another program than one with it
UNREAD = (
    "code", "steps", "enclosure", "isaacs_gap", "reached", "grid_error", "box_error", "monotone_error", "cut",
    "stopping", "active", "pushing",
)  # fmt: skip
FEWEST = 10  # intervals between stored times that a marched feedback needs over a path
ROUNDING = 1e-9  # relative tolerance for comparing times, which may be sums of steps

Place: TypeAlias = Numbers | Sequence  # a state, shape (n,) or (..., n), or the time that precedes it


class GridFeedback(Protocol):
    """Both players on a grid, interpolated between its nodes: a Solution or a ``greedy_feedback``."""

    @property
    def grid(self) -> Grid:
        """The nodes, in whose box the players are known."""

    @property
    def times(self) -> Array | None:
        """The stored times of a march; None for a stationary feedback."""

    @property
    def disturbance(self) -> Array | None:
        """Not None if and only if the worst case is known."""

    @property
    def control_at(self) -> Callable[..., Array]:
        """The control at (x), or at (t, x) for a marched feedback; with the keyword ``clamp``."""

    @property
    def disturbance_at(self) -> Callable[..., Array]:
        """The opponent's action at the same arguments."""


def is_grid_feedback(feedback: object) -> "TypeIs[GridFeedback]":
    """True for a Solution and other objects with ``control_at`` on a grid, False for a plain function of the state."""
    return hasattr(feedback, "control_at") and hasattr(feedback, "grid")


def without_grid(feedback: Any, time_varying: bool) -> tuple[Any, bool]:
    """A solution without a grid, such as a HopfSolution, as the function ``control_at``; True if this takes (t, x).

    Other feedbacks are returned unchanged.
    """
    if not isinstance(feedback, GridFreeFeedback):
        return feedback, time_varying
    return feedback.control_at, time_varying or feedback.timed


def check_kept(solution: GridFeedback, duration: float, name: str) -> float:
    """Refuse a marched feedback that is not stored at enough times up to the duration.

    Args:
      solution: a marched solution whose times are known numbers.
      duration: the length of the path, from t = 0.
      name: the function the user called and its name for the duration, for messages.

    Returns:
      The horizon of the march.

    Raises:
      ValueError: the stored times end too early or are too far apart.
    """
    times = np.asarray(solution.times, np.float64)
    horizon = float(times[-1])
    if isinstance(solution, Solution):
        horizon = float(solution.stats.get("horizon", horizon))
    if duration > horizon * (1 + ROUNDING):
        raise ValueError(f"{name} = {duration:g} goes beyond the horizon {horizon:g} of the solution; shorten it")
    # the feedback is linear between two stored times: no gap, including both ends, may be wider than a tenth
    between = np.concatenate([[0.0], times[(times > 0) & (times < duration)], [duration]])
    gap = float(np.max(np.diff(between)))
    if times[0] > 0 or times[-1] < duration * (1 - ROUNDING) or gap > duration / FEWEST * (1 + ROUNDING):
        raise ValueError(
            f"{name} = {duration:g}, but the solution was marched and stored at {times.size} times from {times[0]:g} "
            f"to {times[-1]:g}; a feedback up to t = {duration:g} needs times over that whole range,\n"
            f"at most {duration / FEWEST:g} apart: march(..., times=np.linspace(0, {horizon:g}, 41))"
        )
    return horizon


def lookups(feedback: GridFeedback) -> tuple[Callable, Callable]:
    """The control and the disturbance of a GridFeedback as functions of (t, x).

    A state outside the target may be in a cell whose nodes are all inside, for example next to a hollow target. There
    the surrounding nodes are used.
    """
    if isinstance(feedback, GreedyFeedback):
        feedback = dataclasses.replace(feedback, solution=_node_values(feedback.solution))
    answers: list[GridFeedback] = [feedback]
    if isinstance(feedback, Solution):
        answers = [feedback := _node_values(feedback)]
        players = {"policy": feedback.discrete, "disturbance": feedback.discrete_disturbance}
        given = {name: getattr(feedback, name) for name in players if getattr(feedback, name) is not None}
        # nodes without a control get their neighbours' control; this is used only where a whole cell is NaN
        filled = {name: extended(feedback.grid, array, players[name]) for name, array in given.items()}
        answers.append(dataclasses.replace(feedback, **filled))
    ask = _look_up if feedback.times is None else _look_up_in_time
    control, disturbance = (
        jax.tree_util.Partial(ask, tuple(as_partial(getattr(each, name)) for each in answers))
        for name in ("control_at", "disturbance_at")
    )
    return control, disturbance


def _node_values(solution: Solution) -> Solution:
    """The solution with only what a lookup reads."""
    return altered(solution, **dict.fromkeys(UNREAD))


# The loop clips every state into the box first; clamp=True keeps rounding from refusing a state on the boundary. An
# integrator traces its right-hand side about twenty times; ``jit`` traces a lookup only once, in 1 s instead of 2 s.


def _look_up(looks: tuple[Callable, ...], t: Number, x: State) -> Array:
    """The first of several lookups at x that is not NaN, for any time."""
    return _first_at(as_jax(looks), x)


def _look_up_in_time(looks: tuple[Callable, ...], t: Number, x: State) -> Array:
    """The first of several lookups at (t, x) that is not NaN."""
    return _first_at(as_jax(looks), t, x)


@functools.partial(jax.jit, inline=True)
def _first_at(looks: tuple[Callable, ...], *where: Array) -> Array:
    """The first lookup, with NaN entries replaced by the next lookup."""
    answer, *others = [look(*where, clamp=True) for look in looks]
    for other in others:
        answer = jnp.where(jnp.isnan(answer), other, answer)
    return answer


@pytree_dataclass()
class GreedyFeedback:
    """The feedback of ``greedy_feedback``; called with (x), or (t, x) for a marched solution.

    It has the interface of a Solution, so ``simulate`` takes its grid, its times and its worst case from it.

    Args:
      problem: the problem whose Hamiltonian is minimised.
      solution: the solution whose value gives the slopes.
      bounds: the function of the state that bounds the controls; None for a fixed set.
    """

    problem: Problem
    solution: Solution
    bounds: Callable | None = None

    def __call__(self, *where: Place, mode: str | int | None = None) -> Array:
        """The control, shape (m,); outside the grid the control of its nearest point."""
        return self.control_at(*where, mode=mode, clamp=True)

    def control_at(self, *where: Place, mode: str | int | None = None, clamp: bool = False) -> Array:
        """The minimising control, shape ``x.shape[:-1] + (m,)``; arguments and errors as for a Solution."""
        return self._ask(where, mode, clamp)[0]

    def disturbance_at(self, *where: Place, mode: str | int | None = None, clamp: bool = False) -> Array:
        """The maximising disturbance, shape ``x.shape[:-1] + (l,)``."""
        return self._ask(where, mode, clamp)[1]

    @property
    def grid(self) -> Grid:
        """The grid of the solution."""
        return self.solution.grid

    @property
    def times(self) -> Array | None:
        """The stored times of a marched solution, or None."""
        return self.solution.times

    @property
    def stats(self) -> dict:
        """The statistics of the solution."""
        return self.solution.stats

    @property
    def disturbance(self) -> Array | None:
        """Not None in a game: the disturbances of the solution at the nodes, which are not interpolated here."""
        return self.solution.disturbance

    def _ask(self, where: tuple[Place, ...], mode: str | int | None, clamp: bool) -> tuple[Array, Array]:
        """Both players' actions: float64 NumPy arrays for concrete data, otherwise in the tracer's dtype."""
        if mode is not None:
            x: Any = where[-1]
            where = (*where[:-1], states_in_mode(self.grid, x, mode, "greedy_feedback"))
        costate = self.solution.costate_at(*where, clamp=clamp)  # also checks the state
        if self.grid.modes:  # V has no slope along the modes
            xp: Any = jnp if is_traced(costate) else np
            costate = xp.concatenate([xp.zeros_like(costate[..., :1]), costate], axis=-1)
        own = dataclasses.replace(self, solution=_node_values(self.solution))
        if is_traced(costate, own):  # float64 must not be switched on in the middle of a caller's trace
            with own_settings():
                return _minimax(as_jax(own), where, costate)
        with own_settings(x64=True):
            greedy, where, costate = cast((own, where, costate), np.float64)
            return jax.tree.map(np.array, _jit_minimax(greedy, where, costate))


@front_door
def greedy_feedback(problem: Problem, solution: Solution | GridFreeSolution) -> "GreedyFeedback | CostateFeedback":
    """A feedback that minimises the Hamiltonian at the state, with the slopes of the solution's value there.

    u(x) = argmin_u max_d [L + f·DV + ½ tr(σσᵀ D²V)], exact where ``solve`` minimises exactly, and always admissible.
    A Solution interpolates the controls of the nodes, which is cheaper and smoother but not optimal where the control
    jumps. The minimiser's path costs V, up to the error of V. For the double integrator on 101 x 101 nodes, where V is
    off by a fifth, it is no better than interpolation; with exact V its time is seven times closer to the minimum.

    Modes and jumps add Σ λ (V(y) − V + c) to the minimised function, with V after the change from the solution. Pushes
    and changes of the mode by choice are not controls; ``simulate`` takes them from the solution.

    Where the control jumps, pass a sampling interval ``hold=`` to ``simulate``. The control then changes only at the
    samples, and a path attracted by a switching curve follows it in a zigzag as wide as a sample. Without a hold an
    adaptive step is cut at every crossing, thousands of times. In the cells at a constrained end the feedback is the
    solution's own control, which does not leave the box. NaN where the value has no finite slope.

    Args:
      problem: the problem that was solved; it must have controls.
      solution: the result of ``solve`` or ``march``, or a solution without a grid, of ``hopf``, ``decompose`` or
        ``neural``. Without a grid the problem must have one player, and noise that does not depend on the control.

    Returns:
      A function of the state, or of (t, x) if the solution was marched, with the keyword ``mode`` if there are modes.
      It is a pytree, supports ``jit`` and ``vmap``, and can be used like any feedback, as in ``simulate``.

    Raises:
      TypeError: an argument that is not a Problem or not a Solution.
      ValueError: a problem without controls, a solution with another number of states or other modes, or jumps to
        states that depend on the control.

    Example:
      >>> import hjbjax as hjb
      >>> problem, grid = hjb.zoo.eikonal(shape=(21, 21))
      >>> feedback = hjb.greedy_feedback(problem, hjb.solve(problem, grid))
      >>> round(float(feedback(np.array([0.6, 0.0]))[0]), 3), feedback(np.array([[0.0, 0.6], [0.5, 0.5]])).shape
      (-1.0, (2, 2))
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"greedy_feedback: got {type(problem).__name__}, wanted a Problem")
    if isinstance(solution, GridFreeSolution):
        return costate_feedback(problem, solution)
    if not isinstance(solution, Solution):
        raise TypeError(f"greedy_feedback: got {type(solution).__name__}, wanted a Solution")
    names = () if problem.modes is None else problem.modes.names
    if names != solution.grid.modes:
        raise ValueError(
            f"greedy_feedback: got a problem with the modes {names!r} and a solution with {solution.grid.modes!r}; "
            "wanted the same modes"
        )
    problem = for_solvers(problem, without_modes(solution.grid).ndim)
    bounds = problem.controls if callable(problem.controls) else None
    if bounds is not None:
        bounds = settled_function(bounds, *problem.state_arguments((solution.grid.ndim,), ()))
    problem = in_unit_box(problem, solution.grid.ndim)
    if problem.controls is None:
        raise ValueError("greedy_feedback: problem.controls is None, so that there is nothing to choose")
    wanted = (*np.shape(solution.times), *solution.grid.shape)
    if np.shape(solution.value) != wanted:
        raise ValueError(f"greedy_feedback: the value has shape {np.shape(solution.value)}, wanted {wanted}: no batch")
    m = np.shape(solution.policy)[-1:] if solution.policy is not None else (problem.controls.dim,)
    if m != (problem.controls.dim,) or (problem.is_game and solution.disturbance is None):
        raise ValueError("greedy_feedback: the solution belongs to another problem; its players differ")
    problem = settled(problem, solution.grid.ndim)
    if not influence(problem, solution.grid.ndim, np.dtype(np.float64)).landing.is_constant:
        raise ValueError(
            "greedy_feedback: got jumps whose landing depends on an action, so V would be interpolated for every "
            "action\nthat is tried; pass the solution itself as the feedback: it interpolates the controls of the nodes"
        )
    return GreedyFeedback(problem, in_costs(solution), bounds)


def _minimax(greedy: GreedyFeedback, where: tuple, costate: Array) -> tuple[Array, Array]:
    """Both players' actions at states of shape (..., n), each state separately, shapes (..., m) and (..., l)."""
    times, shape = where[:-1], jnp.shape(costate)  # the time and the states broadcast to the shape of the costates
    states = jnp.broadcast_to(jnp.asarray(where[-1], costate.dtype), shape).reshape(-1, shape[-1])
    moments = [jnp.broadcast_to(jnp.asarray(t, costate.dtype), shape[:-1]).reshape(-1) for t in times]
    answers = list(jax.vmap(lambda x, p, *t: _at(greedy, t, x, p))(states, costate.reshape(-1, shape[-1]), *moments))
    if greedy.grid.sides("constrained"):
        # the minimiser in the block around a state ignores the wall and may leave the box; the nodes' controls do not
        beside = _beside_a_wall(greedy.grid, states)[:, None]
        looks = [greedy.solution.control_at, greedy.solution.disturbance_at][: 1 + greedy.problem.is_game]
        for player, look in enumerate(looks):
            answers[player] = jnp.where(beside, look(*moments, states, clamp=True), answers[player])
    control, disturbance = (each.reshape(*shape[:-1], each.shape[-1]) for each in answers)
    return control, disturbance


_jit_minimax = jax.jit(_minimax)


def _beside_a_wall(grid: Grid, states: Array) -> jax.Array:
    """A mask (k,) of the states (k, n) in a cell at a constrained end."""
    found = jnp.zeros(states.shape[:1], bool)
    for axis, step in grid.sides("constrained"):
        nodes = np.arange(grid.shape[axis])[[-2, 1][step < 0]]  # the first node inside, from either end
        inner = jnp.asarray(grid.axis(axis), states.dtype)[nodes]
        found |= step * (states[:, axis] - inner) > 0
    return found


def _at(greedy: GreedyFeedback, when: tuple[Number, ...], x: State, p: Costate) -> tuple[jax.Array, jax.Array]:
    """Both players' actions at one state with the costate p."""
    problem, grid = greedy.problem, greedy.grid
    n, t = grid.ndim, (when[0] if when else 0.0)
    x = grid.wrap(x)
    # clipped like the costate: outside the box the Hamiltonian of the nearest point is used
    x = jnp.where(np.array(grid.periodic), x, jnp.clip(x, jnp.asarray(grid.lo, x.dtype), jnp.asarray(grid.hi, x.dtype)))
    # D²V uses V one mean cell away, also on a stretched axis, because the nodes resolve nothing finer
    widths = [jnp.asarray(grid.spacing(axis), x.dtype) for axis in range(n)]
    h = jnp.stack([jnp.mean(width) for width in widths])
    # without noise and growth V is not needed, so zeros replace it at the 3^n nodes
    value, bends = jnp.zeros((3,) * n, x.dtype), (jnp.zeros((), x.dtype),) * n
    look = functools.partial(greedy.solution.value_at, *when, clamp=True)
    if problem.growth is not None:
        value = value + look(x)
    if problem.noise is not None:
        steps = np.stack(np.meshgrid(*[(-1, 0, 1)] * n, indexing="ij"), axis=-1)
        points = _reflected(jnp.asarray(x + h * steps), grid)
        value = beyond_ends(look, points, grid, continuing_sides(grid))
        center = (1,) * n
        # D⁺ − D⁻ along every axis, the second difference times h, which is how the Hamiltonian takes noise
        bends = tuple(
            sum(value[(*center[:axis], side, *center[axis + 1 :])] - value[center] for side in (0, 2)) / h[axis]
            for axis in range(n)
        )
    # a block of nodes around the state, of which only the middle one is used; no upwinding, since both slopes are DV
    block = Grid(x - h, x + h, (3,) * n)
    slopes, links = tuple(p), tuple(Links(width, width) for width in h)
    on = Discretisation(problem, block, Limited(), x.dtype, t)
    changes = _changes(problem, grid, look, t, x)
    hamiltonian = DiscreteHamiltonian(on, list(x), value, slopes, slopes, bends, links, *changes)
    _, u, d = optimise(hamiltonian)
    known = jnp.all(jnp.isfinite(p))  # otherwise minimising over NaN slopes would still return an admissible action
    control, disturbance = (jnp.where(known, _middle(action, x.dtype, n), jnp.nan) for action in (u, d))
    if greedy.bounds is not None:
        control = jnp.asarray(control_of(bounds_at(greedy.bounds, *problem.state_arguments(x, t)), control))
    return control, disturbance


def _changes(problem: Problem, grid: Grid, look: Callable, t: Number, x: jax.Array) -> tuple[tuple, tuple]:
    """V after every change of the mode at random, and after every jump of the state, minus V."""
    if problem.mode_rates is None and problem.landings is None:
        return (), ()
    count, here = len(grid.modes), look(x)
    numbers = range(1, count) if problem.mode_rates is not None else ()
    gaps = tuple(look(x.at[0].set((x[0] + number) % count)) - here for number in numbers)
    if problem.landings is None:
        return gaps, ()
    u, d = (jnp.zeros(0 if each is None else each.dim, x.dtype) for each in (problem.controls, problem.disturbances))
    after = jnp.asarray(problem.landings(*problem.arguments(x, u, d, t)), x.dtype)
    if count:  # a jump keeps the mode
        after = jnp.concatenate([jnp.full((len(after), 1), x[0]), after], axis=1)
    return gaps, tuple(beyond_ends(look, after, grid, continuing_sides(grid)) - here)


def _reflected(points: jax.Array, grid: Grid) -> jax.Array:
    """Points (..., n) with those beyond a wall replaced by their mirror image, as noise is reflected there."""
    for axis, step in grid.sides("projected") + grid.sides("constrained"):
        wall = jnp.asarray((grid.hi if step > 0 else grid.lo)[axis], points.dtype)
        along = points[..., axis]
        points = points.at[..., axis].set(jnp.where(step * (along - wall) > 0, 2 * wall - along, along))
    return points


def beyond_ends(look: Callable, points: jax.Array, grid: Grid, sides: Sequence[tuple[int, int]]) -> jax.Array:
    """V at points (..., n) that may be beyond an end at which the scheme extends V.

    The node beyond an end has the scheme's own value, see ``stencil.continuation``; V is linear up to that node.

    Args:
      look: V inside the box, as a function of points (..., n).
      points: the points.
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
        inside = 0 if k else 1  # the weight of this node for a point inside the box
        weight = jnp.where(outside, share * jnp.asarray(weight, points.dtype) + inside * (1 - share), inside)
        place = points.at[..., axis].set(jnp.where(outside, inwards[k], along))
        value = beyond_ends(look, place, grid, further)
        total = total + jnp.where(weight == 0, 0, weight * value)  # a node with weight zero may be infinite
    if (end := stencil.sloped(grid, axis, step)) is None:
        return total
    slope = jnp.broadcast_to(jnp.asarray(end.slope, points.dtype), grid.shape)
    added = step * 2 * gap * share * grid.interpolate(slope, points, clamp=True)
    return total + jnp.where(outside, added, 0)


def continuing_sides(grid: Grid) -> list[tuple[int, int]]:
    """The ends beyond which the scheme extends V: pairs of an axis and a step, −1 lower and 1 upper."""
    sides = itertools.product(range(grid.ndim), (-1, 1))
    return [side for side in sides if not grid.periodic[side[0]] and not stencil.has_wall(grid, *side)]


def _middle(action: list[Array], dtype: DType, n: int) -> jax.Array:
    """An action at the middle node of the block of 3^n, as one array of shape (m,)."""
    if not action:
        return jnp.zeros(0, dtype)
    # an input that does not depend on the node is a number; an input that varies along an axis only broadcasts
    return jnp.stack([jnp.broadcast_to(jnp.asarray(entry, dtype), (3,) * n)[(1,) * n] for entry in action])
