"""One solve by many processes, and over many devices: what ``hjbjax launch`` and ``hjbjax solve --devices`` do.

Every process runs the same command; the environment says which of them it is. They find each other by
``jax.distributed``, and what they exchange goes by gloo on processors. All come to the same answer; the first one
writes it. One that dies takes the others along within the heartbeat: ``launch`` says which it was, and how to go on.
"""

import contextlib
import difflib
import math
import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TextIO

from hjbjax.cli.command_line import Failure

if TYPE_CHECKING:
    from jax.sharding import Mesh

RANK, PROCESSES, COORDINATOR, HEARTBEAT = (
    f"HJBJAX_{word}" for word in ("RANK", "PROCESSES", "COORDINATOR", "HEARTBEAT")
)
SAID = (0, 2, 3, 4, 5, 6, 130)  # exit codes of a command that said why
DIED, INTERRUPTED = 7, 130  # ours where one did not, and where that was asked for
MOST = 256  # devices of a process, each of which takes threads
GRACE = 15.0  # seconds beyond the heartbeat after which what is left is ended


def rank() -> int:
    """The number of this process among those of a launch; 0 without one."""
    return int(os.environ.get(RANK, "0"))


def mesh_of(counts: tuple[int, ...] | None) -> "Mesh | None":
    """The mesh of so many devices along each axis, or of one of every process; None for one device.

    Joins the other processes of a launch. To be called before JAX computes anything: then the devices of a processor
    are made.
    """
    processes = int(os.environ.get(PROCESSES, "1"))
    if counts is None and processes == 1:
        return None
    import jax
    import numpy as np
    from jax.sharding import Mesh

    counts = counts or (processes,)
    wanted = math.prod(counts)
    if wanted % processes:
        raise Failure(f"--devices: {wanted} devices cannot be the same number in each of {processes} processes")
    if wanted > MOST * processes:
        raise Failure(f"--devices: {wanted} devices were asked for; of a process {MOST} are the most")
    # once JAX has computed something the devices are those that there are
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", wanted // processes)
    if processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(
            os.environ[COORDINATOR], processes, rank(), heartbeat_timeout_seconds=int(os.environ[HEARTBEAT])
        )
    devices = jax.devices()
    if len(devices) < wanted:
        raise Failure(f"--devices: {wanted} devices were asked for, and {len(devices)} are there")
    return Mesh(np.array(devices[:wanted]).reshape(counts), tuple(f"axis{k}" for k in range(len(counts))))


def leave() -> None:
    """Wait for the other processes of a launch: one that ended before them would count as dead."""
    if PROCESSES in os.environ:
        import jax

        jax.distributed.shutdown()


def start(words: Sequence[str], processes: int, heartbeat: int) -> int:
    """Run a command of ``hjbjax`` in so many processes on this host; its exit code.

    Args:
      words: the command, as in ``("solve", "pendulum")``.
      processes: how many.
      heartbeat: seconds without a sign of life after which a process counts as dead.

    Raises:
      Failure: another command, or a process that died.
    """
    if words[0].startswith("-"):
        near = difflib.get_close_matches(words[0], ("--processes", "--heartbeat"), 1)
        raise Failure(f"launch: no such option {words[0]!r}{f'; did you mean {near[0]!r}?' if near else ''}")
    if words[0] != "solve":
        raise Failure(f"launch: got {words[0]!r}, wanted solve, which alone divides its nodes")
    common = {PROCESSES: str(processes), COORDINATOR: f"127.0.0.1:{_free_port()}", HEARTBEAT: str(heartbeat)}
    command, quiet = [sys.executable, "-m", "hjbjax", *words], threading.Event()
    running = []
    for number in range(processes):
        # the first one speaks; sessions of their own, so that Ctrl-C comes once, by way of this process
        said = subprocess.PIPE if number == 0 else subprocess.DEVNULL
        options: Any = {"stdout": said, "stderr": said, "text": True, "errors": "replace", "start_new_session": True}
        environment = {**os.environ, **common, RANK: str(number)}
        running.append(subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, **options))
    voices = [
        threading.Thread(target=_pass_on, args=(stream, out, quiet), daemon=True)
        for stream, out in ((running[0].stdout, sys.stdout), (running[0].stderr, sys.stderr))
    ]
    for voice in voices:
        voice.start()
    dead = _watch(running, heartbeat, quiet)
    for voice in voices:
        voice.join(timeout=GRACE)
    if dead is None:  # what the first one says holds for all
        return running[0].returncode if running[0].returncode in SAID else INTERRUPTED
    number, since = dead
    raise Failure(_obituary(number, running[number].returncode, since, words, processes), DIED)


def _watch(running: list[subprocess.Popen], heartbeat: int, quiet: threading.Event) -> tuple[int, float] | None:
    """The first process that died, if one did, and for how long the others lived on; returns when all have ended."""
    dead: int | None = None
    asked, began = False, time.monotonic()
    while any(process.poll() is None for process in running):
        try:
            if dead is None and not asked:
                dead, began = _died(running), time.monotonic()
                if dead is not None:
                    quiet.set()  # the others end in many lines, which do not say more
            if dead is not None and time.monotonic() - began > heartbeat + GRACE:
                for process in running:
                    process.kill()
            time.sleep(0.05)
        except KeyboardInterrupt:  # they keep what they have, and end by themselves; one may be at its pictures
            asked = True
            for process in running:
                process.send_signal(signal.SIGTERM)
    dead = _died(running) if dead is None and not asked else dead  # the last one to end
    return None if dead is None else (dead, time.monotonic() - began)


def _died(running: list[subprocess.Popen]) -> int | None:
    """The number of a process that ended without saying why, as one that was killed; None where there is none."""
    return next((number for number, each in enumerate(running) if each.poll() not in (None, *SAID)), None)


def _obituary(number: int, code: int, seconds: float, words: Sequence[str], processes: int) -> str:
    """The process that died, and how to go on."""
    how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
    died = f"process {number} of {processes} {how}, and the others {seconds:.0f} s later"
    if not any(word.split("=")[0] == "--checkpoint" for word in words):
        return f"{died}; with --checkpoint FILE a run can be resumed"
    again = [*words, *([] if "--resume" in words else ["--resume"])]
    return f"{died}; go on with: hjbjax launch --processes {processes} -- {shlex.join(again)}"


def _free_port() -> int:
    """A port of this host that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _pass_on(stream: TextIO, out: TextIO, quiet: threading.Event) -> None:
    """Pass on the lines of the first process, but for gloo's greetings, and for what it says when others have died."""
    for line in stream:
        if not quiet.is_set() and not line.startswith("[Gloo]"):
            out.write(line)
            out.flush()
