"""Questions that are posed with solve and march: sets, chances, robustness, and studies.

``reachability`` and ``exits`` make problems, ``probabilities``, ``gain`` and ``robust`` solve them; ``convergence`` and
``perturbations`` are studies, ``reference`` what errors are measured against.
"""
