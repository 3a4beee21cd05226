"""The mechanical systems against textbook formulas, energy and the linear theory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import hjbjax as hjb
from hjbjax import zoo


def test_the_pendulum_rests_upright_on_a_node():
    problem, grid = zoo.pendulum()
    upright = grid.state((grid.shape[0] // 2, grid.shape[1] // 2))
    assert upright.tolist() == [0.0, 0.0]
    assert problem.drift(upright, np.zeros(1)).tolist() == [0.0, 0.0]
    assert float(problem.cost(upright, np.zeros(1))) == 0.0
    assert grid.periodic == (True, False)
    assert problem.discount == 0.0


def test_the_two_readings_of_the_pendulum():
    x, u = jnp.zeros(2), jnp.ones(1)
    corrected, printed = zoo.pendulum(mass=2.0)[0], zoo.pendulum(mass=2.0, as_printed=True)[0]
    assert float(corrected.drift(x, u)[1]) == pytest.approx(1 / 2)
    assert float(printed.drift(x, u)[1]) == pytest.approx(9.81 / 2)
    assert corrected.controls.hi.tolist() == [30.0]
    assert printed.controls.hi.tolist() == [6.0]


@pytest.mark.parametrize("parameters", [{}, {"mass": 2.0, "discount": 0.1}, {"as_printed": True}])
def test_the_pendulum_is_quadratic_near_upright(parameters):
    problem, _ = zoo.pendulum(**parameters)
    value = zoo.pendulum_near_upright(**parameters).value
    gain = problem.drift.args[0].gain

    def residual(x):
        u = -gain * jax.grad(value)(x)[1:]
        return float(problem.discount * value(x) - problem.cost(x, u) - problem.drift(x, u) @ jax.grad(value)(x))

    near, far = residual(jnp.array([0.05, -0.1])), residual(jnp.array([0.1, -0.2]))
    assert abs(far) > 1e-7
    assert far / near == pytest.approx(16, rel=0.02)


@pytest.mark.parametrize(
    "links", [1, 2, pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow)]
)
def test_the_mass_matrix_is_symmetric_and_positive(links):
    rng = np.random.default_rng(links)
    arm = zoo.Manipulator(links=links, lengths=rng.uniform(0.5, 2, links), masses=rng.uniform(0.5, 2, links))
    q, w, tau = (jnp.asarray(rng.uniform(-3, 3, links)) for _ in range(3))

    @jax.jit
    def evaluate(q, w, tau):
        energy, rates = arm.kinetic_energy(q, w), arm.drift(jnp.concatenate([q, w]), tau)
        return arm.mass_matrix(q), energy, rates, arm.coriolis(q, w) + arm.gravity(q)

    matrix, energy, rates, forces = map(np.asarray, evaluate(q, w, tau))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.min(np.linalg.eigvalsh(matrix)) > 0
    assert float(energy) == pytest.approx(0.5 * w @ matrix @ w)
    # The drift solves (5.5).
    np.testing.assert_allclose(matrix @ rates[links:] + forces, tau, atol=1e-9)
    np.testing.assert_array_equal(rates[:links], w)


@pytest.mark.parametrize(
    "links", [1, 2, pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow)]
)
def test_power_is_torque_times_velocity(links):
    rng = np.random.default_rng(10 + links)
    arm = zoo.Manipulator(links=links, masses=rng.uniform(0.5, 2, links))
    x, tau = jnp.asarray(rng.uniform(-3, 3, 2 * links)), jnp.asarray(rng.uniform(-9, 9, links))
    power = jax.grad(arm.energy)(x) @ arm.drift(x, tau)
    assert float(power) == pytest.approx(float(x[links:] @ tau), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    "links", [1, 2, pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow)]
)
def test_the_coriolis_matrix_makes_the_rate_of_the_masses_skew(links):
    rng = np.random.default_rng(20 + links)
    arm = zoo.Manipulator(links=links, lengths=rng.uniform(0.5, 2, links), masses=rng.uniform(0.5, 2, links))
    q, w = jnp.asarray(rng.uniform(-3, 3, links)), jnp.asarray(rng.uniform(-3, 3, links))

    @jax.jit
    def parts(q, w):
        return arm.coriolis_matrix(q, w), arm.coriolis(q, w), jax.jvp(arm.mass_matrix, (q,), (w,))[1]

    matrix, torques, change = parts(q, w)
    np.testing.assert_allclose(matrix @ w, torques, atol=1e-9)
    skew = change - 2 * matrix
    np.testing.assert_allclose(skew, -skew.T, atol=1e-9)


@pytest.mark.parametrize(
    "links", [1, 2, pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow)]
)
def test_computed_torque_gives_the_acceleration_asked_for(links):
    rng = np.random.default_rng(30 + links)
    arm = zoo.Manipulator(links=links, lengths=rng.uniform(0.5, 2, links), masses=rng.uniform(0.5, 2, links))
    q, w, wanted = (jnp.asarray(rng.uniform(-3, 3, links)) for _ in range(3))

    @jax.jit
    def moved(q, w, acceleration):
        return arm.drift(jnp.concatenate([q, w]), arm.computed_torque(q, w, acceleration))[links:]

    np.testing.assert_allclose(moved(q, w, wanted), wanted, atol=1e-8)


@pytest.mark.slow
def test_an_arm_under_computed_torque_is_linear():
    """Upright from hanging: each joint obeys θ̈ + 3θ̇ + 2θ = 0, the closed form of (2.7)."""
    arm, start = zoo.Manipulator(links=2, masses=(1.3, 0.7)), np.array([3.0, -0.5, 0.0, 1.0])
    problem = hjb.Problem(arm.drift, None, hjb.Box([-999.0] * 2, [999.0] * 2))
    path = hjb.simulate(problem, arm.tracking(), start, 4.0, steps=40, rtol=1e-11, atol=1e-12)
    slow, fast = 2 * start[:2] + start[2:], -(start[:2] + start[2:])
    t = path.times[:, None]
    np.testing.assert_allclose(path.states[:, :2], slow * np.exp(-t) + fast * np.exp(-2 * t), atol=1e-8)


def circle(t):
    return jnp.stack([0.5 * jnp.sin(2 * t), jnp.cos(t)])


@pytest.mark.slow
def test_an_arm_tracks_a_motion_by_computed_torque():
    """The error from the motion obeys ë + 3ė + 2e = 0, and is zero on the motion itself."""
    arm = zoo.Manipulator(links=2)
    problem = hjb.Problem(arm.drift, None, hjb.Box([-999.0] * 2, [999.0] * 2))
    path = hjb.simulate(
        problem, arm.tracking(circle), [0.0, 1.3, 1.0, 0.0], 6.0, time_varying=True, steps=30, rtol=1e-11, atol=1e-12
    )
    error = path.states[:, :2] - np.stack([0.5 * np.sin(2 * path.times), np.cos(path.times)], axis=-1)
    np.testing.assert_allclose(error[:, 0], 0, atol=1e-8)
    np.testing.assert_allclose(error[:, 1], 0.3 * (2 * np.exp(-path.times) - np.exp(-2 * path.times)), atol=1e-8)


def test_one_link_is_the_pendulum():
    arm, pendulum = zoo.Manipulator(masses=[2.0]), zoo.Pendulum(mass=2.0)
    x, u = jnp.array([0.7, -1.2]), jnp.array([3.0])
    np.testing.assert_allclose(arm.drift(x, u), pendulum.drift(x, u), rtol=1e-12)


@given(*[st.floats(-3, 3) for _ in range(4)])
@pytest.mark.slow
def test_two_links_are_the_textbook_arm(q1, q2, w1, w2):
    """Craig's two-link arm with point masses at the ends; his first angle is from the horizontal, ours from upright."""
    m1, m2, l1, l2, g = 1.3, 0.7, 0.9, 1.4, 9.81
    arm = zoo.Manipulator(links=2, lengths=(l1, l2), masses=(m1, m2), g=g)
    q, w = jnp.array([q1, q2]), jnp.array([w1, w2])
    c2, s2 = np.cos(q2), np.sin(q2)
    off = m2 * l2**2 + m2 * l1 * l2 * c2
    matrix = [[m2 * l2**2 + 2 * m2 * l1 * l2 * c2 + (m1 + m2) * l1**2, off], [off, m2 * l2**2]]
    bias = [-m2 * l1 * l2 * s2 * (w2**2 + 2 * w1 * w2), m2 * l1 * l2 * s2 * w1**2]
    fold = -m2 * l2 * g * np.sin(q1 + q2)
    np.testing.assert_allclose(arm.mass_matrix(q), matrix, atol=1e-10)
    np.testing.assert_allclose(arm.coriolis(q, w), bias, atol=1e-10)
    np.testing.assert_allclose(arm.gravity(q), [fold - (m1 + m2) * l1 * g * np.sin(q1), fold], atol=1e-10)


