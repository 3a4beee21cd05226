"""Discretisation of a problem on a grid: finite differences and Markov chains.

Read ``schemes`` for the available schemes, ``stencil`` and ``slopes`` for differences, ``cut_cells`` for targets
between nodes, ``rates`` and ``edges`` for the Markov chain and its behaviour at the ends of the box,
``semi_lagrangian`` and ``arcs`` for paths across many cells. ``correlated_noise`` checks correlated noise against the
spacings."""
