"""Checkpoints: what a run had done when it was cut, in a file, and going on from there with the same bits.

A run is a sequence of parts, each a computation in steps whose state holds all there is: coarser grids, the way to a
guess, the monotone solve, the one of second order. What lies between two parts is computed again and comes to the same,
on the same machine with the same versions; so the states of the parts that are done, and of the one under way, are all
that a file has to hold. Files are written whole or not at all: whenever a run is killed there is the old one or the
new one.
"""

import contextlib
import dataclasses
import hashlib
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import jax
import numpy as np

from hjbjax._version import __version__
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.solution import files
from hjbjax.solution.clock import agreed
from hjbjax.solution.files import Expected, FileError
from hjbjax.solution.placement import Path, check_place, path_of
from hjbjax.solution.status import Status, warn
from hjbjax.tracing import closures
from hjbjax.tracing.outside import ADDRESS

FORMAT, VERSION = "hjbjax.Checkpoint", 1
SECONDS = 60.0  # between two writes
KINDS = tuple(map(np.dtype, ("f8", "f4", "i8", "i4", "u4", "u1", "?")))  # of the arrays in a state
# how a part ends that is not done: from there it goes on
CUT_SHORT = (Status.INTERRUPTED, Status.TIME_LIMIT, Status.MAX_STEPS, Status.RUNNING)


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Where a run keeps what it has done, and how often.

    Args:
      path: the file; ``.npz`` is put behind a name without a suffix.
      every: seconds between two writes; what is cut by hand or by a limit is written in any case.

    Raises:
      ValueError: a time that is not positive; infinity writes at the end alone.

    Example:
      >>> Checkpoint("run.npz", every=600.0)
      Checkpoint(path='run.npz', every=600.0)
    """

    path: Path
    every: float = SECONDS

    def __post_init__(self):
        arguments.positive(self.every, "Checkpoint: every", "in seconds", endless=True)


class Part(Protocol):
    """A computation in steps, as a checkpoint sees it."""

    @property
    def passing(self) -> bool:
        """Whether its end is a guess for the part that follows, and nothing else."""

    def saved(self) -> list[Any]:
        """Its state, as arrays in an order of its own."""

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Go on from the arrays of ``saved``."""


@dataclasses.dataclass(frozen=True)
class Record:
    """What is known of a part: its arrays, how it stands, and whether it is done.

    A part that only led to a guess has no arrays any more when the next one has begun.
    """

    arrays: Sequence[np.ndarray]
    status: Status
    done: bool
    passing: bool


class Journal:
    """The parts of a run: those that are done, and the one under way.

    Args:
      file: what holds them, maybe beside those of other runs.
      records: those of an earlier process.
    """

    def __init__(self, file: "File", records: Sequence[Record] = ()):
        self.file, self.records = file, list(records)
        self._at = 0  # the part under way, or the one that comes next
        self._closed = False

    def enter(self, part: Part) -> Status | None:
        """Put a part to where it stood: how it ended if it is done, else None."""
        if self._closed or self._at >= len(self.records):
            return None
        record = self.records[self._at]
        if record.arrays:
            self.file.check(part.saved(), record.arrays)
            part.restore(list(record.arrays))
        self._at += record.done
        return record.status if record.done else None

    def keep(self, part: Part) -> None:
        """Write the state of the part under way, if it is time for that."""
        if not self._closed and self.file.is_due():
            self._note(part, Status.RUNNING, done=False)
            self.file.write()

    def leave(self, part: Part, status: Status) -> None:
        """Note the end of a part, or how far it came; after a cut nothing counts that follows."""
        if self._closed:
            return
        # no more steps than these were to be taken on the way to a guess
        done = status not in CUT_SHORT or (part.passing and status is Status.MAX_STEPS)
        self._note(part, status, done=done)
        self._at, self._closed = self._at + done, not done

    def _note(self, part: Part, status: Status, *, done: bool) -> None:
        """Record the state of the part under way, and forget those that led to where it began."""
        before = [dataclasses.replace(each, arrays=()) if each.passing else each for each in self.records[: self._at]]
        # on a CPU these are views of JAX's arrays, which a step may take for its own
        keep = np.array if status is Status.RUNNING else np.asarray
        arrays = [keep(array) for array in jax.device_get(part.saved())]
        self.records = [*before, Record(arrays, status, done, part.passing)]
        self.file.changed = True


