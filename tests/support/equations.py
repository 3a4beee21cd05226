"""Random linear equations δ = s + Σ_o w_o δ(x + o) with their dense solutions, for the tests of what solves them."""

import itertools

import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.rates import Rates
from hjbjax.iteration.bellman import PolicyEquation
from hjbjax.problem.grid import Grid

SHAPES = {1: (9,), 2: (6, 5), 3: (4, 3, 5), 4: (3, 4, 2, 3)}
LAYOUTS = [(n, flags) for n in (1, 2) for flags in itertools.product((False, True), repeat=n)]
LAYOUTS += [(3, (False,) * 3), (3, (False, True, False)), (3, (False, False, True)), (3, (True, True, False))]
LAYOUTS += [(4, (False,) * 4), (4, (True, False, True, False)), (4, (False, True, True, True))]
ids = ["".join("p" if flag else "-" for flag in flags) for _, flags in LAYOUTS]


def make_grid(n, flags, shape=None):
    return Grid([0.0] * n, [1.0] * n, shape or SHAPES[n], flags)


def random_equation(rng, grid, leak=0.1, diagonal=False):
    """Substochastic weights with a leak, some nodes held (no weights), and the dense matrix I − W."""
    offsets = [stencil.unit(grid, axis, step) for axis in range(grid.ndim) for step in (1, -1)]
    if diagonal:
        offsets += [(1, 1), (-1, -1)]
    weights = [rng.uniform(0, 1, grid.shape) * rng.choice([0.0, 1.0], grid.shape) for _ in offsets]
    for offset, w in zip(offsets, weights, strict=True):
        for axis, step in enumerate(offset):
            if step:
                w[np.broadcast_to(stencil.on_edge(grid, axis, step), grid.shape)] = 0
    total = sum(weights)
    scale = np.where(rng.random(grid.shape) < 0.1, 0, (1 - leak) / np.where(total > 0, total, 1))
    weights = [w * scale for w in weights]
    source = rng.normal(size=grid.shape)
    dense = stencil.sparse(offsets, [-w for w in weights], np.ones(grid.shape), grid).toarray()
    equation = PolicyEquation(jnp.asarray(source), Rates(tuple(offsets), tuple(map(jnp.asarray, weights))))
    return equation, dense, np.linalg.solve(dense, source.ravel()).reshape(grid.shape)
