"""Studies of convergence: known orders, Richardson's estimate, refusals, the table and the picture."""

import io
import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import hjbjax as hjb
from hjbjax import plotting, zoo
from hjbjax.applications.convergence import Study, fitted_order
from hjbjax.applications.reference import absolute_difference, mask_of, richardson
from hjbjax.plotting.style import few
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status

ROOT = Path(__file__).parents[2]
PROBLEM, _ = zoo.bang_bang()
EXACT = zoo.bang_bang_exact()


def line(*counts, lo=-2.0, **options):
    return [hjb.Grid([lo], [2.0], (count,), **options) for count in counts]


def plane(*shapes):
    return [hjb.Grid([-1.0, -1.0], [1.0, 1.0], shape) for shape in shapes]


@pytest.fixture(scope="module")
def plain():
    return hjb.convergence_study(PROBLEM, line(81, 21, 41), EXACT)


# --- orders ---


@pytest.mark.slow
def test_the_chain_is_first_order_and_the_limited_scheme_second(plain):
    assert plain.nodes.tolist() == [21, 41, 81]  # sorted from coarse to fine
    np.testing.assert_allclose(plain.h, [0.2, 0.1, 0.05], rtol=1e-12)
    np.testing.assert_allclose(plain.errors[1:], (5.577e-2, 2.879e-2), rtol=0.05)
    assert abs(plain.order - 1) <= 0.15
    assert abs(plain.mean_order - 1) <= 0.15
    limited = hjb.convergence_study(PROBLEM, line(21, 41, 81), EXACT, scheme=hjb.Limited())
    assert limited.order >= 1.8
    assert np.all(limited.errors < 0.1 * plain.errors)


@pytest.mark.slow
def test_what_a_study_says_of_its_solutions(plain):
    off = np.abs(plain.solutions[-1].value - [float(EXACT(x)) for x in plain.grids[-1].nodes()])
    assert plain.errors[-1] == pytest.approx(off.max(), rel=1e-4)  # EXACT is float32 outside of enable_x64
    assert plain.mean_errors[-1] == pytest.approx(off.mean(), rel=1e-3)
    assert plain.statuses == (Status.CONVERGED,) * 3
    assert plain.fitted.all()
    assert plain.orders == pytest.approx(np.log2(plain.errors[:-1] / plain.errors[1:]))
    assert plain.order == pytest.approx(fitted_order(plain.h, plain.errors))
    assert (plain.seconds > 0).all()
    assert (plain.compile_seconds >= 0).all()
    assert not plain.estimated
    assert plain.extrapolated is None


@pytest.mark.slow
def test_an_error_below_the_tolerance_is_not_fitted():
    problem, _ = zoo.stochastic_lq()  # the chain is exact on it
    study = hjb.convergence_study(problem, line(21, 41), zoo.stochastic_lq_exact(), tol=1e-6)
    assert study.errors.max() <= 1e-6
    assert not study.fitted.any()
    assert np.isnan([study.order, *study.orders]).all()
    assert "* not fitted" in str(study)


@pytest.mark.slow
def test_a_study_in_the_plane_over_a_region():
    def inner(x):
        return (jnp.abs(x[0]) <= 0.5) & (jnp.abs(x[1]) <= 0.45)

    problem, _ = zoo.smooth()
    study = hjb.convergence_study(problem, plane((21, 21), (41, 41)), zoo.smooth_exact(), region=inner, tol=1e-6)
    assert study.errors[1] == pytest.approx(3.15e-2, rel=0.05)
    assert abs(study.order - 1) <= 0.15


def test_a_solve_that_does_not_converge_keeps_its_row_and_leaves_the_fit():
    study = hjb.convergence_study(PROBLEM, line(21, 41), EXACT, tol=1e-300)
    assert Status.CONVERGED not in study.statuses
    assert np.isfinite(study.errors).all()
    assert np.isnan(study.order)
    assert study.statuses[0].name in str(study)


# --- references ---


@pytest.mark.slow
def test_a_finer_solution_as_the_reference(plain):
    (grid,) = line(161)
    fine = hjb.solve(PROBLEM, grid, scheme=hjb.Limited(), tol=1e-9)
    study = hjb.convergence_study(PROBLEM, line(21, 41, 81), fine)
    np.testing.assert_allclose(study.errors, plain.errors, rtol=0.02)
    assert "the solution on 161 nodes" in str(study)
    assert "linear" not in study.reference
    assert "linear between its nodes" in hjb.convergence_study(PROBLEM, line(21, 31), fine).reference


