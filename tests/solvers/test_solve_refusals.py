"""What solve refuses, and what it says: the argument, what it got, what is wanted, the way out; six lines at most."""

import tracemalloc

import jax.numpy as jnp
import numpy as np
import pytest
from compilation import compiling
from refusals import BOX, GRID, cost, drift, problem, refusal

import hjbjax as hjb

# --- arguments of solve ---


@pytest.mark.parametrize("tol", [0.0, -1e-3, float("nan"), float("inf"), [1e-3, 1e-3], True, "1e-3"])
def test_tolerance(tol):
    refusal(ValueError, "tol", repr(tol), "> 0", tol=tol)


@pytest.mark.parametrize("count", [0, -3, 2.5, True, "7"])
def test_max_steps(count):
    refusal((ValueError, TypeError), "max_steps", repr(count), "positive integer", max_steps=count)


@pytest.mark.parametrize("seconds", [0, -1.0, float("nan"), True, "60"])
def test_time_limit(seconds):
    refusal((ValueError, TypeError), "time_limit", repr(seconds), "> 0", time_limit=seconds)


@pytest.mark.parametrize("dtype", ["float16", "int32", "complex128"])
def test_dtype(dtype):
    refusal((ValueError, TypeError), "dtype", repr(dtype), "float64", "float32", dtype=dtype)


def test_method_and_scheme_are_values():
    refusal(TypeError, "method", "'policy'", "hjb.PolicyIteration", method="policy")
    refusal(TypeError, "method", "PolicyIteration", method=hjb.PolicyIteration)
    refusal(TypeError, "scheme", "'upwind'", "hjb.Upwind", scheme="upwind")


def test_problem_and_grid_are_not_exchanged():
    with pytest.raises(TypeError, match=r"Grid.*Problem.*wanted a Problem and a Grid"):
        hjb.solve(GRID, problem(), scheme=hjb.Upwind())


def test_guess_of_another_shape():
    refusal(ValueError, "guess", "(10, 8)", "(8, 10)", "transposed", guess=np.zeros((10, 8)))
    error = refusal(ValueError, "guess", "(8, 9)", "(8, 10)", guess=np.zeros((8, 9)))
    assert "transposed" not in str(error)
    refusal(ValueError, "guess", "()", guess=1.0)
    refusal(ValueError, "the guess is [[1], [1, 2]]", "(8, 10)", guess=[[1], [1, 2]])
    refusal(ValueError, "guess", "(8, 10)", guess=["high"])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_guess_that_is_not_finite(bad):
    guess = np.zeros(GRID.shape)
    guess[2, 3] = guess[4, 4] = bad
    refusal(ValueError, "guess", "2 nodes", guess=guess)


# --- questions without a stationary answer ---


def test_what_belongs_to_a_finite_horizon():
    refusal(ValueError, "terminal_cost", "horizon", question=problem(terminal_cost=0.0))
    timed = hjb.Problem(lambda t, x, u: drift(x, u), controls=BOX, discount=1.0, time_dependent=True)
    refusal(ValueError, "time", "horizon", question=timed)


def test_an_endless_sum_of_costs():
    refusal(
        ValueError,
        "no finite solution",
        "discount",
        "target",
        question=problem(discount=0.0, cost=lambda x, u: 1.0 + x @ x),
    )


def with_effort(x, u):
    return x @ x + u @ u


def test_rest_between_the_nodes_is_no_rest():
    question = problem(discount=0.0, cost=with_effort)
    refusal(ValueError, "rest point", "on a node", question=question)
    odd = hjb.Grid([-1.0, -2.0], [1.0, 2.0], (9, 11))
    assert hjb.solve(question, odd, tol=1e-2, scheme=hjb.Upwind()).value[4, 5] == 0.0


def test_target_without_a_node_and_target_everywhere():
    refusal(ValueError, "no node lies in the target", "refine", question=problem(target=lambda x: x @ x - 1e-4))
    refusal(ValueError, "all 80 nodes", "enlarge the box", question=problem(target=lambda x: x @ x - 100.0))


# --- functions ---


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (lambda x, u: jnp.stack([x[1], u[0], x[0]]), ("shape (3,)", "(2,)")),
        (lambda x, u: [x[1], u[0]], ("a list", "jnp.stack")),
        (lambda x, u: None, ("None", "(2,)")),
        (lambda x, u: "fast", ("'fast'", "(2,)")),
        (lambda x, u: x * 1j, ("complex", "(2,)")),
        (lambda x, u: x if x[0] > 0 else -x, ("jnp.where",)),
        (lambda x, u: np.sin(np.asarray(x)), ("jnp instead of np",)),
        (lambda x: x, ("drift(x, u)",)),
    ],
    ids=["shape", "list", "none", "string", "complex", "if", "numpy", "arity"],
)
def test_drift_that_cannot_be_used(bad, words):
    error = refusal(ValueError, "drift(x, u)", *words, question=problem(drift=bad))
    if words[0].startswith("jnp"):
        assert error.__cause__ is not None


