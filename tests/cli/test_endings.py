"""How the command ends where the system gives it less than usual: pipes, streams, folders, names, letters, Ctrl-C."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest
from broken_streams import BROKEN
from click.testing import CliRunner

import hjbjax
from hjbjax import zoo
from hjbjax.cli import doctor, gallery, interrupts, run_folder
from hjbjax.cli import main as cli
from hjbjax.cli.gallery import Card
from hjbjax.cli.main import main
from hjbjax.solution import placement
from hjbjax.solution.solution import Solution, Status, load
from hjbjax.solvers import compile_cache

posix = pytest.mark.skipif(os.name != "posix", reason="descriptors and signals are POSIX's")
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(hjbjax.__file__).parents[1])}
NAMES = ["out", "two\nlines", "tab\tand \x1b[31m", os.fsdecode(b"latin \xe9"), "Größe β", "x" * 255]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Every test writes into a folder of its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*words):
    return CliRunner().invoke(main, [str(word) for word in words])


def answer(problem, grid, **options):
    """In place of ``hjbjax.solve``."""
    return Solution(grid, grid.nodes()[..., 0], None, code=Status.CONVERGED, steps=1)


def only_the_solution(problem, solution, folder, **options):
    """In place of ``run_folder.make``: nothing is drawn."""
    solution.save(folder / "solution.npz")
    yield "solution.npz", None


@pytest.fixture
def quick(monkeypatch):
    """The commands without solves and without pictures."""
    monkeypatch.setattr(hjbjax, "solve", answer)
    monkeypatch.setattr(run_folder, "make", only_the_solution)
    monkeypatch.setattr(run_folder, "difference", lambda *_: None)
    monkeypatch.setattr(compile_cache, "keep_for_the_command", lambda: None)
    monkeypatch.setattr(gallery, "card", lambda entry: Card(entry.name, "a summary", "CONVERGED", (), ()))


def process(*words, code=None, **options):
    """The command in a process of its own, with Ctrl-C as in a foreground job; ``code`` runs before it."""
    start = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    start = f"{start}\n{code or ''}\nfrom hjbjax.__main__ import start\nstart()"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": ENVIRONMENT} | options
    return subprocess.run([sys.executable, "-c", start, *words], text=True, timeout=120, check=False, **pipes)


# --- standard output and standard error ---


@posix
@pytest.mark.parametrize("words", [["--version"], ["--help"], ["solve", "--help"], []])
def test_a_pipe_that_nobody_reads_ends_the_command_quietly(words):
    reader, writer = os.pipe()
    os.close(reader)
    done = process(*words, stdout=writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_process_that_fails_does_not_wait_for_the_others_of_its_launch():
    """JAX parts from them at a normal exit: half a minute, after which another process was named."""
    code = """
import atexit, sys, types
sys.modules["jax"] = types.SimpleNamespace(distributed=types.SimpleNamespace(is_initialized=lambda: True))
atexit.register(print, "a normal exit")
"""
    done = process("no-such-command", code=code)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("hjbjax: No such command")


@posix
def test_closed_descriptors_are_not_given_to_files():
    """Otherwise the next file that the command opens would receive what XLA writes to standard error."""
    code = """
import os, sys, types
for each in (0, 1, 2):
    os.close(each)
