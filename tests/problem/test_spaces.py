"""Spaces of Gymnasium as sets and grids; Gymnasium itself plays in ``tests/applications/test_gymnasium.py``."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

import hjbjax as hjb


def box(low, high):
    return SimpleNamespace(low=np.float32(low), high=np.float32(high))


def discrete(n, start=0):
    return SimpleNamespace(n=np.int64(n), start=np.int64(start))


def test_boxes_become_sets_and_grids_with_decimal_bounds():
    space = box([-1.2, -0.07], [0.6, 0.07])
    controls = hjb.from_gymnasium(space)
    assert isinstance(controls, hjb.Box)
    assert controls.hi.tolist() == [0.6, 0.07]  # not 0.07000000029802322, as float32 has it
    grid = hjb.from_gymnasium(space, (5, 7), names=("position", "velocity"), periodic=(False, True))
    assert (grid.shape, grid.names, grid.periodic) == ((5, 7), ("position", "velocity"), (False, True))
    assert grid.lo.tolist() == [-1.2, -0.07]
    open_ended = box([-np.inf, 0.0], [np.inf, 1.0])
    assert hjb.from_gymnasium(open_ended).unbounded
    bounded = hjb.from_gymnasium(open_ended, (5, 5), lo=[-3, None], hi=[3, 2])
    assert (bounded.lo.tolist(), bounded.hi.tolist()) == ([-3.0, 0.0], [3.0, 2.0])


def test_discrete_actions_keep_their_numbers():
    assert hjb.from_gymnasium(discrete(3, -1)).points.tolist() == [[-1.0], [0.0], [1.0]]
    pairs = hjb.from_gymnasium(SimpleNamespace(nvec=np.array([2, 3])))
    assert pairs.points.tolist() == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [1, 2]]


@pytest.mark.parametrize(
    ("space", "shape", "options", "kind", "match"),
    [
        (
            SimpleNamespace(action_space=1, observation_space=2),
            None,
            {},
            TypeError,
            r"got an environment, wanted env\.action_space",
        ),
        (SimpleNamespace(n=3), None, {}, TypeError, "wanted a Box, a Discrete or a MultiDiscrete"),
        (discrete(3), (5,), {}, ValueError, "wanted a Box for a grid; a discrete state is a mode"),
        (box([-np.inf], [1]), (5,), {}, ValueError, r"no bounds on the axes \[0\][\s\S]*lo=\[-3\.0\], hi=\[3\.0\]"),
        (box([0], [1]), (5,), {"lo": [1, 2]}, ValueError, "got 2 bounds, wanted 1"),
        (box([0], [1]), None, {"names": ("x",)}, TypeError, "names belong to a grid; give shape= as well"),
    ],
)
def test_other_spaces_are_refused(space, shape, options, kind, match):
    with pytest.raises(kind, match=match):
        hjb.from_gymnasium(space, shape, **options)


def test_a_factor_per_step_is_a_discount():
    rate = hjb.discount_rate(0.9, 0.05)
    assert np.exp(-rate * 0.05) == pytest.approx(0.9, abs=1e-15)
    assert hjb.discount_rate(1, 0.05) == 0
    assert jax.grad(hjb.discount_rate)(0.9, 0.5) == pytest.approx(-1 / 0.45, rel=1e-6)
    for gamma, dt in ((0, 1), (1.1, 1), (0.9, 0), (0.9, np.inf)):
        with pytest.raises(ValueError, match="discount_rate: got"):
            hjb.discount_rate(gamma, dt)
