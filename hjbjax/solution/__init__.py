"""Solutions, and the ways in which a run may end.

Read ``solution`` and ``status`` first. ``clock`` has the limits of a run and handles Ctrl-C. ``interpolation``
evaluates values between nodes. ``screen`` formats what is printed, ``files`` defines the file format, and ``placement``
moves a file to its path. ``checkpoints`` stores the state of an interrupted run. ``rewards`` gives solutions the sign
of rewards.
"""
