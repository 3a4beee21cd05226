"""State estimation and output feedback: observers and controllers that act on measurements.

    dx = f(x, u) dt + σ dw,    dy = h(x) dt + r dv,    u = control(information state)

Read ``observers`` first: the extended Kalman filter, the Luenberger observer, and how to write an observer. Then read
``information_state`` for the law of the state on a grid, ``robust_filter`` for the worst-case filter (its equation is
in ``max_plus``), ``beliefs`` and ``hidden_chain`` for hidden Markov chains, and ``controllers`` for controllers that
act on these information states. ``measurement`` describes the sensor, ``output_loop`` evaluates the closed loop at one
state, and ``output_feedback`` simulates it.
"""

from hjbjax.filtering.beliefs import BeliefCoordinates, BeliefProblem, belief_problem
from hjbjax.filtering.controllers import averaged_hamiltonian, certainty_equivalence, minimum_stress
from hjbjax.filtering.grid_filter import Density, GridFilter
from hjbjax.filtering.hidden_chain import HiddenPath, WonhamFilter, simulate_hidden
from hjbjax.filtering.information_state import InformationState, zakai
from hjbjax.filtering.max_plus import sup_pairing
from hjbjax.filtering.observers import ExtendedKalman, Gaussian, Luenberger, Observer
from hjbjax.filtering.output_feedback import simulate_output
from hjbjax.filtering.output_loop import OutputPath
from hjbjax.filtering.robust_filter import RobustGridFilter, RobustState, robust_filter

__all__ = [
    "BeliefCoordinates",
    "BeliefProblem",
    "Density",
    "ExtendedKalman",
    "Gaussian",
    "GridFilter",
    "HiddenPath",
    "InformationState",
    "Luenberger",
    "Observer",
    "OutputPath",
    "RobustGridFilter",
    "RobustState",
    "WonhamFilter",
    "averaged_hamiltonian",
    "belief_problem",
    "certainty_equivalence",
    "minimum_stress",
    "robust_filter",
    "simulate_hidden",
    "simulate_output",
    "sup_pairing",
    "zakai",
]
