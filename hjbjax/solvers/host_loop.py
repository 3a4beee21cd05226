"""The host's loop around jitted steps, shared by ``solve``, ``march`` and ``solve_batch``, and its interruptions.

A ``Run`` advances in chunks of steps of about half a second, since every call allocates memory again. Progress, Ctrl-C,
time limits and stops at NaN are handled between two chunks; the length of chunks does not change the result. A first
call with zero steps compiles, so that the others can be timed.

If memory runs out or a callback of the user raises, the exception carries the solution so far as ``.solution``. An
exception for memory becomes a ``MemoryError`` that reports the needed and the free memory.
"""

import contextlib
import functools
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol, TypeAlias

import jax
import numpy as np

from hjbjax.problem import streams
from hjbjax.problem.grid import Grid
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Nodes
from hjbjax.solution.checkpoints import Part
from hjbjax.solution.clock import CHUNK_SECONDS, Clock
from hjbjax.solution.solution import Solution, attach_solution
from hjbjax.solution.status import Status
from hjbjax.solvers import memory

FIRST_NODES = 20_000  # number of nodes visited in a first chunk, approximately
CALLBACK = "CpuCallback error"  # first words of JAX's exception for a callback, whatever its type
# in bits, twice XLA's default: solves take a tenth less time on processors with AVX-512, sweeps over enumerated
# controls a quarter less; no effect on others
WIDTH = {"xla_cpu_prefer_vector_width": 512}

Kept: TypeAlias = tuple[np.ndarray, Grid]  # node values saved from an exception, and their grid


class WideJit:
    """``jax.jit`` for a loop of steps at host level, with the widest vectors of the CPU.

    Args:
      function: the loop.
      options: the options of ``jax.jit``.
    """

    def __init__(self, function: Callable[..., Any], **options: Any):
        functools.update_wrapper(self, function)
        self._jit = functools.partial(jax.jit, function, **options)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """The loop's result; compiles at the first call."""
        return self._jitted(*arguments, **options)

    def lower(self, *arguments: Any, **options: Any) -> Any:
        """The program for these arguments, or for their shapes, before it is compiled."""
        return self._jitted.lower(*arguments, **options)

    @functools.cached_property
    def _jitted(self) -> Any:
        return self._jit(compiler_options=_known_width())


@functools.cache
def _known_width() -> dict[str, Any]:
    """``WIDTH``, or no options if XLA does not know it."""
    try:
        jax.jit(lambda: 0, compiler_options=WIDTH)()
    except jax.errors.JaxRuntimeError:
        return {}
    return WIDTH


class Run(Part, Protocol):
    """A computation in steps, as used by the loop."""

    @property
    def name(self) -> str:
        """Its nodes, in words."""

    @property
    def nodes(self) -> int:
        """The number of nodes that a step visits, for the pace."""

    @property
    def steps(self) -> int:
        """The number of completed steps; the evaluation of a guess is not a step."""

    @property
    def limit(self) -> float:
        """The largest number of steps; infinite if the run ends on its own."""

    @property
    def longest(self) -> int:
        """The largest number of passes in a chunk: steps, and the evaluation of a guess."""

    @property
    def bar(self) -> dict[str, Any]:
        """The options of its progress bar."""

    def compile(self) -> None:
        """Compile the jitted passes by a call that makes no pass."""

    def first_chunk(self, clock: Clock) -> int:
        """The number of passes of the first chunk, before any is timed."""

    def advance(self, count: int) -> Status:
        """Make at most ``count`` passes and return the status; waits until they are done."""

    def between(self, status: Status, clock: Clock) -> Status:
        """Store results between two chunks, and before the first; return the status with which to continue."""

    def show(self, bar: Any) -> None:
        """Advance the progress bar."""

    def keep(self, error: Exception) -> None:
        """Attach the results before an exception to it."""


def drive(run: Run, clock: Clock) -> Status:
    """Drive a run in chunks until it stops, reaches the limit of steps or time, or Ctrl-C; return its last status."""
    status = clock.over()
    if status is not None:
        return status
    journal = clock.journal
    if journal is not None and (done := journal.enter(run)) is not None:
        return done
    status = Status.RUNNING
    with progress_bar(clock.progress, run.bar) as bar:
        try:
            chunk = run.first_chunk(clock)
            clock.phase = f"compiling for {run.name}"
            _suggest_cache(clock)
            run.compile()
            while (status := run.between(status, clock)) is Status.RUNNING:
                chunk = clock.least_of_all(chunk)
                if journal is not None:
                    journal.keep(run)
                began, before = time.perf_counter(), run.steps
                status = _stop_status(run, clock)
                if status is not Status.RUNNING:
                    break
                clock.phase = f"step {before + 1} on {run.name}"
                status = run.advance(chunk)
                done = max(run.steps - before, 1)  # the evaluation of a guess takes less time than a step
                clock.count(time.perf_counter() - began, done, run.nodes)
                # the timing of a short chunk is inaccurate, so the next chunk is at most 8 times as long
                chunk = int(np.clip(clock.steps_in(CHUNK_SECONDS, run.nodes), 1, min(run.longest, 8 * done)))
                if bar is not None:
                    run.show(bar)
        except KeyboardInterrupt as interrupt:  # a second Ctrl-C, or a custom handler
            clock.interrupted = True
            status = _status_interrupted(run, clock, interrupt)
        except Exception as error:
            run.keep(error)
            raise
        else:
            if journal is not None:
                journal.leave(run, status)
    return status


