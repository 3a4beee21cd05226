"""Paths of solved and marched problems cost what V promises, whatever is paid on the way and at the end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.feedback.feedback import beyond_ends, continuing_sides
from hjbjax.feedback.simulation import rollout
from hjbjax.problem.pytree import altered

LINE = hjb.Grid([-2.0], [2.0], (161,))
TIMES = np.linspace(0.0, 1.0, 81)
UNIT = hjb.Box([-1.0], [1.0])
KINDS = ["running", "discounted", "stopping", "target", "stopping and target", "game", "game that stops", "start",
         "reach", "avoid", "reach and avoid", "moving price", "reach in a game", "discounted reach"]  # fmt: skip


def bumps(a, b, c):
    """A smooth function of the state. Its numbers are in a closure, so that other numbers share its programs."""
    return lambda x: a * jnp.cos(2 * x[0] + b) + c * x[0] ** 2


def posed(kind, p):
    """A problem on a line of one of the kinds, whose numbers p are random, shape (12,)."""
    wind = bumps(0.3 * p[0], 3 * p[1], 0.0)
    price = bumps(0.5, 3 * p[2], 0.2)
    distance = lambda x: jnp.sqrt((x[0] - 0.5 * p[3]) ** 2 + 1e-3) - 0.4  # noqa: E731
    obstacle = lambda x: jnp.sqrt((x[0] - 0.5 * p[4] + 1.2) ** 2 + 1e-3) - 0.3  # noqa: E731
    drift = lambda x, u: u + wind(x)  # noqa: E731
    pushed = lambda x, u, d: u + 0.4 * d + wind(x)  # noqa: E731
    cost = lambda x, u: 0.5 + 0.3 * x[0] ** 2 + (0.5 + 0.4 * p[5]) * u @ u  # noqa: E731
    worst = lambda x, u, d: cost(x, u) - (2 + p[6]) * d @ d  # noqa: E731
    final = bumps(0.4, 3 * p[7], 0.3)
    beta, home = 0.5 + 0.4 * p[8], lambda x: 1.2 + 0.2 * p[9] - x[0]
    if kind == "moving price":
        moved = lambda t, x: price(x - 0.5 * t)  # noqa: E731
        return hjb.Problem(
            lambda t, x, u: drift(x, u), lambda t, x, u: cost(x, u), UNIT, stopping_cost=moved, time_dependent=True
        )
    tubes = {
        "reach": lambda: hjb.reach(drift, UNIT, distance),
        "avoid": lambda: hjb.avoid(drift, UNIT, distance),
        "reach and avoid": lambda: hjb.reach_avoid(drift, UNIT, distance, obstacle),
        "reach in a game": lambda: hjb.reach(pushed, UNIT, distance, disturbances=UNIT),
    }
    if kind in tubes:
        return tubes[kind]()
    parts = {
        "running": {"terminal_cost": final},
        "discounted": {"terminal_cost": final, "discount": beta},
        "stopping": {"stopping_cost": price, "discount": beta},
        "target": {"target": home, "exit_cost": -0.2 + 0.3 * p[10], "terminal_cost": final},
        "stopping and target": {"target": home, "exit_cost": -0.5, "stopping_cost": price, "terminal_cost": final},
        "game": {"disturbances": UNIT, "terminal_cost": final},
        "game that stops": {"disturbances": UNIT, "stopping_cost": price},
        "start": {},
        "discounted reach": {"stopping_cost": lambda x: distance(x) - 1, "discount": beta},
    }[kind]
    if "disturbances" in parts:
        return hjb.Problem(pushed, worst, UNIT, **parts)
    return hjb.Problem(drift, None if kind == "discounted reach" else cost, UNIT, **parts)


def numbers(seed):
    return np.random.default_rng(seed).uniform(-1, 1, size=12)


def missed(problem, solution, x0, duration):
    """How far a path from x0 misses V, over the range of V, or of a tube's distance: V may be its least everywhere."""
    path = hjb.simulate(problem, solution, [x0], duration, steps=400)
    extent = np.ptp(solution.value if solution.times is None else solution.value[0])
    if problem.cost is None and problem.stopping_cost is not None:
        extent = max(extent, np.ptp([problem.stopping_cost(x) for x in solution.grid.nodes()]))
    return abs(path.cost - path.promised) / extent, path


