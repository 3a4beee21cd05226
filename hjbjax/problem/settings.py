"""The options of JAX that hold inside the package, whatever the caller has set.

Options of JAX change how a program is traced, compiled and checked. The package and the functions of a problem run
under one set of them: the answer does not depend on what the caller debugs, and a function that was traced once can be
used again. The options are set for the current thread and for the duration of a call, so the caller's own programs and
other threads keep theirs. All of them may be set inside ``jit``, ``vmap`` and ``grad``, except the choice between 32
and 64 bits, which must not change in the middle of a trace.

Options that only log, and options that choose a device or random numbers, stay the caller's.
"""

import contextlib
from collections.abc import Iterator

import jax


@contextlib.contextmanager
def own_settings(*, x64: bool | None = None) -> Iterator[None]:
    """Context, and decorator, under which JAX has the options that the package needs; about ten microseconds.

    Args:
      x64: 64-bit types on or off; ``None`` keeps the caller's choice, as a trace requires.
    """
    with (
        # infinity and NaN are answers here: an unreachable state costs infinity, a node in the target has no control
        jax.debug_nans(False),
        jax.debug_infs(False),
        # integers and floating-point numbers meet on purpose, as do scalars and arrays
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        # grids and answers are NumPy's arrays, which travel to the device and back
        jax.transfer_guard_host_to_device("allow"),
        jax.transfer_guard_device_to_device("allow"),
        jax.transfer_guard_device_to_host("allow"),
        # diffrax keeps traces alive in its caches, and draws a Brownian path again from the same keys
        jax.check_tracer_leaks(False),
        jax.debug_key_reuse(False),
        # a product of float32 matrices would keep 8 to 11 bits on an accelerator
        jax.default_matmul_precision("highest"),
        # without jit every sweep over a grid would be a loop in Python
        jax.disable_jit(False),
        contextlib.nullcontext() if x64 is None else jax.enable_x64(x64),
    ):
        yield
