"""The command: refusals before anything is compiled, exit codes, files that are whole, and one real process."""

import json
import os
import signal
import subprocess
import sys
import warnings
import weakref

import numpy as np
import pytest
from click.testing import CliRunner

import hjbjax
from hjbjax import zoo
from hjbjax.cli import run_folder
from hjbjax.cli.main import main
from hjbjax.feedback.path import Path, PathStatus
from hjbjax.solution import files, placement
from hjbjax.solution.solution import Solution, Status, load
from hjbjax.solvers import compile_cache

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Every test writes into a folder of its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*words):
    return CliRunner().invoke(main, [str(word) for word in words])


def refused(result, code, *parts):
    """One line on stderr, nothing on stdout, the exit code, and no file."""
    assert result.exit_code == code, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("hjbjax: ")
    assert result.stderr.count("\n") == 1
    for part in parts:
        assert part in result.stderr
    return True


def answer(problem, grid, code=Status.CONVERGED, **more):
    """A Solution that was not computed: V = |x|², u = −x within its bounds."""
    x = grid.nodes()
    dim = 0 if problem.controls is None else problem.controls.dim
    policy = np.repeat(-x[..., :1], dim, axis=-1)
    return Solution(grid, (x**2).sum(-1), policy, code=code, steps=7, residuals=np.array([1.0, 1e-4]), **more)


def straight(problem, solution, start, duration, **options):
    """A path that was not computed: straight to zero."""
    assert (options.get("key") is None) == (problem.noise is None)
    share = np.linspace(1, 0, 5)[:, None]
    controls = np.zeros((4, solution.policy.shape[-1]))
    return Path(
        duration * (1 - share[:, 0]),
        share * np.asarray(start),
        controls,
        None,
        1.5,
        None,
        PathStatus.DURATION,
        9,
        "ran",
    )


@pytest.fixture
def solver(monkeypatch):
    """``hjbjax.solve`` replaced: it records how it was called and returns or raises what the test sets."""

    class Solver:
        code, error = Status.CONVERGED, None

        def __call__(self, problem, grid, **options):
            self.calls.append((problem, grid, options))
            if self.error:
                raise self.error
            return answer(problem, grid, self.code)

    stand_in = Solver()
    stand_in.calls = []
    monkeypatch.setattr(hjbjax, "solve", stand_in, raising=False)
    monkeypatch.setattr(run_folder, "simulate", straight)  # the integrator takes seconds to compile
    return stand_in


@pytest.fixture
def no_solver(solver):
    """The solver must not be reached, and no folder made."""
    yield
    assert not solver.calls
    assert not list(os.scandir("."))


BAD_WORDS = [
    (["pendulm"], "unknown problem 'pendulm'", "double-integrator", "did you mean 'pendulum'?"),
    (["double_integrator"], "did you mean 'double-integrator'?"),
    ([], "NAME"),
    (["pendulum", "--tol", "nan"], "--tol", "'nan'", "finite number > 0"),
    (["pendulum", "--tol", "inf"], "--tol", "'inf'"),
    (["pendulum", "--tol", "1e400"], "--tol"),
    (["pendulum", "--tol", "0"], "--tol"),
    (["pendulum", "--tol", "-1e-3"], "--tol"),
    (["pendulum", "--tol", "small"], "--tol"),
    (["pendulum", "--time-limit", "nan"], "--time-limit"),
    (["pendulum", "--max-steps", "0"], "--max-steps"),
    (["pendulum", "--max-steps", "1.5"], "--max-steps", "whole number"),
    (["pendulum", "--max-steps", "nan"], "--max-steps"),
    (["pendulum", "--shape", "1e400"], "--shape", "'1e400'", "as in 200x201"),
    (["pendulum", "--shape", "-5"], "--shape", "'-5'"),
    (["pendulum", "--shape", "20x"], "--shape"),
    (["pendulum", "--shape", "20xnan"], "--shape"),
    (["pendulum", "--shape", "20x0"], "--shape"),
    (["pendulum", "--shape", "20x1"], "--shape", "at least 2"),
    (["pendulum", "--shape", "20.5x20"], "--shape"),
    (["pendulum", "--shape", "True"], "--shape"),
    (["pendulum", "--shape", "200"], "got 1 sizes", "2 axes (angle, velocity)", "as in 200x201"),
    (["pendulum", "--shape", "20x20x20"], "got 3 sizes"),
    (["pendulum", "--set", "mas=2"], "unknown parameter of pendulum 'mas'", "as_printed", "did you mean 'mass'?"),
    (["pendulum", "--set", "mass"], "wanted NAME=VALUE"),
    (["pendulum", "--set", "=2"], "wanted NAME=VALUE"),
    (["pendulum", "--set", "mass=nan"], "mass=nan", "finite number"),
    (["pendulum", "--set", "mass=1e400"], "finite number"),
    (["pendulum", "--set", "mass=heavy"], "finite number"),
    (["pendulum", "--set", "mass=1,2"], "wanted one number"),
    (["pendulum", "--set", "as_printed=1"], "true or false"),
    (["pendulum", "--set", "mass=1", "--set", "mass=2"], "given twice"),
    (["pendulum", "--set", "shape=20"], "--shape"),
    (["pendulum", "--set", "discount=-1"], "discount"),
    (["manipulator", "--set", "links=1.5"], "whole number"),
    (["zermelo", "--set", "current=1"], "2 finite numbers separated by commas"),
    (
        ["pendulum", "--method", "policy-iterations"],
        "unknown method",
        "value-iteration",
        "did you mean 'policy-iteration'?",
    ),
    (["pendulum", "--scheme", "upwnd"], "unknown scheme", "did you mean 'upwind'?"),
    (["pendulum", "--colour", "red"], "--colour"),
]


