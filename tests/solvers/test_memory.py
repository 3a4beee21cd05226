"""The estimate before a solve, what is free, and the largest grid that fits."""

import functools
import os
import re
import subprocess
import sys
import tracemalloc
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.posing import for_solvers
from hjbjax.iteration import fixed_point
from hjbjax.problem.arguments import INDEXABLE
from hjbjax.problem.mode_axis import with_modes
from hjbjax.problem.pytree import cast
from hjbjax.solvers import memory, stationary_run
from hjbjax.solvers.setup import assumptions_of, prepare

METHODS = [
    hjb.ValueIteration(),
    hjb.PolicyIteration(hjb.Sweeps()),
    hjb.PolicyIteration(hjb.Krylov()),
]


def drift(x, u):
    return jnp.stack([x[1], u[0]])


def cost(x, u):
    return x @ x + u @ u


PROBLEM = hjb.Problem(drift, cost, hjb.Box([-1.0], [1.0]), noise=0.3, discount=1.0)


def square(n):
    return hjb.Grid([-1.0, -1.0], [1.0, 1.0], (n, n))


@pytest.mark.parametrize("method", METHODS)
def test_the_estimate_is_proportional_to_nodes_and_word(method):
    one = memory.peak_bytes(PROBLEM, square(10), method, np.float64)
    assert isinstance(one, int)
    assert memory.peak_bytes(PROBLEM, square(20), method, np.float64) == 4 * one
    assert one / 2 <= memory.peak_bytes(PROBLEM, square(10), method, np.float32) < one
    assert memory.peak_bytes(PROBLEM, square(100_000_000), method, np.float64) == 10**14 * one  # Python integers


def told_over_needed(problem, grid, method):
    """The estimate over XLA's own account of the program that a solve runs, and the initial value on the host."""
    with jax.enable_x64(True):
        problem, grid = cast((problem, grid), np.float64)
        on = Discretisation(problem, grid, hjb.Upwind(), np.float64)
        options = {"method": method, "tol": 1e-3, "assumptions": assumptions_of(on)}
        task = jax.eval_shape(lambda on: prepare(on, **options), on)
        state = jax.eval_shape(fixed_point.start, task, jax.ShapeDtypeStruct(grid.shape, np.float64))
        found = stationary_run.run.lower(task, state, 1).compile().memory_analysis()
    together = found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes
    needed = together - found.alias_size_in_bytes + (8 * grid.size if task.method.policy else 0)
    return memory.peak_bytes(problem, grid, method, np.float64) / needed


