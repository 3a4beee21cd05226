"""Controllers that see an information state alone, as functions of an observer's state for ``simulate_output``.

    certainty equivalence     u = u*(x̂)                                    x̂ the observer's estimate
    averaged Hamiltonian      u = argmin_u ∫ σ(x) [ L(x, u) + f(x, u)·DV(x) + ½ tr(a(x, u) D²V(x)) ] dx
    minimum stress            u = u*(x̄),   x̄ = argmax_x { p(x) + V(x) }

with u* and V those of a feedback that sees the state, σ the law of the state given the record (12.6) and p the robust
information state (12.10). The first is optimal for a linear plant with quadratic cost and normal noise (W. M. Wonham's
separation), where the second agrees with it. The second acts as if the state became known in the next instant, so that
it never acts in order to learn. The third is optimal in the worst case for linear plants with quadratic cost, where
x̄ = (1 − Y P/γ²)⁻¹ x̂ while the spectral radius of Y P is less than γ² (K. Glover and J. C. Doyle, 1988).

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
from hjbjax.feedback.output_loop import Observer, OutputPath
from hjbjax.filtering.grid_filter import Density, GridFilter, at_ends, check_box, states_of
from hjbjax.filtering.max_plus import refined_maximum
from hjbjax.filtering.robust_filter import RobustGridFilter
from hjbjax.hamiltonian import pointwise
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, cast, front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Costate, Field, Number, Scalar, State
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import warn
from hjbjax.tracing import checks, closures


@pytree_dataclass(static=("exact",))
class AveragedHamiltonian:
    """The controller of ``averaged_hamiltonian``.

    Args:
      problem: whose Hamiltonian is averaged.
      observer: the filter whose states are seen.
      costate: DV at its nodes, n arrays (*grid).
      bends: D²V at its nodes where noise depends on u, by pairs of axes i ≤ j.
      counts: 1.0 at the nodes outside the target, 0.0 in it.
      exact: whether the average is a separable quadratic in u, by the jaxprs.
    """

    problem: Problem
    observer: GridFilter
    costate: Any
    bends: Any
    counts: Any
    exact: bool

    @front_door
    def __call__(self, information: Density) -> Array:
        """The control, shape (m,); NaN where the law is no law."""
        self.observer.check_state(information)
        # compiled even where the caller does not; in one type, since JAX 0.10 confuses programs of NumPy's float64 that
        # were traced in a ``jit`` of 64 bits with those of 32
        return _least(cast(self, information.density.dtype), information)

    def _least(self, information: Density) -> Array:
        dtype, weights = information.density.dtype, self._weights(information)
        admissible = cast(self.problem.controls, dtype)
        assert admissible is not None
        u = pointwise.least(admissible, lambda u: self._average(weights, u), self.exact, dtype)
        return jnp.where(jnp.isfinite(jnp.sum(weights)), u, jnp.nan)

    @front_door
    def average(self, information: Density, u: Array) -> Scalar:
        """⟨σ, L(·, u) + f(·, u)·DV + ½ tr(a(·, u) D²V)⟩, but for noise terms without u, in cost per unit time."""
        return self._average(self._weights(information), jnp.asarray(u, information.density.dtype))

    def _weights(self, information: Density) -> Field:
        """The probabilities outside the target; where all is inside, all."""
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
        """x̄, where p + V is largest, shape (n,), refined between the nodes."""
        return self._maximum(information)[1]

    @front_door
    def stress(self, information: Field) -> Scalar:
        """The largest p + V, in the units of cost: what the record admits so far and V lets come."""
        return self._maximum(information)[0]

    def judge(self, path: OutputPath) -> None:
        """Warn where paths of ``simulate_output`` end with the worst case at an end of the box."""
        with own_settings(x64=True):
            find = jax.vmap(self.worst_case) if np.ndim(path.code) else self.worst_case
            states = np.atleast_2d(find(jnp.asarray(path.information)))
        if np.any(ends := np.any(at_ends(self.grid, states), axis=-1)):
            warn(
                f"minimum_stress: the worst case is at an end of the box on {np.sum(ends)} of {len(ends)} paths, the "
                f"first at {np.array2string(states[np.argmax(ends)], separator=', ')}: p + V has no maximum inside; γ "
                "is too small for filter and feedback together, or V that of another γ, or the box too small",
                UserWarning,
            )

    def _maximum(self, information: Field) -> tuple[Scalar, State]:
        if np.shape(information) != self.grid.shape:
            got = np.shape(information) if hasattr(information, "shape") else f"a {type(information).__name__}"
            raise ValueError(f"minimum_stress: got {got} for p, wanted shape {self.grid.shape}: one number a node")
        dtype = information.dtype
        return _largest(information + jnp.asarray(self.value, dtype), cast(self.grid, dtype))


@front_door
def certainty_equivalence(observer: Observer, feedback: GridFeedback | Callable) -> jax.tree_util.Partial:
    """A controller that takes the observer's estimate for the state, u = u*(x̂).

    Args:
      observer: whose state it will see.
      feedback: a stationary Solution, a ``greedy_feedback``, or a function of the state that returns the control,
        shape (m,). A state beyond the grid gets the control of the nearest point in it.

    Returns:
      A pytree, called with the observer's state. NaN where a Solution has no control, as in its target.

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
    if not callable(getattr(observer, "estimate", None)):
        raise TypeError(f"{name}: got {type(observer).__name__}, wanted an Observer, with estimate(state)")
    return jax.tree_util.Partial(_at_estimate, as_partial(observer.estimate), _stationary(feedback, name))


