"""JAX options inside the package, independent of the caller's settings.

JAX options change how a program is traced, compiled and checked. The package and the functions of a problem run under
one set of options, so the answer does not depend on the caller's debugging options and traced functions can be reused.
The options apply to the current thread for the duration of a call; the caller's own programs and other threads keep
theirs. All of them may be set inside ``jit``, ``vmap`` and ``grad``, except the choice between 32 and 64 bits, which
must not change in the middle of a trace.

Options that only log, and options that choose a device or random numbers, stay the caller's.
"""

import contextlib
from collections.abc import Iterator

import jax


@contextlib.contextmanager
def own_settings(*, x64: bool | None = None) -> Iterator[None]:
    """Context manager and decorator that sets the JAX options of the package; takes about ten microseconds.

    Args:
      x64: 64-bit types on or off; ``None`` keeps the caller's choice, as a trace requires.
    """
    with (
        # infinity and NaN are valid values: an unreachable state costs infinity, a node in the target has no control
        jax.debug_nans(False),
        jax.debug_infs(False),
        # integers and floats are mixed on purpose, as are scalars and arrays
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        # grids and results are NumPy arrays, which are transferred to the device and back
        jax.transfer_guard_host_to_device("allow"),
        jax.transfer_guard_device_to_device("allow"),
        jax.transfer_guard_device_to_host("allow"),
        # diffrax keeps traces alive in its caches, and draws the same Brownian path again from the same keys
        jax.check_tracer_leaks(False),
        jax.debug_key_reuse(False),
        # products of float32 matrices would otherwise keep only 8 to 11 bits on an accelerator
        jax.default_matmul_precision("highest"),
        # without jit every sweep over a grid would be a loop in Python
        jax.disable_jit(False),
        # callers forbid new traces of their own programs; every solve traces the functions of its problem
        jax.no_tracing(False),
        contextlib.nullcontext() if x64 is None else jax.enable_x64(x64),
    ):
        yield
