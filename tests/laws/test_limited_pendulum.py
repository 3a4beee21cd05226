"""The pendulum against Pontryagin's boundary-value problem: the value is that of the best local extremal.

The angle is periodic and going round can be cheaper, so a local extremal bounds the value from above only. SciPy
solves the Hamiltonian system from many first guesses, which aim at the upright rests at −2π, 0 and 2π.
"""

import dataclasses
import functools

import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo

G = 9.81
HORIZON = 5.0  # the closed loop decays by e^{−2.7 t}, e^{−1.3 t} as printed: what is left is closed by Riccati
COASTS = (0.0, 0.7, 1.0, 1.4, 1.8, 2.2, 2.6)  # seconds without torque before the feedback of a first guess sets in


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclasses.dataclass(frozen=True)
class Hamiltonian:
    """ẋ = H_p, ṗ = −H_x with the torque that minimises H, and the cost on the way; y = (θ, ω, p₁, p₂, cost)."""

    gain: float
    bound: float

    @property
    def riccati(self):
        """P of the value ½x'Px near the upright rest, where the bound is slack."""
        from scipy.linalg import solve_continuous_are

        return solve_continuous_are(
            np.array([[0.0, 1.0], [G, 0.0]]), np.array([[0], [self.gain]]), np.eye(2), np.eye(1)
        )

    def torque(self, p):
        return np.clip(-self.gain * p[1], -self.bound, self.bound)

    def flow(self, t, y):
        angle, omega, p1, p2 = wrapped(y[0]), y[1], y[2], y[3]
        u = self.torque(y[2:4])
        acceleration = G * np.sin(angle) + self.gain * u
        rate = 0.5 * (angle**2 + omega**2 + u**2)
        return np.stack([omega, acceleration, -angle - p2 * G * np.cos(angle), -omega - p1, rate])

    def first_guesses(self, start):
        """Paths that coast, then follow the Riccati feedback as far as the bound allows; its costate along them."""
        from scipy.integrate import solve_ivp

        times, matrix = np.linspace(0, HORIZON, 251), self.riccati
        for coast in COASTS:

            def motion(t, x, coast=coast):
                u = self.torque(matrix @ x) if t >= coast else 0.0
                return [x[1], G * np.sin(x[0]) + self.gain * u]

            path = solve_ivp(motion, (0, HORIZON), start, t_eval=times, max_step=0.05).y
            if np.max(np.abs(path[:, -1])) < 0.5:
                yield times, np.vstack([path, matrix @ path, np.zeros_like(times)])

    @functools.cache  # noqa: B019, of two oracles which stay
    def extremals(self, state):
        """(value, fastest |ω|) of the local extremals from a state, cheapest first."""
        from scipy.integrate import solve_bvp

        matrix, found = self.riccati, []
        for turns in (-1, 0, 1):
            start = np.array([state[0] + 2 * np.pi * turns, state[1]])

            def ends(first, last, start=start):
                return np.concatenate([first[:2] - start, first[4:], last[2:4] - matrix @ last[:2]])

            for times, guess in self.first_guesses(start):
                with np.errstate(all="ignore"):  # nodes crowd at θ = ±π, where the cost has a kink
                    result = solve_bvp(self.flow, ends, times, guess, tol=1e-4, max_nodes=1200)
                last, left = result.y[:, -1], np.sum(result.rms_residuals * np.diff(result.x))
                if left < 1e-3 and np.max(np.abs(last[:2])) < 0.02:  # the equation holds, and the ball is reached
                    found.append((last[4] + 0.5 * last[:2] @ matrix @ last[:2], np.max(np.abs(result.y[1]))))
        return sorted(found)


PENDULUMS = {"gain 1/m": (False, Hamiltonian(1.0, 30.0)), "gain g/m, as printed": (True, Hamiltonian(G, 6.0))}
STATES = ((0.5, 0.0), (np.pi / 4, 0.0), (1.5, -1.0), (2.8, 1.5), (-2.0, -2.0))


@pytest.mark.parametrize("name", PENDULUMS)
@pytest.mark.slow
def test_the_oracle_agrees_with_riccati_near_upright(name):
    as_printed, oracle = PENDULUMS[name]
    near = zoo.pendulum_near_upright(as_printed=as_printed)
    state = np.array([0.04, -0.02])
    assert oracle.extremals(tuple(state))[0][0] == pytest.approx(float(near.value(state)), rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", PENDULUMS)
@pytest.mark.optimised
def test_value_of_the_best_extremal(name):
    as_printed, oracle = PENDULUMS[name]
    problem, grid = zoo.pendulum(as_printed=as_printed, shape=(400, 401))
    solution = hjb.solve(problem, grid, scheme=hjb.Limited(), tol=1e-5)
    assert solution.status is hjb.Status.CONVERGED
    for state in STATES:
        value, fastest = oracle.extremals(state)[0]
        assert fastest < 8  # the path stays in the box
        assert float(solution.value_at(state)) == pytest.approx(value, rel=1e-3), state


@pytest.mark.slow
@pytest.mark.optimised
def test_going_round_is_cheaper():
    """From 45° at rest to let the pendulum fall costs less than to lift it: the value is not that of the direct way."""
    ways = PENDULUMS["gain 1/m"][1].extremals((np.pi / 4, 0.0))
    assert ways[0][0] == pytest.approx(13.3240, abs=1e-3)
    assert ways[0][1] > 5  # falls through the lower rest
    assert any(abs(value - 17.2537) < 1e-3 for value, _ in ways)
    problem, grid = zoo.pendulum(shape=(160, 161))
    limited = hjb.solve(problem, grid, scheme=hjb.Limited(), tol=1e-3)
    plain = hjb.solve(problem, grid, scheme=hjb.Upwind(central=False), tol=1e-3)
    assert float(limited.value_at([np.pi / 4, 0.0])) == pytest.approx(ways[0][0], rel=5e-3)
    assert float(plain.value_at([np.pi / 4, 0.0])) > 1.2 * ways[0][0]


@pytest.mark.slow
@pytest.mark.optimised
def test_the_main_job_is_near_the_truth_and_says_how_near():
    problem, grid = zoo.pendulum()
    solution, oracle = hjb.solve(problem, grid), PENDULUMS["gain 1/m"][1]
    for state in STATES:
        assert float(solution.value_at(state)) == pytest.approx(oracle.extremals(state)[0][0], rel=1e-2), state
    fine = hjb.solve(problem, zoo.pendulum(shape=(800, 801))[1], scheme=hjb.Limited())
    true = np.mean(np.abs(solution.value - fine.value[::4, ::4]))
    assert true / 3 <= np.mean(solution.grid_error) <= 3 * true
