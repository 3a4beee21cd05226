"""Brackets, ranks and linearising feedback against identities, SymPy, flows and the verdicts of the literature.

Sources of the verdicts, by the abstracts and pages that were read:

- F. Jean, The car with n trailers: characterisation of the singular configurations, ESAIM COCV 1 (1996): the degree of
  nonholonomy is n + 2 where no two consecutive trailers are perpendicular, and the Fibonacci number F_{n+3} where all
  are. A degree d means that brackets of d fields, generation d − 1, are needed.
- J. Hauser, S. Sastry and P. Kokotović, Nonlinear control via approximate input-output linearization: the ball and
  beam example, IEEE TAC 37 (1992): its relative degree is not well defined. N. D. Tantaroudas, arXiv:2603.18947: the
  singularity appears in the third derivative of the output.
- K. Groves and A. Serrani, Modeling and Nonlinear Control of a Single-link Flexible Joint Manipulator, Ohio State
  University: state feedback makes the response of the tip angle that of a linear system.
- B. d'Andréa-Novel, J.-M. Coron and W. Perruquetti, arXiv:1905.11132: the unicycle fails Brockett's condition
  (tests/geometry/test_stability.py), although brackets span its state space.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from systems import SEEDS

import hjbjax as hjb
from hjbjax import geometry, zoo
from hjbjax.problem.pytree import pytree_dataclass

pytestmark = pytest.mark.usefixtures("float64")


@pytree_dataclass()
class Wave:
    """x ↦ a ∘ sin(B x + c): smooth, and no two commute."""

    a: object
    b: object
    c: object

    def field(self, x):
        return self.a * jnp.sin(self.b @ x + self.c)

    def height(self, x):
        return self.a @ jnp.cos(self.b @ x)


def random_waves(seed, count, n=3):
    rng = np.random.default_rng(seed)
    waves = [Wave(rng.normal(size=n), rng.normal(size=(n, n)), rng.normal(size=n)) for _ in range(count)]
    return waves, rng.normal(size=n)


def constant(vector):
    return lambda x: jnp.asarray(vector, x.dtype)


# Brackets


def test_the_sign_is_that_of_the_chapter():
    a, b, x = np.random.default_rng(0).normal(size=(3, 4, 4))
    bracket = geometry.lie_bracket(lambda x: a @ x, lambda x: b @ x)
    np.testing.assert_allclose(bracket(jnp.asarray(x[0])), (b @ a - a @ b) @ x[0], rtol=1e-12)


@jax.jit
def identities(f, g, h, x):
    """Antisymmetry, Jacobi's identity and L_[f,g] = L_f L_g − L_g L_f, as what is left of each."""
    bracket, derivative = geometry.lie_bracket, geometry.lie_derivative
    f_, g_, h_ = f.field, g.field, h.field
    cyclic = [bracket(a, bracket(b, c))(x) for a, b, c in ((f_, g_, h_), (g_, h_, f_), (h_, f_, g_))]
    twice = [derivative(a, derivative(b, h.height))(x) for a, b in ((f_, g_), (g_, f_))]
    commutator = derivative(bracket(f_, g_), h.height)(x) - (twice[0] - twice[1])
    return bracket(f_, g_)(x) + bracket(g_, f_)(x), sum(cyclic), commutator, jnp.stack(cyclic)


@given(SEEDS)
def test_brackets_obey_their_identities(seed):
    (f, g, h), x = random_waves(seed, 3)
    with jax.enable_x64(True):
        antisymmetry, jacobi, commutator, cyclic = identities(f, g, h, x)
    scale = 1e-12 * (1 + np.max(np.abs(cyclic)))
    assert np.all(np.abs(antisymmetry) <= scale)
    assert np.all(np.abs(jacobi) <= 10 * scale)
    assert np.abs(commutator) <= 100 * scale


def test_ad_nests_the_first_field():
    (f, g), x = random_waves(1, 2)
    np.testing.assert_array_equal(geometry.ad(f.field, g.field, 0)(x), g.field(x))
    by_hand = geometry.lie_bracket(f.field, geometry.lie_bracket(f.field, g.field))(x)
    np.testing.assert_allclose(geometry.ad(f.field, g.field, 2)(x), by_hand, rtol=1e-13)


