"""Problems that separate: the blocks that are found, values against joint grids, bounds and refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

INTEGRATORS = {
    "drift": lambda x, u: jnp.stack([x[1], u[0], x[3], u[1]]),
    "controls": hjb.Box([-1.0] * 2, [1.0] * 2),
}


def squares(x, u):
    return x @ x + u @ u


@pytest.mark.slow
def test_decoupled_double_integrators_have_the_riccati_value():
    """P = [[√3, 1], [1, √3]] for each; limited slopes are exact on a quadratic."""
    problem = hjb.Problem(cost=squares, **{**INTEGRATORS, "controls": hjb.Box([-9.0] * 2, [9.0] * 2)})
    parts = hjb.decompose(problem, 4)
    assert (parts.states, parts.controls, parts.rule, parts.bound) == (((0, 1), (2, 3)), ((0,), (1,)), "sum", None)
    solution = parts.solve(hjb.Grid([-1.0] * 4, [1.0] * 4, (41,) * 4))
    p = np.array([[np.sqrt(3), 1], [1, np.sqrt(3)]])
    x = np.array([[0.3, -0.1, 0.2, 0.2], [-0.2, 0.1, 0.0, 0.3]])
    exact = np.einsum("ki,ij,kj->k", x[:, :2], p, x[:, :2]) + np.einsum("ki,ij,kj->k", x[:, 2:], p, x[:, 2:])
    assert np.allclose(solution.value_at(x), exact, atol=0.02)
    assert solution.status is hjb.Status.CONVERGED
    gain = np.array([[1, np.sqrt(3), 0, 0], [0, 0, 1, np.sqrt(3)]])
    assert np.allclose(solution.control_at(x), -x @ gain.T, atol=0.05)
    assert np.allclose(jax.jit(solution.value_at)(jnp.asarray(x)), solution.value_at(x), atol=1e-5)
    slope = np.concatenate([2 * x[:, :2] @ p, 2 * x[:, 2:] @ p], axis=1)
    assert np.allclose(solution.costate_at(x), slope, atol=0.1)
    path = hjb.simulate(problem, lambda x: solution.control_at(x, clamp=True), x[0], 8.0, steps=40)
    assert abs(path.cost - exact[0]) < 0.02


@pytest.mark.slow
def test_a_saved_solution_of_blocks_comes_back(tmp_path):
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-3.0] * 2, [3.0] * 2), discount=1.0,
        control_names=("left", "right"),
    )  # fmt: skip
    solution = hjb.decompose(problem, 2).solve(hjb.Grid([-1.0] * 2, [1.0] * 2, (41, 41)))
    x = np.array([0.3, -0.6])
    exact = 0.6180339887 * x @ x
    assert abs(solution.value_at(x) - exact) < 2e-3
    assert solution.grid_error_at(x) < 5e-3
    solution.save(tmp_path / "blocks")
    back = hjb.BlockSolution.load(tmp_path / "blocks")
    assert back.value_at(x) == solution.value_at(x)
    assert (back.rule, back.states, back.controls) == ("sum", ((0,), (1,)), ((0,), (1,)))
    joint = solution.on_grid(hjb.Grid([-1.0] * 2, [1.0] * 2, (5, 5)))
    assert joint.labels.controls == ("left", "right")
    assert np.allclose(joint.value_at([0.5, 0.0]), solution.value_at([0.5, 0.0]))


@pytest.mark.parametrize(
    ("cost", "parts"),
    [
        (lambda x: jnp.maximum(jnp.linalg.norm(x[:2]), jnp.abs(x[2]) + x[3] ** 2) - 0.5, "max"),
        (lambda x: -jnp.min(-jnp.stack([x[0] * x[1], 2.0 * x[2]])), "max"),
        (lambda x: -0.5 * jnp.maximum(x[0], x[2]), "min"),
        (lambda x: jnp.cos(x[0]) + 3 * x[1] ** 2 - jnp.sum(x[2:] ** 2), "sum"),
    ],
)
def test_the_rule_and_the_parts_are_read_from_the_trace(cost, parts):
    problem = hjb.Problem(terminal_cost=cost, **INTEGRATORS)
    found = hjb.decompose(problem, 4)
    assert found.rule == parts
    assert found.states == ((0, 1), (2, 3))
    x = np.random.default_rng(0).normal(size=4)
    values = [float(own.terminal_cost(x[list(at)])) for own, at in zip(found.problems, found.states, strict=True)]
    combined = {"max": max, "min": min, "sum": sum}[parts](values)
    assert abs(combined - float(cost(x))) < 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_blocks_of_matrices_are_found_in_any_order(seed):
    """Matrices that the functions close over: their zeros are known."""
    draw, sizes, m = np.random.default_rng(seed), (3, 2, 1), 3
    state, control = draw.permutation(6), draw.permutation(m)
    mine = np.repeat(np.arange(3), sizes)[state]  # the block of each state
    own = np.arange(m)[control]
    a, q = (draw.normal(size=(6, 6)) * (mine[:, None] == mine) for _ in range(2))
    b = draw.normal(size=(6, m)) * (mine[:, None] == own)
    cost = lambda x, u: x @ q @ x + 2 * u @ u + 0.7  # noqa: E731
    problem = hjb.Problem(lambda x, u: a @ x + b @ u, cost, hjb.Box([-1.0] * m, [1.0] * m), discount=1.0)
    found = hjb.decompose(problem, 6)
    blocks = sorted(tuple(np.nonzero(mine == k)[0].tolist()) for k in range(3))
    assert sorted(found.states) == blocks
    x, u = draw.normal(size=6), draw.normal(size=m)
    total = 0.0
    for part, states, controls in zip(found.problems, found.states, found.controls, strict=True):
        own_x, own_u = x[list(states)], u[list(controls)]
        total += float(part.cost(own_x, own_u))
        assert np.allclose(part.drift(own_x, own_u), (a @ x + b @ u)[list(states)], atol=1e-5)
        assert set(mine[list(states)]) == set(own[list(controls)])
    assert abs(total - cost(x, u)) < 1e-5


FACTOR, MASK = 2.0, np.array([True, False, True, False])


@pytest.mark.parametrize(
    "change",
    [
        {"drift": lambda x, u: jnp.stack([x[1] + 0 * x[2], u[0], x[3] + 0.0 * x[0] * u[0], u[1]])},
        {"drift": lambda x, u: jnp.where(MASK, x[jnp.array([1, 2, 3, 0])], u[jnp.array([0, 0, 1, 1])])},
        {"cost": lambda x, u: squares(x, u) + 0.0 * x[0] * x[2]},
        {"cost": None, "terminal_cost": lambda x: -FACTOR * jnp.minimum(-jnp.abs(x[0]) + 0.1, x[2]) - 0.4},
        {"cost": None, "terminal_cost": lambda x: jnp.abs(x[0]) - 0.5, "running_max": lambda x: x[2] ** 2 - 0.3},
    ],
)
def test_known_factors_couple_nothing(change):
    assert hjb.decompose(hjb.Problem(**{**INTEGRATORS, "cost": squares, **change}), 4).states == ((0, 1), (2, 3))


def test_the_coupling_comes_first_in_the_message():
    """Two chains of five states with one common term."""
    chains = lambda x, u: jnp.concatenate([x[1:5], u[:1], x[6:], u[1:]])  # noqa: E731
    problem = hjb.Problem(chains, lambda x, u: squares(x, u) + 0.1 * x[2] * x[7], INTEGRATORS["controls"], discount=1.0)
    with pytest.raises(ValueError, match=r"nothing to decompose:\n  cost has a term that reads x\[2\], x\[7\]"):
        hjb.decompose(problem, 10)


def test_a_mere_bound_must_be_asked_for():
    problem = hjb.avoid(
        lambda x, u: u, hjb.Box([-1.0] * 2, [1.0] * 2), lambda x: jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1])) - 0.5
    )
    with pytest.raises(ValueError, match="upper bound of V; pass bound=True"):
        hjb.decompose(problem, 2)
    assert hjb.decompose(problem, 2, bound=True).bound == "upper"


@pytest.mark.slow
def test_inputs_and_states_without_effect_keep_their_places():
    """V = (√5 − 1)/2 (x₀² + x₁²) for x' = u; u₂ only costs, and x₂ has no effect."""
    problem = hjb.Problem(
        lambda x, u: jnp.append(u[:2], -x[2]), lambda x, u: x[0] ** 2 + x[1] ** 2 + u @ u,
        hjb.Box([-3.0, -3.0, 0.5], [3.0] * 3), discount=1.0,
    )  # fmt: skip
    solution = hjb.decompose(problem, 3).solve(hjb.Grid([-1.0] * 3, [1.0] * 3, (41,) * 3))
    x, p = np.array([0.3, -0.6, 0.9]), 0.6180339887
    assert abs(solution.value_at(x) - p * (x[0] ** 2 + x[1] ** 2) - 0.25) < 2e-3
    assert np.allclose(solution.control_at(x), [-p * x[0], -p * x[1], 0.5], atol=0.02)
    assert np.allclose(solution.costate_at(x), [2 * p * x[0], 2 * p * x[1], 0], atol=0.02)
    assert solution.ndim == 3


