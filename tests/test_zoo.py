"""The ready problems: their shapes, their exact answers against their own equations, their parameters as tracers."""

import inspect
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from hjbjax import fields, zoo
from hjbjax.sets import Ball, Finite

ENTRIES = list(zoo.catalogue.values())
WITH_ANSWER = [entry for entry in ENTRIES if entry.exact is not None]
FLOATS = [
    (entry, name) for entry in ENTRIES for name, default in entry.parameters.items() if isinstance(default, float)
]


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def name_of(value):
    return value.name if isinstance(value, zoo.Entry) else str(value)


def sample_state(grid, seed, shrink=0.9):
    """A random state of the box, away from its faces."""
    middle, half = (np.add(grid.hi, grid.lo)) / 2, (np.subtract(grid.hi, grid.lo)) / 2
    return jnp.asarray(middle + shrink * half * np.random.default_rng(seed).uniform(-1, 1, grid.ndim))


def some_input(admissible):
    """An admissible control that is not zero."""
    if admissible is None:
        return jnp.zeros(0)
    if isinstance(admissible, Ball):
        return jnp.full(admissible.dim, 0.3 * admissible.radius)
    return admissible.points[0] if isinstance(admissible, Finite) else 0.7 * admissible.hi + 0.3 * admissible.lo


def arguments(problem, x):
    return problem.arguments(x, some_input(problem.controls), some_input(problem.disturbances))


# --- every problem -------------------------------------------------------------------------------------------------


def test_the_catalogue_has_the_problems_under_hyphenated_names():
    expected = {
        "pendulum", "double-integrator", "double-integrator-lq", "manipulator", "stochastic-lq", "lq-game",
        "brownian-exit", "zermelo", "dubins", "van-der-pol", "bang-bang", "merton",
    }  # fmt: skip
    assert expected <= set(zoo.catalogue)
    for name, entry in zoo.catalogue.items():
        assert entry.name == name
        assert getattr(zoo, name.replace("-", "_")) is entry.build
        assert "\n" not in entry.summary
        assert 10 < len(entry.summary) <= 70


@pytest.mark.parametrize("entry", ENTRIES, ids=name_of)
def test_functions_have_the_promised_shapes(entry):
    problem, grid = entry.build()
    x = jnp.asarray(entry.initial_state(grid.ndim))
    assert np.all(x >= grid.lo)
    assert np.all(x <= grid.hi)
    inputs = arguments(problem, x)
    assert jax.eval_shape(problem.drift, *inputs).shape == (grid.ndim,)
    assert jax.eval_shape(problem.cost, *inputs).shape == ()
    assert problem.diffusion(*inputs[:2]).shape[0] == grid.ndim
    if problem.target is not None:
        assert jax.eval_shape(problem.target, x).shape == ()
        inside = jax.vmap(problem.target)(grid.nodes().reshape(-1, grid.ndim)) <= 0
        assert 0 < np.mean(inside) < 0.5
    if callable(problem.exit_cost):
        assert jax.eval_shape(problem.exit_cost, x).shape == ()


@pytest.mark.parametrize("entry", ENTRIES, ids=name_of)
def test_functions_are_evaluated_by_components(entry):
    # FallbackWarning is an error here, so this says that every primitive of the zoo has a component rule.
    problem, grid = entry.build()
    states = np.stack([np.asarray(sample_state(grid, seed)) for seed in range(3)])
    columns = list(jnp.asarray(states.T))
    functions = [(problem.drift, True), (problem.cost, True), (problem.target, False), (problem.exit_cost, False)]
    for function, acts in functions:
        if not callable(function):
            continue
        inputs = arguments(problem, jnp.asarray(states[0]))[1:] if acts else ()
        packed = [[entry for entry in one] for one in inputs]
        got = fields.components(function, columns, *packed, dtype=np.float64)
        wanted = np.asarray(jax.vmap(lambda x, f=function, inputs=inputs: f(x, *inputs))(states))
        rows = np.stack([np.broadcast_to(np.asarray(e), (3,)) for e in got.reshape(-1)], axis=-1)
        np.testing.assert_allclose(rows.reshape(wanted.shape), wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("entry", WITH_ANSWER, ids=name_of)
def test_the_answer_takes_the_keywords_of_the_problem(entry):
    given = {k: v.default for k, v in inspect.signature(entry.exact).parameters.items()}
    wanted = {k: v for k, v in entry.parameters.items() if k != "shape"}
    assert given == wanted


@pytest.mark.parametrize(("entry", "name"), FLOATS, ids=name_of)
def test_another_parameter_is_the_same_structure(entry, name):
    """So that it recompiles nothing."""
    problem, other = (entry.build(**{name: scale * entry.parameters[name]})[0] for scale in (1.0, 1.25))
    assert jax.tree.structure(problem) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(problem), jax.tree.leaves(other), strict=True):
        assert jnp.result_type(a) == jnp.result_type(b)
        assert jnp.shape(a) == jnp.shape(b)