@pytest.mark.parametrize("name", ["cost", "stopping_cost", "exit_cost", "target", "noise"])
def test_other_functions_of_the_wrong_shape(name):
    def bad(*arguments):
        return jnp.zeros((3,))

    changes = {name: bad}
    if name == "exit_cost":
        changes["target"] = lambda x: x @ x - 1.0
    refusal(ValueError, name, "shape (3,)", question=problem(**changes))


@pytest.mark.parametrize("name", ["drift", "cost", "stopping_cost", "target", "exit_cost", "noise"])
def test_functions_that_are_not_finite_at_nodes(name):
    grid = hjb.Grid([0.0, -2.0], [1.0, 2.0], (8, 10))  # 1/x₁ is infinite at the 10 nodes of the first row

    def pole(x, *rest):
        return (-1.0 if name == "stopping_cost" else 1.0) / x[0] - 1.5  # a stopping cost of +∞ forbids stopping

    def poles(x, *rest):
        return jnp.stack([pole(x), x[1]])

    changes = {name: poles if name == "drift" else pole}
    if name == "exit_cost":
        changes["target"] = lambda x: x[0] - 0.5
    if name == "noise":
        changes["noise"] = lambda x, u: jnp.stack([1.0 / x[0], 1.0])
    refusal(
        ValueError, name, "10 of 80 nodes", "(0, 0)", "[0, -2]", "jnp.where", question=problem(**changes), grid=grid
    )


def test_noise_that_is_negative_at_nodes():
    refusal(ValueError, "noise", "negative", "≥ 0", question=problem(noise=lambda x, u: x[0]))


def test_correlated_noise_without_a_chain():
    sigma = np.array([[1.0, 0.0], [0.95, 0.1]])
    grid = hjb.Grid([-1.0, -2.0], [1.0, 2.0], (41, 9))
    error = refusal(ValueError, "noise", "correlated", "a_ii", "shape=", question=problem(noise=sigma), grid=grid)
    shape = tuple(int(n) for n in str(error).split("shape=(")[1].split(")")[0].split(","))
    fixed = hjb.Grid([-1.0, -2.0], [1.0, 2.0], shape)
    assert (
        hjb.solve(problem(noise=sigma), fixed, scheme=hjb.Upwind()).status is hjb.Status.CONVERGED
    )  # the advice is good


# --- other arguments ---


@pytest.mark.parametrize("tol", ["1e-3", object()])
def test_tolerance_that_is_no_number(tol):
    refusal((ValueError, TypeError), "tol", repr(tol), tol=tol)


def test_guess_that_is_no_array_of_numbers():
    refusal((ValueError, TypeError), "guess", guess="zeros")
    refusal((ValueError, TypeError), "guess", guess=np.zeros(GRID.shape, complex) + 1j)


@pytest.mark.parametrize("seconds", ["5"])
def test_time_limit_that_is_no_number(seconds):
    refusal((ValueError, TypeError), "time_limit", repr(seconds), "> 0", time_limit=seconds)


@pytest.mark.parametrize("dtype", ["flaot64"])
def test_unknown_dtype(dtype):
    refusal((ValueError, TypeError), "dtype", repr(dtype), "float64", "float32", dtype=dtype)


# --- memory ---


def many(x, u):
    return -x


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((200,) * 5, ("200 x 200 x 200 x 200 x 200", "320,000,000,000 nodes", "2,147,483,648", "N = 73")),
        ((50_000, 50_000), ("2,500,000,000 nodes", "2,147,483,648", "N = 46340")),
        ((1000,) * 7, ("nodes", "N = ")),  # more than 2⁶³ nodes would abort the interpreter in JAX
        ((30_000, 30_000), ("30000 x 30000", "900,000,000 nodes", "GB are free", "max_memory=", "N = ")),
    ],
)
def test_grids_that_do_not_fit_are_refused_before_anything_is_made(shape, words):
    n = len(shape)
    question = hjb.Problem(many, cost, hjb.Box([-1.0], [1.0]), discount=1.0)
    options = {"max_memory": 16 * 10**9} if n == 2 and shape[0] == 30_000 else {}
    tracemalloc.start()
    try:
        with compiling() as programs:
            refusal(MemoryError, *words, question=question, grid=hjb.Grid([-1.0] * n, [1.0] * n, shape), **options)
        assert (programs, tracemalloc.get_traced_memory()[1] < 10**7) == ([], True)
    finally:
        tracemalloc.stop()


def test_max_memory_overrides_what_is_free():
    error = refusal(MemoryError, "80 nodes", "5e-06 GB", max_memory=5_000)
    assert "max_memory" in str(error)
    assert hjb.solve(problem(), GRID, max_memory=10**6, scheme=hjb.Upwind()).status is hjb.Status.CONVERGED