def test_a_field_may_return_integers_and_the_state_may_be_a_list():
    assert geometry.lie_bracket(lambda x: jnp.array([1, 0]), lambda x: jnp.stack([x[1], x[0]]))([2, 3]).tolist() == [
        0,
        1,
    ]


# SymPy

SYSTEMS = {  # n, f, the fields, the output; each on SymPy's symbols and on JAX's numbers
    "parabola": (2, lambda x: [0, x[0] ** 2], [lambda x: [1, 0]], lambda x: x[1]),
    "heisenberg": (3, None, [lambda x: [1, 0, -x[1]], lambda x: [0, 1, x[0]]], lambda x: x[2]),
    "chained": (4, None, [lambda x: [1, 0, x[1], x[2]], lambda x: [0, 1, 0, 0]], lambda x: x[3] + x[0]),
    "lorenz": (
        3,
        lambda x: [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 3 * x[2]],
        [lambda x: [0, 0, 1]],
        lambda x: x[0] * x[1],
    ),
    "rigid body": (
        3,
        lambda x: [-x[1] * x[2], 2 * x[0] * x[2], -x[0] * x[1]],
        [lambda x: [1, 0, 0], lambda x: [0, 0, 1]],
        lambda x: x[0] ** 2 - x[2] ** 3,
    ),
}
POINTS = {2: [(0, 1), (2, -1)], 3: [(0, 0, 0), (1, 0, 0), (0, 0, 2), (2, -1, 3)], 4: [(0, 0, 0, 0), (1, 2, -1, 1)]}


def on_numbers(field):
    return None if field is None else lambda x: jnp.stack([jnp.asarray(entry, x.dtype) for entry in field(x)])


def symbolic_bracket(f, g, x):
    return g.jacobian(x) * f - f.jacobian(x) * g


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_brackets_and_ranks_are_those_of_sympy(name):
    n, f, gs, h = SYSTEMS[name]
    x = sympy.Matrix(sympy.symbols(f"x0:{n}"))
    symbols = [sympy.Matrix(field(x)) for field in ([f] if f else []) + gs]
    numeric = [on_numbers(field) for field in ([f] if f else []) + gs]
    generations, outputs = [symbols], [[sympy.Matrix([h(x)])]]
    for _ in range(2):
        generations.append([symbolic_bracket(a, b, x) for a in symbols for b in generations[-1]])
        outputs.append([y.jacobian(x) * a for a in symbols for y in outputs[-1]])
    for point in POINTS[n]:
        at = dict(zip(x, point, strict=True))
        state = jnp.asarray(point, float)
        for i, a in enumerate(numeric):
            for j, b in enumerate(numeric):
                wanted = symbolic_bracket(symbols[i], symbols[j], x).subs(at)
                np.testing.assert_allclose(geometry.lie_bracket(a, b)(state), np.array(wanted, float)[:, 0], atol=1e-12)
        for depth in range(3):
            reached = sympy.Matrix.hstack(*[v for some in generations[: depth + 1] for v in some]).subs(at)
            seen = sympy.Matrix.vstack(*[y.jacobian(x) for some in outputs[: depth + 1] for y in some]).subs(at)
            first, rest = (numeric[0], numeric[1:]) if f else (None, numeric)
            got = geometry.reachability_distribution(first, rest, point, depth)
            assert got.rank == reached.rank(), (point, depth)
            assert got.residue < 1e-12
            assert got.basis.shape == (n, got.rank)
            np.testing.assert_allclose(got.basis.T @ got.basis, np.eye(got.rank), atol=1e-12)
            observed = geometry.observability_codistribution(first, rest, h, point, depth)
            assert observed.rank == seen.rank(), (point, depth)