@pytest.mark.parametrize(("entry", "name"), FLOATS, ids=name_of)
def test_a_parameter_may_be_a_tracer(entry, name):
    def evaluate(parameter):
        problem, grid = entry.build(**{name: parameter})
        inputs = arguments(problem, x)
        values = [problem.drift(*inputs), problem.cost(*inputs), problem.diffusion(*inputs[:2]), problem.discount]
        values += [f(x) for f in (problem.target, problem.exit_cost) if callable(f)]
        return [*values, *(jnp.asarray(bound) for bound in (grid.lo, grid.hi))]

    number = 1.25 * entry.parameters[name] or 0.25
    x = sample_state(entry.build()[1], 1)
    for traced, plain in zip(jax.jit(evaluate)(number), evaluate(number), strict=True):
        np.testing.assert_allclose(traced, plain, rtol=1e-12, atol=1e-12)


def test_a_new_mass_traces_nothing_anew():
    count = 0

    @jax.jit
    def push(problem, x, u):
        nonlocal count
        count += 1
        return problem.drift(x, u)

    x, u = jnp.array([0.4, 0.0]), jnp.array([3.0])
    pushes = [push(zoo.pendulum(mass=mass)[0], x, u)[1] - 9.81 * np.sin(0.4) for mass in (1.0, 2.0, 3.0)]
    np.testing.assert_allclose(pushes, [3.0, 1.5, 1.0])
    assert count == 1


def test_the_drift_is_differentiable_in_a_parameter():
    x, u = jnp.array([0.4, 0.0]), jnp.array([3.0])
    slope = jax.grad(lambda m: zoo.pendulum(mass=m)[0].drift(x, u)[1])(2.0)
    assert slope == pytest.approx(-3.0 / 2.0**2)
    lengths = jax.jacobian(lambda a: zoo.manipulator(links=2, lengths=a)[0].drift(jnp.ones(4), u.repeat(2)))(
        jnp.ones(2)
    )
    assert lengths.shape == (4, 2)
    assert np.all(np.isfinite(lengths))


def test_importing_the_zoo_loads_nothing_heavy():
    code = "import sys, hjbjax.zoo; print([m for m in ('scipy.linalg', 'matplotlib', 'diffrax') if m in sys.modules])"
    # JAX itself may load parts of SciPy; the zoo must not add any.
    base = (
        "import sys, jax, jax.numpy; print([m for m in ('scipy.linalg', 'matplotlib', 'diffrax') if m in sys.modules])"
    )
    outputs = [
        subprocess.run([sys.executable, "-c", c], capture_output=True, text=True, check=True) for c in (code, base)
    ]
    assert outputs[0].stdout == outputs[1].stdout


# --- the answers against their own equations -----------------------------------------------------------------------


def equation_residual(problem, value, x, candidates, opponents=None):
    """β V − min_u max_d [L + f·DV + ½ tr(σσ' D²V)] at one state, over the candidates given."""
    slope, curvature = jax.grad(value)(x), jax.hessian(value)(x)

    def rate(u, d):
        inputs = problem.arguments(x, u, d)
        sigma = problem.diffusion(*inputs)
        diffusive = 0.5 * jnp.sum((sigma @ sigma.T) * curvature) if sigma.shape[1] else 0.0
        return problem.cost(*inputs) + problem.drift(*inputs) @ slope + diffusive

    if opponents is None:
        best = jnp.min(jax.vmap(lambda u: rate(u, None))(candidates))
    else:
        best = jnp.min(jnp.max(jax.vmap(lambda u: jax.vmap(lambda d: rate(u, d))(opponents))(candidates), axis=1))
    return problem.discount * value(x) - best


def equation_residuals(problem, value, states, candidates, opponents=None):
    return jax.lax.map(lambda x: equation_residual(problem, value, x, candidates, opponents), states)


def directions(count):
    angles = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