def test_a_finite_set_stays_whole():
    problem = hjb.Problem(
        lambda x, u: -x + jnp.stack([u[0], 0 * u[0]]), lambda x, u: x @ x + u[0] ** 2,
        hjb.Finite([[0.0, 0.0], [1.0, 1.0]]), discount=1.0,
    )  # fmt: skip
    found = hjb.decompose(problem, 2)
    assert (found.states, found.controls) == (((0,), (1,)), ((0, 1), ()))
    assert found.problems[0].controls.dim == 2


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"drift": lambda x, u: jnp.stack([x[1], u[0] - x[2], x[3], u[1] + x[0]])}, r"x\[1\] reads x\[2\]"),
        ({"cost": lambda x, u: (x[0] - x[2]) ** 2 + x[1] ** 2 + x[3] ** 2 + u @ u}, r"term that reads x\[0\], x\[2\]"),
        ({"controls": hjb.Ball(1.0, 2)}, "not a Box couples"),
        ({"drift": lambda x, u: jnp.stack([x[1], u[0], x[3], u[0] + u[1]])}, r"u\[0\] drives x\[1\], x\[3\]"),
        ({"target": lambda x: jnp.abs(x[0]) - 0.1, "discount": 1.0}, "couples the blocks"),
        ({"terminal_cost": lambda x: jnp.maximum(x[0], x[2])}, "does not separate"),
    ],
)
def test_a_coupling_is_refused_and_named(change, said):
    with pytest.raises(ValueError, match=said):
        hjb.decompose(hjb.Problem(**{**INTEGRATORS, "cost": squares, **change}), 4)


