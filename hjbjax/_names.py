"""The public names, imported together when the first of them is used; see ``hjbjax.__getattr__``.

The names in ``LATER`` are imported one by one, because few programs use them.
"""

import importlib
from typing import TYPE_CHECKING, Any

from hjbjax import geometry
from hjbjax._version import __version__
from hjbjax.applications.convergence import convergence_study
from hjbjax.applications.equilibrium import Equilibrium, equilibrium
from hjbjax.applications.hinf import hinf_level
from hjbjax.applications.l2_gain import attenuation, saturation
from hjbjax.applications.perturbations import perturbation_study
from hjbjax.applications.probabilities import expected_exit_time, reach_probability, stay_probability
from hjbjax.applications.reachability import avoid, from_hj_reachability, reach, reach_avoid
from hjbjax.applications.transitions import Transition, transition
from hjbjax.discretisation.schemes import Eno2, Limited, Upwind, Weno5
from hjbjax.extremals.indirect_method import FreeTime, pontryagin
from hjbjax.feedback.dissipation import dissipation
from hjbjax.feedback.feedback import greedy_feedback
from hjbjax.feedback.safety_filter import least_restrictive
from hjbjax.feedback.simulation import simulate
from hjbjax.geometry import stability
from hjbjax.geometry.lyapunov import lyapunov_check
from hjbjax.iteration.evaluation import Direct, Krylov, Sweeps
from hjbjax.iteration.methods import Nested, PolicyIteration, ValueIteration
from hjbjax.iteration.time_methods import Explicit, Implicit, Tableau
from hjbjax.markov_chain import chain
from hjbjax.problem.ends import Dirichlet, Neumann, Robin
from hjbjax.problem.grid import Grid
from hjbjax.problem.jumps import Jump
from hjbjax.problem.modes import Modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pushes import Push
from hjbjax.problem.sets import Ball, Box, Finite, Simplex
from hjbjax.problem.spaces import discount_rate, from_gymnasium
from hjbjax.problem.stretching import Sinh
from hjbjax.semi_lagrangian.scheme import SemiLagrangian
from hjbjax.solution.checkpoints import Checkpoint
from hjbjax.solution.files import FileError
from hjbjax.solution.solution import Solution, SolveError, load
from hjbjax.solution.status import SolveWarning, Status
from hjbjax.solvers.batch import solve_batch
from hjbjax.solvers.compile_cache import keep_compiled
from hjbjax.solvers.finite_horizon import march
from hjbjax.solvers.resources import estimate
from hjbjax.solvers.stationary import solve
from hjbjax.tracing.interpreter import FallbackWarning

if TYPE_CHECKING:
    from hjbjax import filtering, neural, plotting, zoo
    from hjbjax.calibration.design import design
    from hjbjax.calibration.optimisation import Fit, fit
    from hjbjax.calibration.trajectories import fit_trajectories
    from hjbjax.decomposition.combination import BlockSolution
    from hjbjax.decomposition.decompose import Decomposition, decompose
    from hjbjax.enclosure.bounds import Enclosure
    from hjbjax.enclosure.enclose import enclose
    from hjbjax.enclosure.tubes import TubeEnclosure, enclose_tube
    from hjbjax.linear_games import convex
    from hjbjax.linear_games.hopf import HopfSolution, hopf

LATER = {  # the modules of the names that are imported on first use
    "BlockSolution": "decomposition.combination",
    "Decomposition": "decomposition.decompose",
    "Enclosure": "enclosure.bounds",
    "Fit": "calibration.optimisation",
    "HopfSolution": "linear_games.hopf",
    "TubeEnclosure": "enclosure.tubes",
    "decompose": "decomposition.decompose",
    "design": "calibration.design",
    "enclose": "enclosure.enclose",
    "enclose_tube": "enclosure.tubes",
    "fit": "calibration.optimisation",
    "fit_trajectories": "calibration.trajectories",
    "hopf": "linear_games.hopf",
}

__all__ = [
    "Ball",
    "BlockSolution",
    "Box",
    "Checkpoint",
    "Decomposition",
    "Direct",
    "Dirichlet",
    "Enclosure",
    "Eno2",
    "Equilibrium",
    "Explicit",
    "FallbackWarning",
    "FileError",
    "Finite",
    "Fit",
    "FreeTime",
    "Grid",
    "HopfSolution",
    "Implicit",
    "Jump",
    "Krylov",
    "Limited",
    "Modes",
    "Nested",
    "Neumann",
    "PolicyIteration",
    "Problem",
    "Push",
    "Robin",
    "SemiLagrangian",
    "Simplex",
    "Sinh",
    "Solution",
    "SolveError",
    "SolveWarning",
    "Status",
    "Sweeps",
    "Tableau",
    "Transition",
    "TubeEnclosure",
    "Upwind",
    "ValueIteration",
    "Weno5",
    "__version__",
    "attenuation",
    "avoid",
    "chain",
    "convergence_study",
    "convex",
    "decompose",
    "design",
    "discount_rate",
    "dissipation",
    "enclose",
    "enclose_tube",
    "equilibrium",
    "estimate",
    "expected_exit_time",
    "filtering",
    "fit",
    "fit_trajectories",
    "from_gymnasium",
    "from_hj_reachability",
    "geometry",
    "greedy_feedback",
    "hinf_level",
    "hopf",
    "keep_compiled",
    "least_restrictive",
    "load",
    "lyapunov_check",
    "march",
    "neural",
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
    "transition",
    "zoo",
]


def __getattr__(name: str) -> Any:
    """A name that is imported on first use."""
    if name == "convex":
        return importlib.import_module("hjbjax.linear_games.convex")
    if name not in LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"hjbjax.{LATER[name]}"), name)
