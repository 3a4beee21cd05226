"""Steps, pure and jittable: from a value to a better one, and what bounds its error.

Read ``bellman`` for one step and its linear equation, ``evaluation`` with ``gauss_seidel`` for how that is solved,
``methods`` for what there is to choose, ``fixed_point`` for value and policy iteration (``arc_iteration``: on arcs of
many cells), ``certificates`` for bounds, ``time_methods`` and ``time_stepping`` for steps in time, and ``adjoint`` for
derivatives of a fixed point.
"""
