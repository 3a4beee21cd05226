"""What functions read from outside: changed objects and globals, traced numbers, solves inside of transformations."""

import copy
import functools
import pickle
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import hjbjax as hjb
from hjbjax.discretisation import posing
from hjbjax.problem.problem import STATIC
from hjbjax.problem.pytree import altered
from hjbjax.tracing import closures
from hjbjax.tracing.descriptions import digest_of
from hjbjax.tracing.outside import fingerprint, identity, unnested
from tests.support.compilation import compiling

UNIT = hjb.Box([-1.0], [1.0])
LINE = hjb.Grid([-1.0], [1.0], (11,))
GAIN = 1.0
CALLS = []


def square(x, u):
    return x @ x


def steer(x, u):
    return u


def value(drift, cost=square, **options):
    problem = hjb.Problem(drift, cost, UNIT, discount=1.0, **options)
    return hjb.solve(problem, LINE, tol=1e-6, scheme=hjb.Upwind()).value[2]


class Car:
    """No pytree: its attributes are seen only by tracing."""

    def __init__(self):
        self.gain = 1.0
        self.table = np.array([1.0, 1.0])
        self.settings = {"gain": 1.0}

    def drift(self, x, u):
        return self.gain * self.table[0] * self.settings["gain"] * u


def by_global(x, u):
    return GAIN * u


def through(x, u):
    return by_global(x, u)


def test_a_changed_object_is_seen():
    car = Car()
    moving = value(car.drift)
    assert moving < 0.2
    assert value(car.drift) == moving
    for change in (lambda: setattr(car, "gain", 0.0), lambda: car.table.fill(0.0), lambda: car.settings.update(gain=0)):
        car.__init__()
        assert value(car.drift) == moving
        change()
        assert value(car.drift) == pytest.approx(0.36, abs=1e-6)


@pytest.mark.parametrize("function", [by_global, through])
def test_a_changed_global_is_seen(function, monkeypatch):
    moving = value(function)
    monkeypatch.setitem(globals(), "GAIN", 0.0)
    assert value(function) == pytest.approx(0.36, abs=1e-6)
    monkeypatch.setitem(globals(), "GAIN", 1.0)
    assert value(function) == moving


def no_cost(x, u):
    return x @ x


@pytest.mark.parametrize(
    "again",
    [pytest.param(copy.deepcopy, marks=pytest.mark.slow), lambda held: pickle.loads(pickle.dumps(held))],
    ids=["copy", "pickle"],
)
def test_a_solution_goes_to_another_process(again):
    """With functions of a module, one of which reads a global; the copy is simulated and solved like the original."""
    grid = hjb.Grid([-1.0], [1.0], (9,))
    problem = hjb.Problem(by_global, no_cost, hjb.Box([-1.0], [1.0]), discount=1.0)
    solution = hjb.solve(problem, grid)
    copied = again(solution)
    assert np.array_equal(copied.value, solution.value)
    assert np.array_equal(hjb.solve(copied.problem, grid).value, solution.value)
    assert np.array_equal(hjb.greedy_feedback(copied.problem, copied)([0.3]), [-1.0])
    error = again(hjb.SolveError("stopped", solution))
    assert str(error) == "stopped"
    assert np.array_equal(error.solution.value, solution.value)


def of_helpers(x, u):
    return helper(x, u) + partly(x, u)


def helper(x, u):
    return u


def still(x, u):
    return 0 * u


def scaled(factor, x, u):
    return factor * u


partly = functools.partial(scaled, 0.0)


def test_a_helper_written_anew_is_seen(monkeypatch):
    """Functions of nothing but library code and each other: these are not traced again, and were once believed."""
    moving = value(of_helpers)
    monkeypatch.setitem(globals(), "helper", still)
    assert value(of_helpers) == pytest.approx(0.36, abs=1e-6)
    monkeypatch.setitem(globals(), "partly", functools.partial(scaled, 1.0))
    assert value(of_helpers) == pytest.approx(moving, rel=1e-12)


def test_an_object_of_a_library_may_hold_anything(monkeypatch):
    monkeypatch.setitem(globals(), "helper", functools.partial(scaled, 1.0))
    moving = value(of_helpers)
    monkeypatch.setitem(globals(), "helper", functools.partial(scaled, 0.0))
    assert value(of_helpers) == pytest.approx(0.36, abs=1e-6)
    assert moving < 0.2


def compiled(ask):
    """The number of programs that a call compiles, and its result."""
    with compiling() as programs:
        result = ask()
    return len(programs), result


def asked(gain, weight, offset):
    """A problem in closures: a Python number, an integer, and an array that is read by index."""
    return hjb.Problem(lambda x, u: gain * u - offset[0] * x, lambda x, u: weight * (x @ x + u @ u), UNIT, discount=1.0)


@pytest.mark.slow
def test_a_lambda_of_other_numbers_compiles_nothing_again():
    def ask(gain, weight, offset):
        problem = asked(gain, weight, np.array([offset, 9.0]))
        solution = hjb.solve(problem, LINE, tol=1e-9, scheme=hjb.Upwind())
        path = hjb.simulate(problem, lambda x: -gain * x, [0.5], 1.0)
        return solution.value[2], path.cost

    ask(1.0, 2, 0.5)
    for numbers in ((1.5, 3, 0.25), (0.5, 1, 1.0)):
        programs, (found, cost) = compiled(lambda numbers=numbers: ask(*numbers))
        assert programs == 0
        gain, weight, offset = numbers
        plain = hjb.Problem(
            jax.tree_util.Partial(lambda g, o, x, u: g * u - o * x, gain, offset),
            jax.tree_util.Partial(lambda w, x, u: w * (x @ x + u @ u), float(weight)),
            UNIT,
            discount=1.0,
        )
        assert found == pytest.approx(hjb.solve(plain, LINE, tol=1e-9, scheme=hjb.Upwind()).value[2], rel=1e-8)
        rate = offset + gain**2  # dx = −rate·x dt, cost w(1 + gain²)x²
        wanted = weight * (1 + gain**2) * 0.25 * (1 - np.exp(-2 * (rate + 0.5))) / (2 * rate + 1)
        assert cost == pytest.approx(wanted, rel=1e-5)


