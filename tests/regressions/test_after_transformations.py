"""A host call after a transformation of a problem with the same sets and grid.

JAX 0.10 keeps a converted copy of a NumPy array. A trace in 32 bits that took such an array of a set or a grid left a
program that the next solve in 64 bits could not run.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import filtering

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


# --- other functions, with numbers that a problem reads from an array ---


def shared():
    """Sets, grids and arrays, which several calls use."""
    numbers = {"a": np.array([[-0.7]]), "noise": np.array([[0.3]]), "rates": np.array([[-1.0, 1.0], [0.5, -0.5]])}
    grids = {"line": hjb.Grid([-1.0], [1.0], (21,)), "unit": hjb.Box([-1.0], [1.0]), "ball": hjb.Ball(0.5, 1)}
    return numbers | grids | {"dy": np.linspace(0.01, 0.05, 3)[:, None]}


def plant(s, a, **others):
    return hjb.Problem(lambda x, u: a * (s["a"] @ x) + u, lambda x, u: x @ x + u @ u, s["unit"], **others)


def leaving(s, a):
    return hjb.Problem(lambda x, u: a * (s["a"] @ x), None, noise=0.5)


def tube(s, a):
    return hjb.avoid(lambda x, u, d: a * u + d, s["unit"], lambda x: jnp.abs(x[0]) - 0.3, disturbances=s["ball"])


def game(s, a):
    lag = hjb.Problem(lambda x, u: a * (s["a"] @ x) + u, lambda x, u: 0.5 * (x @ x + u @ u), s["unit"])
    return lambda gamma: hjb.attenuation(lag, gamma, s["ball"])


def law(x):
    return jnp.exp(-4 * x @ x)


def after_updates(observer, s):
    state = observer.initial()
    for row in s["dy"]:
        state = observer.update(state, np.zeros(1), row, 0.05)
    return state


def believed(s, a):
    made = filtering.belief_problem(
        lambda u: s["rates"] * (1.5 + a * u[0]), [0.0, 1.0], lambda u: np.array([0.0, 1.0]) + 0.1 * u @ u,
        controls=s["unit"], discount=1.0, nodes=9,
    )  # fmt: skip
    return hjb.solve(made.problem, made.grid).value


def tube_enclosed(s, a):
    marched = hjb.march(tube(s, a), s["line"], 0.5, times=np.linspace(0, 0.5, 6))
    found = hjb.enclose_tube(tube(s, a), marched)
    return found.inner, found.outer


def enclosed(s, a):
    problem = plant(s, a, discount=1.0)
    found = hjb.enclose(problem, hjb.solve(problem, s["line"]))
    return found.lower, found.upper


OTHERS = {
    "solve": lambda s, a: hjb.solve(plant(s, a, discount=1.0, noise=s["noise"]), s["line"]).value,
    "zakai": lambda s, a: (
        filtering.zakai(
            plant(s, a, noise=s["noise"]), lambda x: x, s["line"], s["dy"], 0.05, law, controls=np.zeros((3, 1))
        ).density
    ),
    "grid filter": lambda s, a: after_updates(
        filtering.GridFilter(plant(s, a, noise=s["noise"]), lambda x: x, s["line"], law), s
    ),
    "robust filter": lambda s, a: (
        filtering.robust_filter(
            plant(s, a),
            lambda x: x,
            s["line"],
            s["dy"],
            0.05,
            lambda x: -4 * x @ x,
            gamma=3.0,
            controls=np.zeros((3, 1)),
        ).value
    ),
    "Kalman filter": lambda s, a: after_updates(
        filtering.ExtendedKalman(plant(s, a, noise=s["noise"]), lambda x: x, [0.1], [[0.2]]), s
    ),
    "Wonham filter": lambda s, a: after_updates(
        filtering.WonhamFilter(lambda u: a * s["rates"], [0.0, 1.0], [0.4, 0.6]), s
    ),
    "belief": believed,
    "reach probability": lambda s, a: (
        hjb.reach_probability(
            leaving(s, a), s["line"], lambda x: jnp.abs(x[0] - 0.5) - 0.2, horizon=0.2, step=0.01
        ).value
    ),
    "exit time": lambda s, a: hjb.expected_exit_time(leaving(s, a), s["line"], lambda x: 0.8 - jnp.abs(x[0])).value,
    "tube": lambda s, a: hjb.solve(tube(s, a), s["line"]).value,
}
ON_HOST = {
    "batch": lambda s, a: [each.value for each in hjb.solve_batch([plant(s, a, discount=1.0)] * 2, s["line"])],
    "pontryagin": lambda s, a: hjb.pontryagin(plant(s, a), [0.2], horizon=0.5).cost,
    "level": lambda s, a: hjb.hinf_level(game(s, a), s["line"], 0.2, 3.0, tol=0.5, horizon=8.0).gamma,
    "enclose": enclosed,
    "tube enclosed": tube_enclosed,
    "design": lambda s, a: (
        hjb.design(
            lambda q: plant(s, a * q, discount=1.0),
            s["line"],
            lambda found, q: found.value_at([0.3]) + q**2,
            0.8,
            steps=2,
        ).parameters
    ),
}
FUNCTIONS = OTHERS | ON_HOST


def total(tree):
    return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(tree))


def test_a_filter_reads_an_array_in_32_bits_after_checks_in_64():
    """It ended with E0102: the checks of the plant kept the array in 64 bits."""
    held = shared()
    problem = hjb.Problem(lambda x, u: held["a"] @ x, noise=0.3)
    observer = filtering.ExtendedKalman(problem, lambda x: x, [0.1], [[0.2]])
    drift = observer.plant.drift(jnp.ones(1), jnp.zeros(0))
    assert drift.dtype == jnp.float32
    np.testing.assert_allclose(drift, [-0.7], rtol=1e-7)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.solution.status.SolveWarning")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_another_call_runs_after_it(name):
    """The function itself runs in ``jit`` before, or ``solve`` if it runs on the host only."""
    first = OTHERS.get(name, OTHERS["solve"])
    for wide in (False, True):
        jax.clear_caches()
        objects = shared()  # JAX 0.10 itself fails if the caller traces one array in both precisions
        with jax.enable_x64(wide):
            assert np.isfinite(jax.jit(lambda a, objects=objects: total(first(objects, a)))(1.0))
        found, fresh = (jax.tree.leaves(FUNCTIONS[name](s, 1.0)) for s in (objects, shared()))
        for one, other in zip(found, fresh, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.solution.status.SolveWarning")
@pytest.mark.parametrize("name", OTHERS)
def test_jit_has_the_numbers_of_the_host(name):
    with jax.enable_x64(True):
        inside = jax.jit(lambda a: OTHERS[name](shared(), a))(1.0)
        outside = OTHERS[name](shared(), 1.0)
    for one, other in zip(jax.tree.leaves(inside), jax.tree.leaves(outside), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


TRACED = {
    "solve_batch": ON_HOST["batch"],
    "pontryagin": ON_HOST["pontryagin"],
    "hinf_level": ON_HOST["level"],
    "enclose": lambda s, a: hjb.enclose(plant(s, a, discount=1.0), hjb.Solution(s["line"], np.zeros(21), None)),
    "design": ON_HOST["design"],
    "fit": lambda s, a: hjb.fit(lambda q: (q - a) ** 2, 0.8),
    "lyapunov_check": lambda s, a: hjb.lyapunov_check(lambda x: x @ x, lambda x: -a * x, s["unit"]),
}


@pytest.mark.parametrize("name", TRACED)
def test_functions_of_the_host_refuse_traced_closures(name):
    objects = shared()
    with pytest.raises(ValueError, match=f"^{name}: got traced numbers, but it runs on the host"):
        jax.jit(lambda a: TRACED[name](objects, a))(1.0)
