"""The problem and its grid: the input of a solve.

Read ``problem`` and ``sets`` first, then ``grid`` with ``stretching`` and ``ends``. ``arguments`` checks arguments,
``pytree`` makes dataclasses that are pytrees, and ``layouts`` divides a grid over several devices. The solvers know
costs, constant discounts and fixed sets of controls: ``rewards``, ``time_change`` and ``state_bounds`` express rewards,
discounts of the state and bounds of the state by them.
"""