@pytest.mark.slow
def test_numbers_of_a_helper_are_numbers_too():
    """A drift that calls a function made a line above it, as in a factory of models."""

    def pushed(gain):
        return lambda x, u: gain * u

    def ask(gain, offset):
        push = pushed(gain)
        return hjb.Problem(lambda x, u: push(x, u) - offset * x, square, UNIT, discount=1.0)

    def value(gain, offset):
        return hjb.solve(ask(gain, offset), LINE, tol=1e-9, scheme=hjb.Upwind()).value[2]

    first = value(1.0, 0.5)
    programs, found = compiled(lambda: value(1.5, 0.25))
    assert programs == 0
    plain = hjb.Problem(lambda x, u: 1.5 * u - 0.25 * x, square, UNIT, discount=1.0)
    assert found == pytest.approx(hjb.solve(plain, LINE, tol=1e-9, scheme=hjb.Upwind()).value[2], rel=1e-8)
    assert abs(found - first) > 1e-3
    # what calls itself reads no numbers without end, and a helper that counts is left as it is

    def halved(x, u, depth=3):
        return 1.25 * u if depth == 0 else halved(x, u, depth - 1) / 2

    jitted = closures.settled(hjb.Problem(lambda x, u: halved(x, u), square, UNIT), 1).drift
    assert jax.jit(jitted)(np.ones(1), np.ones(1)) == pytest.approx(1.25 / 8)


def test_an_array_of_a_helper_in_float32():
    """Without x64 a trace keeps an array of NumPy's in float64, which then met the float32 of the states."""
    gain = np.ones(1)

    def push(x, u):
        return gain * u

    problem = hjb.Problem(lambda x, u: push(x, u), square, UNIT, discount=1.0)
    assert hjb.solve(problem, LINE, scheme=hjb.Upwind(), dtype="float32").status.name == "CONVERGED"
    assert hjb.march(problem, LINE, 0.1, dtype="float32").value.dtype == np.float32


def test_numbers_that_decide_stay_in_the_code():
    """Exponents, shapes, indices, branches and comparisons: seen anew each time, and as good as written down."""

    def ask(power, entry, bound, flag):
        def cost(x, u):
            held = jnp.where(bound < 0.5, 2 * x[entry], 0 * x[entry]) + jnp.zeros(entry + 1)[entry]
            return (u @ u) ** power + held if flag else x @ x

        return closures.settled(hjb.Problem(steer, cost, UNIT), 1).cost

    x, u = np.array([0.5]), np.array([0.3])
    marks = set()
    for power, entry, bound, flag in (
        (1.0, 0, 0.25, True),
        (2.0, 0, 0.25, True),
        (2.0, 0, 0.75, True),
        (2.0, 0, 0.75, 0),
    ):
        found = ask(power, entry, bound, flag)
        marks.add(found.func.mark)
        assert jax.jit(found)(x, u) == pytest.approx((u @ u) ** power + (bound < 0.5) if flag else 0.25)
    assert len(marks) == 4


def test_thresholds_and_tuples_are_numbers():
    """Numbers that are compared with the state or chosen by it are leaves, so a sweep over them shares a program."""

    def ask(wall, costs, ends):
        low, high = ends
        at = lambda x, u: jnp.where(x[0] > wall, costs[1], costs[0]) * jnp.sum(u**2) + jnp.clip(x[0], low, high)  # noqa: E731
        return closures.settled(hjb.Problem(steer, at, UNIT), 1).cost

    marks = set()
    for wall, costs, ends in ((0.25, (1.0, 3.0), (-1.0, 0.125)), (0.75, (2.0, 5.0), (0.0, 9.0))):
        found = ask(wall, costs, ends)
        marks.add(found.func.mark)
        for x in (0.125, 0.5, 1.0):
            wanted = costs[x > wall] * 0.09 + np.clip(x, *ends)
            assert jax.jit(found)(np.array([x]), np.array([0.3])) == pytest.approx(wanted, rel=1e-6)
    assert len(marks) == 1


def test_broken_exponents_are_numbers():
    """A sweep over the exponents of a model of growth shares a program; an integer may make a cost quadratic."""

    def ask(share, aversion):
        cost = lambda x, u: -(u[0] ** (1 - aversion)) / (1 - aversion) + x[0] ** share  # noqa: E731
        return closures.settled(hjb.Problem(steer, cost, UNIT), 1).cost

    x, u, marks = np.array([0.7]), np.array([0.3]), []
    for share, aversion in ((0.3, 1.5), (0.4, 2.5), (0.4, 2.0), (2.0, 1.5)):
        found = ask(share, aversion)
        marks.append(found.func.mark)
        wanted = 0.7**share - 0.3 ** (1 - aversion) / (1 - aversion)
        assert jax.jit(found)(x, u) == pytest.approx(wanted, rel=1e-6)
    assert marks[0] == marks[1]
    assert len(set(marks)) == 3


def test_a_tuple_of_a_shape_stays_in_the_code():
    def ask(shape, gain):
        return closures.settled(hjb.Problem(lambda x, u: gain[0] * u + jnp.zeros(shape), square, UNIT), 1).drift

    found = ask((1,), (2.0, None))
    assert jax.jit(found)(np.ones(1), np.ones(1)) == pytest.approx(2.0)
    assert ask((1,), (3.0, None)).func.mark == found.func.mark


