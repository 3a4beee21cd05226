"""Solves in float32 while JAX is set to 64 bits: under ``jit`` and ``grad`` as on the host."""

import jax
import jax.numpy as jnp
import pytest

import hjbjax as hjb

UNIT = hjb.Box([-1.0], [1.0])
UNIFORM = hjb.Grid([-1.0], [1.0], (41,))
STRETCHED = hjb.Grid([-1.0], [1.0], (41,), stretch=(hjb.Sinh(2.0, 0.0),))


def squares(x, u, *others):
    return 1.0 + x @ x + 0.1 * u @ u


def slowed(x, u, *others):
    return u - 0.2 * x


def from_target(x):
    return jnp.abs(x[0]) - 0.2


MAKERS = {
    "discounted": lambda a: hjb.Problem(slowed, lambda x, u: a * squares(x, u), UNIT, discount=1.0),
    "stopping": lambda a: hjb.Problem(
        slowed, squares, UNIT, discount=1.0, stopping_cost=lambda x: a * (0.4 + 0.2 * x[0] ** 2)
    ),
    "modes": lambda a: hjb.Problem(
        slowed, lambda x, u, mode: a * squares(x, u) + 0.1 * mode, UNIT, discount=1.0,
        modes=hjb.Modes(("a", "b"), rates=[[0, 1.0], [1.0, 0]]),
    ),
    "game": lambda a: hjb.Problem(
        lambda x, u, d: u - 0.2 * x + 0.5 * d, lambda x, u, d: a * squares(x, u) - 0.3 * d @ d, UNIT,
        disturbances=UNIT, discount=1.0,
    ),
    "target": lambda a: hjb.Problem(lambda x, u: a * u, squares, UNIT, target=from_target),
    "noise": lambda a: hjb.Problem(lambda x, u: a * u, squares, UNIT, target=from_target, noise=0.3),
    "jumps": lambda a: hjb.Problem(
        lambda x, u: a * u, squares, UNIT, discount=1.0, jumps=[hjb.Jump(0.5, lambda x, u: -0.5 * x)]
    ),
}  # fmt: skip
DOORS = {
    "solve": lambda problem, grid: hjb.solve(problem, grid, dtype="float32").value,
    "march": lambda problem, grid: hjb.march(problem, grid, 0.5, step=0.005, dtype="float32").value[0],
}
GRIDS = {"uniform": UNIFORM, "stretched": STRETCHED}
CASES = [
    pytest.param(door, kind, GRIDS[name], id=f"{door}-{kind}-{name}", marks=marks)
    for door in DOORS
    for kind in MAKERS
    for name in GRIDS
    for marks in [[] if (door, kind, name) == ("solve", "discounted", "stretched") else pytest.mark.slow]
]


@pytest.mark.parametrize(("door", "kind", "grid"), CASES)
def test_a_transformed_solve_in_float32_is_that_of_the_host(door, kind, grid):
    def total(a):
        return DOORS[door](MAKERS[kind](a), grid).sum()

    with jax.enable_x64(True):
        alone = float(total(0.7))
        value, slope = jax.jit(jax.value_and_grad(total))(jnp.asarray(0.7))
        ahead, behind = (float(total(0.7 + step)) for step in (1e-2, -1e-2))
    assert float(value) == pytest.approx(alone, rel=1e-4)
    assert float(slope) == pytest.approx((ahead - behind) / 2e-2, rel=2e-2)
