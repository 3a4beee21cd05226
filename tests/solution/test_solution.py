"""The answer: between the nodes, through transformations, and on the screen."""

import base64
import dataclasses
import io
import pickle
import re

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from small_solutions import GRID, LINEAR, RING, solution_of

from hjbjax.problem.grid import Grid
from hjbjax.solution.solution import Solution, SolveError, Status

# Status and errors


def test_status_says_what_happened_and_what_to_do():
    names = ["RUNNING", "CONVERGED", "MAX_STEPS", "STALLED", "DIVERGED", "NONFINITE", "INTERRUPTED", "TIME_LIMIT"]
    assert [status.name for status in Status] == names
    assert [int(status) for status in Status] == list(range(8))
    messages = {status.message for status in Status}
    assert len(messages) == 8
    assert all(message.endswith(".") for message in messages)
    faults = [status for status in Status if status not in (Status.RUNNING, Status.CONVERGED)]
    assert all(";" in status.message for status in faults)
    assert f"{Status.STALLED}" == str(Status.STALLED) == "STALLED"


def test_solve_error_carries_the_solution():
    error = SolveError("no luck", LINEAR)
    assert isinstance(error, RuntimeError)
    assert error.solution is LINEAR
    assert str(error) == "no luck"
    assert SolveError("nothing yet").solution is None


# Transformations


def test_a_solution_leaves_jit_vmap_and_grad():
    def solve(scale):
        value = scale * jnp.asarray(LINEAR.value)
        code = jnp.where(scale > 1, int(Status.CONVERGED), int(Status.MAX_STEPS))
        solution = Solution(
            GRID,
            value,
            value[..., None],
            code=code,
            steps=jnp.asarray(4),
            enclosure=jnp.array([[1.0, -0.5], [1.0, 1.0]]) * jnp.stack([jnp.ones(()), scale]),
            message="m",
        )
        if isinstance(code, jax.core.Tracer):  # in jit and vmap, and not in grad
            assert isinstance(solution.status, jax.core.Tracer)
            assert repr(solution) == str(solution) == "Solution(traced, grid of shape (5, 4))"
        return solution

    single = jax.jit(solve)(2.0)
    assert single.status is Status.CONVERGED
    assert single.message == ""
    assert single.stats == {}
    assert single.residual is None
    assert single.error == pytest.approx(2, abs=1e-5)
    assert single.grid.shape == (5, 4)
    assert single.value_at([0.1, 1.0]) == pytest.approx(0.4, abs=1e-6)
    assert str(single).startswith("CONVERGED: ")
    batch = jax.vmap(solve)(jnp.array([0.5, 2.0, 3.0]))
    assert batch.status.tolist() == [2, 1, 1]
    assert str(batch) == repr(batch) == "Solution(a batch, grid of shape (5, 4))"
    with pytest.raises(ValueError, match=r"shape \(3, 5, 4\) on a grid of shape \(5, 4\); query a batch.*vmap"):
        batch.value_at([0.1, 1.0])
    np.testing.assert_allclose(
        jax.vmap(lambda solution, x: solution.value_at(x), (0, None))(batch, jnp.array([0.1, 1.0])),
        [0.1, 0.4, 0.6],
        rtol=1e-5,
    )
    apart = np.array([0.5, 2.0, 3.0])[:, None, None]
    np.testing.assert_allclose(batch.bounds, [batch.value - apart / 2, batch.value + apart], rtol=1e-6, atol=1e-6)
    assert batch.error == pytest.approx(3, abs=1e-5)
    assert jax.tree.map(lambda leaf: leaf[0], batch).status is Status.MAX_STEPS
    assert jax.grad(lambda scale: solve(scale).value_at([0.5, 1.0]))(2.0) == pytest.approx(1.0)
    assert jax.jit(lambda scale: solve(scale).error)(2.0) == pytest.approx(2, abs=1e-5)


def test_a_traced_solution_cannot_be_saved(tmp_path):
    def save(value):
        Solution(GRID, value, None).save(tmp_path / "run.npz")

    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(save)(LINEAR.value)
    assert list(tmp_path.iterdir()) == []


def test_moving_the_grid_does_not_recompile():
    traces = []

    @jax.jit
    def value_there(solution, x):
        traces.append(1)
        return solution.value_at(x)

    for end in (3.0, 4.0, 5.0):
        value_there(Solution(Grid([-1.0, 0.0], [1.0, end], (5, 4)), LINEAR.value, LINEAR.policy), jnp.zeros(2))
    assert len(traces) == 1


def test_rebuilding_does_not_validate():
    structure = jax.tree.structure(LINEAR)
    rebuilt = jax.tree.unflatten(structure, [object()] * structure.num_leaves)
    assert rebuilt.discrete is False
    assert jax.tree.structure(rebuilt) == structure


# Certificates


