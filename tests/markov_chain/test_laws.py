"""Laws of the chain against SciPy's matrix exponential and dense null spaces, Gauss, Poisson and detailed balance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm, null_space
from scipy.stats import poisson
from systems import SEEDS, random_grid, random_problem

import hjbjax as hjb
from hjbjax.markov_chain import chain

pytestmark = pytest.mark.usefixtures("float64")
KINDS = [(1, "scalar"), (2, "matrix")]
UNIT = hjb.Box([-1.0], [1.0])


def random_law(rng, shape):
    law = rng.exponential(size=shape)
    return law / law.sum()


# --- the stationary law ---


@pytest.mark.parametrize(("n", "kind"), KINDS)
@given(seed=SEEDS)
@settings(max_examples=15)
def test_the_stationary_law_spans_the_null_space(n, kind, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    problem, policy = random_problem(rng, grid, kind), rng.uniform(-1, 1, (*grid.shape, 1))
    generator = chain.generator(problem, grid, policy).toarray()
    kernel = null_space(generator.T, rcond=1e-10)
    assume(kernel.shape[1] == 1)
    law = chain.stationary_law(problem, grid, policy)
    assert law.shape == grid.shape
    np.testing.assert_allclose(law.ravel(), kernel[:, 0] / kernel[:, 0].sum(), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("drift", "sigma"), [(-1.0, 0.8), (0.3, 1.0), (0.0, 0.5)])
def test_detailed_balance_of_a_birth_and_death_chain(drift, sigma):
    """μ_{i+1}/μ_i = c⁺_i/c⁻_{i+1}, with c± = f±/h + σ²/2h² inside and σ²/h² + |f|/h inwards at a wall."""
    grid = hjb.Grid([0.0], [2.0], (9,))
    h = 0.25
    up, down = (np.full(9, max(f, 0) / h + sigma**2 / (2 * h**2)) for f in (drift, -drift))
    up[0], down[-1] = max(drift, 0) / h + sigma**2 / h**2, max(-drift, 0) / h + sigma**2 / h**2
    exact = np.cumprod(np.append(1.0, up[:-1] / down[1:]))
    problem = hjb.Problem(lambda x, u: drift + 0 * x, noise=sigma)
    law = chain.stationary_law(problem, grid, scheme=hjb.Upwind(central=False))
    np.testing.assert_allclose(law, exact / exact.sum(), rtol=1e-12)
    density = chain.stationary_density(problem, grid, scheme=hjb.Upwind(central=False))
    np.testing.assert_allclose(law, density * grid.volumes(), rtol=1e-12)


@pytest.mark.parametrize("rate", [0.5, 2.0])
def test_a_mass_at_an_end_stays_a_mass(rate):
    """Debts grow and shrink with an income between two levels; a share of the law sits at the borrowing limit.

    Wealth moves with the income z, an Ornstein–Uhlenbeck process. The marginal law of z is the law of its own chain,
    and the mass at the limit does not shrink with the spacing of the wealth.
    """
    shares = []
    for count in (41, 81, 161):
        grid = hjb.Grid([0.0, -1.0], [2.0, 1.0], (count, 11), edges=("constrained", "projected"))
        income = hjb.Problem(
            lambda x, u: jnp.stack([x[1] + u[0] - 0.3 * x[0], -rate * x[1]]), noise=[0.0, 0.4], controls=UNIT
        )
        z = grid.nodes()[..., 1]
        policy = np.where((grid.nodes()[..., 0] == 0) & (z < 0), -z, 0.0)
        policy = np.where((grid.nodes()[..., 0] == 2) & (z > 0.6), 0.6 - z, policy)[..., None]
        law = chain.stationary_law(income, grid, policy)
        shares.append(law[0].sum())
        line = hjb.Grid([-1.0], [1.0], (11,))
        np.testing.assert_allclose(
            law.sum(axis=0), chain.stationary_law(hjb.Problem(lambda x, u: -rate * x, noise=0.4), line), atol=1e-12
        )
    assert shares[0] > 0.1
    assert abs(shares[2] - shares[1]) < 0.6 * abs(shares[1] - shares[0]) < 0.1


def mean_under_the_law(p, grid, f=jnp.sum):
    """A smooth function of the law of dx = (p₀ − p₁ x + u) dt + p₂ dw under u = −p₃ x³."""
    problem = hjb.Problem(lambda x, u: p[0] - p[1] * x + u, noise=p[2], controls=hjb.Box([-9.0], [9.0]))
    x = jnp.asarray(grid.axis(0))
    law = chain.stationary_law(problem, grid, -p[3] * x[:, None] ** 3)
    return f(law * jnp.cos(x))


@pytest.mark.slow
def test_derivatives_of_the_stationary_law():
    grid, p = hjb.Grid([-2.0], [2.0], (21,)), np.array([0.3, 1.2, 0.9, 0.4])
    forward, reverse = jax.jacfwd(mean_under_the_law)(p, grid), jax.grad(mean_under_the_law)(p, grid)
    steps = 1e-5 * np.eye(4)
    exact = [float(mean_under_the_law(p + e, grid) - mean_under_the_law(p - e, grid)) / 2e-5 for e in steps]
    np.testing.assert_allclose(forward, exact, rtol=1e-6)
    np.testing.assert_allclose(reverse, exact, rtol=1e-6)
    lanes = jax.jit(jax.vmap(lambda p: mean_under_the_law(p, grid)))(np.stack([p, 2 * p]))
    np.testing.assert_allclose(lanes, [mean_under_the_law(p, grid), mean_under_the_law(2 * p, grid)], rtol=1e-12)


def test_a_law_that_is_not_unique_is_nan_inside_a_program():
    def law(speed):
        return chain.stationary_law(hjb.Problem(lambda x, u: speed * x), hjb.Grid([-1.0], [1.0], (5,)))

    assert np.all(np.isnan(jax.jit(law)(1.0)))  # paths end at both ends
    np.testing.assert_array_equal(jax.jit(law)(-1.0), [0, 0, 1, 0, 0])
    with pytest.raises(ValueError, match=r"^stationary_law: got 3 recurrent classes"):
        law(1.0)


# --- the law forward in time ---


@pytest.mark.parametrize(("n", "kind"), KINDS)
@given(seed=SEEDS, horizon=st.sampled_from([1e-3, 0.3, 20.0]))
@settings(max_examples=15)
def test_the_matrix_exponential(n, kind, seed, horizon):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    problem, policy = random_problem(rng, grid, kind), rng.uniform(-1, 1, (*grid.shape, 1))
    start, times = random_law(rng, grid.shape), [0.0, horizon / 3, horizon]
    found = chain.evolve(problem, grid, policy, start, horizon, times=times)
    generator = chain.generator(problem, grid, policy).toarray()
    for t, law in zip(times, found, strict=True):
        np.testing.assert_allclose(law.ravel(), expm(t * generator.T) @ start.ravel(), rtol=0, atol=1e-12)
    assert found.min() >= 0
    np.testing.assert_allclose(found.sum(axis=tuple(range(1, n + 1))), 1, rtol=0, atol=1e-13)


@pytest.mark.parametrize(("speed", "horizon"), [(1.0, 3.0), (4.0, 1.0), (0.1, 100.0)])
def test_a_pure_birth_chain_counts_as_poisson(speed, horizon):
    """At speed f the chain jumps up at the rate f/h, so its number of jumps is Poisson with mean f t/h."""
    grid = hjb.Grid([0.0], [40.0], (81,))
    law = chain.evolve(hjb.Problem(lambda x, u: speed + 0 * x), grid, None, np.eye(81)[0], horizon)[0]
    np.testing.assert_allclose(law[:60], poisson.pmf(np.arange(60), speed * horizon / 0.5), rtol=0, atol=1e-14)
    assert law[-1] == pytest.approx(poisson.sf(79, speed * horizon / 0.5), abs=1e-14)  # absorbed at the end


@pytest.mark.parametrize(("rate", "sigma", "m"), [(1.0, 0.7, 1.0), (0.4, 0.5, -1.5)])
def test_moments_of_ornstein_uhlenbeck(rate, sigma, m):
    """Central differences are exact for x and x², so the moments of the chain are exact up to the walls."""
    grid, times = hjb.Grid([-6.0], [6.0], (121,)), np.array([0.2, 1.0, 5.0])
    x = np.asarray(grid.axis(0))
    start = np.where(np.isclose(x, m), 1.0, 0.0)
    laws = chain.evolve(hjb.Problem(lambda x, u: -rate * x, noise=sigma), grid, None, start, 5.0, times=times)
    mean = laws @ x
    np.testing.assert_allclose(mean, m * np.exp(-rate * times), rtol=1e-7)
    variance = sigma**2 / (2 * rate) * -np.expm1(-2 * rate * times)
    np.testing.assert_allclose(laws @ x**2 - mean**2, variance, rtol=1e-7)


@pytest.mark.parametrize("stiffness", [1.0, 1e5])
def test_rates_of_any_size(stiffness):
    """Two nodes exchange at the rate σ²/h²: μ₀(t) = ½ (1 + e^{−2σ²t/h²}); thousands of jumps change no digit."""
    sigma = np.sqrt(stiffness)
    law = chain.evolve(
        hjb.Problem(lambda x, u: 0 * x, noise=sigma), hjb.Grid([0.0], [1.0], (2,)), None, [1.0, 0.0], 0.1
    )
    exact = 0.5 * (1 + np.exp(-0.2 * stiffness))
    np.testing.assert_allclose(law[0], [exact, 1 - exact], rtol=1e-11)


def test_a_policy_of_a_march_is_second_order_in_its_times():
    """The rates of u(t, x) = −(1 + sin 3t) x, between its times linear, against SciPy's integrator."""
    grid = hjb.Grid([-2.0], [2.0], (17,))
    problem = hjb.Problem(lambda x, u: u, noise=0.8, controls=hjb.Box([-9.0], [9.0]))
    x, start = np.asarray(grid.axis(0)), np.eye(17)[3]
    plain = hjb.Upwind(central=False)
    generators = [chain.generator(problem, grid, -k * x[:, None], scheme=plain).toarray().T for k in (0.0, 1.0)]

    def flow(t, law):  # the rates are linear in the gain of this feedback
        gain = 1 + np.sin(3 * t)
        return ((1 - gain) * generators[0] + gain * generators[1]) @ law

    exact = solve_ivp(flow, (0, 1.0), start, rtol=1e-11, atol=1e-13, method="LSODA").y[:, -1]
    errors = []
    for k in (6, 11, 21, 41):
        times = np.linspace(0, 1, k)
        policy = -(1 + np.sin(3 * times))[:, None, None] * x[:, None]
        law = chain.evolve(problem, grid, policy, start, 1.0, policy_times=times, scheme=plain)[0]
        errors.append(np.abs(law - exact).max())
    assert -np.polyfit(np.arange(4) * np.log(2), np.log(errors), 1)[0] == pytest.approx(2, abs=0.15)


