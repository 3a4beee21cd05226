"""The H-infinity level against the Hamiltonian matrix, what saturates, and energies along paths."""

import collections
import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.applications import hinf
from hjbjax.applications.hinf import Trial
from hjbjax.applications.level import comes_back
from hjbjax.feedback.path import PathStatus
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.sets import Ball, Box, Finite


@dataclasses.dataclass(frozen=True, eq=False)
class Linear:
    """ẋ = A x + B u + E d, z = (C x, u), on the box |x_i| ≤ 1, with |u_j| and |d_j| at most ``bound``."""

    a: list
    b: list
    e: list
    c: list
    bound: float = 4.0

    def matrices(self):
        return tuple(np.array(matrix, float) for matrix in (self.a, self.b, self.e, self.c))

    @functools.cache  # noqa: B019  # one set of functions, so that nothing compiles twice
    def plant(self):
        a, b, _, c = self.matrices()
        controls = Box([-self.bound] * b.shape[1], [self.bound] * b.shape[1])
        return hjb.Problem(lambda x, u: a @ x + b @ u, lambda x, u: 0.5 * ((c @ x) @ (c @ x) + u @ u), controls)

    def game(self):
        plant, (_, _, e, _) = self.plant(), self.matrices()
        disturbances = Box([-self.bound] * e.shape[1], [self.bound] * e.shape[1])
        return lambda gamma: hjb.attenuation(plant, gamma, disturbances, enters=e)

    def riccati(self, gamma):
        """P ≥ 0 of the stabilising solution, from the stable eigenvectors of the Hamiltonian matrix; or None."""
        a, b, e, c = self.matrices()
        n = len(a)
        hamiltonian = np.block([[a, e @ e.T / gamma**2 - b @ b.T], [-c.T @ c, -a.T]])
        values, vectors = np.linalg.eig(hamiltonian)
        if np.min(np.abs(values.real)) < 1e-7:
            return None
        stable = vectors[:, values.real < 0]
        p = np.real(stable[n:] @ np.linalg.pinv(stable[:n]))
        return p if np.min(np.linalg.eigvalsh(p + p.T)) > -1e-9 else None

    def level(self):
        lo, hi = 1e-2, 1e2
        for _ in range(60):
            middle = np.sqrt(lo * hi)
            lo, hi = (middle, hi) if self.riccati(middle) is None else (lo, middle)
        return hi


LAG = Linear([[-1.0]], [[1.0]], [[1.0]], [[1.0]])
INTEGRATOR = Linear([[0.0]], [[1.0]], [[1.0]], [[1.0]], bound=6.0)
OSCILLATOR = Linear([[0.0, 1.0], [-1.0, -0.5]], [[0.0], [1.0]], [[0.0], [1.0]], [[1.0, 0.0], [0.0, 0.0]], bound=3.0)


def cube(n, count):
    return hjb.Grid([-1.0] * n, [1.0] * n, (count,) * n)


@pytest.fixture(scope="module")
def oscillator():
    """Its level on a coarse grid: one bisection for several tests."""
    return hjb.hinf_level(OSCILLATOR.game(), cube(2, 17), 0.85, 1.0, horizon=32.0)


def test_the_oracle_agrees_with_scipy():
    from scipy.linalg import solve_continuous_are

    for system in (LAG, INTEGRATOR, OSCILLATOR):
        a, b, e, c = system.matrices()
        gamma = 1.5 * system.level()
        both, weights = np.hstack([b, e]), np.diag([1.0] * b.shape[1] + [-(gamma**2)] * e.shape[1])
        p = solve_continuous_are(a, both, c.T @ c, weights)
        np.testing.assert_allclose(system.riccati(gamma), p, atol=1e-8)
    assert LAG.level() == pytest.approx(0.5**0.5)
    assert INTEGRATOR.level() == pytest.approx(1.0)