@pytest.mark.parametrize(
    "method", [*(pytest.param(method, marks=pytest.mark.slow) for method in METHODS[:2]), METHODS[2]]
)
@pytest.mark.parametrize("noise", [pytest.param(None, marks=pytest.mark.slow), 0.3])
@pytest.mark.parametrize("n", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_the_estimate_is_what_the_compiled_loop_needs(n, noise, method):
    problem = hjb.Problem(
        lambda x, u: jnp.concatenate([x[1:], u]), cost, hjb.Box([-1.0], [1.0]), noise=noise, discount=1.0
    )
    grid = hjb.Grid([-1.0] * n, [1.0] * n, ({2: 121, 3: 41}[n],) * n)
    assert 0.95 <= told_over_needed(problem, grid, method) <= 1.4


def sudden(n, *, noise):
    """Three modes between which the system and the controller change, a push in every direction, and a jump."""
    pushes = [hjb.Push(sign * direction, 1.0) for direction in np.eye(n) for sign in (1, -1)]
    table = 1 - np.eye(3)
    return hjb.Problem(
        lambda x, u, mode: (1 + 0.1 * mode) * jnp.concatenate([x[1:], u]), lambda x, u, mode: cost(x, u),
        hjb.Box([-1.0], [1.0]), noise=noise, discount=1.0, modes=hjb.Modes(("a", "b", "c"), table, table),
        pushes=pushes, jumps=[hjb.Jump(1.0, lambda x, u, mode: x / 2)],
    )  # fmt: skip


@pytest.mark.emitters  # the old ones store more arrays than the program that users run
@pytest.mark.parametrize("method", [*METHODS, hjb.ValueIteration(policy=False)])
@pytest.mark.parametrize("n", [1, 2])
def test_modes_jumps_and_pushes_are_counted(n, method):
    grid = hjb.Grid([-1.0] * n, [1.0] * n, ({1: 4001, 2: 61}[n],) * n)
    problem, grid = for_solvers(sudden(n, noise=0.3), n), with_modes(grid, ("a", "b", "c"))
    assert 0.85 <= told_over_needed(problem, grid, method) <= 1.4


def test_the_largest_grid_with_modes_is_named_per_axis_of_the_state():
    problem = sudden(2, noise=0.3)
    free = hjb.estimate(problem, square(201), measure=False)
    assert free.shape == (3, 201, 201)
    with pytest.raises(MemoryError, match=r"in 2-D") as caught:
        hjb.solve(problem, square(20_001), max_memory=10**9)
    largest = int(re.search(r"N = (\d+)", str(caught.value))[1])
    for count, fits in ((largest, True), (largest + 1, False)):
        bytes_needed = hjb.estimate(problem, square(count), measure=False).bytes
        assert (bytes_needed <= 10**9) == fits


@pytest.mark.parametrize("method", [METHODS[0], pytest.param(METHODS[1], marks=pytest.mark.slow)])
def test_a_search_between_samples_is_counted(method):
    problem = hjb.Problem(lambda x, u: jnp.stack([x[1], jnp.sin(3 * u[0])]), cost, hjb.Box([-1.0], [1.0]), discount=1.0)
    assert 0.95 <= told_over_needed(problem, square(121), method) <= 1.4


COUPLED = {
    "both by a formula": hjb.Problem(
        lambda x, u, d: drift(x, u + d), cost_of_both := lambda x, u, d: cost(x, u) - d @ d, hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.0], [1.0]), discount=1.0,
    ),
    "one by a search": hjb.Problem(
        lambda x, u, d: drift(x, jnp.sin(3 * u)) + d, cost_of_both, hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.0] * 2, [1.0] * 2), discount=1.0,
    ),
    "both by a search": hjb.Problem(
        lambda x, u, d: drift(x, u * jnp.cos(d[0])) + d * u[0], cost_of_both, hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.0] * 2, [1.0] * 2), discount=1.0,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", COUPLED)
def test_players_who_share_a_component_are_counted(name, method):
    assert 0.75 <= told_over_needed(COUPLED[name], square(121), method) <= 1.4


def test_policies_and_evaluations_take_memory():
    value, sweeps, krylov = (memory.peak_bytes(PROBLEM, square(10), method, np.float64) for method in METHODS)
    assert max(value, sweeps) < krylov
    game = hjb.Problem(
        lambda x, u, d: drift(x, u) + d,
        lambda x, u, d: cost(x, u) - d @ d,
        hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.0, -1.0], [1.0, 1.0]),
        discount=1.0,
    )
    assert memory.peak_bytes(game, square(10), METHODS[0], np.float64) > value


@pytest.mark.parametrize("method", METHODS)
def test_the_largest_grid_that_is_named_fits_and_the_next_does_not(method):
    limit = 10**9
    with pytest.raises(MemoryError, match=r"max_memory") as caught:
        memory.require(PROBLEM, square(20_000), method, np.float64, limit)
    largest = int(re.search(r"N = (\d+)", str(caught.value))[1])
    assert memory.require(PROBLEM, square(largest), method, np.float64, limit) <= limit
    with pytest.raises(MemoryError):
        memory.require(PROBLEM, square(largest + 1), method, np.float64, limit)


@pytest.mark.parametrize("ndim", [1, 2, 3, 5])
def test_the_largest_indexable_grid_that_is_named_is_indexable(ndim):
    lo, hi = [-1.0] * ndim, [1.0] * ndim
    with pytest.raises(MemoryError, match="32-bit") as caught:
        memory.require(PROBLEM, hjb.Grid(lo, hi, (2**31,) * ndim), METHODS[0], np.float64, 10**30)
    largest = int(re.search(r"N = (\d+)", str(caught.value))[1])
    assert largest**ndim < INDEXABLE <= (largest + 1) ** ndim
    memory.require(PROBLEM, hjb.Grid(lo, hi, (largest,) * ndim), METHODS[0], np.float64, 10**30)