def test_a_drift_that_depends_on_time():
    """dx = t dt + σ dw: the mean is t²/2, exactly, since the mean of t over a step is its middle."""
    grid, times = hjb.Grid([-4.0], [6.0], (101,)), np.linspace(0, 1.5, 7)
    problem = hjb.Problem(lambda t, x, u: t + 0 * x, noise=0.6, time_dependent=True)
    laws = chain.evolve(problem, grid, None, np.eye(101)[40], 1.5, policy_times=times, times=times[2:])
    np.testing.assert_allclose(laws @ np.asarray(grid.axis(0)), times[2:] ** 2 / 2, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="time-dependent problem without policy_times"):
        chain.evolve(problem, grid, None, np.eye(101)[40], 1.5)


def test_a_target_keeps_what_arrives():
    """From the middle of (0, 1) at speed 1 without noise all mass is in the target at last, and none returns."""
    grid = hjb.Grid([0.0], [1.0], (11,))
    problem = hjb.Problem(lambda x, u: 1 + 0 * x, noise=0.5, target=lambda x: 0.85 - x[0])
    law = chain.evolve(problem, grid, None, np.eye(11)[5], 50.0)[0]
    assert law[9:].sum() == pytest.approx(1, abs=1e-12)
    assert law[10] == 0.0  # nothing passes the first node of the target


