"""Small questions, well and badly put, and what refuses them."""

import jax.numpy as jnp
import pytest

from hjbjax import Box, Grid, Problem
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.schemes import Upwind
from hjbjax.tracing import checks
from hjbjax.well_posedness import node_checks

GRID = Grid([-1.0, -2.0], [1.0, 2.0], (5, 9))
U = Box([-1.0], [1.0])


def drift(x, u):
    return jnp.stack([x[1], u[0]])


def in_disc(x):
    return jnp.linalg.norm(x) - 0.6


def refused(ask, match, grid=GRID, cause=None, **ingredients):
    """The message of the ValueError with which ``checks`` ("shapes") or the survey ("values") refuse a problem."""
    problem = Problem(**({"drift": drift, "controls": U} | ingredients))
    if ask == "values":
        checks.shapes(problem, grid, Upwind())
    asked = {
        "shapes": lambda: checks.shapes(problem, grid, Upwind()),
        "values": lambda: node_checks.check_values(Discretisation(problem, grid, Upwind(), "float64")),
    }
    with pytest.raises(ValueError, match=match) as caught:
        asked[ask]()
    message = str(caught.value)
    assert len(message.splitlines()) <= 6
    assert cause is None or isinstance(caught.value.__cause__, cause)
    return message


def accepted(grid=GRID, dtype="float64", **ingredients):
    problem = Problem(**({"drift": drift, "controls": U} | ingredients))
    checks.shapes(problem, grid, Upwind())
    node_checks.check_values(Discretisation(problem, grid, Upwind(), dtype))
