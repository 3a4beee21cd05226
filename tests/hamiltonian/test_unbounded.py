"""Controls without bounds: against Riccati's equation, a scan of all controls, and bounds too wide to matter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hjbjax as hjb
from hjbjax.hamiltonian.piecewise import Kinked, piecewise_input
from hjbjax.problem import sets

INF = np.inf
FREE = hjb.Box([-INF], [INF])
LINE = hjb.Grid([-2.0], [2.0], (41,))
OPEN = hjb.Grid([-2.0], [2.0], (41,), edges="open")


def regulator(box, price=1.0, discount=1.0, **options):
    return hjb.Problem(lambda x, u: u, lambda x, u: x @ x + price * u @ u, box, discount=discount, **options)


def riccati(price, discount):
    """P of V = P x², the positive root of β P = 1 − P²/q."""
    return price * (-discount + np.sqrt(discount**2 + 4 / price)) / 2


# --- the optimum ---

NUMBERS = st.floats(-3, 3)


@given(
    slope=NUMBERS,
    square=st.floats(0.05, 2),
    up=NUMBERS,
    down=NUMBERS,
    offset=NUMBERS,
    gain=NUMBERS,
    sides=st.integers(0, 2),
)
@settings(max_examples=60)
def test_no_scanned_control_is_better(slope, square, up, down, offset, gain, sides):
    """l u + q u² + f⁺ D⁺ + f⁻ D⁻ with f = b + G u, over R, u ≥ 0 and u ≤ 0."""
    box = hjb.Box(*[([-INF], [INF]), ([0.0], [INF]), ([-INF], [0.0])][sides])

    def rate(f):
        return jnp.maximum(f, 0) * up + jnp.minimum(f, 0) * down

    def total(u):
        f = offset + gain * u
        return slope * u + square * u**2 + np.maximum(f, 0) * up + np.minimum(f, 0) * down

    with jax.enable_x64(True):
        lo, hi = sets.finite_ends(box, np.float64)
        pieces = [Kinked(rate, offset, gain, (0.0,), (down, up))]
        best = float(piecewise_input(1, lo[0], hi[0], slope, square, pieces, curved=True))
    assert box.lo[0] <= best <= box.hi[0]
    scan = np.linspace(max(-300.0, box.lo[0]), min(300.0, box.hi[0]), 200_001)  # |u*| ≤ 12/(2 · 0.05) = 120
    assert total(best) <= total(scan).min() + 1e-12 * (1 + abs(total(best)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_ends_are_finite_and_their_squares_too(dtype):
    with jax.enable_x64(True):
        lo, hi = sets.finite_ends(hjb.Box([-INF, 0.5], [3.0, INF]), dtype)
        ends = np.array([lo, hi], dtype)
        assert np.all(np.isfinite(ends**2))
        assert ends[0, 1] == 0.5
        assert ends[1, 0] == 3.0


# --- solves ---


@pytest.mark.parametrize(("price", "discount"), [(1.0, 1.0), (0.02, 0.3), (5.0, 2.0)])
def test_riccati_without_bounds(price, discount):
    solution = hjb.solve(regulator(FREE, price, discount), OPEN)
    p, x = riccati(price, discount), np.asarray(OPEN.axis(0))
    np.testing.assert_allclose(solution.value, p * x**2, rtol=0, atol=2e-3)
    np.testing.assert_allclose(solution.policy[:, 0], -p * x / price, rtol=0, atol=5e-3 / np.sqrt(price))


@pytest.mark.parametrize("noise", [None, pytest.param(0.6, marks=pytest.mark.slow)])
def test_bounds_too_wide_to_matter_give_the_same_bits(noise):
    found, wide = (
        hjb.solve(regulator(box, noise=noise), LINE, scheme=hjb.Upwind(), tol=1e-8)
        for box in (hjb.Box([0.0], [INF]), hjb.Box([0.0], [40.0]))
    )
    np.testing.assert_array_equal(found.value, wide.value)
    np.testing.assert_array_equal(found.policy, wide.policy)
    assert found.error < 1e-8  # certified, like the other


@pytest.mark.slow
def test_implicit_steps_without_bounds():
    found, wide = (
        hjb.march(regulator(box, discount=0.0), LINE, 1.0, method=hjb.Implicit(), step=0.05)
        for box in (FREE, hjb.Box([-40.0], [40.0]))
    )
    np.testing.assert_allclose(found.value, wide.value, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"march: got infinite bounds.*\n?.*Implicit"):
        hjb.march(regulator(FREE), LINE, 1.0)


@pytest.mark.slow
def test_derivatives_and_paths_without_bounds():
    def value(price):
        return hjb.solve(regulator(FREE, price), OPEN).value_at(jnp.array([1.0]))

    with jax.enable_x64(True):
        slope = float(jax.grad(value)(1.0))
    assert slope == pytest.approx((riccati(1.001, 1.0) - riccati(0.999, 1.0)) / 0.002, rel=1e-3)
    path = hjb.simulate(regulator(FREE), hjb.solve(regulator(FREE), OPEN), [1.0], 10.0)
    assert path.cost == pytest.approx(riccati(1.0, 1.0), rel=1e-3)


def test_a_disturbance_without_bounds_is_concave():
    """βV = x² + u² − 4d² + (u + d) V' with V = P x²: βP = 1 − P² + P²/4."""
    game = hjb.Problem(
        lambda x, u, d: u + d, lambda x, u, d: x @ x + u @ u - 4 * d @ d, FREE, disturbances=FREE, discount=1.0
    )
    solution = hjb.solve(game, hjb.Grid([-2.0], [2.0], (161,), edges="open"), scheme=hjb.Upwind(split=True))
    p = (-1 + np.sqrt(1 + 4 * 0.75)) / 1.5
    assert solution.value_at([1.0]) == pytest.approx(p, rel=0.02)  # first order


