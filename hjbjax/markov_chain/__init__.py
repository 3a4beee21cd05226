"""The Markov chain: rates of jumps, what they do at the ends of the box, and exports.

Read ``chain`` for the rates and the generator, ``edges`` for the ends of the box, ``stationary_law`` for where the
chain stays in the end, and ``decision_process`` for other solvers.
"""
