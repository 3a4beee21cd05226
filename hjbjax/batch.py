"""Many problems on one grid at once: ``solve_batch``.

Problems that differ in numbers alone are lanes of one ``vmap``ped loop. A batched loop runs until its slowest
lane stops, so finished lanes are taken out between chunks; each lane has its own status, and one that goes NaN
changes no bit of the others.
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import checks, iteration, memory
from hjbjax.grid import Grid
from hjbjax.iteration import Method, Nested, State, Task
from hjbjax.preparation import choose, prepare_on_host
from hjbjax.problem import Problem
from hjbjax.report import describe, finish
from hjbjax.schemes import Upwind
from hjbjax.solution import Solution, SolveError
from hjbjax.solver import as_dtype, check_arguments
from hjbjax.status import Status

CHUNK = 8  # steps between two looks at which lanes are done

_begin = jax.vmap(iteration.begin)
_run = jax.jit(jax.vmap(iteration.run, in_axes=(0, 0, 0)))


def solve_batch(
    problems: Iterable[Problem],
    grid: Grid,
    *,
    method: Method | None = None,
    scheme: Upwind = Upwind(),
    tol: float = 1e-3,
    dtype: Any = None,
    max_steps: int | None = None,
    throw: bool = True,
    max_memory: int | None = None,
) -> list[Solution]:
    """Solve many problems on one grid; each answer is what ``solve`` with the same method gives.

    Args:
      problems: problems; those with the same functions and shapes run together, whatever their numbers.
      grid: the nodes.
      method: as in ``solve``, without nesting; ``None`` picks by the problem.
      scheme: the discretisation.
      tol: as in ``solve``.
      dtype: as in ``solve``.
      max_steps: at most so many steps for each lane.
      throw: raise when a lane does not converge; otherwise its status says it.
      max_memory: bytes that one round of lanes may take; a batch that needs more runs in several.

    Returns:
      One solution for each problem, in their order.

    Raises:
      ValueError: a question without an answer; the lane is named.
      SolveError: a lane did not converge; ``.solution`` is the first such.
    """
    lanes = list(problems)
    for lane in lanes:
        check_arguments(lane, grid, method, scheme, tol, max_steps, None)
    kind = as_dtype(dtype)
    solutions: list[Any] = [None] * len(lanes)
    with jax.enable_x64(kind == np.float64):
        for members in _alike(lanes):
            first = lanes[members[0]]
            chosen = method or choose(first, grid, traced=False)
            chosen = chosen.inner if isinstance(chosen, Nested) else chosen
            checks.shapes(first, grid, scheme)
            for some in _rounds(members, memory.require(first, grid, chosen, kind, max_memory), max_memory):
                together = _solve_together([lanes[i] for i in some], some, grid, chosen, scheme, tol, kind, max_steps)
                for index, solution in zip(some, together, strict=True):
                    solutions[index] = solution
    for index, solution in enumerate(solutions):
        if throw and solution.status is not Status.CONVERGED:
            raise SolveError(f"lane {index}: {solution.status.name}: {solution.message}", solution)
    return solutions


def _alike(problems: Sequence[Problem]) -> list[list[int]]:
    """The indices of problems that share functions and shapes, in the order of first appearance."""
    groups: dict[Any, list[int]] = {}
    for index, problem in enumerate(problems):
        leaves, structure = jax.tree.flatten(problem)
        groups.setdefault((structure, tuple(np.shape(leaf) for leaf in leaves)), []).append(index)
    return list(groups.values())


def _rounds(members: Sequence[int], bytes_each: int, limit: int | None) -> list[Sequence[int]]:
    """Lanes that fit into half of the memory together."""
    free = limit if limit is not None else memory.available()
    most = len(members) if free is None else max(1, free // 2 // max(bytes_each, 1))
    return [members[start : start + most] for start in range(0, len(members), most)]


def _solve_together(
    problems: Sequence[Problem],
    names: Sequence[int],
    grid: Grid,
    method: Method,
    scheme: Upwind,
    tol: float,
    kind: Any,
    max_steps: int | None,
) -> list[Solution]:
    clock = time.perf_counter()
    prepared = []
    for name, problem in zip(names, problems, strict=True):
        try:
            prepared.append(prepare_on_host(problem, grid, method=method, scheme=scheme, tol=tol, dtype=kind))
        except ValueError as refusal:
            raise ValueError(f"lane {name}: {refusal}") from refusal
    tasks = _stack([task for task, _, _ in prepared])
    states = _begin(tasks, jnp.zeros((len(problems), *grid.shape), kind))
    final, histories = _finish_lanes(tasks, states, len(problems), max_steps or 10**9)
    seconds = time.perf_counter() - clock
    solutions = []
    for problem, (task, verdict, reached), state, residuals in zip(problems, prepared, final, histories, strict=True):
        code = Status(int(state.code)) or Status.MAX_STEPS
        solution = finish(task, state, code, reached, np.concatenate(residuals), verdict, grid)
        solution.stats.update(method=describe(method, problem), seconds=seconds, lanes=len(problems), tol=tol)
        solutions.append(solution)
    return solutions


def _finish_lanes(tasks: Task, states: State, count: int, max_steps: int) -> tuple[list[State], list[list]]:
    """Chunks of steps until every lane is done; lanes that are done are taken out where that halves the work."""
    final: list[Any] = [None] * count
    histories: list[list] = [[] for _ in range(count)]
    lanes = np.arange(count)  # which lane each row holds; −1 in rows that only fill up
    while lanes.size:
        before = np.asarray(states.step)
        states = _run(tasks, states, np.minimum(before + CHUNK, max_steps))
        codes, steps, history = jax.device_get((states.code, states.step, states.history))
        going = (codes == Status.RUNNING) & (steps < max_steps) & (lanes >= 0)
        live = [row for row, lane in enumerate(lanes) if lane >= 0 and final[lane] is None]
        for row in live:
            histories[lanes[row]].append(history[row, : steps[row] - before[row]])
        ended = [row for row in live if not going[row]]
        if ended:
            on_host = jax.device_get(states)
            for row in ended:
                final[lanes[row]] = jax.tree.map(lambda leaf, row=row: leaf[row].copy(), on_host)
        left = np.flatnonzero(going)
        width = 1 << (left.size - 1).bit_length() if left.size else 0
        if width < lanes.size:
            kept = np.resize(left, width)
            lanes = np.where(np.arange(width) < left.size, lanes[kept], -1)
            tasks, states = _take(tasks, kept), _take(states, kept)
    return final, histories


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(jnp.broadcast_arrays(*leaves)), *trees)


def _take(tree: Any, rows: np.ndarray) -> Any:
    return jax.tree.map(lambda leaf: leaf[rows], tree)
