"""Well-posedness: admissible nodes, paths to the target, and finite values.

Before a solve, ``node_checks`` checks the values of the problem's functions and ``admissibility`` the constrained ends.
``attainability`` finds the nodes from which the target can be reached (``tried_actions``: the actions to try), and
``resting`` the nodes where the system can rest at no cost; ``endless_costs`` refuses a cost that nothing ends. After a
solve, ``earnings`` looks for costs that are earned indefinitely.
"""