class File:
    """The journals of one run, or of the lanes of a batch, in one file.

    Args:
      checkpoint: where it is, and how often it is written.
      asked: what was asked, as digests and words; a file that was made for anything else is refused.
      known: the records of an earlier process, by the names of their journals.
      together: whether many processes solve one problem, of which the first one writes.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        asked: Mapping[str, str],
        known: Mapping[str, Sequence[Record]],
        *,
        together: bool = False,
    ):
        self.checkpoint, self.asked, self.known, self.together = checkpoint, dict(asked), dict(known), together
        self.journals: dict[str, Journal] = {}
        self.changed = False
        self.failure: str | None = None  # why it could not be written
        self._written, self._lock = time.monotonic(), threading.Lock()  # lanes write from threads of their own

    @property
    def outcome(self) -> str:
        """What to say of it at the end: written, or why not."""
        return self.failure or "written"

    def journal(self, name: str = "run") -> Journal:
        """The journal of a run, with what is known of it."""
        return self.journals.setdefault(name, Journal(self, self.known.get(name, ())))

    def is_due(self) -> bool:
        """Whether it is time to write."""
        due = time.monotonic() - self._written >= self.checkpoint.every
        # what is written is gathered from all processes, and all of them have to ask
        return bool(agreed(int(due))) if self.together else due

    def write(self) -> None:
        """Write what has changed; where that fails the run goes on, with one warning."""
        with self._lock:
            if not self.changed or (self.together and jax.process_index() > 0):
                return
            self.changed = False
            # copied: lanes begin meanwhile; and with those of lanes that have not begun yet
            begun = {name: each.records for name, each in dict(self.journals).items()}
            records: dict[str, Sequence[Record]] = {**self.known, **begun}
            try:
                files.write(self.checkpoint.path, self._header(records), dict(_arrays(records)), force=True)
            except (FileError, OSError) as error:
                if self.failure is None:
                    warn(f"the run goes on without a checkpoint: {error}")
                self.failure, self.changed = str(error), True
            else:
                self.failure = None
            self._written = time.monotonic()

    def _header(self, records: Mapping[str, Sequence[Record]]) -> dict[str, Any]:
        """What stands beside the arrays."""
        journals = {
            name: [
                [int(each.status), each.done, each.passing, [[list(a.shape), a.dtype.str] for a in each.arrays]]
                for each in some
            ]
            for name, some in records.items()
        }
        return {
            "format": FORMAT, "version": VERSION, "asked": self.asked, "versions": versions(), "journals": journals,
        }  # fmt: skip

    def check(self, state: Sequence[Any], arrays: Sequence[np.ndarray]) -> None:
        """Refuse arrays that are not those of a part's state."""
        wanted, found = ([(np.shape(a)[1:], np.asarray(a).dtype) for a in each] for each in (state, arrays))
        # a leading axis may be of residuals, or of slices: of these there are as many as the run had come to
        if wanted != found:
            raise FileError(f"{self.checkpoint.path!s}: it holds another state than the run it is to go on with has")


def _arrays(records: Mapping[str, Sequence[Record]]) -> Iterator[tuple[str, np.ndarray]]:
    """All arrays with the names that they have in a file."""
    for journal, some in records.items():
        for i, each in enumerate(some):
            for j, array in enumerate(each.arrays):
                yield _name(journal, i, j), array


def _name(journal: str, part: int, array: int) -> str:
    """The name of an array in a file."""
    return f"{journal}_{part}_{array}"


def versions() -> dict[str, str]:
    """What the bits of an answer depend on beside the question."""
    return {"hjbjax": __version__, "jax": jax.__version__, "device": str(jax.devices()[0].device_kind)}


