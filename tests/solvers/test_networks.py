"""Drifts that are neural networks: solved, batched and differentiated in their weights, against plain NumPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

# a network may lead out of the box: its ends hold it, in the oracle as well
pytestmark = pytest.mark.filterwarnings("ignore:the optimal drift leaves the box")
GRID = hjb.Grid([-1.0, -1.5], [1.0, 1.0], (9, 11))
ACTIONS = np.array([[-1.0], [0.25], [1.0]])
UPWIND = {"scheme": hjb.Upwind(central=False), "tol": 1e-9}


def weights(seed, width=16):
    """A layer of three inputs, one in between and one of two outputs, none of which vanishes."""
    rng = np.random.default_rng(seed)
    sizes = (3, width, width, 2)
    return [(rng.normal(size=(b, a)) / np.sqrt(a), 0.1 * rng.normal(size=b)) for a, b in itertools.pairwise(sizes)]


def network(layers, x, u):
    found = jnp.concatenate([x, u])
    for matrix, shift in layers[:-1]:
        found = jnp.tanh(matrix @ found + shift)
    return layers[-1][0] @ found + layers[-1][1]


def posed(layers):
    return hjb.Problem(
        jax.tree_util.Partial(network, layers), lambda x, u: x @ x + 0.1 * u @ u, hjb.Finite(ACTIONS), discount=0.5
    )


def by_numpy(layers):
    """The fixed point of V = min_u { L + Σ r_± V(x ± h e_i) } / (β + Σ r_±), r_± = f_i^±/h_i; ends hold like walls."""
    axes = [np.linspace(-1.0, 1.0, 9), np.linspace(-1.5, 1.0, 11)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    costs, rates = [], []
    for u in ACTIONS:
        found = np.concatenate([x, np.broadcast_to(u, (*x.shape[:-1], 1))], axis=-1)
        for matrix, shift in layers[:-1]:
            found = np.tanh(found @ matrix.T + shift)
        found = found @ layers[-1][0].T + layers[-1][1]
        costs.append(np.sum(x**2, axis=-1) + 0.1 * u @ u)
        rates.append([np.maximum(sign * found[..., i], 0) / (0.25) for i in range(2) for sign in (1, -1)])
    value = np.zeros(x.shape[:-1])
    for _ in range(800):
        around = [
            np.take(value, np.clip(np.arange(value.shape[i]) + step, 0, value.shape[i] - 1), axis=i)
            for i in range(2)
            for step in (1, -1)
        ]
        value = np.min(
            [
                (cost + sum(r * v for r, v in zip(rate, around, strict=True))) / (0.5 + sum(rate))
                for cost, rate in zip(costs, rates, strict=True)
            ],
            axis=0,
        )
    return value


@pytest.fixture(scope="module")
def answers():
    """Two networks with their values: the oracle's, and the solver's."""
    layers = [weights(seed) for seed in (1, 2)]
    with pytest.warns(hjb.SolveWarning, match="the box decides V"):
        found = hjb.solve_batch(map(posed, layers), GRID, **UPWIND)
    return layers, [by_numpy(each) for each in layers], found


@pytest.mark.slow
def test_a_batch_of_networks_is_value_iteration_in_numpy(answers):
    _, exact, found = answers
    np.testing.assert_allclose([each.value for each in found], exact, atol=1e-8)


@pytest.mark.slow
def test_a_network_in_single_precision(answers):
    layers, exact, _ = answers
    found = hjb.solve(posed(layers[0]), GRID, dtype="float32", scheme=UPWIND["scheme"], tol=1e-4)
    assert found.value.dtype == np.float32
    np.testing.assert_allclose(found.value, exact[0], atol=3e-4)


@pytest.mark.slow
def test_derivatives_in_every_weight_are_those_of_the_oracle(answers):
    layers = answers[0][0]

    def mean(layers):
        return jnp.mean(hjb.solve(posed(layers), GRID, **UPWIND).value)

    gradient = jax.grad(mean)(layers)
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), layers)
    along = sum(
        np.sum(np.asarray(a, float) * b)
        for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
    )
    ends = [by_numpy(jax.tree.map(lambda w, d, t=t: w + t * d, layers, direction)).mean() for t in (-1e-5, 1e-5)]
    np.testing.assert_allclose(along, (ends[1] - ends[0]) / 2e-5, rtol=1e-5 if jax.config.jax_enable_x64 else 1e-3)
    assert all(np.any(np.asarray(leaf) != 0) for leaf in jax.tree.leaves(gradient))


def test_a_long_program_is_warned_of_before_it_is_compiled():
    entry = np.random.default_rng(3).normal(size=(7, 7)) / 7  # too small for one contraction: sums of products

    def slow(x, u):
        found = jnp.concatenate([x, u, x, u, x[:1]])[:7]
        for _ in range(150):
            found = jnp.tanh(entry @ found)
        return found[:2]

    problem = hjb.Problem(slow, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    with pytest.raises(hjb.SolveWarning, match=r"functions is 15,754 scalar operations"):  # an error here, as all are
        hjb.solve(problem, GRID, scheme=hjb.Upwind())