@pytest.mark.slow
def test_linear_systems_have_kalmans_ranks():
    rng = np.random.default_rng(3)
    a, b, c = rng.normal(size=(4, 4)), rng.normal(size=4), rng.normal(size=4)
    a[2:, :2], b[2:] = 0, 0  # the last two states are out of reach
    kalman = np.stack([np.linalg.matrix_power(a, k) @ b for k in range(4)])
    drift, push = (lambda x: a @ x), constant(b)
    # At the origin the drift adds nothing; elsewhere it is one of the fields.
    assert geometry.reachability_distribution(drift, push, np.zeros(4), 3).rank == np.linalg.matrix_rank(kalman) == 2
    assert geometry.observability_codistribution(drift, push, lambda x: c @ x, rng.normal(size=4), 3).rank == 4
    blind = geometry.observability_codistribution(drift, [], lambda x: x[3] + x[2], rng.normal(size=4), 3)
    assert blind.rank == 2


# The chapter's examples


def test_example_41_is_accessible_everywhere():
    f, gs = geometry.affine_fields(zoo.OneWay().drift, 1)
    for x1 in (-1.0, 0.3, 2.0):
        assert geometry.reachability_distribution(f, gs, [x1, 0.7], 0).rank == 2
    ranks = [geometry.reachability_distribution(f, gs, [0.0, 0.7], depth).rank for depth in (0, 1, 2)]
    assert ranks == [1, 1, 2]


@pytest.mark.slow
def test_example_42_is_observable_locally_and_not_globally():
    system = zoo.Angle()
    f, gs = geometry.affine_fields(system.drift, 1)
    for x in np.linspace(-7, 7, 15):
        assert geometry.observability_codistribution(f, gs, system.output, [x], 1).rank == 1
    ranks = [geometry.observability_codistribution(f, gs, system.output, [np.pi / 2], depth).rank for depth in (0, 1)]
    assert ranks == [0, 1]
    # Two states 2π apart have the same outputs under every input, since the input moves both alike.
    problem = hjb.Problem(system.drift, None, hjb.Box([-1.0], [1.0]))

    def wiggle(t, x):
        return jnp.sin(3 * t)[None]

    starts = (0.4, 0.4 + 2 * np.pi, 0.5)
    paths = [hjb.simulate(problem, wiggle, [start], 2.0, time_varying=True, rtol=1e-10) for start in starts]
    outputs = [np.array([system.output(jnp.asarray(x)) for x in path.states]) for path in paths]
    np.testing.assert_allclose(outputs[0], outputs[1], atol=1e-12)
    assert np.max(np.abs(outputs[0] - outputs[2])) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "start"), [(zoo.Unicycle(), [0.0, 0.0, 0.5]), (zoo.CarWithTrailers(), [0.0, 0.0, 0.5, 0.9])]
)
def test_the_switching_of_figure_6_ends_at_the_bracket(system, start):
    """(1,0), (0,1), (−1,0), (0,−1), each for τ, end at x + τ²[g₁,g₂] + O(τ³); the chapter prints ½τ²."""
    switches = jnp.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    problem = hjb.Problem(system.drift, None, hjb.Box([-1.0, -1.0], [1.0, 1.0]))
    _, (g1, g2) = geometry.affine_fields(system.drift, 2)
    bracket = geometry.lie_bracket(g1, g2)(jnp.asarray(start))
    errors, printed, taus = [], [], np.array([0.2, 0.1, 0.05, 0.025])
    for tau in taus:
        path = hjb.simulate(
            problem,
            Switching(switches, tau).control,
            start,
            4 * tau,
            hold=tau,
            time_varying=True,
            rtol=1e-11,
            atol=1e-13,
        )
        moved = path.states[-1] - np.asarray(start)
        errors.append(np.linalg.norm(moved - tau**2 * bracket))
        printed.append(np.linalg.norm(moved - 0.5 * tau**2 * bracket))
    assert np.polyfit(np.log(taus), np.log(errors), 1)[0] == pytest.approx(3, abs=0.15)
    assert np.polyfit(np.log(taus), np.log(printed), 1)[0] == pytest.approx(2, abs=0.15)