@pytest.mark.slow
def test_without_a_reference_richardson_comes_close_to_the_truth(plain):
    study = hjb.convergence_study(PROBLEM, line(21, 41, 81))
    assert study.estimated
    np.testing.assert_allclose(study.errors, plain.errors, rtol=0.1)
    assert abs(study.order - 1) <= 0.15
    truth = np.array([float(EXACT(x)) for x in study.grids[0].nodes()])
    assert np.abs(study.extrapolated - truth).max() <= 0.1 * plain.errors[-1]
    assert "Richardson's estimate" in str(study)
    assert "estimated" in str(study).splitlines()[1]


@pytest.mark.parametrize("h", [(0.4, 0.2, 0.1), (0.3, 0.2, 0.05)])
@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 5.0])
def test_richardson_is_exact_where_the_error_is_one_power(h, order):
    truth, slope = np.array([3.0, -1.0, np.inf, 0.0]), np.array([1.0, -2.0, 0.0, 0.5])
    values = [truth + slope * each**order for each in h]
    extrapolated, words = richardson(values, np.array(h), np.ones(4, bool), 0.0)
    np.testing.assert_allclose(extrapolated, truth, rtol=1e-9, atol=1e-9)
    assert f"order {order:.2f}" in words


@pytest.mark.parametrize("steps", [(1.0, 2.0), (1.0, 1.0), (1.0, 1e-12), (0.0, 0.0), (np.inf, 1.0)])
def test_without_an_order_to_be_seen_there_is_no_estimate(steps):
    values = [np.zeros(3), np.full(3, steps[0]), np.full(3, sum(steps))]
    extrapolated, words = richardson(values, np.array([0.4, 0.2, 0.1]), np.ones(3, bool), 1e-9)
    assert extrapolated is None
    assert "no Richardson estimate" in words


def test_infinities():
    inf = np.inf
    assert absolute_difference(np.array([inf, inf, 1.0]), np.array([inf, 1.0, 3.0])).tolist() == [0.0, inf, 2.0]
    assert np.isnan(fitted_order([0.2, 0.1], [inf, 1.0]))


def test_a_share_of_the_box():
    grid = hjb.Grid([-1.0, 0.0, 0.0], [1.0, 4.0, 1.0], (5, 5, 4), periodic=(False, False, True))
    mask = mask_of(0.5, grid)
    assert mask.sum(axis=(1, 2)).tolist() == [0, 12, 12, 12, 0]
    assert mask.sum(axis=(0, 1)).tolist() == [9] * 4  # a periodic axis has no ends
    assert mask_of(None, grid).all()


# --- refusals ---


FINE = Solution(line(81)[0], np.zeros(81), None, code=Status.CONVERGED)


@pytest.mark.parametrize(
    ("grids", "reference", "options", "message"),
    [
        (line(21), EXACT, {}, "got 1 grid, wanted at least two"),
        ([], EXACT, {}, "got 0 grid, wanted at least two"),
        (line(21, 41), None, {}, "got 2 grids and no reference; Richardson's estimate needs three"),
        (line(21, 41, 71), None, {}, r"must be nodes of \(71,\); wanted intervals that are multiples"),
        (line(21) + line(41, lo=-1.0), EXACT, {}, "grids of different boxes"),
        (line(21) + line(41, periodic=(True,)), EXACT, {}, "grids of different boxes"),
        (line(21) + plane((21, 21)), EXACT, {}, "grids of different boxes"),
        (line(21, 21), EXACT, {}, "wanted each one once"),
        (plane((21, 21), (41, 21)), EXACT, {}, "refined by the factors 2, 1; wanted one factor"),
        (line(21, 41), lambda x: x, {}, r"the reference returned shape \(1,\) for one state; wanted a scalar"),
        (line(21, 41), lambda x: x[0] * jnp.nan, {}, r"NaN at 21 nodes, first at x = \[-2\.\]; exclude them"),
        (line(21, 161), FINE, {}, r"on \(81,\) nodes and the finest grid has \(161,\); wanted a finer reference"),
        (line(21, 41, lo=-1.0), FINE, {}, "a reference of another box"),
        (line(21, 41), Solution(FINE.grid, np.zeros(80), None), {}, r"values of shape \(80,\)"),
        (line(21, 41), Solution(FINE.grid, np.zeros(81), None, code=Status.STALLED), {}, "reference is STALLED"),
        (line(21, 41), EXACT, {"region": 0.0}, "wanted a share of the box"),
        (line(21, 41), EXACT, {"region": lambda x: x[0] > 9.0}, r"no node of the grid \(21,\) lies in the region"),
        (line(21, 41), EXACT, {"region": lambda x: x > 0}, r"the region returned shape \(1,\)"),
    ],
)
def test_refusals_come_before_anything_is_solved(monkeypatch, grids, reference, options, message):
    monkeypatch.setattr("hjbjax.applications.convergence.solve", lambda *_, **__: pytest.fail("solved"))
    with pytest.raises(ValueError, match=message):
        hjb.convergence_study(PROBLEM, grids, reference, **options)


