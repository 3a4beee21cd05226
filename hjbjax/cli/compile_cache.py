"""Compiled programs, kept on disk from process to process by JAX's persistent compilation cache."""

import os
import sys
from pathlib import Path

SETTINGS = {  # JAX's own keep nothing that took less than a second, and a solve is many programs that do
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
CHOICES = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE")  # a user who sets one has chosen already


def user_folder() -> Path:
    """Where this user's caches are, by the custom of the platform."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "hjbjax" / "Cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "hjbjax"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hjbjax"


def keep_compiled(folder: str | os.PathLike | None = None) -> Path:
    """Keep what JAX compiles from now on, and find there what earlier processes compiled.

    One line at the start of a script or notebook, for problems that are solved again tomorrow. The options are JAX's
    own and hold for the whole process, which is why no solve sets them by itself. A program is found again where
    problem, shapes, options, versions and processor are the same; numbers may differ. Entries are never removed or
    mended: one that is damaged warns, and what it held is compiled anew; delete the folder then, or when it has grown.

    Args:
      folder: where; ``None`` is the user's folder for caches, ``~/.cache/hjbjax`` on Linux.

    Returns:
      The folder.

    Raises:
      OSError: it cannot be made, or not be written.

    Example:
      >>> import hjbjax as hjb
      >>> folder = hjb.keep_compiled()  # doctest: +SKIP
    """
    import jax

    place = user_folder() if folder is None else Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    if not os.access(place, os.W_OK):
        raise PermissionError(f"keep_compiled: {place} cannot be written")
    for name, value in SETTINGS.items():
        jax.config.update(name, value)
    jax.config.update("jax_compilation_cache_dir", str(place))
    return place


def keep_for_the_command() -> None:
    """As ``keep_compiled``, unless the environment says otherwise; without a folder nothing is kept."""
    if any(name in os.environ for name in CHOICES):
        return
    try:
        keep_compiled()
    except (OSError, RuntimeError):  # RuntimeError: a user without a home
        return
