"""Pure, jittable iteration steps, and bounds on their errors.

Read ``bellman`` for one step and its linear equation, ``evaluation`` and ``gauss_seidel`` for the solution of that
equation, ``methods`` for the available methods, ``fixed_point`` for value and policy iteration, ``certificates`` for
bounds, ``time_methods`` and ``time_stepping`` for steps in time, and ``adjoint`` for derivatives of a fixed point.
``grid_task`` has what a solve and a march have in common.
"""
