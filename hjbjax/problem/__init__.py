"""The question: what is asked, and on which nodes.

Read ``problem`` and ``sets`` first, then ``grid`` with ``stretching``. ``arguments`` and ``grid_arguments`` refuse what
makes no sense; ``pytree`` makes dataclasses that JAX looks through.
"""
