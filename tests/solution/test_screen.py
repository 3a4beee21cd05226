"""What is printed: on an old terminal, and of a file that somebody else wrote."""

import io
import json
import sys
import textwrap

import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.feedback.path import Path
from hjbjax.problem import streams
from hjbjax.problem.grid import Grid
from hjbjax.solution.solution import Solution, Status

GRID = Grid([0.0], [1.0], (3,))
NASTY = "\x1b[2J\x1b]0;title\x07 \u202ereversed \x00 \x9b31m \ud800"


def solution(**changes):
    fields = {"value": np.zeros(3), "policy": np.zeros((3, 1)), "code": Status.CONVERGED, "steps": 2}
    return Solution(GRID, **(fields | changes))


@pytest.fixture
def terminal(monkeypatch):
    """What ``print`` writes to a terminal of an encoding, as text."""

    def show(what, encoding):
        raw = io.BytesIO()
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding=encoding, errors="strict"))
            print(what)
            sys.stdout.flush()
            return raw.getvalue().decode(encoding)

    return show


WORDS = {"certificate": "discount β > 0: error ≤ residual/β", "device": "𝔾PU"}


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1253", "utf-8"])
def test_a_terminal_without_greek(terminal, encoding):
    text = terminal(solution(stats=WORDS, message="|u| ≤ 1 “so” β − 1"), encoding)
    assert ("β" in text) == (encoding in ("cp1253", "utf-8"))
    if encoding == "ascii":
        assert '|u| <= 1 "so" beta - 1' in text
        assert "discount beta > 0: error <= residual/beta" in text
        assert "\\U0001d53ePU" in text


def test_every_letter_is_spelled_in_ascii():
    assert all(spelled.isascii() and len(letter) == 1 for letter, spelled in streams.SPELLED.items())


def test_an_encoding_that_nobody_knows(monkeypatch):
    class Terminal(io.StringIO):
        encoding = "klingon"

    monkeypatch.setattr(sys, "stdout", Terminal())
    assert "β" in str(solution(stats=WORDS))
    monkeypatch.setattr(sys, "stdout", None)  # a program without a console
    assert "β" in str(solution(stats=WORDS))


@pytest.mark.slow
def test_other_results_on_a_terminal_without_greek(terminal):
    path = hjb.simulate(hjb.Problem(lambda x, u: u - x, controls=hjb.Box([-1.0], [1.0])), lambda x: 0 * x, [1.0], 1.0)
    object.__setattr__(path, "message", "x − 1 ≤ 2")
    assert isinstance(path, Path)
    assert terminal(path, "ascii") == "x - 1 <= 2\n"
    found = hjb.stability.lyapunov_check(lambda x: -x @ x, lambda x: -x, hjb.Box([-1.0], [1.0]), samples=16)
    assert "V - V(x_e)" in terminal(found, "ascii")


# --- a file of somebody else's ---


@pytest.mark.parametrize("where", ["message", "method", "scheme", "device", "dtype", "certificate"])
def test_control_characters_are_shown_as_python_writes_them(where):
    changes = {"message": NASTY} if where == "message" else {"stats": {"device": "cpu", where: NASTY}}
    text = str(solution(**changes))
    assert all(letter.isprintable() or letter == "\n" for letter in text)
    assert "\\x1b[2J" in text
    text.encode()


def test_names_of_axes_are_shown_so_as_well(tmp_path):
    nasty = Grid([0.0], [1.0], (3,), names=[NASTY])
    text = str(Solution(nasty, np.zeros(3), None, code=1))
    assert "\x1b" not in text


@pytest.mark.parametrize("size", [10**6, 3 * 10**6])
def test_of_long_messages_only_the_beginning_is_wrapped(tmp_path, size, monkeypatch):
    """Wrapping a million characters takes a second."""
    wrap, wrapped = textwrap.wrap, []
    monkeypatch.setattr(textwrap, "wrap", lambda text, *options: wrapped.append(len(text)) or wrap(text, *options))
    path = tmp_path / "run.npz"
    for message in ("x" * size, "x " * (size // 2), "\n" * size + "x"):
        solution(message=message, stats={"method": message}).save(path, force=True)
        loaded = hjb.load(path)
        assert loaded.message == message
        assert len(str(loaded)) < 2000
    assert len(wrapped) <= 6  # the message and the method, three times
    assert max(wrapped) <= streams.LONGEST + len(" ...")


def test_only_the_beginning_of_a_long_text_is_looked_at():
    class Long(str):
        def __iter__(self):
            raise AssertionError("all of the text was looked at")

        split = __iter__

    assert streams.plain(Long("x " * 10**6)) == "x " * (streams.LONGEST // 2) + "..."


ODD = [{}, [], [1, 2], None, "fast", True, float("nan"), float("inf"), -1, 10**400, {"a": {"b": []}}]


@pytest.mark.parametrize("value", ODD, ids=lambda value: repr(value)[:12])
@pytest.mark.parametrize(
    "name", ["seconds", "compile_seconds", "bytes", "tol", "method", "scheme", "device", "dtype", "certificate"]
)
def test_statistics_of_any_kind_are_printed(name, value):
    enclosure = np.array([[1.0, 0.0], [1.0, 0.0]])
    stats = json.loads(json.dumps({"seconds": 1.0, "device": "cpu", name: value}))
    assert str(solution(stats=stats, enclosure=enclosure)).startswith("CONVERGED")


def test_what_could_not_be_read_again_is_not_written(tmp_path):
    with pytest.raises(hjb.FileError, match=r"cannot be written: message and statistics take 1[67],.* bytes"):
        solution(message="x" * 2**24).save(tmp_path / "run.npz")
    assert list(tmp_path.iterdir()) == []


def test_a_refused_file_is_quoted_in_one_short_line(tmp_path):
    from hjbjax.solution import files

    path = tmp_path / "run.npz"
    for header in ({"format": "test", "version": NASTY * 10**4}, {"format": "test", "version": 1}):
        files.write(path, header, {"\x1b[2J" * 1000: np.zeros(3)}, force=True)
        with pytest.raises(files.FileError) as caught:
            files.read(path, "test", 1, lambda header: {}, lambda header, arrays: None)
        message = str(caught.value)
        assert len(message) < len(str(path)) + 500
        assert message.isprintable()
