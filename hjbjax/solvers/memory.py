"""The memory that a solve needs before it starts, in Python integers, and the memory that is available.

The available memory is the least of the free memory of the machine, the limits of the process (``ulimit -v``) and the
limits of its control groups, such as a container. The machine may report 60 GB free when a container is killed at 4.
"""

import contextlib
import itertools
import math
import os
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.players import find_players, shared
from hjbjax.iteration.evaluation import Krylov
from hjbjax.iteration.methods import Method, PolicyIteration
from hjbjax.iteration.time_methods import TimeMethod
from hjbjax.problem import arguments
from hjbjax.problem.arguments import NO_GRID
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_constrained, is_discounted
from hjbjax.problem.types import DType
from hjbjax.tracing import checks
from hjbjax.tracing.dependence import influence

# XLA has one type for all errors, and on a CPU reports an array that cannot be allocated as INTERNAL
EXHAUSTED = ("RESOURCE_EXHAUSTED", "Out of memory allocating")


def is_exhausted(error: Exception) -> bool:
    """True if an exception reports that memory ran out: NumPy's by its type, XLA's by its text."""
    return isinstance(error, MemoryError) or any(words in str(error) for words in EXHAUSTED)


def peak_bytes(problem: Problem, grid: Grid, method: Method, dtype: DType, *, high_order: bool = False) -> int:
    """Bytes that a solve uses at its peak, from a count of the arrays that live at the same time.

    The state is the value, the remaining rate and the policy; each evaluation creates the next state while the old one
    lives. Sweeps store the weights (one per axis without noise, two with noise) and the source twice, plain and skewed,
    in single precision. A Krylov method stores its vectors. With a scheme of high order the value of the monotone
    iteration is kept until the end instead of the initial V, and its policy if this does not follow from the value.
    """
    word, n, actions = np.dtype(dtype).itemsize, len(grid.state_axes), _actions(problem)
    searched, choices = _searched(problem, grid.ndim, dtype), _choices(problem, grid)
    if method.relaxes and not method.policy:
        # the initial V, V, the step, V at the start of a chunk, and on few axes the neighbours along the last one
        stored = 4 + (grid.ndim <= stencil.LONGER) + searched + choices + _imposing(choices)
        return math.ceil(word * stored) * grid.size
    conditions = (problem.target, problem.stopping_cost, problem.running_max, problem.disturbances)
    undiscounted = is_discounted(problem) is False
    # the initial V, V, its defect, the actions, prescribed values or bounds at the nodes, the least cost if it gives
    # the certificate, and two one-byte masks: the fixed nodes and the counted nodes
    kept = word * (3 + actions + sum(each is not None for each in conditions) + undiscounted) + 2
    stopping = problem.stopping_cost is not None and not problem.is_game and undiscounted
    both = stopping or not find_players(problem, grid.ndim, dtype).exact  # the policies of both iterations
    kept += word * (choices + (1 + actions) * (high_order and both))
    look, correction = word * (4 + 2 * actions + undiscounted + high_order), 0
    if method.evaluation is not None and not method.relaxes:
        # 2n jumps along the axes and four diagonal ones for each pair of axes
        weights = 2 * n * n if np.ndim(problem.noise) == 2 or callable(problem.noise) else 2 * n
        if problem.noise is None and method.evaluation.rough:
            weights = n  # one direction per axis, since sweeps may merge both
        weights += _sudden(problem, grid, dtype, near=method.evaluation.rough)
        correction = method.evaluation.bytes_per_node(weights, word) + word * 3 * (choices > 0)
        look = max(look, word * (10 + 2 * choices) * (choices > 0))  # also the nodes of every intervention
        if problem.is_game and not method.evaluation.rough:  # the replies of the inner player, with a linear solve each
            look += correction // 2
    elif is_discounted(problem) and not searched:
        # the actions, computed at the end, and the outflow Q + β; a step computes only the defect
        look = word * (actions + 1 + (problem.noise is not None or is_constrained(problem)))
    else:
        look = word * (4 * max(actions, 1) + 1)  # one for the outflow Q + β
        if stopping:
            # on ties the old policy is kept, which requires every rate
            look = max(look, math.ceil(word * (2.5 * n + actions)))
    look = max(look, math.ceil(word * _imposing(choices)))
    return (kept + max(look + word * searched, correction)) * grid.size


def of_march(on: Discretisation, kept: int, method: TimeMethod, *, policy: bool) -> int:
    """Bytes that a march with ``kept`` slices uses at its peak, during its steps or while its errors are estimated.

    At the end every slice has two estimates of its error, and half of one is being interpolated. Before, the
    differences of one slice are computed for the first of them, on a grid with about 2^−n of the nodes.
    """
    word, n = on.dtype.itemsize, on.grid.ndim
    slices = kept * _slice(on, policy=policy)
    estimating, ending = word * (kept + 0.75 + 11 / 2**n) + 3, word * (2 * kept + 0.5) + 2
    return max(of_steps(on, kept, method, policy=policy), math.ceil((slices + max(estimating, ending)) * on.grid.size))


