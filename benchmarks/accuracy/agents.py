"""Returns of feedbacks in the real environments of Gymnasium, next to published agents.

Every environment is posed with the drift and the cost of its documentation, solved once, and played from 100 seeds with
``Solution.predict``.

The published returns are the best of each environment in the table of RL Baselines3 Zoo (DLR-RM/rl-baselines3-zoo,
benchmark.md, commit 0088472), which are means over its own episodes.
"""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import click
import jax.numpy as jnp
import numpy as np

import hjbjax as hjb
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table, without

COLUMNS = ("environment", "nodes", "returns", "deviation", "worst", "published", "agent", "training_steps", "seconds")
PUBLISHED = {  # mean, standard deviation, algorithm, steps of training
    "Pendulum-v1": (-151.855, 90.227, "TD3", 20_000),
    "MountainCarContinuous-v0": (96.672, 0.784, "ARS", 500_000),
    "CartPole-v1": (500.0, 0.0, "DQN", 50_000),
    "Acrobot-v1": (-69.135, 9.967, "QR-DQN", 100_000),
}


class Agent(NamedTuple):
    """A problem on a grid, its options for ``solve``, and the policy of its solution, a function of the observation."""

    problem: hjb.Problem
    grid: hjb.Grid
    policy: Callable[[hjb.Solution], Callable[[np.ndarray], Any]]
    options: dict[str, Any] = {}  # noqa: RUF012


def pendulum(nodes: int = 150) -> Agent:
    """A pendulum that swings up: θ from the upright position, θ'."""

    def drift(x, u):
        return jnp.stack([x[1], 15 * jnp.sin(x[0]) + 3 * u[0]])

    def cost(x, u):
        return (x[0] ** 2 + 0.1 * x[1] ** 2 + 0.001 * u[0] ** 2) / 0.05  # per step of 0.05 s

    def policy(solution):
        return lambda seen: solution.predict([np.arctan2(seen[1], seen[0]), seen[2]])[0]

    grid = hjb.Grid([-jnp.pi, -8.0], [jnp.pi, 8.0], (nodes, nodes + 1), periodic=(True, False))
    return Agent(hjb.Problem(drift, cost, hjb.Box([-2.0], [2.0])), grid, policy)


def mountain_car(nodes: int = 121) -> Agent:
    """A car that gains speed in a valley; the observation is the state and time counts in steps."""

    def drift(x, u):
        return jnp.stack([x[1], 0.0015 * u[0] - 0.0025 * jnp.cos(3 * x[0])])

    # a discount of 1e-4 per step, because without one resting in the valley indefinitely is free
    problem = hjb.Problem(
        drift, reward=lambda x, u: -0.1 * u[0] ** 2, controls=hjb.Box([-1.0], [1.0]), discount=1e-4,
        target=lambda x: 0.45 - x[0], exit_reward=100.0,
    )  # fmt: skip
    grid = hjb.Grid([-1.2, -0.07], [0.6, 0.07], (nodes, nodes))
    return Agent(problem, grid, lambda solution: lambda seen: solution.predict(seen)[0])


def cart_pole(nodes: int = 11) -> Agent:
    """A pole on a cart that is pushed left or right; the observation is the state."""

    def drift(x, u):
        force, s, c = 10 * (2 * u[0] - 1), jnp.sin(x[2]), jnp.cos(x[2])
        mean = (force + 0.05 * x[3] ** 2 * s) / 1.1
        angular = (9.8 * s - c * mean) / (0.5 * (4 / 3 - 0.1 * c**2 / 1.1))
        return jnp.stack([x[1], mean - 0.05 * angular * c / 1.1, x[3], angular])

    def cost(x, u):  # the environment pays for time only; this keeps cart and pole in the middle
        return x[0] ** 2 + 0.1 * x[1] ** 2 + 10 * x[2] ** 2 + 0.1 * x[3] ** 2

    far = np.array([2.4, 3.0, 0.21, 3.0])
    problem = hjb.Problem(drift, cost, hjb.Finite([[0.0], [1.0]]), discount=0.5)
    return Agent(
        problem, hjb.Grid(-far, far, (nodes,) * 4), lambda solution: lambda seen: int(solution.predict(seen)[0][0])
    )