@front_door
def _at_estimate(estimate: Callable, feedback: Callable, information: Any) -> Array:
    x = jnp.asarray(estimate(information))
    return jnp.asarray(feedback(0.0, x), x.dtype)


@front_door
def averaged_hamiltonian(problem: Problem, solution: Solution, observer: GridFilter) -> AveragedHamiltonian:
    """A controller that minimises the Hamiltonian averaged over what the filter knows of the state.

        u = argmin_u ⟨σ, L(·, u) + f(·, u)·DV + ½ tr(a(·, u) D²V)⟩

    Finite sets are enumerated. On a box or a ball the formulas of the minimum hold where the average is a separable
    quadratic in u, as the jaxprs of drift, cost and noise show; else samples, a pattern search and Newton's method find
    it. DV is made of central differences, so that kinks of V are smeared over two cells; where V is not finite there
    are no slopes, and that part of the law is taken for DV = 0. Nodes in the target do not count while there is
    probability outside it. One control costs a pass over the nodes for every u that is tried.

    Args:
      problem: what was solved.
      solution: what ``solve`` returned for it, with every state controlled.
      observer: the filter; its grid need not be that of the solution, in whose box it must lie.

    Returns:
      A pytree, called with the filter's state; ``.average(state, u)`` is what is minimised.

    Raises:
      TypeError: no Problem, no Solution, no GridFilter.
      ValueError: a game, no controls, functions that depend on time, a marched solution, grids that do not fit.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-3.0], [3.0]), noise=0.5)
      >>> grid = hjb.Grid([-4.0], [4.0], (41,))
      >>> x = grid.axis(0)
      >>> known = hjb.Solution(grid, 0.5 * x**2, -x[:, None])  # up to a constant; else ``hjb.solve``
      >>> observer = GridFilter(plant, lambda x: x, grid, lambda x: jnp.exp(-2 * (x - 0.5) @ (x - 0.5)))
      >>> round(float(averaged_hamiltonian(plant, known, observer)(observer.initial())[0]), 3)  # less the mean
      -0.5
    """
    name = "averaged_hamiltonian"
    for got, wanted in ((problem, Problem), (solution, Solution), (observer, GridFilter)):
        if not isinstance(got, wanted):
            raise TypeError(f"{name}: got {type(got).__name__}, wanted a {wanted.__name__}")
    if problem.is_game or problem.time_dependent or problem.controls is None:
        what = "disturbances" if problem.is_game else "no controls" if problem.controls is None else "a time"
        raise ValueError(
            f"{name}: got a problem with {what}, wanted one player whose functions take (x, u); for a game see "
            "minimum_stress, and make the time a state with drift 1"
        )
    _check_stationary(solution, name)
    check_box(solution.grid, observer.grid, name)
    if not is_traced(solution.value) and (bad := int(np.sum(np.isnan(solution.value)))):
        raise ValueError(f"{name}: V is NaN at {bad} nodes, wanted numbers, infinite where the target is out of reach")
    grid, n = observer.grid, observer.grid.ndim
    problem = closures.settled(problem, n)
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
    """A controller that acts as in the worst state, where p + V is largest: what was seen and what is to come.

        u = u*(x̄),    x̄ = argmax_x { p(x) + V(x) }

    V is the value of the H∞ game with the filter's γ and σ, ``attenuation(problem, gamma, disturbances,
    enters=sigma)``. A γ that is too small for both Riccati equations together leaves p + V no maximum inside: x̄ runs
    to an end of the box, of which ``simulate_output`` warns.

    Args:
      observer: the robust filter; its grid need not be that of the solution, in whose box it must lie.
      solution: V; of a marched one the earliest kept time counts, where it should have settled.

    Keyword Args:
      feedback: u*, a function of the state or a ``greedy_feedback``; ``None``: the solution's control.

    Returns:
      A pytree, called with the filter's state; ``.worst_case(state)`` is x̄, ``.stress(state)`` the largest p + V.

    Raises:
      TypeError: no RobustGridFilter, no Solution, a feedback that cannot be called.
      ValueError: grids that do not fit, a V that is not finite at a node of the filter.

    Example:
      >>> import hjbjax as hjb
      >>> plant = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-3.0], [3.0]))
      >>> grid = hjb.Grid([-2.0], [2.0], (41,))
      >>> x = grid.axis(0)
      >>> known = hjb.Solution(grid, 0.25 * x**2, -0.5 * x[:, None])  # else of ``hjb.attenuation(plant, 2.0, ...)``
      >>> observer = RobustGridFilter(plant, lambda x: x, grid, lambda x: -2 * (x - 0.5) @ (x - 0.5), 2.0)
      >>> control = minimum_stress(observer, known)
      >>> round(float(control.worst_case(observer.initial())[0]), 4), round(float(control(observer.initial())[0]), 4)
      (0.5714, -0.2857)
    """
    name = "minimum_stress"
    for got, wanted in ((observer, RobustGridFilter), (solution, Solution)):
        if not isinstance(got, wanted):
            raise TypeError(f"{name}: got {type(got).__name__}, wanted a {wanted.__name__}")
    if solution.times is not None:
        kept = {each: getattr(solution, each) for each in ("value", "policy", "disturbance")}
        first = {each: array[0] for each, array in kept.items() if array is not None}
        solution = dataclasses.replace(solution, times=None, **first)
    check_box(solution.grid, grid := observer.grid, name)
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
                "maximum; take a smaller box for the filter"
            )
    return MinimumStress(grid, value, acts)


