"""Stopping sets and free boundaries, against closed forms, a binomial tree, and geometry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from binomial_tree import binomial_put
from hypothesis import given
from hypothesis import strategies as st

import hjbjax as hjb
from hjbjax.solution.free_boundary import points_of, segments_of


def slow(*numbers):
    return pytest.param(*numbers, marks=pytest.mark.slow)


class Put:
    """The perpetual American put in levels of the price, with McKean's closed form."""

    def __init__(self, strike=100.0, rate=0.05, volatility=0.3):
        self.strike, self.rate, self.volatility = strike, rate, volatility
        self.power = 2 * rate / volatility**2
        self.boundary = self.power * strike / (1 + self.power)

    def price(self, s):
        s = np.asarray(s)
        out = (self.strike - self.boundary) * (np.maximum(s, self.boundary) / self.boundary) ** -self.power
        return np.where(s <= self.boundary, self.strike - s, out)

    def problem(self):
        strike, rate, volatility = self.strike, self.rate, self.volatility  # other numbers share the programs
        top = strike * 4 * (1 - 1e-9)  # the price at the upper end is prescribed
        return hjb.Problem(
            lambda x, u: rate * x, noise=lambda x, u: volatility * x, discount=rate,
            stopping_reward=lambda x: jnp.maximum(strike - x[0], 0.0), target=lambda x: top - x[0],
            exit_reward=float(self.price(4 * self.strike)),
        )  # fmt: skip

    def grid(self, count):
        return hjb.Grid([0.0], [4 * self.strike], (count,))

    def check(self, solution, cells=0.06):
        grid = solution.grid
        cell = float(grid.hi[0]) / (grid.shape[0] - 1)
        (found,) = solution.free_boundary()
        assert abs(found - self.boundary) < cells * cell
        # the chain may decide either way within half a cell of the boundary
        sure = abs(grid.axis(0) - self.boundary) > 0.55 * cell
        np.testing.assert_array_equal(np.asarray(solution.stopping)[sure], (grid.axis(0) < self.boundary)[sure])