@pytest.mark.slow
def test_the_level_of_an_oscillator(oscillator):
    """P stays finite at the level: above it V settles, below it V grows at the end of every march."""
    wanted = OSCILLATOR.level()
    assert oscillator.gamma == pytest.approx(wanted, rel=0.02)
    assert oscillator.bracket[1] == oscillator.gamma <= 1.01 * oscillator.bracket[0]
    gammas = [trial.gamma for trial in oscillator.trials]
    assert gammas == sorted(gammas)
    for trial in oscillator.trials:
        assert trial.feasible == (trial.gamma >= oscillator.gamma) == (trial.reason == "settled")
        assert trial.feasible or trial.growth > 0.03
    top = oscillator.trials[-1]
    p = OSCILLATOR.riccati(top.gamma)
    x = np.array([0.25, 0.25])
    assert top.value == pytest.approx(0.5 * x @ p @ x, rel=0.05)
    assert "least level 0.9" in str(oscillator)
    assert oscillator.stabilises is True
    assert oscillator.saturated == 0.0
    cut = dataclasses.replace(oscillator.trials[0], reason="saturated")
    beside = dataclasses.replace(oscillator, trials=(cut, *oscillator.trials[1:]))
    assert f"at gamma = {cut.gamma:.4g} and below saturation decided, not growth" in str(beside)
    assert "stabilise" not in str(oscillator)
    assert repr(oscillator).startswith("Level(gamma=0.9")


@pytest.mark.slow
def test_the_level_of_a_lag():
    """ẋ = −x + u + d: γ = 1/√2, with a level of its own from a ball of disturbances."""
    game = LAG.game()
    box = hjb.hinf_level(game, cube(1, 21), 0.6, 0.9, horizon=32.0)
    assert box.gamma == pytest.approx(LAG.level(), rel=0.02)

    def in_a_ball(gamma):
        return dataclasses.replace(game(gamma), disturbances=Ball(4.0, 1))

    ball = hjb.hinf_level(in_a_ball, cube(1, 21), 0.69, 0.73, horizon=32.0, tol=0.03)
    assert ball.gamma == pytest.approx(LAG.level(), rel=0.04)


@pytest.mark.slow
def test_the_level_of_an_integrator():
    """ẋ = u + d: γ = 1, where P grows without bound."""
    level = hjb.hinf_level(INTEGRATOR.game(), cube(1, 41), 0.95, 1.1)
    assert level.gamma == pytest.approx(1.0, rel=0.02)
    assert all(trial.growth > 0.1 for trial in level.trials if not trial.feasible)


@pytree_dataclass()
class Scalar:
    """ẋ = a x + u + e d, z = (c x, u), all numbers leaves."""

    a: object
    e: object
    c: object

    def drift(self, x, u):
        return self.a * x + u

    def cost(self, x, u):
        return 0.5 * (self.c**2 * x @ x + u @ u)

    def entry(self, x):
        return jnp.full((1, 1), self.e)


@pytest.mark.slow
@settings(max_examples=8)
@given(st.floats(-2.0, -0.5), st.floats(0.5, 1.5), st.floats(0.5, 1.4))
def test_the_level_of_any_stable_scalar_plant(a, e, c):
    """γ² = e²c²/(a² + c²), where P = c²/|a|, at most 4: the bound of 6 on both players is slack."""
    wanted = e * c / np.hypot(a, c)
    system = Scalar(a, e, c)
    plant = hjb.Problem(system.drift, system.cost, Box([-6.0], [6.0]))

    def game(gamma):
        return hjb.attenuation(plant, gamma, Box([-6.0], [6.0]), enters=system.entry)

    level = hjb.hinf_level(game, cube(1, 41), 0.8 * wanted, 1.2 * wanted)
    assert level.gamma == pytest.approx(wanted, rel=0.02)


# --- a nonlinear plant, whose gain grows towards the ends of the box ---


def hardening(gamma):
    """ẋ = −x + x³ + u + d with z = (x, u)."""
    plant = hjb.Problem(lambda x, u: -x + x**3 + u, lambda x, u: 0.5 * (x @ x + u @ u), Box([-6.0], [6.0]))
    return hjb.attenuation(plant, gamma, Box([-6.0], [6.0]))