def test_error_and_bounds():
    value = np.array([0.0, 1.0, np.inf, -4.0])
    grid = Grid([0.0], [3.0], (4,))

    def certified(lower, upper, value=value):
        return Solution(grid, value, None, enclosure=np.array([lower, upper]))

    shifted = certified([1.0, -0.3], [1.0, 0.2])
    assert shifted.error == pytest.approx(0.3)
    assert isinstance(shifted.error, float)
    np.testing.assert_allclose(shifted.bounds, [[-0.3, 0.7, np.inf, -4.3], [0.2, 1.2, np.inf, -3.8]])
    scaled = certified([0.75, -0.5], [2.0, 5.0])  # (V + 2) · ¾ − 2, (V + 5) · 2 − 5
    np.testing.assert_allclose(scaled.bounds, [[-0.5, 0.25, np.inf, -3.5], [5.0, 7.0, np.inf, -3.0]])
    for solution in (shifted, scaled, certified([0.5, 0.0], [1.0, 0.0], np.array([0.0, 1.0, np.inf, 4.0]))):
        lower, upper = (side[solution.value < np.inf] for side in solution.bounds)
        finite = solution.value[solution.value < np.inf]
        assert solution.error == pytest.approx(np.max(np.maximum(upper - finite, finite - lower)))
    assert certified([1.0, 0.0], [1.0, 0.0]).error == 0
    endless = certified([0.0, 0.0], [1.0, np.inf])
    assert endless.error == np.inf
    np.testing.assert_array_equal(endless.bounds, [[0, 0, np.inf, 0], [np.inf] * 4])
    bare = Solution(grid, value, None)
    assert bare.error is None
    assert bare.bounds is None


@pytest.mark.parametrize("where", ["value", "lower", "upper", "all"])
def test_nan_certifies_nothing(where):
    value, enclosure = np.zeros(4), np.array([[1.0, 0.0], [1.0, 0.0]])
    if where == "all":
        value[:] = np.inf
    elif where == "value":
        value[1] = np.nan
    else:
        enclosure[["lower", "upper"].index(where), 1] = np.nan
    solution = Solution(Grid([0.0], [3.0], (4,)), value, None, enclosure=enclosure)
    assert solution.error == np.inf
    assert jax.jit(lambda solution: solution.error)(solution) == np.inf


# The screen

FULL = {
    "method": "PolicyIteration(evaluation=Sweeps(3))",
    "scheme": "Upwind()",
    "device": "cpu",
    "dtype": "float64",
    "seconds": 1.2345,
    "compile_seconds": 0.5,
    "bytes": 12_345_678,
    "tol": 1e-6,
    "certificate": "residual over the discount rate",
    "versions": {"jax": "1"},
}


def test_the_whole_screen():
    value = np.zeros(RING.shape)
    reached = np.ones(RING.shape, bool)
    reached[0, 0] = False
    solution = Solution(
        RING,
        value,
        value[..., None],
        code=Status.CONVERGED,
        steps=7,
        enclosure=np.array([[1.0, -1e-7], [1.0, 2e-7]]),
        isaacs_gap=0.125,
        reached=reached,
        residuals=np.array([1.0, 3e-8]),
        stats=FULL,
    )
    assert str(solution).splitlines() == [
        "CONVERGED: Converged to the requested tolerance.",
        "  grid             angle (periodic) x speed: 8 x 3 = 24 nodes",
        "  method           PolicyIteration(evaluation=Sweeps(3)), Upwind()",
        "  steps            7, last residual 3e-08",
        "  algebraic error  at most 2e-07 (tol 1e-06): residual over the discount rate",
        "  reached          95.8 % of the nodes",
        "  isaacs gap       0.125",
        "  seconds          1.23, and 0.5 to check and compile",
        "  memory           12.3 MB",
        "  device           cpu, float64",
    ]
    assert repr(solution) == "Solution(CONVERGED after 7 steps on 24 nodes)"


@pytest.mark.parametrize("missing", [*FULL, "all"])
def test_the_screen_copes_with_what_is_missing(missing):
    stats = {} if missing == "all" else {name: value for name, value in FULL.items() if name != missing}
    text = str(solution_of(lambda a, b: a, stats=stats))
    assert text.startswith("CONVERGED: ")
    assert "no certificate" in text
    assert all(len(line.split()) > 1 for line in text.splitlines())  # no row without a text
    assert "reached" not in text
    assert "isaacs" not in text
    assert len(text.splitlines()) >= 4


def test_the_screen_says_why_there_is_no_certificate():
    text = str(solution_of(lambda a, b: a, stats={"certificate": "no discount and\nno running cost"}))
    assert "  algebraic error  no certificate: no discount and no running cost" in text.splitlines()


def test_the_screen_stays_one_screen():
    stats = FULL | {"method": "Method\n" * 100, "scheme": "x" * 1000, "certificate": "because " * 200}
    fields = {"stats": stats, "message": "a long story\n" * 100, "isaacs_gap": 1.0, "residuals": np.ones(3)}
    grid = Grid([0.0, 0.0], [1.0, 1.0], (3, 2), names=["a\nrather long name" * 9] * 2)
    solution = solution_of(lambda a, b: a, grid, reached=np.zeros((3, 2), bool), **fields)
    lines = str(solution).splitlines()
    assert len(lines) <= 18
    assert max(map(len, lines)) <= 80
    assert "3 x 2 = 6 nodes" in str(solution)  # the names of the axes are too long
    assert len(repr(solution).splitlines()) == 1