@pytest.mark.parametrize("numbers", [(100.0, 0.05, 0.3), (1.0, 0.03, 0.2), (40.0, 0.06, 0.45), (100.0, 0.1, 0.35)])
def test_the_boundary_of_a_perpetual_put_is_found_within_a_fraction_of_a_cell(numbers):
    put = Put(*numbers)
    solution = hjb.solve(put.problem(), put.grid(121), tol=1e-6 * put.strike)
    put.check(solution)
    assert "optimal at" in str(solution)
    assert solution.active is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "count", [119, pytest.param(163, marks=pytest.mark.slow), pytest.param(201, marks=pytest.mark.slow)]
)
def test_the_boundary_may_lie_anywhere_in_its_cell(count):
    put = Put()
    put.check(hjb.solve(put.problem(), put.grid(count)))


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"method": hjb.PolicyIteration(hjb.Direct())}, marks=pytest.mark.slow),
        pytest.param({"method": hjb.PolicyIteration(hjb.Krylov())}, marks=pytest.mark.slow),
        {"method": hjb.ValueIteration()},
        {"scheme": hjb.Upwind()},
        pytest.param({"dtype": "float32", "tol": 0.05}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_every_method_finds_the_same_boundary(options):
    put = Put()
    put.check(hjb.solve(put.problem(), put.grid(101), **options))


def test_a_value_only_solve_has_no_stopping_set():
    put = Put()
    solution = hjb.solve(put.problem(), put.grid(41), method=hjb.ValueIteration(policy=False))
    assert solution.stopping is None
    with pytest.raises(ValueError, match="no stopping set; wanted a problem with a stopping_cost"):
        solution.free_boundary()


@pytest.mark.slow
def test_under_transformations_and_in_batches():
    puts = [Put(strike=90.0 + 10.0 * k) for k in range(3)]
    grid = puts[1].grid(101)

    def problem(strike):
        return hjb.Problem(
            lambda x, u: 0.05 * x, noise=lambda x, u: 0.3 * x, discount=0.05,
            stopping_reward=lambda x: jnp.maximum(strike - x[0], 0.0), target=lambda x: 399.9 - x[0],
            exit_reward=lambda x: (strike - share * strike) * (x[0] / (share * strike)) ** -puts[1].power,
        )  # fmt: skip

    share, strikes = puts[1].boundary / 100.0, np.array([put.strike for put in puts])
    lanes = hjb.solve_batch([problem(k) for k in strikes], grid)
    traced = jax.jit(jax.vmap(lambda k: hjb.solve(problem(k), grid)))(strikes)
    for lane, (solution, put) in enumerate(zip(lanes, puts, strict=True)):
        put.check(solution)
        np.testing.assert_array_equal(np.asarray(traced.stopping)[lane], solution.stopping)
    with pytest.raises(ValueError, match="pass one solution of a batch"):
        traced.free_boundary()
    with pytest.raises(ValueError, match="got a traced solution"):
        jax.jit(lambda k: hjb.solve(problem(k), grid).free_boundary())(100.0)


@pytest.mark.slow
def test_the_price_may_be_differentiated():
    put = Put()
    grid = put.grid(101)

    def price(strike):
        again = hjb.Problem(
            lambda x, u: 0.05 * x, noise=lambda x, u: 0.3 * x, discount=0.05,
            stopping_reward=lambda x: strike - x[0], target=lambda x: 399.99 - x[0],
            exit_reward=float(put.price(400.0)),
        )  # fmt: skip
        return hjb.solve(again, grid).value_at(jnp.array([100.0]))

    slope = jax.grad(price)(100.0)
    step = 1e-3
    above, below = (float(price(100.0 + sign * step)) for sign in (1, -1))
    assert slope == pytest.approx((above - below) / (2 * step), rel=2e-3)


def test_a_file_keeps_the_sets(tmp_path):
    put = Put()
    solution = hjb.solve(put.problem(), put.grid(41))
    solution.save(tmp_path / "put.npz")
    again = hjb.load(tmp_path / "put.npz")
    np.testing.assert_array_equal(again.stopping, solution.stopping)
    np.testing.assert_array_equal(again.free_boundary(), solution.free_boundary())
    assert "it is optimal to stop" in str(solution.to_xarray().stopping.attrs)


@pytest.mark.parametrize("method", [hjb.Implicit(), pytest.param(None, marks=pytest.mark.slow)], ids=str)
def test_the_exercise_boundary_of_an_american_put(method):
    """The tree's value minus the payoff changes from zero to positive at the boundary of exercise."""
    strike, rate, volatility = 40.0, 0.06, 0.2
    put = hjb.Problem(
        lambda x, u: rate * x, noise=lambda x, u: volatility * x, discount=rate,
        **dict.fromkeys(("stopping_reward", "terminal_reward"), lambda x: jnp.maximum(strike - x[0], 0.0)),
    )  # fmt: skip
    solution = hjb.march(put, hjb.Grid([0.0], [120.0], (121,)), 1.0, times=(0.0, 0.5, 1.0), method=method)
    for time in (0.0, 0.5):
        (found,) = solution.free_boundary(time=time)
        early, late = (
            binomial_put(strike, rate, volatility, 1.0 - time, found + shift) - (strike - found - shift)
            for shift in (-0.35, 0.35)
        )
        assert early < 1e-3  # the tree exercises, up to its own error
        assert late > 5e-3
    assert solution.stopping[-1].all()  # V = ψ at the horizon: a tie
    assert solution.free_boundary(time=1.0).shape == (0,)
    with pytest.raises(ValueError, match="the solution is stationary; leave it out"):
        Put().check(hjb.solve(Put().problem(), Put().grid(21)).free_boundary(time=0.0))


def wait(price, **parts):
    """Stop at a price, or wait at a rate of one, discounted to a cost of one."""
    return hjb.Problem(lambda x, u: 0 * x, lambda x, u: 1.0, discount=1.0, stopping_cost=price, **parts)


@pytest.mark.parametrize(
    "count", [pytest.param(62, marks=pytest.mark.slow), 81, pytest.param(90, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("radius", [0.6, 1.03, 1.37])
def test_v_may_leave_the_price_at_an_angle(count, radius):
    solution = hjb.solve(wait(lambda x: (x[0] / radius) ** 2), hjb.Grid([-2.0], [2.0], (count,)))
    np.testing.assert_allclose(solution.free_boundary(), [-radius, radius], atol=0.3 * (4 / count) ** 2 + 1e-9)


def test_a_tie_stops():
    """Between zero and one stopping and waiting cost the same, and elsewhere waiting is cheaper."""
    price = lambda x: jnp.where((x[0] > -0.01) & (x[0] < 1.01), 1.0, 3.0)  # noqa: E731
    solution = hjb.solve(wait(price), hjb.Grid([-1.0], [2.0], (31,)))
    np.testing.assert_allclose(solution.value, 1.0, rtol=1e-12)
    x = solution.grid.axis(0)
    np.testing.assert_array_equal(solution.stopping, (x > -0.01) & (x < 1.01))
    np.testing.assert_allclose(solution.free_boundary(), [-0.05, 1.05], atol=0.051)


@pytest.mark.parametrize("method", [None, hjb.ValueIteration()], ids=str)
def test_where_a_running_maximum_is_attained(method):
    """A path moves to the right; the largest sine ahead of it is its own one where the sine falls to its end."""
    height = hjb.Problem(lambda x, u: jnp.ones(1), running_max=lambda x: jnp.sin(x[0]))
    solution = hjb.solve(height, hjb.Grid([0.0], [4.0], (161,)), method=method)
    x = solution.grid.axis(0)
    np.testing.assert_array_equal(solution.active, x >= np.pi / 2 - 0.0126)
    assert solution.stopping is None
    (found,) = solution.free_boundary(solution.active)
    assert abs(found - np.pi / 2) < 0.025
    marched = hjb.march(height, solution.grid, 5.0, scheme=hjb.Upwind())
    assert marched.active.shape == (1, 161)
    assert marched.active[0][x > 1.7].all()


@pytest.mark.slow
def test_where_the_maximum_exceeds_the_price_nobody_stops():
    both = hjb.Problem(
        lambda x, u: u, controls=hjb.Box([-1.0], [1.0]), stopping_cost=lambda x: jnp.abs(x[0]) - 1.0,
        running_max=lambda x: x[0] - 0.5,
    )  # fmt: skip
    solution = hjb.march(both, hjb.Grid([-2.0], [2.0], (41,)), 0.5)
    x, value = solution.grid.axis(0), solution.value[0]
    price, most = abs(x) - 1, x - 0.5
    np.testing.assert_array_equal(solution.stopping[0], abs(value - price) <= 1e-15)
    np.testing.assert_array_equal(solution.active[0], abs(value - most) <= 1e-15)
    assert not solution.stopping[0][most > price + 1e-9].any()
    assert solution.active[0][most > price + 1e-9].all()


@pytest.mark.parametrize(("radius", "shape"), [(1.0, (41, 41)), slow(1.3, (41, 36)), slow(0.7, (36, 41))])
def test_over_two_axes_the_boundary_is_a_line_of_segments(radius, shape):
    problem = wait(lambda x: (x @ x) / radius**2)
    solution = hjb.solve(problem, hjb.Grid([-2.0, -2.0], [2.0, 2.0], shape))
    segments = solution.free_boundary()
    assert segments.shape[1:] == (2, 2)
    np.testing.assert_allclose(np.linalg.norm(segments, axis=-1), radius, atol=0.006)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1).sum()
    assert length == pytest.approx(2 * np.pi * radius, rel=0.01)


@pytest.mark.slow
def test_three_axes_are_refused():
    grid = hjb.Grid([-2.0] * 3, [2.0] * 3, (5, 5, 5))
    solution = hjb.solve(wait(lambda x: x @ x), grid)
    assert solution.stopping.shape == grid.shape
    with pytest.raises(ValueError, match="got a grid with 3 axes, wanted one or two"):
        solution.free_boundary()


@given(st.integers(0, 2**25 - 1), st.booleans(), st.booleans())
def test_segments_are_closed_lines_around_any_set(bits, first, second):
    """Every end of a segment is the end of another one, except on the ends of the box and on the seam."""
    inside = np.array([bits >> k & 1 for k in range(25)], bool).reshape(5, 5)
    periods = (5.0 if first else None, 5.0 if second else None)
    axes = [np.arange(5.0)] * 2
    segments = segments_of(axes, np.where(inside, 0.0, 1.0), inside, periods)
    ends = segments.reshape(-1, 2)
    for axis, period in enumerate(periods):
        if period is not None:
            ends[:, axis] %= period
    _, counts = np.unique(ends.round(9), axis=0, return_counts=True)
    links = sum(
        int(np.sum(np.roll(inside, -1, axis) != inside) if period else np.sum(np.diff(inside, axis=axis)))
        for axis, period in enumerate(periods)
    )
    assert len(counts) == links
    assert counts.max(initial=0) <= 2
    rim = [np.isin(ends[:, axis], (0.0, 4.0)) for axis in (0, 1) if periods[axis] is None]
    inner = ~np.any(rim, axis=0) if rim else np.ones(len(ends), bool)
    _, counts = np.unique(ends[inner].round(9), axis=0, return_counts=True)
    assert np.all(counts == 2)


@given(st.floats(1.2, 7.8), st.floats(-2, 2), st.floats(0.5, 4), st.booleans())
def test_a_parabola_over_a_parabola_ends_where_it_touches(end, bend, width, left):
    """Exact on unequal spacings if V itself is exact: ψ a parabola, V − ψ another one that touches it."""
    x = np.sort(np.concatenate([np.linspace(0, 9, 28) ** 1.1, [11.5]]))
    gap = width * np.maximum((x - end) * (1 if left else -1), 0) ** 2
    (found,) = points_of(x, 1 + x + bend * x**2 + gap, gap == 0, None)
    cell = np.diff(x)[np.searchsorted(x, end) - 1]
    assert abs(found - end) < 0.5 * cell


def test_a_periodic_axis_has_boundaries_on_both_sides_of_its_seam():
    grid = hjb.Grid([-np.pi], [np.pi], (60,), periodic=(True,))
    solution = hjb.solve(wait(lambda x: 1.5 + jnp.cos(x[0] - 0.03)), grid)
    angle = np.arccos(-0.5)
    np.testing.assert_allclose(solution.free_boundary(), np.sort([angle + 0.03, -angle + 0.03]), atol=5e-3)


def option(strike):
    """A put with a horizon in the logarithm of the price."""
    return hjb.Problem(
        lambda x, u: 0.02 + 0 * x, noise=0.3, discount=0.06,
        **dict.fromkeys(("stopping_reward", "terminal_reward"), lambda x: jnp.maximum(strike - jnp.exp(x[0]), 0.0)),
    )  # fmt: skip


LINE, TIMES = hjb.Grid([-1.5], [1.5], (61,)), (0.0, 0.25, 0.5)


@pytest.mark.slow
def test_a_march_inside_a_program_has_the_sets_of_a_march_outside():
    outside = hjb.march(option(1.0), LINE, 0.5, times=TIMES, step=0.01)
    inside = jax.jit(jax.vmap(lambda strike: hjb.march(option(strike), LINE, 0.5, times=TIMES, step=0.01)))
    with jax.enable_x64(True):
        lanes = inside(np.array([1.0, 1.2]))
    assert lanes.stopping.shape == (2, 3, 61)
    np.testing.assert_array_equal(lanes.stopping[0], outside.stopping)
    assert lanes.stopping[1].sum() > lanes.stopping[0].sum()


@pytest.mark.slow
def test_a_march_that_is_resumed_keeps_its_sets(tmp_path):
    file = tmp_path / "march.ckpt"
    first = hjb.march(option(1.0), LINE, 0.5, times=TIMES, checkpoint=file)
    again = hjb.march(option(1.0), LINE, 0.5, times=TIMES, checkpoint=file, resume=True)
    np.testing.assert_array_equal(again.stopping, first.stopping)
    assert first.stopping[:2].any()
    assert not first.stopping[:2].all()
    bare = hjb.march(option(1.0), LINE, 0.5, policy=False)
    assert bare.stopping is None


@pytest.mark.parametrize(
    ("volatilities", "scheme"), [((0.2, 0.4), hjb.Upwind()), slow((0.2, 0.4), None), slow((0.3, 0.3), None)]
)
def test_every_mode_has_its_own_boundary(volatilities, scheme):
    """With the same volatility in both modes it is that of one put, else between the boundaries of two puts."""
    grid, table = Put().grid(101), np.array(volatilities)

    def boundaries(rates):
        put = hjb.Problem(
            lambda x, u, mode: 0.05 * x, noise=lambda x, u, mode: jnp.asarray(table)[mode] * x, discount=0.05,
            stopping_reward=lambda x, mode: jnp.maximum(100.0 - x[0], 0.0), target=lambda x, mode: 399.99 - x[0],
            exit_reward=0.0, modes=hjb.Modes(("calm", "wild"), rates),
        )  # fmt: skip
        solution = hjb.solve(put, grid, scheme=scheme)
        assert solution.stopping.shape == (2, 101)
        with pytest.raises(ValueError, match=r"Write solution.in_mode\('calm'\).free_boundary"):
            solution.free_boundary()
        return [float(solution.in_mode(mode).free_boundary()[0]) for mode in ("calm", "wild")]

    calm, wild = boundaries([[0.0, 1.0], [1.0, 0.0]])
    least, most = sorted(boundaries([[0.0, 0.0], [0.0, 0.0]]))
    if volatilities[0] == volatilities[1]:
        np.testing.assert_allclose([calm, wild, most], least, rtol=1e-5)
    else:
        assert least < wild < calm < most
