"""Controllers that use only an information state: functions of an observer's state for ``simulate_output``.

    certainty equivalence     u = u*(x̂)                                    x̂ the observer's estimate
    averaged Hamiltonian      u = argmin_u ∫ σ(x) [ L(x, u) + f(x, u)·DV(x) + ½ tr(a(x, u) D²V(x)) ] dx
    minimum stress            u = u*(x̄),   x̄ = argmax_x { p(x) + V(x) }

u* and V are the feedback and the value with a known state, σ is the law of the state given the record (12.6), and p is
the robust information state (12.10). Certainty equivalence is optimal for a linear plant with quadratic cost and normal
noise (W. M. Wonham's separation), where the averaged Hamiltonian gives the same control. The averaged Hamiltonian acts
as if the state became known in the next instant, so it never acts in order to learn. Minimum stress is optimal in the
worst case for linear plants with quadratic cost, where x̄ = (1 − Y P/γ²)⁻¹ x̂ as long as the spectral radius of Y P is
less than γ² (K. Glover and J. C. Doyle, 1988).

Source: M. R. James, Nonlinear Control Systems, section 12.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.schemes import Upwind
from hjbjax.feedback.feedback import GridFeedback, is_grid_feedback, lookups
from hjbjax.filtering.grid_filter import Density, GridFilter, at_ends, check_within, states_of
from hjbjax.filtering.max_plus import refined_maximum
from hjbjax.filtering.output_loop import Observer, OutputPath
from hjbjax.filtering.robust_filter import RobustGridFilter
from hjbjax.hamiltonian import pointwise
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, cast, front_door, is_traced, pytree_dataclass
from hjbjax.problem.rewards import costs_of, refuse_rewards
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Costate, Field, Number, Scalar, State
from hjbjax.solution.rewards import in_costs
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import warn
from hjbjax.tracing import checks, closures


@pytree_dataclass(static=("exact",))
class AveragedHamiltonian:
    """The controller of ``averaged_hamiltonian``.

    Args:
      problem: the problem whose Hamiltonian is averaged.
      observer: the filter whose state the controller reads.
      costate: DV at its nodes, n arrays (*grid).
      bends: D²V at its nodes if the noise depends on u, by pairs of axes i ≤ j.
      counts: 1.0 at the nodes outside the target, 0.0 in it.
      exact: True if the jaxprs show that the average is a separable quadratic in u.
    """

    problem: Problem
    observer: GridFilter
    costate: Any
    bends: Any
    counts: Any
    exact: bool

    @front_door
    def __call__(self, information: Density) -> Array:
        """The control, shape (m,); NaN if the density is not a law."""
        self.observer.check_state(information)
        # compiled even if the caller does not compile. Cast to one type, because JAX 0.10 confuses programs with NumPy
        # float64 constants traced in 64 bits with programs traced in 32 bits
        return _least(cast(self, information.density.dtype), information)

    def _least(self, information: Density) -> Array:
        dtype, weights = information.density.dtype, self._weights(information)
        admissible = cast(self.problem.controls, dtype)
        assert admissible is not None
        u = pointwise.least(admissible, lambda u: self._average(weights, u), self.exact, dtype)
        return jnp.where(jnp.isfinite(jnp.sum(weights)), u, jnp.nan)

    @front_door
    def average(self, information: Density, u: Array) -> Scalar:
        """⟨σ, L(·, u) + f(·, u)·DV + ½ tr(a(·, u) D²V)⟩ without noise terms free of u, in cost per unit time."""
        return self._average(self._weights(information), jnp.asarray(u, information.density.dtype))

    def _weights(self, information: Density) -> Field:
        """The probabilities outside the target, normalised; all probabilities if all mass is in the target."""
        probability = self.observer.probability(information)
        total = jnp.sum(outside := probability * jnp.asarray(self.counts, probability.dtype))
        return jnp.where(total > 0, outside / jnp.where(total > 0, total, 1), probability)

    def _average(self, weights: Field, u: Array) -> Scalar:
        dtype = weights.dtype
        on = Discretisation(*cast((self.problem, self.observer.grid), dtype), Upwind(), dtype)
        entries = [u[j] for j in range(u.shape[0])]
        total = on.running_cost(entries)
        for f, slope in zip(on.drift(entries), self.costate, strict=True):
            total = total + f * jnp.asarray(slope, dtype)
        if self.bends:
            for pair, a in on.diffusion(entries).items():
                total = total + a * jnp.asarray(self.bends[pair], dtype) * (0.5 if pair[0] == pair[1] else 1)
        return jnp.sum(weights * total)


_least, _largest = jax.jit(AveragedHamiltonian._least), jax.jit(refined_maximum)


@pytree_dataclass()
class MinimumStress:
    """The controller of ``minimum_stress``.

    Args:
      grid: the nodes of the filter.
      value: V at them, shape (*grid).
      feedback: a pytree that is called with the time and the state.
    """

    grid: Grid
    value: Any
    feedback: Callable

    @front_door
    def __call__(self, information: Field) -> Array:
        """The control, shape (m,)."""
        worst = self.worst_case(information)
        return jnp.asarray(self.feedback(0.0, worst), worst.dtype)

    @front_door
    def worst_case(self, information: Field) -> State:
        """x̄, the state where p + V is largest, shape (n,), refined between the nodes."""
        return self._maximum(information)[1]

    @front_door
    def stress(self, information: Field) -> Scalar:
        """The largest p + V, in the units of cost: the worst total of past and future cost."""
        return self._maximum(information)[0]

    def judge(self, path: OutputPath) -> None:
        """Warn if paths of ``simulate_output`` end with the worst case at an end of the box."""
        with own_settings(x64=True):
            find = jax.vmap(self.worst_case) if np.ndim(path.code) else self.worst_case
            states = np.atleast_2d(find(jnp.asarray(path.information)))
        if np.any(ends := np.any(at_ends(self.grid, states), axis=-1)):
            warn(
                f"minimum_stress: the worst case is at an end of the box on {np.sum(ends)} of {len(ends)} paths, the "
                f"first at {np.array2string(states[np.argmax(ends)], separator=', ')}: p + V has no maximum inside.\n"
                "γ is too small for filter and feedback together, V belongs to another γ, or the box is too small.",
                UserWarning,
            )

    def _maximum(self, information: Field) -> tuple[Scalar, State]:
        if np.shape(information) != self.grid.shape:
            got = np.shape(information) if hasattr(information, "shape") else f"a {type(information).__name__}"
            raise ValueError(f"minimum_stress: got {got} for p, wanted shape {self.grid.shape}: one number per node")
        dtype = information.dtype
        return _largest(information + jnp.asarray(self.value, dtype), cast(self.grid, dtype))


@front_door
def certainty_equivalence(observer: Observer, feedback: GridFeedback | Callable) -> jax.tree_util.Partial:
    """A controller that uses the observer's estimate as if it were the state, u = u*(x̂).

    Args:
      observer: the observer whose information state the controller receives.
      feedback: a stationary Solution, a ``greedy_feedback``, or a function of the state that returns the control,
        shape (m,). A state beyond the grid gets the control of the nearest point in it.

    Returns:
      A pytree, called with the observer's state. NaN where a Solution has no control, for example in its target.

    Raises:
      TypeError: an observer without an estimate, a feedback that cannot be called.
      ValueError: a marched solution.

    Example:
      >>> from hjbjax.filtering.observers import Luenberger
      >>> observer = Luenberger(Problem(lambda x, u: -x), lambda x: x, [[3.0]], [0.5])
      >>> float(certainty_equivalence(observer, lambda x: -2 * x)(observer.initial())[0])
      -1.0
    """
    name = "certainty_equivalence"
    if not isinstance(observer, Observer):
        raise TypeError(f"{name}: got {type(observer).__name__}, wanted an Observer, with estimate(state)")
    return jax.tree_util.Partial(_at_estimate, as_partial(observer.estimate), _stationary(feedback, name))


@front_door
def _at_estimate(estimate: Callable, feedback: Callable, information: Any) -> Array:
    x = jnp.asarray(estimate(information))
    return jnp.asarray(feedback(0.0, x), x.dtype)


@front_door
def averaged_hamiltonian(problem: Problem, solution: Solution, observer: GridFilter) -> AveragedHamiltonian:
    """A controller that minimises the Hamiltonian averaged over the law of the state.

        u = argmin_u ⟨σ, L(·, u) + f(·, u)·DV + ½ tr(a(·, u) D²V)⟩

    Finite sets are enumerated. On a box or a ball the minimum is in closed form if the jaxprs of drift, cost and noise
    show that the average is a separable quadratic in u; otherwise samples, a pattern search and Newton's method find
    it. DV is computed by central differences, which smear kinks of V over two cells. Where V is not finite, DV = 0 is
    used. Nodes in the target do not count as long as there is probability outside it. One control costs one pass over
    the nodes for every u tried.

    Args:
      problem: the problem that was solved.
      solution: the result of ``solve``, in which every state has a control.
      observer: the filter; its grid may differ from the solution's grid, but must lie in the same box.

    Returns:
      A pytree, called with the filter's state; ``.average(state, u)`` is the minimised average, in costs also for a
      problem with rewards.

    Raises:
      TypeError: an argument that is not a Problem, a Solution or a GridFilter.
      ValueError: a game, no controls, functions that depend on time, a marched solution, grids that do not fit.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-3.0], [3.0]), noise=0.5)
      >>> grid = hjb.Grid([-4.0], [4.0], (41,))
      >>> x = grid.axis(0)
      >>> known = hjb.Solution(grid, 0.5 * x**2, -x[:, None])  # up to a constant; usually from ``hjb.solve``
      >>> observer = GridFilter(plant, lambda x: x, grid, lambda x: jnp.exp(-2 * (x - 0.5) @ (x - 0.5)))
      >>> round(float(averaged_hamiltonian(plant, known, observer)(observer.initial())[0]), 3)  # minus the mean
      -0.5
    """
    name = "averaged_hamiltonian"
    for got, wanted in ((problem, Problem), (solution, Solution), (observer, GridFilter)):
        if not isinstance(got, wanted):
            raise TypeError(f"{name}: got {type(got).__name__}, wanted a {wanted.__name__}")
    if problem.is_game or problem.time_dependent or problem.controls is None:
        what = "disturbances" if problem.is_game else "no controls" if problem.controls is None else "a time"
        raise ValueError(
            f"{name}: got a problem with {what}, wanted one player whose functions take (x, u). For a game use "
            "minimum_stress; to replace a time, add a state with drift 1."
        )
    _check_stationary(solution, name)
    check_within(solution.grid, observer.grid, name)
    if not is_traced(solution.value) and (bad := int(np.sum(np.isnan(solution.value)))):
        raise ValueError(f"{name}: V is NaN at {bad} nodes, wanted numbers, or infinity if the target is unreachable")
    grid, n = observer.grid, observer.grid.ndim
    problem, solution = closures.settled(costs_of(problem), n), in_costs(solution)
    checks.of_one_state(problem, n, "the number of axes of the filter's grid")
    with _double(problem, solution, observer), jax.ensure_compile_time_eval():
        dtype = np.dtype(jnp.result_type(float))
        on = Discretisation(*cast((problem, grid), dtype), Upwind(), dtype)
        outside = jnp.ones(grid.shape) if problem.target is None else on.at_nodes(problem.target) > 0
        slopes = _slopes(solution, grid)
        exact, noisy = pointwise.quadratic_with_noise(problem, n)
        found = {
            "costate": tuple(slopes[..., i] for i in range(n)),
            "bends": _bends(solution, grid) if noisy else {},
            "counts": outside.astype(dtype),
        }
    found = found if is_traced(found) else jax.tree.map(np.asarray, found)
    return AveragedHamiltonian(problem, observer, exact=exact, **found)


@front_door
def minimum_stress(
    observer: RobustGridFilter, solution: Solution, *, feedback: GridFeedback | Callable | None = None
) -> MinimumStress:
    """A controller that acts as if the state were the worst one, where past plus future cost p + V is largest.

        u = u*(x̄),    x̄ = argmax_x { p(x) + V(x) }

    V is the value of the H∞ game with the γ and σ of the filter, ``attenuation(problem, gamma, disturbances,
    enters=sigma)``. If γ is too small for both Riccati equations together, p + V has no maximum inside and x̄ runs to
    an end of the box. ``simulate_output`` then warns.

    Args:
      observer: the robust filter; its grid may differ from the solution's grid, but must lie in the same box.
      solution: V; of a marched solution the earliest stored time is used, at which V should have settled.

    Keyword Args:
      feedback: u*, a function of the state or a ``greedy_feedback``. Default: the solution's control.

    Returns:
      A pytree, called with the filter's state; ``.worst_case(state)`` is x̄, ``.stress(state)`` the largest p + V.

    Raises:
      TypeError: an argument that is not a RobustGridFilter or a Solution, or a feedback that cannot be called.
      ValueError: grids that do not fit, or a V that is not finite at a node of the filter.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-3.0], [3.0]))
      >>> grid = hjb.Grid([-2.0], [2.0], (41,))
      >>> x = grid.axis(0)
      >>> known = hjb.Solution(grid, 0.25 * x**2, -0.5 * x[:, None])  # usually ``hjb.attenuation(plant, 2.0, ...)``
      >>> observer = RobustGridFilter(plant, lambda x: x, grid, lambda x: -2 * (x - 0.5) @ (x - 0.5), 2.0)
      >>> control = minimum_stress(observer, known)
      >>> round(float(control.worst_case(observer.initial())[0]), 4), round(float(control(observer.initial())[0]), 4)
      (0.5714, -0.2857)
    """
    name = "minimum_stress"
    for got, wanted in ((observer, RobustGridFilter), (solution, Solution)):
        if not isinstance(got, wanted):
            raise TypeError(f"{name}: got {type(got).__name__}, wanted a {wanted.__name__}")
    refuse_rewards(solution.problem, name, "the worst case maximises the past and future cost p + V")
    if solution.times is not None:
        kept = {each: getattr(solution, each) for each in ("value", "policy", "disturbance")}
        first = {each: array[0] for each, array in kept.items() if array is not None}
        solution = dataclasses.replace(solution, times=None, **first)
    check_within(solution.grid, grid := observer.grid, name)
    acts = _stationary(solution if feedback is None else feedback, name)
    with _double(solution, grid), jax.ensure_compile_time_eval():
        value = solution.value_at(states_of(grid), clamp=True)
    if not is_traced(value):
        value = np.asarray(value)
        bad = np.argwhere(~np.isfinite(value))
        if len(bad):
            state = np.array2string(grid.state(tuple(int(i) for i in bad[0])), separator=", ")
            raise ValueError(
                f"{name}: V is not finite at {len(bad)} nodes of the filter, the first {state}, where p + V has no "
                "maximum; use a smaller box for the filter"
            )
    return MinimumStress(grid, value, acts)


def _double(*trees: Any) -> Any:
    """Settings for float64, except in a caller's float32 trace."""
    return own_settings(x64=jnp.result_type(float) == np.float64 or not is_traced(*trees))


