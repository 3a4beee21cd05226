"""The ready problems: their names, their shapes, their parameters as tracers, what they refuse."""

import inspect
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.problem.mode_axis import in_mode
from hjbjax.problem.rewards import costs_of
from hjbjax.problem.sets import Ball, Finite
from hjbjax.tracing import components

ENTRIES = list(zoo.catalogue.values())
WITH_ANSWER = [entry for entry in ENTRIES if entry.exact is not None]
FLOATS = [
    (entry, name) for entry in ENTRIES for name, default in entry.parameters.items() if isinstance(default, float)
]

# factors of other values, because 1.25 makes the value infinite
OTHER = {("liquidation", "productivity"): 0.9, ("refinancing", "productivity"): 0.9}


def name_of(value):
    return value.name if isinstance(value, zoo.Entry) else str(value)


def some_input(admissible):
    """An admissible control that is not zero."""
    if admissible is None:
        return jnp.zeros(0)
    if isinstance(admissible, Ball):
        return jnp.full(admissible.dim, 0.3 * admissible.radius)
    return admissible.points[0] if isinstance(admissible, Finite) else 0.7 * admissible.hi + 0.3 * admissible.lo


def built(entry, **parameters):
    """The problem with costs, in its first mode if there are modes, and the grid."""
    problem, grid = entry.build(**parameters)
    return costs_of(problem if problem.modes is None else in_mode(problem, 0)), grid


def arguments(problem, x):
    return problem.arguments(x, some_input(problem.controls), some_input(problem.disturbances))


def test_the_catalogue_has_the_problems_under_hyphenated_names():
    expected = {
        "pendulum", "double-integrator", "double-integrator-lq", "manipulator", "stochastic-lq", "lq-game",
        "brownian-exit", "zermelo", "dubins", "van-der-pol", "bang-bang", "merton",
    }  # fmt: skip
    assert expected <= set(zoo.catalogue)
    for name, entry in zoo.catalogue.items():
        assert entry.name == name
        assert getattr(zoo, name.replace("-", "_")) is entry.build
        assert "\n" not in entry.summary
        assert 10 < len(entry.summary) <= 70


@pytest.mark.parametrize("entry", ENTRIES, ids=name_of)
def test_functions_have_the_promised_shapes(entry):
    problem, grid = built(entry)
    x = jnp.asarray(entry.initial_state(grid.ndim))
    assert np.all(x >= grid.lo)
    assert np.all(x <= grid.hi)
    inputs = arguments(problem, x)
    assert jax.eval_shape(problem.drift, *inputs).shape == (grid.ndim,)
    assert problem.cost is None or jax.eval_shape(problem.cost, *inputs).shape == ()
    assert problem.diffusion(*inputs[:2]).shape[0] == grid.ndim
    if problem.target is not None:
        assert jax.eval_shape(problem.target, x).shape == ()
        inside = np.asarray(jax.jit(jax.vmap(problem.target))(grid.nodes().reshape(-1, grid.ndim))) <= 0
        assert 0 < np.mean(inside) < 0.5
    if callable(problem.exit_cost):
        assert jax.eval_shape(problem.exit_cost, x).shape == ()


@pytest.mark.parametrize("entry", ENTRIES, ids=name_of)
def test_functions_are_evaluated_by_components(entry, sample_state):
    # FallbackWarning is an error here, so this says that every primitive of the zoo has a component rule.
    problem, grid = built(entry)
    states = np.stack([np.asarray(sample_state(grid, seed)) for seed in range(3)])
    functions = [(problem.drift, True), (problem.cost, True), (problem.target, False), (problem.exit_cost, False)]

    @jax.jit
    def both(states):
        """Every function by components, entries in a row, and by ``vmap``."""
        found = []
        for function, acts in functions:
            if callable(function):
                inputs = arguments(problem, states[0])[1:] if acts else ()
                entries = components.components(function, list(states.T), *map(list, inputs), dtype=np.float64)
                rows = jnp.stack([jnp.broadcast_to(entry, 3) for entry in entries.reshape(-1)], axis=-1)
                found.append((rows, jax.vmap(lambda x, f=function, inputs=inputs: f(x, *inputs))(states)))
        return found

    for rows, wanted in both(states):
        np.testing.assert_allclose(rows.reshape(wanted.shape), wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("entry", WITH_ANSWER, ids=name_of)
def test_the_answer_takes_the_keywords_of_the_problem(entry):
    given = {k: v.default for k, v in inspect.signature(entry.exact).parameters.items()}
    wanted = {k: v for k, v in entry.parameters.items() if k != "shape"}
    assert given == wanted


@pytest.mark.parametrize(("entry", "name"), FLOATS, ids=name_of)
def test_another_parameter_is_the_same_structure(entry, name):
    """So that it recompiles nothing."""
    scales = 1.0, OTHER.get((entry.name, name), 1.25)
    problem, other = (entry.build(**{name: scale * entry.parameters[name]})[0] for scale in scales)
    assert jax.tree.structure(problem) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(problem), jax.tree.leaves(other), strict=True):
        assert jnp.result_type(a) == jnp.result_type(b)
        assert jnp.shape(a) == jnp.shape(b)


