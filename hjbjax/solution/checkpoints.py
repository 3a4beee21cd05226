"""Checkpoints: the state of a run in a file, from which a later run continues with the same bits.

A run is a sequence of parts, each a computation in steps with a complete state: coarser grids, the computation of a
guess, the monotone solve, the second-order solve. Everything between two parts is computed again, with the same result
on the same machine with the same versions. A file therefore stores only the states of the completed parts and of the
current one. Files are written atomically: if a run is killed, its file is either the old one or the new one.

A run creates its file before it computes anything, which also tests the path, and keeps it locked until its end.
"""

import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import IO, Any, Protocol

import jax
import numpy as np

from hjbjax._version import __version__
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.solution import files, placement
from hjbjax.solution.clock import agreed
from hjbjax.solution.files import Expected, FileError
from hjbjax.solution.locked_file import LockedFile
from hjbjax.solution.placement import Path
from hjbjax.solution.status import Status, warn
from hjbjax.tracing import closures, descriptions

FORMAT, VERSION = "hjbjax.Checkpoint", 1
SECONDS = 60.0  # seconds between two writes
KINDS = tuple(map(np.dtype, ("f8", "f4", "i8", "i4", "u4", "u1", "?")))  # of the arrays in a state
RANDOM = ("jax_default_prng_impl", "jax_threefry_partitionable", "jax_random_seed_offset")
# the statuses of an incomplete part, from which a later run continues
CUT_SHORT = (Status.INTERRUPTED, Status.TIME_LIMIT, Status.MAX_STEPS, Status.RUNNING)


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The file for the state of a run, and the interval between writes.

    Args:
      path: the file; ``.npz`` is added to a name without a suffix.
      every: seconds between two writes; a run that ends for any reason also writes at its end.

    Raises:
      ValueError: a time that is not positive; infinity writes at the end only.

    Example:
      >>> Checkpoint("run.npz", every=600.0)
      Checkpoint(path='run.npz', every=600.0)
    """

    path: Path
    every: float = SECONDS

    def __post_init__(self) -> None:
        arguments.positive(self.every, "Checkpoint: every", "in seconds", endless=True)


class Part(Protocol):
    """A computation in steps, as used by a checkpoint."""

    @property
    def passing(self) -> bool:
        """True if its result is only a guess for the next part."""

    def saved(self) -> list[Any]:
        """Its state, as a list of arrays."""

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Continue from the arrays of ``saved``.

        Raises:
          ValueError: the arrays are not a state of this part.
        """


@dataclasses.dataclass(frozen=True)
class Record:
    """The state of a part, and its status.

    A part that only computes a guess keeps no arrays once the next part has begun.
    """

    arrays: Sequence[np.ndarray]
    status: Status
    passing: bool

    @property
    def done(self) -> bool:
        """True if no steps remain."""
        # the computation of a guess has a fixed number of steps, and ends with them
        return self.status not in CUT_SHORT or (self.passing and self.status is Status.MAX_STEPS)


class Journal:
    """The parts of a run: the completed parts and the current one.

    Args:
      file: the file with this journal, and maybe those for other lanes.
      records: the records of an earlier run.
    """

    def __init__(self, file: "File", records: Sequence[Record] = ()):
        self.file, self.records = file, list(records)
        self._at = 0  # the index of the current part, or of the next one
        self._closed = False

    def enter(self, part: Part) -> Status | None:
        """Bring a part to its recorded state, and return its status if it is complete, otherwise None.

        Raises:
          FileError: the record belongs to another part, or the file cannot be written.
        """
        if self._closed:
            return None
        if self._at >= len(self.records):
            self.file.try_place()
            return None
        record = self.records[self._at]
        forgotten = record.passing and not record.arrays and self._at + 1 < len(self.records)
        if not forgotten:
            try:
                part.restore(list(record.arrays))
            except ValueError as error:
                raise self.file.refusal(f"it holds a state that this run cannot have: {error}") from error
        self._at += record.done
        return record.status if record.done else None

    def keep(self, part: Part) -> None:
        """Write the state of the current part, if a write is due."""
        if not self._closed and self.file.is_due():
            self._note(part, Status.RUNNING)
            self.file.write()

    def leave(self, part: Part, status: Status) -> None:
        """Record the end of a part, or its progress; after a cut nothing else is recorded."""
        if self._closed:
            return
        self._note(part, status)
        done = self.records[-1].done
        self._at, self._closed = self._at + done, not done

    def _note(self, part: Part, status: Status) -> None:
        """Record the state of the current part, and drop the states that only led to its start."""
        before = [dataclasses.replace(each, arrays=()) if each.passing else each for each in self.records[: self._at]]
        # copied before the next step: a view of JAX's array would keep that step from reusing the array's memory
        keep = np.array if status is Status.RUNNING else np.asarray
        arrays = [keep(array) for array in jax.device_get(part.saved())]
        self.records = [*before, Record(arrays, status, part.passing)]
        self.file.changed = True