@pytree_dataclass()
class Switching:
    """The k-th control from kτ to (k + 1)τ; asked at the ends of the intervals alone."""

    controls: object
    tau: object

    def control(self, t, x):
        return self.controls[jnp.round(t / self.tau).astype(int) % 4]


# The verdicts of the literature


@pytest.mark.slow
def test_the_unicycle_reaches_everything_by_one_bracket_and_is_not_linearisable():
    f, gs = geometry.affine_fields(zoo.Unicycle().drift, 2)
    for theta in (0.0, 0.7, np.pi / 2):
        ranks = [geometry.reachability_distribution(None, gs, [1.0, 2.0, theta], depth).rank for depth in (0, 1)]
        assert ranks == [2, 3]
    verdict = geometry.is_feedback_linearisable(f, gs, np.zeros(3))
    assert not verdict.linearisable
    assert not verdict.independent  # without drift ad_f g = 0


def nonholonomy(trailers, angles, deepest):
    """The degree: how many fields the longest bracket needs for full rank."""
    _, gs = geometry.affine_fields(zoo.CarWithTrailers(trailers).drift, 2)
    state = np.concatenate([[0.3, -0.2], angles])
    for depth in range(deepest):
        if geometry.reachability_distribution(None, gs, state, depth).rank == trailers + 3:
            return depth + 1
    return None


@pytest.mark.slow
def test_a_car_with_one_trailer_has_degree_three_everywhere():
    for bend in (0.0, 0.6, np.pi / 2):
        assert nonholonomy(1, [0.4, 0.4 - bend], 4) == 3


@pytest.mark.slow
def test_a_car_with_two_trailers_is_harder_to_move_when_they_are_perpendicular():
    assert nonholonomy(2, [0.4, 0.1, -0.3], 5) == 4
    assert nonholonomy(2, [0.4, 0.4 - np.pi / 2, 0.4 - np.pi], 5) == 5


@pytest.mark.slow
def test_the_ball_and_beam_has_no_relative_degree_at_rest_and_is_not_linearisable():
    system = zoo.BallAndBeam()
    f, gs = geometry.affine_fields(system.drift, 1)
    rest = geometry.relative_degree(f, gs, system.output, np.zeros(4))
    assert rest.degree is None
    assert rest.degrees.tolist() == [3]  # 2B r θ̇ vanishes at rest and not near it
    assert "not defined: nearby 3" in rest.message
    away = geometry.relative_degree(f, gs, system.output, [0.5, 0.0, 0.1, 2.0])
    assert away.degree == 3
    assert away.decoupling == pytest.approx(2 * 5 / 7 * 0.5 * 2.0)
    assert "zero dynamics of dimension 1 on {h = L_f h = L_f^2 h = 0}" in away.message
    for state in (np.zeros(4), [0.5, 0.0, 0.1, 2.0]):
        verdict = geometry.is_feedback_linearisable(f, gs, state)
        assert verdict.independent
        assert not verdict.involutive
        assert verdict.involutivity > 1e3 * verdict.tolerance
        assert not verdict.linearisable
    # At the origin itself the bracket happens to vanish: only points nearby tell.
    assert geometry.is_feedback_linearisable(f, gs, np.zeros(4), samples=0).involutive


@pytest.mark.slow
def test_the_flexible_joint_is_linearised_by_feedback():
    system = zoo.FlexibleJoint(link=0.5, motor=0.2, weight=7.0, stiffness=100.0)
    f, gs = geometry.affine_fields(system.drift, 1)
    state = jnp.array([2.0, -1.0, 1.5, 0.7])
    verdict = geometry.is_feedback_linearisable(f, gs, state)
    assert verdict.linearisable
    assert verdict.ranks.tolist() == [1, 2, 3, 4]
    assert verdict.independence > 1e3 * verdict.tolerance
    assert geometry.relative_degree(f, gs, system.output, state).message == (
        "relative degree 4 of 4 states: no zero dynamics"
    )
    feedback = geometry.linearising_feedback(f, gs, system.output, state)
    xi, moved = pushed(feedback, jax.tree_util.Partial(zoo.FlexibleJoint.drift, system), state, jnp.ones(1))
    np.testing.assert_allclose(moved, [xi[1], xi[2], xi[3], 1.0], rtol=1e-9)
    # A spring without stiffness connects nothing.
    loose, gs = geometry.affine_fields(zoo.FlexibleJoint(stiffness=0.0).drift, 1)
    assert not geometry.is_feedback_linearisable(loose, gs, state).independent


