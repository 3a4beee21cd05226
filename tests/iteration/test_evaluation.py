"""Sweeps, Krylov and direct solves of δ = s + Σ_o w_o δ(x + o) against dense linear algebra."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import LAYOUTS, ids, make_grid, random_equation
from hypothesis import given, settings
from systems import SEEDS

import hjbjax as hjb
from hjbjax.discretisation.rates import Rates
from hjbjax.iteration.bellman import PolicyEquation
from hjbjax.iteration.evaluation import Direct, Evaluation, Krylov, Sweeps, evaluate, jacobi, left_over, relaxed

pytestmark = pytest.mark.usefixtures("float64")


@functools.partial(jax.jit, static_argnames="rounds")
def sweeps(equation, grid, rounds):
    return relaxed(equation, grid, rounds)


left_over = jax.jit(left_over)


@pytest.mark.parametrize(("n", "flags"), LAYOUTS, ids=ids)
@given(seed=SEEDS)
@settings(max_examples=4)
def test_rounds_of_sweeps_converge_to_the_dense_solve(n, flags, seed):
    rng, grid = np.random.default_rng(seed), make_grid(n, flags)
    equation, dense, exact = random_equation(rng, grid)
    delta = sweeps(equation, grid, 150)  # a pass takes away a tenth, a round is two passes at least: 0.9³⁰⁰ = 2e-14
    assert np.allclose(delta, exact, rtol=0, atol=1e-11 * np.max(np.abs(exact)))
    guess = rng.normal(size=grid.size)
    left = (np.ravel(equation.source) - dense @ guess).reshape(grid.shape)
    found = left_over(equation, grid, guess.reshape(grid.shape))
    assert np.allclose(found, left, rtol=0, atol=1e-13 * np.max(np.abs(left)))


@functools.partial(jax.jit, static_argnames="method_type")
def solved(equation, grid, method_type):
    method = {"krylov": Krylov(fraction=1e-12), "direct": Direct(), "sweeps": Sweeps(3)}[method_type]
    return evaluate(method, equation, grid)


@pytest.mark.parametrize(
    ("n", "flags"),
    [
        (1, (False,)),
        (1, (True,)),
        (2, (False, True)),
        pytest.param(4, (False, True, False, True), marks=pytest.mark.slow),
    ],
)
@given(seed=SEEDS)
@settings(max_examples=4)
def test_krylov_and_direct_equal_the_dense_solve(n, flags, seed):
    rng, grid = np.random.default_rng(seed), make_grid(n, flags)
    equation, _, exact = random_equation(rng, grid, leak=0.01)
    size = np.max(np.abs(exact))
    assert np.allclose(solved(equation, grid, "direct"), exact, rtol=0, atol=1e-12 * size)
    assert np.allclose(solved(equation, grid, "krylov"), exact, rtol=0, atol=1e-9 * size)


@given(seed=SEEDS)
@settings(max_examples=4)
def test_diagonal_jumps_are_relaxed_and_solved(seed):
    rng, grid = np.random.default_rng(seed), make_grid(2, (True, False))
    equation, dense, exact = random_equation(rng, grid, diagonal=True)
    size = np.max(np.abs(exact))
    assert np.allclose(solved(equation, grid, "direct"), exact, rtol=0, atol=1e-12 * size)
    assert np.allclose(solved(equation, grid, "krylov"), exact, rtol=0, atol=1e-9 * size)
    assert np.array_equal(sweeps(equation, grid, 2), _jacobi(equation, grid, 32))
    delta = np.zeros(grid.size)
    for _ in range(32):
        delta += 0.5 * (np.ravel(equation.source) - dense @ delta)
    assert np.allclose(np.ravel(_jacobi(equation, grid, 32)), delta, rtol=0, atol=1e-12 * size)
    assert np.allclose(_jacobi(equation, grid, 2000), exact, rtol=0, atol=1e-11 * size)


@functools.partial(jax.jit, static_argnames="count")
def _jacobi(equation, grid, count):
    return jacobi(equation, grid, count)


def test_sweeps_run_in_single_precision_and_return_the_type_they_got():
    grid = make_grid(2, (False, False))
    equation, _, _ = random_equation(np.random.default_rng(0), grid)
    delta = solved(equation, grid, "sweeps")
    assert delta.dtype == np.float64
    assert np.array_equal(delta, delta.astype(np.float32))
    assert np.allclose(delta, sweeps(equation, grid, 3), rtol=0, atol=1e-5)


@pytest.mark.parametrize("method", ["krylov", "direct"])
def test_an_equation_without_a_solution_is_relaxed(method):
    """Two nodes that feed each other for ever: I − W is singular, and the answer stays finite."""
    grid = make_grid(1, (False,), (2,))
    ones = jnp.ones(2)
    weights = Rates(((1,), (-1,)), (jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])))
    assert np.all(np.isfinite(solved(PolicyEquation(ones, weights), grid, method)))


def test_single_precision_goes_through_the_direct_solve():
    grid = make_grid(2, (True, False))
    equation, _, exact = random_equation(np.random.default_rng(4), grid)
    single = jax.tree.map(lambda leaf: leaf.astype(np.float32), equation)
    delta = solved(single, grid, "direct")
    assert delta.dtype == np.float32
    assert np.allclose(delta, exact, rtol=0, atol=1e-5 * np.max(np.abs(exact)))


def test_a_batch_is_solved_lane_by_lane():
    grid = make_grid(1, (False,))
    lanes = [random_equation(np.random.default_rng(seed), grid) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(equation for equation, _, _ in lanes))
    for method in ("direct", "krylov"):
        found = jax.vmap(lambda equation, method=method: solved(equation, grid, method))(stacked)
        assert np.allclose(found, np.stack([exact for *_, exact in lanes]), rtol=0, atol=1e-9)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Gmres(Evaluation):
    """An evaluation of somebody else's."""

    restart: int = 20
    open_ends = True

    def solve(self, equation, grid):
        def matvec(delta):
            return equation.source - left_over(equation, grid, delta)

        zero = jnp.zeros_like(equation.source)
        return jax.scipy.sparse.linalg.gmres(matvec, equation.source, zero, tol=1e-3, restart=self.restart)[0]

    def bytes_per_node(self, weights, word):
        return word * (weights + self.restart + 6)