def of_steps(on: Discretisation, kept: int, method: TimeMethod, *, policy: bool) -> int:
    """Bytes that the steps of a march use: ``kept`` slices, plus the steps themselves or the policy of one slice.

    Fitted to XLA's reports in one to six dimensions: V before and after a chunk, and for a high-order scheme the
    neighbours along each axis; limited slopes on unequal spacings, or next to a target between nodes, take six arrays
    per axis.
    """
    problem, grid, scheme, word, n = on.problem, on.grid, on.scheme, on.dtype.itemsize, on.grid.ndim
    one = _slice(on, policy=policy)  # its memory is allocated when it is filled
    if not method.limited:
        inner = PolicyIteration(method.evaluation or Krylov())
        return kept * one * grid.size + peak_bytes(problem, grid, inner, on.dtype)
    plain = scheme.even or (not any(grid.stretch) and not (scheme.subcell and problem.target is not None))
    if scheme.monotone:
        slopes = float(n <= stencil.LONGER)
    elif plain:
        slopes = sum(1 + max(scheme.points - 1, 2) / count for count in grid.shape)
    else:
        slopes = 6.0 * n
    given = sum(each is not None for each in (problem.exit_cost, problem.stopping_cost, problem.running_max))
    stored = word * given + 1 if policy else 0
    choices = _choices(problem, grid)
    searched = float(_searched(problem, n, on.dtype))
    if problem.is_game and not on.players.decoupled:
        # with a policy the other order of the players is computed too, for the gap between both
        searched = (searched + 4 + 2 * _actions(problem)) * (1 + policy)
    steps = word * (3 + slopes + searched + choices + _imposing(choices))
    filling = one + word  # the last term is V itself
    if policy:
        wide = 1 if scheme.monotone and n > stencil.LONGER else 2 if scheme.monotone or plain else 6
        filling += word * (_actions(problem) + wide) + 2
    return math.ceil(((kept - 1) * one + stored + max(steps, filling)) * grid.size)


def _slice(on: Discretisation, *, policy: bool) -> int:
    """Bytes per node of V at one kept time, with its actions if the policy is stored."""
    return on.dtype.itemsize * (1 + policy * _actions(on.problem))


def _sudden(problem: Problem, grid: Grid, dtype: DType, *, near: bool) -> int:
    """Weights per node for sudden changes: jumps between k modes, their inverse, and the corners of landings.

    ``near``: True for an evaluation that only relaxes, which stores neither the inverse nor the landings.
    """
    count, n = len(grid.modes), len(grid.state_axes)
    if near:
        return count
    jumps = 0 if problem.landings is None else len(influence(problem, grid.ndim, dtype).landing.entries)
    return 2 * count + math.ceil(1.5 * 2**n * jumps / n)  # an index takes half of a word


def _choices(problem: Problem, grid: Grid) -> int:
    """The number of interventions: changes of the mode by choice, and pushes; the cost of each is stored."""
    return (len(grid.modes) - 1) * (problem.switching_costs is not None) + len(problem.push_steps)


def _imposing(choices: int) -> float:
    """Words per node for V after each intervention, and for the lines along which they follow each other."""
    return 3.5 + 1.5 * choices if choices else 0


def _actions(problem: Problem) -> int:
    """The number of inputs of both players together."""
    return sum(each.dim for each in (problem.controls, problem.disturbances) if each is not None)


def _searched(problem: Problem, n: int, dtype: DType) -> int:
    """Words per node of an optimum without a formula: a search between samples, or quadratic programs.

    A search stores the best action so far and the current one, and for every candidate of the outer player the inner
    player's. A program has m + m² numbers and m + 3 for every kink; it is solved on parts of the grid.
    """
    players = find_players(problem, n, dtype)
    alone = [each for each in players.both if not (each.exact or each.enumerated)]
    if problem.is_game and not players.decoupled:
        curved = all(any(player.curved) for player in players.both)  # also optima between the bounds
        return 2 + 10 * max(len(alone), curved)
    words = [5 + 2 * each.admissible.dim for each in alone if each.admissible is not None]
    for player in players.both:
        for group in itertools.compress(player.groups, player.programs if player.programmed else ()):
            m, kinks = len(group), (1 if problem.noise is None else 2) * len(shared(player.driven, group))
            words.append(2 * (m + m * m + kinks * (m + 3)) + m)
    return max(words, default=0)


