"""The Hamiltonian at a node, and its min-max over the admissible sets, by exact formulas or by samples.

Read ``discrete`` first. ``exact`` finds exact optima by ``piecewise``, ``ball`` or ``quadratic_program``, ``search``
has the searches, and ``pointwise`` the minimum at one state for Pontryagin's equations.
"""
