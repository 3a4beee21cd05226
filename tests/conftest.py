"""Settings shared by all tests. A warning is an error (pyproject.toml); pictures are drawn into memory."""

import gc
import os
import signal
import sys
from pathlib import Path

import jax
import pytest
import shares
import xla
from hypothesis import settings

os.environ["MPLBACKEND"] = "Agg"  # for this process and for the commands and notebooks that tests start
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"  # or commands find in a user's folder what others compiled

# Traced programs are millions of objects that stay: looking through them again and again finds nothing.
gc.set_threshold(1_000_000, 50, 1000)

# A shell starts jobs in the background with Ctrl-C ignored, also for the processes that they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The first example of a law compiles what the others reuse, so a deadline would time the compiler.
settings.register_profile("hjbjax", deadline=None, print_blob=True)
settings.load_profile("hjbjax")

COMPILED, LOOK = {"programs": 0}, 30  # programs since the maps were counted, and how many are worth a look


def _count_programs(event: str, duration: float, **_: object) -> None:
    COMPILED["programs"] += event == "/jax/core/compile/backend_compile_duration"


jax.monitoring.register_event_duration_secs_listener(_count_programs)

# Compiled kernels take memory maps, of which Linux allows a process 65,530; XLA crashes beyond that. The programs with
# 15,000 maps take some 6 GB of memory, which runs out first.
MAPS = 30_000 // max(2, int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))


# XLA takes half of the time of a run. Without its optimiser it takes half as long, and jaxlib 0.10 takes half of that
# again with its old emitters of fusions. Jaxlib 0.12 has only new ones, which take 1.4 times as long as the old; its
# `xla_cpu_opt_preset=FAST_COMPILE` takes 1.6 times as long. The old emitters compute a value again in every block of a
# fusion: their time doubles with every action of a choice among many at constrained boundaries. Tests of this kind are
# marked ``emitters``, or compile their programs with ``xla.with_emitters()``. One LLVM module per program instead of up
# to 32 takes 20 % less time and half of the memory maps.
# Without the optimiser a long computation takes up to seventy times as long: these tests are marked ``optimised``.
# `XLA_FLAGS= pytest` runs all tests with the flags that users run.
# The source lines that JAX notes with every operation take another 3 % of a run, and no test reads them.
HASTE = "jax_disable_most_optimizations"
LINES = "jax_traceback_in_locations_limit"
if "XLA_FLAGS" not in os.environ:  # processes that tests start inherit the variables
    os.environ["XLA_FLAGS"] = xla.quick_to_compile()
    os.environ |= {HASTE.upper(): "1", LINES.upper(): "0"}
    jax.config.update(HASTE, True)
    jax.config.update(LINES, 0)


class Figures:
    """No test and no doctest finds the axes of another one, be it on a logarithmic scale."""

    @staticmethod
    def pytest_runtest_teardown():
        """Close what was drawn."""
        if (pyplot := sys.modules.get("matplotlib.pyplot")) is not None:
            pyplot.close("all")


class Examples:
    """Doctests that solve or simulate several problems are slow tests."""

    # the folders of `hjbjax` whose examples take two minutes in all; the tests of these folders cover the same calls
    LONG = frozenset({"applications", "extremals", "feedback", "filtering", "geometry"})

    @classmethod
    def pytest_itemcollected(cls, item):
        """Mark the examples of these folders."""
        if isinstance(item, pytest.DoctestItem) and item.path.parent.name in cls.LONG:
            item.add_marker("slow")


def pytest_configure(config):
    """Doctests lie outside of this folder, whose own hooks they do not see."""
    for plugin in (Figures(), Examples()):
        config.pluginmanager.register(plugin)


def pytest_addoption(parser):
    """The long tests take an hour or more on a slow machine, so each run of CI takes a share of them."""
    parser.addoption("--share", metavar="K/N", default="1/1", help="run every N-th test function from the K-th on")


@pytest.hookimpl(trylast=True)  # after `-m` and `-k`, so that only tests that would run are counted
def pytest_collection_modifyitems(config, items):
    """Leave out the tests that belong to another share."""
    chosen = shares.select({item.nodeid for item in items}, config.getoption("--share"))
    config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in chosen])
    items[:] = [item for item in items if item.nodeid in chosen]


def pytest_runtest_setup(item):
    """Skip programs that the old emitters take minutes to compile."""
    if item.get_closest_marker("emitters") and xla.OLD_EMITTERS in os.environ["XLA_FLAGS"]:
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


@pytest.fixture(autouse=True)
def _room_for_code():
    """Compiled programs are forgotten after a test once they take much room."""
    yield
    # the kernel takes 1.4 µs a line to list the maps: after every test that would be half a minute in all
    if COMPILED["programs"] < LOOK:
        return
    COMPILED["programs"] = 0
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="module")
def float64():
    """The precision of a solve, for tests of its parts."""
    with jax.enable_x64(True):
        yield
