"""Options of JAX that the caller has set: every front door answers as without them, and the caller keeps them."""

import contextlib
import functools
import itertools
import types
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilation import compiling

import hjbjax as hjb
from hjbjax.problem.pytree import front_door
from hjbjax.problem.settings import own_settings

F = hjb.filtering
U = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([-1.0], [1.0], (9,))
WIDE = hjb.Grid([-1.0], [1.0], (21,))
RECORD = np.full((4, 1), 0.1)
HELD = np.zeros((4, 1))

# What people set who debug, or who want other defaults for programs of their own.
SETTINGS = {
    "debug_nans": {"jax_debug_nans": True},
    "debug_infs": {"jax_debug_infs": True},
    "strict_types": {"jax_numpy_dtype_promotion": "strict"},
    "strict_ranks": {"jax_numpy_rank_promotion": "raise"},
    "no_transfers": {
        f"jax_transfer_guard_{way}": "disallow" for way in ("host_to_device", "device_to_device", "device_to_host")
    },
    "leaks": {"jax_check_tracer_leaks": True},
    "reused_keys": {"jax_debug_key_reuse": True},
    "64_bits": {"jax_enable_x64": True},
    "bfloat16": {"jax_default_matmul_precision": "bfloat16"},
    "no_jit": {"jax_disable_jit": True},
    "no_tracing": {"jax_no_tracing": True},
    "no_execution": {"jax_no_execution": True},
    "log": {"jax_log_compiles": True, "jax_explain_cache_misses": True},
}
# The package leaves these to the caller. Each has programs of its own, which take long to compile again.
OTHERS = {
    "device": {"jax_default_device": "cpu"},
    "rbg": {"jax_default_prng_impl": "rbg"},
    "not_partitionable": {"jax_threefry_partitionable": False},
    "linearised": {"jax_use_direct_linearize": False},
    "checks": {"jax_enable_checks": True},
}


@contextlib.contextmanager
def caller(settings):
    """The options as a caller sets them for a whole process, so that threads and callbacks see them as well."""
    before = {name: getattr(jax.config, name) for name in settings}
    try:
        for name, value in settings.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def drift(x, u):
    return jnp.array([[-0.5]]) @ x + u * jnp.ones((1, 1))[0]


def cost(x, u):
    return 2 * (x @ x) / 2 + u @ u  # integers and floats meet, as in functions of users


def hold(x):
    return -x


def full_speed(x):
    return -jnp.sign(x)


def ball(x):
    return jnp.abs(x[0]) - 0.25


def seen(x):
    return 2 * x


def bell(x):
    return jnp.exp(-x @ x)


def peak(x):
    return -x @ x


LQ = hjb.Problem(drift, cost, U, discount=1.0)
FREE = hjb.Problem(drift, cost, hjb.Box([-9.0], [9.0]))
PLANT = hjb.Problem(drift, cost, U, noise=0.5)
TO_TARGET = hjb.Problem(lambda x, u: u, lambda x, u: 1.0, U, target=ball)
LOST = hjb.Problem(lambda x, u: jnp.where(x > 0.5, 0.3, u), lambda x, u: 1.0, U, target=lambda x: x[0] + 0.5)
TUBE = hjb.reach(lambda x, u: u, U, ball)
WEIGHT, HALF, ONE = jnp.asarray(0.9), jnp.array([0.5]), jnp.zeros(1)
KEY = jax.random.key(0, impl="threefry2x32")


def arrays(*answers):
    """The leaves of answers, in NumPy."""
    return [np.asarray(leaf) for leaf in jax.tree.leaves(answers)]


def numbers_of(solution):
    assert solution.status is hjb.Status.CONVERGED
    return arrays(solution.value, solution.policy, solution.enclosure, solution.grid_error)


def upwind(problem, grid=GRID, **options):
    return numbers_of(hjb.solve(problem, grid, scheme=hjb.Upwind(), **options))


def value_of(weight):
    """A value that depends on a number that may be traced."""
    problem = hjb.Problem(lambda x, u: weight * drift(x, u), cost, U, discount=1.0)
    return hjb.solve(problem, GRID, scheme=hjb.Upwind()).value_at(HALF)


def game(gamma):
    return hjb.attenuation(hjb.Problem(drift, cost, U), gamma, U)


def known():
    x = GRID.axis(0)
    return hjb.Solution(GRID, 0.25 * x**2, -0.5 * x[:, None])


def by_turns(observer):
    state = observer.update(observer.initial(), ONE, HALF, WEIGHT)
    return arrays(state, observer.estimate(state))


