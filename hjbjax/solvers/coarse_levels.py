"""Coarser grids: their tasks, and the guess that their solutions give for the finest grid."""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.iteration.methods import Method
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import altered, in_type
from hjbjax.problem.types import Nodes
from hjbjax.solution.clock import Clock
from hjbjax.solution.status import Status
from hjbjax.solvers import nested_grids
from hjbjax.solvers.order import at_order, sharpened, staged
from hjbjax.solvers.setup import assumptions_of, prepared, stores_links
from hjbjax.solvers.stationary_run import iterate
from hjbjax.solvers.vanishing_discounts import warm


class CoarserAnswer(NamedTuple):
    """The solution on a coarser grid, infinite at unreachable nodes, or the reason why there is none."""

    grid: Grid | None
    value: np.ndarray | None = None
    reason: str = ""


def first_guess(
    task: Task, scheme: Scheme, method: Method, guess: Nodes | None, clock: Clock, *, asked_again: bool
) -> tuple[Nodes | None, list[tuple[int, ...]], CoarserAnswer | None]:
    """The guess for the finest grid, from the user or from coarser grids, and the shapes of those grids.

    The last result is the answer on the next coarser grid, with ``asked_again``; None if it was not solved.

    If the clock stops the solve meanwhile, the guess is the value so far, on the finest grid; None if there is none.

    Args:
      task: the task of the chain on the finest grid.
      scheme: the scheme of the solution on that grid.
      method: the chosen method, which may be nested.
      guess: the user's guess, or None.
      clock: the limits.
      asked_again: True if the next coarser grid will be solved again to estimate the error of the grid, so that its
        program is compiled in any case.
    """
    # an undiscounted tube has many fixed points; from its constraint the iteration finds the right one
    if guess is not None or (task.constrained and not np.asarray(task.problem.discount) > 0):
        return guess, [], None
    value: Nodes | None = None
    # with noise, or without a certificate, the schemes have programs of their own
    asked_again &= scheme.monotone or staged(task, scheme) is not task
    coarser = levels(task, method, clock, asked_again=asked_again)
    if coarser:
        coarser[-1] = staged(coarser[-1], scheme)  # the level whose solution is read again
    grids, answer = [*(level.grid for level in coarser), task.grid], None
    for level, finer in zip(coarser, grids[1:], strict=True):
        state, code, _ = iterate(level, warm(level, value, clock), clock)
        if clock.over() is not None:
            return nested_grids.prolong(fill_unreachable(level, state), level.grid, task.grid), [], None
        value = nested_grids.prolong(fill_unreachable(level, state), level.grid, finer)
        if asked_again and code is Status.CONVERGED:
            answer = answer_of(level, state)
    return value, [grid.shape for grid in grids[:-1]], answer


def answer_of(level: Task, state: State) -> CoarserAnswer:
    """The answer of a converged iteration on a coarser grid."""
    return CoarserAnswer(level.grid, values_of(level, state))


def values_of(task: Task, state: State) -> np.ndarray:
    """The value, infinite at unreachable nodes, (*grid)."""
    return np.where(np.asarray(task.counted), np.asarray(state.value), np.inf)


def fill_unreachable(task: Task, state: State) -> np.ndarray:
    """The value, with unreachable nodes set to the largest other value, because huge values spoil interpolation."""
    value, counted = np.asarray(state.value), np.asarray(task.counted)
    return np.where(counted, value, np.max(value[counted])) if task.has_lost else value


def levels(task: Task, method: Method, clock: Clock, *, asked_again: bool) -> list[Task]:
    """The tasks on coarser grids, coarsest first, down to the number of nodes that the method names.

    With ``asked_again`` the next coarser grid is there in any case, if it can estimate the error of the grid.
    """
    found: list[Task] = []
    smaller = (comparison_grid_of(task) if asked_again else None) or below(task.grid, method)
    while smaller is not None and clock.over() is None:
        clock.phase = f"the preparation of {' x '.join(map(str, smaller.shape))} nodes"
        level = on_coarser(task, smaller)
        if level is None:
            break
        found.insert(0, level)
        smaller = below(smaller, method)
    return found


def below(grid: Grid, method: Method) -> Grid | None:
    """The next coarser grid, if it has at least the method's least number of nodes for the coarsest grid."""
    smaller = nested_grids.coarser(grid)
    return None if smaller is None or method.coarsest is None or smaller.size < method.coarsest else smaller


def comparison_grid_of(task: Task) -> Grid | None:
    """The coarser grid for the estimate of the error of the task's grid; None if there is none."""
    counted = np.broadcast_to(np.asarray(task.counted), task.grid.shape)
    return nested_grids.comparison_grid(task.grid, _ends(task), ~counted if task.has_lost else None)


def _ends(task: Task) -> np.ndarray:
    """The nodes with a fixed finite value, (*grid): unreachable nodes are fixed too, at a value above all others."""
    return np.broadcast_to(np.asarray(task.obstacles.fixed & task.counted), task.grid.shape)


def on_coarser(task: Task, coarse: Grid) -> Task | None:
    """The task on a coarser grid; None if that grid would change the question."""
    # a float64 corner would make the whole chain float64 while JAX is set to 64 bits
    fine, coarse = task.grid, in_type(coarse, task.on.dtype)
    strides = [divmod(fine.intervals(axis), coarse.intervals(axis)) for axis in range(fine.ndim)]
    # ``outflow``, the rate of the fastest action, depends on the spacings
    if task.outflow is None and not any(rest for _, rest in strides):
        # data at all nodes restricts to every second node
        every = tuple(slice(None, None, stride) for stride, _ in strides)
        # leave out problem and grid, whose leaves may have the shape of the nodes by chance
        obstacles = task.obstacles
        if obstacles.interventions:  # the cost of a push depends on the spacing
            longer = obstacles.interventions.over([stride for stride, _ in strides])
            obstacles = dataclasses.replace(obstacles, interventions=longer)
        bare: Any = dataclasses.replace(task, on=None, obstacles=obstacles)  # type: ignore[arg-type]
        known = jax.tree.map(lambda leaf: np.asarray(leaf)[every] if np.shape(leaf) == fine.shape else leaf, bare)
        on = task.on.on_grid(coarse)
        if stores_links(on):  # arrays of the chain, which its own level on this grid needs too
            on = _with_links(on.chain).with_scheme(on.scheme)
        made = dataclasses.replace(known, on=on)
    elif task.has_lost:  # it is not known if nodes in between reach the target
        return None
    else:
        level = task.on.chain.on_grid(coarse)
        made = prepared(level, method=task.method, tol=task.tol, assumptions=assumptions_of(level), mesh=task.mesh)
        on = altered(made.on, problem=task.problem, grid=coarse, scheme=task.scheme)  # with the links of the chain
        made = dataclasses.replace(made, on=on, certificate=task.certificate)
        if task.first_order is not None:
            made = at_order(made, first=bool(np.asarray(task.first_order)))
        elif not task.scheme.monotone:
            made = sharpened(made)
    held, kept = (bool(np.any(_ends(each))) for each in (task, made))
    return None if held and not kept else made


_with_links = jax.jit(Discretisation.with_links)