# Linearisation


@jax.jit
def pushed(feedback, drift, x, v):
    """ξ and dξ/dt under α + β v."""
    return jax.jvp(feedback.coordinates, (x,), (drift(x, feedback.control(x, v)),))


@pytest.mark.slow
def test_a_linearised_flexible_joint_follows_a_linear_equation():
    """ξ = (q, q̇, q̈, q⃛) under v = −(s + 1)⁴ obeys e^{−t}(c₀ + c₁t + c₂t² + c₃t³)."""
    system = zoo.FlexibleJoint()
    feedback = geometry.linearising_feedback(*geometry.affine_fields(system.drift, 1), system.output, np.zeros(4))

    def control(x):
        return feedback.control(x, -jnp.array([[1.0, 4.0, 6.0, 4.0]]) @ feedback.coordinates(x))

    problem = hjb.Problem(system.drift, None, hjb.Box([-1e4], [1e4]))
    path = hjb.simulate(problem, control, [2.0, 0.0, 1.0, 0.0], 4.0, rtol=1e-10, atol=1e-12, steps=20)
    t = path.times
    companion = np.diag(np.ones(3), 1)
    companion[3] = [-1.0, -4.0, -6.0, -4.0]
    from scipy.linalg import expm

    start = np.asarray(feedback.coordinates(jnp.asarray(path.states[0])))
    exact = [(expm(companion * s) @ start)[0] for s in t]
    np.testing.assert_allclose(path.states[:, 0], exact, atol=1e-7)


@pytest.mark.slow
def test_an_arm_of_two_links_is_linearised_by_its_computed_torque():
    arm = zoo.Manipulator(links=2, masses=(1.3, 0.7))
    f, gs = geometry.affine_fields(arm.drift, 2)
    x, v = jnp.array([0.4, -1.2, 0.5, 2.0]), jnp.array([3.0, -1.0])
    degree = geometry.relative_degree(f, gs, lambda x: x[:2], x)
    assert degree.degrees.tolist() == [2, 2]
    assert degree.degree == 4
    feedback = geometry.linearising_feedback(f, gs, lambda x: x[:2], x)
    alpha, beta, coordinates = feedback
    torque, parts, xi = jax.jit(lambda: (feedback.control(x, v), alpha(x) + beta(x) @ v, coordinates(x)))()
    np.testing.assert_allclose(torque, arm.computed_torque(x[:2], x[2:], v), rtol=1e-10)
    np.testing.assert_allclose(parts, torque, rtol=1e-10)
    np.testing.assert_allclose(xi, x[jnp.array([0, 2, 1, 3])], rtol=1e-12)
    assert geometry.is_feedback_linearisable(f, gs, x, samples=2).ranks.tolist() == [2, 4]


@pytest.mark.parametrize("zero", [-2.0, 0.5])
@pytest.mark.slow
def test_zero_dynamics_are_the_zeros_of_a_linear_system(zero):
    """y = (s − zero)/(s³ + 2s² + 3s + 4) u has relative degree 2 and one zero."""
    a = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-4.0, -3.0, -2.0]])

    def output(x):
        return x[1] - zero * x[0]

    f, g = (lambda x: a @ x), constant([0.0, 0.0, 1.0])
    feedback = geometry.linearising_feedback(f, g, output, np.ones(3))
    assert feedback.degrees == (2,)
    assert feedback.message(3) == "relative degree 2 of 3 states: zero dynamics of dimension 1 on {h = L_f h = 0}"
    np.testing.assert_allclose(feedback.zero_spectrum(np.zeros(3)), [zero], atol=1e-10)
    with pytest.raises(ValueError, match="not a rest point"):
        feedback.zero_spectrum(np.ones(3))
    # On {ξ = 0} the zero dynamics stay there.
    inside = jnp.array([1.0, zero, zero**2])
    np.testing.assert_allclose(feedback.coordinates(inside), 0, atol=1e-12)
    rate = jax.jvp(feedback.coordinates, (inside,), (feedback.zero_dynamics(inside),))[1]
    np.testing.assert_allclose(rate, 0, atol=1e-12)


