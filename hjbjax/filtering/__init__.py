"""State estimates and control from them: information states of systems whose state is not measured.

Read ``observers`` first, for what a controller is given; then ``robust_filter`` for the worst case, with its equation
in ``max_plus``, and ``beliefs`` with ``hidden_chain`` for hidden chains of a few states.
"""

from hjbjax.filtering.beliefs import BeliefCoordinates, BeliefProblem, belief_problem
from hjbjax.filtering.hidden_chain import HiddenPath, WonhamFilter, simulate_hidden
from hjbjax.filtering.max_plus import sup_pairing
from hjbjax.filtering.observers import Observer
from hjbjax.filtering.robust_filter import RobustGridFilter, RobustState, robust_filter

__all__ = [
    "BeliefCoordinates",
    "BeliefProblem",
    "HiddenPath",
    "Observer",
    "RobustGridFilter",
    "RobustState",
    "WonhamFilter",
    "belief_problem",
    "robust_filter",
    "simulate_hidden",
    "sup_pairing",
]
