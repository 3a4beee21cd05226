"""solve under jit, vmap and grad, and what recompiles."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.iteration import adjoint
from hjbjax.problem.pytree import pytree_dataclass

TRACES = []


@pytree_dataclass()
class Cart:
    """A damped mass whose every number is a leaf; counts how often it is traced."""

    mass: float = 1.0
    damping: float = 0.3

    def drift(self, x, u):
        TRACES.append("drift")
        return jnp.stack([x[1], (u[0] - self.damping * x[1]) / self.mass])


@pytree_dataclass()
class Weights:
    scale: float = 1.0

    def cost(self, x, u):
        return self.scale * (x @ x) + 0.5 * u @ u

    def level(self, x):
        return jnp.max(jnp.abs(x)) - 0.3

    def exit(self, x):
        return self.scale * (0.2 + 0.1 * x[0])

    def stop(self, x):
        return self.scale * (0.6 + 0.2 * x[1])


GRID = hjb.Grid([-1.0, -1.2], [1.1, 1.0], (9, 10))
AT = (2, 7)


def question(*, mass=1.2, discount=0.8, noise=None, bound=1.0, exit_cost=None, scale=1.0, stopping=False, target=False):
    weights = Weights(scale)
    return hjb.Problem(
        Cart(mass).drift,
        weights.cost,
        hjb.Box([-bound], [bound]),
        noise=noise,
        discount=discount,
        target=weights.level if target else None,
        exit_cost=(weights.exit if exit_cost is None else exit_cost) if target else None,
        stopping_cost=weights.stop if stopping else None,
    )


def central_difference(function, at):
    step = 1e-4 * max(1.0, abs(at))
    return (function(at + step) - function(at - step)) / (2 * step)


def value_of(problem, grid=GRID):
    return hjb.solve(problem, grid, tol=1e-11, scheme=hjb.Upwind()).value


def test_changing_a_parameter_does_not_recompile():
    hjb.solve(question(mass=1.0), GRID, scheme=hjb.Upwind())
    TRACES.clear()
    values = [
        hjb.solve(question(mass=mass, discount=discount), GRID, scheme=hjb.Upwind()).value
        for mass, discount in [(1.3, 0.8), (2.0, 1.0)]
    ]
    two = len(TRACES)
    assert np.max(np.abs(values[0] - values[1])) > 0.01
    # what is left are the probes of one state, which compile nothing: the same number for every solve
    TRACES.clear()
    hjb.solve(question(mass=3.0), GRID, scheme=hjb.Upwind())
    assert two == 2 * len(TRACES)
    assert len(TRACES) <= 4  # of closures, shapes, structure and callbacks


PARAMETERS = {
    "mass": (1.2, lambda p: (question(mass=p), GRID)),
    "discount": (0.8, lambda p: (question(discount=p), GRID)),
    "noise": (0.5, lambda p: (question(noise=p), GRID)),
    "control bound": (0.6, lambda p: (question(bound=p), GRID)),
    "cost": (1.0, lambda p: (question(scale=p), GRID)),
    "lower end of the grid": (-1.2, lambda p: (question(), hjb.Grid(jnp.stack([-1.0, p]), [1.1, 1.0], GRID.shape))),
    "exit cost as a number": (0.4, lambda p: (question(target=True, exit_cost=p), GRID)),
    "mass, with a target": (1.2, lambda p: (question(target=True, mass=p), GRID)),
    "exit cost as a function": (1.0, lambda p: (question(target=True, scale=p), GRID)),
    "stopping cost": (1.0, lambda p: (question(stopping=True, scale=p), GRID)),
}


LONG = {"noise", "exit cost as a number", "mass, with a target"}


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(p, marks=[pytest.mark.slow] * (p in LONG)) for p in PARAMETERS])
def test_gradients_match_central_differences(name):
    at, build = PARAMETERS[name]

    def host(parameter):
        return float(value_of(*build(parameter))[AT])

    def traced(parameter):
        return hjb.solve(*build(parameter), tol=1e-11, scheme=hjb.Upwind()).value[AT]

    with jax.enable_x64(True):
        slope = float(jax.jit(jax.grad(traced))(jnp.asarray(at, jnp.float64)))
        wanted = central_difference(host, at)
    assert abs(wanted) > 1e-3
    assert slope == pytest.approx(wanted, rel=1e-5)


@pytest.mark.slow
def test_forward_and_reverse_mode_agree_and_a_game_is_differentiable():
    def traced(gamma):
        problem, grid = zoo.lq_game(gamma=gamma, discount=0.3, shape=(21,))
        return hjb.solve(problem, grid, tol=1e-11, scheme=hjb.Upwind()).value[4]

    with jax.enable_x64(True):
        gamma = jnp.asarray(2.0, jnp.float64)
        forward, reverse = jax.jit(jax.jacfwd(traced))(gamma), jax.jit(jax.jacrev(traced))(gamma)

        def host(gamma):
            problem, grid = zoo.lq_game(gamma=gamma, discount=0.3, shape=(21,))
            return float(hjb.solve(problem, grid, tol=1e-11, scheme=hjb.Upwind()).value[4])

        wanted = central_difference(host, 2.0)
    assert float(forward) == pytest.approx(float(reverse), rel=1e-9)
    assert float(reverse) == pytest.approx(wanted, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [hjb.PolicyIteration(hjb.Sweeps()), hjb.ValueIteration()],
    ids=["policy", "value"],
)
def test_jit_and_vmap_over_a_parameter_equal_single_solves(method):
    masses = np.array([0.8, 1.0, 1.7])

    def solved(mass):
        return hjb.solve(question(mass=mass), GRID, method=method, tol=1e-8, scheme=hjb.Upwind())

    single = [solved(mass) for mass in masses]
    with jax.enable_x64(True):
        batch = jax.jit(jax.vmap(solved))(jnp.asarray(masses, jnp.float64))
        alone = jax.jit(solved)(jnp.asarray(masses[0], jnp.float64))
        assert alone.value.dtype == jnp.float64
    for lane, solution in enumerate(single):
        np.testing.assert_allclose(batch.value[lane], solution.value, rtol=0, atol=1e-12)
        assert int(batch.steps[lane]) == solution.steps
        assert hjb.Status(int(batch.code[lane])) is hjb.Status.CONVERGED
    np.testing.assert_allclose(alone.value, single[0].value, rtol=0, atol=1e-12)
    np.testing.assert_allclose(batch.policy[1], single[1].policy, rtol=0, atol=1e-9)


def test_traced_solves_take_the_dtype_of_their_inputs():
    result = jax.jit(lambda mass: hjb.solve(question(mass=mass), GRID, tol=1e-2, scheme=hjb.Upwind()))(jnp.float32(1.2))
    assert result.value.dtype == jnp.float32
    assert np.max(np.abs(result.value - hjb.solve(question(), GRID, tol=1e-6, scheme=hjb.Upwind()).value)) <= 1e-2


def test_fixed_steps_under_jit_report_that_they_ran_out():
    result = jax.jit(lambda mass: hjb.solve(question(mass=mass), GRID, tol=1e-6, max_steps=1, scheme=hjb.Upwind()))(
        jnp.float32(1.2)
    )
    assert hjb.Status(int(result.code)) is not hjb.Status.CONVERGED


@pytree_dataclass()
class Wavy:
    """A drift and a cost that are not affine and quadratic in u, so that actions are sampled."""

    gain: object

    def drift(self, x, u):
        return self.gain * jnp.sin(2 * u) - 0.3 * x

    def cost(self, x, u):
        return jnp.sum(x * x + 0.3 * u * u + 0.05 * jnp.cos(97 * u + 9 * x))


@pytest.mark.slow
def test_the_gradient_is_that_of_the_policy_that_was_found():
    """Sampled actions may be better with the last step's among them: the derivative must take the same."""
    line = hjb.Grid([-1.0], [1.0], (21,))

    def value(gain):
        wavy = Wavy(gain)
        problem = hjb.Problem(wavy.drift, wavy.cost, hjb.Box([-1.0], [1.0]), discount=0.5)
        return jnp.sum(hjb.solve(problem, line, tol=1e-11, scheme=hjb.Upwind()).value)

    with jax.enable_x64(True):
        slope = float(jax.jit(jax.grad(value))(1.0))
        step = 1e-5
        plain = jax.jit(value)
        difference = float(plain(1.0 + step) - plain(1.0 - step)) / (2 * step)
    assert slope == pytest.approx(difference, rel=1e-5)