# made once, as a function is compiled once for one object
DERIVATIVE = jax.jit(jax.value_and_grad(value_of))
DOORS = {
    "solve": lambda: upwind(LQ),
    "march": lambda: numbers_of(hjb.march(LQ, GRID, 0.2, scheme=hjb.Upwind(split=True))),
    "solve_batch": lambda: [numbers_of(each) for each in hjb.solve_batch([LQ, LQ], GRID, scheme=hjb.Upwind())],
    "simulate": lambda: arrays(hjb.simulate(PLANT, hold, [0.5], 0.2, steps=4, key=KEY)),
    "pontryagin": lambda: arrays(hjb.pontryagin(FREE, [0.5], horizon=0.5)),
    "zakai": lambda: arrays(F.zakai(PLANT, seen, GRID, RECORD, 0.05, bell, controls=HELD)),
    "robust_filter": lambda: arrays(F.robust_filter(PLANT, seen, GRID, RECORD, 0.05, peak, gamma=2.0, controls=HELD)),
    "hinf_level": lambda: [np.asarray(hjb.hinf_level(game, GRID, 0.1, 8.0, tol=0.9, horizon=4.0, settle=0.2).gamma)],
    "queries": lambda: arrays(known().value_at([0.3]), hjb.greedy_feedback(LQ, known())([0.3])),
    "jit and grad": lambda: arrays(DERIVATIVE(WEIGHT)),
}
MORE = {
    "limited": lambda: numbers_of(hjb.solve(LQ, WIDE)),
    "target": lambda: upwind(TO_TARGET, WIDE),
    "unreachable": lambda: upwind(LOST, WIDE),
    "tube": lambda: upwind(TUBE, WIDE),
    "float32": lambda: upwind(LQ, dtype="float32"),
    "Direct": lambda: upwind(LQ, method=hjb.PolicyIteration(hjb.Direct())),
    "Krylov": lambda: upwind(PLANT_DISCOUNTED, method=hjb.PolicyIteration(hjb.Krylov())),
    "arcs": lambda: numbers_of(hjb.solve(TO_TARGET, WIDE, scheme=hjb.SemiLagrangian())),
    "march to a target": lambda: numbers_of(hjb.march(TO_TARGET, WIDE, 0.5, scheme=hjb.Upwind(split=True))),
    "implicit": lambda: numbers_of(hjb.march(LQ, GRID, 0.2, method=hjb.Implicit())),
    "past the target": lambda: arrays(hjb.simulate(TO_TARGET, full_speed, [0.9], 3.0, steps=4)),
    "no noise": lambda: arrays(hjb.simulate(LQ, hold, [0.5], 0.2, steps=4)),
    "a solution's feedback": lambda: arrays(hjb.simulate(LQ, known(), [0.5], 0.2, steps=4)),
    "ExtendedKalman": lambda: by_turns(F.ExtendedKalman(PLANT, seen, [0.0], [1.0])),
    "Luenberger": lambda: by_turns(F.Luenberger(PLANT, seen, [[1.0]], [0.0])),
    "GridFilter": lambda: by_turns(F.GridFilter(PLANT, seen, GRID, bell)),
    "RobustGridFilter": lambda: by_turns(F.RobustGridFilter(PLANT, seen, GRID, peak, 2.0)),
    "WonhamFilter": lambda: by_turns(F.WonhamFilter([[-1.0, 1.0], [2.0, -2.0]], [0.0, 1.0], [1.0, 1.0])),
    "reach_probability": lambda: numbers_of(hjb.reach_probability(PLANT, GRID, ball, horizon=0.5)),
    "expected_exit_time": lambda: numbers_of(hjb.expected_exit_time(PLANT, GRID, ball)),
    "generator": lambda: [hjb.chain.generator(LQ, GRID, -0.5 * GRID.axis(0)[:, None]).toarray()],
    "lyapunov_check": lambda: [np.asarray(hjb.lyapunov_check(lambda x: x @ x, hold, U).holds)],
    "geometry": lambda: [np.asarray(hjb.geometry.is_feedback_linearisable(turning, push, [0.0, 0.0]).linearisable)],
    "lie_bracket": lambda: arrays(hjb.geometry.lie_bracket(turning, push)(np.zeros(2))),
    "estimate": lambda: [np.asarray(hjb.estimate(LQ, GRID, measure=False).bytes)],
    "grad without jit": lambda: arrays(jax.grad(value_of)(WEIGHT)),
    "vmap": lambda: arrays(jax.vmap(value_of)(WEIGHTS)),
}
PLANT_DISCOUNTED = hjb.Problem(drift, cost, U, noise=0.5, discount=1.0)
WEIGHTS = jnp.array([0.8, 0.9])
OBSERVERS = ("ExtendedKalman", "Luenberger", "GridFilter", "RobustGridFilter", "WonhamFilter")
FOLLOWS_JAX = ("jit and grad", "vmap", "grad without jit", "lie_bracket", *OBSERVERS)
BY_ITSELF = {  # JAX's own ``grad`` makes such a transfer, and a program of the caller's own does not run
    ("grad without jit", "no_transfers"),
    *((door, "no_execution") for door in ("jit and grad", "grad without jit", "vmap", "queries", "hinf_level")),
}