ANSWERS = [
    ("bang-bang", {}, 1e-12),
    ("bang-bang", {"noise": 0.5**0.5, "discount": 0.7}, 1e-12),
    ("stochastic-lq", {}, 1e-5),
    ("stochastic-lq", {"rate": 0.3, "control_weight": 2.0, "state_weight": 1.5, "discount": 0.4}, 1e-5),
    ("double-integrator-lq", {}, 1e-5),
    ("double-integrator-lq", {"mass": 1.5, "discount": 0.6, "noise": 0.4, "control_weight": 2.0}, 1e-5),
    ("lq-game", {}, 1e-4),
    ("lq-game", {"gamma": 1.5, "rate": -0.4, "discount": 0.3}, 1e-4),
    ("brownian-exit", {}, 1e-11),
    ("brownian-exit", {"noise": 0.8, "discount": 0.5, "half_width": 1.3}, 1e-11),
    ("brownian-exit", {"dim": 2}, 1e-7),
    ("brownian-exit", {"dim": 2, "noise": 0.7, "discount": 1.1}, 1e-7),
    ("brownian-ball", {"dim": 3, "noise": 0.8}, 1e-12),
    ("double-integrator", {}, 1e-10),
    ("double-integrator", {"discount": 0.0, "mass": 1.7}, 1e-10),
    ("zermelo", {}, 1e-5),
    ("zermelo", {"speed": 1.2, "current": (-0.3, 0.6), "discount": 0.0}, 1e-5),
    ("eikonal", {}, 1e-5),
    ("eikonal", {"norm": 1, "dim": 3, "discount": 0.5}, 1e-12),
    ("eikonal", {"norm": np.inf, "speed": 2.0}, 1e-12),
    ("smooth", {}, 1e-5),
    ("smooth", {"discount": 1.5}, 1e-5),
    ("merton", {}, 1e-10),
    ("merton", {"growth": 0.06, "aversion": 3.0, "interest": 0.02}, 1e-10),
]


def candidate_controls(name, problem, parameters):
    if problem.controls is None:
        return np.zeros((1, 0))
    if isinstance(problem.controls, Finite):
        return problem.controls.points
    if name == "merton":
        known = {k: v for k, v in parameters.items() if k != "shape"}
        system = zoo.Merton(**known)
        best = [[float(system.share), float(system.consumption)]]
        return np.concatenate([best, problem.controls.grid((41, 37)).points])
    if isinstance(problem.controls, Ball):
        return directions(2000)
    if problem.is_game:
        return problem.controls.grid(1001).points
    return problem.controls.grid(3 if name in ("bang-bang", "double-integrator", "eikonal") else 4001).points


@pytest.mark.parametrize(("name", "parameters", "tolerance"), ANSWERS)
def test_the_answer_satisfies_its_equation(name, parameters, tolerance):
    entry = zoo.catalogue[name]
    problem, grid = entry.build(**parameters)
    value = entry.exact(**parameters)
    candidates = candidate_controls(name, problem, parameters)
    opponents = problem.disturbances.grid(1001).points if problem.is_game else None
    states = jnp.stack([sample_state(grid, seed) for seed in range(12)])
    if name == "brownian-ball":
        states = states * 0.5
    residual = jax.jit(equation_residuals)(problem, value, states, candidates, opponents)
    scale = np.maximum(1.0, np.abs(jax.vmap(value)(states)))
    assert np.max(np.abs(residual) / scale) < tolerance


@pytest.mark.parametrize("entry", WITH_ANSWER, ids=name_of)
def test_a_wrong_answer_does_not_satisfy_the_equation(entry):
    """The check above can fail: a value one per cent too steep does."""
    problem, grid = entry.build()
    value = entry.exact()
    candidates = candidate_controls(entry.name, problem, {})
    opponents = problem.disturbances.grid(1001).points if problem.is_game else None
    x = sample_state(grid, 5, shrink=0.6)
    off = jax.jit(lambda x: equation_residual(problem, lambda y: 1.01 * value(y), x, candidates, opponents))(x)
    assert abs(off) > 1e-3 * min(1.0, float(value(x)))


@pytest.mark.parametrize("entry", WITH_ANSWER, ids=name_of)
def test_the_answer_meets_the_exit_cost(entry):
    problem, grid = entry.build()
    if problem.target is None:
        return
    nodes = grid.nodes().reshape(-1, grid.ndim)
    inside = nodes[np.asarray(jax.vmap(problem.target)(nodes)) <= 0]
    exit_cost = jax.vmap(problem.exit_cost)(inside) if callable(problem.exit_cost) else problem.exit_cost or 0.0
    np.testing.assert_allclose(jax.vmap(entry.exact())(inside), exit_cost, atol=1e-5)