@pytest.mark.parametrize(("find", "lose"), [(1.5, 1.0), (0.2, 0.7)])
def test_modes_are_the_first_axis_of_a_law(find, lose):
    """Two modes: the share of the first is s + (1 − s) e^{−(a + b) t}, s = b/(a + b), whatever the state does."""
    grid, times = hjb.Grid([-2.0], [2.0], (21,)), np.array([0.0, 0.4, 3.0])
    problem = hjb.Problem(
        lambda x, u, mode: jnp.stack([1.0, -2.0])[mode] - x, noise=0.4,
        modes=hjb.Modes(("up", "down"), rates=[[0.0, find], [lose, 0.0]]),
    )  # fmt: skip
    start = np.stack([np.eye(21)[10], np.zeros(21)])
    laws = chain.evolve(problem, grid, None, start, 3.0, times=times)
    share = lose / (find + lose)
    exact = share + (1 - share) * np.exp(-(find + lose) * times)
    np.testing.assert_allclose(laws[:, 0].sum(axis=1), exact, rtol=0, atol=1e-12)
    law = chain.stationary_law(problem, grid)
    np.testing.assert_allclose(law.sum(axis=1), [share, 1 - share], rtol=1e-12)
    generator = chain.generator(problem, grid).toarray()
    np.testing.assert_allclose(generator.T @ law.ravel(), 0, atol=1e-10)
    np.testing.assert_allclose(laws[-1].ravel(), expm(3.0 * generator.T) @ start.ravel(), rtol=0, atol=1e-12)
    # m' = up share − down share − m, in the mean
    assert law.sum(axis=0) @ np.asarray(grid.axis(0)) == pytest.approx(share - 2 * (1 - share), abs=0.05)