@pytest.mark.slow
def test_a_sweep_over_thresholds_compiles_nothing_again():
    def value(wall, costs):
        cost = lambda x, u: jnp.where(x[0] > wall, costs[1], costs[0])  # noqa: E731
        return hjb.solve(hjb.Problem(lambda x, u: 1 + 0 * u, cost, UNIT, discount=1.0), LINE, scheme=hjb.Upwind()).value

    value(0.1, (1.0, 2.0))
    programs, found = compiled(lambda: value(0.3, (0.5, 4.0)))
    assert programs == 0
    written = hjb.Problem(lambda x, u: 1 + 0 * u, lambda x, u: jnp.where(x[0] > 0.3, 4.0, 0.5), UNIT, discount=1.0)
    np.testing.assert_allclose(found, hjb.solve(written, LINE, scheme=hjb.Upwind()).value, rtol=1e-9)


def test_a_function_that_counts_its_calls_still_does():
    def counting(x, u):
        global GAIN
        GAIN += 1
        return u

    before = GAIN
    closures.settled(hjb.Problem(counting, square, UNIT), 1)
    assert before + 1 <= GAIN
    globals()["GAIN"] = before


def two_lenses(radius):
    """A target and an obstacle in functions of numbers and of another function, made anew at every call."""

    def distance(x):
        return jnp.abs(x[0] - 0.1) - radius

    return distance, lambda x: 0.2 - distance(x)


POSED = {
    "reach, forward": lambda a: hjb.reach(lambda x, u: a * u, UNIT, two_lenses(a)[0], forward=True),
    "avoid": lambda a: hjb.avoid(lambda x, u: a * u, UNIT, two_lenses(a)[0]),
    "avoid at the end": lambda a: hjb.avoid(lambda x, u: a * u, UNIT, two_lenses(a)[1], tube=False),
    "reach and avoid": lambda a: hjb.reach_avoid(lambda x, u: a * u, UNIT, *two_lenses(a)),
    "Partials in a tuple": lambda a: hjb.Problem(
        lambda x, u: a * u, jax.tree_util.Partial(sums, tuple(map(jax.tree_util.Partial, two_lenses(a)))), UNIT
    ),
    "Partials of keywords": lambda a: hjb.Problem(
        lambda x, u: a * u, jax.tree_util.Partial(shifted, shift=a, inner=jax.tree_util.Partial(two_lenses(a)[0])), UNIT
    ),
    "a Partial in a Partial in a Partial": lambda a: hjb.Problem(
        jax.tree_util.Partial(negative, jax.tree_util.Partial(negative, jax.tree_util.Partial(lambda x, u: a * u))),
        square, UNIT,
    ),
}  # fmt: skip


def sums(functions, x, u):
    return sum(each(x) for each in functions)


def shifted(x, u, shift, inner):
    return inner(x - shift)


def negative(function, *arguments):
    return -function(*arguments)


@pytest.mark.parametrize("name", POSED)
def test_functions_inside_functions_share_programs(name):
    """The functions of ``avoid`` are negated inside; another radius, or the same lambda made anew, compiled again."""
    posed = POSED[name]
    first, again, other = (closures.settled(posed(a), 1) for a in (0.5, 0.5, 0.75))
    assert jax.tree.structure(first) == jax.tree.structure(again) == jax.tree.structure(other)
    assert hash(jax.tree.structure(first)) == hash(jax.tree.structure(other))
    x, u = np.array([0.3]), np.array([-0.7])
    for a, found in ((0.5, first), (0.75, other)):
        for each in ("drift", "cost", "stopping_cost", "running_max", "terminal_cost"):
            plain, held = getattr(posed(a), each), getattr(found, each)
            arguments = (x, u) if each in ("drift", "cost") else (x,)
            if plain is not None:
                np.testing.assert_allclose(jax.jit(held)(*arguments), plain(*arguments), rtol=1e-6)
    # settled again, as in every front door, and copied
    twice = closures.settled(first, 1)
    assert jax.tree.structure(twice) == jax.tree.structure(first)
    assert jax.tree.structure(closures.settled(copy.deepcopy(first), 1)) == jax.tree.structure(first)


def test_closures_of_other_numbers_are_one_batch():
    problems = [asked(gain, 1, np.array([0.5])) for gain in (0.5, 1.0)]
    values = [each.value[2] for each in hjb.solve_batch(problems, LINE, tol=1e-9, scheme=hjb.Upwind())]
    for problem, found in zip(problems, values, strict=True):
        assert found == pytest.approx(hjb.solve(problem, LINE, tol=1e-9, scheme=hjb.Upwind()).value[2], rel=1e-8)


def test_a_change_of_one_ulp_is_seen():
    car = Car()
    first = closures.settled(hjb.Problem(car.drift, square, UNIT), 1)
    car.gain = np.nextafter(1.0, 2.0)
    second = closures.settled(hjb.Problem(car.drift, square, UNIT), 1)
    assert first.drift.func != second.drift.func
    car.gain = 1.0
    assert closures.settled(hjb.Problem(car.drift, square, UNIT), 1).drift.func == first.drift.func


@pytest.mark.slow
def test_a_changed_object_is_seen_in_batches_marches_and_tubes():
    car = Car()

    def asked():
        problem = hjb.Problem(car.drift, square, UNIT, discount=1.0)
        tube = hjb.reach(car.drift, UNIT, lambda x: jnp.abs(x[0]) - 0.1)
        return (
            hjb.solve_batch([problem], LINE, tol=1e-6, scheme=hjb.Upwind())[0].value[2],
            hjb.march(problem, LINE, 1.0, scheme=hjb.Upwind(split=True)).value[0, 2],
            hjb.solve(tube, LINE, tol=1e-6, scheme=hjb.Upwind()).value[2],
        )

    before = asked()
    car.gain = 0.0
    after = asked()
    assert before[0] < 0.2
    assert after[0] == pytest.approx(0.36, abs=1e-6)
    assert before[1] < 0.2
    assert after[1] == pytest.approx(0.36 * (1 - np.exp(-1)), rel=0.2)
    assert before[2] < 0.1
    assert after[2] == pytest.approx(0.5)


