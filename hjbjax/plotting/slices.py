"""The data of a plot as plain arrays: fields cut to one or two axes, and paths folded at periodic seams.

This file does not use matplotlib. Cuts are linear between nodes, like ``Solution.value_at``; fields of enumerated
controls are cut at the nearest node. Entries that are not finite are masked.
"""

import difflib
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import numpy as np

from hjbjax.feedback.payments import is_tube
from hjbjax.plotting.scales import place_text
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import Labels
from hjbjax.problem.sets import Ball, Box, Simplex
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, State
from hjbjax.tracing import checks

if TYPE_CHECKING:
    from hjbjax.solution.solution import Solution

# coordinates by axis number or name; three types, because a type checker does not accept {0: 1.0} for the last one
Cuts: TypeAlias = Mapping[int, float] | Mapping[str, float] | Mapping[int | str, float]
STOP, PUSH = "stop", "push"  # the labels of the stopping set and of a push region; its direction is added
CHUNK = 1 << 16  # number of states evaluated at once, to bound the memory of intermediate arrays
RASTER = 301  # points per axis for the outline of a set; a disc a tenth of the plot wide has 30 across
ON_NODE = 1e-9  # fraction of a cell: a coordinate this close to a node means the node, so 0.1 + 0.2 means 0.3
ENDS = 0.01  # fraction of the range of V: where the ends of the box change V by more, pictures are marked
COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")


class Section(NamedTuple):
    """A field cut to one or two axes: the axes, their labels and coordinates, masked values, and the cuts."""

    axes: tuple[int, ...]
    labels: tuple[str, ...]
    coordinates: tuple[np.ndarray, ...]
    values: np.ma.MaskedArray
    caption: str
    grid: Grid
    cuts: dict[int, float]  # by axis number

    def states(self, coordinates: Sequence[np.ndarray]) -> np.ndarray:
        """The states on a raster of the free axes, shape (*raster, n), with the other states at their cuts."""
        raster = np.meshgrid(*coordinates, indexing="ij")
        columns = dict(zip(self.axes, raster, strict=True))
        return np.stack(
            [columns.get(axis, np.full(raster[0].shape, self.cuts.get(axis))) for axis in range(self.grid.ndim)],
            axis=-1,
        )


class Described(NamedTuple):
    """Members of a Solution that reachability solutions and a user's stand-ins may leave out; see ``described``."""

    labels: Labels = Labels()
    times: Array | None = None
    problem: Any = None  # a Problem, or a stand-in of the user
    discrete: bool = False  # the mean of two enumerated controls may not be admissible
    stopping: Array | None = None  # the nodes where it is optimal to stop
    pushing: Array | None = None  # the nodes where each push is optimal
    box_error: Array | None = None  # the change of V under another assumption at the ends of the box


def described(solution: "Solution | None") -> Described:
    """The optional members of a solution, with their defaults where it has none."""
    given = {name: getattr(solution, name) for name in Described._fields if hasattr(solution, name)}
    return Described(**given)


class Region(NamedTuple):
    """A set in the plane of a section.

    Args:
      label: its name.
      coordinates: of a fine raster.
      level: the function of the set on the raster, ≤ 0 inside.
      nodes: True for the nodes inside, of the shape of the section.
      points: the coordinates of the nodes inside that are not on a face of the box, (k, 2).
    """

    label: str
    coordinates: tuple[np.ndarray, ...]
    level: np.ndarray
    nodes: np.ndarray
    points: np.ndarray

    @property
    def visible(self) -> bool:
        """True if the set is as wide as a line, so that its outline can be seen."""
        inside = self.level < 0
        return bool(np.any(inside[:-2, :-2] & inside[2:, :-2] & inside[:-2, 2:] & inside[2:, 2:]))


