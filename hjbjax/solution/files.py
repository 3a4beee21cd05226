"""Result files: npz archives that are written atomically and validated when read.

A file is an uncompressed zip of npy arrays, one of which, ``header``, is JSON in UTF-8. Data is written to a temporary
file in the same folder, flushed, synced and moved by ``placement``: after a crash at any time the file is the old one
or the new one. Files left by a killed writer are removed by the next writer in that folder. Reading never unpickles,
and rejects declared sizes that exceed the file's own size, so a false claim of 8 TB allocates nothing. Every failure
raises ``FileError``.
"""

import abc
import errno
import json
import math
import os
import re
import stat
import struct
import zipfile
from collections.abc import Callable, Mapping
from typing import IO, Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np

from hjbjax.problem.pytree import is_traced
from hjbjax.problem.types import DType
from hjbjax.solution import screen
from hjbjax.solution.placement import (
    FileError,
    MissingFileError,
    Path,
    absolute,
    check_place,
    flush_to_disk,
    new_file,
    path_of,
    place,
)

T = TypeVar("T")
Kinds = Mapping[str, tuple[type, ...]]  # the types of the entries of a header, as JSON returns them
REAL = (float, int)  # a number that is whole may be written as an integer

REASON = 400  # characters of a message, which may quote the file
OWN = "hjbjax."  # the beginning of the formats of this package
MAX_HEADER = 1 << 24  # bytes; the header has settings and timings, not data

# The only text that numpy writes before an array of numbers. It is matched, and not evaluated as in numpy, because it
# may be any bytes until the checksum has been compared.
DECLARATION = re.compile(rb"\{'descr': '([<>|]\w\d)', 'fortran_order': False, 'shape': \(([0-9, ]{0,999})\), \} *\n")


class Expected(NamedTuple):
    """The shapes and dtypes that an array may have; ``None`` in a shape matches any length."""

    shapes: tuple[tuple[int | None, ...], ...]
    dtypes: tuple[DType, ...] = (np.float64, np.float32)
    optional: bool = True

    def complaint(self, shape: tuple[int, ...], code: str) -> str | None:
        """The reason why an array with this shape and dtype code, such as '<f8', is invalid; ``None`` if valid."""
        allowed = [np.dtype(dtype).str for dtype in self.dtypes]
        if code not in allowed:
            return f"has dtype {code!r}, wanted {' or '.join(allowed)}"
        if not any(_matches(shape, wanted) for wanted in self.shapes):
            return f"has shape {shape}, wanted {' or '.join(_shape_text(wanted) for wanted in self.shapes)}"
        return None


