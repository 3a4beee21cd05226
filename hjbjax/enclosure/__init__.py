"""Bounds on the true value, with proof: ``enclose``.

``interpolant`` is a continuously differentiable function through node values, with its ranges over cells. ``minimum``
is the Hamiltonian over cells, ``defect`` the defect of the equation over every cell and at the ends of the box,
``correction`` moves node values so that the defect falls, ``walls`` bounds the influence of the ends of the box,
``bounds`` is the result with its files, and ``enclose`` the public function.
"""
