"""The answer, and how a run may end: solution, status, clock; on the screen, in files, and between the nodes.

Read ``solution`` and ``status`` first. ``clock`` holds the limits of a run and Ctrl-C, ``interpolation`` values between
nodes and ``nested_grids`` those of one grid on another, with an estimate of how far they are from the exact ones,
``screen`` what is printed, ``files`` the format and ``placement`` how a file gets to its place. ``checkpoints`` keeps
what a run had done when it was cut.
"""
