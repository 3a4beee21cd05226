"""Stretched axes: the map, the nodes, interpolation, and the order that schemes keep on them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.tree_util import Partial

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.problem.pytree import altered

strengths = st.floats(0.1, 8.0)
centers = st.floats(0.0, 1.0)
INTERPOLATE = jax.jit(hjb.Grid.interpolate)


@settings(deadline=None)
@given(strengths, centers)
def test_the_map_takes_the_interval_onto_itself_and_is_densest_at_its_centre(strength, center):
    place = hjb.Sinh(strength, center).place(np.linspace(0.0, 1.0, 41))
    assert place[0] == pytest.approx(0.0, abs=1e-12)
    assert place[-1] == pytest.approx(1.0, abs=1e-12)
    gaps = np.diff(place)
    assert np.all(gaps > 0)
    closest = int(np.argmin(np.abs((place[1:] + place[:-1]) / 2 - center)))
    assert gaps[closest] <= np.min(gaps) * (1 + strength / 20)


@settings(deadline=None)
@given(strengths, centers, st.floats(0.0, 1.0))
def test_the_inverse_map(strength, center, fraction):
    stretching = hjb.Sinh(strength, center)
    with jax.enable_x64(True):
        assert float(stretching.fraction(stretching.place(fraction))) == pytest.approx(fraction, abs=1e-8)


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(st.floats(0.3, 8), st.floats(0, 1), st.floats(-3, 0), st.floats(0.5, 6), st.sampled_from(["float64", "float32"]))
def test_every_program_finds_the_nodes_where_they_are_to_a_few_roundings(strength, center, lo, length, dtype):
    """A node that moved by more from program to program would lie in a target in one and not in another."""
    k, c = np.longdouble(strength), np.longdouble(center)
    middle = np.log((1 - c + c * np.exp(k)) / (1 - c + c * np.exp(-k))) / (2 * k)
    low, high = np.sinh(k * middle), np.sinh(k * (1 - middle))
    exact = lo + length * (np.sinh(k * (np.arange(21) / np.longdouble(20) - middle)) + low) / (low + high)
    grid = hjb.Grid([lo], [lo + length], (21,), stretch=(hjb.Sinh(strength, center),))
    with jax.enable_x64(True):
        compiled = jax.jit(lambda grid: grid.axis(0))(jax.tree.map(lambda entry: np.asarray(entry, dtype), grid))
    few = 9 * max(-lo, lo + length)
    np.testing.assert_allclose(np.asarray(grid.axis(0)), exact.astype(float), rtol=0, atol=few * np.finfo(float).eps)
    np.testing.assert_allclose(compiled, exact.astype(float), rtol=0, atol=few * np.finfo(dtype).eps)


def test_a_node_in_the_middle_is_exactly_zero():
    grid = hjb.Grid([-3.7], [3.7], (41,), stretch=(hjb.Sinh(5.0),))
    assert grid.axis(0)[20] == 0.0
    np.testing.assert_array_equal(grid.axis(0)[[0, -1]], [-3.7, 3.7])


@settings(deadline=None)
@given(st.floats(-2.0, 2.0), st.floats(-1.0, 3.0))
def test_interpolation_is_exact_on_multilinear_functions_and_at_nodes(x, y):
    grid = hjb.Grid([-2.0, -1.0], [2.0, 3.0], (9, 12), stretch=(hjb.Sinh(4.0), hjb.Sinh(2.0, 0.3)))
    nodes = grid.nodes()
    values = 1 + 2 * nodes[..., 0] - nodes[..., 1] + 0.5 * nodes[..., 0] * nodes[..., 1]
    with jax.enable_x64(True):
        found = float(INTERPOLATE(grid, values, np.array([x, y])))
        at_nodes = INTERPOLATE(grid, values, nodes)
    assert found == pytest.approx(1 + 2 * x - y + 0.5 * x * y, abs=1e-12)
    np.testing.assert_allclose(at_nodes, values, atol=1e-12)


@pytest.mark.parametrize(
    ("stretch", "kind", "word"),
    [((3.0, None), TypeError, "Sinh"), ((hjb.Sinh(1.0), None), ValueError, "periodic")],
)
def test_what_is_no_stretching_is_refused(stretch, kind, word):
    with pytest.raises(kind, match=word):
        hjb.Grid([0.0, 0.0], [1.0, 1.0], (5, 5), periodic=(True, False), stretch=stretch)


@pytest.mark.parametrize("arguments", [(0.0,), (-1.0,), (np.nan,), (1.0, 2.0)])
def test_maps_that_are_none_are_refused(arguments):
    with pytest.raises(ValueError, match="Sinh: got"):
        hjb.Sinh(*arguments)


def test_correlated_noise_wants_equal_spacings():
    problem = hjb.Problem(lambda x, u: -x, lambda x, u: x @ x, noise=np.array([[1.0, 0.2], [0.0, 1.0]]), discount=1.0)
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (9, 9), stretch=(hjb.Sinh(2.0), None))
    with pytest.raises(ValueError, match="equal spacings"):
        hjb.solve(problem, grid, scheme=hjb.Upwind())


SHEAR = np.array([[0.5, 0.0], [0.3, 0.4]])
GATHERED = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (9, 9), stretch=(hjb.Sinh(2.0), None))


def calm(x, *rest):
    return -x


def shear(x, *rest):
    return jnp.asarray(SHEAR)


def shear_by_time(t, x, u):
    return (1 + t) * jnp.asarray(SHEAR)


def product(x, *rest):
    return x[0] * x[1]


@pytest.mark.parametrize("noise", [SHEAR, shear], ids=["matrix", "function"])
@pytest.mark.parametrize("ask", ["solve", "batch", "march", "jit", "generator", "matrix", "arrays", "density"])
def test_correlated_noise_is_refused_by_the_shape_that_it_returns(ask, noise):
    problem = hjb.Problem(calm, product, noise=noise, discount=1.0)
    asked = {
        "solve": lambda: hjb.solve(problem, GATHERED, scheme=hjb.Upwind()),
        "batch": lambda: hjb.solve_batch([problem], GATHERED, scheme=hjb.Upwind()),
        "march": lambda: hjb.march(problem, GATHERED, 0.1, scheme=hjb.Upwind(split=True)),
        "jit": lambda: jax.jit(
            lambda rate: hjb.solve(altered(problem, discount=rate), GATHERED, scheme=hjb.Upwind()).value
        )(1.0),
        "generator": lambda: hjb.chain.generator(problem, GATHERED),
        "matrix": lambda: hjb.chain.matrix(problem, GATHERED),
        "arrays": lambda: hjb.chain.transition_arrays(problem, GATHERED),
        "density": lambda: hjb.chain.stationary_density(problem, GATHERED),
    }
    with pytest.raises(ValueError, match=r"correlated noise.*equal spacings"):
        asked[ask]()


def test_correlated_noise_of_the_time_is_refused_too():
    problem = hjb.Problem(lambda t, x, u: -x, noise=shear_by_time, terminal_cost=lambda t, x: x[0], time_dependent=True)
    with pytest.raises(ValueError, match="equal spacings"):
        hjb.march(problem, GATHERED, 0.1, scheme=hjb.Upwind(split=True))


def test_one_state_has_nothing_to_correlate():
    """σ of shape (1, 2) on a stretched axis is the noise √(.09 + .16)."""
    grid = hjb.Grid([-1.0], [1.0], (9,), stretch=(hjb.Sinh(2.0),))
    values = [
        hjb.solve(
            hjb.Problem(calm, lambda x, u: x @ x, noise=noise, discount=1.0), grid, tol=1e-9, scheme=hjb.Upwind()
        ).value
        for noise in (np.array([[0.3, 0.4]]), 0.5)
    ]
    np.testing.assert_allclose(*values, rtol=1e-12)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_rate_is_negative_on_stretched_axes(seed):
    """Where drift and diffusion of the chain cancel, rounding left −3e-17."""
    rng = np.random.default_rng(seed)
    grid = hjb.Grid([-1.0, -2.0], [1.3, 0.7], (9, 7), stretch=(hjb.Sinh(rng.uniform(0.5, 3)), hjb.Sinh(1.8)))
    u = hjb.Finite(rng.normal(size=(3, 2)))
    matrix = rng.normal(size=(2, 2))
    for noise in (None, rng.uniform(0, 0.3)):
        problem = hjb.Problem(Partial(rotated, matrix), product, u, noise=noise, discount=1.0)
        probabilities = hjb.chain.transition_arrays(problem, grid)[1]
        assert probabilities.data.min() >= 0
        policy = np.broadcast_to(u.points[0], (*grid.shape, 2))
        generator = hjb.chain.generator(problem, grid, policy)
        assert (generator - np.diag(generator.diagonal())).min() >= 0


def rotated(matrix, x, u):
    return matrix @ x + u


def bang_bang_errors(scheme, epsilon, stretch, counts):
    exact, errors = zoo.bang_bang_exact(noise=epsilon), []
    for count in counts:
        problem, grid = zoo.bang_bang(noise=epsilon, shape=(count,))
        grid = hjb.Grid(grid.lo, grid.hi, (count,), stretch=(stretch,))
        solution = hjb.solve(problem, grid, scheme=scheme, tol=1e-7)
        with jax.enable_x64(True):
            errors.append(np.max(np.abs(solution.value - np.asarray(jax.vmap(exact)(jnp.asarray(grid.nodes()))))))
    return errors


@pytest.mark.parametrize(
    ("scheme", "epsilon", "order"), [(hjb.Upwind(), 0.0, 1), (hjb.Limited(), 0.0, 2), (hjb.Upwind(), 0.5**0.5, 2)]
)
@pytest.mark.slow
def test_schemes_keep_their_order(scheme, epsilon, order):
    errors = bang_bang_errors(scheme, epsilon, hjb.Sinh(2.0), (41, 81))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)


@pytest.mark.slow
def test_nodes_where_the_value_bends_buy_accuracy():
    uniform, gathered = (bang_bang_errors(hjb.Limited(), 0.0, stretch, (81,))[0] for stretch in (None, hjb.Sinh(3.0)))
    assert gathered < 0.75 * uniform


def test_a_stretched_solution_comes_back_from_its_file(tmp_path):
    problem, grid = zoo.bang_bang(shape=(21,))
    grid = hjb.Grid(grid.lo, grid.hi, (21,), stretch=(hjb.Sinh(2.0, 0.4),))
    solution = hjb.solve(problem, grid, scheme=hjb.Upwind())
    solution.save(tmp_path / "run.npz")
    again = hjb.load(tmp_path / "run.npz")
    np.testing.assert_array_equal(again.grid.axis(0), grid.axis(0))
    assert again.value_at([0.3]) == solution.value_at([0.3])