@pytest.mark.slow
def test_two_inputs_can_share_a_chain():
    """Brunovský's form with indices 3 and 1, hidden by a change of coordinates, is found again."""
    a = np.zeros((4, 4))
    a[0, 1] = a[1, 2] = 1.0
    b = np.zeros((4, 2))
    b[2, 0] = b[3, 1] = 1.0

    def bend(z):
        return jnp.stack([z[0], z[1] + z[0] ** 2, z[2] + jnp.sin(z[3]), z[3] + z[0] * z[1]])

    def straight(x):
        z1 = x[1] - x[0] ** 2
        z3 = x[3] - x[0] * z1
        return jnp.stack([x[0], z1, x[2] - jnp.sin(z3), z3])

    def drift(x, u):
        z = straight(x)
        return jax.jvp(bend, (z,), (a @ z + b @ u,))[1]

    f, gs = geometry.affine_fields(drift, 2)
    verdict = geometry.is_feedback_linearisable(f, gs, [0.2, -0.1, 0.4, 0.3])
    assert verdict.linearisable
    assert verdict.ranks.tolist() == [2, 3, 4]
    # With a third chain state that turns with the second input it is not.
    spoiled = geometry.affine_fields(lambda x, u: drift(x, u).at[0].add(x[3] * u[1] * x[2]), 2)
    assert not geometry.is_feedback_linearisable(*spoiled, [0.2, -0.1, 0.4, 0.3]).linearisable


@pytest.mark.slow
def test_decisions_can_be_traced():
    system = zoo.FlexibleJoint()
    x = jnp.array([0.3, 0.1, -0.2, 0.5])

    @jax.jit
    def verdicts(stiffness, x):
        spring = zoo.FlexibleJoint(stiffness=stiffness)
        f, gs = geometry.affine_fields(spring.drift, 1)
        reach = geometry.reachability_distribution(f, gs, x, 2)
        seen = geometry.observability_codistribution(f, gs, spring.output, x, 2)
        linear = geometry.is_feedback_linearisable(f, gs, x, samples=4)
        degree = geometry.relative_degree(f, gs, spring.output, x, samples=4)
        return reach.rank, reach.basis, seen.rank, linear.linearisable, linear.independent, degree.defined, reach.margin

    f, gs = geometry.affine_fields(system.drift, 1)
    rank, basis, seen, linear, independent, defined, margin = verdicts(10.0, x)
    plain = geometry.reachability_distribution(f, gs, x, 2)
    assert (int(rank), int(seen), bool(linear), bool(independent), bool(defined)) == (plain.rank, 3, True, True, True)
    np.testing.assert_allclose(np.abs(basis), np.abs(plain.directions * plain.counted), atol=1e-9)
    assert margin == pytest.approx(plain.margin)
    assert not verdicts(0.0, x)[3]


@pytest.mark.slow
def test_the_relative_degree_around_the_origin_can_be_found_inside_a_trace():
    f, g, h = (lambda x: jnp.stack([x[1], jnp.sin(x[0])])), constant([0.0, 2.0]), lambda x: x[0]
    feedback = geometry.linearising_feedback(f, g, h)
    x = jnp.array([0.4, -1.0])
    np.testing.assert_allclose(jax.jit(feedback.alpha)(x), -np.sin([0.4]) / 2, rtol=1e-12)
    np.testing.assert_allclose(feedback.alpha(x), -np.sin([0.4]) / 2, rtol=1e-12)
    assert feedback.message(2) == "relative degree 2 of 2 states: no zero dynamics"
    with pytest.raises(ValueError, match="x was not given"):
        jax.jit(lambda m: geometry.linearising_feedback(jax.tree_util.Partial(scaled, m), g, h).alpha(x))(2.0)


