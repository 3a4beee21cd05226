"""Differences and the Markov chain: from a problem and a grid to rates of jumps.

Read ``schemes`` for what there is to choose, ``stencil`` and ``slopes`` for differences, ``subcell`` for targets
between nodes, ``edges`` for the ends of the box, and ``chain`` for the rates, the generator and the exports
(``export``, ``recurrence``); ``correlation`` says which correlated noise fits the spacings.
"""
