"""The problems that are timed, at any size, except the ones in ``speed.march``."""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np

import hjbjax as hjb
from hjbjax.zoo.minimum_time import DoubleIntegrator

ARRIVAL = DoubleIntegrator().arrival_time


def pendulum(nodes: int, actions: int | None = 21, mass: float = 1.0) -> tuple[hjb.Problem, hjb.Grid]:
    """The zoo's pendulum on nodes x (nodes + 1), discount 0.1; ``actions`` torques, or a continuum for ``None``."""
    problem, grid = hjb.zoo.pendulum(mass=mass, discount=0.1, shape=(nodes, nodes + 1))
    if actions is not None:
        problem = dataclasses.replace(problem, controls=problem.controls.grid(actions))
    return problem, grid


def saving(nodes: int, actions: int) -> tuple[hjb.Problem, hjb.Grid]:
    """The zoo's saving with two incomes on ``nodes`` levels of wealth, with ``actions`` levels of consumption."""
    problem, grid = hjb.zoo.saving(shape=(nodes,))
    return dataclasses.replace(problem, controls=problem.controls.grid(actions)), grid


def undiscounted_pendulum(nodes: int) -> tuple[hjb.Problem, hjb.Grid]:
    """The zoo's pendulum without a discount, brought to rest at the top; nodes x (nodes + 1)."""
    return hjb.zoo.pendulum(shape=(nodes, nodes + 1))


def dubins(nodes: int, discount: float) -> tuple[hjb.Problem, hjb.Grid]:
    """The zoo's car to a disc of radius 0.5, on [−3, 3]² × [−π, π) with (nodes + 1)² · nodes nodes."""
    problem, _ = hjb.zoo.dubins(radius=0.5, discount=discount)
    lo, hi = [-3.0, -3.0, -math.pi], [3.0, 3.0, math.pi]
    return problem, hjb.Grid(lo, hi, (nodes + 1, nodes + 1, nodes), periodic=(False, False, True))


def manipulator(nodes: int) -> tuple[hjb.Problem, hjb.Grid]:
    """The zoo's arm of two links, discount 0.5; nodes² angles and (nodes + 1)² velocities."""
    return hjb.zoo.manipulator(links=2, discount=0.5, shape=(nodes, nodes, nodes + 1, nodes + 1))


def double_integrator(nodes: int) -> tuple[hjb.Problem, hjb.Grid]:
    """Minimum time of the double integrator on [−1, 1]², exact values on {T ≤ 0.5} and at the ends of the box."""
    problem, _ = hjb.zoo.double_integrator()
    return dataclasses.replace(problem, target=_within_half), hjb.Grid([-1.0, -1.0], [1.0, 1.0], (nodes, nodes))


def integrators(shape: tuple[int, ...], actions: int = 3) -> tuple[hjb.Problem, hjb.Grid]:
    """A chain of integrators in any dimension with a force at its end: a simple problem with few controls."""
    dim = len(shape)
    problem = hjb.Problem(_push, _effort, hjb.Box([-1.0], [1.0]).grid(actions), discount=0.5)
    return problem, hjb.Grid([-1.0] * dim, [1.0] * dim, shape)


def apart(dim: int, nodes: int) -> tuple[hjb.Problem, hjb.Grid]:
    """Independent states, each with its own input.

    V, and also the value of the chain, is the sum of ``dim`` values of one state; the benchmark checks this.
    """
    problem = hjb.Problem(_decay, _effort, hjb.Box([-1.0] * dim, [1.0] * dim), discount=0.5)
    return problem, hjb.Grid([-1.0] * dim, [1.0] * dim, (nodes,) * dim)


def side_by_side(count: int, nodes: int) -> tuple[hjb.Problem, hjb.Grid]:
    """``count`` double integrators, each with its own input; V and the value of the chain are sums of their values."""
    problem = hjb.Problem(_push_each, _effort, hjb.Box([-1.0] * count, [1.0] * count), discount=2.0)
    return problem, hjb.Grid([-1.0] * 2 * count, [1.0] * 2 * count, (nodes,) * 2 * count)


def inner(x: Any) -> Any:
    """True where the value of the zoo's "smooth" does not depend on the ends of the box."""
    return (jnp.abs(x[0]) <= 0.5) & (jnp.abs(x[1]) <= 0.45)


def sum_over_axes(value: np.ndarray, dim: int) -> np.ndarray:
    """Σ_i v(x_i) on the grid of ``dim`` axes, from v at the nodes of one axis."""
    total = np.zeros((1,) * dim)
    for axis in range(dim):
        total = total + value.reshape([-1 if i == axis else 1 for i in range(dim)])
    return total


def _within_half(x: Any) -> Any:
    return jnp.minimum(ARRIVAL(x) - 0.5, 1 - 1e-6 - jnp.max(jnp.abs(x)))


def _push(x: Any, u: Any) -> Any:
    return jnp.concatenate([x[1:], u])


def _push_each(x: Any, u: Any) -> Any:
    return jnp.stack([x[1::2], u], axis=1).ravel()


def _decay(x: Any, u: Any) -> Any:
    return u - 0.5 * x


def _effort(x: Any, u: Any) -> Any:
    return x @ x + 0.5 * (u @ u)