# --- refusals ---


def posed(drift=lambda x, u: u, cost=lambda x, u: x @ x + u @ u, box=FREE, **options):
    return hjb.Problem(drift, cost, box, discount=1.0, **options)


@pytest.mark.parametrize(
    ("problem", "options", "reason"),
    [
        (posed(cost=lambda x, u: x @ x), {}, "the cost is affine in input 0, so the optimum is infinite"),
        (posed(cost=lambda x, u: x @ x + u[0] ** 4), {}, "the optimum is searched between the bounds"),
        (posed(drift=lambda x, u: u**2), {}, "the optimum is searched between the bounds"),
        (posed(noise=lambda x, u: u), {}, "the optimum is searched between the bounds"),
        (posed(cost=lambda x, u: x[0] * u[0] ** 2), {}, r"no curvature in input 0 at 21 nodes, the first x = \[-2.0\]"),
        (posed(cost=lambda x, u: x @ x - u @ u), {}, "no curvature in input 0 at 41 nodes"),
        (
            posed(lambda x, u: u[:1] + u[1:], lambda x, u: u @ u + u[0] * u[1], hjb.Box([0.0, 0.0], [INF, 1.0])), {},
            "the optimum over input 0 is a quadratic program",
        ),
        (posed(), {"method": hjb.ValueIteration()}, "its steps divide by the largest rate"),
        (posed(), {"scheme": hjb.SemiLagrangian()}, "infinite bounds: its actions are samples"),
        (posed(box=lambda x: hjb.Box(0 * x, INF + 0 * x)), {}, "not a box with finite lo ≤ hi"),
    ],
)  # fmt: skip
def test_bounds_that_are_needed_are_refused(problem, options, reason):
    with pytest.raises(ValueError, match=reason) as caught:
        hjb.solve(problem, LINE, **options)
    assert len(str(caught.value).splitlines()) <= 6


# --- bounds that are active ---


@pytest.mark.parametrize("most", [0.3, 0.5, 5.0])
def test_the_solution_counts_the_nodes_at_a_bound(most):
    solution = hjb.solve(regulator(hjb.Box([-most], [0.25])), LINE, scheme=hjb.Upwind())
    u = solution.policy[:, 0]
    lower, upper = int(np.sum(u == -most)), int(np.sum(u == 0.25))
    counts = [f"{n} at the {end} bound" for n, end in ((lower, "lower"), (upper, "upper")) if n]
    assert solution.stats["bounds"] == f"u1: {', '.join(counts)}, of 41 nodes"
    assert "bounds" in str(solution)


@pytest.mark.parametrize("most", [0.3, 0.8])
def test_a_march_counts_them_at_its_earliest_time(most):
    problem = regulator(hjb.Box([-most], [most]), discount=0.0)
    marched = hjb.march(problem, LINE, 1.0, times=[0.25, 1.0], scheme=hjb.Upwind())
    count = int(np.sum(marched.policy[0] == most))
    assert marched.stats["bounds"] == (
        f"u1: {count} at the lower bound, {count} at the upper bound, of 41 nodes at t = 0.25"
    )


def test_bounds_that_are_not_active_are_not_mentioned():
    assert "bounds" not in hjb.solve(regulator(hjb.Box([-9.0], [9.0])), LINE, scheme=hjb.Upwind()).stats
    bang_bang = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    assert "bounds" not in hjb.solve(bang_bang, LINE, scheme=hjb.Upwind()).stats
