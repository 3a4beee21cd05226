"""Steps, pure and jittable: from a value to a better one, and what bounds its error.

Read ``bellman`` for one step and its linear equation, ``relaxation`` with ``wavefront`` for how that is solved,
``iteration`` for value and policy iteration, ``certificates`` for bounds, ``marching``, ``implicit`` and ``splitting``
for steps in time, and ``sensitivity`` for derivatives of a fixed point.
"""
