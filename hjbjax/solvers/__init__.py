"""The front doors ``solve``, ``solve_batch`` and ``march``, which run on the host.

Read ``stationary``, ``batch`` and ``finite_horizon`` first. ``setup`` makes the task and chooses the method,
``memory`` and ``faults`` say what a run needs and what breaks it, ``host_loop`` and ``epochs`` are the host's loops,
``nested`` goes from coarse grids to fine ones, and ``result`` makes the solution.
"""