@pytest.mark.parametrize(("entry", "name"), FLOATS, ids=name_of)
def test_a_parameter_may_be_a_tracer(entry, name, sample_state):
    def evaluate(parameter):
        problem, grid = built(entry, **{name: parameter})
        inputs = arguments(problem, x)
        values = [problem.drift(*inputs), problem.diffusion(*inputs[:2]), problem.discount]
        values += [problem.cost(*inputs)] if problem.cost is not None else []
        values += [f(x) for f in (problem.target, problem.exit_cost, problem.stopping_cost) if callable(f)]
        return [*values, *(jnp.asarray(bound) for bound in (grid.lo, grid.hi))]

    number = OTHER.get((entry.name, name), 1.25) * entry.parameters[name] or 0.25
    x = sample_state(entry.build()[1], 1)
    for traced, plain in zip(jax.jit(evaluate)(number), evaluate(number), strict=True):
        np.testing.assert_allclose(traced, plain, rtol=1e-12, atol=1e-12)


def test_a_new_mass_traces_nothing_anew():
    count = 0

    @jax.jit
    def push(problem, x, u):
        nonlocal count
        count += 1
        return problem.drift(x, u)

    x, u = jnp.array([0.4, 0.0]), jnp.array([3.0])
    pushes = [push(zoo.pendulum(mass=mass)[0], x, u)[1] - 9.81 * np.sin(0.4) for mass in (1.0, 2.0, 3.0)]
    np.testing.assert_allclose(pushes, [3.0, 1.5, 1.0])
    assert count == 1


def test_the_drift_is_differentiable_in_a_parameter():
    x, u = jnp.array([0.4, 0.0]), jnp.array([3.0])
    slope = jax.jit(jax.grad(lambda m: zoo.pendulum(mass=m)[0].drift(x, u)[1]))(2.0)
    assert slope == pytest.approx(-3.0 / 2.0**2)
    push = u.repeat(2)
    lengths = jax.jit(jax.jacobian(lambda a: zoo.manipulator(links=2, lengths=a)[0].drift(jnp.ones(4), push)))(
        np.ones(2)
    )
    assert lengths.shape == (4, 2)
    masses = jax.jit(jax.grad(lambda m: zoo.Manipulator(links=2, masses=[m, 1.0]).drift(jnp.ones(4), push)[2]))(1.0)
    assert np.isfinite(masses)
    assert np.all(np.isfinite(lengths))


