"""Settings shared by all tests. A warning is an error (pyproject.toml); pictures are drawn into memory."""

import gc
import os
import sys
from pathlib import Path

import jax
import pytest
from hypothesis import settings

os.environ["MPLBACKEND"] = "Agg"  # for this process and for the commands and notebooks that tests start
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"  # or commands find in a user's folder what others compiled

# Traced programs are millions of objects that stay: looking through them again and again finds nothing.
gc.set_threshold(100_000, 20, 20)

# The first example of a law compiles what the others reuse, so a deadline would time the compiler.
settings.register_profile("hjbjax", deadline=None, print_blob=True)
settings.load_profile("hjbjax")

MAPS = 20_000  # of the 65 530 that Linux allows a process; every compiled kernel takes a few, and XLA crashes beyond


# Two thirds of a run are XLA's: without its optimiser it takes half of the time, and without the emitters of fusions a
# third. Those of old write a value anew in every block of a fusion: one that chooses among many actions at constrained
# ends takes them time that doubles with every action. Such tests are marked ``emitters``, or a program asks for them
# itself (``compiler_options``). Without the optimiser what computes for long takes up to seventy times as long: such
# tests are marked ``optimised``. Who wants all tests with what users run says ``XLA_FLAGS= pytest``.
QUICK = "--xla_cpu_use_fusion_emitters=false"
HASTE = "jax_disable_most_optimizations"  # its variable is for the processes that tests start
if os.environ.setdefault("XLA_FLAGS", QUICK) == QUICK:  # read when JAX starts to compute, here and in those processes
    os.environ[HASTE.upper()] = "1"
    jax.config.update(HASTE, True)


class Figures:
    """No test and no doctest finds the axes of another one, be it on a logarithmic scale."""

    @staticmethod
    def pytest_runtest_teardown():
        """Close what was drawn."""
        if (pyplot := sys.modules.get("matplotlib.pyplot")) is not None:
            pyplot.close("all")


def pytest_configure(config):
    """Doctests lie outside of this folder, whose own hooks they do not see."""
    config.pluginmanager.register(Figures())


def pytest_runtest_setup(item):
    """Skip what the old emitters do not come to an end with."""
    if item.get_closest_marker("emitters") and os.environ["XLA_FLAGS"] == QUICK:
        pytest.skip("takes the old emitters too long: XLA_FLAGS= pytest -m emitters")


@pytest.fixture(autouse=True)
def _optimised(request, monkeypatch):
    """XLA's optimiser for the tests marked ``optimised`` and for the processes that they start."""
    if request.node.get_closest_marker("optimised") is None:
        yield
        return
    monkeypatch.delenv(HASTE.upper(), raising=False)
    before = jax.config.read(HASTE)
    jax.config.update(HASTE, False)
    yield
    jax.config.update(HASTE, before)


@pytest.fixture(autouse=True, scope="module")
def _room_for_code():
    """Compiled programs are forgotten after a file of tests once they take much room."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MAPS:
        jax.clear_caches()
        gc.collect()
