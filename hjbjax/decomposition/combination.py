"""The solutions of the blocks as one solution: values are added, or their largest or smallest is taken.

For a tube whose target is an intersection all blocks must be inside at the same moment:

    V(t, x) = min over s in [t, T] of max_i V_i(s, x_i),

where V_i(s, ·) is the value at time s of reaching at the end of the horizon T; the problem does not depend on time. The
values are linear between the kept times. So the minimum of their maximum is at a kept time, or where two of them are
equal, and both kinds are evaluated.
"""

import itertools
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.decomposition.separation import MAX, MIN, SUM
from hjbjax.decomposition.subsystems import FIRST
from hjbjax.problem import labels as labelling
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import Labels
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Numbers
from hjbjax.solution import archive, files
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status

Places = tuple[tuple[int, ...], ...]
LARGEST = 10**6  # number of states, controls or disturbances in a file: a query allocates an entry for each


@pytree_dataclass(static=("rule", "bound", "states", "controls", "disturbances", "labels", "count"), host=("problem",))
class BlockSolution(files.Saved):
    """The value of a problem that separates into blocks; made by ``Decomposition.solve`` and ``march``.

    Args:
      parts: the solutions of the blocks.
      rule: "sum", "max", "min", or "first": the least over time of the largest.
      bound: "lower" or "upper" if the value is only this bound of V; ``None`` if it is V.
      states: the numbers of the states of every block.
      controls: the numbers of the controls of every block.
      disturbances: the numbers of the disturbances of every block.
      labels: names and units of the controls, the side of the level set, and whether V is a cost or a reward.
      count: the number of states n; states that are in no block have no effect on V.
      problem: the whole problem; ``None`` on return from ``jit`` or from a file; host data.
    """

    FORMAT = "hjbjax.BlockSolution"
    KINDS: ClassVar = {
        "parts": (list,), "rule": (str,), "bound": (str, type(None)), "states": (list,), "controls": (list,),
        "disturbances": (list,), "labels": (list,), "count": (int,),
    }  # fmt: skip

    parts: tuple[Solution, ...]
    rule: str
    bound: str | None
    states: Places
    controls: Places
    disturbances: Places
    labels: Labels = Labels()
    count: int = 0
    problem: Problem | None = None

    @property
    def status(self) -> Any:
        """The worst ``Status`` of the blocks."""
        found = [part.status for part in self.parts]
        return next((each for each in found if each is not Status.CONVERGED), Status.CONVERGED)

    @property
    def ndim(self) -> int:
        """The number of states n."""
        return self.count

    @property
    def times(self) -> Any:
        """The kept times of a march; ``None`` for a stationary solution."""
        return self.parts[0].times

    @property
    def timed(self) -> bool:
        """True after ``march``, with methods that take (t, x) instead of (x)."""
        return self.times is not None

    @property
    def error(self) -> float | None:
        """The certified bound on the distance to the solutions of the discrete problems; ``None`` without one."""
        found = [part.error for part in self.parts]
        if any(each is None for each in found):
            return None
        return float(sum(found) if self.rule == SUM else max(found))

    def value_at(self, *where: Numbers | Sequence, clamp: bool = False) -> Any:
        """V, or its bound: ``value_at(x)``, or ``value_at(t, x)`` for a march; works under jit and vmap.

        Args:
          where: states x, shape (n,) or (..., n); for a march preceded by the time.
          clamp: use the nearest point for states outside the grids; otherwise NaN.

        Returns:
          Shape ``x.shape[:-1]``, in cost units.
        """
        if self.rule == FIRST:
            return self._first_time(where, clamp)[0]
        values = self._of_parts("value_at", where, clamp)
        xp: Any = jnp if is_traced(values) else np
        stacked = xp.stack(values)
        return {SUM: xp.sum, MAX: xp.max, MIN: xp.min}[self.rule](stacked, axis=0)

    def control_at(self, *where: Numbers | Sequence, clamp: bool = False) -> Any:
        """u, shape ``x.shape[:-1] + (m,)``; arguments as for ``value_at``.

        Every block uses its own optimal control. For a minimum the controls of the block with the least value decide,
        also those that it shares with other blocks; for a maximum, those of the block with the largest.
        """
        return self._actions("control_at", self.controls, where, clamp)

    def disturbance_at(self, *where: Numbers | Sequence, clamp: bool = False) -> Any:
        """The opponent's d, shape ``x.shape[:-1] + (k,)``; see ``control_at``."""
        return self._actions("disturbance_at", self.disturbances, where, clamp)

    def costate_at(self, *where: Numbers | Sequence, clamp: bool = False) -> Any:
        """DV, shape ``x.shape[:-1] + (n,)``: of all blocks for a sum, otherwise of the block whose value V is."""
        n = self.count
        if self.rule == FIRST:
            _, leading, moment = self._first_time(where, clamp)
            slopes = self._of_parts("costate_at", (moment, where[-1]), clamp)
        else:
            slopes, leading = self._of_parts("costate_at", where, clamp), self._leading(where, clamp)
        own = [leading == i if leading is not None else None for i in range(len(slopes))]
        return _placed(slopes, self.states, n, own)

    def grid_error_at(self, *where: Numbers | Sequence) -> Any:
        """An estimate of the error of the grids and of the time steps, shape ``x.shape[:-1]``; arguments as above.

        The sum over the blocks for a sum, otherwise the largest. NaN if a block has no estimate.
        """
        found = []
        for part, own in zip(self.parts, self._own_states(where), strict=True):
            estimate = part.grid_error
            if estimate is None:
                return np.full(np.shape(own[-1])[:-1], np.nan)
            marched = part.times is not None
            values = Solution(part.grid, np.asarray(estimate), None, times=part.times)
            if marched and self.rule == FIRST:  # at an unknown kept time: the largest estimate over time
                own = (own[-1],)
                values = Solution(part.grid, np.max(np.asarray(estimate), axis=0), None)
            found.append(values.value_at(*own, clamp=True))
        return np.sum(found, axis=0) if self.rule == SUM else np.max(found, axis=0)

    def on_grid(self, grid: Grid) -> Solution:
        """Value and feedback at the nodes of one grid over all states: for pictures and ``greedy_feedback``.

        Args:
          grid: the nodes; keep it coarse in many dimensions.
        """
        nodes, times = grid.nodes(), None if self.times is None else np.asarray(self.times)
        if times is None:
            value, policy = self.value_at(nodes, clamp=True), self.control_at(nodes, clamp=True)
        else:
            value, policy = (
                np.stack([np.asarray(look(t, nodes, clamp=True)) for t in times])
                for look in (self.value_at, self.control_at)
            )
        return Solution(
            grid, np.asarray(value), np.asarray(policy), code=int(self.status), times=times, labels=self.labels,
            problem=self.problem, message=f"Combined from {len(self.parts)} blocks: {self.rule}.",
            discrete=any(part.discrete for part in self.parts),
        )  # fmt: skip

    def _contents(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        headers: list[dict] = []
        arrays: dict[str, np.ndarray] = {}
        for i, part in enumerate(self.parts):
            header, own = archive.contents(part)
            headers.append(header)
            arrays |= {f"part{i}.{name}": array for name, array in own.items()}
        names = ("rule", "bound", "states", "controls", "disturbances", "labels", "count")
        return {"parts": headers, **{name: getattr(self, name) for name in names}}, arrays

    @staticmethod
    def _plan(header: dict) -> dict[str, files.Expected]:
        """The arrays of a file: those of every block."""
        return {
            f"part{i}.{name}": expected
            for i, own in enumerate(header["parts"])
            for name, expected in archive.plan(own).items()
        }

    @classmethod
    def _from_file(cls, header: dict, arrays: dict[str, np.ndarray]) -> Self:
        """The solution with a header and arrays of a file."""
        parts = []
        for i, own in enumerate(header["parts"]):
            mine = {name.partition(".")[2]: array for name, array in arrays.items() if name.startswith(f"part{i}.")}
            parts.append(Solution(**archive.fields(own, mine)))
        for name, known in {"rule": (SUM, MAX, MIN, FIRST), "bound": (None, "lower", "upper")}.items():
            if header[name] not in known:
                raise files.FileError(f"its {name} is {header[name]!r:.60}, wanted one of {known}")
        count = header["count"]
        states = _places_in_file(header, "states", [part.grid.ndim for part in parts], count)
        controls, disturbances = (
            _places_in_file(header, name, [_size(getattr(part, field)) for part in parts], LARGEST)
            for name, field in (("controls", "policy"), ("disturbances", "disturbance"))
        )
        if len({part.times is None for part in parts}) > 1:
            raise files.FileError("some of its blocks depend on time and others do not")
        return cls(
            tuple(parts), header["rule"], header["bound"], states, controls, disturbances,
            labelling.of_file(header["labels"]), count,
        )  # fmt: skip

    def _count(self, places: Places) -> int:
        """The number of controls or disturbances of the whole problem."""
        return max((place + 1 for each in places for place in each), default=0)

    def _own_states(self, where: tuple) -> list[tuple]:
        """The arguments ``where`` for every block."""
        *time, x = where
        xp: Any = jnp if is_traced(x) else np
        x = xp.asarray(x)
        n = self.count
        if x.ndim == 0 or x.shape[-1] < n:
            raise ValueError(f"BlockSolution: got states of shape {x.shape}, wanted (..., {n})")
        return [(*time, x[..., np.array(each, int)]) for each in self.states]

    def _of_parts(self, name: str, where: tuple, clamp: bool) -> list:
        """The results of a method of all blocks."""
        own = self._own_states(where)
        return [getattr(part, name)(*each, clamp=clamp) for part, each in zip(self.parts, own, strict=True)]

    def _leading(self, where: tuple, clamp: bool) -> Any:
        """The number of the block whose value V is; ``None`` for a sum."""
        if self.rule == SUM:
            return None
        values = self._of_parts("value_at", where, clamp)
        xp: Any = jnp if is_traced(values) else np
        return (xp.argmax if self.rule == MAX else xp.argmin)(xp.stack(values), axis=0)

    def _actions(self, name: str, places: Places, where: tuple, clamp: bool) -> Any:
        """The actions of all blocks in one array; where blocks share an input, those of the leading block."""
        if self.rule == FIRST:
            _, leading, moment = self._first_time(where, clamp)
            where = (moment, where[-1])
        else:
            leading = self._leading(where, clamp)
        used = [i for i, each in enumerate(places) if each]
        own = self._own_states(where)
        actions = [getattr(self.parts[i], name)(*own[i], clamp=clamp) for i in used]
        chosen = [leading == i if leading is not None else None for i in used]
        shared = len({place for each in places for place in each}) < sum(map(len, places))
        return _placed(
            actions, [places[i] for i in used], self._count(places), chosen if shared else [None] * len(used)
        )

    def _first_time(self, where: tuple, clamp: bool) -> tuple[Any, Any, Any]:
        """The least over time of the largest value, the block with the largest value, and the time."""
        if len(where) != 2:
            raise ValueError("BlockSolution: got no time, wanted (t, x): the solution is marched")
        own, t = self._own_states(where), where[0]
        if is_traced(self, t, *own):
            return _least_of_largest(self.parts, jnp.asarray(t), [each[-1] for each in own], clamp)
        with own_settings(x64=True):
            states = [np.asarray(each[-1], float) for each in own]
            return jax.tree.map(np.asarray, _least_of_largest(self.parts, np.asarray(t, float), states, clamp))


def _least_of_largest(
    parts: Sequence[Solution], t: Array, states: Sequence[Array], clamp: bool
) -> tuple[Any, Any, Any]:
    """min over s ≥ t of max_i V_i(s, x_i), the block of the maximum, and s; the time is the last axis inside."""
    times = jnp.asarray(parts[0].times)
    t = jnp.broadcast_to(jnp.asarray(t, times.dtype), states[0].shape[:-1])
    until = jnp.maximum(times, t[..., None])  # kept times before t count as t
    values = []
    for part, x in zip(parts, states, strict=True):
        over = part.grid.interpolate(jnp.moveaxis(jnp.asarray(part.value), 0, -1), x, clamp=clamp)  # (..., times)
        values.append(_between_times(times, over, until))
    stacked = jnp.stack(values)  # (blocks, ..., times)
    candidates, moments = [jnp.max(stacked, axis=0)], [until]
    for a, b in itertools.combinations(range(len(parts)), 2):
        before, after = (stacked[a] - stacked[b])[..., :-1], (stacked[a] - stacked[b])[..., 1:]
        crosses = before * after < 0
        share = jnp.where(crosses, before / jnp.where(crosses, before - after, 1), 0)
        there = stacked[..., :-1] + share * (stacked[..., 1:] - stacked[..., :-1])
        candidates.append(jnp.max(there, axis=0))
        moments.append(until[..., :-1] + share * (until[..., 1:] - until[..., :-1]))
    everything, when = jnp.concatenate(candidates, axis=-1), jnp.concatenate(moments, axis=-1)
    place = jnp.argmin(everything, axis=-1, keepdims=True)
    best, moment = (jnp.take_along_axis(each, place, axis=-1)[..., 0] for each in (everything, when))
    at = jnp.stack([_between_times(times, v, moment[..., None], until)[..., 0] for v in values])
    return best, jnp.argmax(at, axis=0), moment


def _between_times(times: Array, values: Array, when: Array, nodes: Array | None = None) -> jax.Array:
    """Linear interpolation in time along the last axis of ``values``, at the times ``when`` of shape (..., k)."""
    nodes = jnp.broadcast_to(times, values.shape) if nodes is None else nodes
    flat = [jnp.reshape(each, (-1, each.shape[-1])) for each in (when, nodes, values)]
    return jax.vmap(jnp.interp)(*flat).reshape(when.shape)


def _size(actions: Any) -> int | None:
    """The number of controls or disturbances of a block; None if they are unknown."""
    return None if actions is None else int(np.shape(actions)[-1])


def _places_in_file(header: dict, name: str, sizes: Sequence[int | None], count: int) -> Places:
    """The numbers of the states or inputs of every block in the header of a file.

    Args:
      header: the header.
      name: the entry.
      sizes: the number of states or inputs of every block; None if it is unknown.
      count: the number of states or inputs of the whole problem, or a bound of it.

    Raises:
      FileError: they do not fit the blocks.
    """
    found = header[name]
    lists = all(isinstance(each, list) for each in found) and len(found) == len(sizes)
    if not sizes or not lists or not 0 < count <= LARGEST:
        raise files.FileError(f"its {len(sizes)} blocks have {name} = {found!r:.60} of {count}")
    for each, size in zip(found, sizes, strict=True):
        if size not in (None, len(each)) or not all(type(place) is int and 0 <= place < count for place in each):
            raise files.FileError(f"a block of {size} {name} has the numbers {each!r:.60}, wanted some of {count}")
    return tuple(map(tuple, found))


def _placed(entries: Sequence[Any], places: Sequence[tuple[int, ...]], count: int, chosen: Sequence[Any]) -> Any:
    """Vectors of the blocks in one vector of ``count`` entries; a block that is not ``chosen`` does not overwrite."""
    xp: Any = jnp if is_traced(entries, chosen) else np
    shape = np.shape(entries[0])[:-1] if entries else ()
    columns: list[Any] = [xp.zeros(shape)] * count
    for values, own, mine in zip(entries, places, chosen, strict=True):
        for k, place in enumerate(own):
            entry = xp.asarray(values)[..., k]
            columns[place] = entry if mine is None else xp.where(mine, entry, columns[place])
    return xp.stack(columns, axis=-1) if columns else xp.zeros((*shape, 0))
