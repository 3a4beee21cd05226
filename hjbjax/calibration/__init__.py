"""Parameters found by gradients through solves, marches and simulations, with optimisers of optax.

``optimisation`` has ``fit`` for any loss and its result; ``trajectories`` fits a problem to observed closed loops, and
``design`` makes a criterion of the value least.
"""