def _matches(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    """True if a shape has the wanted lengths."""
    return len(shape) == len(wanted) and all(n is None or n == m for m, n in zip(shape, wanted, strict=True))


def _shape_text(wanted: tuple[int | None, ...]) -> str:
    """A shape as Python writes it, with "any" for arbitrary lengths."""
    return f"({', '.join('any' if n is None else str(n) for n in wanted)}{',' * (len(wanted) == 1)})"


def write(path: Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, force: bool = False) -> None:
    """Write a header and arrays atomically.

    Args:
      path: the file; ``.npz`` is added to a name without a suffix, unless a file of that very name exists.
      header: JSON values; NumPy scalars and arrays in it become numbers and lists, anything else its text.
      arrays: numbers or booleans by name.
      force: replace an existing file, whose permissions are kept.

    Raises:
      FileExistsError: the file exists and ``force`` is false, or another process has created it meanwhile.
      FileError: the folder is missing or not writable, the disk is full, or the name belongs to a folder, a device or a
        pipe; no partial file is left.
    """
    path = with_suffix(path_of(path, "written"))
    write_whole(path, lambda stream: write_archive(stream, header, arrays), force=force)


def write_whole(path: Path, fill: Callable[[IO[bytes]], object], *, force: bool = False) -> None:
    """Write a file atomically: ``fill`` writes its bytes to a stream; errors as for ``write``."""
    # through links: replaces the file behind a link, not the link
    path = absolute(path_of(path, "written"))
    check_place(path, force)  # before the bytes are written, and again when the file is moved
    with new_file(path) as (temporary, stream):
        fill(stream)
        flush_to_disk(stream)
        place(temporary, path, force)
    _sync_folder(os.path.dirname(path))


def write_archive(stream: IO[bytes], header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write a header and arrays as a zip archive.

    Raises:
      OSError: the header is too long to be read again.
    """
    # A damaged table of contents may hide whole entries, and has no checksum, so the header lists the arrays.
    text = json.dumps({**header, "arrays": sorted(arrays)}, default=_plain).encode()
    if len(text) > MAX_HEADER - 1000:  # the entry's own header takes some of it
        raise OSError(f"message and statistics take {len(text):,} bytes of {MAX_HEADER:,}")
    archive = zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED)
    try:
        for name, array in {"header": np.frombuffer(text, np.uint8), **arrays}.items():
            info = zipfile.ZipInfo(name + ".npy")  # dated 1980, so that equal solutions give equal files
            # zip64, because an entry that is written in pieces may exceed 2 GiB after its header is written
            with archive.open(info, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)
        archive.close()
    except BaseException:
        archive.fp = None  # otherwise an exception on closing would hide Ctrl-C, or the reason of a failure
        raise


def with_suffix(path: str) -> str:
    """The name with ``.npz``, as NumPy writes it, unless it has a suffix or a file of that very name exists.

    A folder of that name does not count if the file with ``.npz`` exists: ``hjbjax solve pendulum --checkpoint
    pendulum`` makes both.
    """
    if not path or os.path.splitext(path)[1]:
        return path
    whole = path + ".npz"
    return path if os.path.lexists(path) and not (os.path.isdir(path) and os.path.isfile(whole)) else whole


def _sync_folder(folder: str) -> None:
    """Make the new name survive a power cut, if the system supports it; the file is complete in any case."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows cannot open folders
        return
    try:
        os.fsync(handle)
    except OSError:
        pass
    finally:
        os.close(handle)


def _plain(value: object) -> Any:
    """Convert a value that JSON does not support to a number, a list or text."""
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else str(value)


def read(
    path: Path,
    form: str,
    version: int,
    plan: Callable[[dict], Mapping[str, Expected]],
    rebuild: Callable[[dict, dict[str, np.ndarray]], T],
) -> T:
    """Read an object from a file written by ``write``.

    Args:
      path: the file.
      form: the required ``header["format"]``.
      version: the newest ``header["version"]`` that the caller supports.
      plan: a function from the header to the shapes and dtypes of the arrays.
      rebuild: a function from the header and the arrays by name, without missing optional arrays, to the object.

    Returns:
      The object returned by ``rebuild``.

    Raises:
      FileError: the file is invalid in any way; raised before memory of the claimed size is allocated.
    """
    path = with_suffix(path_of(path, "read"))
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISDIR(mode):
            raise FileError("it is a folder; give a file in it")
        if not stat.S_ISREG(mode):  # opening a pipe would block indefinitely
            raise FileError("it is not an ordinary file")
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size  # of the open file, which a writer may have replaced meanwhile
            return rebuild(*_read_archive(file, size, form, version, plan))
    except FileError as error:
        reason, cause = str(error), error.__cause__ or error
    except OSError as error:
        # offsets in a damaged table of contents may lie before the start of the file
        reason = "it is damaged" if error.errno == errno.EINVAL else error.strerror or str(error)
        cause = error
    except zipfile.BadZipFile as error:
        reason, cause = f"it is damaged: {error}", error
    except Exception as error:  # zipfile, json and numpy raise a dozen types for damaged bytes
        reason, cause = f"damaged or foreign ({type(error).__name__}: {' '.join(str(error).split())[:200]})", error
    kind = MissingFileError if isinstance(cause, FileNotFoundError) else FileError
    raise kind(f"{path}: cannot be read: {screen.one_line(reason, REASON)}") from cause


def _read_archive(file: IO[bytes], size: int, form: str, version: int, plan: Callable) -> tuple[dict, dict]:
    """Header and arrays of an archive; checks the declared sizes before it reads the arrays."""
    if size == 0:
        raise FileError("it is empty")
    start = file.read(4)  # a zip archive with entries begins with PK\3\4, a pickle of protocol 2 or later with \x80
    if start != b"PK\3\4":
        what = "a pickle, which may run code and is never opened" if start[:1] == b"\x80" else "not an npz file"
        raise FileError(f"it is {what}; wanted a file written by save()")
    try:
        archive = zipfile.ZipFile(file)
    except (zipfile.BadZipFile, struct.error, EOFError) as error:
        raise FileError("it is truncated or damaged: its table of contents is missing") from error
    with archive:
        members = _members(archive, size)
        if "header" not in members or members["header"].file_size > MAX_HEADER:
            raise FileError("it has no header: not a file written by save()")
        header = _read_header(archive, members["header"], form, version)
        expected = plan(header)
        # missing entries mean a damaged table of contents, additional ones were inserted later
        if wrong := set(members) ^ {"header", *header["arrays"]}:
            raise FileError(f"it does not hold the arrays that its header lists: {', '.join(sorted(wrong))}")
        for name, wanted in expected.items():
            if name in members:
                _check_member(archive, members[name], wanted)
            elif not wanted.optional:
                raise FileError(f"the array {name!r} is missing")
        if unknown := set(members) - {"header"} - set(expected):
            raise FileError(f"unknown entry {min(unknown)!r}: not a file written by save()")
        present = [name for name in expected if name in members]
        return header, {name: _read_member(archive, members[name]) for name in present}


def _members(archive: zipfile.ZipFile, size: int) -> dict[str, zipfile.ZipInfo]:
    """The entries by name, after checking that together they are no larger than the file and the memory."""
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    if len(members) != len(archive.infolist()):
        raise FileError("an entry is there twice")
    for name, info in members.items():
        # a few kB may unpack to gigabytes, while a stored entry takes the same number of bytes of the file; bit 0:
        # encrypted
        if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
            raise FileError(f"entry {name!r} is compressed or encrypted: not a file written by save()")
        if info.file_size != info.compress_size:
            raise FileError(f"entry {name!r} declares two sizes: it is damaged")
    total, memory = sum(info.file_size for info in members.values()), _memory()
    if total > size:  # overlapping entries, each of which would fit
        raise FileError(f"it claims {total:,} bytes of arrays and is {size:,} bytes long")
    if total > memory:
        raise FileError(f"it holds {total:,} bytes of arrays; this machine has {memory:,} bytes of memory")
    return members


def check_kinds(header: Mapping[str, Any], kinds: Kinds, where: str = "its header") -> None:
    """Check that entries of a header exist and have the right types; True is not a number here.

    Raises:
      FileError: an entry is missing or of another type.
    """
    for name, wanted in kinds.items():
        if name not in header:
            raise FileError(f"{where} has no {name!r}: it is damaged, or of an older format")
        if type(header[name]) not in wanted:
            raise FileError(f"{where} has {name} = {header[name]!r:.60}, wanted {wanted[0].__name__}")


def _memory() -> float:
    """The physical memory in bytes; infinite if the system does not report it."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return math.inf


def _read_header(archive: zipfile.ZipFile, info: zipfile.ZipInfo, form: str, version: int) -> dict:
    """The header, if its format and version are supported."""
    _check_member(archive, info, Expected(((None,),), (np.uint8,)))
    header = json.loads(_read_member(archive, info).tobytes())
    kind = header.get("format") if isinstance(header, dict) else None
    if isinstance(kind, str) and kind != form and kind.startswith(OWN):
        raise FileError(f"it holds a result of another kind, {kind:.60}, wanted {form}")
    if kind != form:
        raise FileError(f"its header does not say {form!r}: another program wrote it")
    found = header.get("version")
    # JSON's true is a bool, which Python treats as the integer 1
    if isinstance(found, bool) or not isinstance(found, int) or found < 1:
        raise FileError(f"its format version is {found!r}, wanted an integer from 1 to {version}")
    if found > version:
        raise FileError(f"its format is version {found}, newer than the {version} known here: update hjbjax")
    return header


def _check_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, wanted: Expected) -> None:
    """Compare the declared shape and dtype of an npy header with the wanted ones and with the size of the entry."""
    name = info.filename.removesuffix(".npy")
    with archive.open(info) as member:
        start = member.read(10)  # magic, version 1.0, and the length of the following text in two bytes
        text = member.read(int.from_bytes(start[8:], "little"))
    declared = DECLARATION.fullmatch(text)
    if start[:8] != b"\x93NUMPY\1\0" or declared is None:
        raise FileError(f"the array {name!r} is damaged or holds something other than numbers")
    code, shape = declared[1].decode(), tuple(int(count) for count in declared[2].split(b",") if count.strip())
    if complaint := wanted.complaint(shape, code):
        raise FileError(f"the array {name!r} {complaint}")
    if info.file_size != 10 + len(text) + np.dtype(code).itemsize * math.prod(shape):
        raise FileError(
            f"the array {name!r} declares shape {shape} of {code!r}; its entry has {info.file_size:,} bytes"
        )


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """Read one array and verify its checksum."""
    with archive.open(info) as member:
        array = np.lib.format.read_array(member, allow_pickle=False)
        member.read()  # to the end, where the checksum is compared
    return array


class Saved(abc.ABC):
    """The methods ``save`` and ``load`` of a result that one file holds.

    A subclass has the class variables FORMAT, the name of the format, VERSION, which is incremented when an older
    hjbjax would misread a file, and KINDS, the types of the entries of the header.
    """

    FORMAT: ClassVar[str]
    KINDS: ClassVar[Kinds] = {}
    VERSION: ClassVar[int] = 1

    def save(self, path: Path, *, force: bool = False) -> None:
        """Write the result to ``path`` atomically; ``load`` of the same class reads it.

        Args:
          path: the file.
          force: replace an existing file.

        Raises:
          FileExistsError: the file exists, without ``force``.
          FileError: the file cannot be written.
          ValueError: the result is traced, or contains a function or an array that a file cannot hold.
        """
        if is_traced(self):
            name = type(self).__name__
            raise ValueError(f"{name}.save: got a traced solution; save it outside of jit, vmap and grad")
        header, arrays = self._contents()
        self._check_readable(header, arrays)
        write(path, {"format": self.FORMAT, "version": self.VERSION, **header}, arrays, force=force)

    def _check_readable(self, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Raise ValueError if ``load`` would refuse the arrays, which would be lost in the file."""
        expected = self._checked_plan(json.loads(json.dumps({**header, "arrays": sorted(arrays)}, default=_plain)))
        for name, array in arrays.items():
            if complaint := expected[name].complaint(np.shape(array), np.asarray(array).dtype.str):
                raise ValueError(f"{type(self).__name__}.save: {name} {complaint}")

    @classmethod
    def load(cls, path: Path) -> Self:
        """The result in a file written by ``save``, without its problem.

        Args:
          path: the file.

        Raises:
          FileError: the file is missing, damaged or foreign.
        """
        return read(path, cls.FORMAT, cls.VERSION, cls._checked_plan, cls._from_file)

    @classmethod
    def _checked_plan(cls, header: dict) -> Mapping[str, Expected]:
        """The arrays of a file with this header, whose entries have the right types."""
        check_kinds(header, cls.KINDS)
        return cls._plan(header)

    @abc.abstractmethod
    def _contents(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Header and arrays of a file."""

    @staticmethod
    @abc.abstractmethod
    def _plan(header: dict) -> Mapping[str, Expected]:
        """The arrays of a file with this header."""

    @classmethod
    @abc.abstractmethod
    def _from_file(cls, header: dict, arrays: dict[str, np.ndarray]) -> Self:
        """The result with the header and the arrays of a file."""
