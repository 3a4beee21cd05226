"""The front doors ``solve``, ``solve_batch`` and ``march``, which run on the host.

Read ``stationary``, ``batch`` and ``finite_horizon`` first. ``setup`` makes the task and chooses the method,
``host_loop`` drives all of them in chunks of steps, as ``stationary_run``, ``march_run`` and ``batch`` say how;
``nested`` goes from coarse grids to fine ones, ``semi_lagrangian`` solves on arcs, and ``result`` makes the solution.
"""