@pytest.mark.parametrize(("words", "parts"), [(words, parts) for words, *parts in BAD_WORDS], ids=lambda x: " ".join(x))
@pytest.mark.usefixtures("no_solver")
def test_bad_words_are_refused_in_one_line_before_anything_runs(words, parts):
    assert refused(run("solve", *words), 2, *parts)


@pytest.mark.usefixtures("no_solver", "folder")
@pytest.mark.parametrize(
    "words", [("solve", "bang-bang", "--out", ""), ("solve", "bang-bang", "--checkpoint", ""), ("gallery", "--out", "")]
)
def test_an_empty_path_is_refused(words):
    """It is an unset variable of a script, and must not spread results over the current folder."""
    assert refused(run(*words), 2, words[-2], "empty path")


@pytest.mark.usefixtures("no_solver", "folder")
@pytest.mark.parametrize(("place", "reason"), [(".", "it is a folder"), (os.devnull, "it is a device")])
def test_a_checkpoint_that_is_no_file_is_named(place, reason):
    assert refused(run("solve", "bang-bang", "--checkpoint", place), 5, "--checkpoint", reason)


@pytest.mark.usefixtures("no_solver", "folder")
@pytest.mark.parametrize("words", ["list", "solve bang-bang", "solve bang-bang --dry-run", "gallery --out page"])
def test_jax_without_a_device_is_refused_in_one_line(words, monkeypatch):
    def fail():
        raise RuntimeError("Unable to initialize\nbackend 'gpu'")

    monkeypatch.setattr("jax.devices", fail)
    assert refused(run(*words.split()), 2, "JAX cannot start: Unable to initialize backend 'gpu'")


@pytest.mark.usefixtures("no_solver", "folder")
def test_an_error_of_jax_without_a_text_is_named(monkeypatch):
    """JAX raises a bare AssertionError for JAX_PLATFORMS=cuda if CUDA is missing."""

    def fail():
        raise AssertionError

    monkeypatch.setattr("jax.devices", fail)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    assert refused(run("list"), 2, "JAX cannot start: AssertionError with JAX_PLATFORMS='cuda'; 'hjbjax doctor' says")


