"""The ends of the box: the drift that leaves there, and its treatment at each kind of end.

At a projected end the outward component of the drift is cut off, while the control pays its full cost. At a constrained
end an action whose drift leaves costs infinitely much: it is inadmissible for the control, and if a disturbance can
push the state out the control must prevent this. Noise reflects at both. An open end stops nothing; see ``stencil`` for
the extrapolation of the value.

A drift that vanishes at an end does so up to rounding, because terms of the drift cancel, and because the coordinates
of the node are rounded. The threshold for leaving is relative to both errors at that node, so it does not depend on
units or on the rest of the box.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.stencil import PerNode
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.types import Array, DType, Number, Numbers
from hjbjax.tracing import components, dependence

BLOCK = 2**18  # nodes per evaluation of the drift; limits the memory
PLANES = 5  # coordinates per axis at which the size of the drift is sampled for the count
ROUNDINGS = 256  # units of eps in terms of a drift: error of its formula if they cancel
COORDINATES = 8  # rounding error of a coordinate, in units of eps


@dataclasses.dataclass(frozen=True)
class Rounding:
    """Rounding errors of a drift component that vanishes at a node; both entries broadcast.

    Attributes:
      idle: the component without actions, which the actions may cancel.
      shift: its change when the node moves by the rounding error of its coordinates.
    """

    idle: jax.Array
    shift: jax.Array

    def of(self, f: PerNode) -> jax.Array:
        """The size below which ``f`` counts as rounding."""
        eps = jnp.finfo(jnp.result_type(f)).eps
        # |f₀| + |f − f₀| ≥ |f|, and is much larger if the terms cancel; a threshold that shrinks with f would count
        # every remainder of a cancellation as drift
        return ROUNDINGS * eps * (jnp.abs(self.idle) + jnp.abs(f - self.idle)) + self.shift


def slack(on: Discretisation) -> list[Rounding]:
    """The rounding errors of the drift along every axis, at every node."""
    problem, grid, dtype = on.problem, on.grid, on.dtype
    m, k = (0 if admissible is None else admissible.dim for admissible in (problem.controls, problem.disturbances))
    nothing = ([jnp.zeros((), dtype)] * m, [jnp.zeros((), dtype)] * k)
    found = []
    for entry in on.drift(*nothing):
        # zero need not be admissible: if the formula has no value there, nothing can cancel
        idle = jnp.broadcast_to(jnp.where(jnp.isfinite(entry), entry, 0), grid.shape)
        shift = jnp.zeros((), dtype)
        for axis in grid.state_axes:
            up, down = (jnp.abs(slope) for slope in stencil.one_sided(idle, grid, axis))
            end = stencil.on_edge(grid, axis, 1) | stencil.on_edge(grid, axis, -1)
            farthest = jnp.maximum(jnp.abs(grid.lo[axis]), jnp.abs(grid.hi[axis]))
            slope = jnp.where(end, jnp.maximum(up, down), jnp.minimum(up, down))  # the other may cross a jump
            shift = shift + COORDINATES * jnp.finfo(dtype).eps * farthest * slope
        found.append(Rounding(idle, shift))
    return found


def leaves(f: PerNode, grid: Grid, axis: int, step: int, rounding: Rounding, coarser: Numbers = 1) -> Array:
    """The nodes where a drift component leaves across one end of its axis by more than rounding; broadcasts."""
    return stencil.on_edge(grid, axis, step) & (step * f > coarser * rounding.of(f))


def barred(f: PerNode, grid: Grid, axis: int, rounding: Rounding, coarser: Numbers = 1) -> Array | None:
    """The nodes where a drift component leaves across a constrained end of its axis; None if it has none."""
    steps = [step for which, step in grid.sides("constrained") if which == axis]
    found = [leaves(f, grid, axis, step, rounding, coarser) for step in steps]
    return None if not found else found[0] if len(found) == 1 else found[0] | found[1]


def beside(lost: jax.Array, grid: Grid) -> tuple[tuple[jax.Array, jax.Array], ...]:
    """Per axis, the nodes whose upper neighbour is ``lost`` and the nodes whose lower one is, bool (*grid) each."""
    up, down = ([stencil.unit(grid, axis, step) for axis in range(grid.ndim)] for step in (1, -1))
    pairs = zip(up, down, strict=True)
    return tuple((stencil.neighbour(lost, grid, p), stencil.neighbour(lost, grid, q)) for p, q in pairs)


def strays(f: PerNode, beside: tuple[jax.Array, jax.Array], rounding: Rounding) -> jax.Array:
    """The nodes where a drift component that is only rounding points to a lost neighbour."""
    return _points(f, beside) & (jnp.abs(f) <= rounding.of(f))


def leads(f: PerNode, beside: tuple[jax.Array, jax.Array], rounding: Rounding) -> jax.Array:
    """The nodes where a drift component larger than rounding points to a lost neighbour."""
    return _points(f, beside) & (jnp.abs(f) > rounding.of(f))


def _points(f: PerNode, beside: tuple[jax.Array, jax.Array]) -> jax.Array:
    up, down = beside
    return (up & (f > 0)) | (down & (f < 0))


def inadmissible(on: Discretisation, u: list, d: list | None = None, *, eps: Number | None = None) -> jax.Array:
    """The nodes where the actions lead out across a constrained end, bool (*grid); ``eps`` is their precision."""
    bad = jnp.zeros(on.grid.shape, bool)
    if not on.grid.sides("constrained"):
        return bad
    f = on.drift(u, d)
    # a policy found in single precision but evaluated in double is judged by its own precision
    coarser = 1 if eps is None else eps / jnp.finfo(on.dtype).eps
    for axis, rounding in enumerate(slack(on)):
        out = barred(f[axis], on.grid, axis, rounding, coarser)
        bad = bad if out is None else bad | out
    return bad


def cut(
    problem: Problem, grid: Grid, value: np.ndarray, actions: tuple[list, list], acting: np.ndarray, t: Number = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The number of nodes on each projected end where these actions' drift is cut off, and of all nodes there.

    If the value is constant towards the end, relative to its range over the box, and no action has a cost, the cut
    changes nothing and is not counted. Host level: one small program evaluates the drift at the ends and on a coarse
    sample, whose size sets the threshold. NumPy counts, because reductions compile slowly.

    Args:
      problem, grid: the problem and its grid.
      value: V, shape (*grid).
      actions: u and d, each component (*grid).
      acting: bool (*grid), the nodes to check.
      t: the time.

    Returns:
      Two integer arrays of shape (n, 2), lower and upper ends; zeros at ends that are not projected.
    """
    counts, totals = np.zeros((2, grid.ndim, 2), int)
    acting, earning = np.broadcast_to(acting, grid.shape), _actions_cost(problem, grid.ndim, value.dtype)
    # flat indices in C order, because a table of all indices would take as much memory as the values
    strides = [math.prod(grid.shape[axis + 1 :]) for axis in range(grid.ndim)]
    sides, sample = grid.sides("projected"), [np.linspace(0, n - 1, min(n, PLANES)).astype(int) for n in grid.shape]

    def face(axis: int, step: int) -> np.ndarray:
        along = [np.arange(count) for count in grid.shape]
        along[axis] = along[axis][[-1 if step > 0 else 0]]
        return _numbers(along, strides)

    def drift(numbers: np.ndarray) -> np.ndarray:
        places = np.unravel_index(numbers, grid.shape)
        x = [np.asarray(grid.axis(axis), value.dtype)[index] for axis, index in enumerate(places)]
        taken = ([np.broadcast_to(entry, grid.shape)[places] for entry in each] for each in actions)
        return np.asarray(_drift(problem, x, *taken, t))

    parts = [functools.partial(_numbers, sample, strides), *(functools.partial(face, *side) for side in sides)]
    found = _in_blocks(drift, parts, math.prod(map(len, sample)) + sum(grid.size // grid.shape[a] for a, _ in sides))
    _, f = next(found)
    # the sample gives the size of the drift over the box, relative to which a remainder at an end may be rounding
    least = ROUNDINGS * np.finfo(value.dtype).eps * np.max(np.abs(f), axis=1)
    ends = (np.max(value, where=acting, initial=-np.inf), np.min(value, where=acting, initial=np.inf))
    extent = ends[0] - ends[1] if acting.any() else 0.0
    for (axis, step), (there, f) in zip(sides, found, strict=True):
        # the slope at the end times the length of the axis, in the units of V
        change = np.abs(value.ravel()[there] - value.ravel()[there - step * strides[axis]]) * (grid.shape[axis] - 1)
        # if V is flat towards the end up to rounding, the cut does not matter
        matters = earning | (change > np.sqrt(np.finfo(value.dtype).eps) * extent)
        side, looked_at = (step + 1) // 2, acting.ravel()[there]  # column 0 is the lower end, 1 the upper
        counts[axis, side] = np.sum(looked_at & (step * f[axis] > least[axis]) & matters)
        totals[axis, side] = np.sum(looked_at)
    return counts, totals


def count_leaving(on: Discretisation, value: jax.Array, u: list, d: list, acting: jax.Array) -> jax.Array:
    """The number of nodes on each projected end where these actions' drift is cut off, (n, 2); for compiled programs.

    Like ``cut``, but scaled by the sizes of the drift and of V at the end.
    """
    grid, shape = on.grid, on.grid.shape
    f = [jnp.broadcast_to(entry, shape) for entry in on.drift(u, d)]
    earning, eps = _actions_cost(on.problem, grid.ndim, on.dtype), float(jnp.finfo(on.dtype).eps)
    counts = jnp.zeros((grid.ndim, 2), jnp.int32)
    for axis, step in grid.sides("projected"):
        last, side = (shape[axis] - 1 if step > 0 else 0), (step + 1) // 2
        there, looked_at, own, inner = (
            jax.lax.index_in_dim(array, place, axis, keepdims=False)
            for array, place in ((f[axis], last), (acting, last), (value, last), (value, last - step))
        )
        change = jnp.abs(own - inner) * (shape[axis] - 1)
        matters = earning | (change > math.sqrt(eps) * (jnp.max(jnp.abs(own)) + jnp.max(change)))
        leaves = step * there > ROUNDINGS * eps * jnp.max(jnp.abs(there))
        counts = counts.at[axis, side].set(jnp.sum(looked_at & leaves & matters, dtype=jnp.int32))
    return counts


def _in_blocks(
    drift: Callable[[np.ndarray], np.ndarray], parts: Sequence[Callable[[], np.ndarray]], count: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The indices of the nodes of each part, and the drift there, (n, K); one program for all parts.

    All parts at once if they are small, else blocks of one size: in six dimensions most nodes lie on an end.
    """
    if count <= BLOCK:
        numbers = [part() for part in parts]
        f = np.split(drift(np.concatenate(numbers)), np.cumsum([each.size for each in numbers[:-1]]), axis=1)
        yield from zip(numbers, f, strict=True)
        return
    for part in parts:
        there = part()
        rows = []
        for first in range(0, there.size, BLOCK):
            block = there[first : first + BLOCK]
            rows.append(drift(np.pad(block, (0, BLOCK - block.size), mode="edge"))[:, : block.size])
        yield there, np.concatenate(rows, axis=1)


def _numbers(picks: Sequence[np.ndarray], strides: Sequence[int]) -> np.ndarray:
    """The flat indices, in C order, of the nodes with one of the given indices along each axis."""
    along = (pick * stride for pick, stride in zip(picks, strides, strict=True))
    return functools.reduce(np.add.outer, along, np.zeros((), int)).ravel()


@jax.jit
def _drift(problem: Problem, x: list, u: list, d: list, t: Number) -> jax.Array:
    """The drift at states with entries (K,), shape (n, K)."""
    f = components.components(problem.drift, *problem.arguments(x, u, d, t), dtype=x[0].dtype)
    return jnp.stack([jnp.broadcast_to(entry, x[0].shape) for entry in f])


def _actions_cost(problem: Problem, n: int, dtype: DType) -> bool:
    """True if the running cost depends on an action of either player."""
    if problem.cost is None:
        return False
    m, k = (0 if admissible is None else admissible.dim for admissible in (problem.controls, problem.disturbances))
    time, game = ((None, False),) * problem.time_dependent, ((k, True),) * problem.is_game
    return not dependence.dependence(problem.cost, *time, (n, False), (m, True), *game, dtype=dtype).is_constant
