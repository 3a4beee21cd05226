"""hjbjax: Hamilton–Jacobi–Bellman and Isaacs equations on grids, with JAX."""

from hjbjax import chain, geometry, plotting, stability, zoo
from hjbjax._version import __version__
from hjbjax.batch import solve_batch
from hjbjax.convergence import convergence_study
from hjbjax.dissipation import dissipation
from hjbjax.extremals import FreeTime, pontryagin
from hjbjax.feedback import greedy_feedback
from hjbjax.fields import FallbackWarning
from hjbjax.files import FileError
from hjbjax.gain import attenuation, saturation
from hjbjax.grid import Grid
from hjbjax.horizon import march
from hjbjax.iteration import Nested, PolicyIteration, ValueIteration
from hjbjax.lyapunov import lyapunov_check
from hjbjax.marching import Explicit, Implicit
from hjbjax.perturbations import perturbation_study
from hjbjax.preparation import SolveWarning
from hjbjax.probabilities import expected_exit_time, reach_probability, stay_probability
from hjbjax.problem import Problem
from hjbjax.reachability import avoid, reach, reach_avoid
from hjbjax.relaxation import Direct, Krylov, Sweeps
from hjbjax.robust import hinf_level
from hjbjax.safety import least_restrictive
from hjbjax.schemes import Eno2, Limited, Upwind, Weno5
from hjbjax.sets import Ball, Box, Finite
from hjbjax.simulation import simulate
from hjbjax.solution import Solution, SolveError, load
from hjbjax.solver import solve
from hjbjax.status import Status
from hjbjax.stretching import Sinh

__all__ = [
    "Ball",
    "Box",
    "Direct",
    "Eno2",
    "Explicit",
    "FallbackWarning",
    "FileError",
    "Finite",
    "FreeTime",
    "Grid",
    "Implicit",
    "Krylov",
    "Limited",
    "Nested",
    "PolicyIteration",
    "Problem",
    "Sinh",
    "Solution",
    "SolveError",
    "SolveWarning",
    "Status",
    "Sweeps",
    "Upwind",
    "ValueIteration",
    "Weno5",
    "__version__",
    "attenuation",
    "avoid",
    "chain",
    "convergence_study",
    "dissipation",
    "expected_exit_time",
    "geometry",
    "greedy_feedback",
    "hinf_level",
    "least_restrictive",
    "load",
    "lyapunov_check",
    "march",
    "perturbation_study",
    "plotting",
    "pontryagin",
    "reach",
    "reach_avoid",
    "reach_probability",
    "saturation",
    "simulate",
    "solve",
    "solve_batch",
    "stability",
    "stay_probability",
    "zoo",
]
