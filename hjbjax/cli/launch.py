"""One solve in several processes or on several devices, for ``hjbjax launch`` and ``hjbjax solve --devices``.

Every process runs the same command and reads its rank from the environment. The processes find each other through
``jax.distributed`` and exchange values through gloo on CPUs. All of them compute the same result, and the first one
writes it. ``hjbjax.cli.children`` starts and ends the processes and reports how they ended.
"""

import contextlib
import dataclasses
import difflib
import errno
import math
import os
import shlex
import signal
import socket
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hjbjax.cli import children
from hjbjax.cli.command_line import Failure, finite, starting_jax
from hjbjax.problem import streams

if TYPE_CHECKING:
    from jax.sharding import Mesh

VARIABLES = RANK, PROCESSES, COORDINATOR, HEARTBEAT = (
    "HJBJAX_RANK", "HJBJAX_PROCESSES", "HJBJAX_COORDINATOR", "HJBJAX_HEARTBEAT",
)  # fmt: skip
EXPLAINED = (2, 3, 4, 5, 6, 130)  # exit codes of a command that has printed its reason
SOLVED = (0, 3)  # exit codes of a command that all processes have finished
DIED, INTERRUPTED = 7, 130  # exit codes of a launch
MOST = 256  # maximal number of processes per launch and of devices per process, because each takes threads
LONGEST = 86_400  # seconds of a heartbeat
_ADVICE = "'hjbjax launch' sets these variables; unset all of them to solve in one process"
WITHOUT_PROXY = {"no_grpc_proxy": "127.0.0.1"}  # otherwise gRPC uses a proxy even for processes of this host
ARRIVED = "hjbjax: arrived"  # printed by a process that has imported everything
ARRIVAL = 120.0  # seconds for the imports; one more per process, because the imports share the processors
FAREWELL = "hjbjax: parted"  # printed by a process that the others no longer need
GREETING = (b"[Gloo]", b"connected peer ranks")  # in messages of gloo, which several threads may mix in one line


# --- in each process ---


@dataclasses.dataclass(frozen=True)
class Member:
    """A process of a launch.

    Args:
      rank: its number, from 0.
      processes: the number of processes.
      coordinator: host and port at which they meet.
      heartbeat: seconds without a sign of life after which a process counts as dead.
    """

    rank: int
    processes: int
    coordinator: str
    heartbeat: int


def member() -> Member | None:
    """This process as a member of a launch according to its environment; None outside a launch.

    Raises:
      Failure: a variable is missing or has an unusable value.
    """
    if not any(name in os.environ for name in VARIABLES):
        return None
    if missing := [name for name in VARIABLES if name not in os.environ]:
        known = ", ".join(name for name in VARIABLES if name in os.environ)
        raise Failure(f"{missing[0]} is not set, but {known} is; {_ADVICE}")
    processes = _count(PROCESSES, 1, MOST)
    host, _, text = os.environ[COORDINATOR].rpartition(":")
    port = finite(text, int) or 0
    if not host or not 0 < port < 2**16:
        raise Failure(f"{COORDINATOR}: got {os.environ[COORDINATOR]!r}, wanted HOST:PORT; {_ADVICE}")
    # the number, because other programs do not read every text that Python reads, such as 4_000
    return Member(_count(RANK, 0, processes - 1), processes, f"{host}:{port}", _count(HEARTBEAT, 1, LONGEST))


def _count(name: str, least: int, most: int) -> int:
    """The whole number in a variable of the environment."""
    number = finite(os.environ[name], int)
    if number is None or not least <= number <= most:
        wanted = f"a whole number from {least} to {most}" if most > least else str(least)
        raise Failure(f"{name}: got {os.environ[name]!r}, wanted {wanted}; {_ADVICE}")
    return number


def rank() -> int:
    """The number of this process in a launch; 0 outside a launch."""
    this = member()
    return 0 if this is None else this.rank


def check_devices(counts: tuple[int, ...] | None, processes: int) -> None:
    """Raise if the processes cannot have these numbers of devices along the axes.

    Raises:
      Failure: the devices are too many, or not the same number in each process.
    """
    wanted = processes if counts is None else math.prod(counts)
    if wanted % processes:
        raise Failure(f"--devices: {wanted} devices cannot be the same number in each of {processes} processes")
    if wanted > MOST * processes:
        raise Failure(f"--devices: got {wanted} devices, wanted at most {MOST} per process")


def mesh_of(counts: tuple[int, ...] | None) -> "Mesh | None":
    """The mesh with ``counts`` devices along its axes; by default one device per process, and None for one process.

    It joins the other processes of a launch. Call it before JAX computes anything, because the number of CPU devices is
    fixed afterwards.

    Raises:
      Failure: there are not enough devices, or the processes cannot meet.
    """
    this = member()
    processes = 1 if this is None else this.processes
    if counts is None and processes == 1:
        return None
    import jax
    import numpy as np
    from jax.sharding import Mesh

    counts = counts or (processes,)
    check_devices(counts, processes)
    wanted = math.prod(counts)
    # JAX refuses a new number of devices after its first computation
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", wanted // processes)
    if this is not None and processes > 1:
        _join(this)
    with starting_jax():
        devices = jax.devices()
    if len(devices) < wanted:
        raise Failure(f"--devices: got {wanted} devices, but only {len(devices)} are available")
    return Mesh(np.array(devices[:wanted]).reshape(counts), tuple(f"axis{k}" for k in range(len(counts))))