def test_known_numbers():
    time = zoo.double_integrator_exact(discount=0.0)
    assert float(time([1.0, 0.0])) == pytest.approx(2.0, abs=1e-14)
    assert float(time([0.0, 1.0])) == pytest.approx(1 + 2**0.5, abs=1e-14)
    assert float(time([1.0, 1.0])) == pytest.approx(3.4494897428, abs=1e-10)
    assert float(time([-0.5, 1.0])) == pytest.approx(1.0, abs=1e-7)
    assert float(zoo.double_integrator_exact()([1.0, 0.0])) == pytest.approx(1 - np.exp(-2))
    assert float(zoo.stochastic_lq_exact()([1.0])) == pytest.approx(2 * 0.6180339887, abs=1e-9)
    assert float(zoo.lq_game_exact()([1.0])) == pytest.approx(1.1547005384, abs=1e-10)
    assert float(zoo.merton_exact()([0.0])) == pytest.approx(493.8271605, abs=1e-7)
    assert float(zoo.Merton().share) == pytest.approx(0.5)
    assert float(zoo.Merton().consumption) == pytest.approx(0.045)
    assert float(zoo.brownian_exit_exact(dim=2)([0.0, 0.0])) == pytest.approx(0.589370826, abs=1e-9)
    matrix = jax.hessian(zoo.double_integrator_lq_exact())(jnp.zeros(2)) / 2
    np.testing.assert_allclose(matrix, [[3**0.5, 1], [1, 3**0.5]], atol=1e-12)


@pytest.mark.parametrize("discount", [0.0, 0.9])
def test_the_square_agrees_with_its_double_eigenseries(discount):
    x, noise = np.array([0.35, -0.2]), 0.8
    k = np.arange(1, 4001, 2)
    coefficient = 4 / (np.pi * k) * np.where(k % 4 == 1, 1.0, -1.0)
    wave = np.pi * k / 2
    rows = coefficient * np.cos(wave * x[0])
    columns = coefficient * np.cos(wave * x[1])
    rates = discount + 0.5 * noise**2 * (wave[:, None] ** 2 + wave[None, :] ** 2)
    series = rows @ (1 / rates) @ columns
    value = zoo.brownian_exit_exact(dim=2, noise=noise, discount=discount)
    assert float(value(x)) == pytest.approx(series, abs=1e-6)
    assert float(value(x[::-1])) == pytest.approx(float(value(x)), abs=1e-14)


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_least_time_is_two_arcs(position, velocity):
    """Full force to the switching curve, then along it: integrated piece by piece in closed form."""
    system = zoo.DoubleIntegrator()
    time = float(system.arrival_time(jnp.array([position, velocity])))
    side = position - float(system.switching_position(velocity))
    sign = -1.0 if side >= 0 else 1.0
    # v + s t₁ − s t₂ = 0 and t₁ + t₂ = T
    first, second = (time - sign * velocity) / 2, (time + sign * velocity) / 2
    assert first >= -1e-7
    assert second >= -1e-7
    middle = position + velocity * first + 0.5 * sign * first**2
    speed = velocity + sign * first
    end = middle + speed * second - 0.5 * sign * second**2
    assert end == pytest.approx(0.0, abs=1e-6)
    assert speed - sign * second == pytest.approx(0.0, abs=1e-12)
    assert middle == pytest.approx(float(system.switching_position(speed)), abs=1e-6)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_a_boat_arrives_when_the_water_brought_it_within_reach(a, b, east, north):
    boat = zoo.Boat(1.0, (east, north))
    time = float(boat.arrival_time(jnp.array([a, b])))
    assert time >= 0
    if np.isfinite(time):
        assert np.hypot(a + east * time, b + north * time) == pytest.approx(time, rel=1e-6, abs=1e-9)
    else:
        # The distance from the drifting origin stays above what the boat covers.
        later = np.linspace(0, 50, 5001)
        assert np.all(np.hypot(a + east * later, b + north * later) > later - 1e-6)


def test_the_discounted_time_of_the_unreachable_is_one():
    assert float(zoo.zermelo_exact(current=(2.0, 0.0))([1.0, 0.0])) == 1.0
    assert float(zoo.zermelo_exact(current=(2.0, 0.0))([-1.0, 0.0])) == pytest.approx(1 - np.exp(-1 / 3))
    assert float(zoo.zermelo_exact()([0.0, 0.0])) == 0.0


@pytest.mark.parametrize("discount", [1e-3, 1e-6, 1e-9])
def test_a_small_discount_tends_to_none(discount):
    for exact in (zoo.double_integrator_exact, zoo.zermelo_exact):
        x = [0.7, -0.4]
        assert float(exact(discount=discount)(x)) == pytest.approx(float(exact(discount=0.0)(x)), rel=4 * discount)
    one = float(zoo.brownian_exit_exact(discount=discount)([0.3]))
    assert one == pytest.approx(1 - 0.3**2, rel=2 * discount)