# --- linear solves that sweeps do not bring to their end ---


def spun_drift(rate, x, u):
    return jnp.stack([x[1], -rate * x[0] + 0.01 * u[0]])


def spun_cost(x, u):
    return x @ x


def spun_stop(scale, x):
    return scale * (2 + x[0])


def spun_value(numbers, tol=1e-9):
    """V of an oscillator that hardly anything damps: paths go round for 1/discount, or until they are stopped."""
    rate, discount, scale = numbers
    problem = hjb.Problem(
        jax.tree_util.Partial(spun_drift, rate), spun_cost, hjb.Box([-1.0], [1.0]), discount=discount,
        stopping_cost=jax.tree_util.Partial(spun_stop, scale),
    )  # fmt: skip
    return hjb.solve(problem, hjb.Grid([-2.0, -2.0], [2.0, 2.0], (9, 9)), tol=tol, scheme=hjb.Upwind()).value[5, 6]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the optimal drift leaves")
def test_the_gradient_is_right_where_sweeps_gain_little():
    """Without a stop that counts, and with one: rate, discount and stopping cost move the value."""
    at = np.array([[1.0, 1e-3, 1e6], [1.3, 1e-4, 200.0]])
    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(jax.grad(spun_value)))(at)
    for row, slopes in zip(at, np.asarray(found), strict=True):
        for j, slope in enumerate(slopes):
            step = 1e-4 * row[j] * np.eye(3)[j]
            rise = spun_value(row + step) - spun_value(row - step)
            assert slope == pytest.approx(rise / (2 * step[j]), rel=1e-4, abs=1e-6)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the optimal drift leaves")