def test_what_is_free_is_known_here():
    free = memory.available()
    assert isinstance(free, int)
    assert free > 10**6


def group(folder, **numbers):
    folder.mkdir(parents=True, exist_ok=True)
    for name, number in numbers.items():
        (folder / f"memory.{name}").write_text(f"{number}\n")


V1 = ("limit_in_bytes", "usage_in_bytes")


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("limited", ["own", "above", "mount", "none"])
def test_what_control_groups_leave(tmp_path, version, limited):
    """The least of the groups from the process's own up to the mount; read files are given up."""
    process, mount = tmp_path / "proc", tmp_path / "cgroup"
    process.mkdir()
    lines = {1: "9:cpu,cpuacct:/job\n4:memory:/job/step\n0::/\n", 2: "0::/job/step\n"}
    (process / "cgroup").write_text(lines[version])
    top = mount / "memory" if version == 1 else mount
    most, used = V1 if version == 1 else ("max", "current")
    unlimited = 2**63 - 4096 if version == 1 else "max"
    folders = {"mount": top, "above": top / "job", "own": top / "job" / "step"}
    for name, folder in folders.items():
        group(folder, **{most: 4 * 10**9 if name == limited else unlimited, used: 10**9})
        (folder / "memory.stat").write_text("anon 5\ninactive_file 250000000\n")
    left = memory._of_groups(process, mount)
    if limited == "none":
        assert left is None or left > 2**62
    else:
        assert left == 3 * 10**9 + 250_000_000


def test_groups_that_cannot_be_read(tmp_path):
    assert memory._of_groups(tmp_path / "no", tmp_path) is None
    (tmp_path / "cgroup").write_text("nonsense\n0::/gone/with/it\n")
    group(tmp_path, max=10**6)  # without what is used
    assert memory._of_groups(tmp_path, tmp_path) is None


def test_the_least_of_all_counts(monkeypatch):
    for machine, process, groups, least in ((9, 5, 7, 5), (9, None, 7, 7), (9, None, None, 9), (9, -1, None, 0)):
        for name, free in (("machine", machine), ("process", process), ("groups", groups)):
            monkeypatch.setattr(memory, f"_of_{name}", lambda free=free: free)
        assert memory.available() == least
    monkeypatch.setattr(memory, "_of_machine", lambda: None)
    monkeypatch.setattr(memory, "_of_process", lambda: None)
    assert memory.available() is None


def test_a_mesh_of_accelerators_has_the_memory_of_all_of_them():
    def card(free):
        return SimpleNamespace(
            platform="gpu", memory_stats=lambda: {"bytes_limit": 80 * 10**9, "bytes_in_use": 80 * 10**9 - free}
        )

    mesh = SimpleNamespace(local_devices=[card(70 * 10**9), card(60 * 10**9)], size=8)  # six of them in other processes
    assert memory.available(mesh) == 8 * 60 * 10**9
    needed, grid = 100 * 10**9, square(20_000)
    assert memory.fitting(needed, grid, None, mesh) == needed
    mesh.size = 1
    with pytest.raises(MemoryError, match="60 GB are free"):
        memory.fitting(needed, grid, None, mesh)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits are POSIX's")
