"""Bounds on the true value, with proof: ``enclose``.

``interpolant`` is a continuously differentiable function through node values, with its ranges over cells.
``cell_functions`` has the functions of a problem over cells, ``minimum`` the Hamiltonian of one player and ``games``
the Hamiltonian of two. ``defect`` is the defect of the equation over every cell and at the ends of the box, and
``correction`` changes node values so that the defect falls. ``walls`` bounds the influence of the ends of the box, and
``exits`` describes the target between the nodes. ``levels`` makes functions of the candidate that are bounds, and
``bounds`` is the result with its files. ``discounted``, ``branches`` (at kinks) and ``undiscounted`` find the bounds
for ``enclose``. ``tube_levels`` has the conditions on the levels of a spline that bounds a tube, ``tube_search`` finds
these levels, and ``tube_branches`` has further splines for edges, for ``enclose_tube`` in ``tubes``. ``checks`` refuses
problems without a proof.
"""
