"""Whether there is a finite value, and where: what must be known of all nodes before or after a solve.

``node_checks`` looks at what the functions return, ``admissibility`` at constrained ends, ``attainability`` at which
nodes can be brought to the target (``tried_actions``: by which actions), ``resting`` at where the system can rest at no
cost, ``earnings`` at costs earned for ever, and ``memory`` at whether there is room for it.
"""