def arrive() -> None:
    """Report the start of this process to its launcher, if any; otherwise JAX would blame a process that waits."""
    if member() is not None:
        _report(ARRIVED)


def _report(words: str) -> None:
    """Write a line that the launcher reads."""
    out = streams.Expendable(sys.stdout)
    out.write(f"{words}\n")
    out.flush()


def _join(this: Member) -> None:
    """Meet the other processes of a launch."""
    import jax

    address = _address_of(this.coordinator)
    try:
        if this.rank == 0:
            _check_port(*address)  # JAX's own error does not name the port
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        # JAX's handler of SIGTERM would swallow a request to end that comes before the solve
        jax.config.update("jax_enable_preemption_service", False)
        jax.config.update("jax_check_proxy_envs", False)  # disable a warning, see WITHOUT_PROXY
        jax.distributed.initialize(
            this.coordinator,
            this.processes,
            this.rank,
            initialization_timeout=round(ARRIVAL) + this.processes,  # as in the launcher; JAX waits for five minutes
            heartbeat_timeout_seconds=this.heartbeat,
            coordinator_bind_address=this.coordinator,  # the default accepts connections from the whole network
        )
    except (OSError, jax.errors.JaxRuntimeError) as error:
        why = getattr(error, "strerror", None) or error
        raise Failure(
            f"process {this.rank} of {this.processes} could not meet the others at {this.coordinator}: {why}; "
            f"{_WITHOUT_ADDRESS.get(getattr(error, 'errno', 0), _TAKEN)}"
        ) from error


_TAKEN = "another program may use the port: start the command again"
_WITHOUT_ADDRESS = {  # advice if process 0 cannot have the address, by the error of the system
    errno.EADDRNOTAVAIL: f"process 0 must run on the host in {COORDINATOR}",
    errno.EACCES: f"choose another port in {COORDINATOR}",
}


def _address_of(coordinator: str) -> tuple[socket.AddressFamily, Any]:
    """The family and the address of the coordinator's socket.

    Raises:
      Failure: the name of its host cannot be resolved, for which JAX would wait for five minutes.
    """
    host, _, port = coordinator.rpartition(":")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)  # brackets: an IPv6 address
    except (OSError, UnicodeError) as error:  # UnicodeError: an empty label, or one that is too long
        why = getattr(error, "strerror", None) or error
        raise Failure(
            f"{COORDINATOR}: got {coordinator!r}, but the host {host!r} is unknown: {why}; {_ADVICE}"
        ) from error
    return found[0][0], found[0][4]


def _check_port(family: socket.AddressFamily, address: Any) -> None:
    """Raise OSError if the port of the coordinator is not available."""
    with _shared_socket(family) as probe:
        probe.bind(address)


def leave() -> None:
    """Leave the launch after the solve; the other processes would regard a process that just ends as dead."""
    this = member()
    if this is None:
        return
    import jax

    jax.distributed.shutdown()
    if this.rank > 0:  # the first process continues and prints for all
        _report(FAREWELL)


# --- in the launcher ---


def check_launch(words: Sequence[str], processes: int, heartbeat: int) -> None:
    """Raise if the command or a number cannot be launched.

    Raises:
      Failure: the command is not ``solve``, or a number is too large.
    """
    if words[0].startswith("-"):
        near = difflib.get_close_matches(words[0], ("--processes", "--heartbeat"), 1)
        raise Failure(f"launch: no such option {words[0]!r}{f'; did you mean {near[0]!r}?' if near else ''}")
    if words[0] != "solve":
        raise Failure(f"launch: got {words[0]!r}, wanted solve, the only command that can split its nodes")
    for option, number, most in (("--processes", processes, MOST), ("--heartbeat", heartbeat, LONGEST)):
        if number > most:
            raise Failure(f"launch: got {option} {number}, wanted at most {most}")


@contextlib.contextmanager
def without_accelerators() -> Iterator[None]:
    """Context in which JAX, unless it has started, starts on the processor only.

    The launcher checks arguments, and would otherwise take the memory of the accelerators that its processes need.
    """
    import jax

    usual = jax.config.values["jax_platforms"]
    jax.config.update("jax_platforms", "cpu")
    try:
        yield
    finally:
        jax.config.update("jax_platforms", usual)


