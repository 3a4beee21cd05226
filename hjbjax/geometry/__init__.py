"""Geometric control: Lie brackets, reachability and observability ranks, feedback linearisation, stability.

Read ``brackets`` and ``distributions`` first, then ``feedback_linearisation`` and ``linearisability``. ``lyapunov``
searches for violations of a Lyapunov function, and ``stability`` has Brockett's condition.
"""

from hjbjax.geometry.brackets import ad, affine_fields, lie_bracket, lie_derivative
from hjbjax.geometry.distributions import Distribution, observability_codistribution, reachability_distribution
from hjbjax.geometry.feedback_linearisation import Linearisation, RelativeDegree, linearising_feedback, relative_degree
from hjbjax.geometry.linearisability import Linearisability, is_feedback_linearisable

__all__ = [
    "Distribution",
    "Linearisability",
    "Linearisation",
    "RelativeDegree",
    "ad",
    "affine_fields",
    "is_feedback_linearisable",
    "lie_bracket",
    "lie_derivative",
    "linearising_feedback",
    "observability_codistribution",
    "reachability_distribution",
    "relative_degree",
]
