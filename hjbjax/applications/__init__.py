"""Applications of solve and march: reachable sets, probabilities, robustness, and studies.

``reachability`` and ``exit_problems`` construct problems; ``probabilities``, ``l2_gain`` and ``hinf`` solve them.
``convergence`` and ``perturbations`` are studies, and ``reference`` has the reference values of their errors.
"""
