"""The size of the program of an exact minimum: with noise in two components every drift has three kinks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.problem.settings import own_settings

MIX = jnp.array([[1.0, 0.5], [-0.4, 1.0]])
SQUARE = hjb.Box([-1.0] * 2, [1.0] * 2)
MOST = 3600  # equations; written out they were 13,500, which XLA had not compiled after 100 s


def equations(jaxpr):
    """The number of equations of a program, inner ones included."""
    inner = (each for equation in jaxpr.eqns for each in jax.tree.leaves(list(equation.params.values())))
    bodies = (getattr(each, "jaxpr", each) for each in inner)
    return len(jaxpr.eqns) + sum(equations(body) for body in bodies if hasattr(body, "eqns"))


def posed():
    problem = hjb.Problem(
        lambda t, x, u: (1 + 0.1 * t) * MIX @ u - 0.1 * x, lambda t, x, u: x @ x + u @ u, SQUARE,
        noise=0.3 * jnp.ones(2), time_dependent=True,
    )  # fmt: skip
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (17, 17), edges="open")
    return Discretisation(problem, grid, hjb.Upwind(split=True), np.dtype(np.float64))


def test_two_inputs_in_two_noisy_components():
    with own_settings(x64=True):
        on, value = posed(), jnp.asarray(np.random.default_rng(0).normal(size=(17, 17)))

        def least(value):
            return optimum.optimise(discrete.around(on.at(0.3), value))[0]

        assert equations(jax.make_jaxpr(least)(value).jaxpr) < MOST


@pytest.mark.slow
def test_its_minimum_is_the_least_of_many_actions():
    with own_settings(x64=True):
        on, value = posed(), jnp.asarray(0.05 * np.random.default_rng(0).normal(size=(17, 17)))
        hamiltonian = discrete.around(on.at(0.3), value)
        found = np.asarray(jax.jit(lambda: optimum.optimise(hamiltonian)[0])())
        line = jnp.linspace(-1, 1, 101)
        tried = jax.jit(lambda u: hamiltonian.at([u[0], u[1]], []))
        least = np.min([tried(jnp.array([a, b])) for a in line for b in line], axis=0)
    assert np.all(found <= least + 1e-9)
    assert np.all(found >= least - 5e-3)