def acrobot(nodes: int = 30) -> Agent:
    """Two links that swing up as fast as possible by a torque between them."""

    def drift(x, u):
        (a, b, da, db), s, c, g = x, jnp.sin, jnp.cos, 9.8
        d1, d2 = 3.5 + c(b), 1.25 + 0.5 * c(b)
        phi2 = 0.5 * g * s(a + b)
        phi1 = -0.5 * db**2 * s(b) - db * da * s(b) + 1.5 * g * s(a) + phi2
        second = (u[0] - 1 + d2 / d1 * phi1 - 0.5 * da**2 * s(b) - phi2) / (1.25 - d2**2 / d1)
        return jnp.stack([da, db, -(d2 * second + phi1) / d1, second])

    def policy(solution):
        def act(seen):
            x = [np.arctan2(seen[1], seen[0]), np.arctan2(seen[3], seen[2]), seen[4], seen[5]]
            return int(solution.predict(x)[0][0])

        return act

    problem = hjb.Problem(
        drift, lambda x, u: 1.0, hjb.Finite([[0.0], [1.0], [2.0]]), discount=0.1,
        target=lambda x: 1 + jnp.cos(x[0]) + jnp.cos(x[0] + x[1]),
    )  # fmt: skip
    far = np.array([np.pi, np.pi, 6.0, 11.0])  # in practice the joints turn no faster
    grid = hjb.Grid(-far, far, (nodes, nodes, 5 * nodes // 6, 5 * nodes // 6), periodic=(True, True, False, False))
    return Agent(problem, grid, policy, {"scheme": hjb.Limited(), "dtype": "float32"})


AGENTS = dict(zip(PUBLISHED, (pendulum, mountain_car, cart_pole, acrobot), strict=True))


def play(environment: str, policy: Callable[[np.ndarray], Any], seeds: int) -> np.ndarray:
    """The returns of a policy in an environment of Gymnasium from the seeds 0, 1, ..."""
    import gymnasium

    found, env = [], gymnasium.make(environment)
    for seed in range(seeds):
        seen, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            seen, reward, terminated, truncated, _ = env.step(policy(seen))
            total, over = total + float(reward), terminated or truncated
        found.append(total)
    return np.array(found)


def measure(environment: str, agent: Agent, seeds: int) -> list[dict[str, Any]]:
    """One row: the returns of the feedback from ``seeds`` initial states, and the published agent."""
    began = time.perf_counter()
    solution = hjb.solve(agent.problem, agent.grid, **agent.options)
    seconds = time.perf_counter() - began
    returns = play(environment, agent.policy(solution), seeds)
    mean, deviation, name, steps = PUBLISHED[environment]
    return [
        {
            "nodes": agent.grid.size, "returns": returns.mean(), "deviation": returns.std(), "worst": returns.min(),
            "published": mean, "published_deviation": deviation, "agent": name, "training_steps": steps,
            "episodes": seeds, "dtype": str(solution.value.dtype), "seconds": seconds, "status": solution.status.name,
        }
    ]  # fmt: skip


def quoted(row: dict[str, Any]) -> str:
    """The line of the documentation for a row."""
    numbers = (f"{row['nodes']:,}", f"{row['returns']:.1f}", f"{row['deviation']:.1f}", f"{row['published']:.1f}")
    agent = (f"{row['published_deviation']:.1f}", row["agent"], f"{row['training_steps']:,}")
    return f"| {row['environment']} | {' | '.join(numbers)} | {' | '.join(agent)} |"


@click.command()
@click.option("--seeds", default=100, show_default=True, help="Episodes per environment.")
@click.option("--only", "names", multiple=True, type=click.Choice(list(AGENTS)), help="Only these environments.")
@click.option("--quick", is_flag=True, help="Two episodes each.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(seeds, names, quick, out):
    """Solve four environments of Gymnasium, play them, and print the mean returns."""
    if (reason := without("gymnasium")) is not None:
        raise click.ClickException(reason)
    rows = []
    for name in names or AGENTS:
        about = {"benchmark": "agents", "environment": name}
        rows += attempt(functools.partial(measure, name, AGENTS[name](), 2 if quick else seeds), about)
        click.echo(table(rows[-1:], COLUMNS))
    publish(out, "agents", rows)