class Spring:
    """No pytree, with what several front doors ask for."""

    stiffness = 1.0

    def drift(self, x, u):
        return jnp.stack([x[1], -self.stiffness * x[0] - x[1] + u[0]])

    def alone(self, x):
        return jnp.stack([x[1], -self.stiffness * x[0] - x[1]])

    def pull(self, x):
        return -self.stiffness * x[:1]

    def push(self, t, x):
        return self.stiffness * x

    def game(self, x, u, d):
        return self.stiffness * u + d


SPRING = Spring()
SQUARE = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (9, 9))
FIXED = hjb.Problem(SPRING.drift, lambda x, u: x @ x + u @ u, UNIT, discount=1.0)
PLAIN = hjb.Problem(lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: x @ x + u @ u, UNIT)
NOISY = hjb.Problem(SPRING.drift, lambda x, u: x @ x, UNIT, noise=0.5)
GAME = hjb.Problem(
    SPRING.game, lambda x, u, d: 0.5 * (x @ x + u @ u) - 2 * d @ d, UNIT, disturbances=hjb.Box([-2.0], [2.0])
)


def known(grid, players=1):
    """A solution by formula: V = x², and players that pull to the middle."""
    x = grid.nodes()
    return hjb.Solution(grid, np.sum(x**2, -1), *[-0.5 * x[..., :1]] * players)


