"""The dense oracle itself, against answers that are known by hand and against actions drawn at random."""

import dense
import numpy as np
import pytest
from hypothesis import given, settings
from random_problems import BY_NAME, FAMILIES, draw
from systems import SEEDS


def on_a_line(nodes, b=0.0, q=1.0, gain=1.0, discount=0.0, **more):
    nodes = np.asarray(nodes, float)
    size, box = len(nodes), dense.Actions("box", lo=np.array([-1.0]), hi=np.array([1.0]), dim=1)
    return dense.Model(
        [nodes], (False,), np.full((size, 1), b), np.full(size, q), box, np.full((size, 1, 1), gain), np.zeros(1),
        np.zeros(1), discount, **more,
    )  # fmt: skip


def test_a_cost_for_ever():
    assert np.allclose(dense.solve(on_a_line(range(5), q=3.0, discount=0.5)).value, 6.0, rtol=1e-14)


def test_minimum_time_on_uneven_nodes():
    nodes = np.array([0.0, 0.5, 2.0, 3.0, 7.0])
    model = on_a_line(nodes, gain=2.0, held=nodes == 0, given=np.where(nodes == 0, -3.0, 0))
    assert np.allclose(dense.solve(model).value, nodes / 2 - 3, rtol=1e-14)


def test_what_cannot_arrive_is_infinite():
    nodes = np.arange(5.0)
    answer = dense.solve(on_a_line(nodes, b=1.5, held=nodes == 2, given=np.zeros(5)))
    assert np.array_equal(np.isinf(answer.value), nodes > 2)
    assert np.allclose(answer.value[:3], [0.8, 0.4, 0.0])


def test_the_ruin_of_a_gambler():
    """Without drift the chance to leave at the top is linear; so is the exit cost there."""
    nodes = np.linspace(0, 1, 6)
    ends = (nodes == 0) | (nodes == 1)
    model = on_a_line(nodes, q=0.0, gain=0.0, a=np.full((6, 1, 1), 0.3), held=ends, given=np.where(nodes == 1, 1.0, 0))
    assert np.allclose(dense.solve(model).value, nodes, rtol=1e-13)


def test_to_stop_or_to_go_on():
    """At unit speed and unit cost towards the place where stopping is cheap: 1-Lipschitz below ψ."""
    nodes = np.arange(7.0)
    stop = np.array([5.0, 9, 9, 2, 9, 9, 9])
    assert np.allclose(dense.solve(on_a_line(nodes, stop=stop)).value, [5, 4, 3, 2, 3, 4, 5])


def test_a_tube_and_what_must_be_avoided():
    nodes = np.arange(5.0)
    floor = np.array([0.0, 3, 0, 1, 2])
    pushed = on_a_line(nodes, b=2.0, q=0.0, floor=floor)  # carried upwards whatever is done
    assert np.allclose(dense.solve(pushed).value, [3, 3, 2, 2, 2], atol=1e-12)


@pytest.mark.parametrize("family", [f for f in FAMILIES if not f.disturbances], ids=lambda family: family.name)
@given(seed=SEEDS)
@settings(max_examples=3)
def test_no_action_is_better_than_the_best(family, seed):
    rng = np.random.default_rng(seed)
    model = draw(family, rng).model
    chain, value, admissible = (
        dense.Chain(model),
        rng.normal(size=len(model.q)) * np.max(np.abs(model.q) + 1),
        model.controls,
    )
    best, _ = dense.best_control(chain, value)
    if admissible.kind in ("box", "ball"):
        spread = rng.uniform(-2, 2, (400, 1, admissible.dim))
        tried = admissible.nearest(spread * (admissible.hi if admissible.kind == "box" else admissible.radius))
        drawn = chain.hamiltonian(value, np.broadcast_to(tried, (400, chain.size, admissible.dim)))
        size = dense._noise(chain, value, np.broadcast_to(tried[0], (chain.size, admissible.dim)), None, 1.0)
        assert np.all(best <= np.min(drawn, axis=0) + 1e-9 * size)


@pytest.mark.parametrize("name", ["game, line", "game, lower"])
@given(seed=SEEDS)
@settings(max_examples=5)
def test_the_saddle_of_a_game_lies_between_samples(name, seed):
    """min max over samples of the outer player is above the optimum, and close to it with many."""
    rng = np.random.default_rng(seed)
    model = draw(BY_NAME[name], rng).model
    chain = dense.Chain(model)
    value = rng.normal(size=chain.size) * (np.max(np.abs(model.q)) + 1)
    best = dense.saddle(chain, value)[0]
    outer, answer = (
        (model.disturbances, dense.best_control) if model.lower else (model.controls, dense.best_disturbance)
    )
    places = np.linspace(outer.lo, outer.hi, 401)
    found = np.stack([answer(chain, value, np.broadcast_to(place, (chain.size, 1)))[0] for place in places])
    sampled = -np.max(found, axis=0) if model.lower else np.min(found, axis=0)
    exact = -best if model.lower else best
    spread = np.ptp(found, axis=0) + 1e-12 * np.max(np.abs(found))
    assert np.all(exact <= sampled + 1e-9 * spread)
    assert np.all(sampled <= exact + 0.02 * spread)