def test_a_limit_on_the_address_space_refuses_a_grid():
    program = """
import resource
import hjbjax as hjb
from hjbjax.solvers import memory
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
memory.available()  # starts JAX
resource.setrlimit(resource.RLIMIT_AS, (used + 4 * 10**9,) * 2)
free = memory.available()
assert 0 <= free <= 4 * 10**9, free
problem = hjb.Problem(lambda x, u: u[0] - x, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
try:
    hjb.solve(problem, hjb.Grid([-1.0] * 2, [1.0] * 2, (9000, 9000)))
except MemoryError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert "81,000,000 nodes need about" in done.stdout, done.stderr


@pytest.mark.parametrize("bad", [0, -5, float("nan"), float("inf"), "lots", True, [10**9], 2**64 * 1j])
def test_limits_that_are_no_number_of_bytes(bad):
    problem = hjb.Problem(lambda x, u: u[0] - x, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    for grid in (hjb.Grid([-1.0], [1.0], (11,)), square(11)):
        for door, question in ((hjb.solve, problem), (functools.partial(hjb.march, horizon=1.0), problem)):
            with pytest.raises(ValueError, match=r"max_memory = .*; wanted a finite number > 0, in bytes"):
                door(question, grid, max_memory=bad)
        with pytest.raises(ValueError, match=r"max_memory = "):
            hjb.solve_batch([problem], grid, max_memory=bad, scheme=hjb.Upwind())


def test_hardly_any_memory():
    with pytest.raises(MemoryError, match="Not even two points per axis would fit in 2-D"):
        memory.require(PROBLEM, square(10), METHODS[0], np.float64, 7.5)


def test_six_dimensions_are_refused_with_a_way_out():
    """35^6 nodes: XLA would take 120 to 190 GB, by its account of the loop on 9^6 nodes, and the initial value 7 GB."""
    question = hjb.Problem(lambda x, u: jnp.concatenate([x[1:], u]), cost, hjb.Box([-1.0], [1.0]), discount=1.0)
    grid = hjb.Grid([-1.0] * 6, [1.0] * 6, (35,) * 6)
    with pytest.raises(MemoryError) as caught:
        hjb.solve(question, grid, max_memory=64 * 10**9, scheme=hjb.Upwind())
    message = str(caught.value)
    assert 120 <= float(re.search(r"about (\d+) GB", message)[1]) <= 197
    assert len(message.splitlines()) <= 6
    for word in ("1,838,265,625 nodes", "64 GB are free", "float32", "hjb.pontryagin", "N = ", "max_memory="):
        assert word in message


def test_nobody_says_what_is_free(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda mesh: None)
    needed = memory.peak_bytes(PROBLEM, square(30_000), METHODS[0], np.float64)
    assert memory.require(PROBLEM, square(30_000), METHODS[0], np.float64, None) == needed


@pytest.mark.parametrize(
    "method", [METHODS[0], *(pytest.param(method, marks=pytest.mark.slow) for method in METHODS[1:])]
)
def test_the_estimate_is_near_what_the_compiler_reports(method):
    """Between half and four times the peak of the compiled step."""
    import jax

    from hjbjax.iteration import fixed_point
    from hjbjax.solvers import setup

    grid = square(64)
    with jax.enable_x64(True):
        on = Discretisation(PROBLEM, grid, hjb.Upwind(), np.float64)
        task, _, _ = setup.prepare_on_host(on, method=method, tol=1e-3)
        state = jax.eval_shape(fixed_point.start, task, jnp.zeros(grid.shape))
        analysis = jax.jit(fixed_point.run).lower(task, state, 1).compile().memory_analysis()
    peak = analysis.argument_size_in_bytes + analysis.output_size_in_bytes + analysis.temp_size_in_bytes
    estimate = memory.peak_bytes(PROBLEM, grid, method, np.float64)
    assert peak / 4 <= estimate <= 4 * peak
    assert estimate >= peak / 2


@pytest.mark.slow
def test_numpy_takes_no_more_for_the_errors_of_a_march_than_is_told():
    drift, controls, ends = hjb.zoo.Dubins().drift, hjb.Box([-1.0], [1.0]), ([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi])
    tube = hjb.reach(drift, controls, lambda x: jnp.hypot(x[0], x[1]) - 0.5)
    grid = hjb.Grid(*ends, (61, 61, 62), periodic=(False, False, True))
    march = functools.partial(hjb.march, tube, grid, 0.02, policy=False, dtype="float32", progress=False, throw=False)
    march()  # compiles
    tracemalloc.start()
    try:
        solution = march()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak <= 1.1 * solution.stats["bytes"]
    assert solution.grid_error.dtype == solution.box_error.dtype == np.float32
