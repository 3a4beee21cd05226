"""JAX options inside the package, independent of the caller's settings.

JAX options change how a program is traced, compiled and checked. The package and the functions of a problem run under
one set of options, so the answer does not depend on the caller's debugging options and traced functions can be reused.
The options apply to the current thread for the duration of a call; the caller's own programs and other threads keep
theirs. All of them may be set inside ``jit``, ``vmap`` and ``grad``, except the choice between 32 and 64 bits, which
must not change in the middle of a trace.

Options that only log, and options that choose a device or random numbers, stay the caller's.
"""

import contextlib
import operator
from collections.abc import Iterator
from typing import Any

import jax

# error checks write to a global array, which JAX allows neither under ``vmap`` nor in most loops
ERROR_CHECKS = tuple(f"jax_error_checking_behavior_{name}" for name in ("nan", "divide", "oob"))


def refuse_error_checks(caller: str) -> None:
    """Refuse options of the caller that no context manager can change for the duration of a call.

    Raises:
      ValueError: one of them is set.
    """
    for option in ERROR_CHECKS:
        if (found := getattr(jax.config, option, "ignore")) != "ignore":
            raise ValueError(
                f"{caller}: {option} is {found!r}, wanted 'ignore': JAX cannot put such checks into loops.\n"
                f"Call jax.config.update({option!r}, 'ignore') first; NaN is found and reported without them."
            )


# option: its context manager, the value that the package requires, and other values that mean the same
_REQUIRED: dict[str, tuple[Any, Any, tuple]] = {
    # infinity and NaN are valid values: an unreachable state costs infinity, a node in the target has no control
    "jax_debug_nans": (jax.debug_nans, False, ()),
    "jax_debug_infs": (jax.debug_infs, False, ()),
    # integers and floats are mixed on purpose, as are scalars and arrays
    "jax_numpy_dtype_promotion": (jax.numpy_dtype_promotion, "standard", ()),
    "jax_numpy_rank_promotion": (jax.numpy_rank_promotion, "allow", ()),
    # grids and results are NumPy arrays, which are transferred to the device and back
    "jax_transfer_guard_host_to_device": (jax.transfer_guard_host_to_device, "allow", (None,)),
    "jax_transfer_guard_device_to_device": (jax.transfer_guard_device_to_device, "allow", (None,)),
    "jax_transfer_guard_device_to_host": (jax.transfer_guard_device_to_host, "allow", (None,)),
    # diffrax keeps traces alive in its caches, and draws the same Brownian path again from the same keys
    "jax_check_tracer_leaks": (jax.check_tracer_leaks, False, ()),
    "jax_debug_key_reuse": (jax.debug_key_reuse, False, ()),
    # without jit every sweep over a grid would be a loop in Python
    "jax_disable_jit": (jax.disable_jit, False, ()),
    # callers forbid traces or runs of their own programs; every solve traces and runs functions of its problem
    "jax_no_tracing": (jax.no_tracing, False, ()),
    "jax_no_execution": (jax.no_execution, False, ()),
}
_found = operator.attrgetter(*_REQUIRED)


def _to_change() -> list[tuple[Any, Any]]:
    """The context managers of the options that the caller has set to another value, and the required values."""
    pairs = zip(_REQUIRED.values(), _found(jax.config), strict=True)
    return [(set_to, value) for (set_to, value, others), found in pairs if found != value and found not in others]


@contextlib.contextmanager
def own_settings(*, x64: bool | None = None) -> Iterator[None]:
    """Context manager and decorator that sets the JAX options of the package; takes about ten microseconds.

    Args:
      x64: 64-bit types on or off; ``None`` keeps the caller's choice, as a trace requires.
    """
    with contextlib.ExitStack() as stack:
        for set_to, value in _to_change():
            stack.enter_context(set_to(value))
        # products of float32 matrices would otherwise keep only 8 to 11 bits on an accelerator
        stack.enter_context(jax.default_matmul_precision("highest"))
        if x64 is not None:
            stack.enter_context(jax.enable_x64(x64))
        yield


def are_usual() -> bool:
    """True if a lookup between nodes, which has no product of matrices, need not set any option."""
    return not _to_change()