def available(mesh: Mesh | None = None) -> int | None:
    """Free bytes on the device that JAX computes on, or on all devices of a mesh together; None if unknown."""
    devices = jax.devices()[:1] if mesh is None else mesh.local_devices
    # on a CPU the operating system reports the free memory, below; all devices of a CPU share it
    stats = [device.memory_stats() for device in devices if device.platform != "cpu"]
    if stats and all(each and "bytes_limit" in each for each in stats):
        least = min(int(each["bytes_limit"]) - int(each.get("bytes_in_use", 0)) for each in stats)
        return least * (1 if mesh is None else mesh.size)  # each device gets an equal share of the nodes
    known = [free for free in (_of_machine(), _of_process(), _of_groups()) if free is not None]
    return max(min(known), 0) if known else None


def _of_machine() -> int | None:
    """Free bytes of the machine, including caches that it can release."""
    try:
        with open("/proc/meminfo") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):  # not MemFree, which excludes file caches
                    return int(line.split()[1]) * 1024
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")  # for systems without that line
    except (OSError, ValueError, AttributeError):
        return None


def _of_process() -> int | None:
    """Bytes left below the limit on the address space of this process; None without a limit."""
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return None
        # the first number counts addresses, which the limit applies to, not pages in use
        used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, OSError, ValueError, AttributeError):  # Windows; a system without /proc
        return None
    return limit - used


def _of_groups(process: Path = Path("/proc/self"), mount: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Bytes left in the control groups of this process, for both versions; None if no group has a limit."""
    left = []
    for folder in _groups(process, mount):
        # version 2, version 1
        for most, used in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")):
            with contextlib.suppress(OSError, ValueError):  # "max" means no limit
                limit = int((folder / most).read_text())
                left.append(limit - int((folder / used).read_text()) + _reclaimable(folder))
    return min(left) if left else None


def _groups(process: Path, mount: Path) -> Iterator[Path]:
    """The memory groups of a process and their parents, as folders; in a container the mount is its own group."""
    try:
        lines = (process / "cgroup").read_text().splitlines()
    except OSError:
        return
    # lines are "0::/path" in version 2 and "4:memory,cpu:/path" in version 1
    for number, controllers, path in (line.split(":", 2) for line in lines if line.count(":") >= 2):
        if number != "0" and "memory" not in controllers.split(","):
            continue
        top = mount if number == "0" else mount / "memory"
        folder = top / path.strip("/")
        # a group is also bound by the limits of its parents
        while folder != top:
            yield folder
            folder = folder.parent
        yield top


def _reclaimable(folder: Path) -> int:
    """Bytes of a group that are cached files, which it can release."""
    with contextlib.suppress(OSError, ValueError):
        stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        return int(stat.get("inactive_file", 0))
    return 0


def require(
    problem: Problem,
    grid: Grid,
    method: Method,
    dtype: DType,
    limit: int | None,
    *,
    high_order: bool = False,
    mesh: Mesh | None = None,
) -> int:
    """The estimated bytes of a solve, on all devices of a mesh together, if they fit.

    Raises:
      MemoryError: the bytes do not fit; reports the estimate, the free memory, and the largest N that fits.
    """
    return fitting(peak_bytes(problem, grid, method, dtype, high_order=high_order), grid, limit, mesh)


def fitting(needed: int, grid: Grid, limit: int | None, mesh: Mesh | None = None) -> int:
    """Return ``needed`` bytes if they fit into the free memory, or into ``limit``; raises as ``require`` does.

    Raises:
      ValueError: the limit is not a number of bytes.
    """
    if limit is not None:
        arguments.positive(limit, "max_memory", "in bytes")
    free = available(mesh) if limit is None else int(limit)
    checks.check_indices(grid)
    # memory is proportional to the number of nodes
    if free is not None and needed > free:
        raise MemoryError(
            f"{as_counts(grid)} = {grid.size:,} nodes need about {needed / 1e9:.3g} GB, {free / 1e9:.3g} GB are free.\n"
            f"{_largest(free / needed * grid.size, grid)}; max_memory= (bytes) overrides what counts as free.\n"
            f"dtype='float32' takes about half; {NO_GRID}."
        )
    return needed


def points_per_axis(nodes: float, grid: Grid) -> int:
    """The points along every axis of the state, in a grid with the same axes and modes and this number of nodes."""
    # an exact root may be rounded down
    return math.floor((nodes / max(len(grid.modes), 1)) ** (1 / len(grid.state_axes)) * (1 + 1e-12))


def _largest(nodes: float, grid: Grid) -> str:
    """A sentence with the points per axis of the largest grid with the same axes and this number of nodes."""
    largest, n = points_per_axis(nodes, grid), len(grid.state_axes)
    if largest < 2:
        return f"Not even two points per axis would fit in {n}-D"
    return f"About N = {largest} points per axis would fit in {n}-D"


def as_counts(grid: Grid) -> str:
    """The points of all axes, such as "41 x 81"."""
    return " x ".join(map(str, grid.shape))