@pytest.mark.parametrize("words", [("list",), ("launch", "--", "solve", "bang-bang")])
def test_a_variable_that_jax_refuses_is_named_in_one_line(words):
    ended = subprocess.run(
        [sys.executable, "-m", "hjbjax", *words],
        env={**os.environ, "JAX_ENABLE_X64": "banana"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ended.returncode == 2, ended.stderr
    assert ended.stderr.startswith("hjbjax: JAX cannot start: ")
    assert ended.stderr.count("\n") == 1
    assert "JAX_ENABLE_X64" in ended.stderr


@pytest.mark.usefixtures("no_solver")
def test_an_unknown_command_is_refused():
    assert refused(run("slove", "pendulum"), 2, "slove")


@pytest.mark.parametrize("out", ["file", "file/below", "/proc/nothing", "/dev/null"])
def test_an_unwritable_out_is_refused_before_anything_runs(solver, folder, out):
    (folder / "file").write_text("mine")
    assert refused(run("solve", "bang-bang", "--out", out), 2, "--out", out)
    assert not solver.calls
    assert [entry.name for entry in os.scandir(".")] == ["file"]
    assert (folder / "file").read_text() == "mine"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_refused(solver, folder):
    (folder / "locked").mkdir(mode=0o500)
    assert refused(run("solve", "bang-bang", "--out", "locked/deep"), 2, "--out", "Permission denied")
    assert not solver.calls


@pytest.mark.parametrize("old", run_folder.FILES)
def test_an_existing_result_is_refused_and_stays(solver, folder, old):
    (folder / "bang-bang").mkdir()
    (folder / "bang-bang" / old).write_text("old")
    assert refused(run("solve", "bang-bang"), 2, old, "--force")
    assert not solver.calls
    assert (folder / "bang-bang" / old).read_text() == "old"


def test_a_solve_writes_four_files_and_prints_the_screen(solver, folder):
    result = run("solve", "double-integrator-lq", "--shape", "11x13", "--set", "mass=2", "--set", "noise=0.5")
    assert result.exit_code == 0, result.output
    assert sorted(os.listdir("double-integrator-lq")) == sorted(run_folder.FILES)
    assert os.listdir(".") == ["double-integrator-lq"]
    for name in run_folder.FILES[1:]:
        assert (folder / "double-integrator-lq" / name).read_bytes().startswith(PNG)
    solution = load("double-integrator-lq/solution.npz")
    problem, grid, options = solver.calls[0]
    assert (grid.shape, options) == ((11, 13), {"throw": False})
    assert (problem.drift.args[0].mass, problem.noise) == (2.0, 0.5)
    np.testing.assert_array_equal(solution.value, answer(problem, grid).value)
    assert str(solution).splitlines()[0] in result.stdout
    assert "trajectory.png" in result.stdout


def test_options_reach_the_solver(solver):
    words = [
        "--tol",
        "1e-5",
        "--max-steps",
        "9",
        "--time-limit",
        "2.5",
        "--method",
        "value-iteration",
        "--scheme",
        "upwind",
    ]
    assert run("solve", "bang-bang", *words, "--out", "a/b").exit_code == 0
    _, _, options = solver.calls[0]
    assert (options["tol"], options["max_steps"], options["time_limit"], options["throw"]) == (1e-5, 9, 2.5, False)
    assert isinstance(options["method"], hjbjax.ValueIteration)
    assert isinstance(options["scheme"], hjbjax.Upwind)
    assert sorted(os.listdir("a/b")) == sorted(run_folder.FILES)


def strict(text):
    """JSON without the words NaN and Infinity, which other readers refuse."""

    def refuse(word):
        raise AssertionError(f"{word} in JSON")

    return json.loads(text, parse_constant=refuse)


def test_json_is_one_object_without_infinities(solver):
    result = run("solve", "zermelo", "--set", "current=0.25,0", "--shape", "9x9", "--json")
    assert result.exit_code == 0, result.output
    report = strict(result.stdout)
    assert report["problem"] == "zermelo"
    assert report["parameters"] == {"current": [0.25, 0.0]}
    assert (report["status"], report["steps"], report["residual"], report["shape"]) == ("CONVERGED", 7, 1e-4, [9, 9])
    assert report["files"] == [f"zermelo/{name}" for name in run_folder.FILES]
    assert report["trajectory"]["start"] == list(zoo.catalogue["zermelo"].start)
    assert report["version"] == hjbjax.__version__
    assert 0 < report["exact_difference"] < 10


def test_a_report_has_null_for_what_json_cannot_say():
    problem, grid = zoo.bang_bang(shape=(5,))
    solution = answer(
        problem, grid, stats={"tol": np.float64(np.nan), "seconds": np.float32(0.5), "on": np.bool_(True)}
    )
    report = run_folder.json_report(solution, None, [])
    assert report["stats"] == {"tol": None, "seconds": 0.5, "on": True}
    assert (report["trajectory"], report["error"]) == (None, None)
    assert strict(json.dumps(report, allow_nan=False)) == report


@pytest.mark.parametrize(
    ("status", "code", "files"),
    [
        (Status.MAX_STEPS, 3, run_folder.FILES[:3]),
        (Status.STALLED, 3, run_folder.FILES[:3]),
        (Status.TIME_LIMIT, 3, run_folder.FILES[:3]),
        (Status.DIVERGED, 4, run_folder.FILES[:3]),
        (Status.NONFINITE, 4, run_folder.FILES[:3]),
        (Status.INTERRUPTED, 130, run_folder.FILES[:1]),
    ],
)
def test_the_exit_code_says_how_the_solve_ended(solver, status, code, files):
    solver.code = status
    result = run("solve", "bang-bang")
    assert result.exit_code == code
    assert result.stderr == f"hjbjax: {status.name}: {status.message}\n"
    assert status.name in result.stdout
    assert sorted(os.listdir("bang-bang")) == sorted(files)
    assert load("bang-bang/solution.npz").status == status


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ValueError("drift is NaN at 3 nodes:\n  the first is (0, 0)"), 2),
        (MemoryError("needs 2.5 TB,\n 3 GB are free"), 6),
        (KeyboardInterrupt(), 130),
    ],
)
def test_a_refusal_of_the_solver_is_one_line(solver, error, code):
    solver.error = error
    result = run("solve", "bang-bang")
    assert result.exit_code == code
    assert result.stderr.strip().count("\n") == 0
    assert " ".join(str(error).split()) in result.stderr
    assert not os.listdir(".")