def start_processes(words: Sequence[str], processes: int, heartbeat: int, result: Path) -> int:
    """Run a command of ``hjbjax`` in several processes on this host, and return its exit code.

    Args:
      words: the command, as in ``("solve", "pendulum")``.
      processes: the number of processes.
      heartbeat: seconds without a sign of life after which a process counts as dead.
      result: the file that the command writes.

    Raises:
      Failure: a process died, did not end on request, or could not be started.
      OSError: the output of the first process could not be written.
    """
    try:
        with reserved_port() as port:
            shared = {
                PROCESSES: str(processes),
                COORDINATOR: f"127.0.0.1:{port}",
                HEARTBEAT: str(heartbeat),
                **WITHOUT_PROXY,
            }
            commands = [
                children.followed("hjbjax", words, {**os.environ, **shared, RANK: str(number)})
                for number in range(processes)
            ]
            arrival = (ARRIVED.encode(), ARRIVAL + processes)
            # less than the heartbeat, so that the others can save their work even if the stopped one continues
            outcome = children.run_children(commands, EXPLAINED, GREETING, heartbeat / 2, FAREWELL.encode(), arrival)
    except (OSError, RuntimeError) as error:  # RuntimeError: no thread can be started
        why = getattr(error, "strerror", None) or error
        raise Failure(f"launch: {processes} processes could not be started: {why}", DIED) from error
    code = _verdict(outcome, _way_on(words, processes, result))
    if outcome.unwritten is not None:
        raise outcome.unwritten
    return code


def _verdict(outcome: children.ChildEnds, way_on: str) -> int:
    """The exit code of a launch.

    Raises:
      Failure: names the process that made the others fail, and says how to continue.
    """
    processes, first, culprit = len(outcome.ends), outcome.end_of(0), outcome.culprit
    if first.code in SOLVED or culprit is None:
        return first.code
    if outcome.interrupted:
        # the first process has saved everything, so the others do not matter
        if first.code == INTERRUPTED or (first.code in EXPLAINED and not outcome.killed):
            return first.code
        killed = f"; {_killed(outcome)}; {way_on}" if outcome.killed else ""
        raise Failure(f"interrupted{killed}", INTERRUPTED)
    name = f"process {culprit.number} of {processes}"
    if culprit.early:
        raise Failure(f"{name} ended with exit code 0 before the others were done; {way_on}", DIED)
    if culprit.number in outcome.stopped:
        raise Failure(f"{name} was stopped, and the others cannot go on without it; {way_on}", DIED)
    if culprit.number in outcome.late:
        raise Failure(f"{name} did not start within {ARRIVAL + processes:.0f} s; {way_on}", DIED)
    if culprit.code < 0:
        names = {each.value: f" ({each.name})" for each in signal.Signals}  # real-time signals have none
        by = f"signal {-culprit.code}{names.get(-culprit.code, '')}"
        raise Failure(f"{name} was ended by {by}; {way_on}", DIED)
    if culprit.code not in EXPLAINED:
        said = f": {culprit.words}" if culprit.words else ""
        raise Failure(f"{name} ended with exit code {culprit.code}{said}; {way_on}", DIED)
    if culprit.code == first.code:
        return first.code  # the first process has printed the reason
    raise Failure(f"{name}: {culprit.words.removeprefix('hjbjax: ')}", culprit.code)


def _killed(outcome: children.ChildEnds) -> str:
    """Describe which processes were killed, and why."""
    numbers = [number for number in outcome.killed if number in outcome.stopped] or outcome.killed
    which, were = ("process", "was") if len(numbers) == 1 else ("processes", "were")
    name = f"{which} {', '.join(map(str, numbers))} of {len(outcome.ends)} {were} killed"
    return f"{name} by the second signal" if outcome.hurried else f"{name}, not having ended in {children.GRACE:.0f} s"


def _way_on(words: Sequence[str], processes: int, result: Path) -> str:
    """The command that resumes a run, or the advice to use a checkpoint."""
    if not any(word.split("=")[0] == "--checkpoint" for word in words):
        return "with --checkpoint FILE a run can be resumed"
    wanted = ["--resume", *(["--force"] if os.path.lexists(result) else [])]
    again = shlex.join([*words, *(word for word in wanted if word not in words)])
    return f"go on with: hjbjax launch --processes {processes} -- {again}"


@contextlib.contextmanager
def reserved_port() -> Iterator[int]:
    """Context with a free port of this host that no other program gets; the coordinator shares it.

    If the system cannot share ports, the port is released at once.

    Raises:
      OSError: there is no free port.
    """
    with _shared_socket() as keeper:
        keeper.bind(("127.0.0.1", 0))
        port = keeper.getsockname()[1]
        if not _CAN_SHARE:
            keeper.close()
        yield port


_CAN_SHARE = hasattr(socket, "SO_REUSEPORT")


def _shared_socket(family: socket.AddressFamily = socket.AF_INET) -> socket.socket:
    """A socket whose port other sockets of this user may share if all of them request it, as gRPC does."""
    made = socket.socket(family)
    if _CAN_SHARE:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    return made