@pytest.mark.parametrize(
    ("grids", "reference", "options"),
    [
        (line(21)[0], 3.0, {}),
        ([(21,), (41,)], EXACT, {}),
        (line(21, 41), 3.0, {}),
        (line(21, 41), EXACT, {"region": "inner"}),
    ],
)
def test_what_is_of_no_use_is_a_type_error_or_said_so(grids, reference, options):
    with pytest.raises((TypeError, ValueError), match="convergence_study: got .*wanted"):
        hjb.convergence_study(PROBLEM, grids, reference, **options)


# --- the table and the picture ---


def made(errors, estimated=False, codes=None):
    """A study of given errors, without solving."""
    count = len(errors)
    grids = tuple(line(*(20 * 2**k + 1 for k in range(count))))
    codes = [Status.CONVERGED] * count if codes is None else codes
    solutions = tuple(Solution(g, np.zeros(g.shape), None, code=c) for g, c in zip(grids, codes, strict=True))
    h, errors = np.array([0.2 / 2**k for k in range(count)]), np.array(errors)
    times = np.full(count, 0.25)
    return Study(
        grids, solutions, "Upwind()", 1e-7, "the function given", estimated, h, errors, errors / 2, times, times
    )


def test_the_table():
    codes = [Status.CONVERGED, Status.CONVERGED, Status.STALLED]
    lines = str(made([0.4, 0.1, 0.05], codes=codes)).splitlines()
    assert lines[0] == "Upwind(), tol 1e-07; error against the function given"
    assert lines[1].split() == ["grid", "h", "largest", "order", "mean", "order", "seconds", "first", "status"]
    assert lines[2].split() == ["21", "0.2", "4.000e-01", "2.000e-01", "0.25", "0.5", "CONVERGED"]
    assert lines[3].split() == ["41", "0.1", "1.000e-01", "2.00", "5.000e-02", "2.00", "0.25", "0.5", "CONVERGED"]
    assert lines[4].split() == ["81", "0.05", "5.000e-02*", "-", "2.500e-02", "-", "0.25", "0.5", "STALLED"]
    assert lines[5].split() == ["fitted", "2.00", "2.00"]
    assert lines[6].startswith("* not fitted")
    assert max(map(len, lines)) <= 100
    assert repr(made([0.4, 0.1])) == "Study(Upwind(), 2 grids, order 2.00)"


def test_the_rows_are_what_json_takes(plain):
    rows = json.loads(json.dumps(plain.rows))
    assert [row["shape"] for row in rows] == [[21], [41], [81]]
    assert [row["error"] for row in rows] == plain.errors.tolist()
    assert {row["status"] for row in rows} == {"CONVERGED"}


def test_the_picture_shows_both_errors_over_h_and_seconds():
    study = made([0.4, 0.1, 0.0])
    artists = plotting.convergence(study)
    largest, mean, fit, slower, _ = artists
    np.testing.assert_array_equal(largest.get_xdata(), study.h)
    assert np.ma.getmaskarray(largest.get_ydata()).tolist() == [False, False, True]
    np.testing.assert_allclose(mean.get_ydata()[:2], [0.2, 0.05])
    np.testing.assert_allclose(fit.get_ydata(), [0.4, 0.1])
    np.testing.assert_array_equal(slower.get_xdata(), study.seconds)
    first, second = largest.axes, slower.axes
    assert (first.get_xscale(), first.get_yscale(), first.get_xlabel(), first.get_ylabel()) == (
        "log",
        "log",
        "h",
        "error",
    )
    assert (second.get_xlabel(), second.get_ylabel()) == ("seconds", "")
    assert [text.get_text() for text in first.get_legend().get_texts()] == ["largest, order 2.00", "mean, order 2.00"]
    largest.get_figure().savefig(io.BytesIO(), dpi=40)