sys.modules["hjbjax.cli.main"] = types.SimpleNamespace(main=lambda **_: os._exit(os.open(os.devnull, os.O_RDONLY)))
"""
    assert process(code=code).returncode > 2


@posix
def test_the_command_with_all_streams_closed():
    command = f"exec {sys.executable} -m hjbjax"
    for words, code in (("--version", 0), ("slove", 2)):
        done = subprocess.run(["sh", "-c", f"{command} {words} <&- >&- 2>&-"], env=ENVIRONMENT, check=False)
        assert done.returncode == code


@posix
def test_the_command_does_not_end_in_a_prompt():
    """Its exit code would be 1 in any case."""
    options = {"stdin": subprocess.DEVNULL, "env": {**ENVIRONMENT, "PYTHONINSPECT": "1"}}
    words = [sys.executable, "-m", "hjbjax", "slove"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False, **options)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)


@pytest.mark.parametrize("kind", BROKEN)
def test_an_exit_code_holds_without_standard_error(quick, kind, monkeypatch, capsys):
    def warned(*arguments, **options):
        warnings.warn("said to nobody", UserWarning, stacklevel=1)
        return answer(*arguments, **options)

    monkeypatch.setattr(hjbjax, "solve", warned)
    monkeypatch.setattr(sys, "stderr", BROKEN[kind]())
    for words, code in ((["solve", "smooth", "--json"], 0), (["slove"], 2), (["solve", "smooth"], 2)):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == code
    assert json.loads(capsys.readouterr().out)["status"] == "CONVERGED"


@pytest.mark.parametrize("kind", ["none", "closed", "detached"])
def test_results_are_written_without_standard_output(quick, kind, monkeypatch):
    monkeypatch.setattr(sys, "stdout", BROKEN[kind]())
    for words in (["solve", "smooth"], ["gallery", "--out", "page", "--only", "smooth"], ["list"]):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 0
    assert sorted(os.listdir()) == ["page", "smooth"]


def test_a_reader_that_goes_during_a_gallery_leaves_the_page_of_what_was_done(quick, monkeypatch):
    monkeypatch.setattr(sys, "stdout", BROKEN["no reader"]())
    with pytest.raises(SystemExit) as ended:
        main(["gallery", "--out", "page"])
    assert ended.value.code == 141
    assert os.listdir() == []  # the first line met nobody, and nothing had been solved
    with pytest.raises(SystemExit) as ended:
        main(["solve", "smooth"])
    assert ended.value.code == 141
    assert os.listdir("smooth") == ["solution.npz"]


# --- letters ---


@pytest.mark.parametrize("words", [[], ["list"], ["solve"], ["gallery"], ["doctor"], ["launch"]])
def test_help_has_only_letters_of_every_encoding(words):
    assert run(*words, "--help").stdout.isascii()


def test_a_terminal_without_greek_letters(quick, monkeypatch):
    screen = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", screen)
    lines = ["γ ≤ 1", *zoo.catalogue]
    monkeypatch.setattr("hjbjax.cli.listing.overview", lambda: iter(lines))
    main(["list"], standalone_mode=False)
    for name in zoo.catalogue:
        main(["list", name], standalone_mode=False)
    main(["solve", "smooth", "--out", NAMES[-2]], standalone_mode=False)
    screen.flush()
    text = screen.buffer.getvalue().decode("ascii")
    assert text.startswith("gamma <= 1\n")
    assert "wrote Gr\\xf6\\xdfe beta/solution.npz" in text


@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_any_name_that_the_system_takes_is_written_and_said_in_one_line(quick, folder, name):
    for words in (["solve", "smooth", "--out", name], ["gallery", "--only", "smooth", "--force", "--out", name]):
        result = run(*words)
        assert result.exit_code == 0, result.output
        (last,) = [line for line in result.stdout.splitlines() if line.startswith("wrote ")]
        assert last.isprintable()
    assert sorted(os.listdir(name)) == ["index.html", "solution.npz"]
    again = run("solve", "smooth", "--out", name)
    assert (again.exit_code, again.stderr.count("\n")) == (2, 1)
    assert again.stderr.rstrip("\n").isprintable()


@pytest.mark.parametrize("name", ["x" * 256, "a/" + "x" * 256 + "/b"])
@pytest.mark.parametrize("words", [["solve", "smooth"], ["gallery"]])
def test_a_name_that_is_too_long_is_refused_before_anything_is_solved(quick, monkeypatch, words, name):
    monkeypatch.setattr(hjbjax, "solve", None)
    monkeypatch.setattr(gallery, "card", None)
    result = run(*words, "--out", name)
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert "too long" in result.stderr
    assert os.listdir() == []


# --- folders ---


def test_a_gallery_in_an_empty_folder_that_is_there(quick, folder):
    """It took its own hidden folder in there for somebody else's file, after two minutes of solving."""
    (folder / "page").mkdir()
    (folder / "page" / placement.hidden_name("index.html")).write_text("a killed command's, or one at work")
    result = run("gallery", "--out", "page")
    assert result.exit_code == 0, result.output
    assert "index.html" in os.listdir("page")


@pytest.fixture
def gone(folder, monkeypatch):
    """The current folder has been removed."""
    (folder / "gone").mkdir()
    monkeypatch.chdir(folder / "gone")
    (folder / "gone").rmdir()


@posix
@pytest.mark.usefixtures("gone")
@pytest.mark.parametrize("words", [["solve", "smooth"], ["gallery", "--out", "page"], ["gallery", "--out", "/tmp/x"]])
def test_a_removed_current_folder_is_refused_before_anything_is_solved(quick, monkeypatch, words):
    monkeypatch.setattr(hjbjax, "solve", None)
    monkeypatch.setattr(gallery, "card", None)
    result = run(*words)
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert "the current folder has been removed; change to another one" in result.stderr