@contextlib.contextmanager
def opened(
    checkpoint: Path | Checkpoint | None,
    problems: Sequence[Problem],
    grid: Grid,
    *,
    resume: bool,
    what: str,
    together: bool = False,
    **others: Any,
) -> Iterator[File | None]:
    """Context with the file of a run, which is written at its end; None where there is to be none.

    Args:
      checkpoint: the file, or that and how often it is written.
      problems: one, or those of all lanes.
      grid: the nodes.
      resume: whether to go on from the file, if it is there.
      what: the function that was called, for messages.
      together: whether many processes solve the problem.
      others: what else decides the answer.

    Raises:
      ValueError: ``resume`` without a checkpoint.
      FileExistsError: the file is there, and ``resume`` is false.
      FileError: the file cannot be read, or is that of another question.
    """
    if checkpoint is None:
        if resume:
            raise ValueError(f"{what}: resume=True goes on from a checkpoint; give checkpoint=, the file")
        yield None
        return
    kept = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(checkpoint)
    kept = dataclasses.replace(kept, path=_place_of(kept.path))
    there = os.path.lexists(kept.path)
    if there and not resume:
        raise FileExistsError(f"{kept.path!s}: there is a checkpoint already; resume=True goes on from it")
    question = asked(problems, grid, **others)
    file = File(kept, question, _read(kept.path, question) if there else {}, together=together)
    try:
        yield file
    finally:
        file.write()


def asked(problems: Sequence[Problem], grid: Grid, **others: Any) -> dict[str, str]:
    """What a run is asked, by digests and words: settled problems, their grid and what else decides the answer."""
    about = (
        grid.shape,
        grid.periodic,
        grid.edges,
        [each and (each.strength, each.center) for each in grid.stretch or ()],
    )
    ends = np.concatenate([np.asarray(grid.lo, np.float64), np.asarray(grid.hi, np.float64)])
    digests = " ".join(closures.digest(problem, grid.ndim) for problem in problems)
    found = {
        "problem" if len(problems) == 1 else "list of problems": digests,
        "grid": f"{about} from {ends.tobytes().hex()}",
    }
    for word, thing in others.items():
        array = isinstance(thing, (np.ndarray, jax.Array))
        said = hashlib.blake2b(np.asarray(thing).tobytes(), digest_size=16).hexdigest() if array else repr(thing)
        found[word] = ADDRESS.sub("", said)
    return found


def _place_of(path: Path) -> str:
    """The file of a checkpoint, in a folder where it can be written; that is known before anything is computed."""
    place = files.with_suffix(path_of(path, "written"))
    folder = os.path.dirname(os.path.abspath(place))
    if not os.path.isdir(folder) or not os.access(folder, os.W_OK):
        raise FileError(f"{place}: cannot be written: {folder} is no folder in which one may write")
    check_place(place, force=True)
    return place


def _read(path: Path, asked: Mapping[str, str]) -> dict[str, list[Record]]:
    """The records in a file by the names of their journals; it must be of the same question."""

    def rebuild(header: dict, arrays: dict[str, np.ndarray]) -> dict[str, list[Record]]:
        made_for = header["asked"]
        if other := sorted(key for key in asked.keys() | made_for.keys() if asked.get(key) != made_for.get(key)):
            raise FileError(f"it was made for another {' and '.join(other)}; give another path, or take the file away")
        if header["versions"] != versions():
            warn(f"{path!s}: the checkpoint was made with {header['versions']}; the last bits of the answer may differ")
        return {
            name: [
                Record(
                    [arrays[_name(name, i, j)] for j in range(len(shapes))], Status(status), bool(done), bool(passing)
                )
                for i, (status, done, passing, shapes) in enumerate(parts)
            ]
            for name, parts in header["journals"].items()
        }

    return files.read(path, FORMAT, VERSION, _plan, rebuild)


def _plan(header: dict) -> dict[str, Expected]:
    """Shapes and dtypes of the arrays in a file, as its header has them."""
    return {
        _name(name, i, j): Expected(
            (tuple(map(int, shape)),), tuple(kind for kind in KINDS if kind.str == code), optional=False
        )
        for name, parts in header["journals"].items()
        for i, (_, _, _, arrays) in enumerate(parts)
        for j, (shape, code) in enumerate(arrays)
    }
