"""Standard output and standard error that may be missing, closed, full, or not a terminal.

``sys.stderr`` is None under ``pythonw``, in some services and after ``2>&-``. Notebooks, editors and test runners
replace it by objects that may lack ``isatty`` or raise when written to. It is better to lose the output than to lose a
solve. ``encodable`` and ``plain`` make text that a stream can show.
"""

import contextlib
import os
import sys
import warnings
from typing import Any

LONGEST = 2000  # characters of a text to show; wrapping a million takes a second
SPELLED = {  # replacements for characters that the encoding lacks
    **{"−": "-", "–": "-", "—": "-", "≤": "<=", "≥": ">=", "∞": "inf", "·": "*", "×": "x", "→": "->", "±": "+-"},
    **{"²": "^2", "½": "1/2", "Δ": "d", "∂": "d", "Σ": "sum ", "“": '"', "”": '"', "‘": "'", "’": "'", "…": "..."},
    **{"α": "alpha", "β": "beta", "γ": "gamma", "δ": "delta", "ε": "eps", "η": "eta", "θ": "theta", "κ": "kappa"},
    **{"λ": "lambda", "μ": "mu", "π": "pi", "ρ": "rho", "σ": "sigma", "τ": "tau", "φ": "phi", "ψ": "psi", "ω": "omega"},
}


def is_terminal(stream: Any) -> bool:
    """True if a stream is a terminal that can be written to; False for every other object, including None."""
    try:
        stream.write("")
        return bool(stream.isatty())
    except Exception:  # a closed file raises ValueError, None AttributeError, a replacement object anything
        return False


def is_open(stream: Any) -> bool:
    """True if a stream accepts text; also True on a full disk and in a pipe without a reader."""
    try:
        stream.write("")
    except OSError:
        return True
    except Exception:
        return False
    return True


def encoding_of(stream: Any) -> str:
    """The name of a stream's encoding; UTF-8 by default."""
    try:
        encoding = stream.encoding
    except Exception:  # a detached stream raises ValueError, None AttributeError
        return "utf-8"
    return encoding if isinstance(encoding, str) else "utf-8"


class Expendable:
    """A text stream that ignores errors, for output that is not essential.

    Args:
      stream: the stream.
    """

    def __init__(self, stream: Any):
        self._stream, self.encoding = stream, encoding_of(stream)

    def write(self, text: str) -> int:
        """Write a text if the stream accepts it, and return the number of its characters.

        Raises:
          TypeError: bytes, with which some libraries test whether a stream is a text stream.
        """
        if not isinstance(text, str):
            raise TypeError(f"write() argument must be str, not {type(text).__name__}")
        with contextlib.suppress(Exception):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream if it can be flushed."""
        with contextlib.suppress(Exception):
            self._stream.flush()

    def isatty(self) -> bool:
        """True if the stream is a terminal."""
        return is_terminal(self._stream)


def warn_safely(message: str, category: type[Warning] = UserWarning, stacklevel: int = 1) -> None:
    """``warnings.warn``, without an exception if standard error cannot be written to.

    Raises:
      Warning: a filter turns this warning into an error.
    """
    try:
        warnings.warn(message, category, stacklevel=stacklevel + 1)
    except Exception as error:
        # Python drops an OSError itself; a character that the stream cannot encode is a UnicodeError
        if isinstance(error, Warning) or (is_open(sys.stderr) and not isinstance(error, UnicodeError)):
            raise


def let_go(stream: Any) -> None:
    """Discard the buffer of a stream, otherwise the interpreter fails on it again at exit."""
    with contextlib.suppress(Exception):
        # replace the descriptor below Python, because closing the stream would flush it and fail again
        handle = stream.fileno()
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, handle)
        os.close(nowhere)


def flush_or_let_go(stream: Any) -> None:
    """Flush a stream at the end of a process, or discard the text that it cannot write."""
    try:
        stream.flush()
    except OSError:
        let_go(stream)
    except Exception:  # None, a closed stream, a replacement object
        return


# --- text that a stream can show ---


def encodable(text: str, stream: Any = None) -> str:
    """A text in characters that a stream, by default standard output, can encode; other characters are spelled out."""
    encoding = encoding_of(sys.stdout if stream is None else stream)
    try:
        text.encode(encoding)  # a Windows console may support 256 characters, and print would raise halfway
    except UnicodeEncodeError:
        return "".join(_spell(letter, encoding) for letter in text)
    except LookupError:  # an encoding that Python does not know
        pass
    return text


def _spell(letter: str, encoding: str) -> str:
    """A character itself if the encoding has it, else its name, else its code point."""
    try:
        letter.encode(encoding)
    except UnicodeEncodeError:
        return SPELLED.get(letter) or ascii(letter)[1:-1]
    return letter


def plain(text: str) -> str:
    """A text without line breaks and control characters, cut after ``LONGEST`` characters."""
    cut = " ".join(text[:LONGEST].split()) + (" ..." if len(text) > LONGEST else "")
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in cut)