@pytest.mark.slow
def test_importing_the_zoo_loads_nothing_heavy():
    code = "import sys, hjbjax.zoo; print([m for m in ('scipy.linalg', 'matplotlib', 'diffrax') if m in sys.modules])"
    # JAX itself may load parts of SciPy; the zoo must not add any.
    base = (
        "import sys, jax, jax.numpy; print([m for m in ('scipy.linalg', 'matplotlib', 'diffrax') if m in sys.modules])"
    )
    outputs = [
        subprocess.run([sys.executable, "-c", c], capture_output=True, text=True, check=True) for c in (code, base)
    ]
    assert outputs[0].stdout == outputs[1].stdout


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: zoo.lq_game_exact(gamma=1.0), "gamma = 1, wanted a level above"),
        (lambda: zoo.lq_game_exact(gamma=0.5, rate=-0.1), "gamma = 0.5"),
        (lambda: zoo.merton(aversion=1.0), "aversion = 1"),
        (lambda: zoo.brownian_exit_exact(dim=3), "dim = 3, wanted 1 or 2"),
        (lambda: zoo.eikonal(norm=3), "norm = 3, wanted 1, 2 or infinity"),
        (lambda: zoo.eikonal(dim=3, directions=8), "directions with dim = 3"),
        (lambda: zoo.Manipulator(links=0), "links = 0"),
        (lambda: zoo.Manipulator(links=2, masses=[1.0]), "masses: got 1 numbers, wanted 2"),
        (lambda: zoo.Manipulator(links=2, masses=[1.0, 0.0]), "masses"),
        (lambda: zoo.CarWithTrailers(0), "trailers = 0"),
        (lambda: zoo.CarWithTrailers(2, lengths=(1.0,)), "got 1 numbers, wanted 2"),
        (lambda: zoo.FlexibleJoint(motor=0.0), "motor = 0.0"),
        (lambda: zoo.pendulum(mass=0.0), "mass = 0.0, wanted a finite number > 0"),
        (lambda: zoo.double_integrator(mass=-1.0), "mass = -1.0"),
        (lambda: zoo.double_integrator_lq_exact(noise=1.0), "discount = 0.0"),
        (lambda: zoo.zermelo(speed=np.nan), "speed = nan"),
        (lambda: zoo.bang_bang(discount=0.0), "discount = 0.0"),
        (lambda: zoo.stochastic_lq(discount=0.0), "discount = 0.0"),
        (lambda: zoo.brownian_exit(noise=0.0), "noise = 0.0"),
        (lambda: zoo.brownian_ball(radius=0.0), "radius = 0.0"),
        (lambda: zoo.merton(volatility=0.0), "volatility = 0.0"),
        (lambda: zoo.manipulator(links=2, shape=(20, 21)), "lengths 4, 4, 2"),
        (lambda: zoo.merton_wealth(growth=0.2), "best share is 2.125,"),
        (lambda: zoo.growth(share=1.2), "share = 1.2, wanted a number between 0 and 1"),
        (lambda: zoo.growth(discount=0.0), "discount = 0.0"),
        (lambda: zoo.perpetual_put(volatility=-0.1), "volatility = -0.1"),
        (lambda: zoo.american_put(maturity=0.0), "maturity = 0.0"),
        (lambda: zoo.leland(tax=1.0), r"tax = 1.0, wanted a number in \[0, 1\)"),
        (lambda: zoo.leland_exact(payout=-0.01), "payout = -0.01"),
        (lambda: zoo.merton(growth=0.2), r"best share is 2.125, wanted one within \[0, 1\]"),
        (lambda: zoo.merton_exact(aversion=0.5), "best share is 2,"),
        (lambda: zoo.merton(discount=0.3), r"best consumption is 0.17, wanted one within \[0.01, 0.1\]"),
        (lambda: zoo.merton_exact(discount=0.3), "best consumption is 0.17,"),
        (lambda: zoo.stochastic_lq(bound=0.5), r"best control is 1.23607 at the ends of the box, wanted one within"),
        (lambda: zoo.stochastic_lq_exact(bound=0.5), "best control is 1.23607"),
        (lambda: zoo.stochastic_lq_exact(state_weight=0.0, rate=1.0), "state_weight = 0.0"),
        (lambda: zoo.double_integrator_lq_exact(bound=2.0), "best force is 5.4641 at a corner"),
        (lambda: zoo.lq_game_exact(bound=1.0), "best control is 1.1547 at the ends"),
        (lambda: zoo.lq_game_exact(gamma=0.8, rate=-1.0, bound=0.7), "best disturbance is 0.94"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("name", [name for name in zoo.__all__ if inspect.isfunction(getattr(zoo, name))])
def test_a_misspelt_parameter_is_answered_with_the_cure(name):
    function = getattr(zoo, name)
    (first, *_) = inspect.signature(function).parameters
    with pytest.raises(
        TypeError, match=rf"{name}\(\) got an unexpected keyword argument '{first}x': did you mean {first}"
    ):
        function(**{f"{first}x": 1.0})


@pytest.mark.parametrize("change", [{"mass": 2.0}, {"mass": 3.5}])
def test_changing_a_zoo_parameter_compiles_nothing(change, caplog):
    shape = (20, 21)
    hjb.solve(*zoo.pendulum(shape=shape), tol=1.0, scheme=hjb.Upwind())
    with jax.log_compiles(True), caplog.at_level("WARNING"):
        hjb.solve(*zoo.pendulum(shape=shape, **change), tol=1.0, scheme=hjb.Upwind())
    compiled = [record.getMessage() for record in caplog.records if "Compiling" in record.getMessage()]
    assert compiled == []
