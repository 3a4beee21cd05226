"""Tubes and sets against light cones, hand-computed answers, published fractions and a decoupled truth."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.problem.sets import Box

UNIT = Box([-1.0], [1.0])


def boat(x, u):
    """Floats up at speed 1, rows sideways."""
    return jnp.stack([u[0], jnp.ones(())])


def square(x):
    return jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1])) - 1.0


def cone(x, horizon):
    """From (x, y) the boat is in the square within the horizon iff |x| ≤ 1 + time until it is level with its top."""
    entry = np.maximum(-1.0 - x[..., 1], 0)
    leaving = 1.0 - x[..., 1]
    within = (entry <= horizon) & (leaving >= 0)
    return within & (np.abs(x[..., 0]) <= 1 + np.minimum(leaving, horizon))


def disagreement(found, wanted):
    """The share of the nodes on which two sets differ."""
    return np.mean(found != wanted)


def test_a_floating_boat_has_its_light_cone():
    grid = hjb.Grid([-5.0, -5.0], [5.0, 5.0], (101, 101))
    tube = hjb.march(hjb.reach(boat, UNIT, square), grid, 3.0, scheme=hjb.Weno5())
    wrong = (tube.value[0] <= 0) != cone(grid.nodes(), 3.0)
    assert np.mean(wrong) < 0.01  # nodes on the boundary itself
    assert tube.value.min() >= -1.1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is coarse")
def test_the_stationary_tube_is_the_limit_of_marching():
    grid = hjb.Grid([-3.0, -3.0], [3.0, 3.0], (31, 31))
    problem = hjb.reach(boat, UNIT, square)
    long = hjb.march(problem, grid, 40.0, scheme=hjb.Upwind(split=True))
    np.testing.assert_allclose(
        hjb.solve(problem, grid, tol=1e-8, scheme=hjb.Upwind()).value, long.value[0], rtol=0, atol=1e-5
    )


def gap(x):
    return jnp.abs(x[0]) - 0.5


def push(x, u, d):
    return u + 0.5 * d


@pytest.mark.slow
@pytest.mark.parametrize("player", ["with", pytest.param("without", marks=pytest.mark.slow)])
def test_an_opponent_slows_the_tube_down(player):
    """|x| ≤ ½ + (1 − ½)T against a disturbance of half the strength, ½ + T without one."""
    grid = hjb.Grid([-4.0], [4.0], (161,))
    if player == "with":
        problem, edge = hjb.reach(push, UNIT, gap, disturbances=UNIT), 1.0
    else:
        problem, edge = hjb.reach(lambda x, u: u, UNIT, gap), 1.5
    value = hjb.march(problem, grid, 1.0, scheme=hjb.Weno5()).value[0]
    x = np.asarray(grid.axis(0))
    assert np.abs(x[value <= 0]).max() == pytest.approx(edge, abs=0.051)


@pytest.mark.slow
def test_avoid_is_the_mirror_image_of_reach():
    """Who pursues with u in one problem pursues with d in the other."""
    grid = hjb.Grid([-4.0], [4.0], (81,))

    def pursuer(x, u, d):
        return 0.5 * u + d

    kept_away = hjb.march(
        hjb.avoid(pursuer, UNIT, gap, disturbances=UNIT), grid, 1.0, scheme=hjb.Upwind(split=True)
    ).value
    caught = hjb.march(hjb.reach(push, UNIT, gap, disturbances=UNIT), grid, 1.0, scheme=hjb.Upwind(split=True)).value
    np.testing.assert_allclose(kept_away, -caught, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_set_is_not_a_tube():
    """ẋ = 1: at the end in |x| ≤ ½ only from [−1.5, −.5], at some time from [−1.5, .5]."""
    grid = hjb.Grid([-4.0], [4.0], (161,))

    def carried(x, u):
        return jnp.ones(1)

    x = np.asarray(grid.axis(0))
    at_the_end = x[
        hjb.march(hjb.reach(carried, None, gap, tube=False), grid, 1.0, scheme=hjb.Upwind(split=True)).value[0] <= 0.0
    ]
    at_some_time = x[hjb.march(hjb.reach(carried, None, gap), grid, 1.0, scheme=hjb.Upwind(split=True)).value[0] <= 0.0]
    assert (at_the_end[0], at_the_end[-1]) == pytest.approx((-1.5, -0.5), abs=0.06)
    assert (at_some_time[0], at_some_time[-1]) == pytest.approx((-1.5, 0.5), abs=0.06)
    ahead = x[
        hjb.march(
            hjb.reach(carried, None, gap, tube=False, forward=True), grid, 1.0, scheme=hjb.Upwind(split=True)
        ).value[0]
        <= 0.0
    ]
    assert (ahead[0], ahead[-1]) == pytest.approx((0.5, 1.5), abs=0.06)


def wall(x):
    """Everything right of ¼."""
    return 0.25 - x[0]


def test_a_goal_inside_an_obstacle_is_not_reached():
    """The goal |x| ≤ ½ is covered from ¼ on: from the left it is reached, from within the wall never."""
    grid = hjb.Grid([-2.0], [2.0], (81,))
    problem = hjb.reach_avoid(lambda x, u: u, UNIT, gap, wall)
    value, x = hjb.march(problem, grid, 1.0, scheme=hjb.Upwind(split=True)).value[0], np.asarray(grid.axis(0))
    assert np.all(value[x > 0.26] > 0)
    assert np.all(value[(x > -1.4) & (x < 0.24)] <= 0)
    assert np.all(value[x < -1.6] > 0)
    stationary = hjb.solve(problem, grid, tol=1e-8, scheme=hjb.Upwind()).value
    assert np.all(stationary[x > 0.26] > 0)
    assert np.all(stationary[x < 0.24] <= 0.02)


def test_forward_sets_of_time_dependent_systems_are_refused():
    with pytest.raises(ValueError, match=r"forward=True reverses time"):
        hjb.reach(lambda t, x, u: u, UNIT, lambda t, x: gap(x), forward=True, time_dependent=True)


# --- published instances ---


def collision(x, u, d):
    """Air3D: the evader's frame, v = 5 for both, turn rates at most 1."""
    evader, pursuer = u[0], d[0]
    return jnp.stack([-5 + 5 * jnp.cos(x[2]) + evader * x[1], 5 * jnp.sin(x[2]) - evader * x[0], pursuer - evader])