def turning(x):
    return jnp.array([x[1], jnp.sin(x[0])])


def push(x):
    return jnp.array([0.0, 1.0])


@functools.cache
def wanted(door):
    """The answer without a setting."""
    return (DOORS | MORE)[door]()


def check(door, setting, settings):
    """Compare an answer with that without the setting; returns the programs that were compiled for it."""
    expected = jax.tree.leaves(wanted(door))
    with caller(settings), compiling() as programs:
        found = jax.tree.leaves((DOORS | MORE)[door]())
    # inside ``jit`` the caller's precision holds, and without ``jit`` the host's
    rounding = 1e-5 if setting in ("64_bits", "no_jit") and door in FOLLOWS_JAX else 0
    for got, known in zip(found, expected, strict=True):
        np.testing.assert_allclose(got, known, rtol=rounding, atol=rounding)
    return programs


def paired(pair):
    """A door and a setting; some pairs run for long."""
    dear = pair[0] == "simulate" and pair[1] in ("debug_nans", "debug_infs")
    dear |= pair[0] == "hinf_level"
    dear |= pair[0] == "jit and grad" and pair[1] not in ("debug_nans", "64_bits", "no_jit")
    return pytest.param(*pair, marks=[pytest.mark.slow] * dear)


# every setting and every door, but not every pair: each changed setting compiles a door's programs again
A_QUARTER = [(door, name) for i, door in enumerate(MORE) for j, name in enumerate(SETTINGS) if (i + j) % 4 == 0]


@pytest.mark.parametrize(("door", "setting"), [*map(paired, itertools.product(DOORS, SETTINGS))])
def test_an_answer_does_not_depend_on_a_setting(door, setting):
    if (door, setting) in BY_ITSELF:
        return
    programs = check(door, setting, SETTINGS[setting])
    # the same options hold inside, so that the programs are the same; a device and the caller's ``jit`` have their own
    assert not programs or setting == "device" or door == "jit and grad"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.solution.status.SolveWarning")  # these small grids are poor
@pytest.mark.parametrize(("door", "setting"), A_QUARTER)
def test_an_answer_of_another_door_does_not_depend_on_a_setting(door, setting):
    if (door, setting) not in BY_ITSELF:
        check(door, setting, SETTINGS[setting])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.solution.status.SolveWarning")  # these small grids are poor
@pytest.mark.parametrize("setting", OTHERS)
@pytest.mark.parametrize("door", DOORS)
def test_an_answer_does_not_depend_on_an_option_that_is_left_to_the_caller(door, setting):
    if (door, setting) != ("simulate", "not_partitionable"):  # which are other random numbers
        check(door, setting, OTHERS[setting])


PLANE = hjb.Grid([0.0, -1.0], [2.0, 1.0], (8, 9), periodic=(True, False), stretch=(None, hjb.Sinh(2.0, 0.1)))
STATES = np.array([[-0.3, 0.2], [2.5, -0.7], [1.0, 0.0]])
CONVEX = [hjb.convex.box([-1, -1], [1.0, 2.0]), hjb.convex.ellipsoid([0.1, 0], [[2, 0], [0, 1.0]])]


def direct_calls():
    lookups = [PLANE.interpolate(PLANE.nodes(), STATES), PLANE.interpolate(np.eye(8, 9), STATES[0])]
    return arrays(PLANE.wrap(STATES), lookups, [convex(STATES[0]) for convex in CONVEX])


@pytest.mark.parametrize("setting", SETTINGS)
def test_grids_and_convex_functions_do_not_depend_on_a_setting(setting):
    rounding = 1e-6 if setting == "64_bits" else 0
    with caller(SETTINGS[setting]):
        found = direct_calls()
    for got, known in zip(found, direct_calls(), strict=True):
        np.testing.assert_allclose(got, known, rtol=rounding, atol=rounding)


def is_own(function, module):
    """True if a file without ``__all__`` defines a public function."""
    return function.__module__ == module.__name__ and not function.__name__.startswith("_")