def test_a_derivative_that_is_not_found_is_nan_and_the_value_stays(monkeypatch):
    monkeypatch.setattr(adjoint, "STEPS", 1)
    numbers = np.array([1.0, 1e-3, 1e6])
    anew = functools.partial(spun_value, tol=2e-9)  # a program of its own, not one kept since before the patch
    with jax.enable_x64(True):
        value, ahead = jax.jit(lambda at: jax.jvp(anew, (at,), (jnp.ones(3),)))(numbers)
    assert value == pytest.approx(spun_value(numbers), rel=1e-9)
    assert np.isnan(ahead)


def test_a_constraint_that_rounds_otherwise_is_the_same_constraint():
    psi = jnp.asarray(np.array([0.3, 1e9, -2.0, 0.0]), jnp.float32)
    one_off = jnp.nextafter(psi, jnp.float32(-1e30))
    assert np.all(adjoint._is_constraint(psi, one_off)[:3])
    assert np.all(adjoint._is_constraint(one_off, psi)[:3])
    assert np.all(adjoint._is_constraint(psi, psi))
    assert not np.any(adjoint._is_constraint(psi * 1.001 - 1e-3, psi))


@pytest.mark.parametrize("scheme", [hjb.Upwind(), pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.parametrize("read", ["value_at", "control_at"])
def test_second_derivatives_are_refused_and_not_made_up(scheme, read):
    """The rule of the first ones takes value, policy and operator as constants: by it the second would be wrong."""

    def number(price):
        problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + price * u @ u, hjb.Box([-4.0], [4.0]), discount=1.0)
        solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (11,)), scheme=scheme)
        return jnp.sum(getattr(solution, read)(jnp.array([0.5])))

    for second in (jax.hessian, lambda f: jax.grad(jax.grad(f)), lambda f: jax.jacfwd(jax.jacfwd(f))):
        with pytest.raises(NotImplementedError, match="second derivatives of a solve are not available"):
            jax.eval_shape(second(number), jnp.asarray(1.3))
    # of a first derivative by something that the solve does not depend on there is one
    value = jax.eval_shape(jax.grad(lambda x: jax.grad(lambda p: number(p) * x)(1.3)), jnp.asarray(2.0))
    assert value.shape == ()


@pytest.mark.slow
def test_second_derivatives_of_a_march_are_those_of_its_steps():
    def value(price):
        problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + price * u @ u, hjb.Box([-4.0], [4.0]))
        marched = hjb.march(problem, hjb.Grid([-1.0], [1.0], (11,)), 0.5, step=0.01, scheme=hjb.Upwind(split=True))
        return marched.value_at(0.0, jnp.array([0.5]))

    with jax.enable_x64(True):
        found = jax.hessian(value)(1.3)
        slope = jax.jit(jax.grad(value))
        wanted = (slope(1.3 + 1e-5) - slope(1.3 - 1e-5)) / 2e-5
    assert float(found) == pytest.approx(float(wanted), rel=1e-4)
