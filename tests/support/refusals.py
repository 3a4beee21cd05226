"""A question for ``solve`` with ingredients that may be changed, and what its refusal says."""

import jax.numpy as jnp
import pytest

import hjbjax as hjb

GRID = hjb.Grid([-1.0, -2.0], [1.0, 2.0], (8, 10))
BOX = hjb.Box([-1.0], [1.0])


def drift(x, u):
    return jnp.stack([x[1], u[0]])


def cost(x, u):
    return x @ x


def problem(**changes):
    return hjb.Problem(**({"drift": drift, "cost": cost, "controls": BOX, "discount": 1.0} | changes))


def refused(call, reason, kind=ValueError):
    """The call is refused in a few lines that hold the reason."""
    with pytest.raises(kind) as caught:
        call()
    assert reason in str(caught.value)
    assert len(str(caught.value).splitlines()) <= 6


def refusal(kind, *words, question=None, grid=GRID, **options):
    """The message of the refusal, which holds all ``words``."""
    with pytest.raises(kind) as caught:
        hjb.solve(problem() if question is None else question, grid, **options)
    message = str(caught.value)
    assert len(message.splitlines()) <= 6
    for word in words:
        assert word in message, f"{word!r} is not in: {message}"
    return caught.value
