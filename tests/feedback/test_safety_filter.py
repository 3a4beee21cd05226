"""The safety filter where the exact safe set is known: braking before a wall, one that moves, against a disturbance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

UNIT = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([-3.0, -2.0], [1.0, 2.0], (61, 61))


def braking(x, u):
    return jnp.stack([x[1], u[0]])


def wall(x):
    return -x[0]


def full_throttle(x):
    return jnp.ones(1)


AVOID = hjb.avoid(braking, UNIT, wall)


@pytest.fixture(scope="module")
def tube():
    return hjb.solve(AVOID, GRID, scheme=hjb.Upwind())


def farthest(feedback, x0, duration=5.0, problem=AVOID, **options):
    options = {"grid": GRID, "clamp": True, "hold": 0.02} | options
    return float(hjb.simulate(problem, feedback, x0, duration, **options).states[:, 0].max())


def deepest(x):
    """V = x + ½ max(v, 0)²: how deep in the wall full braking ends."""
    return x[..., 0] + np.maximum(x[..., 1], 0) ** 2 / 2


def test_the_tube_is_what_braking_allows(tube):
    errors = []
    for count in (31, 61):
        solved = (
            tube
            if count == 61
            else hjb.solve(AVOID, hjb.Grid([-3.0, -2.0], [1.0, 2.0], (count, count)), scheme=hjb.Upwind())
        )
        exact = deepest(solved.grid.nodes())
        errors.append(np.max(np.abs(solved.value - exact)[exact < 0.4]))
    assert errors[1] < 0.6 * errors[0]
    assert errors[1] < 0.08


@pytest.mark.parametrize("x0", [[-2.5, 0.0], [-2.0, 1.0], [-1.5, -1.0]])
def test_full_throttle_hits_the_wall_and_with_the_filter_does_not(tube, x0):
    assert farthest(full_throttle, x0) > 0
    guarded = hjb.least_restrictive(tube, full_throttle)
    assert -0.25 < farthest(guarded, x0) < 0  # and comes as near as the margin and a cell allow
    assert 0 < guarded.margin < 0.15


def test_where_it_is_safe_the_nominal_control_is_untouched_to_the_bit(tube):
    rng = np.random.default_rng(0)
    x = rng.uniform(GRID.lo, GRID.hi, (500, 2))

    def nominal(x):
        return jnp.sin(3 * x[:1]) * x[1]

    guarded = hjb.least_restrictive(tube, nominal, margin=0.1)
    acts, u = (np.asarray(jax.vmap(each)(x)) for each in (guarded.acts, guarded))
    wanted = np.asarray(jax.vmap(nominal)(x))
    np.testing.assert_array_equal(u[~acts], wanted[~acts])
    np.testing.assert_array_equal(acts, tube.value_at(x) > -0.1)
    exact = deepest(x)
    assert np.all(acts[exact > 0.0])
    assert not np.any(acts[exact < -0.25])
    assert np.all(u[acts & (x[:, 1] > 0.1) & (exact < 0)] == -1)  # brakes, and never half


def test_a_nominal_control_of_integers_does_not_cut_off_the_safe_one():
    grid = hjb.Grid([-1.0], [1.0], (5,))
    tube = hjb.Solution(grid, np.asarray(grid.axis(0)), np.full((5, 1), -0.5), code=hjb.Status.CONVERGED)
    guarded = hjb.least_restrictive(tube, lambda x: jnp.array([1]), margin=0.1)
    assert guarded(jnp.array([0.5])).tolist() == [-0.5]
    assert guarded(jnp.array([-0.5])).tolist() == [1.0]


def test_it_can_be_compiled(tube):
    guarded = hjb.least_restrictive(tube, full_throttle)
    for x in ([-2.5, 0.0], [-0.2, 1.0]):
        assert jax.jit(guarded)(jnp.array(x)) == guarded(jnp.array(x))
        assert jax.jit(lambda f, x: f(x))(guarded, jnp.array(x)) == guarded(jnp.array(x))

    def built_inside(margin, x):
        return hjb.least_restrictive(tube, full_throttle, margin=margin)(x)

    assert jax.jit(built_inside)(0.1, jnp.array([-2.5, 0.0]))[0] == 1
    assert jax.jit(built_inside)(10.0, jnp.array([-2.5, 1.0]))[0] == -1


def test_a_wider_margin_stops_farther_away(tube):
    reached = [
        farthest(hjb.least_restrictive(tube, full_throttle, margin=margin), [-2.5, 0.0]) for margin in (0.1, 0.5, 1.0)
    ]
    assert reached[0] > reached[1] > reached[2]
    assert reached[2] == pytest.approx(-1.0, abs=0.1)


@pytest.mark.slow
def test_the_nominal_control_may_be_a_solution(tube):
    """The fastest way through the wall."""
    race = hjb.Problem(braking, lambda x, u: 1.0, UNIT, target=lambda x: jnp.hypot(x[0] - 0.5, x[1]) - 0.2)
    fastest = hjb.solve(race, hjb.Grid([-3.0, -2.0], [1.0, 2.0], (41, 41)), tol=0.1, scheme=hjb.Upwind())
    assert farthest(fastest, [-1.5, 0.0], grid=None) > 0
    assert farthest(hjb.least_restrictive(tube, fastest), [-1.5, 0.0]) < 0


def drifting(x, u):
    return jnp.stack([jnp.ones(()), u[0]])


def box(x):
    return jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1])) - 0.5


@pytest.mark.filterwarnings("ignore:the optimal drift leaves")
@pytest.mark.slow
def test_straight_ahead_left_or_right_is_safe_and_their_mean_is_not():
    """Carried towards a square: unsafe is |y| < ½ − (time until it is there), where the two ways round meet."""
    grid = hjb.Grid([-2.0, -1.5], [1.0, 1.5], (31, 31))
    problem = hjb.avoid(drifting, UNIT, box)
    guarded = hjb.least_restrictive(hjb.solve(problem, grid, scheme=hjb.Upwind()), lambda x: jnp.zeros(1))
    for y in (0.0, 0.05, -0.02):
        path = hjb.simulate(problem, guarded, [-1.9, y], 2.4, grid=grid, hold=0.02)
        assert min(float(box(x)) for x in path.states) > 0
        turns = path.times[np.argmax(np.abs(path.controls[:, 0]) > 0)]
        assert 0.3 < turns < 0.9  # exactly: .9, when x = −1


# --- in time ---


def moving_wall(t, x):
    """At 1 − t/2."""
    return 1.0 - 0.5 * t - x[0]


MOVING = hjb.avoid(lambda t, x, u: braking(x, u), UNIT, moving_wall, time_dependent=True)


@pytest.mark.filterwarnings("ignore:the optimal drift leaves")
@pytest.mark.slow
def test_a_wall_that_comes_nearer():
    """y = x − 1 + t/2 and w = v + ½ see a wall at rest: V = y + ½w² as long as there is time to brake."""
    grid = hjb.Grid([-3.0, -2.0], [2.0, 2.0], (51, 41))
    tube = hjb.march(MOVING, grid, 3.0, times=np.linspace(0, 3, 31), scheme=hjb.Upwind(split=True))
    y, w = grid.nodes()[..., 0] - 0.5, grid.nodes()[..., 1] + 0.5
    exact = y + np.maximum(w, 0) ** 2 / 2
    inner = (exact < 0.3) & (y > -2)
    assert np.max(np.abs(tube.value[10] - exact)[inner]) < 0.2  # t = 1, wall at ½
    guarded = hjb.least_restrictive(tube, lambda t, x: jnp.ones(1))

    def nearest(feedback):
        path = hjb.simulate(MOVING, feedback, [-2.0, 0.0], 3.0, grid=grid, clamp=True, hold=0.02)
        return float(np.max(path.states[:, 0] - 1 + path.times / 2))

    assert nearest(lambda t, x: jnp.ones(1)) > 0
    assert -0.5 < nearest(guarded) < 0


@pytest.mark.slow
def test_a_marched_tube_guards_a_system_that_does_not_know_the_time():
    tube = hjb.march(AVOID, GRID, 3.0, times=np.linspace(0, 3, 31), scheme=hjb.Upwind(split=True))
    guarded = hjb.least_restrictive(tube, lambda t, x: full_throttle(x))
    assert farthest(guarded, [-2.0, 1.0], 3.0, time_varying=True) < 0
    late = jnp.array([-0.5, 1.2])  # would end ½·1.44 beyond: too late to brake for ever, not for the last tenth
    assert guarded(jnp.array(0.0), late)[0] == -1
    assert guarded(jnp.array(2.9), late)[0] == 1


def gust(x, u, d):
    return jnp.stack([x[1], u[0] + 0.4 * d[0]])


@pytest.mark.slow
def test_against_the_worst_disturbance():
    """Brakes at 1 − .4: V = x + v²/(2·.6); a filter that does not know of the wind is blown into the wall."""
    problem = hjb.avoid(gust, UNIT, wall, disturbances=UNIT)
    windy = hjb.solve(problem, GRID, scheme=hjb.Upwind())
    calm = hjb.solve(AVOID, GRID, scheme=hjb.Upwind())
    exact = GRID.nodes()[..., 0] + np.maximum(GRID.nodes()[..., 1], 0) ** 2 / 1.2
    assert np.max(np.abs(windy.value - exact)[exact < 0.3]) < 0.1

    def worst(x):
        return jnp.ones(1)

    def blown(solution):
        guarded = hjb.least_restrictive(solution, full_throttle)
        return farthest(guarded, [-2.5, 0.5], problem=problem, disturbance=worst)

    assert blown(windy) < 0
    assert blown(calm) > 0


# --- refusals ---


@pytest.mark.parametrize(
    ("arguments", "changes", "error", "reason"),
    [
        ({"nominal": 1.0}, {}, TypeError, r"nominal is 1.0, wanted a function of the state or a Solution"),
        ({"solution": AVOID}, {}, TypeError, r"got Problem, wanted the Solution of a tube"),
        ({"margin": -0.1}, {}, ValueError, r"margin = -0.1; wanted a finite number ≥ 0"),
        ({"margin": np.nan}, {}, ValueError, r"margin = nan"),
        ({"margin": 50.0}, {}, ValueError, r"nothing is safe by the margin 50: the smallest V is -3"),
        ({}, {"policy": np.zeros((61, 61, 0))}, ValueError, r"the tube has no controls"),
        ({}, {"code": hjb.Status.MAX_STEPS}, ValueError, r"ended with <Status.MAX_STEPS.*>, so it guarantees nothing"),
    ],
)
def test_what_guards_nothing_is_refused(tube, arguments, changes, error, reason):
    about = {"value": tube.value, "policy": tube.policy, "code": tube.code} | changes
    arguments = {"solution": hjb.Solution(GRID, **about), "nominal": full_throttle} | arguments
    with pytest.raises(error, match=reason) as caught:
        hjb.least_restrictive(**arguments)
    assert len(str(caught.value).splitlines()) <= 6


def test_a_marched_tube_that_is_kept_at_one_time_is_refused(tube):
    once = hjb.Solution(GRID, tube.value[None], tube.policy[None], code=tube.code, times=np.zeros(1))
    with pytest.raises(ValueError, match=r"marched and stored at one time only.* times=np.linspace"):
        hjb.least_restrictive(once, full_throttle)


def test_traced_use_wants_a_margin(tube):
    with pytest.raises(ValueError, match=r"inside jit, vmap and grad give margin="):
        jax.jit(lambda tube: hjb.least_restrictive(tube, full_throttle)(jnp.zeros(2)))(tube)


@pytest.mark.slow
def test_a_marched_filter_wants_the_time(tube):
    marched = hjb.march(AVOID, GRID, 0.1, times=[0.0, 0.1], scheme=hjb.Upwind(split=True))
    guarded = hjb.least_restrictive(marched, full_throttle)
    with pytest.raises(ValueError, match=r"this solution is marched over times: call value_at\(t, x\)"):
        guarded(jnp.zeros(2))