def region_of(function: Callable[[State], Number], section: Section, label: str) -> Region:
    """The set where a function of one state is ≤ 0, in the plane of a section over two axes.

    Raises:
      ValueError: the function cannot be traced, or does not return a number.
    """
    checks.function_of(function, label, (), x=(section.grid.ndim,))
    fine = tuple(np.linspace(line[0], line[-1], RASTER) for line in section.coordinates)
    level, nodes = (at_states(function, section.states(lines)) for lines in (fine, section.coordinates))
    inner = np.ones(nodes.shape, bool)
    for position, axis in enumerate(section.axes):
        if not section.grid.periodic[axis]:  # a set may be a face of the box, which the frame already draws
            np.moveaxis(inner, position, 0)[[0, -1]] = False
    places = np.argwhere((nodes <= 0) & inner)
    points = np.stack([line[places[:, i]] for i, line in enumerate(section.coordinates)], axis=-1)
    return Region(label, fine, np.where(np.isfinite(level), level, 1.0), nodes <= 0, points)


def at_time(solution: "Solution", field: Array, time: float | None) -> tuple[np.ndarray, str]:
    """The field at the stored time closest to ``time``, and a caption with this time."""
    field, times = np.asarray(field), described(solution).times
    if times is None:
        if time is not None:
            raise ValueError(f"time: got {time!r}, but the solution is stationary; leave time out")
        return field, ""
    times = np.asarray(times)
    index = int(np.argmin(times if time is None else np.abs(times - time)))
    return field[index], f"t = {times[index]:.4g}"


def target_of(solution: "Solution", time: float | None = None) -> Callable[[State], Number] | None:
    """The target of the solution's problem at the time of the plot; ``None`` if unknown."""
    problem = described(solution).problem
    if problem is None or problem.target is None:
        return None
    if not problem.time_dependent:
        return problem.target
    moment = _moment(solution, time)
    return lambda x: problem.target(moment, x)


