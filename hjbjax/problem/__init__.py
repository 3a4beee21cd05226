"""The problem and its grid: the input of a solve.

Read ``problem`` and ``sets`` first, then ``grid`` with ``stretching`` and ``ends``. ``arguments`` checks arguments,
``pytree`` makes dataclasses that are pytrees, and ``layouts`` divides a grid over several devices.
"""
