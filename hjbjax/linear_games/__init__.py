"""Linear dynamics and convex terminal costs in any dimension: the generalised Hopf formula, without a grid.

``hopf`` is the public function; read it first. ``convex`` has the terminal costs, ``support`` the support functions of
control sets, ``linear_dynamics`` reads the matrices from a problem, ``costate`` finds the costate of one state.
"""
