"""What a solve needs before it starts, in Python integers, and what there is."""

import math
import os
from typing import Any

import jax
import numpy as np

from hjbjax.grid import Grid
from hjbjax.iteration import Method, Nested, PolicyIteration
from hjbjax.problem import Problem, may_be_positive
from hjbjax.relaxation import Krylov, Sweeps

INDEXABLE = 2**31  # nodes that 32-bit indices can number


def estimate(problem: Problem, grid: Grid, method: Method, dtype: Any) -> int:
    """Bytes that a solve keeps at its peak, from a count of the arrays that live at once.

    The state is the value, the rate that is left and the policy. A look at it makes the next one beside it; sweeps
    need the weights (one an axis without noise, two with it) and the source twice, as they are and sheared, in single
    precision; a Krylov method its vectors.
    """
    if isinstance(method, Nested):
        return estimate(problem, grid, method.inner, dtype)
    word, n = np.dtype(dtype).itemsize, grid.ndim
    actions = sum(choices.dim for choices in (problem.controls, problem.disturbances) if choices is not None)
    conditions = (problem.exit_cost, problem.stopping_cost, problem.running_max, problem.disturbances)
    kept = (
        word * (2 + actions + sum(each is not None for each in conditions) + (not may_be_positive(problem.discount)))
        + 2
    )
    look, correction = word * (5 + actions), 0
    if isinstance(method, PolicyIteration):
        jumps = 2 * n * n if np.ndim(problem.noise) == 2 or callable(problem.noise) else 2 * n
        if isinstance(method.evaluation, Sweeps):
            weights = n if problem.noise is None else jumps
            correction = 4 * (2 * weights + 2) + 2 * word
        else:
            correction = word * (2 * jumps + 4 + 8 * isinstance(method.evaluation, Krylov))
    else:
        look += word  # the pace
    return (kept + max(look, correction)) * grid.size


def available() -> int | None:
    """Free bytes on the device that JAX computes on, or None where nobody says."""
    device = jax.devices()[0]
    stats = device.memory_stats() if device.platform != "cpu" else None
    if stats and "bytes_limit" in stats:
        return int(stats["bytes_limit"]) - int(stats.get("bytes_in_use", 0))
    try:
        with open("/proc/meminfo") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return None


def require(problem: Problem, grid: Grid, method: Method, dtype: Any, limit: int | None) -> int:
    """The estimate, if it fits.

    Raises:
      MemoryError: with the estimate, what is free, and the largest N that fits.
    """
    return fitting(estimate(problem, grid, method, dtype), grid, limit)


def fitting(needed: int, grid: Grid, limit: int | None) -> int:
    """``needed`` bytes, if they fit into what is free, or into ``limit``; refusals as for ``require``."""
    free = available() if limit is None else limit
    if grid.size >= INDEXABLE:
        largest = math.floor((INDEXABLE - 1) ** (1 / grid.ndim))
        raise MemoryError(
            f"{_product(grid)} = {grid.size:,} nodes; 32-bit indices number fewer than {INDEXABLE:,}.\n"
            f"At most N = {largest} points an axis in {grid.ndim}-D."
        )
    if free is not None and needed > free:
        largest = math.floor((free / needed * grid.size) ** (1 / grid.ndim))
        raise MemoryError(
            f"{_product(grid)} = {grid.size:,} nodes need about {needed / 1e9:.3g} GB, {free / 1e9:.3g} GB are free.\n"
            f"About N = {largest} points an axis would fit in {grid.ndim}-D; "
            "max_memory= (bytes) overrides what counts as free."
        )
    return needed


def _product(grid: Grid) -> str:
    return " x ".join(map(str, grid.shape))