class File:
    """The journals of one run, or of the lanes of a batch, in one file.

    Args:
      checkpoint: the path and the seconds between two writes.
      question: the problem as digests and words; see ``describe_question``.
      known: the records of an earlier run, by the names of their journals.
      target: the file; None in a process that does not write.
      caller: the function that was called, for messages.
      together: True if several processes solve one problem.
      untested: True if nobody has tested yet that the file can be written.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        question: Mapping[str, str],
        known: Mapping[str, Sequence[Record]],
        target: LockedFile | None,
        *,
        caller: str = "solve",
        together: bool = False,
        untested: bool = False,
    ):
        self.checkpoint, self.question, self.known = checkpoint, dict(question), dict(known)
        self.target, self.caller, self.together, self.untested = target, caller, together, untested
        self.journals: dict[str, Journal] = {}
        self.changed = False
        self.failure: str | None = None  # why it could not be written
        self._written, self._lock = time.monotonic(), threading.Lock()  # lanes write from separate threads

    @property
    def outcome(self) -> str:
        """The outcome of the writes: "written", or the reason for a failure."""
        return self.failure or "written"

    def journal(self, name: str = "run") -> Journal:
        """The journal of a run, with the records of an earlier one."""
        return self.journals.setdefault(name, Journal(self, self.known.get(name, ())))

    def is_due(self) -> bool:
        """True if a write is due."""
        due = time.monotonic() - self._written >= self.checkpoint.every
        # the state is gathered from all processes, so they must agree
        return bool(agreed(int(due))) if self.together else due

    def try_place(self) -> None:
        """Test that the file can be written, unless this has been tested.

        Raises:
          FileError: it cannot be written.
        """
        if self.untested and self.target is not None:
            self.untested = False
            with _named_after(self.caller):
                placement.try_place(self.target.path)

    def records(self) -> dict[str, Sequence[Record]]:
        """All records by the names of their journals, including lanes that have not begun."""
        begun = {name: each.records for name, each in dict(self.journals).items()}  # copied: lanes may begin meanwhile
        return {**self.known, **begun}

    def write(self) -> None:
        """Write the changes; if that fails the run continues, with one warning."""
        with self._lock:
            if not self.changed or self.target is None:
                return
            self.changed = False
            try:
                self.target.write(_archive(self.question, self.records()))
            except OSError as error:
                if self.failure is None:
                    warn(f"{self.caller}: the run goes on without a checkpoint: {error}")
                self.failure, self.changed = str(error), True
            else:
                self.failure = None
            self._written = time.monotonic()

    def refusal(self, reason: str) -> FileError:
        """The error for an unusable file."""
        return FileError(f"{self.caller}: {self.checkpoint.path!s}: cannot be read: {reason}")


def check_alike(arrays: Sequence[np.ndarray], wanted: Sequence[Any]) -> None:
    """Compare number, shapes and dtypes of arrays with the wanted ones.

    Raises:
      ValueError: they differ.
    """
    found, own = ([f"{np.asarray(each).dtype}{list(np.shape(each))}" for each in some] for some in (arrays, wanted))
    if len(found) != len(own):
        raise ValueError(f"it has {len(found)} arrays, wanted {len(own)}")
    for one, other in zip(found, own, strict=True):
        if one != other:
            raise ValueError(f"one of its arrays is {one}, wanted {other}")


def _archive(question: Mapping[str, str], records: Mapping[str, Sequence[Record]]) -> Callable[[IO[bytes]], None]:
    """A function that writes all records to a stream."""
    journals = {
        name: [
            [int(each.status), each.done, each.passing, [[list(a.shape), a.dtype.str] for a in each.arrays]]
            for each in some
        ]
        for name, some in records.items()
    }
    header = {
        "format": FORMAT, "version": VERSION, "asked": dict(question), "versions": versions(), "journals": journals,
    }  # fmt: skip
    return lambda stream: files.write_archive(stream, header, dict(_arrays(records)))


def _arrays(records: Mapping[str, Sequence[Record]]) -> Iterator[tuple[str, np.ndarray]]:
    """All arrays with their names in the file."""
    for journal, some in records.items():
        for i, each in enumerate(some):
            for j, array in enumerate(each.arrays):
                yield _name(journal, i, j), array


def _name(journal: str, part: int, array: int) -> str:
    """The name of an array in a file."""
    return f"{journal}_{part}_{array}"


def versions() -> dict[str, str]:
    """The versions and the device that affect the last bits of a solution."""
    return {"hjbjax": __version__, "jax": jax.__version__, "device": str(jax.devices()[0].device_kind)}


@contextlib.contextmanager
def open_checkpoint(
    checkpoint: Path | Checkpoint | None,
    problems: Sequence[Problem],
    grid: Grid | int,
    *,
    resume: bool,
    caller: str,
    together: bool = False,
    **others: Any,
) -> Iterator[File | None]:
    """Context with the file of a run, which is written at its end; None without a checkpoint.

    The file is locked during the whole run. A new file is created at once, and removed if the run ends with an
    exception before there is anything to store.

    Args:
      checkpoint: the file, or a ``Checkpoint``.
      problems: one problem, the problems of all lanes, or none.
      grid: the grid; without one the number of states.
      resume: continue from the file, if it exists.
      caller: the function that was called, for messages.
      together: True if several processes solve the problem.
      others: the other arguments that affect the solution.

    Raises:
      ValueError: ``resume`` without a checkpoint.
      FileExistsError: the file exists, and ``resume`` is false.
      FileError: the file cannot be read or written, belongs to another problem, or is in use by another run.
    """
    if checkpoint is None:
        if resume:
            raise ValueError(f"{caller}: resume=True continues from a checkpoint; pass checkpoint=, the file")
        yield None
        return
    with _named_after(caller):
        kept = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(checkpoint)
        path = placement.absolute(files.with_suffix(placement.path_of(kept.path, "written")))
        kept, target = dataclasses.replace(kept, path=path), LockedFile(path)
    question = describe_question(problems, grid, **others)
    with contextlib.closing(target):
        with _named_after(caller):
            known = (_begin_together if together else _begin)(target, question, resume=resume)
        writes = not together or jax.process_index() == 0
        untested = not together and _is_complete(known)
        own = target if writes else None
        file = File(kept, question, known, own, caller=caller, together=together, untested=untested)
        try:
            yield file
        except BaseException:
            if not any(file.records().values()):
                target.remove()
            raise
        finally:
            file.write()


def refuse_checkpoint(checkpoint: object, resume: bool, caller: str) -> None:
    """Refuse a checkpoint inside a JAX transformation, which would leave the run without one.

    Raises:
      ValueError: a checkpoint or ``resume`` was passed.
    """
    if checkpoint is not None or resume:
        raise ValueError(
            f"{caller}: checkpoint= and resume= work at host level only, not inside jit, vmap and grad: leave them "
            "out, or call the function outside of the transformation"
        )


@contextlib.contextmanager
def _named_after(caller: str) -> Iterator[None]:
    """Context in which errors about files are prefixed with the function that was called."""
    try:
        yield
    except (FileError, FileExistsError) as error:
        raise type(error)(f"{caller}: {error}") from error.__cause__


def _begin(target: LockedFile, question: Mapping[str, str], *, resume: bool) -> dict[str, list[Record]]:
    """The records of an earlier run, from the file, which is locked from now on; a new file has no records.

    A complete run writes nothing when it is resumed, so its file may be on a full or read-only disk.

    Raises:
      FileExistsError: the file exists, and ``resume`` is false.
      FileError: the file is in use or was made for another problem, or no file can be written there.
    """
    empty = _archive(question, {})
    if not resume:
        try:
            target.write(empty)
        except FileExistsError:
            raise FileExistsError(
                f"{target.path}: there is a checkpoint already; pass resume=True to continue from it"
            ) from None
        return {}
    while not target.take():
        with contextlib.suppress(FileExistsError):  # another run was faster, which ``take`` reports
            target.write(empty)
            return {}
    known = _read(target.path, question)
    if not _is_complete(known):
        placement.try_place(target.path)
    return known


def _is_complete(known: Mapping[str, Sequence[Record]]) -> bool:
    """True if all recorded parts are complete; parts that have not begun have no record."""
    return bool(known) and all(some and all(each.done for each in some) for some in known.values())


def _begin_together(target: LockedFile, question: Mapping[str, str], *, resume: bool) -> dict[str, list[Record]]:
    """``_begin`` in several processes that solve one problem: the first one locks the file, the others read it."""
    first, known = jax.process_index() == 0, {}
    with _in_all_processes(target.path):
        known = _begin(target, question, resume=resume) if first else {}
        if _is_complete(known):  # an error in a later part would occur in the first process only
            placement.try_place(target.path)
    with _in_all_processes(target.path):
        return known if first or not resume else _read(target.path, question)


@contextlib.contextmanager
def _in_all_processes(path: str) -> Iterator[None]:
    """Context that all processes leave together: an exception in one of them raises in all, so no process waits.

    The others raise the same type, FileExistsError or FileError, because a command has an exit code for each.
    """
    try:
        yield
    except Exception as error:
        agreed(-1 if isinstance(error, FileExistsError) else 0)
        raise
    outcome = agreed(1)
    if outcome < 1:
        kind = FileExistsError if outcome < 0 else FileError
        raise kind(f"{path}: another process of this run could not open it")


def describe_question(problems: Sequence[Problem], grid: Grid | int, **others: Any) -> dict[str, str]:
    """The question of a run by parts, as text: digests of its problems, its grid, and its other arguments."""
    n = grid.ndim if isinstance(grid, Grid) else grid
    # these settings of JAX determine the numbers of a key; functions of a problem may use keys as well
    found = {"setting of random numbers": repr([getattr(jax.config, name) for name in RANDOM])}
    if problems:
        digests = " ".join(closures.digest(problem, n) for problem in problems)
        found["problem" if len(problems) == 1 else "list of problems"] = digests
    if isinstance(grid, Grid):
        about = (
            grid.shape,
            grid.periodic,
            grid.edges,
            # as Python numbers, because NumPy prints an array with 8 digits
            [each and (float(each.strength), float(each.center)) for each in grid.stretch],
        )
        ends = np.concatenate([np.asarray(grid.lo, np.float64), np.asarray(grid.hi, np.float64)])
        found["grid"] = f"{about} from {ends.tobytes().hex()}"
    for word, thing in others.items():
        found[word] = repr(thing) if isinstance(thing, descriptions.PLAIN) else descriptions.digest_of(thing)
    return found


def _read(path: str, question: Mapping[str, str]) -> dict[str, list[Record]]:
    """The records in a file by the names of their journals; the file must have been made for the same problem."""

    def rebuild(header: dict, arrays: dict[str, np.ndarray]) -> dict[str, list[Record]]:
        made_for = header["asked"]
        changed = header["versions"] != versions()
        if other := _difference(question, made_for):
            # JAX may write the operations of a function differently in another version
            since = f", or the same with other versions ({_words(header['versions'])}; now {_words(versions())})"
            raise FileError(f"it was made {other}{since if changed else ''}; give another path, or remove the file")
        if changed:
            warn(f"{path}: the checkpoint was made with {header['versions']}; the last bits of the answer may differ")
        return {
            name: [
                Record([arrays[_name(name, i, j)] for j in range(len(shapes))], Status(status), bool(passing))
                for i, (status, _, passing, shapes) in enumerate(parts)
            ]
            for name, parts in header["journals"].items()
        }

    return files.read(path, FORMAT, VERSION, _plan, rebuild)


def check_file(path: str) -> None:
    """Raise FileError if a file is not an undamaged checkpoint; the problem is not compared."""
    files.read(path, FORMAT, VERSION, _plan, lambda header, arrays: None)


def _difference(question: Mapping[str, str], made_for: Mapping[str, str]) -> str:
    """The difference between two questions in words; empty if there is none."""
    if question.keys() != made_for.keys():
        return "for another function, or another number of problems"
    other = sorted(key for key in question if question[key] != made_for[key])
    return f"for another {' and '.join(other)}" if other else ""


def _words(versions: Mapping[str, str]) -> str:
    """Names with their versions."""
    return ", ".join(f"{name} {version}" for name, version in versions.items())


def _plan(header: dict) -> dict[str, Expected]:
    """Shapes and dtypes of the arrays in a file, from its header."""
    return {
        _name(name, i, j): Expected(
            (tuple(map(int, shape)),), tuple(kind for kind in KINDS if kind.str == code), optional=False
        )
        for name, parts in header["journals"].items()
        for i, (_, _, _, arrays) in enumerate(parts)
        for j, (shape, code) in enumerate(arrays)
    }