DOORS = {
    "simulate, drift": lambda: hjb.simulate(FIXED, known(SQUARE), [0.5, 0.0], 1.0).cost,
    "simulate, feedback": lambda: hjb.simulate(PLAIN, SPRING.pull, [0.5, 0.0], 1.0).cost,
    "simulate, feedback of time": lambda: (
        hjb.simulate(PLAIN, lambda t, x: SPRING.pull(x), [0.5, 0.0], 1.0, time_varying=True).cost
    ),
    "greedy_feedback": lambda: hjb.greedy_feedback(GAME, known(LINE, 2))([0.1]),
    "stationary_density": lambda: hjb.chain.stationary_density(NOISY, SQUARE, np.zeros((9, 9, 1))),
    "generator": lambda: hjb.chain.generator(NOISY, SQUARE, np.zeros((9, 9, 1))).toarray(),
    "matrix": lambda: hjb.chain.matrix(NOISY, SQUARE, np.zeros((9, 9, 1))).toarray(),
    "pontryagin": lambda: hjb.pontryagin(FIXED, [0.5, 0.0], horizon=1.0).cost,
    "lyapunov_check": lambda: hjb.lyapunov_check(lambda x: x @ x, SPRING.alone, hjb.Ball(1.0, 2)).worst_state,
    "dissipation, drift": lambda: hjb.dissipation(GAME, known(LINE, 2), [[0.5]], 1.0, random=1).worst,
    "dissipation, signal": lambda: (
        hjb.dissipation(GAME, known(LINE, 2), [[0.5]], 1.0, random=0, disturbances=[SPRING.push]).worst
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("door", DOORS)
def test_a_changed_object_is_seen_by_every_front_door(door, monkeypatch):
    before = DOORS[door]()
    monkeypatch.setattr(SPRING, "stiffness", 0.5, raising=False)
    after = DOORS[door]()
    assert not np.array_equal(before, after)
    monkeypatch.setattr(SPRING, "stiffness", 1.0)
    np.testing.assert_array_equal(DOORS[door](), before)


class Counted:
    gain = 1.0

    def drift(self, weight, x, u):
        CALLS.append(1)
        return weight * self.gain * jax.nn.relu(u + 1) - x  # a rule of derivatives is made anew with every trace


def test_what_did_not_change_is_traced_once_and_not_compiled_again():
    car = Counted()
    bound = car.drift
    value(jax.tree_util.Partial(bound, 1.0))
    for weight, most in ((1.0, 1), (2.0, 5)):  # another number: shapes, indices and structure are read, too
        CALLS.clear()
        value(jax.tree_util.Partial(bound, weight))
        assert 1 <= len(CALLS) <= most


def test_library_code_and_arguments_are_not_even_traced():
    plain = hjb.Problem(steer, lambda x, u: jnp.sum(x * x) + np.pi, UNIT)
    for problem, n in ((plain, 1), (hjb.zoo.pendulum()[0], 2)):
        for name in ("drift", "cost"):
            found, asked = (getattr(each, name).func for each in (closures.settled(problem, n), problem))
            assert found.__wrapped__ is asked
            assert found == getattr(closures.settled(problem, n), name).func
            assert not found._jaxprs


def switching_and_jumping(rate, size):
    return hjb.Problem(
        lambda x, u, mode: u - (0.1, 0.4)[mode] * x, reward=lambda x, u, mode: (1.0, 0.5)[mode] - x[0] ** 2,
        controls=hjb.Box([-1.0], [1.0]), discount=1.0,
        modes=hjb.Modes(("a", "b"), rates=rate * np.array([[0, 1.2], [0.7, 0]])),
        jumps=[hjb.Jump(lambda x, u, mode: 0.3, lambda x, u, mode: size * x)],
        pushes=[hjb.Push([1.0], cost=lambda x, mode: 3.0)],
    )  # fmt: skip


def test_modes_jumps_pushes_and_rewards_share_programs():
    grid = hjb.Grid([-1.0], [1.0], (13,))

    def ask(rate, size):
        return hjb.solve(switching_and_jumping(rate, size), grid, scheme=hjb.Upwind(), tol=1e-8).value

    ask(1.0, 0.5)
    programs, found = compiled(lambda: ask(0.5, -0.3))
    assert programs == 0
    assert np.max(np.abs(found - ask(1.0, 0.5))) > 1e-3


def test_transformed_library_code_is_not_even_traced():
    problem = hjb.Problem(
        square, reward=still, controls=hjb.Box([-1.0], [1.0]), discount=lambda x: 1.0 + x[0] ** 2,
        jumps=[hjb.Jump(0.3, still)],
    )  # fmt: skip
    for name in ("drift", "cost", "intensities", "landings"):
        function = getattr(posing.for_solvers(problem, 1), name)
        assert identity(unnested(function)) is not None, name
    halved = hjb.Problem(square, reward=lambda x, u, half=0.5: half * x[0], controls=hjb.Box([-1.0], [1.0]))
    number = 0.5
    read = hjb.Problem(square, reward=lambda x, u: number * x[0], controls=hjb.Box([-1.0], [1.0]))
    assert identity(unnested(posing.for_solvers(halved, 1).cost)) is not None
    assert identity(unnested(posing.for_solvers(read, 1).cost)) is None  # the number may change


def test_what_cannot_be_traced_is_left_to_the_checks():
    car = Car()
    value(car.drift)
    car.table = None
    with pytest.raises(ValueError, match=r"drift\(x, u\) failed on one state"):
        value(car.drift)


def test_the_arguments_of_a_method_are_still_counted():
    with pytest.raises(ValueError, match=r"drift does not take the arguments"):
        value(lambda x: LINE.lo[0] * x)


def test_front_doors_are_called_by_names_too_and_refuse_like_any_function():
    problem = hjb.Problem(steer, square, UNIT, discount=1.0)
    assert hjb.solve(grid=LINE, problem=problem, scheme=hjb.Upwind()).status is hjb.Status.CONVERGED
    with pytest.raises(TypeError, match=r"solve\(\) got multiple values for argument 'problem'"):
        hjb.solve(problem, problem=problem, scheme=hjb.Upwind())
    with pytest.raises(TypeError, match=r"solve\(\) missing 1 required positional argument: 'grid'"):
        hjb.solve(problem, scheme=hjb.Upwind())
    with pytest.raises(TypeError, match=r"march\(\) takes 3 positional arguments but 4 were given"):
        hjb.march(problem, LINE, 1.0, 2.0)
    with pytest.raises(ValueError, match=r"dtype: got 'flaot64'"):
        hjb.solve(hjb.Problem(Car().drift, square, UNIT, discount=1.0), LINE, dtype="flaot64", scheme=hjb.Upwind())


# --- traced numbers ---


def curved(a):
    """V of a problem whose functions close over a."""
    return value(lambda x, u: a * u, lambda x, u: a * (x @ x) + u @ u)


def as_leaves(a):
    return value(
        jax.tree_util.Partial(lambda a, x, u: a * u, a), jax.tree_util.Partial(lambda a, x, u: a * (x @ x) + u @ u, a)
    )


@pytest.mark.slow
def test_gradients_batches_and_compilation_see_what_is_closed_over():
    with jax.enable_x64(True):
        found, wanted = (np.array(jax.jit(jax.value_and_grad(ask))(1.3)) for ask in (curved, as_leaves))
        np.testing.assert_allclose(found, wanted, rtol=1e-9)
        ahead = jax.jvp(curved, (1.3,), (1.0,))[1]
        assert ahead == pytest.approx(wanted[1], rel=1e-9)
        lanes = jax.vmap(curved)(jnp.array([0.7, 1.3]))
    assert lanes[1] == pytest.approx(curved(1.3), abs=2e-6)
    assert lanes[0] == pytest.approx(curved(0.7), abs=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("way", [jax.grad, jax.value_and_grad, lambda f: lambda a: jax.vmap(f)(jnp.stack([a, 2 * a]))])
def test_a_transformation_without_jit_is_one_program_that_is_kept(way):
    """The functions are new ones at every call, and so are the numbers: a loop over gradients, as people write it."""

    def marched(a):
        problem = hjb.Problem(lambda x, u: a * u, lambda x, u: x @ x, UNIT)
        return hjb.march(problem, LINE, 0.5, step=0.05).value[0, 2]

    for ask, many in ((curved, 60), (marched, 60)):
        first, found = compiled(lambda ask=ask: way(ask)(jnp.asarray(1.3)))
        assert first <= many  # by operations they were hundreds
        again, other = compiled(lambda ask=ask: way(ask)(jnp.asarray(1.7)))
        assert again == 0
        for at, kept in ((1.3, found), (1.7, other)):
            wanted = jax.jit(way(ask))(jnp.asarray(at))
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), kept, wanted)


@pytest.mark.slow
def test_known_numbers_beside_traced_ones_belong_to_the_program():
    def total(a, discount):
        problem = hjb.Problem(lambda x, u: 0 * u, lambda x, u: a * x @ x, UNIT, discount=discount)
        return hjb.solve(problem, LINE, scheme=hjb.Upwind()).value[2]

    # the state rests where it is: V = a x²/β
    for discount in (1.0, 2.0, 1.0):
        assert jax.grad(total)(1.3, discount) == pytest.approx(0.36 / discount, rel=1e-5)


@pytest.mark.slow
def test_a_closure_beside_a_leaf_and_inside_a_march():
    def marched(a):
        problem = hjb.Problem(jax.tree_util.Partial(lambda b, x, u: b * u, a), lambda x, u: a * (x @ x), UNIT)
        return hjb.march(problem, LINE, 0.5, step=0.05, scheme=hjb.Upwind(split=True)).value[0, 2]

    slope = jax.grad(marched)(1.0)
    assert slope == pytest.approx((marched(1.001) - marched(0.999)) / 0.002, rel=1e-2)


@pytest.mark.slow
def test_known_problems_are_solved_at_once_inside_a_transformation():
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, UNIT, discount=1.0)
    for ask in (
        lambda: hjb.solve(problem, LINE, scheme=hjb.Upwind()),
        lambda: hjb.solve_batch([problem], LINE, scheme=hjb.Upwind())[0],
        lambda: hjb.march(problem, LINE, 0.5, times=[0.0, 0.5], scheme=hjb.Upwind(split=True)),
    ):
        outside = ask()
        place = (0.0,) if outside.times is not None else ()
        wanted = float(outside.value_at(*place, np.array([0.33])))
        kept = []

        def there(x, ask=ask, place=place, kept=kept):
            kept.append(ask())
            return kept[-1].value_at(*place, x)

        assert float(jax.jit(there)(jnp.array([0.33]))) == pytest.approx(wanted, rel=1e-6)
        assert float(jax.vmap(there)(jnp.array([[0.33]]))[0]) == pytest.approx(wanted, rel=1e-6)
        assert all(isinstance(solution.value, np.ndarray) for solution in kept)