class Unregistered(Gmres):
    """Hashable, but no pytree of its own."""


def controlled(x, u):
    return u


def costs(x, u):
    return x @ x + u @ u


LINE, WALK = hjb.Grid([-1.0], [1.0], (31,)), hjb.Problem(controlled, costs, hjb.Box([-1.0], [1.0]), noise=0.5)
FOR_EVER = hjb.Problem(controlled, costs, hjb.Box([-1.0], [1.0]), noise=0.5, discount=0.3)


@pytest.mark.slow
def test_another_evaluation_solves_marches_and_goes_lane_by_lane():
    method, known = hjb.PolicyIteration(Gmres()), hjb.solve(FOR_EVER, LINE, tol=1e-8, scheme=hjb.Upwind())
    alone = hjb.solve(FOR_EVER, LINE, method=method, tol=1e-6, scheme=hjb.Upwind())
    (lane,) = hjb.solve_batch([FOR_EVER], LINE, method=method, tol=1e-6, scheme=hjb.Upwind())
    for found in (alone, lane):
        assert found.status is hjb.Status.CONVERGED
        np.testing.assert_allclose(found.value, known.value, rtol=0, atol=found.error + known.error)
    steps = [
        hjb.march(WALK, LINE, 1.0, step=0.1, method=hjb.Implicit(each), scheme=hjb.Upwind(split=True)).value
        for each in (Gmres(), Direct())
    ]
    np.testing.assert_allclose(*steps, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_another_evaluation_inside_a_derivative():
    def value(weight, method):
        problem = hjb.Problem(
            controlled, lambda x, u: weight * x @ x + u @ u, FOR_EVER.controls, noise=0.5, discount=0.3
        )
        return hjb.solve(problem, LINE, method=method, scheme=hjb.Upwind()).value[20]

    found, known = (jax.grad(value)(2.0, hjb.PolicyIteration(each)) for each in (Gmres(), hjb.Krylov()))
    assert float(found) == pytest.approx(float(known), rel=1e-6)


@pytest.mark.parametrize("evaluation", [Gmres, hjb.Sweeps, "krylov", 3])
def test_what_is_no_evaluation_is_refused(evaluation):
    with pytest.raises(TypeError, match=r"PolicyIteration: evaluation is .*; wanted hjb.Sweeps\("):
        hjb.PolicyIteration(evaluation)


def test_an_evaluation_that_is_no_pytree_is_told_how_to_become_one():
    with pytest.raises(TypeError, match=r"Unregistered is not a pytree.*\n?.*jax.tree_util.register_static"):
        hjb.PolicyIteration(Unregistered())


@pytest.mark.slow
def test_policy_iteration_picks_its_evaluation_by_the_problem():
    noisy = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), noise=0.5, discount=1.0)
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (31, 31))
    plane = hjb.Problem(lambda x, u: jnp.stack([x[1], u[0]]), noisy.cost, noisy.controls, noise=0.5, discount=1.0)
    quiet = hjb.Problem(plane.drift, plane.cost, plane.controls, discount=1.0)
    for problem, evaluation in ((plane, hjb.Krylov()), (quiet, hjb.Sweeps())):
        for method in (hjb.PolicyIteration(), hjb.Nested(coarsest=900)):
            chosen = hjb.solve(problem, grid, method=method, scheme=hjb.Upwind())
            assert repr(evaluation) in chosen.stats["method"]
    named = hjb.solve(plane, grid, method=hjb.PolicyIteration(hjb.Krylov()), scheme=hjb.Upwind())
    picked = hjb.solve(plane, grid, method=hjb.PolicyIteration(), scheme=hjb.Upwind())
    np.testing.assert_array_equal(picked.value, named.value)
    assert picked.steps == named.steps < 20  # sweeps take hundreds
    line = hjb.solve(noisy, hjb.Grid([-1.0], [1.0], (41,)), method=hjb.PolicyIteration(), scheme=hjb.Upwind())
    assert repr(hjb.Krylov()) in line.stats["method"]
    assert repr(hjb.PolicyIteration()) == "PolicyIteration(evaluation=None, replies=20)"