@pytest.mark.parametrize(
    ("text", "code"),
    [("RESOURCE_EXHAUSTED: 9 TB", 6), ("INTERNAL: Out of memory allocating 9 bytes.", 6), ("INTERNAL: broken", 4)],
)
def test_a_fault_of_the_device_has_a_code(solver, text, code):
    import jax

    solver.error = jax.errors.JaxRuntimeError(text)
    assert refused(run("solve", "bang-bang"), code, text)


def test_force_replaces_all_and_takes_stale_files_away(solver, folder):
    assert run("solve", "bang-bang", "--shape", "11").exit_code == 0
    (folder / "bang-bang" / "notes.txt").write_text("mine")
    assert run("solve", "bang-bang", "--shape", "13").exit_code == 2
    assert load("bang-bang/solution.npz").grid.shape == (11,)
    solver.code = Status.MAX_STEPS
    assert run("solve", "bang-bang", "--shape", "13", "--force").exit_code == 3
    assert load("bang-bang/solution.npz").grid.shape == (13,)
    assert sorted(os.listdir("bang-bang")) == ["notes.txt", "policy.png", "solution.npz", "value.png"]


@pytest.mark.parametrize("file", run_folder.FILES)
def test_a_full_disk_leaves_no_half_file(solver, folder, monkeypatch, file):
    """The old files stay whole where the new one cannot be written, and what came out whole before is kept."""
    finish = placement.flush_to_disk

    def full(stream):
        finish(stream)
        if f"{os.sep}.{file}." in stream.name:
            raise OSError(28, "No space left on device")

    whole = {}
    (folder / "out").mkdir()
    for name in run_folder.FILES:
        (folder / "out" / name).write_bytes(b"old")
    for module in (placement, files):
        monkeypatch.setattr(module, "flush_to_disk", full)
    made = run_folder.FILES[: run_folder.FILES.index(file)]
    written = f"; written: {', '.join(os.path.join('out', name) for name in made)}" if made else "; no other folder"
    reason = f"{os.path.join('out', file)}: cannot be written: No space left on device{written}"
    assert refused(run("solve", "bang-bang", "--out", "out", "--force"), 5, reason)
    for name in os.listdir("out"):
        whole[name] = (folder / "out" / name).read_bytes()
    assert all(whole[name] != b"old" for name in made)
    assert whole.get(file) in (None, b"old")
    assert sorted(entry.name for entry in os.scandir(".")) == ["out"]


