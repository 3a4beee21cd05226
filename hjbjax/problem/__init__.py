"""The question: what is asked, and on which nodes.

Read ``problem`` and ``sets`` first, then ``grid`` with ``stretching``. ``arguments`` refuses what makes no sense;
``pytree`` makes dataclasses that JAX looks through. ``parts`` is about grids that are divided over many devices.
"""
