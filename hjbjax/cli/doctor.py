"""The checks of ``hjbjax doctor``: versions, devices, float64, a tiny solve, memory, pictures, the folder."""

import functools
import importlib.metadata
import io
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from hjbjax._version import __version__
from hjbjax.cli.command_line import text_of
from hjbjax.solution import placement

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "diffrax", "optax", "matplotlib", "tqdm", "click")


def examine() -> Iterator[tuple[str, bool, str]]:
    """Run the checks one by one: the name of each, True if it passed, and the finding."""
    # each check imports what it needs, so that a broken package is one line of the report
    checks: dict[str, Callable[[], str]] = {
        "python": lambda: f"{sys.version.split()[0]} at {sys.executable}",
        "hjbjax": lambda: f"{__version__} at {Path(__file__).parent}",
        **{package: functools.partial(importlib.metadata.version, package) for package in PACKAGES},
        "devices": _devices,
        "float64": _float64,
        "solve": _solve,
        "memory": _memory,
        "pictures": _pictures,
        "folder": _folder,
    }
    for name, check in checks.items():
        try:
            yield name, True, check()
        except Exception as error:  # report any failure
            yield name, False, f"{type(error).__name__}: {' '.join(str(error).split())}"


def _devices() -> str:
    import jax

    return ", ".join(f"{device.platform} {device.device_kind} ({device.id})" for device in jax.devices())


def _float64() -> str:
    import jax
    import jax.numpy as jnp

    with jax.enable_x64(True):  # compiled like a solve, because a device without float64 fails only then
        third = jax.jit(lambda x: x / 3)(jnp.asarray(1.0))
        # 1/3 has no finite binary expansion, so float32 would differ in the eighth digit
        if float(third) != 1 / 3 or third.dtype != np.float64:
            raise ArithmeticError(f"1/3 is {float(third)!r} in {third.dtype}")
    return "works, inside jax.enable_x64(True)"


def _solve() -> str:
    import hjbjax as hjb

    # the smallest problem that uses tracing, compiling and certification
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-3.0], [3.0]), discount=1.0)
    begun = time.perf_counter()
    solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (41,)))
    return f"{solution.status.name} on {solution.grid.size} nodes in {time.perf_counter() - begun:.2f} s"


def _memory() -> str:
    # works on Linux only; elsewhere the name is unknown, and the line says so
    free, total = (os.sysconf("SC_PAGE_SIZE") * os.sysconf(f"SC_{which}_PAGES") / 2**30 for which in ("AVPHYS", "PHYS"))
    return f"{free:.1f} GiB free of {total:.1f} GiB"


def _pictures() -> str:
    import matplotlib
    from matplotlib.figure import Figure

    # into memory with the renderer of savefig, so that no display and no file is needed
    Figure(figsize=(1, 1)).savefig(io.BytesIO(), format="png")
    backend = matplotlib.get_backend(auto_select=False)  # auto-selection would choose one and import pyplot
    return f"PNG works without a display; matplotlib's backend is {backend or 'not chosen yet'}"


def _folder() -> str:
    here = Path(placement.current_folder())
    placement.remove_leftovers(here)  # remove leftovers of a killed command
    # create and remove a folder, as a solve does, because permission bits do not show a full or read-only disk
    folder = here / placement.hidden_name("doctor")
    folder.mkdir()
    folder.rmdir()
    return f"{text_of(here)} can be written"
