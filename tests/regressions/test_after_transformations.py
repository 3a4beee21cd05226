"""A host call after a transformation of a problem with the same sets and grid.

JAX 0.10 keeps a converted copy of a NumPy array. A trace in 32 bits that took such an array of a set or a grid left a
program that the next solve in 64 bits could not run.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

KINDS = {
    "discounted": lambda a, unit: hjb.Problem(lambda x, u: a * u, lambda x, u: x @ x, unit, discount=1.0),
    "stopping": lambda a, unit: hjb.Problem(
        lambda x, u: a * u, lambda x, u: x @ x, unit, discount=1.0, stopping_cost=lambda x: 0.4 + 0.2 * x[0] ** 2
    ),
    "target": lambda a, unit: hjb.Problem(
        lambda x, u: a * u, lambda x, u: 1.0 + x @ x, unit, discount=1.0, target=lambda x: jnp.abs(x[0]) - 0.2,
        exit_cost=lambda x: 0.1 * x[0],
    ),
    "noise and jumps": lambda a, unit: hjb.Problem(
        lambda x, u: a * u, lambda x, u: x @ x, unit, discount=1.0, noise=0.3,
        jumps=[hjb.Jump(0.5, lambda x, u: -0.5 * x)],
    ),
    "modes": lambda a, unit: hjb.Problem(
        lambda x, u, mode: a * u, lambda x, u, mode: x @ x + mode, unit, discount=1.0,
        modes=hjb.Modes(("low", "high"), rates=[[0, 1.0], [1.0, 0]], switching_cost=[[0, 0.5], [0.5, 0]]),
    ),
    "game": lambda a, unit: hjb.Problem(
        lambda x, u, d: a * u + 0.5 * d, lambda x, u, d: x @ x, unit, disturbances=unit, discount=1.0
    ),
    "push": lambda a, unit: hjb.Problem(
        lambda x, u: a * u, lambda x, u: x @ x, unit, discount=1.0, pushes=[hjb.Push([1.0], 0.7)]
    ),
}  # fmt: skip
DOORS = {
    "solve": lambda problem, grid: hjb.solve(problem, grid).value,
    "march": lambda problem, grid: hjb.march(problem, grid, 0.5, step=0.01).value[0],
    "path": lambda problem, grid: hjb.simulate(problem, lambda x: -x, [0.5], 1.0).states,
}
WAYS = {
    "jit": lambda total: jax.jit(total)(1.0),
    "vmap": lambda total: jax.vmap(total)(jnp.array([0.9, 1.0])),
    "grad": lambda total: jax.grad(total)(1.0),
}
QUICK = [("march", "stopping", "grad"), ("solve", "discounted", "vmap")]
CASES = [
    pytest.param(door, kind, way, marks=[] if (door, kind, way) in QUICK else pytest.mark.slow)
    for door in DOORS
    for kind in KINDS
    for way in WAYS
    if (door, kind) not in [("path", each) for each in ("stopping", "noise and jumps", "modes", "game", "push")]
]


@pytest.mark.filterwarnings("ignore::hjbjax.solution.status.SolveWarning")
@pytest.mark.parametrize(("door", "kind", "way"), CASES)
def test_a_host_call_runs_after_it(door, kind, way):
    jax.clear_caches()  # a program of an earlier test would run
    unit, line = hjb.Box([-1.0], [1.0]), hjb.Grid([-1.0], [1.0], (21,))
    assert np.all(np.isfinite(WAYS[way](lambda a: DOORS[door](KINDS[kind](a, unit), line).sum())))
    for other in ("solve", "march"):
        found = DOORS[other](KINDS[kind](1.0, unit), line)
        fresh = DOORS[other](KINDS[kind](1.0, hjb.Box([-1.0], [1.0])), hjb.Grid([-1.0], [1.0], (21,)))
        np.testing.assert_array_equal(found, fresh)
