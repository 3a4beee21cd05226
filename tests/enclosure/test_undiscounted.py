"""Bounds on the cost until a target is met hold for exact answers and for an oracle in plain NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.enclosure.levels import levels_of
from hjbjax.tracing.intervals import point

FINE = 20_001  # points of the oracle


def solution_of(grid, value, error=0.0, **more):
    """A float32 solution whose node values are exact up to an error per node, times a sine."""
    nodes = grid.nodes()
    flat = value(nodes.reshape(-1, grid.ndim)).reshape(grid.shape)
    wrong = error * np.sin(np.sum(37 * nodes, axis=-1))
    return hjb.Solution(grid, (flat + wrong).astype(np.float32), None, code=hjb.Status.CONVERGED, **more)


def check(found, value, lo, hi, slack=0.0, count=4000):
    """The value is between the bounds at random states; returns the widths there relative to its range."""
    states = np.random.default_rng(1).uniform(lo, hi, (count, len(lo)))
    exact, low, high = value(states), found.lower_at(states), found.upper_at(states)
    assert np.all(low <= exact + slack)
    assert np.all(exact - slack <= high)
    return (high - low) / np.ptp(exact)


def random_line(seed):
    """x' = a(x) + b(x) u with |a| < b, the cost q(x) + r u², and the targets x ≤ −0.8 and x ≥ 0.7 with exit costs.

    The oracle: no path turns, so V is the smaller of two integrals of the least cost per distance.
    """
    draw = np.random.default_rng(seed)
    a, b, q = draw.uniform(0, 0.7), draw.uniform(1, 2), draw.uniform(0.5, 2)
    phase, wave, r, left, right = (*draw.uniform(0, 3, 2), draw.uniform(0, 1), *draw.uniform(0, 0.3, 2))
    problem = hjb.Problem(
        lambda x, u: a * jnp.sin(3 * x + phase) + b * u,
        lambda x, u: q + 0.4 * jnp.cos(wave * x[0]) + r * u[0] ** 2,
        hjb.Box([-1.0], [1.0]),
        target=lambda x: jnp.minimum(x[0] + 0.8, 0.7 - x[0]),
        exit_cost=lambda x: jnp.where(x[0] < 0, left * x[0] ** 2, right * jnp.exp(-x[0])),
    )
    x, u = np.linspace(-0.8, 0.7, FINE), np.linspace(-1, 1, 401)[:, None]
    speed, paid = a * np.sin(3 * x + phase) + b * u, q + 0.4 * np.cos(wave * x) + r * u**2
    with np.errstate(divide="ignore"):
        per = [np.min(np.where(side * speed > 0, paid / (side * speed), np.inf), axis=0) for side in (-1, 1)]
    to_left, whole = (np.concatenate([[0], np.cumsum((p[1:] + p[:-1]) / 2)]) * (x[1] - x[0]) for p in per)
    inner = np.minimum(to_left + left * 0.64, whole[-1] - whole + right * np.exp(-0.7))

    def value(states):
        s = states[:, 0]
        ended = np.where(s < 0, left * s**2, right * np.exp(-s))
        return np.where((s <= -0.8) | (s >= 0.7), ended, np.interp(s, x, inner))

    return problem, value


@pytest.mark.parametrize(
    ("seeds", "counts"), [(range(1, 2), (40,)), pytest.param(range(2, 14), (40, 81), marks=pytest.mark.slow)]
)
def test_random_problems_with_two_targets_are_enclosed(seeds, counts):
    for seed in seeds:
        problem, value = random_line(seed)
        for count in counts:
            grid = hjb.Grid([-1.0], [1.0], (count,))
            x = np.asarray(grid.axis(0))
            wrong = 1e-4 * (seed % 2) * ((x > -0.8) & (x < 0.7))
            found = hjb.enclose(problem, solution_of(grid, value, wrong))
            # the oracle is good to 1e-6: 401 controls, and quadrature
            widths = check(found, value, [-1.0], [1.0], slack=1e-5)
            assert np.median(widths) < 0.05
            assert np.mean(np.isinf(widths)) < 4.0 / count


def disc(center=0.02, radius=0.25, reward=False):
    """The time to a disc at unit speed, or minus it as a reward."""
    paid = {"reward": lambda x, u: -1.0} if reward else {"cost": lambda x, u: 1.0}
    problem = hjb.Problem(
        lambda x, u: u,
        controls=hjb.Ball(1.0, 2),
        target=lambda x: jnp.sqrt((x[0] - center) ** 2 + x[1] ** 2) - radius,
        **paid,
    )
    sign = -1 if reward else 1
    return problem, lambda x: sign * np.maximum(np.hypot(x[:, 0] - center, x[:, 1]) - radius, 0)


@pytest.mark.parametrize("reward", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_distance_to_a_disc_is_enclosed(reward, tmp_path):
    problem, value = disc(reward=reward)
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (21, 21))
    found = hjb.enclose(problem, solution_of(grid, value, labels=problem.labels), rounds=1)
    assert np.median(check(found, value, [-1.0, -1.0], [1.0, 1.0])) < 0.05
    # states in the middle are nearer to the target than to the walls
    middle = np.hypot(*np.moveaxis(grid.nodes(), -1, 0)) < 0.45
    assert not np.any(found.remaining[middle])
    found.save(tmp_path / "disc.npz")
    again, states = hjb.Enclosure.load(tmp_path / "disc.npz"), grid.nodes() * 0.99
    np.testing.assert_array_equal(again.upper_at(states), found.upper_at(states))
    np.testing.assert_array_equal(again.lower_at(states), found.lower_at(states))


@pytest.mark.slow
def test_the_bounds_of_a_distance_close_with_the_mesh():
    problem, value = disc()
    widths = []
    for count in (41, 81):
        grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (count, count))
        widths.append(
            np.median(check(hjb.enclose(problem, hjb.solve(problem, grid)), value, [-1, -1], [1, 1], 0, 50_000))
        )
    assert np.log2(widths[0] / widths[1]) > 1.3
    assert widths[1] < 2e-3


@pytest.mark.slow
def test_a_concave_kink_between_two_discs_costs_width_only_next_to_it():
    far = lambda x, side: jnp.sqrt((x[0] - side * 0.6) ** 2 + x[1] ** 2) - 0.2  # noqa: E731
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: 1.0, hjb.Ball(1.0, 2), target=lambda x: jnp.minimum(far(x, 1), far(x, -1))
    )
    value = lambda x: np.maximum(np.hypot(np.abs(x[:, 0]) - 0.6, x[:, 1]) - 0.2, 0)  # noqa: E731
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (61, 61))
    found = hjb.enclose(problem, solution_of(grid, value))
    widths = check(found, value, [-1, -1], [1, 1], 0, 50_000)
    assert np.median(widths) < 0.02
    assert np.mean(widths > 0.1) < 0.1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is coarse")
def test_the_minimum_time_of_the_double_integrator_is_enclosed():
    """T₀ is the time to the origin. From the boundary of the disc it takes at most t, so T₀ − t ≤ V ≤ T₀."""

    def to_origin(x):
        s = np.where(x[:, 0] + x[:, 1] * np.abs(x[:, 1]) / 2 > 0, 1.0, -1.0)
        return s * x[:, 1] + 2 * np.sqrt(np.maximum(x[:, 1] ** 2 / 2 + s * x[:, 0], 0))

    def problem(radius):
        return hjb.Problem(
            lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: 1.0, hjb.Box([-1.0], [1.0]),
            target=lambda x: jnp.sqrt(x @ x) - radius,
        )  # fmt: skip

    grid = hjb.Grid([-1.5, -1.5], [1.5, 1.5], (41, 41))
    angle = np.linspace(0, 2 * np.pi, 2001)
    longest = np.max(to_origin(0.3 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)))
    states = np.random.default_rng(0).uniform(-0.6, 0.6, (5000, 2))  # from here no fast path meets a wall
    smaller = hjb.solve(problem(0.1), grid)
    for solution, is_finite in (
        (solution_of(grid, lambda x: np.maximum(to_origin(x) - longest, 0)), False),
        (smaller, True),
    ):
        found = hjb.enclose(problem(0.3), solution)
        assert np.all(found.lower_at(states) <= to_origin(states))
        assert np.all(to_origin(states) - longest <= found.upper_at(states))
        assert np.all(np.isfinite(found.upper)) or not is_finite
        assert np.any(found.lower_at(states) > 0)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_function_of_levels_bounds_the_integral_of_its_slopes(sign):
    draw = np.random.default_rng(2)
    least = draw.uniform(0, 2, 300)
    largest = least + draw.exponential(0.1, 300)
    relative = draw.uniform(-0.1, 0.4, 300)
    found = levels_of(least, largest, relative, -sign * 0.3, sign)
    s = np.linspace(np.min(least), np.max(largest), 200_001)
    worst = np.zeros(len(s))
    for a, b, size in zip(least, largest, relative, strict=True):
        worst[(a <= s) & (s <= b)] = np.maximum(worst[(a <= s) & (s <= b)], size)
    slopes = 1 / (1 + sign * worst)
    exact = s[0] - sign * 0.3 + np.concatenate([[0], np.cumsum((slopes[1:] + slopes[:-1]) / 2)]) * (s[1] - s[0])
    gap = sign * (exact - found.at(point(s)))
    assert np.all(gap > -1e-4)  # the error of the quadrature
    assert np.max(gap) < 0.05
    blocked = levels_of(least, largest, np.where(np.arange(300) == np.argmax(least), np.inf, relative), 0.0, -1)
    assert np.isinf(blocked.at(point(np.max(least)))).all()
    assert np.isfinite(blocked.at(point(np.max(least) - 0.01))).all()


def test_a_cost_that_may_vanish_outside_the_target_is_refused():
    line, near = hjb.Grid([-1.0], [1.0], (21,)), lambda x: np.abs(x[:, 0])
    for cost, more, word in (
        (lambda x, u: (x[0] - 0.5) ** 2, {}, "not known to be positive in the cell at x = "),
        (lambda x, u: 1.0, {"discount": 1.0}, "a target with a discount"),
    ):
        problem = hjb.Problem(
            lambda x, u: u, cost, hjb.Box([-1.0], [1.0]), target=lambda x: jnp.abs(x[0]) - 0.21, **more
        )
        with pytest.raises(ValueError, match=word):
            hjb.enclose(problem, solution_of(line, near))


@pytest.mark.parametrize(
    ("target", "word"),
    [
        (lambda x: jnp.nan * x[0], "is NaN at x = "),
        (lambda x: jnp.sqrt(x[0] - 0.5), r"is NaN at x = \[-1.0\]"),
        (lambda x: x, r"returned shape \(1,\)"),
        (lambda x: jnp.stack([x[0], x[0]]), r"returned shape \(2,\)"),
        (lambda x: 1.0, "no cell of the grid meets the target"),
        (lambda x: jnp.asarray(-1.0), "every cell of the grid is inside the target"),
    ],
)
def test_a_target_without_numbers_or_states_is_refused(target, word):
    problem = hjb.Problem(lambda x, u: u, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), target=target)
    with pytest.raises(ValueError, match=word):
        hjb.enclose(problem, solution_of(hjb.Grid([-1.0], [1.0], (21,)), lambda x: np.abs(x[:, 0])))


def test_a_target_may_use_hypot():
    """The program of jnp.hypot divides by a number that is zero at the origin: the upper bound was infinite."""
    _, value = disc()
    grid, widths = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (21, 21)), []
    for target in (lambda x: jnp.hypot(x[0] - 0.02, x[1]) - 0.25, disc()[0].target):
        problem = hjb.Problem(lambda x, u: u, lambda x, u: 1.0, hjb.Ball(1.0, 2), target=target)
        found = hjb.enclose(problem, solution_of(grid, value), rounds=1)
        widths.append(np.median(check(found, value, [-1.0, -1.0], [1.0, 1.0])))
    assert widths[0] <= 1.01 * widths[1]