def test_subsystems_that_share_a_heading_give_a_bound_on_request():
    """Chen et al.: a car at unit speed as (x, heading) and (y, heading); the union of two targets is exact."""
    drift = lambda x, u: jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]), u[0]])  # noqa: E731
    both = hjb.reach(drift, hjb.Box([-1.0], [1.0]), lambda x: jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1])) - 0.5)
    either = hjb.reach(drift, hjb.Box([-1.0], [1.0]), lambda x: jnp.minimum(jnp.abs(x[0]), jnp.abs(x[1])) - 0.5)
    with pytest.raises(ValueError, match="bound=True"):
        hjb.decompose(both, 3)
    found = hjb.decompose(both, 3, bound=True)
    assert (found.rule, found.bound, found.states) == ("first", "lower", ((0, 2), (1, 2)))
    assert hjb.decompose(either, 3, bound=True).bound is None


LINES = {"drift": lambda x, u: u, "controls": hjb.Box([-1.0, -0.5], [1.0, 0.5])}


@pytest.mark.slow
def test_a_tube_into_an_intersection_needs_one_moment():
    """x' = u, |u₁| ≤ 1, |u₂| ≤ ½: V = max_i max(|x_i| − speed_i t, 0) − ½ at the end t, the best moment."""
    problem = hjb.reach(target=lambda x: jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1])) - 0.5, **LINES)
    parts = hjb.decompose(problem, 2)
    assert (parts.rule, parts.bound) == ("first", None)
    solution = parts.march(
        hjb.Grid([-3.0] * 2, [3.0] * 2, (121, 121), edges="linear"), 1.0, times=[0.0, 0.25, 0.5, 1.0]
    )
    x = np.array([[1.2, 0.3], [0.9, 1.2], [-2.0, 0.0], [0.2, -0.1]])
    exact = np.max(np.maximum(np.abs(x) - [1.0, 0.5], 0), axis=1) - 0.5
    assert np.allclose(solution.value_at(0.0, x), exact, atol=0.02)
    assert np.all(np.sign(solution.control_at(0.0, x[:1])) == [[-1, -1]])
    assert np.isfinite(solution.grid_error_at(0.0, x)).all()