@posix
@pytest.mark.usefixtures("gone")
def test_a_file_in_a_removed_current_folder(tmp_path):
    solution = answer(None, hjbjax.Grid([0.0], [1.0], (3,)))
    with pytest.raises(hjbjax.FileError, match=r"run.npz: cannot be written: the current folder has been removed.*abs"):
        solution.save("run.npz")
    solution.save(tmp_path / "run.npz")
    assert run("list").exit_code == 0
    with pytest.raises(hjbjax.FileError, match="the current folder has been removed"):
        doctor._folder()


class Spoiler:
    """What another program does to a folder while the command is computing."""

    def __init__(self, folder):
        self.folder = folder

    def a_result_appears(self):
        (self.folder / "out").mkdir(exist_ok=True)
        for name in ("solution.npz", "index.html"):
            (self.folder / "out" / name).write_text("another's")

    def a_file_takes_the_name(self):
        (self.folder / "out").write_text("another's")

    def the_place_is_gone(self):
        shutil.rmtree(self.folder)

    def the_hidden_folder_is_gone(self):
        for name in os.listdir(self.folder):
            shutil.rmtree(self.folder / name)
        self.a_file_takes_the_name()


@pytest.mark.parametrize("harm", [name for name in vars(Spoiler) if not name.startswith("_")])
@pytest.mark.parametrize("words", [["solve", "smooth"], ["gallery", "--only", "smooth"]])
def test_what_was_computed_is_never_thrown_away(quick, folder, monkeypatch, harm, words):
    place, elsewhere = folder / "place", folder / "tmp"
    place.mkdir()
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    solve, card = hjbjax.solve, gallery.card
    spoil = getattr(Spoiler(place), harm)
    monkeypatch.setattr(hjbjax, "solve", lambda *a, **o: (solve(*a, **o), spoil())[0])
    monkeypatch.setattr(gallery, "card", lambda entry: (card(entry), spoil())[0])
    result = run(*words, "--out", place / "out")
    assert (result.exit_code, result.stderr.count("\n")) == (5, 1)
    kept = Path(result.stderr.strip().rpartition("; they are in ")[2])
    assert kept.parent == (elsewhere if harm == "the_place_is_gone" else place)
    (file,) = kept.iterdir()
    if file.suffix == ".npz":
        assert load(file).status == Status.CONVERGED
    else:
        assert "smooth" in file.read_text(encoding="utf-8")


@pytest.mark.parametrize("function", ["replace", "rmdir", "open"])
@pytest.mark.parametrize("words", [["solve", "smooth", "--force"], ["gallery", "--only", "smooth", "--force"]])
def test_an_error_of_the_disk_names_a_place_of_the_user_once(quick, folder, monkeypatch, function, words):
    """Not the hidden folder, which no longer exists, and a file that cannot be moved not twice."""
    call, made = getattr(os, function), folder / "out" / ("index.html" if words[0] == "gallery" else "solution.npz")
    if function == "replace":
        made.parent.mkdir()
        made.write_text("old")

    def fail(path, *more, **options):
        if placement.OWN.search(os.fspath(path)):
            raise OSError(
                5, "Input/output error", os.fspath(path), None, *map(os.fspath, more[: function == "replace"])
            )
        return call(path, *more, **options)

    monkeypatch.setattr(os, function, fail)
    result = run(*words, "--out", "out")
    assert (result.exit_code, result.stderr.count("\n")) == (5 if function == "replace" else 2, 1)
    place = f"out/{made.name}: " if function == "replace" else "--out: out cannot be written: "
    assert f"{place}Input/output error; " in result.stderr
    assert "Errno" not in result.stderr
    assert ".tmp-" not in result.stderr


def test_pictures_are_kept_too(folder, monkeypatch):
    grid = hjbjax.Grid([0.0], [1.0], (3,))
    (folder / "staging").mkdir()
    (folder / "staging" / "value.png").write_bytes(b"a picture")
    said = run_folder.rescue(Path("out"), lambda new: run_folder.copy(answer(None, grid), folder / "staging", new))
    kept = Path(said.removeprefix("they are in "))
    assert {file.name for file in kept.iterdir()} == {"solution.npz", "value.png"}
    np.testing.assert_array_equal(load(kept / "solution.npz").value, grid.nodes()[..., 0])


def test_nothing_is_left_where_no_folder_can_be_written(folder, monkeypatch):
    def full(place):
        (place / "half").write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    assert run_folder.rescue(Path("out"), full) == "no other folder could be written either"
    assert os.listdir() == []


