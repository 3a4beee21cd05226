"""Pontryagin's equations as a boundary-value problem: extremals without a grid.

Read ``indirect_method`` for ``pontryagin`` (``arguments``: what it refuses), ``boundary_value`` for the equations,
which ``collocation`` solves, with arcs between the seams of an angle, ``initial_guess`` and ``equilibria`` for where it
starts, ``continuation`` for its solve, ``switching`` for controls that jump, ``necessary_conditions`` for how well they
are met, where the path meets the target and what to do about a failure, and ``second_order`` for extremals that are no
minima.
"""
