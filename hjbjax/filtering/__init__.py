"""State estimates and control from them: output feedback.

    dx = f(x, u) dt + σ dw,    dy = h(x) dt + r dv,    u = control(information state)

Read ``observers`` first: the protocol, the extended Kalman filter, the Luenberger observer; then ``information_state``,
the law of the state on a grid, and ``output_feedback``, the loop through plant, sensor, observer and control.
"""

from hjbjax.filtering.grid_filter import Density, GridFilter
from hjbjax.filtering.information_state import InformationState, zakai
from hjbjax.filtering.observers import ExtendedKalman, Gaussian, Luenberger, Observer
from hjbjax.filtering.output_feedback import simulate_output
from hjbjax.filtering.output_loop import OutputPath

__all__ = [
    "Density",
    "ExtendedKalman",
    "Gaussian",
    "GridFilter",
    "InformationState",
    "Luenberger",
    "Observer",
    "OutputPath",
    "simulate_output",
    "zakai",
]
