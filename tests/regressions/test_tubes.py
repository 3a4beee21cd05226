"""Tubes without discount: of many fixed points between ψ and g every path takes the right one, and goes to its end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

U = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([-3.0], [3.0], (61,))
X = GRID.axis(0)
partial = jax.tree_util.Partial


def half_speed(x, u):
    """Beyond |x| = 2 nothing moves."""
    return jnp.where(jnp.abs(x) < 2, 0.5 * u, 0.0)


def ball(radius, x):
    return jnp.abs(x[0]) - radius


def reach(radius):
    return hjb.reach(half_speed, U, partial(ball, radius))


def pulled(x, u):
    return -x + 0 * u


def near_one(radius, x):
    return jnp.abs(x[0] - 1.0) - radius


def avoid(radius):
    return hjb.avoid(pulled, U, partial(near_one, radius))


def reach_avoid(radius):
    return hjb.reach_avoid(half_speed, U, partial(ball, radius), partial(near_one, 0.25))


def exact_reach(radius):
    """Inside |x| < 2 the set is reached, where V is the least of l, −radius at 0; outside it is l."""
    return np.where(np.abs(X) < 2 - 1e-9, -radius, np.abs(X) - radius)


def exact_avoid(radius):
    """The path goes from x to 0 and meets all between: the closest that it comes to 1."""
    return radius - np.maximum(1 - np.maximum(X, 0), 0)


CASES = {"reach": (reach, exact_reach), "avoid": (avoid, exact_avoid), "reach_avoid": (reach_avoid, None)}


def traced(make, which):
    """V for radius ½ by transformations: of a number in the problem, of the whole problem, of a batch of numbers."""

    def value(radius):
        return hjb.solve(make(radius), GRID, tol=1e-9, scheme=hjb.Upwind()).value

    with jax.enable_x64(True):
        if which == "jit":
            return np.asarray(jax.jit(value)(0.5))
        if which == "jit of the problem":
            found = jax.jit(lambda problem: hjb.solve(problem, GRID, tol=1e-9, scheme=hjb.Upwind()))(make(0.5))
            assert int(found.code) == hjb.Status.CONVERGED
            return np.asarray(found.value)
        return np.asarray(jax.vmap(value)(jnp.array([0.4, 0.5]))[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_every_path_to_a_tube_starts_from_its_constraint(name):
    make, exact = CASES[name]
    alone = hjb.solve(make(0.5), GRID, tol=1e-9, scheme=hjb.Upwind())
    assert alone.status is hjb.Status.CONVERGED
    if exact is not None:
        assert np.allclose(alone.value, exact(0.5), atol=1e-9)
    together = hjb.solve_batch([make(0.4), make(0.5)], GRID, tol=1e-9, scheme=hjb.Upwind())
    assert np.allclose(together[1].value, alone.value, atol=1e-12)
    for which in ("jit", "jit of the problem", "vmap"):
        assert np.allclose(traced(make, which), alone.value, atol=1e-12), which


@pytest.mark.slow
def test_the_derivative_of_a_tube():
    """V = l outside where nothing moves, and l at the middle inside: both fall as the ball grows."""
    with jax.enable_x64(True):
        slope = jax.jacrev(lambda radius: hjb.solve(reach(radius), GRID, tol=1e-9, scheme=hjb.Upwind()).value)(0.5)
    assert np.allclose(slope, -1)


def free(x, u):
    return u


@pytest.mark.parametrize(
    ("scale", "nodes", "half"),
    [(1, 61, 3.0), (1e-3, 61, 3.0), (1e6, 61, 3.0), pytest.param(1, 4001, 3.0, marks=pytest.mark.slow), (1, 401, 0.1)],
)
def test_a_tube_goes_to_its_end_whatever_the_units_and_the_spacing(scale, nodes, half):
    """All of the box is reached: no default tolerance is small beside spacing times slope."""

    def level(x):
        return scale * (jnp.abs(x[0]) - half / 6)

    grid = hjb.Grid([-half], [half], (nodes,))
    solution = hjb.solve(hjb.reach(free, U, level), grid, scheme=hjb.Upwind())
    assert solution.status is hjb.Status.CONVERGED
    assert np.allclose(solution.value, scale * np.min(np.abs(grid.axis(0)) - half / 6), atol=1e-12 * scale)


@pytest.mark.slow
def test_a_tube_with_noise_and_in_single_precision_is_the_limit_of_marching():
    """Relatives: noise makes V fall for long by little, and float32 knows fewer numbers."""
    problem = hjb.reach(lambda x, u: 0.3 * u + 0.5, U, lambda x: jnp.abs(x[0] - 1.0) - 0.4, disturbances=None)
    solution = hjb.solve(problem, GRID, scheme=hjb.Upwind())
    far = hjb.march(problem, GRID, 60.0, scheme=hjb.Upwind(split=True))
    assert np.allclose(solution.value, far.value[0], atol=1e-6)
    single = hjb.solve(problem, GRID, dtype="float32", scheme=hjb.Upwind())
    assert single.status is hjb.Status.CONVERGED
    assert np.allclose(single.value, solution.value, atol=1e-4)


def winding(x, u):
    """A rotation: the front comes round many times before it has been everywhere."""
    return jnp.stack([-x[1], x[0]]) + 0.02 * u


@pytest.mark.slow
def test_a_slow_spiral_is_followed_to_its_end():
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (21, 21))
    problem = hjb.reach(
        winding, hjb.Box([-1.0, -1.0], [1.0, 1.0]), lambda x: jnp.linalg.norm(x - jnp.array([0.5, 0.0])) - 0.2
    )
    solution = hjb.solve(problem, grid, scheme=hjb.Upwind())
    further = hjb.march(problem, grid, 50.0, start=solution.value, scheme=hjb.Upwind(split=True))
    assert np.max(np.abs(further.value[0] - solution.value)) <= 1e-9


@pytest.mark.parametrize("make", [reach, avoid])
def test_a_guess_between_the_fixed_points_of_a_tube_is_refused(make):
    """Zero is itself a fixed point, and would stay."""
    with pytest.raises(ValueError, match="remove guess"):
        hjb.solve(make(0.5), GRID, guess=np.zeros(GRID.shape), scheme=hjb.Upwind())


@pytest.mark.slow
@pytest.mark.parametrize(
    "inner", [hjb.ValueIteration(), pytest.param(hjb.PolicyIteration(), marks=pytest.mark.slow)], ids=repr
)
def test_coarser_grids_lead_to_no_other_fixed_point(inner):
    """From the interpolated answer of a coarser grid it came to another one, .0025 off, and said CONVERGED."""
    grid, actions = hjb.Grid([-1.0], [1.0], (41,)), hjb.Finite(np.array([[-1.0], [0.0], [1.0]]))
    still = hjb.Problem(lambda x, u: 0 * u, None, actions, stopping_cost=lambda x: -(x[0] ** 2))
    nested = hjb.solve(still, grid, method=hjb.Nested(inner, coarsest=5))
    np.testing.assert_allclose(nested.value, -(np.asarray(grid.axis(0)) ** 2), rtol=0, atol=1e-12)
    assert nested.stats["levels"] == [(41,)]
    # of an even number of nodes none is at zero: the coarser grid has one
    reach = hjb.Problem(lambda x, u: u, None, hjb.Box([-1.0], [1.0]), stopping_cost=lambda x: abs(x[0]))
    grid = hjb.Grid([-1.0], [1.0], (40,))
    nested, alone = (hjb.solve(reach, grid, method=each) for each in (hjb.Nested(inner, coarsest=5), None))
    np.testing.assert_allclose(nested.value, alone.value, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", [None, hjb.ValueIteration(policy=False)])
@pytest.mark.parametrize(("dtype", "close"), [("float64", 1e-9), ("float32", 2e-3)])
def test_a_tube_ends_where_nothing_moves_and_not_before(method, dtype, close):
    """At a node of slow drift a step is less than the last place of V: STALLED was said of the right value.

    V alone knows the step by the fastest rate, not the residual of the slow node, and ended .03 too early in float32.
    """

    def drift(x, u, d):
        return 0.7095693481 * jnp.sin(2 * x) + 0.8158293698 * u + 0.2286814718 * d

    problem = hjb.reach(
        drift, hjb.Finite([[-1.0], [0.0], [1.0]]), lambda x: jnp.abs(x[0] + 0.2900834182) - 0.3,
        disturbances=hjb.Finite([[-1.0], [1.0]]),
    )  # fmt: skip
    found = hjb.solve(problem, hjb.Grid([-1.0], [1.2], (61,)), scheme=hjb.Upwind(), method=method, dtype=dtype)
    assert found.status.name == "CONVERGED"
    assert found.value[14] == pytest.approx(-0.286750085349, abs=close)  # by value iteration in NumPy


def along(x, u):
    return jnp.stack([u[0], jnp.ones_like(u[0])])


def block(x):
    """Signed distance to the square |x|, |y| ≤ 1: ≤ 0 inside."""
    return jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1])) - 1


def minus_block(x):
    return -block(x)


BOAT = hjb.Grid([-3.0, -3.0], [3.0, 3.0], (25, 25))  # nodes at multiples of ¼


def test_reach_tube_of_the_floating_boat():
    """The infimum over time of l: the largest solution, reached from ψ; from zero the iteration stays at zero."""
    problem = hjb.Problem(along, controls=hjb.Box([-1.0], [1.0]), stopping_cost=block)
    solution = hjb.solve(problem, BOAT, tol=1e-6, scheme=hjb.Upwind())
    x, y = np.moveaxis(BOAT.nodes(), -1, 0)
    level = np.maximum(np.abs(x), np.abs(y)) - 1
    assert np.all(solution.value <= level + 1e-12)
    assert np.all(solution.value[(np.abs(x) <= 0.5) & (y <= 1)] <= 1e-9)
    past = (y >= 2) & (np.abs(x) < y)
    np.testing.assert_allclose(solution.value[past], (y - 1)[past], atol=1e-9)


@pytest.mark.slow
def test_avoid_tube_of_the_floating_boat():
    """The supremum over time of −l: the smallest solution, reached from g; from zero nothing would be safe."""
    problem = hjb.Problem(along, controls=hjb.Box([-1.0], [1.0]), running_max=minus_block)
    solution = hjb.solve(problem, BOAT, tol=1e-6, scheme=hjb.Upwind())
    x, y = np.moveaxis(BOAT.nodes(), -1, 0)
    level = 1 - np.maximum(np.abs(x), np.abs(y))
    assert np.all(solution.value >= level - 1e-12)
    assert np.all(solution.value[(y > 1) | (np.abs(x) > 1.5)] < 0)  # past the square, or beside it