CHEAP = ("stopping",)
CASES = [pytest.param(kind, 1, marks=() if kind in CHEAP else pytest.mark.slow) for kind in KINDS]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the box decides V")
@pytest.mark.parametrize(("kind", "seed"), [*CASES, *(pytest.param(kind, 2, marks=pytest.mark.slow) for kind in KINDS)])
def test_a_path_of_a_march_costs_what_v_promises(kind, seed):
    """Those with a price of stopping ran on to the horizon, tubes cost nothing, and ``start=`` was never paid."""
    p = numbers(seed)
    problem = posed(kind, p)
    start = np.cos(3 * LINE.axis(0) + p[11]) if kind == "start" else None
    solution = hjb.march(problem, LINE, 1.0, times=TIMES, start=start)
    for x0 in (-0.6 + 0.1 * p[0], 0.1, 0.55):
        off, path = missed(problem, solution, x0, 1.0)
        assert path.status.name in ("DURATION", "TARGET")
        assert off < 0.01


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the box decides V")
@pytest.mark.parametrize(
    "kind", ["discounted", "stopping", "target", "stopping and target", "game that stops", "reach", "reach in a game"]
)
def test_a_path_of_a_solve_costs_what_v_promises(kind):
    """With what V says of the time after a path that is cut short."""
    problem = altered(posed(kind, numbers(1)), terminal_cost=None)
    solution = hjb.solve(problem, LINE)
    for x0 in (-0.55, 0.1, 0.55):
        off, path = missed(problem, solution, x0, 12.0)
        ahead = 0.0
        if kind == "discounted":
            ahead = np.exp(-float(problem.discount) * 12) * solution.value_at(path.states[-1])
            off = abs(path.cost + ahead - path.promised) / np.ptp(solution.value)
        assert off < 0.01


@pytest.mark.slow
@pytest.mark.optimised
def test_noisy_paths_of_a_march_stop_and_cost_what_v_promises_in_the_mean():
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: 0.3 + u @ u, UNIT, noise=0.4, stopping_cost=lambda x: jnp.sin(3 * x[0]) ** 2
    )
    solution = hjb.march(problem, LINE, 1.0, times=TIMES)
    keys = jax.random.split(jax.random.key(2), 1000)
    with jax.enable_x64(True):
        run = jax.vmap(lambda key: rollout(problem, solution, jnp.array([0.55]), np.linspace(0, 1, 21), key=key).cost)
        cost = np.asarray(jax.jit(run)(keys))
    deviation = cost.std() / np.sqrt(len(cost))
    assert abs(cost.mean() - float(solution.value_at(0.0, [0.55]))) < 4 * deviation < 0.04


@pytest.mark.slow
def test_one_had_better_stop_at_once():
    """V = ψ = 0.2; the path ran on to the horizon and cost 1."""
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: 1.0 + 0 * x[0] + 0.1 * u @ u, UNIT, stopping_cost=lambda x: 0.2 + x[0] ** 2
    )
    solution = hjb.march(problem, hjb.Grid([-2.0], [2.0], (81,)), 1.0, times=np.linspace(0, 1, 41))
    path = hjb.simulate(problem, solution, [0.0], 1.0)
    assert path.cost == path.promised == pytest.approx(0.2, rel=1e-12)


