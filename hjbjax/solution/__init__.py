"""The answer, and how a run may end: solution, status, clock; on the screen, in files, and between the nodes.

Read ``solution`` and ``status`` first. ``clock`` holds the limits of a run and Ctrl-C, ``interpolation`` values between
nodes, ``nested_grids`` carries them from one grid to another, and ``grid_error`` estimates the error from two grids.
``screen`` what is printed, ``files`` the format and ``placement`` how a file gets to its place. ``checkpoints`` keeps
what a run had done when it was cut.
"""
