"""The host's loop around jitted steps, which ``solve``, ``march`` and ``solve_batch`` share, and what breaks it.

A ``Run`` goes on in chunks of steps of about half a second, since every call takes its memory anew. Progress, Ctrl-C,
time limits and stops at NaN all live between two chunks; how long a chunk is changes no bit of the answer. A first call
of no steps compiles, so that the others can be timed.

Memory that runs out on the way and callbacks of the user's that raise leave with what was there before them as
``.solution``; an exception for memory becomes a ``MemoryError`` that says what was needed and what is free.
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

from hjbjax.markov_chain import memory
from hjbjax.problem import streams
from hjbjax.problem.grid import Grid
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Nodes
from hjbjax.solution.checkpoints import Part
from hjbjax.solution.clock import CHUNK_SECONDS, Clock
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status

FIRST_NODES = 20_000  # a first chunk steps over about so many nodes
CALLBACK = "CpuCallback error"  # how JAX heads the exception of a callback, whatever its type
# bits, half of which are XLA's own choice: solves take a tenth less time where the processor has AVX-512, sweeps over
# enumerated controls a quarter less; on others it changes nothing
WIDTH = {"xla_cpu_prefer_vector_width": 512}

Kept: TypeAlias = tuple[np.ndarray, Grid]  # node values that outlived an exception, and their grid


class WideJit:
    """``jax.jit`` of a loop of steps at host level, with the widest vectors that a CPU has.

    Args:
      function: the loop.
      options: of ``jax.jit``.
    """

    def __init__(self, function: Callable[..., Any], **options: Any):
        functools.update_wrapper(self, function)
        self._jit = functools.partial(jax.jit, function, **options)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """The loop's answer, compiled at the first call."""
        return self._jitted(*arguments, **options)

    def lower(self, *arguments: Any, **options: Any) -> Any:
        """The program for such arguments, of which shapes will do, before it is compiled."""
        return self._jitted.lower(*arguments, **options)

    @functools.cached_property
    def _jitted(self) -> Any:
        return self._jit(compiler_options=_known_width())


@functools.cache
def _known_width() -> dict[str, Any]:
    """``WIDTH``, or nothing where XLA no longer knows the option."""
    try:
        jax.jit(lambda: 0, compiler_options=WIDTH)()
    except jax.errors.JaxRuntimeError:
        return {}
    return WIDTH


class Run(Part, Protocol):
    """A computation in steps, as the loop drives it."""

    @property
    def name(self) -> str:
        """Its nodes, in words."""

    @property
    def nodes(self) -> int:
        """The nodes that a step passes over, by which its pace is told."""

    @property
    def steps(self) -> int:
        """The steps that are done; a first look at a guess is step 0, and −1 is before it."""

    @property
    def limit(self) -> float:
        """No more steps than these; infinite where it ends by itself."""

    @property
    def longest(self) -> int:
        """The most steps of a chunk."""

    @property
    def bar(self) -> dict[str, Any]:
        """The options of its progress bar."""

    def compile(self) -> None:
        """Call the jitted steps for none of them."""

    def first_chunk(self, clock: Clock) -> int:
        """The number of steps of the first chunk, before any is timed; none is a look alone."""

    def advance(self, count: int) -> Status:
        """Take ``count`` steps at most, and say how it stands; returns when they are done."""

    def between(self, status: Status, clock: Clock) -> Status:
        """Keep what is to be kept between two chunks, and before the first; the status with which to go on."""

    def show(self, bar: Any) -> None:
        """Move the progress bar."""

    def keep(self, error: Exception) -> None:
        """Attach what was there before an exception to it."""


def drive(run: Run, clock: Clock) -> Status:
    """Drive a run in chunks of steps until it stops, the steps or the time run out, or Ctrl-C; its last status."""
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
                clock.count(time.perf_counter() - began, max(run.steps - before, 1), run.nodes)
                # a short chunk is timed badly, hence the 8
                steps = clock.steps_in(CHUNK_SECONDS, run.nodes)
                chunk = int(np.clip(steps, 1, min(run.longest, 8 * max(chunk, 1))))
                if bar is not None:
                    run.show(bar)
        except KeyboardInterrupt:  # the second one, or by a handler of the user's own
            clock.interrupted = True
            status = run.between(Status.INTERRUPTED, clock)
        except Exception as error:
            run.keep(error)
            raise
        else:
            if journal is not None:
                journal.leave(run, status)
    return status