def test_an_interrupt_while_drawing_keeps_what_is_whole(solver, monkeypatch):
    def interrupt(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("hjbjax.plotting.policy", interrupt)
    result = run("solve", "bang-bang")
    assert (result.exit_code, result.stderr.strip()) == (130, "hjbjax: interrupted")
    assert sorted(os.listdir("bang-bang")) == ["solution.npz", "value.png"]


def test_a_result_that_appeared_meanwhile_is_not_overwritten(solver, folder, monkeypatch):
    real = solver.__call__

    def slow(*args, **options):
        (folder / "bang-bang").mkdir()
        (folder / "bang-bang" / "solution.npz").write_text("another's")
        return real(*args, **options)

    monkeypatch.setattr(hjbjax, "solve", slow)
    assert refused(run("solve", "bang-bang"), 5, "already")
    assert (folder / "bang-bang" / "solution.npz").read_text() == "another's"


def test_sigterm_is_an_interrupt_and_the_handler_goes_back(solver, monkeypatch):
    before = signal.getsignal(signal.SIGTERM)

    def killed(*args, **options):
        signal.raise_signal(signal.SIGTERM)
        raise AssertionError("SIGTERM did nothing")

    monkeypatch.setattr(hjbjax, "solve", killed)
    result = run("solve", "bang-bang")
    assert (result.exit_code, result.stderr.strip()) == (130, "hjbjax: interrupted")
    assert signal.getsignal(signal.SIGTERM) is before
    assert not os.listdir(".")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_python_drops_is_noted(monkeypatch, number):
    """An exception in a callback of the garbage collector, of which JAX has one, goes nowhere: three of eight did."""

    class Thing:
        pass

    def dropped():
        thing = Thing()
        weakref.finalize(thing, signal.raise_signal, number)
        monkeypatch.setattr(sys, "unraisablehook", lambda found: seen.append(found.exc_type))
        monkeypatch.setattr(sys, "excepthook", lambda kind, *_: seen.append(kind))  # where finalizers report
        del thing

    seen, before = [], signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(compile_cache, "keep_for_the_command", dropped)
    result = run("solve", "bang-bang")
    signal.signal(signal.SIGINT, before)
    assert seen == [KeyboardInterrupt]
    assert result.exit_code == 130


def test_a_warning_is_one_line_and_a_path_that_cannot_be_is_left_out(solver, monkeypatch):
    def leaves(*args, **options):
        warnings.warn("simulate: the path\n left the box", UserWarning, stacklevel=1)
        return straight(*args, **options)

    def refuses(*args, **options):
        raise ValueError("simulate: x0 lies\n outside the box")

    monkeypatch.setattr(run_folder, "simulate", leaves)
    result = run("solve", "bang-bang")
    assert (result.exit_code, result.stderr) == (0, "hjbjax: warning: simulate: the path left the box\n")
    monkeypatch.setattr(run_folder, "simulate", refuses)
    result = run("solve", "bang-bang", "--out", "other")
    assert result.exit_code == 0
    assert result.stderr == "hjbjax: warning: no trajectory.png: simulate: x0 lies outside the box\n"
    assert sorted(os.listdir("other")) == sorted(run_folder.FILES[:3])


def test_a_bang_bang_feedback_is_sampled(solver, monkeypatch):
    seen = []
    monkeypatch.setattr(
        run_folder, "simulate", lambda *args, **options: seen.append(options) or straight(*args, **options)
    )
    run("solve", "double-integrator", "--out", "smooth")
    real = hjbjax.solve
    monkeypatch.setattr(hjbjax, "solve", lambda *args, **options: jumping(real(*args, **options)))
    run("solve", "double-integrator", "--out", "jumping")
    run("solve", "bang-bang", "--out", "line")  # the mean of both controls holds the state at the switching point
    first, sampled, *_, last = seen
    assert (first, last) == ({}, {})
    assert sampled == {"hold": zoo.catalogue["double-integrator"].duration / run_folder.SAMPLES}


def jumping(solution):
    return Solution(solution.grid, solution.value, np.sign(solution.policy), code=solution.code, steps=1)


def test_the_difference_from_the_exact_answer_is_that_of_the_inner_half():
    _, grid = zoo.bang_bang(shape=(9,))
    exact = zoo.bang_bang_exact()
    value = np.array([float(exact(x)) for x in grid.nodes()])
    value[[0, 1, 2, 5, 6]] += [9.0, np.inf, -0.25, 0.125, -0.5]
    solution = Solution(grid, value, grid.nodes())
    assert run_folder.difference(exact, solution) == pytest.approx(0.5)
    value[2:7] = np.inf
    assert run_folder.difference(exact, solution) is None


def test_bang_bang_is_recognised():
    problem, grid = zoo.bang_bang(shape=(21,))
    x = grid.nodes()
    smooth = Solution(grid, x[..., 0], np.clip(x, -0.9, 0.9))
    undefined = Solution(grid, x[..., 0], np.where(x == 0, np.nan, np.sign(x)))
    assert not run_folder.is_bang_bang(problem, smooth)
    assert run_folder.is_bang_bang(problem, undefined)
    assert run_folder.is_bang_bang(problem, Solution(grid, x[..., 0], x, discrete=True))
    problem, grid = zoo.brownian_exit(shape=(5,))
    assert not run_folder.is_bang_bang(problem, answer(problem, grid))


def test_list_shows_states_units_grids_and_answers():
    lines = run("list").stdout.splitlines()
    assert [line.split()[0] for line in lines[::2]] == list(zoo.catalogue)
    assert all(len(line) <= 100 for line in lines)
    for entry, first, second in zip(zoo.catalogue.values(), lines[::2], lines[1::2], strict=True):
        _, grid = entry.build()
        assert first.endswith(entry.summary)
        assert all(name in second and unit in second for name, unit in zip(grid.names, grid.units, strict=True))
        assert " x ".join(map(str, grid.shape)) in second
        assert ("exact answer" in second) == (entry.exact is not None)
    assert refused(run("list", "zermalo"), 2, "did you mean 'zermelo'?")


@pytest.mark.parametrize("name", zoo.catalogue)
def test_list_says_of_each_parameter_of_a_problem_what_it_means(name):
    lines = run("list", name).stdout.splitlines()
    assert all(len(line) <= 100 for line in lines)
    settings = {line.split()[1].partition("=")[0]: line.split()[2:] for line in lines if line.startswith("  --set")}
    assert list(settings) == [key for key in zoo.catalogue[name].parameters if key != "shape"]
    assert all(settings.values())  # a word at least
    assert sum("--shape" in line for line in lines) == 1


def test_list_says_of_a_problem_what_it_is_made_of():
    text = run("list", "zermelo").stdout
    assert "east [m] from -2 to 2; north [m] from -2 to 2" in text
    assert "(course east, course north) of length 1 at most" in text
    assert "ends by       a target" in text
    assert "  --set current=0.5,0.0" in text
    text = run("list", "pendulum").stdout
    assert "angle [rad] from -3.142 to 3.142, periodic" in text
    assert "torque [N m] from -30 to 30" in text
    assert "none is known" in text
    text = run("list", "lq-game").stdout
    assert "disturbances" in text
    assert run("list", "brownian-exit").stdout.count("controls      none") == 1


@pytest.mark.parametrize("columns", [60, 80, 200])
@pytest.mark.parametrize("words", [[], ["solve"], ["list"], ["gallery"], ["doctor"]])
def test_no_help_is_cut(columns, words):
    result = CliRunner().invoke(main, [*words, "--help"], terminal_width=columns)  # which overrides COLUMNS itself
    assert result.exit_code == 0
    assert "..." not in result.stdout.replace("[ARGS]...", "")
    assert all(len(line) <= columns for line in result.stdout.splitlines())


def test_no_file_for_a_control_that_is_not_there(solver, folder):
    result = run("solve", "brownian-exit", "--shape", "21")
    assert result.exit_code == 0
    assert "no policy.png, as there are no controls" in result.stdout
    assert sorted(os.listdir("brownian-exit")) == ["solution.npz", "trajectory.png", "value.png"]


@pytest.mark.slow
def test_two_inputs_are_drawn_side_by_side(solver, folder):
    from matplotlib.image import imread

    assert run("solve", "eikonal", "--shape", "9x9").exit_code == 0
    assert run("solve", "van-der-pol", "--shape", "9x9").exit_code == 0
    wide, single = (imread(folder / name / "policy.png") for name in ("eikonal", "van-der-pol"))
    assert wide.shape[1] == 2 * single.shape[1]


def test_what_list_prints_can_be_set(solver):
    lines = run("list", "pendulum").stdout.splitlines()
    settings = [line.split()[1] for line in lines if line.startswith("  --set")]
    words = [word for setting in settings if "..." not in setting for word in ("--set", setting)]
    assert run("solve", "pendulum", "--shape", "8x9", *words).exit_code == 0


def test_help_and_version():
    assert run("--version").stdout == f"hjbjax, version {hjbjax.__version__}\n"
    for words in ([], ["--help"], ["-h"]):
        result = run(*words)
        assert result.exit_code == 0
        assert all(command in result.stdout for command in ("solve", "list", "doctor"))
    assert "--shape" in run("solve", "--help").stdout


@pytest.mark.slow
def test_the_schemes_on_offer_solve_and_others_are_refused():
    result = run("solve", "bang-bang", "--scheme", "eno2")
    assert result.exit_code == 2
    assert "upwind" in result.stderr
    for name in ("limited", "weno5"):
        assert run("solve", "bang-bang", "--scheme", name, "--out", name).exit_code == 0


def test_help_loads_nothing_heavy():
    code = "import sys, hjbjax.cli.main; print(*sys.modules)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment())
    assert not {"jax", "matplotlib", "diffrax", "scipy", "optax", "tqdm"} & set(answer.stdout.split())


def test_doctor_reports_every_check(monkeypatch):
    result = run("doctor")
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert all(line.startswith("ok ") for line in lines)
    names = [line.split()[1] for line in lines]
    assert names[:3] == ["python", "hjbjax", "jax"]
    assert names[-6:] == ["devices", "float64", "solve", "memory", "pictures", "folder"]
    assert "CONVERGED" in result.stdout
    assert not os.listdir(".")


def test_doctor_fails_with_the_check_that_fails(monkeypatch):
    def broken(*args, **options):
        raise RuntimeError("no such\ndevice")

    monkeypatch.setattr(hjbjax, "solve", broken, raising=False)
    result = run("doctor")
    assert result.exit_code == 1
    assert "FAIL  solve       RuntimeError: no such device" in result.stdout
    assert result.stderr == "hjbjax: 1 of the checks failed\n"


# ------------------------------------------------------------------------------------ with the real solver


def environment():
    """The checkout first on the path, whatever is installed."""
    return {**os.environ, "PYTHONPATH": os.path.dirname(os.path.dirname(hjbjax.__file__)), "PYTHONWARNINGS": "error"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        pytest.param(words.split(), id=words)
        for words in (
            "brownian-exit --shape 41",
            "lq-game --shape 41",
            "double-integrator --shape 21x21",
            "dubins --shape 13x13x12",
        )
    ],
)
def test_problems_of_every_kind_give_their_files(words):
    """A game, bang-bang in the plane, three states; the fourth picture is of controls, which noise alone has not."""
    result = run("solve", *words)
    assert result.exit_code == 0, result.output
    pictured = [name for name in run_folder.FILES if words[0] != "brownian-exit" or name != "policy.png"]
    assert sorted(os.listdir(words[0])) == sorted(pictured)
    assert "CONVERGED" in result.stdout


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a disk that is full")
@pytest.mark.parametrize("words", [["list"], ["--version"]])
def test_output_that_cannot_be_written(words):
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "hjbjax", *words], stdout=full, stderr=subprocess.PIPE, text=True, timeout=120
        )
    assert result.returncode == 5
    assert result.stderr == "hjbjax: the output could not be written: No space left on device\n"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a disk that is full")