def disc(x):
    return jnp.sqrt(x[0] ** 2 + x[1] ** 2) - 5.0


AIR3D = hjb.avoid(collision, UNIT, disc, disturbances=UNIT)


def air3d_grid(shape):
    return hjb.Grid([-6.0, -10.0, 0.0], [20.0, 10.0, 2 * np.pi], shape, (False, False, True))


@pytest.mark.slow
@pytest.mark.optimised
def test_air3d_never_leaves_the_range_of_the_distance():
    grid = air3d_grid((27, 21, 24))
    solution = hjb.march(AIR3D, grid, 1.0, times=[0.0, 1.0], scheme=hjb.Upwind(split=True))
    assert solution.value[0].min() >= solution.value[1].min()
    assert solution.value[0].max() <= 5.0
    assert solution.value.shape == (2, 27, 21, 24)


@pytest.mark.slow
@pytest.mark.optimised
def test_air3d_has_the_published_fraction():
    """hj_reachability 0.7.0 "very_high" finds .25941 of the nodes unsafe."""
    value = hjb.march(AIR3D, air3d_grid((51, 40, 50)), 2.8, scheme=hjb.Weno5()).value[0]
    assert np.mean(value >= 0) == pytest.approx(0.2594, abs=0.0005)
    plain = hjb.march(AIR3D, air3d_grid((51, 40, 50)), 2.8, times=[0.0, 2.8], scheme=hjb.Upwind(split=True)).value
    assert plain[0].min() >= plain[1].min()
    assert plain[0].max() <= plain[1].max()


def dubins(x, u):
    return jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]), u[0]])


def cylinder(x):
    return jnp.sqrt(x[0] ** 2 + x[1] ** 2) - 1.0


@pytest.mark.slow
@pytest.mark.optimised
def test_the_tube_of_the_dubins_car():
    """hj_reachability finds .1298 at "very_high"; straight ahead the value is exactly −1."""
    grid = hjb.Grid([-5.0, -5.0, -np.pi], [5.0, 5.0, np.pi], (41, 41, 41), (False, False, True))
    problem = hjb.reach(dubins, UNIT, cylinder)
    value = hjb.march(problem, grid, 2.0, scheme=hjb.Weno5()).value[0]
    assert np.mean(value <= 0) == pytest.approx(0.1298, abs=0.0005)
    # Euler steps with slopes of high order sharpen: they keep the tip of the cone where Runge–Kutta rounds it off
    sharp = hjb.march(problem, grid, 2.0, scheme=hjb.Weno5(), method=hjb.Explicit(stages=1))
    assert np.mean(sharp.value[0] <= 0) == pytest.approx(0.1298, abs=0.0005)
    for x in ([-2.0, 0.0, 0.0], [0.0, -2.0, np.pi / 2]):
        assert sharp.value_at(0.0, x) == pytest.approx(-1.0, abs=0.03)


def integrator(x, u):
    return jnp.stack([x[1], u[0]])


def integrators(x, u):
    return jnp.stack([x[1], u[0], x[3], u[1]])


def half(x):
    return jnp.abs(x[0]) - 0.5