def _double(*trees: Any) -> Any:
    """float64, but not in the middle of somebody's trace."""
    return own_settings(x64=jnp.result_type(float) == np.float64 or not is_traced(*trees))


def _stationary(feedback: Any, name: str) -> Callable:
    """A feedback as a pytree that is called with the time, which does not matter, and the state."""
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
    """Refuse what was marched: a controller is not told the time."""
    if solution.times is not None:
        raise ValueError(
            f"{name}: got a marched solution, wanted a stationary one: the information state does not hold the time; "
            "give simulate_output the solution itself for certainty equivalence, or make the time a state with drift 1"
        )


def _slopes(solution: Solution, grid: Grid) -> Array:
    """DV at the nodes of a grid, shape (*grid, n), zero where V has none."""
    slopes = solution.costate_at(states_of(grid), clamp=True)
    return jnp.where(jnp.isfinite(slopes), slopes, 0)


def _bends(solution: Solution, grid: Grid) -> dict[tuple[int, int], Costate]:
    """D²V at the nodes of a grid by pairs of axes: central differences of central differences."""
    n = grid.ndim
    slopes = _slopes(solution, solution.grid)
    rows = [_slopes(dataclasses.replace(solution, value=slopes[..., i]), grid) for i in range(n)]
    # mixed differences commute on an even grid; their mean is symmetric on any
    return {(i, j): (rows[i][..., j] + rows[j][..., i]) / 2 for i in range(n) for j in range(i, n)}
