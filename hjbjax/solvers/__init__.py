"""The front doors ``solve``, ``solve_batch`` and ``march``, which run on the host.

Read ``solver``, ``batch`` and ``horizon`` first. ``preparation`` makes the task and chooses the method, ``memory`` and
``faults`` say what a run needs and what breaks it, ``driver`` and ``epochs`` are the host's loops, ``nested`` and
``transfer`` go from coarse grids to fine ones, and ``report`` makes the solution.
"""
