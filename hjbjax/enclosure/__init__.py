"""Bounds on the true value, with proof: ``enclose``.

``interpolant`` is a continuously differentiable function through node values, with its ranges over cells. ``minimum``
is the Hamiltonian over cells, ``games`` the Hamiltonian of two players, ``defect`` the defect of the equation over
every cell and at the ends of the box, ``correction`` moves node values so that the defect falls, ``walls`` bounds the
influence of the ends of the box, ``levels`` makes functions of the candidate that are bounds, ``bounds`` is the result
with its files, ``exits`` the target between the nodes, ``discounted``, ``branches`` (at kinks) and ``undiscounted``
find the bounds, and ``enclose`` is the public function. ``tube_levels`` has the conditions on the levels of a spline
that bounds a tube, and ``tubes`` the public function for tubes.
"""
