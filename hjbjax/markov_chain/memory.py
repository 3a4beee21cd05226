"""What a solve needs before it starts, in Python integers, and what there is.

What is free is the least of what the machine, the limits of the process (``ulimit -v``) and its control groups (as of a
container) leave: the machine alone would say 60 GB where a container is killed at 4.
"""

import contextlib
import itertools
import math
import os
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.hamiltonian.players import find_players, shared
from hjbjax.iteration.evaluation import Krylov
from hjbjax.iteration.methods import Method, PolicyIteration
from hjbjax.iteration.time_methods import TimeMethod
from hjbjax.problem import arguments
from hjbjax.problem.arguments import NO_GRID
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_constrained, is_discounted
from hjbjax.problem.types import DType


def estimate(problem: Problem, grid: Grid, method: Method, dtype: DType) -> int:
    """Bytes that a solve keeps at its peak, from a count of the arrays that live at once.

    The state is the value, the rate that is left and the policy. A look at it makes the next one beside it; sweeps
    need the weights (one an axis without noise, two with it) and the source twice, as they are and sheared, in single
    precision; a Krylov method its vectors.
    """
    word, n, actions = np.dtype(dtype).itemsize, grid.ndim, _actions(problem)
    searched = _searched(problem, n, dtype)
    if method.relaxes and not method.policy:
        # where V began, V, the step, and V as a chunk begins; and on few axes the neighbours along the last one
        return word * (4 + (n <= stencil.LONGER) + searched) * grid.size
    conditions = (problem.target, problem.stopping_cost, problem.running_max, problem.disturbances)
    # V and its defect, the actions, what is given at the nodes or bounds V there, the least cost where that certifies;
    # and two masks of a byte: the nodes that are held, and those that count
    kept = word * (2 + actions + sum(each is not None for each in conditions) + (is_discounted(problem) is False)) + 2
    look, correction = word * (4 + 2 * actions), 0
    if method.evaluation is not None and not method.relaxes:
        # 2n jumps along the axes and four diagonal ones for each pair of axes
        weights = 2 * n * n if np.ndim(problem.noise) == 2 or callable(problem.noise) else 2 * n
        if problem.noise is None and method.evaluation.rough:
            weights = n  # one way an axis, since sweeps may keep the two as one
        correction = method.evaluation.bytes_per_node(weights, word)
    elif is_discounted(problem) and not searched:
        # the defect is all that a step asks for; at the end the actions, and the pace
        look = word * (actions + 1 + (problem.noise is not None or is_constrained(problem)))
    else:
        look = word * (4 * max(actions, 1) + 1)  # and the pace
        if problem.stopping_cost is not None and not problem.is_game and is_discounted(problem) is False:
            # a policy that stops is kept where another one is no better, which looks at every rate
            look = max(look, math.ceil(word * (2.5 * n + actions)))
    return (kept + max(look + word * searched, correction)) * grid.size


def of_march(on: Discretisation, kept: int, method: TimeMethod, *, policy: bool) -> int:
    """Bytes that a march keeps at its peak: ``kept`` slices, and what its steps or the policy of one slice take.

    By XLA's own accounts of one to six axes: V before and after a chunk, and of a scheme of high order each axis'
    neighbours; where that limits slopes on unequal spacings, or beside a target between nodes, six arrays an axis.
    """
    problem, grid, scheme, word, n = on.problem, on.grid, on.scheme, on.dtype.itemsize, on.grid.ndim
    actions = _actions(problem) if policy else 0
    one = word * (1 + actions)  # slice, whose memory is taken when it is filled
    if not method.limited:
        inner = PolicyIteration(method.evaluation or Krylov())
        return kept * one * grid.size + estimate(problem, grid, inner, on.dtype)
    plain = scheme.even or (not any(grid.stretch) and not (scheme.subcell and problem.target is not None))
    if scheme.monotone:
        slopes = float(n <= stencil.LONGER)
    elif plain:
        slopes = sum(1 + max(scheme.points - 1, 2) / count for count in grid.shape)
    else:
        slopes = 6.0 * n
    given = sum(each is not None for each in (problem.exit_cost, problem.stopping_cost, problem.running_max))
    stored = word * given + 1 if policy else 0
    steps = word * (3 + slopes + _searched(problem, n, on.dtype))
    filling = one + word  # and V itself
    if policy:
        wide = 1 if scheme.monotone and n > stencil.LONGER else 2 if scheme.monotone or plain else 6
        filling += word * (actions + wide) + 2
    return math.ceil(((kept - 1) * one + stored + max(steps, filling)) * grid.size)


def _actions(problem: Problem) -> int:
    """The inputs of both players together."""
    return sum(each.dim for each in (problem.controls, problem.disturbances) if each is not None)


