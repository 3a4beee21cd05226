"""Tracing of a problem's functions of one state: evaluation on a grid, and analysis and checks before a solve.

``components`` evaluates a function on a whole grid component by component, by an ``interpreter`` with the rules of
``jaxprs`` and ``stacks``. ``dependence`` finds how a function depends on the control, ``closures`` and ``outside`` find
what it reads from outside, ``host_functions`` lets it call the host in 64 bits, ``indices`` finds indices out of range,
and ``checks`` refuses unsuitable functions.
"""