def pushed_tube(discount):
    """The least x² that is reached, where the drift leads away; the push back costs 0.6 per unit of length."""
    return hjb.Problem(
        lambda x, u: 0.2 + u, None, hjb.Box([-0.1], [0.1]), discount=discount, stopping_cost=lambda x: x @ x,
        pushes=[hjb.Push([-1.0], cost=0.6)],
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the box decides V")
def test_pushes_are_paid_without_a_running_cost():
    """The path cost the least x² on the way, 0.09, as in a tube: nobody paid for the push from 1.2 to 0.3."""
    problem = pushed_tube(0.0)
    for solution in (hjb.solve(problem, LINE), hjb.march(problem, LINE, 1.0, times=TIMES)):
        path = hjb.simulate(problem, solution, [1.2], 1.0)
        assert path.cost == pytest.approx(0.6 * 0.9 + 0.09, rel=1e-9)
        assert path.promised == pytest.approx(path.cost, rel=1e-9)
    # with a discount it is best to drift to 1.3 and to push at the horizon
    solution = hjb.march(pushed_tube(0.5), LINE, 1.0, times=TIMES)
    path = hjb.simulate(pushed_tube(0.5), solution, [1.2], 1.0)
    assert path.promised == pytest.approx(np.exp(-0.5) * 0.69, rel=1e-3)
    assert path.cost == pytest.approx(np.exp(-0.5) * 0.69, rel=0.01)


def moded_tube(price):
    """The least x² that is reached, where one mode leads right and the other left."""
    changes = None if price is None else [[0.0, price], [price, 0.0]]
    return hjb.Problem(
        lambda x, u, mode: (0.5, -0.5)[mode] + u, None, hjb.Box([-0.1], [0.1]), stopping_cost=lambda x, mode: x @ x,
        modes=hjb.Modes(("right", "left"), switching_cost=changes),
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the box decides V")
@pytest.mark.parametrize(("price", "mode", "least"), [(0.2, "right", 0.2), (0.2, "left", 0.0), (None, "left", 0.0)])
def test_changes_of_the_mode_are_paid_without_a_running_cost(price, mode, least):
    """Paths failed with a TypeError of JAX, also those of modes that never change."""
    problem = moded_tube(price)
    solution = hjb.march(problem, LINE, 3.0, times=3 * TIMES)
    path = hjb.simulate(problem, solution, [1.2], 3.0, mode=mode)
    assert path.cost == pytest.approx(least, abs=1e-3)
    assert path.promised == pytest.approx(least, abs=1e-3)


@pytest.mark.slow
def test_feedback_continues_v_beyond_an_open_end_as_the_scheme_does():
    """V was clamped there: with noise its second difference was that of a wall, and u was 0.05 and 3 at the ends."""
    problem = hjb.Problem(
        lambda y, u: jnp.stack([0.02 + u[0] * 0.04 - 0.5 * u[0] ** 2 * 0.04]), None, hjb.Box([0.0], [3.0]),
        noise=lambda y, u: u * 0.2, terminal_cost=lambda y: -2 * jnp.exp(0.5 * y[0]),
    )  # fmt: skip
    solution = hjb.march(problem, hjb.Grid([-1.0], [1.0], (41,), edges="open"), 1.0, times=TIMES)
    greedy = hjb.greedy_feedback(problem, solution)
    for x in (-1.0, 1.0):
        assert greedy(0.5, [x]) == pytest.approx(solution.control_at(0.5, [x]), abs=1e-6)
    assert greedy(0.5, [-0.99])[0] == pytest.approx(2.0, abs=0.4)
    assert greedy(0.5, [0.0])[0] == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize("ndim", [1, 2])
def test_a_quadratic_goes_on_beyond_open_ends(ndim):
    """Also beyond a corner, and on ghost nodes exactly."""
    grid = hjb.Grid([-1.0] * ndim, [1.0] * ndim, (5,) * ndim, edges="open")
    x = np.moveaxis(grid.nodes(), -1, 0)
    value = sum((i + 1.0) * entry**2 for i, entry in enumerate(x)) + (x[0] * x[-1])
    solution = hjb.Solution(grid, value, np.zeros((*grid.shape, 1)))
    points = jnp.array([[1.5] * ndim, [-1.5] * ndim, [0.5] * ndim, [1.5] + [-1.0] * (ndim - 1)])
    found = beyond_ends(lambda y: solution.value_at(y, clamp=True), points, grid, continuing_sides(grid))
    wanted = sum((i + 1.0) * points[:, i] ** 2 for i in range(ndim)) + points[:, 0] * points[:, -1]
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is coarse")
def test_a_promise_that_is_never_kept_is_a_warning():
    """A car in a valley whose reward is at the end, and that pays nothing for time: it swings there and waits."""
    problem = hjb.Problem(
        lambda x, u: jnp.stack([x[1], 0.0015 * u[0] - 0.0025 * jnp.cos(3 * x[0])]), lambda x, u: 0.1 * u @ u, UNIT,
        target=lambda x: 0.45 - x[0], exit_cost=-100.0,
    )  # fmt: skip
    with pytest.warns(UserWarning, match="the feedback never arrives"):
        solution = hjb.solve(problem, hjb.Grid([-1.2, -0.07], [0.6, 0.07], (91, 91)))
    with pytest.warns(UserWarning, match="the path costs .* and V promised -99.9"):
        hjb.simulate(problem, solution, [-0.5, 0.0], 999.0)


@pytest.mark.slow
def test_a_value_that_is_wrong_is_a_promise_that_is_broken():
    problem, grid = hjb.zoo.eikonal(shape=(21, 21))
    solution = hjb.solve(problem, grid)
    wrong = altered(solution, value=3 * np.asarray(solution.value))
    with pytest.warns(UserWarning, match="V promised"):
        hjb.simulate(problem, wrong, [0.6, 0.5], 4.0)
    kept = hjb.simulate(problem, solution, [0.6, 0.5], 4.0)
    assert kept.cost == pytest.approx(kept.promised, abs=0.02)


def test_a_filter_wants_a_tube():
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, UNIT, discount=1.0)
    solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (11,)), scheme=hjb.Upwind())
    with pytest.raises(ValueError, match="a problem that is not a tube"):
        hjb.least_restrictive(solution, lambda x: jnp.zeros(1))


def test_a_time_that_was_not_kept_is_told():
    solution = hjb.Solution(LINE, np.zeros((2, 161)), np.zeros((2, 161, 1)), times=np.array([0.0, 1.0]))
    with pytest.warns(UserWarning, match="1 of 2 times lie outside the kept times, from 0 to 1"):
        assert np.isnan(solution.value_at([0.5, 1.5], [[0.0], [0.0]])).tolist() == [False, True]
    assert solution.value_at(1.5, [0.0], clamp=True) == 0