@pytest.mark.parametrize("unbuffered", ["", pytest.param("1", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("words", "code"), [(["list"], 5), (["lst"], 2)])
def test_nobody_hears_the_refusal(words, code, unbuffered):
    command = [sys.executable, "-m", "hjbjax", *words]
    variables = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with open("/dev/full", "w") as full:
        result = subprocess.run(command, stdout=full, stderr=full, env=variables, timeout=120)
    assert result.returncode == code


def test_a_reader_that_has_seen_enough():
    command = f"{sys.executable} -m hjbjax list | head -n 1"
    result = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=120)
    assert (result.stdout.count("\n"), result.stderr) == (1, "")


@pytest.mark.slow
def test_a_real_process(folder):
    command = [sys.executable, "-m", "hjbjax", "solve", "stochastic-lq", "--shape", "41", "--json"]
    first = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=300)
    assert (first.returncode, first.stderr) == (0, "")
    assert strict(first.stdout)["status"] == "CONVERGED"
    solution = load(folder / "stochastic-lq" / "solution.npz")
    exact = zoo.stochastic_lq_exact()
    assert abs(float(solution.value_at([0.5])) - float(exact([0.5]))) < 0.05
    again = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=300)
    assert (again.returncode, again.stdout, again.stderr.count("\n")) == (2, "", 1)