def test_nearly_all_is_not_printed_as_all():
    reached = np.ones((50, 40), bool)
    reached[0, 0] = False
    solution = solution_of(lambda a, b: a, Grid([0.0, 0.0], [1.0, 1.0], (50, 40)), reached=reached)
    assert "99.9 % of the nodes" in str(solution)


def test_the_message_of_the_solve_comes_first():
    assert str(solution_of(lambda a, b: a, message="step 3 is NaN")).startswith("CONVERGED: step 3 is NaN\n")


def test_status_from_every_kind_of_number():
    for code in (3, np.int64(3), np.array(3), jnp.asarray(3), Status.STALLED):
        solution = Solution(GRID, LINEAR.value, None, code=code)
        assert solution.status is Status.STALLED
        assert type(solution.code) is not Status


# For whoever comes from elsewhere


def test_policies_are_called_as_in_reinforcement_learning():
    control, state = LINEAR.predict([0.5, 1.0], "memory", episode_start=True, deterministic=False)
    assert (control.tolist(), state) == ([2.0], "memory")
    many, _ = LINEAR.predict(np.array([[0.5, 1.0], [9.0, 1.0]]))  # the second is taken to the edge
    assert many.tolist() == [[2.0], [4.0]]


@pytest.mark.parametrize("discrete", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_predict_is_control_at_for_every_kind_of_call(discrete):
    turned = dataclasses.replace(solution_of(lambda a, b: jnp.cos(a) + b, RING), discrete=discrete)
    x = np.array([[0.1, 0.5], [7.0, 9.0], [np.inf, 0.0], [np.nan, 0.0]])
    wanted = turned.control_at(x, clamp=True)
    np.testing.assert_allclose(turned.predict(x)[0], wanted, rtol=1e-13)
    assert turned.predict(x)[0].dtype == np.float64
    np.testing.assert_allclose(turned.predict([0, 1])[0], turned.control_at([0.0, 1.0]), rtol=1e-13)
    with jax.debug_nans(True):  # a control may be NaN
        np.testing.assert_allclose(turned.predict(x)[0], wanted, rtol=1e-13)
    inside = jax.jit(lambda y: y + turned.predict(x[0])[0])(jnp.zeros(1))  # a known state in a program
    np.testing.assert_allclose(inside, wanted[0], rtol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda y: turned.predict(y)[0])(x[0]), wanted[0], rtol=1e-6)
    again = pickle.loads(pickle.dumps(turned))  # after the first call, which made a program
    np.testing.assert_allclose(again.predict(x)[0], wanted, rtol=1e-13)
    with pytest.raises(ValueError, match=r"states of shape \(3,\)"):
        turned.predict([1.0, 2.0, 3.0])


def test_states_outside_are_told_of():
    with pytest.warns(UserWarning, match=r"value_at: 1 of 2 states lie outside the grid, .* clamp=True to use") as told:
        assert np.isnan(LINEAR.value_at([[0.0, 0.0], [1.01, 0.0]])).tolist() == [False, True]
    assert told[0].filename == __file__
    inside = [[1 + 2e-15, 3 + 2e-15], [-1 - 2e-15, -2e-15], [np.nan, 0.0]]
    assert np.isnan(LINEAR.control_at(inside))[:, 0].tolist() == [False, False, True]
    assert np.isnan(jax.jit(LINEAR.value_at)(jnp.array([2.0, 0.0])))  # no values to look at
    turned = solution_of(lambda a, b: jnp.cos(a) + b, RING)
    np.testing.assert_allclose(turned.value_at([2 * np.pi + 0.1, 0.5]), turned.value_at([0.1, 0.5]))


@pytest.mark.parametrize("marched", [False, True])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_notebooks_get_a_thumbnail(n, marched):
    grid = Grid([0.0] * n, [1.0] * n, (7, 300, 5)[:n], names=("a<b", "y", "z")[:n])
    value = np.array(np.sum(grid.nodes(), axis=-1))
    value[(0,) * min(n, 2)] = np.inf
    fields = {"value": value, "policy": None, "code": 1}
    if marched:
        fields = {"value": np.stack([value] * 2), "policy": None, "code": 1, "times": np.array([0.0, 1.0])}
    shown = Solution(grid, **fields)._repr_html_()
    picture = re.search(r'<img alt="V over (.*?)" .*base64,([^"]*)">', shown)
    assert picture[1] == ("a&lt;b" if n == 1 else "a&lt;b and y")
    pixels = plt.imread(io.BytesIO(base64.b64decode(picture[2])))
    assert pixels.shape == ((160, 7, 4) if n == 1 else (150, 7, 4))
    assert pixels[-1, 0, 3] == 0  # infinite: nothing is there
    assert pixels[-1, -1, 3] == 1
    assert "7" in shown.partition("<pre>")[2]
