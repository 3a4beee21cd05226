"""Where a solve starts: the answers of coarser grids, and of discounts that vanish."""

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import transfer
from hjbjax.certificates import Certificate
from hjbjax.driver import Clock, drive
from hjbjax.grid import Grid
from hjbjax.iteration import Method, Nested, Task
from hjbjax.preparation import held_jit, judge, prepare_jit
from hjbjax.problem import Problem
from hjbjax.schemes import Upwind

VANISHING = (1.0, 0.1, 0.01)  # discounts on the way to none, per unit time
WARM_STEPS = 60  # improvements for each of them


def start(
    problem: Problem, grid: Grid, method: Method, scheme: Upwind, tol: float, guess: Any, dtype: Any, clock: Clock
) -> tuple[Any, list[tuple[int, ...]]]:
    """The guess for the finest grid: the user's, or the answer of the coarser grids, and the shapes of those."""
    if guess is not None or not isinstance(method, Nested):
        return guess, []
    grids = levels(problem, grid, method, scheme, dtype)
    value = None
    for coarse, fine in itertools.pairwise(grids):
        verdict = judge(problem, coarse, dtype)
        task = prepare_jit(problem, coarse, method=method.inner, scheme=scheme, tol=tol, dtype=dtype, verdict=verdict)
        state, _, _ = drive(task, warm(task, value, clock), clock)
        value = transfer.prolong(state.value, coarse, fine)
    return value, [coarse.shape for coarse in grids[:-1]]


def levels(problem: Problem, grid: Grid, method: Nested, scheme: Upwind, dtype: Any) -> list[Grid]:
    """The grids of a nested solve, coarsest first; a coarser grid that loses the target or rest point is left out."""
    grids, verdict = [grid], judge(problem, grid, dtype)
    needs_held = problem.target is not None or verdict.may_rest
    while (smaller := transfer.coarser(grids[0])) is not None and smaller.size >= method.coarsest:
        if needs_held and not held_jit(problem, smaller, scheme=scheme, dtype=dtype, verdict=verdict).any():
            break
        grids.insert(0, smaller)
    return grids


def warm(task: Task, guess: Any, clock: Clock) -> jax.Array:
    """The guess; without one zero, or without discount what leads to the right one of many fixed points.

    A stopping cost or a running maximum is itself the start: ψ lies above all fixed points and g below. Otherwise
    the answers for a discount that vanishes lead the way: from below an undiscounted problem is full of policies
    that stay where they are at a cost; those of a small discount move to the target.
    """
    if guess is not None:
        return guess
    value = jnp.asarray(np.zeros(task.grid.shape, task.tol.dtype))  # NumPy's zeros: nothing to compile
    if np.asarray(task.problem.discount) == 0:  # constraints alone have many fixed points between g and ψ
        value = value if task.rules.stop is None else task.rules.stop
        floor = task.rules.floor
        if floor is not None:
            value = floor if task.rules.stop is None else jnp.maximum(floor, value)
    if task.certificate is not Certificate.MULTIPLICATIVE:
        return value
    for discount in VANISHING:
        problem = dataclasses.replace(task.problem, discount=jnp.asarray(discount, task.tol.dtype))
        value = drive(dataclasses.replace(task, problem=problem), value, clock, most=WARM_STEPS)[0].value
    return value
