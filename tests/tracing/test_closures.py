"""What functions read from outside: changed objects and globals, traced numbers, solves inside of transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.tracing import closures

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


def test_a_change_of_one_ulp_is_seen():
    car = Car()
    first = closures.settled(hjb.Problem(car.drift, square, UNIT), 1)
    car.gain = np.nextafter(1.0, 2.0)
    second = closures.settled(hjb.Problem(car.drift, square, UNIT), 1)
    assert first.drift.func != second.drift.func
    car.gain = 1.0
    assert closures.settled(hjb.Problem(car.drift, square, UNIT), 1).drift.func == first.drift.func


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
            assert found.mark is None
            assert not found._jaxprs


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


def test_gradients_batches_and_compilation_see_what_is_closed_over():
    with jax.enable_x64(True):
        found, wanted = (np.array(jax.jit(jax.value_and_grad(ask))(1.3)) for ask in (curved, as_leaves))
        np.testing.assert_allclose(found, wanted, rtol=1e-9)
        ahead = jax.jvp(curved, (1.3,), (1.0,))[1]
        assert ahead == pytest.approx(wanted[1], rel=1e-9)
        lanes = jax.vmap(curved)(jnp.array([0.7, 1.3]))
    assert lanes[1] == pytest.approx(curved(1.3), abs=2e-6)
    assert lanes[0] == pytest.approx(curved(0.7), abs=2e-6)


def test_a_closure_beside_a_leaf_and_inside_a_march():
    def marched(a):
        problem = hjb.Problem(jax.tree_util.Partial(lambda b, x, u: b * u, a), lambda x, u: a * (x @ x), UNIT)
        return hjb.march(problem, LINE, 0.5, step=0.05, scheme=hjb.Upwind(split=True)).value[0, 2]

    slope = jax.grad(marched)(1.0)
    assert slope == pytest.approx((marched(1.001) - marched(0.999)) / 0.002, rel=1e-2)


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
