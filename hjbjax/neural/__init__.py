"""Networks for problems with more states than a grid holds.

Read ``ansatz`` first: values that contain a network and meet the data of a problem exactly. ``deterministic`` has
``solve``, and ``backward_equation`` has ``deep_bsde`` for stochastic problems. ``training`` is the loop of the
optimiser, ``solution`` the result.
"""

from hjbjax.neural.backward_equation import deep_bsde
from hjbjax.neural.deterministic import solve
from hjbjax.neural.solution import NeuralSolution

__all__ = ["NeuralSolution", "deep_bsde", "solve"]