def test_the_picture_on_axes_of_the_caller():
    figure = Figure()
    ax = figure.add_subplot()
    artists = plotting.convergence(made([0.4, 0.1], estimated=True), ax=ax)
    assert {artist.axes for artist in artists} == {ax}
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("h", "estimated error")
    pair = Figure().subplots(1, 2)
    assert plotting.convergence(made([0.4, 0.1]), ax=pair)[-1].axes is pair[1]
    with pytest.raises(ValueError, match="wanted a positive finite one"):
        plotting.convergence(made([np.nan, 0.0]))


@pytest.mark.parametrize(
    ("lo", "hi", "ticks"),
    [
        (0.9, 110, [1, 10, 100]),
        (0.02, 0.4, [0.03, 0.1, 0.3]),
        (1.9, 5.5, [2, 3, 5]),
        (0.027, 0.07, [0.03, 0.05, 0.07]),
        (6.5, 9.2, [7, 8, 9]),
        (6.5, 6.6, [6.5, np.sqrt(6.5 * 6.6), 6.6]),
    ],
)
def test_few_ticks(lo, hi, ticks):
    assert few(lo, hi) == pytest.approx(ticks)
    assert len(few(1e-12, 1e3)) <= 7


# --- the benchmark ---


def test_benchmarks_are_listed_and_a_wrong_name_is_refused(capsys):
    from benchmarks.__main__ import main

    main([])
    assert "accuracy" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["acuracy"])
    assert "did you mean accuracy?" in capsys.readouterr().err


def test_a_measurement_that_fails_is_a_row_and_json_has_no_nan(tmp_path):
    from benchmarks.harness import report

    def fail():
        raise ValueError("no\nsuch thing")

    rows = report.attempt(fail, {"problem": "one"})
    assert rows == [{"problem": "one", "status": "FAILED", "reason": "ValueError: no such thing"}]
    path = tmp_path / "new" / "rows.json"
    report.write_json(path, report.stamped([*rows, {"error": float("nan"), "shape": (2, 3)}]))
    failed, missing = json.loads(path.read_text())
    assert {"device", "versions", "date", "reason"} <= set(failed)
    assert (missing["error"], missing["shape"]) == (None, [2, 3])
    assert [each.name for each in path.parent.iterdir()] == ["rows.json"]
    assert report.table([{"a": 0.125, "b": [2, 3]}, {"b": "x"}], ("a", "b")).splitlines() == [
        "    a  b",
        "0.125  2 x 3",
        "    -  x",
    ]


@pytest.mark.slow
def test_the_control_that_the_peer_marches_with_is_the_best_one():
    from benchmarks.peers import stationary_march

    rng = np.random.default_rng(0)
    for name, entry in zoo.catalogue.items():
        problem, grid = entry.build()
        if problem.noise is not None or problem.is_game or entry.exact is None or problem.reward is not None:
            continue  # the peer marches costs
        ball = isinstance(problem.controls, hjb.Ball)
        for _ in range(3):
            x, p = (jnp.asarray(rng.uniform(-1, 1, grid.ndim)) for _ in range(2))
            samples = rng.normal(size=(400, problem.controls.dim))
            if ball:
                samples *= problem.controls.radius / np.linalg.norm(samples, axis=1, keepdims=True)
            else:
                samples = rng.uniform(problem.controls.lo, problem.controls.hi, samples.shape)
            scan = jax.vmap(lambda u: problem.cost(x, u) + p @ problem.drift(x, u))(jnp.asarray(samples)).min()  # noqa: B023
            got = stationary_march.rate(problem, x, 0.0, p)
            u = stationary_march.best(problem, x, p)
            assert float(got) <= scan + 1e-5, name
            assert float(got) == pytest.approx(float(problem.cost(x, u) + p @ problem.drift(x, u)), abs=1e-5)
            if ball:
                assert np.linalg.norm(u) <= problem.controls.radius + 1e-5
            else:
                assert np.all((problem.controls.lo <= u) & (u <= problem.controls.hi))


@pytest.mark.slow
def test_the_accuracy_benchmark_runs(tmp_path):
    command = [
        sys.executable,
        "-m",
        "benchmarks",
        "accuracy",
        "--quick",
        "--problem",
        "bang-bang",
        "--out",
        str(tmp_path),
    ]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "Limited" in answer.stdout
    rows = json.loads((tmp_path / "accuracy.json").read_text())
    mine = [row for row in rows if row["code"] == "hjbjax"]
    assert {row["status"] for row in mine} == {"CONVERGED"}
    assert all({"device", "dtype", "versions", "date", "status"} <= set(row) for row in rows)
    assert {row["status"] for row in rows if row["code"] == "hj_reachability"} & {"SETTLED", "HORIZON", "SKIPPED"}
    assert (tmp_path / "accuracy.png").stat().st_size > 1000