def level_up_to(b):
    """The level on |x| ≤ b: the discriminant (x − x³)² − (1/γ² − 1) x² is negative first where |x| is largest."""
    return 1 / np.sqrt(1 + (1 - b**2) ** 2)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the box decides V")
def test_a_plateau_near_the_rest_point_is_not_settled():
    """At γ = 0.87 V(0.08) stays at 0.0018 up to T = 8 and is 12.4 at T = 128."""
    grid = hjb.Grid([-0.8], [0.8], (41,))
    with pytest.raises(ValueError, match=r"hi = 0.87 is not feasible: V still grew by 0\.\d+ of itself"):
        hjb.hinf_level(hardening, grid, 0.6, 0.87)


def test_a_plateau_that_ends_late_is_found_by_the_march_to_the_horizon(monkeypatch):
    """A march that grows again after it had settled: the γ above is reported, and marched to the horizon itself."""
    marched = collections.defaultdict(float)

    def march(problem, grid, span, *, start, **options):
        gamma = float(problem.cost.args[1])
        marched[gamma] += span
        grows = gamma < 0.65 or (gamma < 0.8 and marched[gamma] > 16)
        actions = np.zeros((1, *grid.shape, 1))
        value = (start + 1 if grows else np.ones(grid.shape))[None]
        return hjb.Solution(grid, value, actions, actions, times=np.zeros(1), code=int(hjb.Status.CONVERGED))

    monkeypatch.setattr(hinf, "march_part", march)
    monkeypatch.setattr(hinf, "comes_back", lambda *given: True)
    level = hjb.hinf_level(LAG.game(), cube(1, 21), 0.6, 1.0, horizon=32.0)
    assert 0.8 <= level.gamma <= 0.81
    reported = next(trial for trial in level.trials if trial.gamma == level.gamma)
    assert reported.time == 32.0
    assert all(trial.reason == "growing" for trial in level.trials if trial.gamma < 0.8)
    assert marched[1.0] < 32.0  # only what is reported goes on to the horizon


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.filterwarnings("ignore:the box decides V")
@pytest.mark.parametrize(("count", "least", "most"), [(41, 0.87, 0.97), (161, 0.92, 0.97)])
def test_the_level_of_a_nonlinear_plant_is_that_of_the_box(count, least, most):
    level = hjb.hinf_level(hardening, hjb.Grid([-0.8], [0.8], (count,)), 0.8, 1.2)
    assert level_up_to(0.8) == pytest.approx(0.9409, abs=1e-4)
    assert least <= level.gamma <= most
    assert level.stabilises is True


UNSEEN = Linear([[0.5, 0.0], [0.0, -1.0]], [[1.0], [1.0]], [[0.0], [1.0]], [[0.0, 1.0]], bound=12.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the optimal drift leaves the box")
def test_an_unstable_mode_that_the_cost_does_not_see():
    """ẋ₁ = ½x₁ + u at no cost: 1/√2 is the level without stability, .8354 that of a stabilising feedback."""
    grid = hjb.Grid([-2.0] * 2, [2.0] * 2, (21, 21))
    level = hjb.hinf_level(UNSEEN.game(), grid, 0.6, 0.8, tol=0.15, horizon=32.0)
    assert level.gamma < 0.99 * UNSEEN.level()
    assert level.stabilises is False
    assert "feasible, but the feedback does not stabilise" in str(level)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "stable"), [(-1.0, True), (0.0, False), (0.5, False)])
def test_the_undisturbed_loop_of_a_mode_without_control(rate, stable):
    """ẋ = a x comes back for a < 0 alone; resting is not coming back."""
    plant = hjb.Problem(lambda x, u: rate * x + 0 * u, lambda x, u: 0.5 * (u @ u), Box([-1.0], [1.0]))
    grid = cube(1, 5)
    feedback = hjb.Solution(grid, np.zeros(5), np.zeros((5, 1)), np.zeros((5, 1)))
    game = hjb.attenuation(plant, 1.0, Box([-1.0], [1.0]))
    assert comes_back(game, feedback, 0.25, 8.0) is stable


