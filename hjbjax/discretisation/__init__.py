"""Differences and the Markov chain: from a problem and a grid to rates of jumps.

Read ``schemes`` for what there is to choose, ``stencil`` and ``slopes`` for differences, ``cut_cells`` for targets
between nodes, ``edges`` for the ends of the box, and ``chain`` for the rates, the generator and the exports
(``decision_process``, ``stationary_law``); ``correlated_noise`` says which correlated noise fits the spacings.
"""
