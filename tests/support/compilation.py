"""Which programs are compiled."""

import contextlib

import jax

EVENT = "/jax/core/compile/backend_compile_duration"


@contextlib.contextmanager
def compiling():
    """The names of the programs that are compiled inside this context, a list that grows."""
    programs = []

    def note(event, _, fun_name="", **__):
        if event == EVENT:
            programs.append(fun_name)

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield programs
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