class OnHost:
    """A drift that the host computes: its jaxpr is that of every other of its kind."""

    def __init__(self, gain):
        self.gain = gain

    def product(self, u):
        return np.asarray(u) * np.float32(self.gain)

    def drift(self, x, u):
        return jax.pure_callback(self.product, jax.ShapeDtypeStruct(u.shape, u.dtype), u, vmap_method="expand_dims")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the primitive 'pure_callback'")
def test_functions_of_the_host_are_told_apart():
    options = {"dtype": "float32", "scheme": hjb.Upwind(), "tol": 1e-4}

    def solved(drift):
        return hjb.solve(hjb.Problem(drift, square, UNIT, discount=1.0), LINE, **options).value

    cars = [OnHost(gain) for gain in (0.0, 1.0, 0.5)]
    for car in (*cars, *reversed(cars)):
        np.testing.assert_allclose(solved(car.drift), solved(lambda x, u, gain=car.gain: gain * u), atol=1e-3)


HOST = """
def host(x):
    return GAIN * x


def drift(x, u):
    return jax.pure_callback(host, jax.ShapeDtypeStruct(x.shape, x.dtype), x, vmap_method="expand_dims") + u
"""


def test_a_digest_of_a_function_of_the_host_is_that_of_every_process():
    """A checkpoint is resumed by another process, where code and globals are at other addresses."""

    def digest(gain):
        module = {"jax": jax}
        exec(HOST.replace("GAIN", gain), module)
        problem = hjb.Problem(module["drift"], square, UNIT, discount=1.0)
        return closures.digest(closures.settled(problem, 1), 1)

    assert digest("2.0") == digest("2.0")
    assert digest("2.0") != digest("3.0")
    made = []
    for gain in (0.0, 1.0, 1.0):
        problem = hjb.Problem(OnHost(gain).drift, square, UNIT, discount=1.0)
        made.append(closures.digest(closures.settled(problem, 1), 1))
    assert made[0] != made[1] == made[2]


class Gain:
    """A callable object of the host."""

    def __init__(self, gain):
        self.gain = gain

    def __call__(self, x):
        return self.gain * np.asarray(x)


def times_gain(gain):
    """A host function that reads a number from a closure."""
    return lambda x: gain * np.asarray(x)


def interpolated(table):
    """A host function that reads a long table, through a second function."""
    places = np.linspace(-1.0, 1.0, len(table))
    at = lambda x: np.interp(x, places, table)  # noqa: E731
    return lambda x: at(np.asarray(x))


def weighted(x, gain):
    return gain * np.asarray(x)


TABLE = np.linspace(0.0, 1.0, 5000)
NEARLY = np.where(np.arange(5000) == 2500, TABLE + 1e-12, TABLE)
SHARED = {"gain": 1.0}


def read_through_a_global(x):
    return SHARED["gain"] * np.asarray(x)


class Fixed:
    """A class whose attributes a host function reads."""


def with_attribute(attribute):
    """A host function that reads an attribute of a class, through an object of a derived class."""
    made = type("Own", (type("Base", (Fixed,), {"gain": attribute}),), {})()
    return lambda x: (made.gain() if callable(made.gain) else made.gain) * np.asarray(x)


def with_module(gain):
    """A host function that reads a number from a module inside a module."""
    outer, outer.inner = types.ModuleType("outer"), types.ModuleType("outer.inner")
    outer.inner.gain = gain
    return types.FunctionType((lambda x: outer.inner.gain * np.asarray(x)).__code__, {"np": np}, closure=(cell(outer),))


def cell(held):
    return (lambda: held).__closure__[0]


def wrapping(gain):
    """A host function with the name and the documentation of a function of NumPy."""
    return functools.wraps(np.sinc)(lambda x: gain * np.asarray(x))


HELD = {
    "attribute": (lambda: with_attribute(1.0), lambda: with_attribute(2.0)),
    "property": (lambda: with_attribute(property(lambda _: 1.0)), lambda: with_attribute(property(lambda _: 2.0))),
    "static": (lambda: with_attribute(staticmethod(lambda: 1.0)), lambda: with_attribute(staticmethod(lambda: 2.0))),
    "of a class": (
        lambda: with_attribute(classmethod(lambda _: 1.0)),
        lambda: with_attribute(classmethod(lambda _: 2.0)),
    ),
    "module": (lambda: with_module(1.0), lambda: with_module(2.0)),
    "wrapping": (lambda: wrapping(Gain(1.0)), lambda: wrapping(Gain(2.0))),
    "object": (lambda: Gain(1.0), lambda: Gain(2.0)),
    "closure": (lambda: times_gain(1.0), lambda: times_gain(2.0)),
    "table": (lambda: interpolated(TABLE), lambda: interpolated(NEARLY)),
    "partial": (lambda: functools.partial(weighted, gain=1.0), lambda: functools.partial(weighted, gain=2.0)),
    "nested": (lambda: times_gain({"a": [Gain(TABLE)]}), lambda: times_gain({"a": [Gain(NEARLY)]})),
    "cached": (lambda: functools.lru_cache(times_gain(1.0)), lambda: functools.lru_cache(times_gain(2.0))),
    "compiled": (lambda: jax.jit(lambda x: 1.0 * x), lambda: jax.jit(lambda x: 2.0 * x)),
    "spline": (lambda: CubicSpline(TABLE, TABLE), lambda: CubicSpline(TABLE, NEARLY)),
}


