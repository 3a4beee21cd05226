"""The semi-Lagrangian scheme: paths across many cells instead of differences between neighbours.

Read ``scheme`` for the arcs that are tried and the problems it supports, and ``arcs`` for their paths and costs.
``arc_iteration`` is value and policy iteration on arcs, and ``arc_adjoint`` differentiates its fixed point.
"""