STUCK = """
import signal, sys, threading, time
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in a job that a shell starts in the background
import jax, jax.numpy as jnp, numpy as np
import hjbjax
from hjbjax.cli.main import main

def busy():
    jax.jit(lambda x: jax.lax.fori_loop(0, 30_000, lambda i, x: jnp.sin(x), x))(jnp.ones(10**5)).block_until_ready()

def stuck(problem, grid, **options):
    threading.Thread(target=busy, daemon=True).start()
    time.sleep(1)
    try:
        print("ready", flush=True)
        time.sleep(50)
    except KeyboardInterrupt:
        if options["tol"] == 1.0:
            raise
    zero = np.zeros(grid.shape)
    return hjbjax.Solution(grid, zero, zero[..., None], code=hjbjax.Status.INTERRUPTED)

hjbjax.solve = stuck
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("way", ["keeps", "raises"])
def test_sigterm_in_a_real_process(folder, way):
    """With or without a partial solution it ends at once and orderly, though JAX is at work; no hidden folder stays."""
    command = [sys.executable, "-c", STUCK, "solve", "bang-bang", "--tol", "1" if way == "raises" else "2"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environment(), **pipes) as process:
        assert process.stdout.readline() == "ready\n"
        process.terminate()
        try:
            out, errors = process.communicate(timeout=20)
        finally:
            process.kill()
    assert process.returncode == 130, errors
    assert errors.count("\n") <= 2
    assert "interrupted" in errors.lower()
    if way == "keeps":
        assert "INTERRUPTED" in out
        assert load("bang-bang/solution.npz").status == Status.INTERRUPTED
    assert os.listdir(".") == (["bang-bang"] if way == "keeps" else [])


# ------------------------------------------------------------------------------------------- compiled programs


def cached(folder, *options):
    """The command in a process whose user has his caches in ``folder``: the process, and the entries it left."""
    kept = {key: value for key, value in environment().items() if "COMPILATION_CACHE" not in key}
    kept |= dict.fromkeys(("XDG_CACHE_HOME", "HOME", "LOCALAPPDATA"), str(folder)) | {"PYTHONWARNINGS": "default"}
    words = ["solve", "bang-bang", "--shape", "41", "--force", "--json", *options]
    done = subprocess.run(
        [sys.executable, "-m", "hjbjax", *words], capture_output=True, text=True, env=kept, timeout=300
    )
    return done, {path for path in folder.rglob("*-cache")} if folder.is_dir() else set()


@pytest.mark.slow
def test_the_second_process_finds_what_the_first_one_compiled(tmp_path):
    first, left = cached(tmp_path)
    assert first.returncode == 0, first.stderr
    assert any(path.name.startswith("jit_run-") for path in left)
    again, entries = cached(tmp_path)
    assert entries == left
    assert json.loads(again.stdout)["residual"] == json.loads(first.stdout)["residual"]
    for path in left:
        path.write_bytes(b"no program")
    damaged, _ = cached(tmp_path)
    assert damaged.returncode == 0
    assert all(line.startswith("hjbjax: warning: ") for line in damaged.stderr.splitlines())


@pytest.mark.slow
def test_nothing_is_kept_where_nobody_wants_it_or_nothing_can_be(tmp_path):
    assert cached(tmp_path, "--no-cache")[1] == set()
    (tmp_path / "file").write_text("no folder")
    done, left = cached(tmp_path / "file")
    assert (done.returncode, left) == (0, set())


def test_one_line_keeps_what_is_compiled_in_one_folder(tmp_path):
    script = (
        "import hjbjax as h, jax, os; print(h.keep_compiled('mine')); os.chdir('other'); jax.jit(lambda x: -x)(1.0)"
    )
    (tmp_path / "other").mkdir()
    kept = {key: value for key, value in environment().items() if "COMPILATION_CACHE" not in key}
    words = [sys.executable, "-c", script]
    done = subprocess.run(words, capture_output=True, text=True, env=kept, timeout=120, cwd=tmp_path)
    assert done.stdout == f"{tmp_path / 'mine'}\n", done.stderr
    assert list((tmp_path / "mine").glob("*-cache"))
    assert list((tmp_path / "other").iterdir()) == []


def test_a_removed_current_folder_keeps_nothing_compiled(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tmp_path.rmdir()
    with pytest.raises(hjbjax.FileError, match="the current folder has been removed"):
        hjbjax.keep_compiled("mine")


def test_a_folder_that_cannot_be_made_is_said(tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OSError, match="file"):
        hjbjax.keep_compiled(tmp_path / "file")


def test_a_parameter_as_an_option_of_its_own_is_answered_with_the_cure():
    assert refused(run("solve", "pendulum", "--mass", "2"), 2, "--set, as in --set mass=VALUE")
    assert refused(run("solve", "pendulum", "--mas", "2"), 2, "No such option '--mas'")


# --- long runs ---


@pytest.mark.slow
def test_a_dry_run_says_what_a_solve_will_take_and_writes_nothing(folder):
    result = run("solve", "pendulum", "--shape", "40x41", "--dry-run")
    assert result.exit_code == 0, result.output
    assert [line.split()[0] for line in result.stdout.splitlines()] == [
        "nodes", "memory", "programs", "steps", "seconds",
    ]  # fmt: skip
    assert result.stdout.startswith("nodes     40 x 41 = 1,640\n")
    assert not list(folder.iterdir())
    told = run("solve", "pendulum", "--shape", "46000x46001", "--scheme", "upwind", "--dry-run", "--json")
    assert told.exit_code == 6
    assert json.loads(told.stdout)["shape"] == [46000, 46001]
    assert told.stderr == "hjbjax: the solve does not fit into the free memory\n"


@pytest.mark.slow
def test_a_checkpoint_is_gone_on_from(folder):
    first = run("solve", "stochastic-lq", "--shape", "41", "--checkpoint", "run", "--max-steps", "1", "--out", "a")
    assert first.exit_code == 3
    assert (folder / "run.npz").exists()
    assert refused(run("solve", "stochastic-lq", "--shape", "41", "--checkpoint", "run", "--out", "b"), 2, "resume")
    again = run("solve", "stochastic-lq", "--shape", "41", "--checkpoint", "run", "--resume", "--out", "c")
    assert again.exit_code == 0, again.output
    whole = run("solve", "stochastic-lq", "--shape", "41", "--out", "d")
    assert whole.exit_code == 0
    np.testing.assert_array_equal(load("c/solution.npz").value, load("d/solution.npz").value)
    other = run("solve", "stochastic-lq", "--shape", "43", "--checkpoint", "run", "--resume", "--out", "e")
    assert refused(other, 5, "it was made for another grid")
    assert refused(run("solve", "stochastic-lq", "--resume", "--out", "f"), 2, "add --checkpoint FILE")
    assert not (folder / "e").exists()


def test_a_checkpoint_that_could_not_be_written_is_a_file_error_after_the_results(folder, monkeypatch):
    def solve(problem, grid, **options):
        return answer(problem, grid, stats={"checkpoint": "run.npz: cannot be written: No space left on device"})

    monkeypatch.setattr(hjbjax, "solve", solve)
    monkeypatch.setattr(run_folder, "simulate", straight, raising=False)
    result = run("solve", "bang-bang", "--shape", "21", "--checkpoint", "run", "--out", "a")
    assert result.exit_code == 5
    assert "No space left on device" in result.stderr
    assert (folder / "a" / "solution.npz").exists()
