"""A front door gives its answer also where standard error cannot be written; progress and warnings are not shown."""

import dataclasses
import sys
import warnings

import numpy as np
import pytest
from broken_streams import BROKEN, show_as_python_does

import hjbjax as hjb
from hjbjax.solution.clock import Clock
from hjbjax.solvers import host_loop

GRID = hjb.Grid([-1.0], [1.0], (9,))
MONOTONE = {"scheme": hjb.Upwind(), "method": hjb.ValueIteration()}


REGULATOR = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-9.0], [9.0]))
DISCOUNTED = dataclasses.replace(REGULATOR, discount=1.0)


def feedback(x):
    return -0.5 * x


def outside():
    """A query with a warning."""
    solution = hjb.Solution(GRID, GRID.nodes()[..., 0], None)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = show_as_python_does
        return solution.value_at([2.0])


def values(found):
    return np.asarray(found.value)


DOORS = {
    "solve": lambda **options: values(hjb.solve(DISCOUNTED, GRID, **MONOTONE, **options)),
    "solve_batch": lambda **options: values(hjb.solve_batch([DISCOUNTED] * 2, GRID, **MONOTONE, **options)[1]),
    "march": lambda **options: values(hjb.march(DISCOUNTED, GRID, 0.1, scheme=hjb.Upwind(), **options)),
    "simulate": lambda **_: hjb.simulate(DISCOUNTED, feedback, [0.5], 1.0).states,
    "pontryagin": lambda **_: hjb.pontryagin(REGULATOR, [0.5], horizon=1.0).states,
    "a query outside": lambda **_: outside(),
}


@pytest.mark.parametrize("door", DOORS)
def test_a_front_door_without_a_usable_standard_error(door, monkeypatch):
    wanted = DOORS[door](progress=False)
    for make in BROKEN.values():
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stderr", make())
            found = [DOORS[door](progress=progress) for progress in (None, True)]
        np.testing.assert_array_equal(found, [wanted] * 2)


@pytest.mark.parametrize("kind", BROKEN)
@pytest.mark.parametrize("progress", [None, True])
def test_a_bar_on_a_stream_that_fails_is_not_shown(kind, progress, monkeypatch):
    monkeypatch.setattr(sys, "stderr", BROKEN[kind]())
    clock = Clock(progress=progress)
    with host_loop.announce(clock), host_loop.progress_bar(progress, {"total": 3, "delay": 0}) as bar:
        clock.phase = "compiling for 9 nodes"
        if bar is not None:
            bar.update(2)
    # tqdm asks standard error for an attribute when it begins
    assert (bar is None) == (progress is None or kind == "proxy")
