"""The command ``hjbjax``, also as ``python -m hjbjax``. This file does what must precede all other imports."""

import os
import sys


def start() -> None:
    """Run the command and end the process with its exit code."""
    if sys.flags.inspect and os.environ.pop("PYTHONINSPECT", "") and os.name == "posix":
        # Python would end in a prompt, with exit code 1; it has read the variable, so it must start again
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    try:
        from hjbjax.cli import interrupts

        interrupts.end_at_once()
    except KeyboardInterrupt:  # in these few milliseconds
        os._exit(130)
    # 2>&- leaves descriptor 2 free, and the next file that is opened would receive what XLA writes to standard error
    while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(handle)
    from hjbjax.cli.main import main

    main(prog_name="hjbjax")


if __name__ == "__main__":
    start()