@pytest.mark.parametrize("timed", [pytest.param(False, marks=pytest.mark.slow), True])
def test_laws_inside_programs(timed):
    grid, times = hjb.Grid([-2.0], [2.0], (13,)), np.array([0.0, 0.5, 1.0])
    x, start = np.asarray(grid.axis(0)), np.eye(13)[4]

    def law(p):
        problem = hjb.Problem(lambda x, u: u - p[1] * x, noise=p[0], controls=UNIT)
        policy = -p[2] * jnp.asarray(x)[:, None]
        if timed:
            policy = policy * jnp.cos(jnp.asarray(times))[:, None, None]
        options = {"policy_times": times} if timed else {}
        return chain.evolve(problem, grid, policy, start, 1.0, times=[0.3, 1.0], **options)

    p = np.array([0.7, 0.4, 0.3])
    known = law(p)
    np.testing.assert_allclose(jax.jit(law)(p), known, rtol=0, atol=1e-14)
    lanes = jax.vmap(law)(np.stack([p, 2 * p]))
    np.testing.assert_allclose(lanes[1], law(2 * p), rtol=0, atol=1e-14)
    slopes = jax.jacfwd(law)(p)
    for k, e in enumerate(1e-6 * np.eye(3)):
        np.testing.assert_allclose(slopes[..., k], (law(p + e) - law(p - e)) / 2e-6, rtol=0, atol=1e-8)


def test_single_precision_inside_a_program():
    def law(sigma):
        return chain.evolve(hjb.Problem(lambda x, u: -x, noise=sigma), hjb.Grid([-2.0], [2.0], (33,)), None, start, 3.0)

    start = np.eye(33)[8]
    with jax.enable_x64(False):
        found = jax.jit(law)(jnp.float32(0.9))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, law(0.9), rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"horizon": 0.0}, "horizon = 0.0; wanted a finite number > 0"),
        ({"times": [0.5, 0.5]}, "times is .*increasing"),
        ({"times": [0.5, 1.5]}, r"times are from 0.5 to 1.5, wanted them in \[0, 1\]"),
        ({"policy_times": [0.0, 0.5]}, r"policy_times are from 0 to 0.5, wanted them to cover \[0, 1\]"),
        ({"policy_times": [0.0, 0.5, 1.0]}, r"got a policy of shape \(5, 1\) for 3 policy_times"),
        ({"law": np.ones(4)}, r"got a law of shape \(4,\), wanted \(5,\)"),
        ({"law": np.array([1.0, -1, 1, np.nan, 0])}, "negative or not finite at 2 nodes"),
        ({"policy": np.zeros((5, 2))}, r"got a policy of shape \(5, 2\)"),
    ],
)
def test_refusals(changes, reason):
    grid, problem = hjb.Grid([0.0], [1.0], (5,)), hjb.Problem(lambda x, u: u, noise=0.5, controls=UNIT)
    given = {"policy": np.zeros((5, 1)), "law": np.ones(5) / 5, "horizon": 1.0} | changes
    with pytest.raises(ValueError, match=reason) as caught:
        chain.evolve(problem, grid, **given)
    assert len(str(caught.value).splitlines()) <= 6
