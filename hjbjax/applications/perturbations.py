"""The second-order effects of vanishing noise and of expensive disturbances on a value.

    ε: dx = f dt + ε dw, the equation with ½ε² Δ V;      γ: dx = (f + E d) dt, cost L − ½γ²|d|²

    |V^ε − V| = O(ε²),   |V^γ − V| = O(γ⁻²),   and the same for the feedbacks, where V is smooth.

To leading order the changes are ε² times the integral of ½ΔV, and γ⁻² times the integral of ½|E'DV|², along the optimal
path. These integrals must exist, so the paths from the region must not meet a kink of V, and must not come to rest
where V'' is infinite: with the cost |x| the order in ε is 4/3. The grid must resolve the change. All problems are
solved on one grid by one scheme, so the discretisation error cancels up to its product with the change. ``Limited()``
avoids numerical diffusion, which would hide ε. The orders are least-squares slopes of log error over log ε and log 1/γ,
for errors above the tolerance.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from hjbjax.applications.convergence import fitted_order
from hjbjax.applications.l2_gain import InputMatrix, attenuation, saturation
from hjbjax.applications.reference import mask_of
from hjbjax.discretisation.discretisation import Scheme
from hjbjax.discretisation.schemes import Limited, check_slopes
from hjbjax.iteration.methods import Method
from hjbjax.problem.grid import Grid
from hjbjax.problem.mode_axis import refuse_modes
from hjbjax.problem.problem import Problem, is_discounted
from hjbjax.problem.pytree import front_door
from hjbjax.problem.rewards import refuse_rewards
from hjbjax.problem.sets import AdmissibleSet, Ball, Box
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Mask
from hjbjax.solution.clock import Clock, noting_interrupts
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status
from hjbjax.solvers.stationary import check_arguments, solve
from hjbjax.tracing import checks


@dataclasses.dataclass(frozen=True, eq=False)
class Series:
    """One perturbation of a problem, with one entry per value of a parameter that goes to zero.

    Args:
      name: "ε" or "1/γ".
      parameters: the values of the parameter, increasing.
      errors: the largest |V' − V| over the nodes of the region.
      feedback_errors: the largest |u' − u| over these nodes.
      solutions: the perturbed solutions.
      fitted: a mask of the entries for the order of V: converged, with a change above the tolerance.
      feedback_fitted: a mask of the entries for the order of u: also |u' − u| above the tolerance over the spacing.
    """

    name: str
    parameters: np.ndarray
    errors: np.ndarray
    feedback_errors: np.ndarray
    solutions: tuple[Solution, ...]
    fitted: np.ndarray
    feedback_fitted: np.ndarray

    @property
    def order(self) -> float:
        """The fitted slope of the value; NaN with fewer than two entries to fit."""
        return fitted_order(self.parameters[self.fitted], self.errors[self.fitted])

    @property
    def feedback_order(self) -> float:
        """The fitted slope of the feedback; NaN with fewer than two entries to fit."""
        return fitted_order(self.parameters[self.feedback_fitted], self.feedback_errors[self.feedback_fitted])

    def __str__(self) -> str:
        lines = [f"{self.name:>9} {'value':>10} {'feedback':>10}  status"]
        rows = zip(self.parameters, self.errors, self.feedback_errors, self.fitted, self.solutions, strict=True)
        for parameter, value, feedback, counts, solution in rows:
            # for the fit of the value; the fit of the feedback may use fewer entries
            mark = " " if counts else "*"
            lines.append(f"{parameter:>9.4g} {value:>10.3e}{mark}{feedback:>10.3e}  {solution.status.name}")
        lines.append(f"{'order':>9} {self.order:>10.2f} {self.feedback_order:>10.2f}")
        return "\n".join(lines)


# eq=False, because the fields are arrays
@dataclasses.dataclass(frozen=True, eq=False)
class Perturbation:
    """The effects of noise and of disturbances on a value; ``print`` shows the tables.

    Args:
      nominal: the solution without noise and disturbances.
      noise: the changes for the noises ε.
      gain: the changes for the disturbances at the levels γ, against 1/γ.
      scheme: the scheme as text.
      tol: the tolerance of every solve.
    """

    nominal: Solution
    noise: Series  # with ½ε²ΔV in the equation
    gain: Series  # with ½γ⁻²|E'DV|² in the equation
    scheme: str
    tol: float

    def __str__(self) -> str:
        head = f"{self.scheme}, tol {self.tol:g}; largest changes in the region"
        lines = [head, *(str(each) for each in (self.noise, self.gain))]
        if not (self.noise.fitted.all() and self.gain.fitted.all()):
            lines.append("* not fitted: the solve did not converge, or the change is not above the tolerance")
        return "\n".join(lines)


@front_door
def perturbation_study(
    problem: Problem,
    grid: Grid,
    *,
    noises: Sequence[float],
    gammas: Sequence[float],
    disturbances: AdmissibleSet,
    enters: InputMatrix = None,
    region: Callable | float | None = 0.25,
    scheme: Scheme = Limited(),
    method: Method | None = None,
    tol: float = 1e-6,
) -> Perturbation:
    """Solve a problem with vanishing noise and with expensive disturbances, and fit the orders of the changes.

    Args:
      problem: a problem without noise and disturbances, and with a discount, because the cost of noise never ends.
      grid: the grid of all solves.
      noises: ε, at least two numbers > 0.
      gammas: γ, at least two feasible levels.
      disturbances: the set of d, not saturated in the region.
      enters: E, as in ``attenuation``.
      region: where changes are measured, without a kink of V: a boolean function of one state or a fraction of the box.
      scheme: as in ``solve``.
      method: as in ``solve``.
      tol: as in ``solve``, small compared with the smallest change.

    Returns:
      The study; ``hjb.plotting.perturbation(study)`` draws both lines in one plot.

    Raises:
      ValueError: there are fewer than two noises or levels; the problem has modes, noise or disturbances, or no
        discount; the set of disturbances is saturated in the region; or ``solve`` refuses.
      SolveError: the study was interrupted; ``.solution`` is the study so far, or the unperturbed solution.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-4.0], [4.0]), discount=1.0)
      >>> study = hjb.perturbation_study(plant, hjb.Grid([-2.0], [2.0], (21,)), noises=[0.05, 0.1], gammas=[5.0, 10.0],
      ...     disturbances=hjb.Box([-1.0], [1.0]), scheme=hjb.Upwind(central=False))
      >>> round(study.noise.order, 1), round(study.gain.order, 1)
      (2.0, 2.0)
    """
    check_arguments(problem, grid, method, scheme, tol)
    check_slopes(scheme, "perturbation_study: scheme")
    refuse_modes(problem)
    refuse_rewards(problem, "perturbation_study", "an L₂ gain is about the energy of an output, which is a cost")
    levels = _parameters("noises", noises), _parameters("gammas", gammas)
    if problem.is_game or problem.noise is not None:
        raise ValueError("perturbation_study: the problem already has noise or disturbances; remove them")
    # with noise the state never rests, so the running cost continues indefinitely and is finite only with a discount
    if not is_discounted(problem):
        raise ValueError("perturbation_study: without a discount the cost with noise is infinite; give a discount > 0")
    mask = mask_of(region, grid, "perturbation_study")
    # from the highest level, the weakest disturbance, so that effects increase as for the noises
    games = [attenuation(problem, gamma, disturbances, enters=enters) for gamma in levels[1][::-1]]
    # ``saturation`` at the end requires a Box or a Ball, so check before the solves
    if not isinstance(disturbances, (Box, Ball)):
        raise ValueError(f"perturbation_study: the disturbances are {disturbances!r:.60}; wanted a Box or a Ball")
    # check E and the set of d before the first solve, which may take long and does not use them
    with own_settings(x64=True):
        checks.shapes(games[0], grid, scheme)

    # throw=False for a perturbed problem: it keeps its row and is not fitted
    def solution_of(which: Problem, throw: bool = False) -> Solution:
        return solve(which, grid, scheme=scheme, method=method, tol=tol, throw=throw)

    clock, found = Clock(), []
    # a number means ε I; it is a leaf, so one program serves all noises
    noisy = [dataclasses.replace(problem, noise=epsilon) for epsilon in levels[0]]
    with noting_interrupts(clock):
        nominal = solution_of(problem, throw=True)  # everything else is compared with it
        for perturbed in (*noisy, *games):
            if not clock.interrupted:
                found.append(solution_of(perturbed))
    noise = _series("ε", levels[0], found[: len(noisy)], nominal, mask, tol)
    # against 1/γ, so that both parameters go to zero and both slopes should be 2
    gain = _series("1/γ", 1 / levels[1][::-1], found[len(noisy) :], nominal, mask, tol)
    study = Perturbation(nominal, noise, gain, str(scheme), tol)
    if clock.interrupted:
        came = f"{len(found)} of {len(noisy) + len(games)} perturbed problems"
        raise SolveError(f"perturbation_study: interrupted after {came}; .solution is the study so far", study)
    # The worst case is strongest at the lowest level: if it does not reach its bound, no other does. The region need
    # not be a box, so the disturbance is masked outside it, with inner=1.
    watched = dataclasses.replace(found[-1], disturbance=_disturbance_within(found[-1], mask))
    felt = saturation(watched, games[-1], inner=1.0)
    if felt.share > 0:
        raise ValueError(f"perturbation_study: at gamma = {levels[1][0]:g} {felt}; widen the set, or raise gamma")
    return study


def _parameters(name: str, numbers: Sequence[float]) -> np.ndarray:
    """The parameters in increasing order without duplicates."""
    # np.unique sorts; duplicates would count twice in the fit
    values = np.unique(np.asarray(numbers, np.float64))
    if values.size < 2 or not np.all(np.isfinite(values) & (values > 0)):
        raise ValueError(f"perturbation_study: got {name} = {numbers!r}, wanted at least two finite numbers > 0")
    return values


def _disturbance_within(solution: Solution, mask: Mask) -> np.ndarray:
    """The disturbance in the region, NaN outside."""
    # (*grid, l); ``saturation`` skips nodes with NaN
    return np.where(mask[..., None], solution.disturbance, np.nan)


def _series(
    name: str, parameters: np.ndarray, solutions: Sequence[Solution], nominal: Solution, mask: Mask, tol: float
) -> Series:
    """The changes relative to the unperturbed solution, and masks of the changes that count for the orders."""
    parameters = parameters[: len(solutions)]  # fewer if the study was interrupted
    # on one grid with one scheme the discretisation error cancels up to its product with the change
    values = [np.abs(each.value - nominal.value)[mask] for each in solutions]
    # NaN propagates through the maxima and is not fitted
    inputs = [np.abs(each.policy - nominal.policy)[mask] for each in solutions]
    errors = np.array([np.max(each) for each in values])
    feedback = np.array([np.max(each, initial=0.0) for each in inputs])  # initial, because u may be empty
    converged = np.array([each.status is Status.CONVERGED for each in solutions], bool)
    # a smaller change may come from the iteration
    fitted = converged & np.isfinite(errors) & (errors > tol)
    # the smallest spacing, because an error of V causes the largest error of its slope there
    finest = min(float(nominal.grid.spacing(axis)) for axis in range(nominal.grid.ndim))
    seen = fitted & (feedback > tol / finest)  # a slope of V is not more accurate than this
    return Series(name, parameters, errors, feedback, tuple(solutions), fitted, seen)
