"""Pontryagin's equations as a boundary-value problem: extremals without a grid.

Read ``extremals`` for ``pontryagin``, ``two_point`` for the equations, ``first_guess`` and ``rests`` for where it
starts, ``shooting`` for its solve with arcs between the ``seams`` of an angle, ``switching`` for controls that jump,
and ``optimality`` for how well the conditions are met.
"""