def scaled(m, x):
    return m * jnp.stack([x[1], x[0]])


@settings(max_examples=30)
@given(SEEDS)
def test_random_chains_are_linearised_exactly(seed):
    """ẋ₁ = x₂ + w(x₁), ẋ₂ = x₃ + w(x₁,x₂), ẋ₃ = w(x) + (2 + sin)u: ξ̇ = (ξ₂, ξ₃, v) at random states."""
    (wave,), x = random_waves(seed, 1)
    v = np.random.default_rng(seed).normal(size=1)
    with jax.enable_x64(True):
        xi, moved = chain_of(wave, x, v)
    np.testing.assert_allclose(moved, [xi[1], xi[2], v[0]], atol=1e-9 * (1 + np.max(np.abs(xi))))


@jax.jit
def chain_of(wave, x, v):
    rows = jnp.tril(wave.b)

    def f(x):
        return jnp.append(x[1:], 0.0) + wave.a * jnp.sin(rows @ x + wave.c)

    def g(x):
        return jnp.array([0.0, 0.0, 1.0]) * (2 + jnp.sin(x[0]))

    feedback = geometry.Linearisation((f, g), lambda x: x[0], (3,))
    rate = f(x) + g(x) * feedback.control(x, v)
    return feedback.coordinates(x), jax.jvp(feedback.coordinates, (x,), (rate,))[1]


# Refusals and margins


def test_a_rank_tells_how_clear_it_is():
    wobble = [constant([1.0, 1.0]), constant([1.0, 1.0 + 1e-6])]  # not (1, 1e-6): that is clear in other units
    clear = geometry.reachability_distribution(None, wobble, np.zeros(2), 0)
    assert clear.rank == 2
    assert clear.margin == pytest.approx(2.5e-7, rel=1e-3)
    blunt = geometry.reachability_distribution(None, wobble, np.zeros(2), 0, tolerance=1e-3)
    assert blunt.rank == 1
    assert blunt.residue == pytest.approx(2.5e-7, rel=1e-3)
    nothing = geometry.reachability_distribution(None, constant([0.0, 0.0]), np.zeros(2), 1)
    assert (nothing.rank, nothing.margin, nothing.basis.shape) == (0, 0.0, (2, 0))


def flat(x):
    return jnp.stack([x[1], 0.0])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: geometry.ad(flat, flat, -1), "k = -1"),
        (lambda: geometry.reachability_distribution(flat, [flat], np.zeros(2), 1.5), "depth = 1.5"),
        (
            lambda: geometry.reachability_distribution(flat, [flat], np.zeros(3), 1),
            "returned shape (2,), expected (3,)",
        ),
        (lambda: geometry.reachability_distribution(flat, [flat], [[0.0, 1.0]], 1), "one state"),
        (lambda: geometry.reachability_distribution(flat, [flat], [0.0, np.nan], 1), "finite numbers"),
        (lambda: geometry.reachability_distribution(None, lambda x: jnp.sqrt(x), [0.0, 1.0], 1), "not finite"),
        (lambda: geometry.reachability_distribution(flat, flat, np.zeros(2), 1, tolerance=0), "tolerance = 0"),
        (lambda: geometry.reachability_distribution(lambda x: x if x[0] > 0 else -x, [], np.zeros(2), 1), "jnp.where"),
        (lambda: geometry.affine_fields(lambda x, u: x, True), "inputs = True"),
        (lambda: geometry.linearising_feedback(flat, flat, lambda x: x[:2], np.ones(2)), "2 outputs and 1 inputs"),
        (
            lambda: geometry.linearising_feedback(flat, flat, lambda x: 0 * x[0], np.ones(2)),
            "no input above the tolerance",
        ),
        (lambda: geometry.linearising_feedback(flat, flat, lambda x: 0 * x[0]).alpha(jnp.ones(2)), "at the origin"),
    ],
)
def test_bad_input_is_refused(call, words):
    with pytest.raises(ValueError) as refusal:  # noqa: PT011
        call()
    assert words in str(refusal.value)
