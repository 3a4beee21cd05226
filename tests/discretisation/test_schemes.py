"""A scheme of somebody else's, in every front door; and what is none."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import chain
from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Chain, Scheme


@dataclasses.dataclass(frozen=True)
class Minmod(Scheme):
    """Second order by the smaller of two second differences of one sign; equal spacings."""

    even, points, chain = True, 3, hjb.Upwind()

    def slopes(self, around):
        grid, found = around.grid, []
        for axis, (up, down) in enumerate(around.one_sided):
            bend = up - down
            above, below = (stencil.neighbour(bend, grid, stencil.unit(grid, axis, step)) for step in (1, -1))
            up, down = up - least(bend, above) / 2, down + least(bend, below) / 2
            found.append(stencil.stopped(up, down, grid, axis))
        return found


def least(a, b):
    return jnp.where(a * b > 0, jnp.where(jnp.abs(a) < jnp.abs(b), a, b), 0)


def smooth(count):
    """V = 1 − cos x on a ring, β = 1: f = u, L = ½ u² + V + ½ |DV|² with the optimal u = −DV."""

    def cost(x, u):
        return 0.5 * u @ u + 1 - jnp.cos(x[0]) + 0.5 * jnp.sin(x[0]) ** 2

    problem = hjb.Problem(lambda x, u: u, cost, hjb.Box([-2.0], [2.0]), discount=1.0)
    return problem, hjb.Grid([-np.pi], [np.pi], (count,), periodic=[True])


def largest_error(count, scheme):
    problem, grid = smooth(count)
    solution = hjb.solve(problem, grid, scheme=scheme, tol=1e-9)
    assert solution.enclosure is None or scheme.monotone
    return np.max(np.abs(solution.value - (1 - np.cos(grid.nodes()[..., 0]))))


def test_another_scheme_is_of_its_order_in_a_stationary_problem():
    """Nearly of order 2: limiters of this kind lose some of it at extrema."""
    coarse, fine = largest_error(40, Minmod()), largest_error(160, Minmod())
    assert np.log(coarse / fine) / np.log(4) > 1.3
    assert fine < 0.2 * largest_error(160, hjb.Upwind())


@pytest.mark.slow
def test_another_scheme_marches_and_goes_lane_by_lane():
    problem, grid = smooth(80)
    free = hjb.Problem(problem.drift, problem.cost, problem.controls)
    values = [hjb.march(free, grid, 1.0, scheme=scheme).value[0] for scheme in (hjb.Upwind(), Minmod(), hjb.Weno5())]
    assert np.max(np.abs(values[1] - values[2])) < 0.2 * np.max(np.abs(values[0] - values[2]))
    alone = hjb.solve(problem, grid, scheme=Minmod(), tol=1e-9)
    (lane,) = hjb.solve_batch([problem], grid, scheme=Minmod(), tol=1e-9)
    np.testing.assert_allclose(lane.value, alone.value, rtol=0, atol=1e-8)


@dataclasses.dataclass  # neither frozen nor hashable
class Loose(Scheme):
    chain = hjb.Upwind()

    def slopes(self, around):
        return around.one_sided


@pytest.mark.parametrize("scheme", [Minmod, hjb.Upwind, "upwind", Loose(), 1.0])
@pytest.mark.parametrize("door", ["solve", "march", "solve_batch"])
def test_what_is_no_scheme_is_refused(door, scheme):
    problem, grid = smooth(20)
    free = hjb.Problem(problem.drift, problem.cost, problem.controls)
    ask = {
        "solve": lambda: hjb.solve(problem, grid, scheme=scheme),
        "march": lambda: hjb.march(free, grid, 1.0, scheme=scheme),
        "solve_batch": lambda: hjb.solve_batch([problem], grid, scheme=scheme),
    }
    with pytest.raises(TypeError, match=r"scheme is .*; wanted hjb.Upwind\("):
        ask[door]()


def test_what_a_scheme_of_ones_own_cannot_do_is_said():
    problem, grid = smooth(20)
    free = hjb.Problem(problem.drift, problem.cost, problem.controls)
    with pytest.raises(ValueError, match=r"solves with the matrix of a chain; got Minmod"):
        hjb.march(free, grid, 1.0, scheme=Minmod(), method=hjb.Implicit())
    stretched = hjb.Grid([-1.0], [1.0], (20,), stretch=(hjb.Sinh(2.0),))
    for ask in (lambda: hjb.solve(problem, stretched, scheme=Minmod()),
                lambda: hjb.march(free, stretched, 1.0, scheme=Minmod())):  # fmt: skip
        with pytest.raises(ValueError, match=r"Minmod\(.*\) requires equal spacings"):
            ask()
    with pytest.raises(TypeError, match=r"Eno2\(\); wanted hjb.Upwind"):
        hjb.solve(problem, grid, scheme=hjb.Eno2())
    with pytest.raises(ValueError, match="axis 0 has 2 points; Minmod needs at least 3"):
        hjb.march(free, hjb.Grid([-1.0], [1.0], (2,)), 1.0, scheme=Minmod())


# --- a chain of somebody else's: monotone, certified ---


@dataclasses.dataclass(frozen=True)
class LaxFriedrichs(Chain):
    """Central differences, and a diffusion that no drift of at most ``speed`` turns negative, with a share of noise."""

    speed: float
    share: float = 1.0
    even = True

    def excess(self, f, a, link):
        return self.share * a + self.speed * link.up + 0 * f

    def kinks(self, a, slopes, link):
        return (), (sum(slopes) / 2,)


H, X, US = 0.1, np.linspace(-1, 1, 21), np.linspace(-1, 1, 2001)[:, None]
BETA = 0.7


def dense(noise, speed, cost_of_control=0.3):
    """Value iteration in NumPy over finely sampled actions."""
    f = US + 0.2 * X
    e = noise**2 + speed * H
    up, down = (e + H * f) / (2 * H**2), (e - H * f) / (2 * H**2)
    up[:, -1], down[:, 0] = 0, 0
    up[:, 0], down[:, -1] = 2 * up[:, 0], 2 * down[:, -1]  # over half a cell
    value, dt = np.zeros(21), 1 / (np.max(up + down) + BETA)
    for _ in range(10_000):
        jumps = up * (np.append(value[1:], 0) - value) + down * (np.append(0, value[:-1]) - value)
        step = dt * (np.min(X**2 + cost_of_control * US**2 + jumps, axis=0) - BETA * value)
        value = value + step
        if np.max(np.abs(step)) < 1e-13:
            break
    return value


def held_back(noise=None, controls=None):
    return hjb.Problem(
        lambda x, u: u + 0.2 * x, lambda x, u: x @ x + 0.3 * u @ u, controls or hjb.Box([-1.0], [1.0]),
        discount=BETA, noise=noise,
    )  # fmt: skip


@pytest.mark.filterwarnings("ignore:the optimal drift leaves the box")
@pytest.mark.parametrize(
    ("method", "noise"),
    [
        (None, 0.5),
        (hjb.ValueIteration(), None),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in [
                (None, None), (hjb.ValueIteration(), 0.5),
                (hjb.PolicyIteration(hjb.Direct()), None), (hjb.PolicyIteration(hjb.Direct()), 0.5),
            ]
        ),
    ],
)  # fmt: skip
def test_a_chain_of_ones_own_is_solved_and_certified(method, noise):
    scheme, grid = LaxFriedrichs(1.2), hjb.Grid([-1.0], [1.0], (21,))
    solution = hjb.solve(held_back(noise), grid, scheme=scheme, method=method, tol=1e-8)
    known = dense(noise or 0.0, 1.2)
    np.testing.assert_allclose(solution.value, known, atol=1e-6)  # the table knows two thousand actions
    assert solution.error <= 1e-8
    assert "sample" not in solution.stats["certificate"]
    lane = hjb.solve_batch([held_back(noise)], grid, scheme=scheme, tol=1e-8)[0]
    np.testing.assert_allclose(lane.value, solution.value, atol=2e-8)


@pytest.mark.filterwarnings("ignore:the optimal drift leaves the box", "ignore:the grid is coarse")
@pytest.mark.parametrize("method", [hjb.Explicit(), pytest.param(hjb.Implicit(hjb.Direct()), marks=pytest.mark.slow)])
def test_it_marches_to_its_stationary_value(method):
    grid, scheme = hjb.Grid([-1.0], [1.0], (21,)), LaxFriedrichs(1.2)
    found = hjb.march(held_back(0.5), grid, 30.0, scheme=scheme, method=method).value[0]
    np.testing.assert_allclose(found, dense(0.5, 1.2), atol=1e-5)


def test_its_generator_is_exported():
    policy = np.full((21, 1), 0.4)
    found = chain.generator(held_back(0.5), hjb.Grid([-1.0], [1.0], (21,)), policy, scheme=LaxFriedrichs(1.2)).toarray()
    f, e = 0.4 + 0.2 * X, 0.25 + 0.12
    cell = H * np.where(np.abs(X) < 1, 2 * H, H)  # at a wall half a cell
    np.testing.assert_allclose(np.diag(found, 1), ((e + H * f) / cell)[:-1], atol=1e-10)
    np.testing.assert_allclose(np.diag(found, -1), ((e - H * f) / cell)[1:], atol=1e-10)
    np.testing.assert_allclose(found.sum(axis=1), 0, atol=1e-10)


def test_a_chain_that_is_none_is_refused_by_what_it_lacks():
    @dataclasses.dataclass(frozen=True)
    class Slopes(Scheme):
        monotone, stages = True, 1

        @property
        def chain(self):
            return self

        def slopes(self, around):
            return around.one_sided

    @dataclasses.dataclass(frozen=True)
    class Chainless(Slopes):
        chain = None

    problem, grid = hjb.zoo.bang_bang(shape=(21,))
    with pytest.raises(TypeError, match=r"whose chain .*Slopes.* is not derived from .*Chain"):
        hjb.solve(problem, grid, scheme=Slopes())
    with pytest.raises(TypeError, match="whose chain None is not derived from"):
        hjb.march(problem, grid, 0.1, scheme=Chainless())
    with pytest.raises(TypeError, match="or a custom one derived from hjbjax.discretisation.schemes.Scheme"):
        hjb.solve(problem, grid, scheme=Slopes)


FAST = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-2.0], [2.0]), discount=1.0)
LINE = hjb.Grid([-1.0], [1.0], (41,))


@pytest.mark.parametrize(
    "ask",
    [
        lambda scheme: hjb.solve(FAST, LINE, scheme=scheme),
        lambda scheme: hjb.solve_batch([FAST], LINE, scheme=scheme),
        lambda scheme: hjb.march(FAST, LINE, 0.1, scheme=scheme),
    ],
    ids=["solve", "solve_batch", "march"],
)
def test_a_chain_with_too_little_diffusion_is_refused(ask):
    """It carried half of the drift, converged to .16 for .12, and its bound said 1e-6."""
    with pytest.raises(ValueError, match=r"LaxFriedrichs\(speed=1.0.*too little diffusion at 41 of 41 nodes, first at"):
        ask(LaxFriedrichs(1.0))
    ask(LaxFriedrichs(2.0))


@pytest.mark.slow
def test_a_chain_that_leaves_out_noise_is_refused():
    noisy = dataclasses.replace(FAST, noise=0.5)
    with pytest.raises(ValueError, match="too little diffusion"):
        hjb.solve(noisy, LINE, scheme=LaxFriedrichs(2.0, share=0.5))
    # e may be made of noise and of artificial diffusion: 2 h = .1 stands for a fifth of a = .25 and for no drift
    still = dataclasses.replace(noisy, drift=lambda x, u: 0 * u)
    assert hjb.solve(still, LINE, scheme=LaxFriedrichs(2.0, share=0.8)).status is hjb.Status.CONVERGED
