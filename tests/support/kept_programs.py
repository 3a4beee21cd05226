"""The compiled programs that ``tests/conftest.py`` keeps, for processes that tests start."""

import jax


def variables():
    """Environment variables with which a process finds what earlier ones compiled, and keeps what it compiles."""
    folder = jax.config.jax_compilation_cache_dir
    if folder is None:
        return {}
    return {
        "JAX_ENABLE_COMPILATION_CACHE": "true",
        "JAX_COMPILATION_CACHE_DIR": folder,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
