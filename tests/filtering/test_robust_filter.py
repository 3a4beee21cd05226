"""The robust information state: parabolas that stay parabolas, a brute-force oracle, laws, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from orders import order_of
from scipy.integrate import solve_ivp

import hjbjax as hjb
from hjbjax.filtering import Observer, RobustGridFilter, robust_filter

SEEDS = st.integers(0, 2**32 - 1)


# --- linear systems: K and x̂ of p = −½ (x − x̂)ᵀ K (x − x̂) + φ from their own equations ---


def riccati(f, b, spread, q, c, gamma, *, start, record, held, dt):
    """K (n, n), x̂ (n,) and φ after every interval, by SciPy; ``record`` is a function of the time or an array."""
    n = len(f)

    def slope(t, z, y, u):
        k, x, measured = z[: n * n].reshape(n, n), z[n * n : -1], y(t) if callable(y) else y
        off = measured - c @ x
        dk = -k @ f - f.T @ k - k @ np.diag(spread**2) @ k / gamma**2 - q + gamma**2 * c.T @ c
        dx = f @ x + b @ u + np.linalg.solve(k, q @ x + gamma**2 * c.T @ off)
        return np.concatenate([dk.ravel(), dx, [x @ q @ x / 2 - gamma**2 * off @ off / 2]])

    z, rows = np.concatenate([start[0].ravel(), start[1], [0.0]]), []
    for number, u in enumerate(held):
        y = record if callable(record) else record[number]
        z = solve_ivp(slope, (number * dt, (number + 1) * dt), z, args=(y, u), rtol=1e-11, atol=1e-12).y[:, -1]
        rows.append(z)
    rows = np.array(rows)
    return rows[:, : n * n].reshape(-1, n, n), rows[:, n * n : -1], rows[:, -1]


A, C, Q, GAMMA, K0, X0 = -0.5, 1.0, 0.6, 2.0, 8.0, 0.3
LAG = hjb.Problem(lambda x, u: A * x + u, lambda x, u: 0.5 * Q * x @ x, hjb.Box([-1.0], [1.0]))


def seen(x):
    return C * x


def prior(x):
    return -0.5 * K0 * (x[0] - X0) ** 2


def lag_errors(count, y, u, dt, exact, scheme):
    grid = hjb.Grid([-4.0], [4.0], (count,))
    state = robust_filter(LAG, seen, grid, y, dt, prior, gamma=GAMMA, controls=u, scheme=scheme)
    k, x, phi = (each[-1] for each in exact)
    nodes = np.asarray(grid.axis(0))
    inner = np.abs(nodes) < 2.5
    wanted = -0.5 * k[0, 0] * (nodes - x[0]) ** 2 + phi
    return (
        np.max(np.abs(state.p[-1] - wanted)[inner]),
        np.max(np.abs(state.worst_case - exact[1])),
        np.max(np.abs(state.value - exact[2])),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "order", "finest"),
    [
        pytest.param(hjb.Upwind(), 1, 0.15, marks=pytest.mark.slow),
        pytest.param(hjb.Limited(), 2, 1e-5, marks=pytest.mark.slow),
        (hjb.Weno5(), 2.75, 4e-7),
    ],
)
def test_a_parabola_stays_one_for_a_lag(scheme, order, finest):
    """High slopes are exact for it: what is left falls with the inner steps, which are in proportion to h."""
    rng = np.random.default_rng(0)
    y, u = 0.7 * rng.normal(size=(20, 1)), rng.uniform(-1, 1, (20, 1))
    parts = (np.array([[A]]), np.eye(1), np.ones(1), np.array([[Q]]), np.array([[C]]), GAMMA)
    exact = riccati(*parts, start=(np.array([[K0]]), np.array([X0])), record=y, held=u, dt=0.1)
    errors = np.array([lag_errors(count, y, u, 0.1, exact, scheme) for count in (41, 81, 161)])
    assert order_of(errors[:, 0]) == pytest.approx(order, abs=0.25)
    assert order_of(errors[:, 1]) >= order - 0.5
    assert errors[-1, 2] < finest


@pytest.mark.slow
def test_records_sampled_in_the_middle_are_of_second_order_in_dt():
    def y(t):
        return np.array([np.sin(2 * t)])

    parts = (np.array([[A]]), np.eye(1), np.ones(1), np.array([[Q]]), np.array([[C]]), GAMMA)
    errors = []
    for count in (5, 10, 20):
        dt = 2 / count
        u = np.zeros((count, 1))
        exact = riccati(*parts, start=(np.array([[K0]]), np.array([X0])), record=y, held=u, dt=dt)
        sampled = np.stack([y((number + 0.5) * dt) for number in range(count)])
        grid = hjb.Grid([-4.0], [4.0], (161,))
        state = robust_filter(LAG, seen, grid, sampled, dt, prior, gamma=GAMMA, controls=u)
        errors.append(abs(state.worst_case[-1, 0] - exact[1][-1, 0]))
    assert order_of(errors) == pytest.approx(2, abs=0.15)


OSCILLATOR = np.array([[0.0, 1.0], [-1.0, -0.4]])


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "spread"), [(None, (1.0, 1.0)), ([[0.0], [0.8]], (0.0, 0.8))])
def test_a_quadratic_stays_one_for_an_oscillator(sigma, spread):
    """Cross terms and all; with noise on the velocity alone, too."""
    plant = hjb.Problem(
        lambda x, u: jnp.stack([x[1], -x[0] - 0.4 * x[1] + u[0]]), lambda x, u: 0.1 * x @ x, hjb.Box([-1.0], [1.0])
    )
    rng = np.random.default_rng(1)
    y, u = 0.5 * rng.normal(size=(8, 1)), rng.uniform(-1, 1, (8, 1))
    k0, x0, gamma = np.array([[6.0, 1.0], [1.0, 4.0]]), np.array([0.2, -0.3]), 2.5
    parts = (OSCILLATOR, np.array([[0.0], [1.0]]), np.array(spread), 0.2 * np.eye(2), np.array([[1.0, 0.0]]), gamma)
    k, x, phi = riccati(*parts, start=(k0, x0), record=y, held=u, dt=0.1)

    def start(z):
        return -0.5 * (z - x0) @ k0 @ (z - x0)

    errors, values = [], []
    for count in (25, 49, 97):
        grid = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (count, count))
        state = robust_filter(plant, lambda z: z[:1], grid, y, 0.1, start, gamma=gamma, controls=u, sigma=sigma)
        off = grid.nodes() - x[-1]
        wanted = -0.5 * np.einsum("...i,ij,...j", off, k[-1], off) + phi[-1]
        errors.append(np.max(np.abs(state.p[-1] - wanted)[grid.inner(0.6)]))
        values.append(max(np.max(np.abs(state.worst_case - x)), np.max(np.abs(state.value - phi))))
    assert order_of(errors) >= 2.5
    assert errors[-1] < 2e-4
    assert values[-1] < 1e-5


# --- another way to the answer: dynamic programming over all pairs of nodes, in NumPy ---


def brute_force(drift, cost, measured, nodes, p, record, dt, pieces, gamma, sigma):
    """p⁺(x) = max_z { p(z) − (γ²/2σ²) (v − f)² δ + source δ }, v = (x − z)/δ, f and source half way from z to x."""
    step = dt / pieces
    middle, v = (nodes[:, None] + nodes[None, :]) / 2, (nodes[:, None] - nodes[None, :]) / step
    moving = -(gamma**2) / (2 * sigma**2) * (v - drift(middle)) ** 2 + cost(middle)
    for y in record:
        paid = (moving - gamma**2 / 2 * (y - measured(middle)) ** 2) * step
        for _ in range(pieces):
            p = np.max(p[None, :] + paid, axis=1)
    return p


@pytest.mark.parametrize(("reach", "name"), [pytest.param(3.0, "wide", marks=pytest.mark.slow), (1.0, "narrow")])
def test_brute_force_over_all_paths_agrees(reach, name):
    """A nonlinear drift and sensor; in the narrow box paths from outside would do better, and are not there."""
    gamma, sigma, record = 1.5, 0.7, np.array([0.8, 0.5, -0.2])
    plant = hjb.Problem(lambda x, u: jnp.sin(2 * x) - 0.5 * x, lambda x, u: 0.2 * jnp.sum(jnp.cos(x)))
    fine = np.linspace(-reach, reach, int(500 * reach) + 1)
    theirs = brute_force(
        lambda x: np.sin(2 * x) - 0.5 * x, lambda x: 0.2 * np.cos(x), lambda x: x + 0.2 * x**3, fine,
        -2.0 * (fine - 0.2) ** 2, record, 0.2, 4, gamma, sigma,
    )  # fmt: skip
    grid = hjb.Grid([-reach], [reach], (int(40 * reach) + 1,))
    state = robust_filter(
        plant, lambda x: x + 0.2 * x**3, grid, record[:, None], 0.2, lambda x: -2.0 * (x[0] - 0.2) ** 2,
        gamma=gamma, sigma=sigma,
    )  # fmt: skip
    there = np.interp(np.asarray(grid.axis(0)), fine, theirs)
    # the oracle is of second order in its steps: with half of them it is off by a quarter
    assert np.max((np.abs(state.p[-1] - there) / (1 + np.abs(there)))[grid.inner(0.9)]) < 1.5e-3
    assert abs(state.value[-1] - theirs.max()) < 3e-3
    assert abs(state.worst_case[-1, 0] - fine[np.argmax(theirs)]) < 2e-2


# --- laws ---

PLANT = hjb.Problem(lambda x, u: jnp.stack([x[1], -jnp.sin(x[0]) + u[0]]), None, hjb.Box([-1.0], [1.0]))
RING = hjb.Grid([-np.pi, -2.0], [np.pi, 2.0], (12, 11), (True, False))


def angle(x):
    return jnp.stack([jnp.sin(x[0]), jnp.cos(x[0])])


def filtered(start, y, u, scale=1.0, scheme=None):
    scheme = scheme or hjb.Upwind()
    return robust_filter(PLANT, angle, RING, y, 0.3, start, gamma=1.2 * scale**0.5, controls=u, scheme=scheme)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*at an end of the box")
@given(seed=SEEDS)
@settings(max_examples=15)
def test_laws_of_the_max_plus_semigroup(seed):
    """Monotone, a constant goes through, in any unit of cost; disturbances that are paid for gain nothing."""
    rng = np.random.default_rng(seed)
    y, u = rng.normal(size=(3, 2)), rng.uniform(-1, 1, (3, 1))
    p0, shift, unit = -5 * rng.uniform(size=RING.shape), rng.normal(), 10 ** rng.uniform(-6, 6)
    plain = filtered(p0, y, u)
    above = filtered(p0 + rng.uniform(size=RING.shape), y, u)
    assert np.all(above.p >= plain.p - 1e-9)
    np.testing.assert_allclose(filtered(p0 + shift, y, u).p, plain.p + shift, atol=1e-9)
    np.testing.assert_allclose(filtered(unit * p0, y, u, unit).p, unit * plain.p, rtol=1e-8, atol=1e-9 * unit)
    assert plain.p.max() <= p0.max() + 1e-12  # L = 0: costs can only be subtracted
    assert np.all((plain.worst_case >= RING.lo) & (plain.worst_case <= RING.hi))


def test_an_interval_of_any_length_is_stable():
    whole = robust_filter(LAG, seen, hjb.Grid([-4.0], [4.0], (81,)), [[0.4]], 4.0, prior, gamma=GAMMA, controls=[[0.2]])
    parts = robust_filter(
        LAG, seen, hjb.Grid([-4.0], [4.0], (81,)), [[0.4]] * 40, 0.1, prior, gamma=GAMMA, controls=[[0.2]] * 40
    )
    np.testing.assert_allclose(whole.p[0], parts.p[-1], atol=1e-4)


@pytest.mark.slow
def test_stretched_axes_and_other_schemes():
    exact = riccati(
        np.array([[A]]), np.eye(1), np.ones(1), np.array([[Q]]), np.array([[C]]), GAMMA,
        start=(np.array([[K0]]), np.array([X0])), record=np.full((10, 1), 0.5), held=np.zeros((10, 1)), dt=0.1,
    )  # fmt: skip
    grid = hjb.Grid([-4.0], [4.0], (121,), stretch=(hjb.Sinh(2.0),))
    state = robust_filter(
        LAG, seen, grid, np.full((10, 1), 0.5), 0.1, prior, gamma=GAMMA, controls=np.zeros((10, 1)),
        scheme=hjb.Limited(),
    )  # fmt: skip
    np.testing.assert_allclose(state.worst_case, exact[1], atol=1e-4)
    np.testing.assert_allclose(state.value, exact[2], atol=1e-4)


# --- as an observer, in batches, in single precision ---


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*at an end of the box")
def test_the_observer_is_the_filter_and_records_come_in_batches():
    rng = np.random.default_rng(3)
    y, u = rng.normal(size=(4, 5, 2)), rng.uniform(-1, 1, (4, 5, 1))
    p0 = -rng.uniform(size=RING.shape)
    one = [filtered(p0, *each) for each in zip(y, u, strict=True)]
    with jax.enable_x64(True):
        many = jax.vmap(lambda y, u: filtered(p0, y, u))(y, u)
        observer = RobustGridFilter(PLANT, angle, RING, p0, 1.2, scheme=hjb.Upwind())
        assert isinstance(observer, Observer)
        state, update = observer.initial(), jax.jit(observer.update)
        for number in range(5):
            state = update(state, u[0, number], y[0, number] * 0.3, 0.3)
        estimate = observer.estimate(state)
    np.testing.assert_allclose(many.p, np.stack([each.p for each in one]), atol=1e-10)
    np.testing.assert_allclose(many.value, np.stack([each.value for each in one]), atol=1e-10)
    np.testing.assert_allclose(state, one[0].p[-1], atol=1e-10)
    np.testing.assert_allclose(estimate, one[0].worst_case[-1], atol=1e-9)


@pytest.mark.slow
def test_single_precision_follows():
    observer = RobustGridFilter(LAG, seen, hjb.Grid([-4.0], [4.0], (41,)), prior, GAMMA)
    state = observer.update(observer.initial(), jnp.zeros(1), jnp.array([0.05]), 0.1)
    assert state.dtype == jnp.float32
    exact = robust_filter(LAG, seen, observer.grid, [[0.5]], 0.1, prior, gamma=GAMMA, controls=[[0.0]])
    np.testing.assert_allclose(observer.estimate(state), exact.worst_case[-1], atol=1e-3)


@pytest.mark.slow
def test_a_function_that_reads_a_number_from_elsewhere_is_looked_at_again():
    class Gain:
        value = 1.0

    record = np.full((5, 1), 0.5)
    plant = hjb.Problem(lambda x, u: Gain.value * -x)
    grid = hjb.Grid([-3.0], [3.0], (31,))

    def largest():
        return robust_filter(plant, lambda x: x, grid, record, 0.2, prior, gamma=2.0, scheme=hjb.Upwind()).value[-1]

    first = largest()
    Gain.value = -1.0
    assert largest() != first


# --- refusals ---


def nan_record():
    record = np.zeros((5, 1))
    record[3] = np.nan
    return record


GAME = hjb.Problem(lambda x, u, d: u + d, None, hjb.Box([-1.0], [1.0]), disturbances=hjb.Box([-1.0], [1.0]))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"gamma": 0.0}, r"gamma = 0.0; wanted a finite number > 0"),
        ({"dt": -0.1}, r"dt = -0.1; wanted a finite number > 0, in units of time"),
        ({"y": nan_record()}, r"y\[3\] = \[nan\], wanted finite numbers"),
        ({"y": np.zeros(5)}, r"y has shape \(5,\), wanted \(k, 1\)"),
        ({"controls": None}, r"controls is None, but the problem has 1"),
        ({"controls": np.full((5, 1), np.inf)}, r"controls\[0\] = \[inf\], wanted finite numbers"),
        ({"h": lambda x: x[0]}, r"h\(x\) returned float64 numbers of shape \(\), wanted .* of shape \(p,\)"),
        ({"initial": lambda x: jnp.where(x[0] > 0, -jnp.inf, 0.0)}, r"initial is -inf at some node"),
        ({"initial": np.full(41, np.inf)}, r"initial is inf at some node"),
        ({"initial": np.zeros(40)}, r"initial has shape \(40,\), wanted \(41,\)"),
        (
            {"grid": hjb.Grid([-4.0], [4.0], (41,), edges="open")},
            r"got a grid with open ends, through which unknown values of p would flow in",
        ),
        ({"grid": hjb.Grid([-4.0], [4.0], (5,))}, r"axis 0 has 5 points; Weno5 needs at least 7"),
        ({"sigma": -1.0}, r"sigma = -1.0; wanted finite numbers ≥ 0"),
        ({"sigma": [1.0, 1.0]}, r"sigma has shape \(2,\), wanted \(\), \(1,\) or \(1, k\)"),
        ({"measurement_noise": 0.0}, r"got measurement_noise = 0.0, wanted finite numbers > 0"),
        ({"problem": GAME}, r"got a problem with an opponent, wanted drift \(x, u\)"),
        (
            {"problem": hjb.Problem(lambda t, x, u: u, None, LAG.controls, time_dependent=True)},
            r"got a problem with functions that depend on time",
        ),
    ],
)
def test_what_has_no_answer_is_refused(changes, reason):
    arguments = {
        "problem": LAG, "h": seen, "grid": hjb.Grid([-4.0], [4.0], (41,)), "y": np.zeros((5, 1)), "dt": 0.1,
        "initial": prior, "gamma": GAMMA, "controls": np.zeros((5, 1)),
    }  # fmt: skip
    with pytest.raises(ValueError, match="robust_filter: " + reason) as caught:
        robust_filter(**(arguments | changes))
    assert len(str(caught.value).splitlines()) <= 6


def test_correlated_disturbances_are_refused_with_the_way_out():
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (9, 9))
    plant = hjb.Problem(lambda x, u: x, noise=[[1.0], [0.5]])
    with pytest.raises(ValueError, match="wanted a diagonal one: each column of σ acts on one axis"):
        robust_filter(plant, lambda x: x, grid, np.zeros((2, 2)), 0.1, np.zeros((9, 9)), gamma=1.0)


def test_a_cost_without_bound_is_reported_with_its_time():
    plant = hjb.Problem(lambda x, u: 0 * x, lambda x, u: jnp.exp(jnp.exp(8 * x[0] ** 2)))
    with pytest.raises(ValueError, match=r"p is not finite from interval 0 on, t = 0 to 0.1: .* larger gamma"):
        robust_filter(plant, lambda x: x, hjb.Grid([-2.0], [2.0], (31,)), [[0.0]], 0.1, prior, gamma=1.0)


def test_an_interval_of_too_many_inner_steps_is_refused():
    """3.75 steps per unit time, a hundred thousand at most: 26 667 is the longest interval."""
    plant, grid = hjb.Problem(lambda x, u: -x), hjb.Grid([-4.0], [4.0], (9,))

    def filtered(dt):
        return robust_filter(
            plant, lambda x: 0 * x, grid, [[0.0]], dt, prior, gamma=1.0, sigma=0.0, scheme=hjb.Upwind()
        )

    assert np.all(np.isfinite(filtered(2.6e4).p))
    with pytest.raises(ValueError, match=r"dt = 27000 needs more than 100000 inner steps.* use a shorter interval"):
        filtered(2.7e4)


@pytest.mark.slow
def test_correlated_measurements_count_as_their_whitened_ones():
    root = np.array([[0.5, 0.0], [0.8, 1.5]])
    inverse = np.linalg.inv(root)

    def twice(x):
        return jnp.stack([x[0], jnp.sin(x[0])])

    def white(x):
        return inverse @ twice(x)

    grid, dy = hjb.Grid([-4.0], [4.0], (41,)), np.array([0.03, -0.02])
    observer = RobustGridFilter(LAG, twice, grid, prior, GAMMA, measurement_noise=root)
    beside = RobustGridFilter(LAG, white, grid, prior, GAMMA)
    p = observer.update(observer.initial(), jnp.zeros(1), jnp.asarray(dy), 0.1)
    wanted = beside.update(beside.initial(), jnp.zeros(1), jnp.asarray(np.linalg.solve(root, dy)), 0.1)
    assert np.max(np.abs(p - wanted)) < 1e-5 * np.max(np.abs(wanted))
