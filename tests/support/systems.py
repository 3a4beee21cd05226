"""Random problems for the laws: everything random is a leaf, so that an example costs no compilation."""

import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.sets import Box

SHAPES = {1: (7,), 2: (5, 4), 3: (4, 3, 3), 4: (3, 4, 2, 3)}
PERIODIC = {1: (False,), 2: (True, False), 3: (False, True, False), 4: (False, True, False, True)}
SEEDS = st.integers(0, 2**32 - 1)


@pytree_dataclass()
class System:
    """dx = (s ∘ sin(A x + b) + G u + E d) dt + σ dw with cost c·cos(x) + l·u + q·u² + k·d."""

    a: object
    b: object
    scale: object
    gain: object
    push: object
    sigma: object
    state_cost: object
    linear: object
    square: object
    pull: object

    def drift(self, x, u):
        return self.scale * jnp.sin(self.a @ x + self.b) + self.gain @ u

    def drift_of_both(self, x, u, d):
        return self.drift(x, u) + self.push @ d

    def cost(self, x, u):
        return self.state_cost @ jnp.cos(x) + self.linear @ u + self.square @ (u * u)

    def cost_of_both(self, x, u, d):
        return self.cost(x, u) + self.pull @ d

    def noise(self, x, u):
        """Weaker or stronger with the state, by one factor, so that it stays representable."""
        return (1.2 + jnp.sin(self.b @ x)) * self.sigma


def random_grid(rng, n, periodic=True, shape=None):
    shape = shape or SHAPES[n]
    lo = rng.uniform(-2, 0, n)
    flags = PERIODIC[n] if periodic else (False,) * n
    return Grid(lo, lo + rng.uniform(0.5, 3, n), shape, flags)


def random_sigma(rng, grid, kind):
    """σ of one kind; a matrix is one that the chain can represent on the grid, at times only just."""
    n = grid.ndim
    if kind == "none":
        return None
    if kind == "scalar":
        return rng.choice([0.0, 1.0]) * rng.uniform(0, 2)
    if kind == "diagonal":
        return rng.choice([0.0, 1.0], n) * rng.uniform(0, 2, n)
    h = np.array([grid.spacing(axis) for axis in range(n)])
    b = np.triu(rng.uniform(-1, 1, (n, n)), 1)
    b = b + b.T
    b += np.diag(np.sum(np.abs(b), axis=1) + rng.choice([1e-9, 1.0], n) * rng.uniform(0.1, 1, n))
    return np.linalg.cholesky(b * np.outer(h, h)) * rng.uniform(0.2, 5)


def random_system(rng, n, m=1, opponents=0, sigma=None):
    return System(
        a=rng.normal(size=(n, n)),
        b=rng.normal(size=n),
        scale=rng.choice([0.0, 1.0, 3.0], n),
        gain=rng.normal(size=(n, m)) * rng.choice([0.0, 1.0], (n, m), p=[0.25, 0.75]),
        push=rng.normal(size=(n, opponents)),
        sigma=sigma if sigma is not None else 0.0,
        state_cost=rng.normal(size=n),
        linear=rng.normal(size=m),
        square=rng.uniform(-1, 1, m) * rng.choice([0.0, 1.0], m),
        pull=rng.normal(size=opponents),
    )


def random_problem(rng, grid, kind="none", controls=None, discount=0.7, **ingredients):
    """A problem with one player; ``kind`` is that of its noise: none, scalar, diagonal, matrix, function."""
    sigma = random_sigma(rng, grid, "matrix" if kind == "function" else kind)
    controls = Box([-1.0], [1.0]) if controls is None else controls
    system = random_system(rng, grid.ndim, controls.dim, sigma=sigma)
    noise = system.noise if kind == "function" else sigma
    return Problem(system.drift, system.cost, controls, noise=noise, discount=discount, **ingredients)


def random_game(rng, grid, kind, controls, disturbances, **ingredients):
    sigma = random_sigma(rng, grid, kind)
    system = random_system(rng, grid.ndim, controls.dim, disturbances.dim, sigma)
    return Problem(
        system.drift_of_both,
        system.cost_of_both,
        controls,
        disturbances=disturbances,
        noise=sigma,
        discount=0.7,
        **ingredients,
    )
