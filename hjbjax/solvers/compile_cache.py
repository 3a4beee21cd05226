"""Compiled programs on disk, shared between processes through JAX's persistent compilation cache."""

import os
import re
import sys
from pathlib import Path

from hjbjax.solution import placement

SETTINGS = {  # JAX's defaults skip programs that compile in less than a second, and a solve has many of these
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
DIRECTORY = "jax_compilation_cache_dir"
FAULT = re.compile(r"Error (read|writ)ing persistent compilation cache entry for '.*?': (.*)")  # JAX's warning
CHOICES = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE")  # if one is set, the user has decided


def user_folder() -> Path:
    """The folder for this user's caches on this platform."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "hjbjax" / "Cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "hjbjax"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hjbjax"


def keep_compiled(folder: str | os.PathLike | None = None) -> Path:
    """Store compiled programs on disk, and reuse programs that earlier processes stored.

    Call it once at the start of a script or notebook whose problems are solved again later. It sets options of JAX that
    hold for the whole process, so no solve sets them on its own. A program is reused if problem, shapes, options,
    versions and processor are the same; numbers may differ. Entries are never removed or repaired. A damaged entry
    causes a warning and is compiled again; delete the folder then, or when it has become too large.

    Args:
      folder: the folder; ``None`` is the user's cache folder, ``~/.cache/hjbjax`` on Linux.

    Returns:
      The folder, as an absolute path.

    Raises:
      OSError: the folder cannot be created or written.

    Example:
      >>> import hjbjax as hjb
      >>> folder = hjb.keep_compiled()  # doctest: +SKIP
    """
    import jax

    place = user_folder() if folder is None else Path(folder)
    place = Path(placement.absolute(os.fspath(place)))  # JAX would create the folder again after a change of folders
    place.mkdir(parents=True, exist_ok=True)
    if not os.access(place, os.W_OK):
        raise PermissionError(f"keep_compiled: {place} cannot be written")
    for name, value in SETTINGS.items():
        jax.config.update(name, value)
    jax.config.update(DIRECTORY, str(place))
    return place


def keep_for_the_command() -> None:
    """Call ``keep_compiled`` unless the environment disables it; without a usable folder nothing is stored."""
    if any(name in os.environ for name in CHOICES):
        return
    try:
        keep_compiled()
    except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
        return


def fault_in(warning: str) -> tuple[str | None, str]:
    """The kind of cache fault that a warning of JAX reports, and a line for the user.

    For other warnings the kind is None, and the line is the warning itself.
    """
    found = FAULT.fullmatch(warning)
    if found is None:
        return None, warning
    from jax import config

    fault = f"cannot be {'read' if found[1] == 'read' else 'written'}"
    folder = getattr(config, DIRECTORY)
    return fault, f"compiled programs in {folder} {fault}: {found[2]}; remove that folder, or give --no-cache"