def _searched(problem: Problem, n: int, dtype: DType) -> int:
    """Words per node of an optimum that is not a formula: of a search between samples, or of quadratic programs.

    A search keeps the best action so far, the one that is tried, and both players' actions. A program has m + m²
    numbers and m + 3 for every kink; it is solved in parts of the grid.
    """
    players = find_players(problem, n, dtype)
    alone = [each for each in players.both if not (each.exact or each.enumerated)]
    if problem.is_game and not players.decoupled:
        return 10 + 2 * _actions(problem)
    words = [5 + 2 * each.admissible.dim for each in alone if each.admissible is not None]
    for player in players.both:
        for group in itertools.compress(player.groups, player.programs if player.programmed else ()):
            m, kinks = len(group), (1 if problem.noise is None else 2) * len(shared(player.driven, group))
            words.append(2 * (m + m * m + kinks * (m + 3)) + m)
    return max(words, default=0)


def available() -> int | None:
    """Free bytes on the device that JAX computes on, or None where nobody says."""
    device = jax.devices()[0]
    # on a CPU the operating system is asked, below
    stats = device.memory_stats() if device.platform != "cpu" else None
    if stats and "bytes_limit" in stats:
        return int(stats["bytes_limit"]) - int(stats.get("bytes_in_use", 0))
    known = [free for free in (_of_machine(), _of_process(), _of_groups()) if free is not None]
    return max(min(known), 0) if known else None


def _of_machine() -> int | None:
    """Bytes that the machine has free, with caches that it would give up."""
    try:
        with open("/proc/meminfo") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):  # not MemFree, from which the caches of files are missing
                    return int(line.split()[1]) * 1024
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")  # a system without that line
    except (OSError, ValueError, AttributeError):
        return None


def _of_process() -> int | None:
    """Bytes that the limit on the address space of this process leaves; None without one."""
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return None
        # the first number is of addresses, which the limit is on, and not of pages in use
        used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, OSError, ValueError, AttributeError):  # Windows; a system without /proc
        return None
    return limit - used


def _of_groups(process: Path = Path("/proc/self"), mount: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Bytes that the control groups of this process leave, of both versions; None where none is limited."""
    left = []
    for folder in _groups(process, mount):
        # version 2, version 1
        for most, used in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")):
            with contextlib.suppress(OSError, ValueError):  # "max" is no number, and no limit
                limit = int((folder / most).read_text())
                left.append(limit - int((folder / used).read_text()) + _reclaimable(folder))
    return min(left) if left else None


def _groups(process: Path, mount: Path) -> Iterator[Path]:
    """The folders of the memory groups of a process and of all above it; in a container the mount is its own group."""
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
        # a group is bound by the limits of all that hold it
        while folder != top:
            yield folder
            folder = folder.parent
        yield top


def _reclaimable(folder: Path) -> int:
    """Bytes of a group that are files it has read, which it would give up."""
    with contextlib.suppress(OSError, ValueError):
        stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        return int(stat.get("inactive_file", 0))
    return 0


def require(problem: Problem, grid: Grid, method: Method, dtype: DType, limit: int | None) -> int:
    """Bytes that a solve needs, by the estimate, if they fit.

    Raises:
      MemoryError: with the estimate, what is free, and the largest N that fits.
    """
    return fitting(estimate(problem, grid, method, dtype), grid, limit)


def fitting(needed: int, grid: Grid, limit: int | None) -> int:
    """``needed`` bytes, if they fit into what is free, or into ``limit``; refusals as for ``require``.

    Raises:
      ValueError: a limit that is no number of bytes.
    """
    if limit is not None:
        arguments.positive(limit, "max_memory", "in bytes")
    free = available() if limit is None else int(limit)
    grid.check_indices()
    # in proportion to the nodes: the largest grid that would fit has free/needed times as many
    if free is not None and needed > free:
        raise MemoryError(
            f"{counts(grid)} = {grid.size:,} nodes need about {needed / 1e9:.3g} GB, {free / 1e9:.3g} GB are free.\n"
            f"{_largest(free / needed * grid.size, grid.ndim)}; max_memory= (bytes) overrides what counts as free.\n"
            f"dtype='float32' takes about half; {NO_GRID}."
        )
    return needed


def _largest(nodes: float, n: int) -> str:
    """A sentence on the points an axis of the largest grid of n axes with so many nodes."""
    largest = math.floor(nodes ** (1 / n))
    if largest < 2:
        return f"Not even two points an axis would fit in {n}-D"
    return f"About N = {largest} points an axis would fit in {n}-D"


def counts(grid: Grid) -> str:
    """The points of all axes, as in "41 x 81"."""
    return " x ".join(map(str, grid.shape))