def _stationary(feedback: Any, name: str) -> Callable:
    """A feedback as a pytree that is called with the time, which is ignored, and the state."""
    if is_grid_feedback(feedback):
        _check_stationary(feedback, name)
        return jax.tree_util.Partial(_wrapped, feedback.grid, lookups(feedback)[0])
    if not callable(feedback):
        raise TypeError(f"{name}: got {type(feedback).__name__}, wanted a Solution or a function of the state")
    return jax.tree_util.Partial(_of_state, as_partial(feedback))


def _wrapped(grid: Grid, look: Callable, t: Number, x: State) -> Array:
    return look(t, grid.wrap(x))


def _of_state(function: Callable, t: Number, x: State) -> Array:
    return function(x)


def _check_stationary(solution: GridFeedback, name: str) -> None:
    """Refuse a marched solution: a controller does not receive the time."""
    if solution.times is not None:
        raise ValueError(
            f"{name}: got a marched solution, wanted a stationary one: the information state does not hold the time.\n"
            "For certainty equivalence pass the solution to simulate_output, or make the time a state with drift 1."
        )


def _slopes(solution: Solution, grid: Grid) -> Array:
    """DV at the nodes of a grid, shape (*grid, n); zero where V has no finite slope."""
    slopes = solution.costate_at(states_of(grid), clamp=True)
    return jnp.where(jnp.isfinite(slopes), slopes, 0)


def _bends(solution: Solution, grid: Grid) -> dict[tuple[int, int], Costate]:
    """D²V at the nodes of a grid by pairs of axes: central differences of central differences."""
    n = grid.ndim
    slopes = _slopes(solution, solution.grid)
    rows = [_slopes(dataclasses.replace(solution, value=slopes[..., i]), grid) for i in range(n)]
    # mixed differences commute on a uniform grid; their mean is symmetric on any grid
    return {(i, j): (rows[i][..., j] + rows[j][..., i]) / 2 for i in range(n) for j in range(i, n)}
