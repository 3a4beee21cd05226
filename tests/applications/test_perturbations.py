"""Noise that vanishes and disturbances that become expensive: exact changes on a line, orders on the pendulum."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import plotting, zoo
from hjbjax.applications import perturbations
from hjbjax.applications.perturbations import Series
from hjbjax.problem.sets import Box, Finite

PLANT = hjb.Problem(lambda x, u: u, lambda x, u: 0.5 * (x @ x + u @ u), Box([-4.0], [4.0]), discount=1.0)
GRID = hjb.Grid([-2.0], [2.0], (41,))
GOLDEN = (np.sqrt(5) - 1) / 2  # V = ½px² with p² + p = 1
NOISES, GAMMAS = (0.1, 0.05, 0.025), (5.0, 10.0, 20.0)
SETS = {"noises": NOISES, "gammas": GAMMAS, "disturbances": Box([-1.0], [1.0])}


@pytest.fixture(scope="module")
def line():
    return hjb.perturbation_study(PLANT, GRID, **SETS, tol=1e-8)


@pytest.mark.slow
def test_the_changes_on_a_line_are_exact(line):
    """V^ε = V + ½ε²p/β everywhere; V^γ has (1 − γ⁻²)p² + p = 1, and the feedback is −p x."""
    np.testing.assert_allclose(line.noise.parameters, sorted(NOISES))
    np.testing.assert_allclose(line.noise.errors, 0.5 * line.noise.parameters**2 * GOLDEN, rtol=1e-3)
    np.testing.assert_allclose(line.gain.parameters, np.sort(1 / np.array(GAMMAS)))
    weight = 1 - line.gain.parameters**2
    p = (np.sqrt(1 + 4 * weight) - 1) / (2 * weight)
    np.testing.assert_allclose(line.gain.errors, 0.5 * (p - GOLDEN) * 0.5**2, rtol=1e-3)  # |x| ≤ ½
    np.testing.assert_allclose(line.gain.feedback_errors, (p - GOLDEN) * 0.5, rtol=1e-3)
    assert line.noise.order == pytest.approx(2, abs=0.01)
    assert line.gain.order == pytest.approx(2, abs=0.05)
    assert line.gain.feedback_order == pytest.approx(2, abs=0.05)


@pytest.mark.slow
def test_a_feedback_that_does_not_change_has_no_order():
    """That of a quadratic V with noise: what is left is the tolerance."""
    study = hjb.perturbation_study(PLANT, GRID, **SETS)
    assert np.isnan(study.noise.feedback_order)
    assert study.gain.feedback_order == pytest.approx(2, abs=0.05)


@pytest.mark.slow
def test_what_it_prints_and_draws(line):
    text = str(line)
    assert text.count("order") == 2
    assert "CONVERGED" in text
    assert "*" not in text
    artists = plotting.perturbation(line)
    ax = artists[0].axes
    assert (ax.get_xscale(), ax.get_yscale(), ax.get_xlabel()) == ("log", "log", "ε, 1/γ")
    np.testing.assert_allclose(artists[0].get_xdata(), line.noise.parameters)
    np.testing.assert_allclose(artists[0].get_ydata(), line.noise.errors)
    labels = [artist.get_label() for artist in artists[:-1]]
    assert f"V over ε, order {line.noise.order:.2f}" in labels
    assert f"u over 1/γ, order {line.gain.feedback_order:.2f}" in labels
    mine = plotting.perturbation(line, ax=ax)
    assert mine[0].axes is ax


@pytest.mark.slow
def test_changes_below_the_tolerance_are_not_fitted(line):
    noise = dataclasses.replace(line.noise, fitted=np.array([False, True, True]))
    study = dataclasses.replace(line, noise=noise)
    assert "* not fitted" in str(study)
    assert noise.order == pytest.approx(2, abs=0.01)
    nothing = dataclasses.replace(noise, errors=np.zeros(3), fitted=np.zeros(3, bool))
    assert np.isnan(nothing.order)
    with pytest.raises(ValueError, match=r"got changes .* over ε, wanted a positive one"):
        plotting.perturbation(dataclasses.replace(study, noise=nothing))
    assert isinstance(nothing, Series)


@pytest.fixture
def unsolved(monkeypatch):
    """Nothing may be solved."""

    def solved(*arguments, **options):
        raise AssertionError

    monkeypatch.setattr(perturbations, "solve", solved)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"noises": [0.1]}, r"got noises = \[0.1\], wanted at least two finite numbers > 0"),
        ({"gammas": [1.0, -2.0]}, r"got gammas = \[1.0, -2.0\]"),
        ({"problem": dataclasses.replace(PLANT, noise=0.1)}, r"already has noise or disturbances"),
        ({"problem": dataclasses.replace(PLANT, discount=0.0)}, r"give a discount > 0"),
        ({"region": 2.0}, r"perturbation_study: got region = 2.0; wanted a share of the box"),
        ({"region": lambda x: x}, r"perturbation_study: the region returned shape \(1,\)"),
        ({"region": lambda x: x[0] > 9}, r"perturbation_study: no node of the grid"),
        ({"problem": dataclasses.replace(PLANT, cost=None)}, r"attenuation: the problem has no cost"),
        ({"disturbances": None}, r"the disturbances are None; wanted a Box or a Ball"),
        ({"disturbances": Finite([[0.0], [1.0]])}, r"(?s)the disturbances are Finite.* wanted a Box or a Ball"),
        ({"disturbances": Box([-1.0] * 2, [1.0] * 2)}, r"drift"),
        ({"tol": 0.0}, r"tol = 0.0; wanted a finite number > 0"),
    ],
)
@pytest.mark.usefixtures("unsolved")
def test_bad_input_is_refused_before_anything_is_solved(changes, reason):
    arguments = {"problem": PLANT, "grid": GRID} | SETS | changes
    with pytest.raises(ValueError, match=reason):
        hjb.perturbation_study(**arguments)


@pytest.mark.parametrize(("changes", "got"), [({"grid": 3}, "Problem, int"), ({"problem": None}, "NoneType, Grid")])
@pytest.mark.usefixtures("unsolved")
def test_what_is_no_problem_or_grid_is_refused(changes, got):
    arguments = {"problem": PLANT, "grid": GRID} | SETS | changes
    with pytest.raises(TypeError, match=f"got {got}; wanted a Problem and a Grid"):
        hjb.perturbation_study(**arguments)


@pytest.mark.slow
def test_a_set_that_is_felt_is_refused():
    """At γ = 5 the worst disturbance is p x/25, .0125 at x = ½."""
    with pytest.raises(ValueError, match=r"at gamma = 5 the worst disturbance is at its bound at .* widen the set"):
        hjb.perturbation_study(PLANT, GRID, **(SETS | {"disturbances": Box([-0.01], [0.01])}))


def upright(x):
    """Around the upright rest, this side of the kink."""
    return (jnp.abs(x[0]) <= 0.5) & (jnp.abs(x[1]) <= 1.0)


@pytest.mark.slow
def test_on_the_pendulum_both_orders_are_two():
    """(10.6) and (11.7), ẋ = f + w on both components: values and feedbacks."""
    problem, grid = zoo.pendulum(as_printed=True, discount=1.0, shape=(40, 41))
    study = hjb.perturbation_study(
        problem, grid, noises=[0.04, 0.08, 0.16, 0.32], gammas=[4.0, 8.0, 16.0, 32.0],
        disturbances=Box([-1.0, -1.0], [1.0, 1.0]), region=upright,
    )  # fmt: skip
    assert study.noise.fitted.all()
    assert study.gain.fitted.all()
    for series in (study.noise, study.gain):
        assert series.order == pytest.approx(2, abs=0.2)
        assert series.feedback_order == pytest.approx(2, abs=0.2)
