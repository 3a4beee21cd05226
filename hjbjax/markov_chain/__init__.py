"""The Markov chain as a process: where it goes, whether what it costs is finite, and its exports.

Before a solve ``node_checks`` looks at what the functions return, ``admissibility`` at constrained ends,
``attainability`` at which nodes can be brought to the target (``tried_actions``: by which actions), ``resting`` at
where the system can rest at no cost, and ``memory`` at whether there is room; after it ``earnings`` looks at costs
earned for ever. ``chain`` has the generator and what other solvers take, ``stationary_law`` where the chain stays in
the end, and ``decision_process`` the decision problem.
"""
