"""Steps and records that no observer can take are refused, by eager calls and inside ``jit``; reverse derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.problem import sets

F = hjb.filtering
PLANT = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.1 * x @ x, hjb.Box([-1.0], [1.0]), noise=0.5)
GRID = hjb.Grid([-2.0], [2.0], (21,))


def h(x):
    return 2 * x


OBSERVERS = {
    "ExtendedKalman": F.ExtendedKalman(PLANT, h, [0.0], [1.0]),
    "Luenberger": F.Luenberger(PLANT, h, [[1.0]], [0.0]),
    "GridFilter": F.GridFilter(PLANT, h, GRID, lambda x: jnp.exp(-x @ x)),
    "RobustGridFilter": F.RobustGridFilter(PLANT, h, GRID, lambda x: -x @ x, 2.0),
    "WonhamFilter": F.WonhamFilter([[-1.0, 1.0], [2.0, -2.0]], [1.0, 0.0], [0.5, 0.5]),
}
STEPS = {
    "dt = 0": ({"dt": 0.0}, "dt = 0.0; wanted a finite number > 0"),
    "dt < 0": ({"dt": -0.1}, "dt = -0.1; wanted a finite number > 0"),
    "dt NaN": ({"dt": np.nan}, "dt = nan; wanted a finite number > 0"),
    "dt none": ({"dt": None}, "dt = None; wanted a finite number > 0"),
    "dt a row": ({"dt": np.ones(2)}, r"dt has shape \(2,\), wanted one number"),
    "two measurements": ({"dy": np.ones(2)}, r"dy has shape \(2,\), wanted \(1,\)"),
    "dy a number": ({"dy": 1.0}, r"dy has shape \(\), wanted \(1,\)"),
    "dy a matrix": ({"dy": np.ones((1, 1))}, r"dy has shape \(1, 1\), wanted \(1,\)"),
    "dy NaN": ({"dy": np.array([np.nan])}, r"dy = \[nan\], wanted finite numbers"),
    "u NaN": ({"u": np.array([np.nan])}, r"u = \[nan\], wanted finite numbers"),
    "u a number": ({"u": 0.0}, r"u has shape \(\), wanted \(1,\)"),
}
OF_THE_PLANT = {
    "two inputs": ({"u": np.ones(2)}, r"u has shape \(2,\), wanted \(1,\)"),
    "no input": ({"u": np.zeros(0)}, r"u has shape \(0,\), wanted \(1,\)"),
    "inadmissible": ({"u": np.array([5.0])}, r"u = \[5.0\] .* wanted elements of the admissible set, Box"),
}


@pytest.mark.parametrize("case", [*STEPS, *OF_THE_PLANT])
@pytest.mark.parametrize("name", OBSERVERS)
def test_steps_are_refused(name, case):
    if name == "WonhamFilter" and case in OF_THE_PLANT:
        pytest.skip("its generator takes what it takes")
    altered, reason = {**STEPS, **OF_THE_PLANT}[case]
    told = {"u": np.zeros(1), "dy": np.zeros(1), "dt": 0.1, **altered}
    with pytest.raises(ValueError, match=f"{name}.update: {reason}"):
        OBSERVERS[name].update(OBSERVERS[name].initial(), **told)


@pytest.mark.parametrize("name", OBSERVERS)
def test_wrong_shapes_are_refused_inside_jit(name):
    observer = OBSERVERS[name]
    with pytest.raises(ValueError, match=r"dy has shape \(2,\), wanted \(1,\)"):
        jax.jit(observer.update)(observer.initial(), jnp.zeros(1), jnp.zeros(2), 0.1)


def test_states_of_another_filter_are_refused():
    told = np.zeros(1), np.zeros(1), 0.1
    with pytest.raises(ValueError, match=r"mean has shape \(2,\), wanted \(1,\)"):
        OBSERVERS["ExtendedKalman"].update(F.Gaussian(jnp.zeros(2), jnp.eye(2)), *told)
    with pytest.raises(ValueError, match=r"got a \w+ for the state, wanted a Density of shape \(21,\)"):
        OBSERVERS["GridFilter"].estimate(jnp.zeros(21))
    with pytest.raises(ValueError, match=r"the state has shape \(20,\), wanted \(21,\)"):
        OBSERVERS["RobustGridFilter"].estimate(jnp.zeros(20))
    with pytest.raises(ValueError, match=r"belief has shape \(3,\), wanted \(2,\)"):
        OBSERVERS["WonhamFilter"].update(jnp.ones(3) / 3, *told)


def law(**given):
    options = {"controls": np.zeros((3, 1)), **given}
    dt, dy = options.pop("dt", 0.1), options.pop("dy", np.zeros((3, 1)))
    return F.zakai(PLANT, h, GRID, dy, dt, lambda x: jnp.exp(-x @ x), **options)


def worst(**given):
    options = {"controls": np.zeros((3, 1)), "gamma": 2.0, **given}
    dt, y = options.pop("dt", 0.1), options.pop("dy", np.zeros((3, 1)))
    return F.robust_filter(PLANT, h, GRID, y, dt, lambda x: -x @ x, **options)


@pytest.mark.parametrize("run", [law, worst], ids=["zakai", "robust_filter"])
@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (
            {"controls": np.array([[0.0], [5.0], [0.0]])},
            r"controls = \[5.0\] at 1 of 3 steps, .* admissible set, Box",
        ),
        ({"controls": np.array([[0.0], [np.nan], [0.0]])}, r"controls\[1\] = \[nan\], wanted finite numbers"),
        ({"controls": None}, "controls is None, but the problem has 1"),
        ({"controls": np.zeros((2, 1))}, r"controls has shape \(2, 1\), wanted \(3, 1\)"),
        ({"dy": np.array([[0.0], [np.inf], [0.0]])}, r"y\[1\] = \[inf\], wanted finite numbers"),
        ({"dt": "a"}, "dt = 'a'; wanted a finite number > 0"),
        ({"dt": None}, "dt = None; wanted a finite number > 0"),
        ({"dt": True}, "dt = True; wanted a finite number > 0"),
        ({"dt": 1j}, "dt = 1j; wanted a finite number > 0"),
    ],
)
def test_records_are_refused(run, given, reason):
    with pytest.raises(ValueError, match=reason):
        run(**given)


def test_controls_of_every_kind_of_set_are_judged_in_the_units_of_the_set():
    holds = sets.holds
    for unit in (1e-9, 1.0, 1e9):
        u = unit * np.array([[1.0, 0.0], [np.float32(0.1), 0.0], [1.01, 0.0]])
        assert holds(hjb.Box(-unit * np.ones(2), unit * np.ones(2)), u).tolist() == [True, True, False]
        assert holds(hjb.Ball(unit, 2), u).tolist() == [True, True, False]
        finite = hjb.Finite(unit * np.array([[1.0, 0.0], [0.1, 0.0]]))
        assert holds(finite, u).tolist() == [True, True, False]


@pytest.mark.slow
def test_absurd_steps_end():
    with pytest.raises(ValueError, match="dt = 1e\\+30 needs more than 100000 inner steps"):
        worst(dt=1e30)
    observer = OBSERVERS["GridFilter"]
    state = observer.update(observer.initial(), np.zeros(1), np.zeros(1), 1e30)
    assert np.all(np.isnan(state.density))  # and no law that is none


def test_p_that_is_no_number_has_no_worst_state():
    observer = OBSERVERS["RobustGridFilter"]
    assert np.isnan(observer.estimate(jnp.full(21, jnp.nan))[0])  # not an end of the box
    value, state = F.sup_pairing(np.full(21, -np.inf), 0.0, GRID)
    assert value == -np.inf
    assert np.isnan(state[0])
    with pytest.raises(ValueError, match="sup_pairing: p is NaN at 21 nodes"):
        F.sup_pairing(np.full(21, np.nan), 0.0, GRID)
    with pytest.raises(TypeError, match="got int for the grid"):
        F.sup_pairing(np.zeros(21), 0.0, 3)
    with pytest.raises(TypeError, match="sup_pairing: p: got"):
        F.sup_pairing(np.zeros(21) + 1j, 0.0, GRID)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["zakai", "robust_filter"])
def test_reverse_derivatives_are_those_of_finite_differences(which):
    record = np.array([[0.1], [-0.05], [0.2]])

    def loss(rate):
        plant = hjb.Problem(lambda x, u: -rate * x, lambda x, u: 0.1 * x @ x, noise=0.5)
        if which == "zakai":
            return F.zakai(plant, h, GRID, jnp.asarray(record), 0.1, lambda x: jnp.exp(-x @ x)).log_likelihood[-1]
        options = {"gamma": 2.0, "scheme": hjb.Upwind()}
        return F.robust_filter(plant, h, GRID, jnp.asarray(record), 0.1, lambda x: -x @ x, **options).value[-1]

    with jax.enable_x64(True):
        rate, step = 1.05, 1e-5  # at 1 the number of sub-steps changes
        found = jax.grad(loss)(rate)
        wanted = (float(loss(rate + step)) - float(loss(rate - step))) / (2 * step)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


RECORD = np.full((5, 1), 0.5)


def test_estimates_at_an_end_of_the_box_are_told():
    with pytest.warns(UserWarning, match="zakai: the mode of the law is at an end of the box on axis 0 after 1 of 1"):
        F.zakai(PLANT, h, GRID, 1e6 * RECORD[:1], 0.1, lambda x: jnp.exp(-x @ x), controls=np.zeros((1, 1)))
    with pytest.warns(UserWarning, match=r"robust_filter: the worst case is at an end .* first at t = 0\.\d"):
        F.robust_filter(PLANT, h, GRID, 100 * RECORD, 0.1, lambda x: -x @ x, gamma=2.0, controls=0 * RECORD)


def test_what_is_not_finite_is_refused():
    with pytest.raises(ValueError, match=r"zakai: the law is not finite from step 0 on. Either dt = 1e\+30"):
        F.zakai(PLANT, h, GRID, RECORD, 1e30, lambda x: jnp.exp(-x @ x), controls=0 * RECORD)
    with pytest.raises(ValueError, match=r"robust_filter: h\(x\) is not finite"):
        F.RobustGridFilter(PLANT, lambda x: jnp.log(x), GRID, lambda x: -x @ x, 2.0)
