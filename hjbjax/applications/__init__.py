"""Questions that are posed with solve and march: sets, chances, robustness, and studies.

``reachability`` and ``exit_problems`` make problems, ``probabilities``, ``l2_gain`` and ``hinf`` solve them;
``convergence`` and ``perturbations`` are studies, ``reference`` what errors are measured against.
"""
