"""What a solve needs before it starts, in Python integers, and what there is."""

import math
import os
from typing import Any

import jax
import numpy as np

from hjbjax.grid import Grid
from hjbjax.iteration import Method, Nested, PolicyIteration
from hjbjax.problem import Problem
from hjbjax.relaxation import Krylov, Sweeps

INDEXABLE = 2**31  # nodes that 32-bit indices can number


def estimate(problem: Problem, grid: Grid, method: Method, dtype: Any) -> int:
    """Bytes that a solve keeps at its peak, from a count of the arrays that live at once.

    Value, residual, policy and what the certificate needs; for policy iteration the 2n weights and the source in
    double and, sheared, in single precision; eight vectors for a Krylov method.
    """
    if isinstance(method, Nested):
        return estimate(problem, grid, method.inner, dtype)
    word, n = np.dtype(dtype).itemsize, grid.ndim
    actions = sum(choices.dim for choices in (problem.controls, problem.disturbances) if choices is not None)
    per_node = word * (6 + 2 * actions) + 2
    if isinstance(method, PolicyIteration):
        jumps = 2 * n if np.ndim(problem.noise) < 2 and not callable(problem.noise) else 2 * n * n
        per_node += word * (jumps + 2)
        per_node += 4 * 2 * (jumps + 4) if isinstance(method.evaluation, Sweeps) else 2 * word * (jumps + 4)
        per_node += 8 * word * isinstance(method.evaluation, Krylov)
    return per_node * grid.size


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