def digest_with(host):
    """The digest of a problem whose drift calls a host function."""

    def drift(x, u):
        return u + jax.pure_callback(host, jax.ShapeDtypeStruct(x.shape, x.dtype), x, vmap_method="expand_dims")

    return closures.digest(closures.settled(hjb.Problem(drift, square, UNIT, discount=1.0), 1), 1)


@pytest.mark.parametrize("kind", HELD)
def test_a_digest_contains_what_a_host_function_holds(kind):
    """A checkpoint of another problem would be continued, and a complete one be returned as the answer."""
    one, other = HELD[kind]
    assert digest_with(one()) == digest_with(one())
    assert digest_with(one()) != digest_with(other())


def test_a_digest_contains_the_globals_of_a_host_function(monkeypatch):
    first = digest_with(read_through_a_global)
    monkeypatch.setitem(SHARED, "gain", 2.0)
    assert digest_with(read_through_a_global) != first


def test_a_function_may_close_over_a_dictionary_whose_keys_have_no_order():
    table = {1: [2.0], "a": {2: 3.0, "b": 4.0}}
    assert not closures.holds_tracers(lambda x: table[1][0] * x)
    endless = {1: 2.0}
    endless["itself"] = endless
    assert not closures.holds_tracers(lambda x: endless["itself"][1] * x)
    assert digest_of(lambda x: table["a"]["b"] * x) == digest_of(lambda x: table["a"]["b"] * x)
    found = []
    jax.jit(lambda a: found.append(closures.holds_tracers(lambda x: {**table, 2: {"c": [a]}}[2]["c"][0] * x)) or a)(1.0)
    jax.jit(lambda a: found.append(closures.holds_tracers(nested({**table, 2: {"c": [a]}}))) or a)(1.0)
    assert found == [True, True]


def nested(held):
    return lambda x: held[2]["c"][0] * x


def with_forward_rule(slope):
    same = jax.custom_jvp(lambda u: u)
    same.defjvp(lambda primals, tangents: (same(primals[0]), slope * tangents[0]))
    return same


def with_reverse_rule(slope):
    same = jax.custom_vjp(lambda u: u)
    same.defvjp(lambda u: (same(u), None), lambda _, weights: (slope * weights,))
    return same


def with_second_rule(slope):
    """A function whose first derivative has a rule."""
    once = jax.custom_jvp(lambda tangent: tangent)
    once.defjvp(lambda primals, tangents: (once(primals[0]), slope * tangents[0]))
    same = jax.custom_jvp(lambda u: u)
    same.defjvp(lambda primals, tangents: (same(primals[0]), once(primals[0]) * tangents[0]))
    return same


@pytest.mark.slow
@pytest.mark.parametrize("ruled", [with_forward_rule, with_reverse_rule, with_second_rule])
def test_a_digest_contains_the_derivative_rules_of_functions(ruled):
    """A training follows the rules, so a run with other rules would continue the weights of another training."""

    def digest(slope):
        same = ruled(slope)
        problem = hjb.Problem(lambda x, u: same(u), square, UNIT, discount=1.0)
        return closures.digest(closures.settled(problem, 1), 1)

    assert digest(1.0) == digest(1.0)
    assert digest(1.0) != digest(2.0)


def test_the_rules_of_a_program_that_is_not_differentiated_are_not_followed():
    """A step of a fit has its derivatives among its operations; third ones of it took minutes."""
    followed = []
    same = jax.custom_jvp(lambda u: u)
    same.defjvp(lambda primals, tangents: followed.append(1) or (same(primals[0]), tangents[0]))
    assert closures.digest_of_program(same, 1.0) == closures.digest_of_program(same, 2.0)
    assert not followed
    closures.digest_of_program(jax.grad(same), 1.0)
    assert followed


PLANE = hjb.Box([-1.0] * 2, [1.0] * 2)


def flat(x, u):
    return u


SIMILAR = {
    "one noise": lambda: hjb.Problem(flat, square, PLANE, discount=1.0, noise=[[0.1], [0.2]]),
    "separate noises": lambda: hjb.Problem(flat, square, PLANE, discount=1.0, noise=[0.1, 0.2]),
    "push up": lambda: hjb.Problem(flat, square, PLANE, discount=1.0, pushes=[hjb.Push([0.0, 1.0], 1.0)]),
    "push down": lambda: hjb.Problem(flat, square, PLANE, discount=1.0, pushes=[hjb.Push([0.0, -1.0], 1.0)]),
    "push along": lambda: hjb.Problem(flat, square, PLANE, discount=1.0, pushes=[hjb.Push([1.0, 0.0], 1.0)]),
    "two": lambda: hjb.Problem(
        flat, square, PLANE, discount=1.0, pushes=[hjb.Push([1.0, 0.0], 1.0), hjb.Push([0.0, 1.0], 1.0)]
    ),
}


@pytest.mark.slow
def test_problems_whose_numbers_mean_something_else_have_other_digests(tmp_path):
    """A resumed solve returned the finished value of a push along another axis as that of this one."""
    grid = hjb.Grid([-1.0] * 2, [1.0] * 2, (5, 5))
    hjb.solve(SIMILAR["push up"](), grid, checkpoint=tmp_path / "run.npz")
    for name, each in SIMILAR.items():
        if name == "push up":
            hjb.solve(each(), grid, checkpoint=tmp_path / "run.npz", resume=True)
            continue
        with pytest.raises(hjb.FileError, match="made for another problem; give"):
            hjb.solve(each(), grid, checkpoint=tmp_path / "run.npz", resume=True)
    digests = {closures.digest(closures.settled(SIMILAR[name](), 2), 2) for name in ("one noise", "separate noises")}
    assert len(digests) == 2


