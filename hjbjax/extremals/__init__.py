"""Pontryagin's equations as a boundary-value problem: extremals without a grid.

``indirect_method`` has ``pontryagin``; read it first, then ``boundary_value`` for the equations, which ``collocation``
solves. ``arguments`` checks the arguments. ``initial_guess`` and ``equilibria`` construct the initial guess,
``continuation`` solves from it, and ``switching`` does so for controls that jump. ``necessary_conditions`` reports how
well the conditions are met and gives advice after a failure. ``second_order`` detects extremals that are not minima.
"""
