"""The Markov chain as a process: reachability, finiteness of costs, and exports.

Before a solve, ``node_checks`` checks the values of the problem's functions and ``admissibility`` the constrained ends.
``attainability`` finds the nodes from which the target can be reached (``tried_actions``: the actions to try),
``resting`` the nodes where the system can rest at no cost, and ``memory`` checks that there is room. After a solve,
``earnings`` looks for costs that are earned indefinitely. ``chain`` exports the generator for other solvers,
``stationary_law`` computes stationary distributions, and ``decision_process`` builds the decision problem.
``forward_equation`` moves a law forward in time, and ``transport`` keeps it sharp where there is little noise.
"""
