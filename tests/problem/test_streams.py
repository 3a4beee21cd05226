"""Standard streams that are missing, closed, full or no terminal end nothing."""

import io
import sys
import warnings

import pytest
from broken_streams import BROKEN, show_as_python_does

from hjbjax.problem import streams


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture(params=BROKEN)
def broken(request, monkeypatch):
    """Standard error that cannot be used in one way or another."""
    stream = BROKEN[request.param]()
    monkeypatch.setattr(sys, "stderr", stream)
    return stream


def test_a_broken_stream_is_no_terminal(broken):
    assert not streams.is_terminal(broken)
    assert streams.is_terminal(Terminal())
    assert not streams.is_terminal(io.StringIO())


def test_what_cannot_be_written_is_dropped(broken):
    stream = streams.Expendable(broken)
    assert stream.write("text") == 4
    stream.flush()
    assert not stream.isatty()


def test_what_can_be_written_is():
    terminal = Terminal()
    stream = streams.Expendable(terminal)
    stream.write("text")
    assert (terminal.getvalue(), stream.isatty()) == ("text", True)
    with pytest.raises(TypeError, match="bytes"):  # click would take a stream of bytes for one that has to be wrapped
        stream.write(b"text")


def test_the_encoding_is_that_of_the_stream(broken):
    assert streams.Expendable(io.TextIOWrapper(io.BytesIO(), encoding="latin-1")).encoding == "latin-1"
    assert streams.Expendable(broken).encoding.lower() == "utf-8"


@pytest.mark.usefixtures("broken")
def test_a_warning_that_cannot_be_written_is_dropped():
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = show_as_python_does
        streams.warn_safely("said to nobody")


def test_a_warning_in_letters_that_the_stream_lacks_is_dropped(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = show_as_python_does
        streams.warn_safely("γ is too small")


@pytest.mark.usefixtures("broken")
def test_a_warning_that_is_made_an_error_is_raised():
    with pytest.raises(UserWarning, match="said"):
        streams.warn_safely("said")


def test_the_line_of_a_warning_is_that_of_the_caller():
    with pytest.warns(RuntimeWarning, match="said") as found:
        streams.warn_safely("said", RuntimeWarning)
    assert found[0].filename == __file__


def test_an_exception_of_the_program_s_own_way_to_show_warnings_is_raised(monkeypatch):
    def show(*_, **__):
        raise ValueError("mine")

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = show
        with pytest.raises(ValueError, match="mine"):
            streams.warn_safely("said")
