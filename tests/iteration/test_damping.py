"""The damping of high-order corrections, and the distance to the limit of their iteration."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hjbjax import Grid
from hjbjax.iteration.damping import Moves, turns_back


@pytest.mark.parametrize(("turned", "shares"), [(True, [0.5, 0.25, 0.125]), (False, [1.0])])
def test_corrections_that_do_not_shrink_are_halved_where_they_turn_back(turned, shares):
    """Once per six equal steps and at most three times; steps that continue in one direction are taken whole."""
    moves = Moves(jnp.full(2, jnp.inf), jnp.inf, jnp.ones(()), jnp.zeros((), int))
    found = []
    for _ in range(30):
        moves = moves.after(moves.share * 1e-3, jnp.asarray(turned))
        found.append(float(moves.share))
    assert list(dict.fromkeys(found[8:])) == shares  # in order, each once
    onwards = dataclasses.replace(moves, since=100)
    assert float(onwards.after(moves.share * 1e-3, False).share) == min(2 * shares[-1], 1)


def test_an_infinite_size_is_not_a_step():
    moves = Moves(jnp.full(2, jnp.inf), jnp.inf, jnp.ones(()), jnp.zeros((), int))
    after = moves.after(jnp.asarray(jnp.inf), jnp.asarray(True))
    assert all(
        np.array_equal(one, other) for one, other in zip(jax.tree.leaves(after), jax.tree.leaves(moves), strict=True)
    )
    assert moves.distance(jnp.asarray(jnp.inf), jnp.zeros(())) == jnp.inf


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_correction_turns_back_where_v_changed_most(sign):
    grid = Grid([0.0], [1.0], (5,))
    change = sign * jnp.array([0.1, 1.0, 0.8, 0.1, 0.0])
    onwards = sign * jnp.array([-9.0, 0.2, -0.1, -9.0, -9.0])  # elsewhere V may ask for what it likes
    assert not turns_back(grid.layout, change, onwards)
    assert turns_back(grid.layout, change, -onwards)
