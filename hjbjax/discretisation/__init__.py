"""Differences: from a problem and a grid to what a scheme makes of them at the nodes.

Read ``schemes`` for what there is to choose, ``stencil`` and ``slopes`` for differences, ``cut_cells`` for targets
between nodes, ``rates`` and ``edges`` for the Markov chain and what it does at the ends of the box, ``semi_lagrangian``
and ``arcs`` for paths of many cells; ``correlated_noise`` says which correlated noise fits the spacings.
"""