@pytest.mark.parametrize(
    ("out", "checkpoint"),
    [("out", "out/solution.npz"), ("out", "out/../out/solution"), ("out", "link/value.png"), ("a.npz/out", "a")],
)
@pytest.mark.parametrize("more", [["--force"], ["--resume", "--force"]])
def test_a_checkpoint_in_the_place_of_results_is_refused(quick, folder, monkeypatch, out, checkpoint, more):
    """Results would replace it, or could not be written after the solve."""
    monkeypatch.setattr(hjbjax, "solve", None)
    os.symlink("out", folder / "link")
    result = run("solve", "smooth", "--out", out, "--checkpoint", checkpoint, *more)
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert f"is a name that --out {out} needs; give another one" in result.stderr


def test_a_full_disk_is_found_before_anything_is_solved(quick, folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(hjbjax, "solve", None)
    monkeypatch.setattr(Path, "write_bytes", full)  # a full disk still accepts folders
    result = run("solve", "smooth", "--out", "out")
    assert (result.exit_code, result.stderr) == (
        2,
        "hjbjax: --out: out cannot be written: No space left on device; give another folder\n",
    )
    assert os.listdir() == []


def test_results_of_the_current_folder_have_a_name_next_to_it(folder, monkeypatch):
    (folder / "here").mkdir()
    monkeypatch.chdir(folder / "here")
    kept = Path(run_folder.rescue(Path(), lambda new: None).removeprefix("they are in "))
    assert kept.parent == folder
    assert kept.name.startswith("hjbjax-")


def test_a_fault_of_the_compile_cache_is_one_warning(capsys):
    """JAX repeats it for every program, of which a solve has a hundred."""
    with cli._one_line_warnings():
        for way in ("writing", "reading", "writing"):
            for program in ("jit_run", "jit_stage"):
                words = f"Error {way} persistent compilation cache entry for '{program}': OSError: {program}"
                warnings.warn(words, UserWarning, stacklevel=1)
        for _ in range(2):
            warnings.warn("another one", UserWarning, stacklevel=1)
    written, read, *others = capsys.readouterr().err.splitlines()
    assert written.startswith("hjbjax: warning: compiled programs in ")
    assert written.endswith(" cannot be written: OSError: jit_run; remove that folder, or give --no-cache")
    assert " cannot be read: OSError: jit_run; " in read
    assert others == ["hjbjax: warning: another one"] * 2


# --- Ctrl-C ---

INTERRUPTING = """
import importlib.abc, sys
class Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {name!r}:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder())
"""


@pytest.mark.parametrize("name", ["hjbjax.cli.interrupts", "click", "numpy", "jax", "hjbjax.zoo"])
def test_an_interrupt_while_modules_are_imported(name):
    """The words are refused at the end of the imports, with another code."""
    done = process("list", "no-such-problem", code=INTERRUPTING.format(name=name))
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr in ("hjbjax: interrupted\n", "")


def test_an_interrupt_that_is_ignored_stays_so():
    """A shell starts background jobs in this way."""
    ignored = "signal.signal(signal.SIGINT, signal.SIG_IGN)" + INTERRUPTING.format(name="click")
    assert process("--version", code=ignored).stdout.startswith("hjbjax, version ")


def test_an_interrupt_is_raised_where_the_command_has_something_to_keep():
    before = signal.signal(signal.SIGINT, interrupts.end)
    try:
        with interrupts.raising_interrupts():
            assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert signal.getsignal(signal.SIGINT) is interrupts.end
    finally:
        signal.signal(signal.SIGINT, before)
    with interrupts.raising_interrupts():  # in somebody's own program
        assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("words", ["solve smooth", "gallery --out page", "launch -- solve smooth"])
def test_the_commands_that_have_something_to_keep(quick, monkeypatch, words):
    def interrupt(*_, **__):
        assert signal.getsignal(signal.SIGINT) is not interrupts.end
        raise KeyboardInterrupt

    monkeypatch.setattr(hjbjax, "solve", interrupt)
    monkeypatch.setattr(gallery, "card", interrupt)
    monkeypatch.setattr("hjbjax.cli.launch.start_processes", interrupt)
    before = signal.signal(signal.SIGINT, interrupts.end)
    try:
        result = run(*words.split())
    finally:
        signal.signal(signal.SIGINT, before)
    assert (result.exit_code, result.stderr) == (130, "hjbjax: interrupted\n")
    assert os.listdir() == []


# --- a broken installation ---


def test_doctor_reports_a_jax_that_cannot_be_imported(folder):
    (folder / "jax").mkdir()
    (folder / "jax" / "__init__.py").write_text("raise ImportError('libcudart.so: cannot open shared object file')")
    done = process("doctor", code=f"import sys; sys.path.insert(0, {str(folder)!r})")
    assert done.returncode == 1
    lines = {line.split()[1]: line for line in done.stdout.splitlines()}
    assert "FAIL  devices     ImportError: libcudart.so: cannot open" in lines["devices"]
    assert lines["folder"].startswith("ok")