def check_against_joint_march(problem, grid, finer, horizon, x, **options):
    """Blocks on the same and on a finer spacing are as close to the joint march as its own grid error says."""
    parts = hjb.decompose(problem, grid.ndim)
    joint = hjb.march(problem, grid, horizon, policy=False, **options)
    error = hjb.Solution(grid, joint.grid_error[0], None).value_at(x)
    value = joint.value_at(0.0, x)
    assert error.max() < 0.2  # V is between −0.6 and 1.5; an error as large as V would compare nothing
    for own in (grid, finer):
        blocks = parts.march(own, horizon).value_at(0.0, x)
        off = np.abs(blocks - value)
        print(f"off {off.max():.2g}, mean {off.mean():.2g}; grid error {error.max():.2g}, mean {error.mean():.2g}")
        assert off.max() <= error.max()
        assert off.mean() <= error.mean()
    return parts, blocks


@pytest.mark.slow
def test_two_double_integrators_equal_the_joint_march():
    """A force of ±1 moves the end of a path by ±T²/2, so |x(1)| = max(|x + v| − ½, 0). The paths stay in the box."""
    distance = lambda x: jnp.maximum(jnp.abs(x[0]), jnp.abs(x[2])) - 0.5  # noqa: E731
    problem = hjb.reach(target=distance, tube=False, **INTEGRATORS)
    grid, finer = (hjb.Grid([-2.0, -1.5] * 2, [2.0, 1.5] * 2, shape * 2) for shape in ((21, 17), (81, 65)))
    x = np.random.default_rng(1).uniform(-0.9, 0.9, (200, 4))
    _, blocks = check_against_joint_march(problem, grid, finer, 1.0, x)
    exact = np.max(np.maximum(np.abs(x[:, ::2] + x[:, 1::2]) - 0.5, 0), axis=1) - 0.5
    print(f"from the exact value {np.abs(blocks - exact).max():.2g}")
    assert np.abs(blocks - exact).max() < 0.06


def three_states(x, u):
    """A cart with a lagging actuator."""
    return [x[1], x[2], u - x[2]]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is coarse")
def test_a_reach_avoid_of_three_and_three_states_equals_the_joint_march():
    """4.8 million nodes in six dimensions; on fewer than 11 intervals per axis a march does not estimate its error."""
    problem = hjb.reach_avoid(
        lambda x, u: jnp.stack([*three_states(x[:3], u[0]), *three_states(x[3:], u[1])]),
        hjb.Box([-1.0] * 2, [1.0] * 2),
        lambda x: jnp.maximum(jnp.abs(x[0]), jnp.abs(x[3])) - 0.6,
        lambda x: jnp.minimum(x[0] + 1.4, x[3] + 1.4),
    )
    grid, finer = (
        hjb.Grid([-2.0, -1.2, -1.0] * 2, [2.0, 1.2, 1.0] * 2, (nodes,) * 6, edges="linear") for nodes in (13, 49)
    )
    x = np.random.default_rng(2).uniform([-1, -0.6, -0.5] * 2, [1, 0.6, 0.5] * 2, (300, 6))
    parts, _ = check_against_joint_march(problem, grid, finer, 0.8, x, dtype="float32")
    assert (parts.rule, parts.states) == ("first", ((0, 1, 2), (3, 4, 5)))


@pytest.mark.slow
def test_three_blocks_of_two_states():
    """2 + 2 + 2, each the Riccati value of a double integrator."""
    problem = hjb.Problem(
        lambda x, u: jnp.stack([x[1], u[0], x[3], u[1], x[5], u[2]]), squares, hjb.Box([-9.0] * 3, [9.0] * 3)
    )
    parts = hjb.decompose(problem, 6)
    assert parts.states == ((0, 1), (2, 3), (4, 5))
    x = np.array([0.3, -0.1, 0.2, 0.2, -0.3, 0.1])
    p = np.array([[np.sqrt(3), 1], [1, np.sqrt(3)]])
    exact = sum(x[i : i + 2] @ p @ x[i : i + 2] for i in (0, 2, 4))
    assert abs(parts.solve(hjb.Grid([-1.0] * 6, [1.0] * 6, (41,) * 6)).value_at(x) - exact) < 0.03