@pytest.mark.parametrize(
    "links", [1, 2, pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow)]
)
def test_energy_is_conserved_without_torque(links):
    arm = zoo.Manipulator(links=links)
    drift = jax.jit(arm.drift)
    start = np.concatenate([np.linspace(1.0, 0.4, links), np.zeros(links)])
    flow = solve_ivp(lambda t, x: np.asarray(drift(x, np.zeros(links))), (0, 3), start, rtol=1e-10, atol=1e-10)
    energies = [float(arm.energy(jnp.asarray(x))) for x in flow.y.T[:: max(1, flow.y.shape[1] // 10)]]
    assert flow.success
    assert np.ptp(energies) < 1e-6
    assert np.ptp(flow.y[0]) > 1


def test_the_manipulator_problem_grows_with_its_links():
    problem, grid = zoo.manipulator(links=2)
    assert grid.ndim == 4
    assert grid.periodic == (True, True, False, False)
    assert problem.controls.dim == 2
    upright = grid.state([count // 2 for count in grid.shape])
    np.testing.assert_array_equal(upright, 0)
    np.testing.assert_allclose(problem.drift(upright, np.zeros(2)), 0, atol=1e-12)
    assert zoo.catalogue["manipulator"].initial_state(4) == (2.0, 0.0, 0.0, 0.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:simulate. the path costs")  # V is far off on so few nodes
def test_one_link_is_raised_as_the_pendulum_is():
    shape = (24, 25)
    (arm, grid), (pendulum, _) = zoo.manipulator(shape=shape), zoo.pendulum(shape=shape)
    solution = hjb.solve(arm, grid, tol=1e-3, scheme=hjb.Upwind())
    np.testing.assert_allclose(
        solution.value, hjb.solve(pendulum, grid, tol=1e-3, scheme=hjb.Upwind()).value, atol=2e-3
    )
    path = hjb.simulate(arm, solution, [2.0, 0.0], 6.0, clamp=True, hold=0.02)
    assert np.cos(path.states[-1, 0]) > 0.999
    assert abs(path.states[-1, 1]) < 0.01


@pytest.mark.slow
def test_the_manipulator_of_the_catalogue_raises_its_arm_and_with_a_discount_of_one_half_it_does_not():
    """Under β = .5 hanging down costs ½π²/β = 9.9 at most, and raising the arm 32."""
    entry = zoo.catalogue["manipulator"]
    angles = []
    for parameters in ({}, {"discount": 0.5}):
        problem, grid = entry.build(**parameters)
        solution = hjb.solve(problem, grid, scheme=hjb.Upwind())
        path = hjb.simulate(problem, solution, entry.initial_state(grid.ndim), entry.duration)
        angles.append(np.cos(path.states[-40:, 0]))
    raised, hanging = angles
    assert raised.min() > 0.999
    assert hanging.max() < -0.3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:simulate. the path costs")  # V is far off on so few nodes
def test_two_links_are_solved_in_four_dimensions():
    """To a certified error, at zero cost upright, as the mirror image of itself; and the feedback holds the arm up."""
    problem, _ = zoo.manipulator(links=2, g=1.0, torque=8.0, discount=0.1)
    problem = hjb.Problem(problem.drift, problem.cost, problem.controls.grid(5), discount=problem.discount)
    ends = np.array([np.pi, np.pi, 3.0, 3.0])
    grid = hjb.Grid(-ends, ends, (14, 14, 11, 11), periodic=(True, True, False, False))
    solution = hjb.solve(problem, grid, tol=1e-1, scheme=hjb.Upwind())
    assert solution.error <= 1e-1
    assert solution.value[7, 7, 5, 5] == 0.0
    mirrored = np.roll(np.flip(solution.value), 1, axis=(0, 1))
    np.testing.assert_allclose(mirrored, solution.value, atol=2e-1)
    path = hjb.simulate(problem, solution, [0.4, -0.2, 0.0, 0.0], 10.0, clamp=True, hold=0.02)
    left = hjb.simulate(problem, lambda x: jnp.zeros(2), [0.4, -0.2, 0.0, 0.0], 10.0)
    assert np.all(np.cos(path.states[:, :2]) > 0.8)
    assert np.min(np.cos(left.states[:, 0])) < -0.9
    assert path.cost < left.cost


def test_one_length_is_for_all_links():
    x, u = jnp.linspace(0.1, 0.6, 4), jnp.ones(2)
    np.testing.assert_array_equal(
        zoo.Manipulator(links=2, lengths=0.7).drift(x, u), zoo.Manipulator(links=2, lengths=(0.7, 0.7)).drift(x, u)
    )


def test_van_der_pol_is_van_der_pol():
    rates = zoo.VanDerPol(1.5).drift(jnp.array([0.5, 2.0]), jnp.array([0.25]))
    np.testing.assert_allclose(rates, [2.0, 1.5 * 0.75 * 2.0 - 0.5 + 0.25])


def test_dubins_drives_ahead():
    rates = zoo.Dubins(2.0).drift(jnp.array([0.0, 0.0, np.pi / 6]), jnp.array([0.3]))
    np.testing.assert_allclose(rates, [3**0.5, 1.0, 0.3])


def test_a_quadrotor_hovers_falls_and_leans():
    quadrotor = zoo.PlanarQuadrotor(mass=2.0, inertia=0.5)
    x = jnp.array([0.3, -0.2, 0.0, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(quadrotor.drift(x, jnp.array([quadrotor.hover, 0.0])), [1, 2, 3, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(quadrotor.drift(x, jnp.array([0.0, 1.0])), [1, 2, 3, 0, -9.81, 2], atol=1e-12)
    leant = quadrotor.drift(x.at[2].set(np.pi / 2), jnp.array([4.0, 0.0]))
    np.testing.assert_allclose(leant, [1, 2, 3, -2, -9.81, 0], atol=1e-12)
    # energy: power is that of the thrust along the speed and of the torque
    u = jnp.array([3.0, 0.7])
    for angle in (0.4, -2.0):
        x = x.at[2].set(angle)
        rate, (vx, vz, w) = quadrotor.drift(x, u), x[3:]
        power = 2.0 * (vx * rate[3] + vz * rate[4]) + 2.0 * 9.81 * vz + 0.5 * w * rate[5]
        np.testing.assert_allclose(power, u[0] * (-vx * np.sin(angle) + vz * np.cos(angle)) + u[1] * w, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.optimised
def test_a_quadrotor_has_its_mirror_image_and_six_dimensions_fit():
    """A tube on 8^6 nodes in single precision, the value alone: even under x, θ, ẋ, θ̇ → −x, −θ, −ẋ, −θ̇."""
    quadrotor = zoo.PlanarQuadrotor()
    tube = hjb.reach(quadrotor.drift, hjb.Box([0.0, -0.4], [2 * quadrotor.hover, 0.4]), near_the_origin)
    grid = hjb.Grid(
        [-2.0, -2.0, -np.pi, *[-4.0] * 3],
        [2.0, 2.0, np.pi, *[4.0] * 3],
        (8,) * 6,
        (False,) * 2 + (True,) + (False,) * 3,
    )
    options = {"scheme": hjb.Upwind(), "dtype": "float32"}
    found = hjb.march(tube, grid, 0.05, policy=False, **options)
    value = found.value[0]
    # the angle has a node at −π and none at π: its mirror image is itself, and the others are turned round
    turned = np.roll(np.flip(value, (0, 2, 3, 5)), 1, axis=2)
    np.testing.assert_allclose(turned, value, atol=1e-5)
    level = np.asarray(jax.vmap(near_the_origin)(grid.nodes().reshape(-1, 6)[:, :])).reshape(grid.shape)
    assert np.all(value <= level + 1e-6)
    assert np.min(value - level) < -0.05
    assert found.stats["bytes"] <= 17 * grid.size


def near_the_origin(x):
    return jnp.hypot(x[0], x[1]) - 0.5