MODULES = (hjb, F, hjb.geometry, hjb.stability, hjb.chain, hjb.zoo)
FUNCTIONS = {
    f"{module.__name__}.{name}": thing
    for module in MODULES
    for name, thing in list(vars(module).items())
    if isinstance(thing, types.FunctionType) and (name in getattr(module, "__all__", ()) or is_own(thing, module))
}
OF_OBSERVERS = {
    f"{kind}.{name}": getattr(getattr(F, kind), name)
    for kind in OBSERVERS
    for name in ("__init__", "initial", "update", "estimate")
}
ENTERED = front_door(lambda **options: None).__code__
WITHOUT_JAX = {"hjbjax.load", "hjbjax.keep_compiled"}


@pytest.mark.parametrize("name", sorted((FUNCTIONS.keys() | OF_OBSERVERS.keys()) - WITHOUT_JAX))
def test_a_public_function_is_a_front_door(name):
    function, codes = (FUNCTIONS | OF_OBSERVERS)[name], set()
    while function is not None:
        codes.add(function.__code__)
        function = getattr(function, "__wrapped__", None)
    assert ENTERED in codes


def options_here():
    """The options of JAX in this thread that ``SETTINGS`` names."""
    return {name: getattr(jax.config, name) for each in SETTINGS.values() for name in each}


def test_the_caller_and_other_threads_keep_their_options():
    """The options hold while a function of the problem runs, in this thread alone, and end with the call."""
    seen = {}

    def drift(x, u):
        with ThreadPoolExecutor(1) as pool:
            seen.update(inside=options_here(), beside=pool.submit(options_here).result())
        return u

    theirs = {name: value for setting in SETTINGS.values() for name, value in setting.items()}
    theirs |= {"jax_disable_jit": False, "jax_enable_x64": False}
    with caller(theirs):
        hjb.solve(hjb.Problem(drift, cost, U, discount=1.0), GRID, scheme=hjb.Upwind())
        assert options_here() == theirs
        with (
            jax.no_tracing(False),
            jax.no_execution(False),
            pytest.raises(jax.errors.JaxRuntimeError, match="Disallowed host-to-device"),
        ):
            jnp.sin(np.ones(2))
    assert seen["beside"] == theirs
    alike = {name for name, value in theirs.items() if seen["inside"][name] == value}
    assert alike == {"jax_log_compiles", "jax_explain_cache_misses", "jax_disable_jit"}


@pytest.mark.parametrize("name", ["nan", "divide", "oob"])
def test_an_option_that_cannot_be_changed_for_one_call_is_refused(name):
    option = f"jax_error_checking_behavior_{name}"
    with caller({option: "raise"}):
        for door in ("solve", "march", "simulate", "zakai"):
            with pytest.raises(ValueError, match=f"{door}|GridFilter") as caught:
                DOORS[door]()
            assert f"jax.config.update('{option}', 'ignore')" in str(caught.value)


def test_the_options_end_with_a_call_that_raises():
    def drift(x, u):
        raise RuntimeError("a bug of the user's")

    before = options_here()
    with pytest.raises(Exception, match="a bug of the user's"):
        hjb.solve(hjb.Problem(drift, cost, U, discount=1.0), GRID)
    assert options_here() == before


def test_inside_a_transformation_the_callers_precision_holds():
    for wide in (False, True):
        with jax.enable_x64(wide):
            answer = jax.eval_shape(value_of, jax.ShapeDtypeStruct((), np.float64 if wide else np.float32))
        assert answer.dtype == (np.float64 if wide else np.float32)


def test_products_of_matrices_are_exact_to_the_last_bit_of_their_type():
    """With "bfloat16", or by default on a GPU, they would keep 8 or 11 bits of float32."""
    observer = F.ExtendedKalman(PLANT, seen, [0.0], [1.0])

    def step(state):
        return observer.update(state, ONE, HALF, WEIGHT)

    with caller(SETTINGS["bfloat16"]):
        program = jax.jit(step).lower(observer.initial()).as_text()
    products = [line for line in program.splitlines() if "dot_general" in line]
    assert products
    assert all("precision = [HIGHEST, HIGHEST]" in line for line in products)


def test_a_nan_of_the_users_own_is_found():
    with caller(SETTINGS["debug_nans"]), pytest.raises(ValueError, match="cost.* is NaN or infinite at 4 of 9 nodes"):
        upwind(hjb.Problem(drift, lambda x, u: jnp.sqrt(x[0]), U, discount=1.0))


def test_nothing_of_a_context_is_left_to_the_next():
    before = options_here()
    with own_settings(x64=True), own_settings(x64=False), own_settings():
        assert not jax.config.jax_enable_x64
    assert options_here() == before
