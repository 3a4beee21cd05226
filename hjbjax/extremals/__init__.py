"""Pontryagin's equations as a boundary-value problem: extremals without a grid.

Read ``indirect_method`` for ``pontryagin``, ``boundary_value`` for the equations, which ``collocation`` solves,
``initial_guess``, ``reaching_guess`` and ``equilibria`` for where it starts, ``continuation`` for its solve with arcs
between the seams of an angle (``periodic_arcs``), ``switching`` for controls that jump, ``necessary_conditions`` for
how well they are met and where the path meets the target, ``second_order`` for extremals that are no minima, and
``diagnosis`` for what to do about a failure.
"""
