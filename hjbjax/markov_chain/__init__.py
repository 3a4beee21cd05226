"""The Markov chain as a process: its generator, its laws, and exports for other solvers.

``chain`` exports the generator, ``stationary_law`` computes stationary distributions, and ``decision_process`` builds
the decision problem. ``forward_equation`` moves a law forward in time, and ``transport`` keeps it sharp where there is
little noise.
"""