def _status_interrupted(run: Run, clock: Clock, interrupt: KeyboardInterrupt) -> Status:
    """The status of a run that Ctrl-C stopped, which may happen at any moment.

    Raises:
      KeyboardInterrupt: it came between a step, which takes over the memory of the state, and the new state.
    """
    try:
        return run.between(Status.INTERRUPTED, clock)
    except Exception as error:
        raise interrupt from error


def _suggest_cache(clock: Clock) -> None:
    """On the progress line, while a program is compiled, suggest ``keep_compiled``."""
    if clock.tell is not None and setting("jax_compilation_cache_dir") is None:
        clock.tell(f"{clock.phase} (hjb.keep_compiled() keeps compiled programs for later runs)")


def _stop_status(run: Run, clock: Clock) -> Status:
    """The status that forbids another chunk, else RUNNING; a step that would exceed the time limit is not started."""
    status = clock.over()
    # one step on a large grid may take minutes and cannot be interrupted
    if status is None and clock.per_node is not None:
        late = clock.steps_in(clock.seconds - clock.elapsed(), run.nodes) < 1
        status = None if clock.least_of_all(int(not late)) else Status.TIME_LIMIT
    # if the requested steps are done this takes precedence over a time limit, but not over Ctrl-C
    if run.steps >= run.limit and status is not Status.INTERRUPTED:
        return Status.MAX_STEPS
    return Status.RUNNING if status is None else status


@contextlib.contextmanager
def announce(clock: Clock) -> Iterator[None]:
    """Context in which a terminal shows each phase of a run as it begins, above the bar of its steps."""
    with progress_bar(clock.progress, {"bar_format": "{desc}", "desc": clock.phase, "delay": 0}) as line:
        clock.tell = None if line is None else line.set_description_str
        try:
            yield
        finally:
            clock.tell = None


@contextlib.contextmanager
def progress_bar(progress: bool | None, options: dict[str, Any]) -> Iterator[Any]:
    """A progress bar on a terminal, after one second if ``options`` name no other delay; None elsewhere.

    If standard error is missing, closed or full, the bar is not shown and the run continues.
    """
    if not (progress or (progress is None and streams.is_terminal(sys.stderr))):
        yield None
        return
    from tqdm import tqdm

    # tqdm writes nothing to a terminal that does not report its size, such as that of `script` and of some editors
    size = shutil.get_terminal_size()
    shown = {"file": streams.Expendable(sys.stderr), "ncols": size.columns, "nrows": size.lines}
    try:
        bar = tqdm(**{"delay": 1, "leave": False, **shown, **options})
    except Exception:  # tqdm compares the stream with standard error, whose attributes may raise anything
        yield None
        return
    with bar:
        yield bar


def keep(error: Exception, grid: Grid, *values: Callable[[], Nodes]) -> None:
    """Attach to an exception the first of several node values that can still be read after a failure."""
    failed: Any = error
    for value in values:
        # a donated buffer, or one that depends on the failed program, raises when it is read
        with contextlib.suppress(Exception):
            failed.kept = np.asarray(value()), grid
            return


@contextlib.contextmanager
def with_solution(clock: Clock, needed: int, partial: Callable[[Kept | None], Solution | None]) -> Iterator[None]:
    """Attach the solution so far to exceptions of the runtime.

    Args:
      clock: the progress of the run.
      needed: the estimate of its memory, in bytes.
      partial: a function from the result of ``keep``, or None, to the solution so far.

    Raises:
      MemoryError: memory ran out.
    """
    try:
        yield
    except Exception as error:
        starved = memory.is_exhausted(error)
        # the package's own errors are complete, and have no value to attach
        if not (starved or isinstance(error, jax.errors.JaxRuntimeError) or CALLBACK in str(error)):
            raise
        solution = getattr(error, "solution", None)
        if solution is None:
            with contextlib.suppress(MemoryError):  # there may not be enough memory even for this
                solution = partial(getattr(error, "kept", None))
        where = f"It stopped during {clock.phase}; the value so far is .solution of this exception."
        if starved:
            raise _memory_error(error, needed, where, solution) from error
        attach_solution(error, solution)
        error.add_note(where)
        raise


def _memory_error(error: Exception, needed: int, where: str, solution: Solution | None) -> MemoryError:
    """The error for exhausted memory: needed memory, free memory, and the solution so far."""
    # the first line only: the runtime may append a list of all its buffers
    free, said = memory.available(), (str(error).strip() or type(error).__name__).splitlines()[0][:200]
    left = "" if free is None else f", {free / 1e9:.3g} GB are free now"
    report = MemoryError(
        f"memory ran out: {said}\nThe run was estimated at {needed / 1e9:.3g} GB{left}. Use fewer nodes or "
        f"dtype='float32'; {memory.NO_GRID}.\n{where}"
    )
    attach_solution(report, solution)
    return report


def settings() -> Callable[[], contextlib.AbstractContextManager[None]]:
    """A factory of contexts in which another thread uses this thread's JAX settings and device."""
    x64, device = setting("jax_enable_x64"), setting("jax_default_device")

    @contextlib.contextmanager
    def entered() -> Iterator[None]:
        with own_settings(x64=x64), jax.default_device(device):
            yield

    return entered


def setting(name: str) -> Any:
    """A setting of JAX in this thread."""
    return getattr(jax.config, name)
