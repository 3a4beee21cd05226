"""The public functions ``solve``, ``solve_batch`` and ``march``, which run on the host.

Read ``stationary``, ``batch`` and ``finite_horizon`` first. ``setup`` builds the task and chooses the method.
``host_loop`` drives all of them in chunks of steps, which ``stationary_run``, ``march_run`` and ``batch`` define.
``nested`` solves on coarse grids first, ``semi_lagrangian`` solves on arcs, and ``result`` builds the solution.
"""