def decided_sets(
    solution: "Solution", section: Section, time: float | None = None
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The stopping set and the region of each push in the plane of a section, bool, and V there; none for tubes.

    Their names are the keys. The name of a push has its direction, as in "push cash down".

    A tube without running cost and noise is drawn by its level sets, and its paths do not stop.
    """
    known = described(solution)
    if known.problem is not None and is_tube(known.problem):
        return {}
    cuts: Cuts = section.cuts
    found = {}
    for name, mask in _masks(known, section.grid).items():
        inside, value = (
            section_of("value", at_time(solution, np.asarray(f, float), time)[0], section.grid, cuts, "", nearest=True)
            for f in (mask, solution.value)
        )
        found[name] = inside.values.data > 0.5, value.values.data
    return found


def _masks(known: Described, grid: Grid) -> dict[str, np.ndarray]:
    """The nodes where the state stops or is pushed, by name."""
    found = {} if known.stopping is None else {STOP: np.asarray(known.stopping)}
    if known.pushing is None:
        return found
    if known.problem is None or not known.problem.pushes:  # a solution from a file does not know its problem
        return found | {PUSH: np.any(known.pushing, axis=-1)}
    for number, push in enumerate(known.problem.pushes):
        axis, sign = push.step
        name = f"{PUSH} {grid.names[axis]} {'up' if sign > 0 else 'down'}"
        found[name] = np.asarray(known.pushing)[..., number]
    return found


def near_ends(solution: "Solution", section: Section, time: float | None = None) -> np.ndarray:
    """The nodes of a section where V depends on the assumptions at the ends of the box, bool."""
    error = described(solution).box_error
    if error is None:
        return np.zeros(section.values.shape, bool)
    value = at_time(solution, solution.value, time)[0]
    known = value[np.isfinite(value)]
    # a march has one estimate for each time, or one for the earliest time
    change = at_time(solution, error, time)[0] if np.ndim(error) > solution.grid.ndim else np.asarray(error)
    cut = section_of("value", change, section.grid, section.cuts, "").values.filled(0.0)
    return cut > ENDS * (np.ptp(known) if known.size else np.inf)


def sets_of(solution: "Solution", time: float | None = None) -> dict[str, Callable[[State], Number]]:
    """The sets whose signed distances define a reachability problem, by name, as functions ≤ 0 inside."""
    problem = described(solution).problem
    if problem is None or problem.target is not None or problem.cost is not None:
        return {}
    moment = _moment(solution, time) if problem.time_dependent else 0.0
    above = problem.inside == "above"

    def at(function: Callable, sign: int) -> Callable[[State], Number]:
        return lambda x: sign * function(*problem.state_arguments(x, moment))

    end = problem.terminal_cost if callable(problem.terminal_cost) else None
    least = problem.stopping_cost if callable(problem.stopping_cost) else None if above else end
    most = problem.running_max if problem.running_max is not None else end if above else None
    sets = {"target": (least, 1), "obstacle": (most, -1)}  # the running maximum is −o, ≥ 0 inside the obstacle
    return {name: at(function, sign) for name, (function, sign) in sets.items() if function is not None}


def _moment(solution: "Solution", time: float | None) -> float:
    """The stored time closest to ``time``, or the earliest."""
    times = np.asarray(solution.times, float)
    return float(times[np.argmin(times if time is None else np.abs(times - time))])


def span_of(solution: "Solution", input: int) -> float:
    """The length of the range of one control; 0 if unknown."""
    problem = described(solution).problem
    controls = None if problem is None else problem.controls
    if isinstance(controls, Box):
        span = float(controls.hi[input] - controls.lo[input])
        return span if np.isfinite(span) else 0.0
    if isinstance(controls, Simplex):
        return float(controls.total)
    return 2 * float(controls.radius) if isinstance(controls, Ball) else 0.0


def at_states(function: Callable[[State], Number], states: np.ndarray) -> np.ndarray:
    """Evaluate a function of one state at states of shape (..., n), in one program; shape (...)."""
    # in float64, because in float32 a level at a face of the box would be rounded to either side
    with own_settings(x64=True):
        every = jax.jit(lambda states: jax.lax.map(function, states, batch_size=CHUNK))
        return np.asarray(every(states.reshape(-1, states.shape[-1]))).reshape(states.shape[:-1])


def feedback(solution: "Solution", input: int, fixed: Cuts | None, time: float | None) -> tuple[Section, str]:
    """The section and the name of one input, masked where no control is defined or the value is not finite."""
    if solution.policy is None:
        raise ValueError("policy: this solution has no policy")
    inputs, caption = at_time(solution, solution.policy, time)
    count = inputs.shape[-1]
    # bool is a subclass of int, so True would mean input 1
    if isinstance(input, bool) or not isinstance(input, (int, np.integer)) or not 0 <= input < count:
        allowed = f"0 to {count - 1}" if count else "none: the problem has no control"
        raise ValueError(f"policy: got input={input!r}, wanted one of {allowed}")
    # where V is infinite all controls are equally bad, so the greedy control is meaningless
    known = np.isfinite(at_time(solution, solution.value, time)[0])
    field = np.where(known, inputs[..., input], np.nan)
    extra = described(solution)
    label = extra.labels.control(input, count)
    return section_of("policy", field, solution.grid, fixed, caption, extra.discrete), label


def section_of(
    what: str,
    field: np.ndarray,
    grid: Grid,
    fixed: Cuts | None,
    caption: str,
    nearest: bool = False,
) -> Section:
    """Cut the field at the fixed coordinates, close it along periodic axes, and mask entries that are not finite."""
    if field.shape != grid.shape:
        raise ValueError(
            f"{what}: got a field of shape {field.shape} on a grid of shape {grid.shape}; draw one lane at a time"
        )
    cuts: dict[int, float] = {}  # keys are numbers, because an axis may be given both by name and by number
    for key, place in dict(fixed or {}).items():
        axis = axis_number(key, grid)
        if axis in cuts:
            raise ValueError(f"{what}: fixed gives axis {axis} ({grid.names[axis]}) twice; give each axis once")
        if not np.ndim(place) == 0 or not np.isreal(place):
            raise ValueError(f"{what}: got {grid.names[axis]} = {place!r}, wanted one coordinate")
        cuts[axis] = float(place)
    free = tuple(axis for axis in range(grid.ndim) if axis not in cuts)
    if not 1 <= len(free) <= 2:
        raise ValueError(f"{what}: {_how_many(grid, free)}")
    field = closed_field(cut_field(what, field, grid, cuts, nearest), grid, free)
    coordinates = tuple(closed_axis(grid, axis) for axis in free)
    places = [caption] * bool(caption)
    places += [f"{grid.names[axis]} = {place_text(grid, axis, cuts[axis])}" for axis in sorted(cuts)]
    return Section(
        free, tuple(grid.labels[axis] for axis in free), coordinates, np.ma.masked_invalid(field), ", ".join(places),
        grid, cuts,
    )  # fmt: skip


def _how_many(grid: Grid, free: tuple[int, ...]) -> str:
    """The error message if the number of free axes is not one or two."""
    if not free:
        return "every axis is fixed; leave one or two of them free"
    rest = grid.ndim - 2
    number = COUNTS[rest] if rest < len(COUNTS) else str(rest)
    example = ", ".join(f"{grid.names[axis]!r}: ..." for axis in range(2, grid.ndim))
    return (
        f"a picture has two axes and {len(free)} are free ({', '.join(grid.names[axis] for axis in free)}); "
        f"choose two axes and fix the other {number}, as in fixed={{{example}}}"
    )


def axis_number(key: object, grid: Grid) -> int:
    """The number of the axis with this number or name."""
    if isinstance(key, str) and key in grid.names:
        return grid.names.index(key)
    if isinstance(key, (int, np.integer)) and not isinstance(key, bool) and 0 <= key < grid.ndim:
        return int(key)
    near = difflib.get_close_matches(str(key), grid.names, 1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"fixed: got axis {key!r}, wanted one of {', '.join(grid.names)} or 0 to {grid.ndim - 1}{hint}")


def cut_field(what: str, field: np.ndarray, grid: Grid, cuts: Mapping[int, float], nearest: bool = False) -> np.ndarray:
    """Cut a field at the nodes at the coordinates in ``cuts``, by axis number."""
    for axis in sorted(cuts, reverse=True):  # last axis first, because a cut renumbers the axes behind it
        field = _cut(what, field, grid, axis, cuts[axis], nearest)
    return field


def closed_field(field: np.ndarray, grid: Grid, free: Sequence[int]) -> np.ndarray:
    """Repeat the first row of a field at the upper end of each periodic free axis, so that no gap remains."""
    for position, axis in enumerate(free):
        if grid.periodic[axis]:
            field = np.concatenate([field, np.take(field, [0], position)], position)
    return field


def _cut(what: str, field: np.ndarray, grid: Grid, axis: int, place: float, nearest: bool) -> np.ndarray:
    """Interpolate linearly along one axis; a neighbour with weight zero does not contribute, even if infinite."""
    lo, hi, last = float(grid.lo[axis]), float(grid.hi[axis]), grid.intervals(axis)
    if grid.periodic[axis] and math.isfinite(place):
        place = lo + (place - lo) % (hi - lo)
    slack = ON_NODE * (hi - lo) / last
    if not lo - slack <= place <= hi + slack:  # in this form NaN is refused
        raise ValueError(f"{what}: got {grid.names[axis]} = {place:g}, which is outside the grid, [{lo:g}, {hi:g}]")
    nodes = closed_axis(grid, axis)  # cells have different widths on a stretched axis
    position = float(np.interp(place, nodes, np.arange(len(nodes))))
    # on a node up to rounding; otherwise 0·∞ of a neighbour without weight would mask the whole slice
    if nearest or abs(position - round(position)) < ON_NODE:
        return np.take(field, round(position) % grid.shape[axis], axis)
    cell = math.floor(position)
    left, right = np.take(field, cell, axis), np.take(field, (cell + 1) % grid.shape[axis], axis)
    with np.errstate(invalid="ignore"):  # ∞ − ∞ is NaN, which is masked
        return (cell + 1 - position) * left + (position - cell) * right


def closed_axis(grid: Grid, axis: int) -> np.ndarray:
    """The coordinates of an axis, including the upper end of a periodic axis."""
    nodes = np.asarray(grid.axis(axis))
    return np.append(nodes, grid.hi[axis]) if grid.periodic[axis] else nodes


def zeros(x: np.ndarray, values: np.ma.MaskedArray) -> list[float]:
    """The places where a sampled function changes sign, linear between nodes; the middle of a run of zeros."""
    samples = values.filled(np.nan)  # NaN ≠ 0, so a masked node ends a run of zeros and does not cross
    signed = np.flatnonzero(samples != 0).tolist()
    crossings = []
    for left, right in itertools.pairwise(signed):
        if samples[left] * samples[right] >= 0 or np.isnan(samples[left] * samples[right]):
            continue
        # the middle of a run of zeros, because a control that rests in between has no unique switching point
        share = samples[left] / (samples[left] - samples[right])
        place = x[left] + share * (x[right] - x[left]) if right == left + 1 else np.mean(x[left + 1 : right])
        crossings.append(float(place))
    return crossings


def without_jumps(states: np.ndarray, grid: Grid | None) -> np.ndarray:
    """States (k, n) made continuous in time, without the jumps of periodic states at their seam."""
    states = np.array(states, dtype=float)
    if grid is None:
        return states
    for axis in np.flatnonzero(grid.periodic):
        states[:, axis] = np.unwrap(states[:, axis], period=float(grid.hi[axis] - grid.lo[axis]))
    return states


def line_in_box(states: np.ndarray, axes: tuple[int, int], grid: Grid | None) -> np.ndarray:
    """Two columns with periodic states wrapped into the box; a row of NaN cuts the line where it crosses a seam."""
    points = states[:, list(axes)]  # (k, 2)
    # the period of an axis that is not periodic is infinite, so both columns use the same code
    lo, period = np.zeros(2), np.full(2, np.inf)
    for column, axis in enumerate(axes):
        if grid is not None and grid.periodic[axis]:
            lo[column], period[column] = grid.lo[axis], grid.hi[axis] - grid.lo[axis]

    def turns(point: np.ndarray) -> np.ndarray:  # the number of periods between the point and the box, (2,)
        return np.where(np.isinf(period), 0.0, np.floor((point - lo) / period))

    def shift(count: np.ndarray) -> np.ndarray:  # the length of this number of periods; 0·∞ would be NaN
        return np.where(np.isinf(period), 0.0, count * np.where(np.isinf(period), 0.0, period))

    here = turns(points[0])
    rows = [points[0] - shift(here)]
    for start, end in itertools.pairwise(points):
        cuts: set[float] = {0.0, 1.0}  # the fractions at which the piece from start to end crosses a seam
        for column in np.flatnonzero(turns(start) != turns(end)).tolist():
            low, high = sorted((turns(start)[column], turns(end)[column]))
            edges = lo[column] + np.arange(low + 1, high + 1) * period[column]
            shares = (edges - start[column]) / (end[column] - start[column])
            cuts.update(np.round(shares, 12).tolist())  # rounded, so that a corner is one cut
        for a, b in itertools.pairwise(sorted(cuts)):
            # use the middle of the piece, because its ends are on seams, where rounding decides the side
            piece = turns(start + (a + b) / 2 * (end - start))
            if np.any(piece != here):
                rows += [np.full(2, np.nan), start + a * (end - start) - shift(piece)]
                here = piece
            # the end itself, because start + 1·(end − start) is rounded
            rows.append((end if b == 1 else start + b * (end - start)) - shift(here))
    return np.array(rows)