# --- mechanics -----------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("links", [1, 2, 3, 4])
def test_the_mass_matrix_is_symmetric_and_positive(links):
    rng = np.random.default_rng(links)
    arm = zoo.Manipulator(links=links, lengths=rng.uniform(0.5, 2, links), masses=rng.uniform(0.5, 2, links))
    q, w, tau = (jnp.asarray(rng.uniform(-3, 3, links)) for _ in range(3))
    matrix = np.asarray(arm.mass_matrix(q))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.min(np.linalg.eigvalsh(matrix)) > 0
    assert float(arm.kinetic_energy(q, w)) == pytest.approx(0.5 * w @ matrix @ w)
    # The drift solves (5.5).
    rates = arm.drift(jnp.concatenate([q, w]), tau)
    np.testing.assert_allclose(matrix @ rates[links:] + arm.coriolis(q, w) + arm.gravity(q), tau, atol=1e-9)
    np.testing.assert_array_equal(rates[:links], w)


@pytest.mark.parametrize("links", [1, 2, 3, 4])
def test_power_is_torque_times_velocity(links):
    rng = np.random.default_rng(10 + links)
    arm = zoo.Manipulator(links=links, masses=rng.uniform(0.5, 2, links))
    x, tau = jnp.asarray(rng.uniform(-3, 3, 2 * links)), jnp.asarray(rng.uniform(-9, 9, links))
    power = jax.grad(arm.energy)(x) @ arm.drift(x, tau)
    assert float(power) == pytest.approx(float(x[links:] @ tau), rel=1e-9, abs=1e-9)
    # V − ½ Ṁ w does no work: Ṁ − 2C is skew for any C with C w = V.
    q, w = x[:links], x[links:]
    _, change = jax.jvp(arm.mass_matrix, (q,), (w,))
    assert float(w @ (arm.coriolis(q, w) - 0.5 * change @ w)) == pytest.approx(0.0, abs=1e-9)


def test_one_link_is_the_pendulum():
    arm, pendulum = zoo.Manipulator(masses=[2.0]), zoo.Pendulum(mass=2.0)
    x, u = jnp.array([0.7, -1.2]), jnp.array([3.0])
    np.testing.assert_allclose(arm.drift(x, u), pendulum.drift(x, u), rtol=1e-12)


@given(*[st.floats(-3, 3) for _ in range(4)])
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


@pytest.mark.parametrize("links", [1, 2, 3])
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


def test_van_der_pol_is_van_der_pol():
    rates = zoo.VanDerPol(1.5).drift(jnp.array([0.5, 2.0]), jnp.array([0.25]))
    np.testing.assert_allclose(rates, [2.0, 1.5 * 0.75 * 2.0 - 0.5 + 0.25])


def test_dubins_drives_ahead():
    rates = zoo.Dubins(2.0).drift(jnp.array([0.0, 0.0, np.pi / 6]), jnp.array([0.3]))
    np.testing.assert_allclose(rates, [3**0.5, 1.0, 0.3])


# --- refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: zoo.lq_game_exact(gamma=1.0), "gamma = 1, wanted a level above"),
        (lambda: zoo.lq_game_exact(gamma=0.5, rate=-0.1), "gamma = 0.5"),
        (lambda: zoo.merton(aversion=1.0), "aversion = 1"),
        (lambda: zoo.brownian_exit_exact(dim=3), "dim = 3, wanted 1 or 2"),
        (lambda: zoo.eikonal(norm=3), "norm = 3, wanted 1, 2 or infinity"),
        (lambda: zoo.eikonal(dim=3, directions=8), "directions with dim = 3"),
        (lambda: zoo.Manipulator(links=0), "links = 0"),
        (lambda: zoo.Manipulator(links=2, masses=[1.0]), "masses: got 1 numbers, wanted 2"),
        (lambda: zoo.manipulator(links=2, shape=(20, 21)), "lengths 4, 4, 2"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_damped_game_is_solvable_below_one():
    """With enough damping the disturbance is attenuated below 1: the least level is 1/√(1 + a²)."""
    value = zoo.lq_game_exact(gamma=0.8, rate=-1.0)
    problem, _ = zoo.lq_game(gamma=0.8, rate=-1.0)
    opponents = problem.disturbances.grid(2001).points
    residual = equation_residual(problem, value, jnp.array([0.6]), problem.controls.grid(2001).points, opponents)
    assert abs(residual) < 1e-4