def _suggest_cache(clock: Clock) -> None:
    """Say on the progress line, while a program is compiled, how later processes are spared that."""
    if clock.tell is not None and setting("jax_compilation_cache_dir") is None:
        clock.tell(f"{clock.phase} (hjb.keep_compiled() keeps compiled programs for later runs)")


def _stop_status(run: Run, clock: Clock) -> Status:
    """The status that forbids another chunk, else RUNNING; a step that the last pace makes too late is not begun."""
    status = clock.over()
    # one step on a large grid may take minutes, and nothing can cut it
    if status is None and clock.per_node is not None:
        late = clock.steps_in(clock.seconds - clock.elapsed(), run.nodes) < 1
        status = None if clock.least_of_all(int(not late)) else Status.TIME_LIMIT
    # the steps that were asked for are done: that comes before a time limit, but not before Ctrl-C
    if run.steps >= run.limit and status is not Status.INTERRUPTED:
        return Status.MAX_STEPS
    return Status.RUNNING if status is None else status


@contextlib.contextmanager
def telling(clock: Clock) -> Iterator[None]:
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

    Standard error may be missing, closed or full: then the bar is not shown, and the run does not notice.
    """
    if not (progress or (progress is None and streams.is_terminal(sys.stderr))):
        yield None
        return
    from tqdm import tqdm

    # tqdm writes nothing to a terminal that does not report its size, such as that of `script` and of some editors
    size = shutil.get_terminal_size()
    shown = {"file": streams.Expendable(sys.stderr), "ncols": size.columns, "nrows": size.lines}
    with tqdm(**{"delay": 1, "leave": False, **shown, **options}) as bar:
        yield bar


def keep(error: Exception, grid: Grid, *values: Callable[[], Nodes]) -> None:
    """Attach to an exception the first of some node values that can still be read: a broken run takes its own along."""
    for value in values:
        # a buffer that was donated, or that waits for the program that failed, raises when it is read
        with contextlib.suppress(Exception):
            error.kept = np.asarray(value()), grid  # type: ignore[attr-defined]
            return


@contextlib.contextmanager
def with_solution(clock: Clock, needed: int, partial: Callable[[Kept | None], Solution | None]) -> Iterator[None]:
    """Let exceptions of the runtime leave with the solution so far.

    Args:
      clock: how far the run came.
      needed: the estimate of its memory, in bytes.
      partial: from what ``keep`` noted, or None, to the solution so far.

    Raises:
      MemoryError: memory ran out.
    """
    try:
        yield
    except Exception as error:
        # XLA reports memory that ran out by a status in the text, NumPy by the type
        starved = isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)
        # a refusal of the package's own says all there is to say, and has no value beside it
        if not (starved or isinstance(error, jax.errors.JaxRuntimeError) or CALLBACK in str(error)):
            raise
        solution = getattr(error, "solution", None)
        if solution is None:
            with contextlib.suppress(MemoryError):  # too little is left even for that
                solution = partial(getattr(error, "kept", None))
        where = f"It came as far as {clock.phase}; the value so far is .solution of this exception."
        if starved:
            raise _memory_error(error, needed, where, solution) from error
        error.solution = solution  # type: ignore[attr-defined]
        error.add_note(where)
        raise


def _memory_error(error: Exception, needed: int, where: str, solution: Solution | None) -> MemoryError:
    """The report of memory that ran out: what was needed, what is free now, and the solution so far."""
    # the first line alone: the runtime may append a list of all its buffers
    free, said = memory.available(), (str(error).strip() or type(error).__name__).splitlines()[0][:200]
    left = "" if free is None else f", {free / 1e9:.3g} GB are free now"
    report = MemoryError(
        f"memory ran out: {said}\nThe run was estimated at {needed / 1e9:.3g} GB{left}. Take fewer nodes or "
        f"dtype='float32'; {memory.NO_GRID}.\n{where}"
    )
    report.solution = solution  # type: ignore[attr-defined]
    return report


def settings() -> Callable[[], contextlib.AbstractContextManager[None]]:
    """The context in which another thread has the package's own settings of JAX, and this thread's device."""
    x64, device = setting("jax_enable_x64"), setting("jax_default_device")

    @contextlib.contextmanager
    def entered() -> Iterator[None]:
        with own_settings(x64=x64), jax.default_device(device):
            yield

    return entered


def setting(name: str) -> Any:
    """A setting of JAX as this thread has it."""
    return getattr(jax.config, name)