def test_a_bound_that_is_felt_is_infeasible():
    """At γ = 1.01 the worst disturbance is 7.1 x: with a bound of 1 it saturates within the inner quarter."""
    narrow = dataclasses.replace(INTEGRATOR, bound=1.0)
    with pytest.raises(
        ValueError, match=r"(?s)hi = 1.01 is not feasible: the worst .* is at its bound at .*wider sets"
    ) as e:
        hjb.hinf_level(narrow.game(), cube(1, 41), 0.5, 1.01)
    assert len(str(e.value).splitlines()) <= 6


@pytest.mark.parametrize("scheme", [hjb.Upwind(split=True), pytest.param(hjb.Weno5(), marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore:the grid is coarse")
def test_a_march_goes_on_from_another(scheme):
    problem, grid = LAG.game()(0.9), cube(1, 21)
    options = {"scheme": scheme, "step": 1 / 256}
    whole = hjb.march(problem, grid, 2.0, **options)
    half = hjb.march(problem, grid, 1.0, **options)
    rest = hjb.march(problem, grid, 1.0, start=half.value[0], **options)
    np.testing.assert_allclose(rest.value[0], whole.value[0], rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"march: start has shape \(3,\), the grid \(21,\)"):
        hjb.march(problem, grid, 1.0, start=np.zeros(3), scheme=scheme)


@pytest.mark.parametrize(
    ("changes", "error", "reason"),
    [
        ({"lo": 0.9, "hi": 0.9}, ValueError, r"got lo = 0.9 and hi = 0.9, wanted lo < hi"),
        ({"lo": -1.0}, ValueError, r"hinf_level: lo = -1.0; wanted a finite number > 0"),
        ({"hi": np.inf}, ValueError, r"hi = inf"),
        ({"tol": 0.0}, ValueError, r"tol = 0.0; wanted a number > 0 and at most 1"),
        ({"inner": 2.0}, ValueError, r"inner = 2.0"),
        ({"inner": 0.05}, ValueError, r"inner = 0.05 of \(21,\) nodes contains fewer than 3 along an axis"),
        ({"settle": 0.7}, ValueError, r"settle = 0.7"),
        ({"horizon": "long"}, ValueError, r"horizon = 'long'"),
        ({"problem_of_gamma": 3}, TypeError, r"problem_of_gamma is 3, wanted a function"),
        ({"problem_of_gamma": lambda gamma: gamma}, TypeError, r"problem_of_gamma\(0.9\) returned 0.9"),
        ({"problem_of_gamma": lambda gamma: LAG.plant()}, ValueError, r"has disturbances None; wanted a Box or a Ball"),
        (
            {"problem_of_gamma": lambda gamma: dataclasses.replace(LAG.game()(gamma), noise=0.1)},
            ValueError,
            r"the problem has a noise, with which V does not show a gain",
        ),
        (
            {"problem_of_gamma": lambda gamma: dataclasses.replace(LAG.game()(gamma), discount=0.5)},
            ValueError,
            r"the problem has discount = 0.5, with which V settles even if the gain is violated",
        ),
        (
            {"problem_of_gamma": lambda gamma: dataclasses.replace(LAG.game()(gamma), target=lambda x: x @ x - 0.1)},
            ValueError,
            r"the problem has a target, with which V does not show a gain",
        ),
    ],
)
def test_bad_input_is_refused(changes, error, reason):
    arguments = {"problem_of_gamma": LAG.game(), "grid": cube(1, 21), "lo": 0.6, "hi": 0.9} | changes
    with pytest.raises(error, match=reason) as caught:
        hjb.hinf_level(**arguments)
    assert len(str(caught.value).splitlines()) <= 6


def test_brackets_that_do_not_hold_the_level():
    game, grid = LAG.game(), cube(1, 21)
    with pytest.raises(ValueError, match=r"(?s)hi = 0.6 is not feasible: V still grew by 0.5.* longer horizon"):
        hjb.hinf_level(game, grid, 0.5, 0.6, horizon=32.0)
    with pytest.raises(ValueError, match=r"lo = 0.8 is feasible: V settles at .* use a smaller lo"):
        hjb.hinf_level(game, grid, 0.8, 0.9, horizon=32.0)


def test_a_march_that_runs_out_of_time_is_no_verdict():
    with pytest.raises(hjb.SolveError, match=r"hinf_level: at gamma = 0.9") as caught:
        hjb.hinf_level(LAG.game(), cube(1, 21), 0.6, 0.9, time_limit=1e-9)
    level = caught.value.solution
    assert (level.status, level.gamma, level.bracket) == (hjb.Status.TIME_LIMIT, np.inf, (0.0, np.inf))
    assert [trial.reason for trial in level.trials] == ["out of time"]
    assert level.solution is level.trials[0].solution
    assert "out of time" in str(level)


def test_the_marches_of_one_gamma_share_its_time(monkeypatch):
    now, limits = [100.0], []

    def slow(*arguments, time_limit, **options):
        limits.append(time_limit)
        now[0] += 3.0
        return hjb.march(*arguments, **options)

    monkeypatch.setattr(hinf, "march_part", slow)
    monkeypatch.setattr(hinf, "perf_counter", lambda: now[0])
    with pytest.raises(ValueError, match=r"hi = 0.6 is not feasible"):
        hjb.hinf_level(LAG.game(), cube(1, 21), 0.5, 0.6, horizon=8.0, time_limit=10.0)
    assert limits[:4] == [10.0, 7.0, 4.0, 1.0]
    assert max(limits[4:]) < 1e-3


# --- the problem and its saturation ---


def test_attenuation_is_the_game_of_the_zoo():
    """The zoo's cost is x² + u² − γ²d²: twice a half."""
    plant = hjb.Problem(lambda x, u: 0.3 * x + u, lambda x, u: 0.5 * (x @ x + u @ u), Box([-4.0], [4.0]))
    mine, (game, _) = hjb.attenuation(plant, 1.7, Box([-4.0], [4.0])), zoo.lq_game(gamma=1.7, rate=0.3)
    for x, u, d in np.random.default_rng(0).normal(size=(5, 3, 1)):
        np.testing.assert_allclose(mine.drift(x, u, d), game.drift(x, u, d), rtol=1e-6)
        np.testing.assert_allclose(2 * mine.cost(x, u, d), game.cost(x, u, d), rtol=1e-5, atol=1e-6)


def test_attenuation_with_a_field_of_the_state_and_with_time():
    plant = hjb.Problem(
        lambda t, x, u: x * t + u,
        lambda t, x, u: x @ x,
        Box([-1.0] * 2, [1.0] * 2),
        noise=lambda t, x, u: x,
        time_dependent=True,
    )
    game = hjb.attenuation(plant, 3.0, Box([-1.0], [1.0]), enters=lambda x: x[:, None])
    x, u, d = jnp.array([1.0, 2.0]), jnp.array([0.5, 0.0]), jnp.array([2.0])
    np.testing.assert_allclose(game.drift(2.0, x, u, d), [4.5, 8.0])
    assert float(game.cost(2.0, x, u, d)) == pytest.approx(5 - 18)
    np.testing.assert_allclose(game.noise(2.0, x, u, d), x)


def test_attenuation_refuses():
    plant, box = LAG.plant(), Box([-1.0], [1.0])
    with pytest.raises(ValueError, match=r"already has disturbances"):
        hjb.attenuation(LAG.game()(1.0), 2.0, box)
    with pytest.raises(ValueError, match=r"the problem has no cost"):
        hjb.attenuation(dataclasses.replace(plant, cost=None), 2.0, box)
    for gamma in (0.0, -1.0, np.nan, [1.0]):
        with pytest.raises(ValueError, match=r"got gamma = .* wanted a finite number > 0"):
            hjb.attenuation(plant, gamma, box)


def solution_with(disturbance, grid, **more):
    return hjb.Solution(grid, np.zeros(grid.shape), np.zeros((*grid.shape, 1)), np.asarray(disturbance, float), **more)


def test_saturation_is_counted_in_the_inner_box():
    grid = hjb.Grid([-1.0], [1.0], (9,))
    d = np.array([9, 9, 3, 0, 1, np.nan, 3, 9, 9])[:, None]
    problem = hjb.Problem(lambda x, u, d: u + d, None, Box([-1.0], [1.0]), disturbances=Box([-1.0], [3.0]))
    found = hjb.saturation(solution_with(d, grid), problem, inner=0.5)
    assert found.share == pytest.approx(2 / 4)  # NaN is no disturbance
    assert found.largest == pytest.approx(1.0)  # from the middle of the set, which is 1
    assert found.state == pytest.approx([-0.5])
    assert "50 % of the nodes of the inner 0.5 of the box" in str(found)
    ball = dataclasses.replace(problem, disturbances=Ball(6.0, 1))
    assert hjb.saturation(solution_with(d, grid), ball, inner=0.5).largest == pytest.approx(0.5)
    assert hjb.saturation(solution_with(d, grid), ball, inner=0.5).share == 0
    marched = solution_with(np.stack([d, 0 * d]), grid, times=np.array([0.0, 1.0]))
    assert hjb.saturation(marched, problem, inner=0.5).share == found.share


def test_saturation_refuses():
    grid = hjb.Grid([-1.0], [1.0], (9,))
    problem = LAG.game()(1.0)
    solution = solution_with(np.full((9, 1), np.nan), grid)
    with pytest.raises(ValueError, match=r"no disturbances; give Problem"):
        hjb.saturation(solution, LAG.plant())
    with pytest.raises(ValueError, match=r"are 2 points; wanted a Box or a Ball"):
        hjb.saturation(solution, dataclasses.replace(problem, disturbances=Finite([[0.0], [1.0]])))
    with pytest.raises(ValueError, match=r"inner = 0; wanted a share"):
        hjb.saturation(solution, problem, inner=0)
    with pytest.raises(ValueError, match=r"no node with a disturbance in the inner 0.5"):
        hjb.saturation(solution, problem)


# --- the dissipation inequality ---

STARTS = [[0.25, 0.25], [0.25, -0.125], [-0.125, 0.25]]  # nodes: between them V is interpolated


@pytest.fixture(scope="module")
def top(oscillator) -> Trial:
    """γ = 1, a tenth above the level."""
    return oscillator.trials[-1]


def resonant(t, x):
    """Near the frequency at which the closed loop answers most."""
    return 0.2 * jnp.sin(0.97 * t)[None]


@pytest.fixture(scope="module")
def energies(top):
    game = OSCILLATOR.game()(top.gamma)
    return hjb.dissipation(game, top.solution, STARTS, 15.0, disturbances=[resonant], random=6, key=3)


@pytest.mark.slow
def test_the_inequality_holds_along_paths(top, energies):
    kinds = np.array(energies.disturbances)
    assert [int(np.sum(kinds == kind)) for kind in ("worst case", "random", "given")] == [3, 18, 3]
    np.testing.assert_allclose(energies.stored, top.solution.value_at(np.tile(STARTS, (8, 1))))
    np.testing.assert_allclose(energies.margin, energies.stored + energies.supplied - energies.output)
    largest = energies.stored.max()
    assert energies.worst == energies.margin.min() >= -0.01 * largest
    assert np.all(energies.margin[kinds != "worst case"] > 0)
    assert np.all(energies.margin[kinds == "worst case"] < 0.05 * largest)  # it is tight
    assert np.all(energies.supplied >= 0)
    assert np.ptp(np.log10(energies.supplied[kinds == "random"])) > 2
    assert "worst case" in str(energies)


@pytest.mark.slow
def test_the_inequality_fails_below_the_level(top):
    """What is stored at γ = 1 does not cover a gain of .7: the check can fail."""
    below = OSCILLATOR.game()(0.7)
    found = hjb.dissipation(below, top.solution, STARTS, 60.0, disturbances=[resonant], random=6)
    assert np.all(found.margin[-3:] < -0.1)
    assert found.worst < 0


@pytest.mark.slow
def test_the_energies_are_those_of_simulate(top, energies):
    """Both integrals against quadrature along a path of ``simulate``."""
    path = hjb.simulate(OSCILLATOR.game()(top.gamma), top.solution, STARTS[0], 15.0, steps=6000)
    squares = 0.5 * np.sum(path.disturbances**2, -1)
    supplied = top.gamma**2 * np.sum(squares * np.diff(path.times))
    assert energies.supplied[0] == pytest.approx(supplied, rel=2e-3)
    assert energies.output[0] - energies.supplied[0] == pytest.approx(path.cost, rel=1e-3)
    assert energies.statuses[0] is PathStatus.DURATION
    np.testing.assert_allclose(energies.ends[0], path.states[-1], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "error", "reason"),
    [
        ({"problem": OSCILLATOR.plant()}, ValueError, r"wanted a game with a cost"),
        ({"problem": dataclasses.replace(OSCILLATOR.game()(1.0), noise=0.1)}, ValueError, r"holds in the mean only"),
        ({"x0s": [[0.0, 0.0, 0.0]]}, ValueError, r"x0s has shape \(1, 3\), wanted \(k, 2\)"),
        ({"x0s": [[0.0, 2.0]]}, ValueError, r"a start is outside the grid"),
        ({"duration": 0.0}, ValueError, r"duration is 0.0"),
        ({"random": -1}, ValueError, r"random is -1"),
        ({"disturbances": [1.0]}, TypeError, r"got 1.0 among the disturbances"),
    ],
)
def test_dissipation_refuses(top, changes, error, reason):
    arguments = {"problem": OSCILLATOR.game()(1.0), "solution": top.solution, "x0s": STARTS, "duration": 1.0} | changes
    with pytest.raises(error, match=reason):
        hjb.dissipation(**arguments)


@pytest.mark.slow
def test_random_disturbances_stay_in_a_box_without_zero():
    """ẋ = −x and cost −½d²: what is supplied is ½∫d², with 1 ≤ d ≤ 2."""
    problem = hjb.Problem(
        lambda x, u, d: -x + 0 * d, lambda x, u, d: -0.5 * (d @ d), Box([-1.0], [1.0]), disturbances=Box([1.0], [2.0])
    )
    solution = solution_with(np.ones((5, 1)), hjb.Grid([-1.0], [1.0], (5,)))
    found = hjb.dissipation(problem, solution, [0.5], 2.0, random=4)
    assert np.all((found.supplied >= 1 - 1e-6) & (found.supplied <= 4))
    assert np.ptp(found.supplied) > 0.5


@pytest.mark.slow
def test_random_disturbances_of_a_finite_set_are_refused():
    problem = hjb.Problem(
        lambda x, u, d: -x + 0 * d,
        lambda x, u, d: -0.5 * (d @ d),
        Box([-1.0], [1.0]),
        disturbances=Finite([[0.0], [1.0]]),
    )
    solution = solution_with(np.ones((5, 1)), hjb.Grid([-1.0], [1.0], (5,)))
    with pytest.raises(
        ValueError, match=r"the disturbances are 2 points, .* wanted a Box, a Ball or a Simplex, or random=0"
    ):
        hjb.dissipation(problem, solution, [0.5], 2.0)
    assert hjb.dissipation(problem, solution, [0.5], 2.0, random=0).supplied == pytest.approx(1.0)


@pytest.mark.slow
def test_dissipation_refuses_a_marched_solution(top):
    marched = dataclasses.replace(top.solution, times=np.array([0.0]))
    with pytest.raises(ValueError, match=r"wanted a stationary problem and solution"):
        hjb.dissipation(OSCILLATOR.game()(1.0), marched, STARTS, 1.0)