def test_every_choice_in_a_problem_is_part_of_its_digest():
    """Except words that no computation uses; a new field must be added to one of the two."""
    assert set(closures.WORDS) < set(STATIC)
    words = {"control_names": ("left",), "control_units": ("N",), "inside": "above", "payoff": "reward",
             "value_name": "W", "time_unit": "s"}  # fmt: skip
    assert set(words) == set(closures.WORDS)
    problem = closures.settled(hjb.Problem(flat, square, UNIT, discount=1.0), 1)
    plain = closures.digest(problem, 1)
    assert closures.digest(altered(problem, **words), 1) == plain
    others = {"isaacs": "lower", "discounted": None, "push_steps": ((0, 1),)}
    assert {*others, *words, "time_dependent"} == set(STATIC)
    for name, value in others.items():
        assert closures.digest(altered(problem, **{name: value}), 1) != plain


@pytest.mark.slow
def test_a_cost_may_close_over_random_keys():
    """The value is that of the numbers that the keys draw."""
    typed, old = jax.random.split(jax.random.key(5), 3), jax.random.split(jax.random.PRNGKey(5), 3)
    one = jax.random.key(0)
    wanted = value(steer, lambda x, u: x @ x + jax.random.uniform(jax.random.PRNGKey(0)))
    np.testing.assert_allclose(value(steer, lambda x, u: x @ x + jax.random.uniform(one)), wanted, atol=1e-12)
    wanted = value(steer, lambda x, u: x @ x + jax.random.uniform(old[1]))
    np.testing.assert_allclose(value(steer, lambda x, u: x @ x + jax.random.uniform(typed[1])), wanted, atol=1e-12)
    inside = jax.jit(lambda a: value(lambda x, u: a * u, lambda x, u: x @ x + jax.random.uniform(typed[1])))(1.0)
    np.testing.assert_allclose(inside, wanted, atol=1e-5)


def test_a_digest_contains_random_keys():
    def digest(seed):
        key = jax.random.key(seed)
        problem = hjb.Problem(steer, lambda x, u: x @ x + jax.random.uniform(key), UNIT, discount=1.0)
        return closures.digest(closures.settled(problem, 1), 1), digest_of(lambda x: jax.random.uniform(key, x.shape))

    assert digest(0) == digest(0)
    assert not set(digest(0)) & set(digest(1))


@pytest.mark.parametrize("function", [lambda x: x + 1, lambda x: x @ x])
def test_a_digest_contains_the_functions_in_the_structure_of_a_tree(function):
    """Printing a structure shows the addresses of its functions, and not their data."""

    def digest(held):
        return digest_of(jax.tree.structure(jax.tree_util.Partial(closures.Marked(held))))

    assert digest(function) == digest(types.FunctionType(function.__code__, globals()))
    assert digest(function) != digest(lambda x: x + 2)


def test_a_digest_contains_the_state_of_an_object_written_in_c():
    made = [np.random.default_rng(seed) for seed in (0, 0, 1)]
    assert digest_of(made[0]) == digest_of(made[1]) != digest_of(made[2])


def test_a_host_function_that_holds_a_traced_number_has_a_digest():
    """The host can use only its shape; its computation is part of the program."""
    found = []

    def loss(p):
        found.append(digest_of(lambda x: x + p.size))
        return p

    for parameters in (1.0, np.ones(2), 2.0):
        jax.make_jaxpr(lambda p: loss(p))(parameters)  # a new function, because JAX traces each of them once
    assert found[0] == found[2] != found[1]


@pytest.mark.filterwarnings("ignore:the primitive 'pure_callback'")
@pytest.mark.slow
def test_a_host_function_may_close_over_a_number():
    """A traced number would reach NumPy while the program runs."""

    def drift_of(gain):
        def drift(x, u):
            found = jax.pure_callback(
                lambda y: gain * np.asarray(y), jax.ShapeDtypeStruct(x.shape, x.dtype), x, vmap_method="expand_dims"
            )
            return u - found

        return drift

    for gain in (0.5, 2.0):
        called, known = (
            hjb.solve(hjb.Problem(drift, square, UNIT, discount=1.0), LINE, scheme=hjb.Upwind(), tol=1e-9).value
            for drift in (drift_of(gain), lambda x, u, gain=gain: u - gain * x)
        )
        np.testing.assert_allclose(called, known, atol=1e-12)


@pytest.mark.slow
def test_rules_of_derivatives_that_a_jaxpr_does_not_tell():
    def ruled(slope):
        @jax.custom_jvp
        def same(p):
            return p**2

        same.defjvp(lambda primals, tangents: (primals[0] ** 2, slope * tangents[0]))
        return same

    def of_weight(slope):
        same = ruled(slope)

        def total(p):
            problem = hjb.Problem(lambda x, u: u, lambda x, u: same(p), UNIT, discount=1.0)
            return hjb.solve(problem, LINE, scheme=hjb.Upwind(), tol=1e-8).value[5]

        return jax.grad(total)(2.0)

    np.testing.assert_allclose([of_weight(3.0), of_weight(5.0)], [3.0, 5.0], rtol=1e-6)


@pytest.mark.slow
def test_rules_of_jax_are_known():
    def fingerprint_of(function):
        closed = jax.make_jaxpr(function)(jnp.ones(2))
        return fingerprint(closed.jaxpr, closed.consts)

    (first, whole), (again, _) = (fingerprint_of(lambda x: jax.nn.relu(x - 1.0)) for _ in range(2))
    assert whole
    assert first == again != fingerprint_of(lambda x: jax.nn.relu(x - 2.0))[0]
    mine = jax.custom_jvp(lambda x: x * 2.0)
    mine.defjvp(lambda x, tangent: (2.0 * x[0], 2.0 * tangent[0]))
    assert not fingerprint_of(mine)[1]
