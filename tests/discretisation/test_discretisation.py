"""A problem on a grid: its stored links, its players, and the masks that a scheme receives."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Differences, Discretisation
from hjbjax.problem.pytree import altered

GRID = hjb.Grid([-1.0], [1.0], (6,))
PROBLEM = hjb.Problem(
    lambda x, u: u, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), target=lambda x: jnp.abs(x[0]) - 0.5, discount=1.0
)


def on(problem=PROBLEM, grid=GRID, scheme=None):
    return Discretisation(problem, grid, scheme or hjb.Upwind(subcell=True), "float32")


def test_a_target_cuts_its_links():
    found = on().links[0]
    # the nodes ±0.6 are 0.1 away from the target, the others 0.4 from each other
    np.testing.assert_allclose(found.up, [0.4, 0.1, 0.4, 0.4, 0.4, 0.4], rtol=1e-5)
    np.testing.assert_allclose(found.down, [0.4, 0.4, 0.4, 0.4, 0.1, 0.4], rtol=1e-5)


def test_stored_links_are_those_of_the_same_question():
    """They are kept for another cost and for the chain, and computed again for another target, grid or time."""
    stored = on().with_links()
    asked = altered(PROBLEM, cost=None)
    for same in (stored.asking(asked), stored.with_scheme(hjb.Limited(subcell=True)), stored.chain):
        assert same.links is stored.links
    moved = altered(PROBLEM, target=hjb.Problem(PROBLEM.drift, target=lambda x: jnp.abs(x[0]) - 0.3).target)
    nodes = stored.with_scheme(hjb.Upwind())
    coarse = dataclasses.replace(GRID, shape=(5,))
    np.testing.assert_allclose(stored.asking(moved).links[0].up[1], 0.3, rtol=1e-5)
    assert stored.on_grid(coarse).links[0].up.shape == (5,)
    assert stored.at(1.0).links is not stored.links
    assert nodes.links[0].meets_up is None


def test_players_belong_to_the_problem():
    game = hjb.Problem(
        lambda x, u, d: u + d, lambda x, u, d: u @ u, hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-0.5], [0.5]), discount=1.0,
    )  # fmt: skip
    one = on()
    assert one.players.disturbance.admissible is None
    assert one.asking(game).players.disturbance.admissible is not None
    # the players share the drift: upwinding their drifts separately decouples them on the grid
    assert [on(game, scheme=hjb.Upwind(split=split)).players.decoupled for split in (False, True)] == [False, True]


@pytest.mark.parametrize("noise", [None, 0.5])
def test_a_scheme_receives_the_masks_of_noise(noise):
    problem = hjb.Problem(lambda x, u: 10 * u, None, hjb.Box([-1.0], [1.0]), noise=noise, discount=1.0)
    grid = hjb.Grid([-1.0], [1.0], (41,), edges=(("projected", "open"),))
    where = on(problem, grid)
    value = jnp.zeros(grid.shape, "float32")
    pairs = (stencil.one_sided(value, grid, 0),)
    around = Differences(where, where.coordinates(), value, where.links, pairs)
    assert around.grid is grid
    # noise reflects at the wall, and not at the open end
    assert [{step: bool(np.all(mask)) for step, mask in axis.items()} for axis in around.reflecting] == [
        {} if noise is None else {-1: True}
    ]
    # h |f| = 0.5 exceeds a = 0.25, so central differences are not monotone
    assert around.central is None if noise is None else not np.any(around.central[0])
