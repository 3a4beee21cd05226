"""The public functions ``solve``, ``solve_batch`` and ``march``, which run on the host.

Read ``stationary``, ``batch`` and ``finite_horizon`` first. ``setup`` builds the task and chooses the method.
``host_loop`` drives all of them in chunks of steps, which ``stationary_run``, ``march_run`` and ``batch`` define.
``coarse_levels`` solves on coarse grids first, ``semi_lagrangian`` solves on arcs, and ``result`` builds the solution.
``nested_grids`` transfers values from one grid to another, and ``grid_error`` estimates the error from two grids.
``memory`` checks that there is room, ``resources`` estimates memory and time, and ``compile_cache`` stores programs.
"""