def halves(x):
    return jnp.maximum(half(x), jnp.abs(x[2]) - 0.5)


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.filterwarnings("ignore:the grid is coarse")
def test_two_integrators_apart_are_two_integrators():
    """The set of two decoupled systems at one time is the product of theirs: V₄ = max(V₂, V₂)."""
    lo, hi = [-4.0, -3.0], [4.0, 3.0]
    four = hjb.march(
        hjb.reach(integrators, Box([-1.0] * 2, [1.0] * 2), halves, tube=False),
        hjb.Grid(lo * 2, hi * 2, (25,) * 4),
        3.0,
        scheme=hjb.Weno5(),
        dtype="float32",
    ).value[0]
    two = hjb.reach(integrator, UNIT, half, tube=False)
    same = hjb.march(two, hjb.Grid(lo, hi, (25, 25)), 3.0, scheme=hjb.Weno5()).value[0]
    fine = hjb.march(two, hjb.Grid(lo, hi, (193, 193)), 3.0, scheme=hjb.Weno5()).value[0][::8, ::8]
    product = np.maximum(same[:, :, None, None], same[None, None])
    truth = np.maximum(fine[:, :, None, None], fine[None, None])
    assert np.mean(np.abs(four - product)) < 0.05
    assert disagreement(four <= 0, truth <= 0) < 0.03


# --- dynamics of hj_reachability ---


class Vehicle:
    """The interface of ``hj_reachability.ControlAndDisturbanceAffineDynamics``: a boat in a current, pushed by wind."""

    def __init__(self, modes=("min", "max"), control=1.0, wind=0.5):
        self.control_mode, self.disturbance_mode = modes
        self.control_space = SimpleNamespace(lo=jnp.full(1, -control), hi=jnp.full(1, control))
        self.disturbance_space = SimpleNamespace(center=jnp.zeros(2), radius=jnp.float32(wind))

    def __call__(self, state, control, disturbance, time):
        return jnp.stack([jnp.cos(state[1]) + disturbance @ jnp.array([1.0, 0.5]), control[0]])


def distance(x):
    return jnp.linalg.norm(x) - 0.5


def steered(x, u, d):
    return jnp.stack([jnp.cos(x[1]) + d[0] + 0.5 * d[1], u[0]])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("modes", "pose", "tube"), [(("min", "max"), hjb.reach, True), (("max", "min"), hjb.avoid, False)]
)
def test_dynamics_of_hj_reachability_pose_the_same_problem(modes, pose, tube):
    sea = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (11, 11), edges="open")
    box, ball = hjb.Box([-1.0], [1.0]), hjb.Ball(0.5, 2)
    found, wanted = (
        hjb.march(problem, sea, 0.5, scheme=hjb.Upwind()).value
        for problem in (
            hjb.from_hj_reachability(Vehicle(modes), distance, tube=tube),
            pose(steered, box, distance, disturbances=ball, tube=tube),
        )
    )
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_a_disturbance_that_helps_or_rests():
    helped = Vehicle(("max", "max"))
    helped.disturbance_space = SimpleNamespace(lo=[-1.0, 0.0], hi=[1.0, 0.0])
    problem = hjb.from_hj_reachability(helped, distance)
    assert problem.disturbances is None
    assert problem.controls.lo.tolist() == [-1.0, -1.0, 0.0]
    np.testing.assert_allclose(problem.drift(jnp.zeros(2), jnp.array([1.0, 0.5, 0.0])), [1.5, 1.0])
    helped.disturbance_space = SimpleNamespace(lo=[0.25, 0.0], hi=[0.25, 0.0])
    problem = hjb.from_hj_reachability(helped, distance)
    np.testing.assert_allclose(problem.drift(jnp.zeros(2), jnp.ones(1)), [1.25, 1.0])


@pytest.mark.parametrize(
    ("dynamics", "reason"),
    [
        (object(), "got object without control_mode, .* wanted a Dynamics"),
        (Vehicle(("low", "max")), r"got the modes \('low', 'max'\)"),
        (Vehicle(("min", "min")), "both minimise, over sets that are not both boxes"),
    ],
)
def test_what_is_no_dynamics_is_refused(dynamics, reason):
    with pytest.raises((TypeError, ValueError), match=reason):
        hjb.from_hj_reachability(dynamics, distance)


@pytest.mark.slow
def test_the_package_itself():
    """Its own march of its own dynamics, from the other side of the interface."""
    hj = pytest.importorskip("hj_reachability")
    dynamics = hj.systems.Air3d()  # the evader maximises
    problem = hjb.from_hj_reachability(dynamics, lambda x: jnp.hypot(x[0], x[1]) - 5.0)
    grid = hjb.Grid([-6.0, -10.0, 0.0], [20.0, 10.0, 2 * np.pi], (27, 21, 20), (False, False, True), edges="open")
    ours = hjb.march(problem, grid, 0.5, scheme=hjb.Weno5()).value[0]
    theirs = hj.Grid.from_lattice_parameters_and_boundary_conditions(
        hj.sets.Box(np.array([-6.0, -10.0, 0.0]), np.array([20.0, 10.0, 2 * np.pi])), (27, 21, 20), periodic_dims=2
    )
    start = jnp.linalg.norm(theirs.states[..., :2], axis=-1) - 5.0
    settings = hj.SolverSettings.with_accuracy(
        "very_high", hamiltonian_postprocessor=hj.solver.backwards_reachable_tube
    )
    found = hj.step(settings, dynamics, theirs, 0.0, start, -0.5, progress_bar=False)
    assert np.abs(ours + found)[5:-5, 5:-5].mean() < 0.02  # .008 at spacings of one
    assert disagreement(ours >= 0, found <= 0) < 0.01
