"""Discretisation of a problem on a grid: finite differences and Markov chains.

Read ``discretisation`` for a problem on a grid, ``schemes`` for the available schemes, ``stencil`` and ``slopes`` for
differences, ``players`` for the dependence of H on each player, ``cut_cells`` for targets between nodes, ``rates`` and
``edges`` for the Markov chain and its behaviour at the ends of the box. ``paths`` is the base class of schemes' paths
across many cells. ``correlated_noise`` checks correlated noise against the spacings. ``posing`` decorates public
functions whose problems may have bounds or discounts that depend on the state.
"""
