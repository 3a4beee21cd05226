"""Stationary equilibria: a price at which the excess of a stationary population is zero.

At a price r the population solves the problem of this price, lives under its policy, and has the stationary law μ_r of
the chain. The equilibrium price solves

    E(r) = excess(r, V_r, μ_r) = 0,

for example the demand for bonds Σ μ a (Huggett), or the supply of capital minus the demand of firms (Aiyagari). A
bracketing search finds it, see ``root_search``. Each evaluation is one ``solve``, which starts from the value at the
nearest price so far, and one stationary law.

With parameters θ, E(r, θ) = 0, so the implicit function theorem gives

    dr/dθ = −(∂E/∂θ)/(∂E/∂r),

with the derivatives of ``solve`` and of ``stationary_law``, each of which is a linear solve. The steps of the search
are not differentiated.

The law of a chain is of first order in the spacing, so on a usual grid the price has a much larger error than V. It is
estimated by one more population at the same price on a coarser grid, |E_coarse − E| / |∂E/∂r|.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.applications import root_search
from hjbjax.applications.root_search import Search
from hjbjax.discretisation.discretisation import Chain
from hjbjax.discretisation.schemes import Upwind
from hjbjax.iteration.methods import Method
from hjbjax.markov_chain import chain
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.mode_axis import over_modes, without_modes
from hjbjax.problem.problem import Problem, is_constrained, is_discounted
from hjbjax.problem.pytree import altered, as_jax, front_door, is_traced, pytree_dataclass
from hjbjax.problem.rewards import costs_of
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import with_any_control
from hjbjax.problem.types import Array, Nodes, Number
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import keeping_warnings, warn
from hjbjax.solvers import nested_grids
from hjbjax.solvers.stationary import solve
from hjbjax.tracing.closures import holds_tracers, settled

COARSE = 0.1  # grid error that is worth a warning, relative to the price and to the width of the bracket
APART = 1e-3  # distance of two prices for the slope of the excess, as a fraction of the bracket
MOST = 100  # evaluations: bisection needs 20 for 1e-6, and the search at most about three times as many


@pytree_dataclass(host=("tried", "grid_error"))
class Equilibrium:
    """A price with the solution, the law and the excess of the population at this price.

    Args:
      price: the price r, a number.
      excess: the excess at this price.
      solution: the ``Solution`` of the problem at this price.
      law: the stationary law under its policy, one probability per node, in the shape of ``solution.value``.
      tried: the prices that were tried and their excess, shape (k, 2), in order; empty on return from ``jit``.
      grid_error: an estimate of the discretisation error of the price from a coarser grid, of first order in the
        spacing. ``None`` on return from ``jit``, and if no coarser grid has a population at this price.
    """

    price: Any
    excess: Any
    solution: Solution
    law: Array
    tried: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))
    grid_error: float | None = None

    def __repr__(self) -> str:
        if is_traced(self.price) or np.ndim(self.price):
            return f"Equilibrium(price={self.price}, excess={self.excess})"
        solves = f" after {len(self.tried)} solves" if len(self.tried) else ""
        error = "" if self.grid_error is None else f", grid error about {self.grid_error:.2g}"
        return f"Equilibrium(price {float(self.price):.9g}{error}, excess {float(self.excess):.2g}{solves})"


@dataclasses.dataclass(frozen=True)
class _Economy:
    """The arguments of ``equilibrium`` that define E.

    Attributes:
      problem_of, grid, excess, scheme, method: as in ``equilibrium``.
      solve_tol: the tolerance of each solve.
    """

    problem_of: Callable
    grid: Grid
    excess: Callable
    scheme: Chain
    method: Method | None
    solve_tol: Number

    def at(self, price: Any, guess: Nodes | None) -> Equilibrium:
        """The population at one price, in equilibrium or not."""
        solution, law = self.population(price, guess)
        return Equilibrium(price, self.excess_of(price, solution, law), solution, law)

    def population(self, price: Any, guess: Nodes | None) -> tuple[Solution, Array]:
        """The solution at one price and the law under its policy."""
        problem = self.problem_of(price)
        if not isinstance(problem, Problem):
            raise TypeError(f"equilibrium: problem_of({price}) returned {problem!r:.60}, wanted a Problem")
        many = is_constrained(problem) and not is_discounted(problem)  # solve refuses a guess for these
        solution = solve(
            problem,
            self.grid,
            scheme=self.scheme,
            method=self.method,
            tol=self.solve_tol,
            guess=None if many else guess,
        )
        law = chain.stationary_law(
            problem, self.grid, solution.policy, disturbance=solution.disturbance, scheme=self.scheme
        )
        return solution, law

    def excess_of(self, *found: Any) -> Any:
        """The excess as one number; in double precision on the host."""
        with own_settings(x64=None if is_traced(found) else True):
            excess = self.excess(*found)
        shape = np.shape(excess)
        if shape != () or (not is_traced(excess) and not arguments.is_number(excess)):
            got = f"an array of shape {shape}" if shape else arguments.shown(excess)
            raise TypeError(f"equilibrium: excess(price, solution, law) returned {got}, wanted one real number")
        return excess if is_traced(excess) else float(excess)


@front_door
def equilibrium(
    problem_of: Callable[[Any], Problem],
    grid: Grid,
    excess: Callable[[Any, Solution, Any], Any],
    bracket: Sequence[float] | Array,
    *,
    tol: float = 1e-6,
    solve_tol: float = 1e-8,
    scheme: Chain = Upwind(),
    method: Method | None = None,
) -> Equilibrium:
    """Find a price at which the excess of the stationary population is zero, in about ten solves.

    E(r) = excess(r, V_r, μ_r) = 0, where V_r solves ``problem_of(r)`` and μ_r is the stationary law under its policy.
    The price may be any number in the problem: an interest rate, a wage, a tax.

    One more population on a coarser grid gives ``grid_error``, an estimate of the discretisation error of the price. It
    is of first order in the spacing. A warning says so if it exceeds a tenth of the price and of the bracket.

    E must be continuous with one change of sign in the bracket. Searched optima, as for u^γ, have small errors that
    limit the accuracy of E; optima by formulas do not.

    Args:
      problem_of: a function of the price that returns the ``Problem`` of one member of the population.
      grid: the grid of its state.
      excess: a function of the price, the solution and its law that returns demand minus supply, a number, such as
        ``lambda r, solution, law: jnp.sum(law * wealth)``. The law has the shape of ``solution.value``.
      bracket: two prices at which the excess has opposite signs, increasing. The problem must have a finite value and a
        stationary law at both prices. With an interest rate above the discount, for example, it has neither.
      tol: the largest error of the price, as a fraction of the width of the bracket.
      solve_tol: ``tol`` of each solve, in cost units.
      scheme: the chain of the value and of the law.
      method: as in ``solve``.

    Returns:
      The equilibrium, that is, the tried price with the smallest excess. Inside ``jit``, ``vmap`` and ``grad``, which
      require 64-bit numbers (``jax.enable_x64(True)``), price and population have first derivatives, in both modes,
      with respect to every number that ``problem_of``, ``excess`` and the grid read. Put ``jax.jit`` around a gradient
      that is evaluated repeatedly, because the search is otherwise compiled at each call. Without a change of sign the
      result is NaN there.

    Raises:
      ValueError: the excess has the same sign at both ends of the bracket, or is not finite; the bracket is invalid; a
        problem has no solution or no unique law.
      TypeError: ``problem_of`` does not return a problem, or ``excess`` does not return a number.
      SolveError: a solve does not converge; a note on the error names the price.

    Example:
      >>> import jax.numpy as jnp
      >>> import hjbjax as hjb
      >>> def firm(price):  # capital x depreciates at the rate 1, is built at the cost u²/2, and earns the price
      ...     return hjb.Problem(
      ...         lambda x, u: u - x, reward=lambda x, u: price * x[0] - u[0] ** 2 / 2,
      ...         controls=hjb.Box([-9.0], [9.0]), noise=0.3, discount=1.0,
      ...     )
      >>> grid = hjb.Grid([-3.0], [4.0], (71,))
      >>> found = equilibrium(firm, grid, lambda p, _, law: jnp.sum(law * grid.axis(0)) - (2 - p), (0.5, 3.0))
      >>> round(float(found.price), 5)  # the mean capital is p/2, the demand 2 − p
      1.33333
    """
    ends = _check(problem_of, grid, excess, bracket)
    arguments.positive(tol, "equilibrium: tol", "as a fraction of the bracket", most=0.5)
    arguments.positive(solve_tol, "equilibrium: solve_tol", "in the units of the cost")
    economy = _Economy(problem_of, grid, excess, scheme, method, solve_tol)
    if is_traced(ends, grid) or holds_tracers(excess) or _is_open(problem_of, ends[0], grid):
        return _in_program(economy, ends, tol)
    return _on_host(economy, float(ends[0]), float(ends[1]), tol)


def _check(problem_of: Any, grid: Any, excess: Any, bracket: Any) -> Any:
    """The ends of the bracket, after checking the arguments."""
    for name, function in (("problem_of", problem_of), ("excess", excess)):
        if not callable(function):
            raise TypeError(f"equilibrium: {name} is {arguments.shown(function)}; wanted a function")
    if not isinstance(grid, Grid):
        raise TypeError(f"equilibrium: got {arguments.shown(grid)}; wanted a Grid")
    return check_bracket(bracket, "equilibrium")


def check_bracket(bracket: Any, name: str) -> Any:
    """The two ends of a bracket, shape (2,); ``name`` is the function that the user called."""
    wanted = "wanted two finite prices lo < hi, such as (0.0, 0.05)"
    if is_traced(bracket):
        ends = jnp.stack([*bracket]) if isinstance(bracket, (tuple, list)) else bracket
        if np.shape(ends) != (2,):
            raise ValueError(f"{name}: the bracket has shape {np.shape(ends)}; {wanted}")
        return ends
    try:
        ends = np.asarray(bracket, np.float64)
    except (TypeError, ValueError):
        ends = np.zeros(0)
    if ends.shape != (2,) or not np.all(np.isfinite(ends)) or ends[0] >= ends[1]:
        raise ValueError(f"{name}: the bracket is {arguments.shown(bracket)}; {wanted}")
    return ends


def _is_open(problem_of: Callable, price: Any, grid: Grid) -> bool:
    """True if the problem depends on tracers of a caller's transformation."""
    problem = problem_of(float(price))
    if not isinstance(problem, Problem):
        return False
    n = without_modes(grid).ndim
    joined = over_modes(costs_of(problem), n)
    n += problem.modes is not None
    return is_traced(settled(with_any_control(joined, n), n))


# --- on the host ---


def _on_host(economy: _Economy, lo: float, hi: float, tol: float) -> Equilibrium:
    """The search with known numbers."""
    found: list[Equilibrium] = []
    warnings: list[list[str]] = []

    def evaluate(price: float) -> float:
        near = min(found, key=lambda each: abs(each.price - price), default=None)
        guess = None if near is None or not np.all(np.isfinite(near.solution.value)) else near.solution.value
        try:
            with keeping_warnings() as said:
                found.append(economy.at(price, guess))
        except (ValueError, SolveError) as error:
            error.add_note(f"equilibrium: this was at the price {price:.9g}")
            raise
        warnings.append(said)
        if not np.isfinite(found[-1].excess):
            raise ValueError(f"equilibrium: the excess is {found[-1].excess} at the price {price:.9g}; wanted a number")
        return found[-1].excess

    at_lo, at_hi = evaluate(lo), evaluate(hi)
    if at_lo * at_hi > 0:
        raise ValueError(
            f"equilibrium: the excess is {at_lo:.6g} at the price {lo:.6g} and {at_hi:.6g} at {hi:.6g}; wanted "
            "opposite signs,\nso that a root lies between. Move an end of the bracket; excess is demand minus supply"
        )
    search, width = root_search.begin_search(lo, at_lo, hi, at_hi), tol * (hi - lo)
    while not root_search.is_done(search, width) and len(found) < MOST:
        price = float(root_search.proposal(search))
        search = root_search.narrowed(search, price, evaluate(price), width)
    tried = np.array([[each.price, each.excess] for each in found])
    best = int(np.argmin(np.abs(tried[:, 1])))
    for warning in warnings[best]:  # other prices are not part of the result
        warn(warning)
    error = _grid_error(economy, found[best], tried, hi - lo)
    if error is not None and error > COARSE * max(hi - lo, abs(found[best].price)):
        warn(
            f"equilibrium: the grid is coarse for this price: the error of the price is about {error:.2g} "
            "(Equilibrium.grid_error). Use more nodes, or concentrate nodes where many members of the population are, "
            "such as at a limit: Grid(..., stretch=)"
        )
    return dataclasses.replace(found[best], tried=tried, grid_error=error)


def _grid_error(economy: _Economy, found: Equilibrium, tried: np.ndarray, width: float) -> float | None:
    """An estimate of the error of the price from the population on a coarser grid; None if there is none."""
    coarse = nested_grids.coarser(economy.grid)
    apart = np.abs(tried[:, 0] - found.price)
    far = apart >= min(APART * width, apart.max())  # the excess of closer prices has few digits left
    other = tried[far][np.argmin(apart[far])]
    slope = (other[1] - found.excess) / (other[0] - found.price)
    if coarse is None or not np.isfinite(slope) or slope == 0:
        return None
    try:
        with keeping_warnings():  # they are about a grid that the user has not chosen
            rough, law = dataclasses.replace(economy, grid=coarse).population(found.price, None)
    except (ValueError, SolveError):
        return None
    # on the nodes of the user's grid, because the user's function may read their coordinates
    fine = found.solution.grid
    moved = dataclasses.replace(
        found.solution,
        value=nested_grids.prolong(np.asarray(rough.value), rough.grid, fine),
        policy=_prolonged(rough.policy, rough.grid, fine),
        disturbance=None if rough.disturbance is None else _prolonged(rough.disturbance, rough.grid, fine),
    )
    excess = economy.excess_of(found.price, moved, _shared_out(np.asarray(law), rough.grid, fine))
    return abs((excess - found.excess) / slope)


def _prolonged(actions: Array, coarse: Grid, fine: Grid) -> np.ndarray:
    """The actions (*coarse, m) of a player between the nodes, (*fine, m)."""
    inputs = np.moveaxis(np.asarray(actions), -1, 0)
    shape = (len(inputs), *fine.shape)
    return np.moveaxis(np.reshape([nested_grids.prolong(each, coarse, fine) for each in inputs], shape), 0, -1)


def _shared_out(law: np.ndarray, coarse: Grid, fine: Grid) -> np.ndarray:
    """A law (*coarse,) as a law (*fine,): each probability goes to the two next nodes, so that means stay the same."""
    for axis in fine.state_axes:
        nodes, x = np.asarray(fine.axis(axis)), np.asarray(coarse.axis(axis))
        nodes = np.append(nodes, float(fine.hi[axis])) if fine.periodic[axis] else nodes
        cell = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
        share = np.clip((x - nodes[cell]) / (nodes[cell + 1] - nodes[cell]), 0, 1)
        matrix = np.zeros((fine.shape[axis], len(x)))
        np.add.at(matrix, (cell, np.arange(len(x))), 1 - share)
        np.add.at(matrix, ((cell + 1) % fine.shape[axis], np.arange(len(x))), share)
        law = np.moveaxis(np.tensordot(matrix, law, (1, axis)), 0, axis)
    return law


# --- inside a transformation ---


def _in_program(economy: _Economy, ends: Any, tol: Number) -> Equilibrium:
    """The same search in a compiled loop, and the price as a differentiable function of the numbers in the economy."""
    if jnp.result_type(float) != np.float64:  # single precision stops each solve far above solve_tol
        raise ValueError(
            "equilibrium: got 32-bit numbers inside jit, vmap or grad, wanted 64-bit numbers: the root of an excess "
            "needs their digits.\nPut `with jax.enable_x64(True):` around the call of the transformed function"
        )
    ends = jnp.asarray(ends, float)
    like = jax.eval_shape(lambda price: economy.at(price, None).solution.value, ends[0])
    nothing = jnp.zeros(like.shape, ends.dtype)

    def of_price(price: Any, guess: Any) -> tuple[Any, Any]:
        found = economy.at(price, guess)
        return jnp.asarray(found.excess, ends.dtype), jnp.asarray(found.solution.value, ends.dtype)

    # the tracers that the user's functions read become arguments, so that the search can do without their derivatives
    opened = jax.make_jaxpr(of_price)(ends[0], nothing)
    numbers = as_jax(opened.consts)
    still, ends = jax.lax.stop_gradient((numbers, ends))

    def evaluated(numbers: list, price: Any, guess: Any) -> Any:
        return jax.core.eval_jaxpr(opened.jaxpr, numbers, price, guess)

    root, value, found = _search(functools.partial(evaluated, still), ends, tol, nothing)
    slope = jax.jvp(lambda price: evaluated(still, price, value)[0], (root,), (jnp.ones_like(root),))[1]
    excess = evaluated(numbers, root, value)[0]
    # equal to ``root``, with the derivative −dE/(∂E/∂r) of the implicit function
    price = root - (excess - jax.lax.stop_gradient(excess)) / jax.lax.stop_gradient(slope)
    result, known = economy.at(price, value), jnp.where(found, 1.0, jnp.nan)
    solution = altered(result.solution, value=result.solution.value * known, policy=result.solution.policy * known)
    return Equilibrium(price * known, result.excess * known, solution, result.law * known)


def _search(of_price: Callable, ends: Any, tol: Any, nothing: Any) -> tuple[Any, Any, Any]:
    """The root in a bracket, the value of the last evaluation, and True if the excess changes its sign."""
    lo, hi = ends
    width = tol * (hi - lo)

    def unfinished(carry: tuple) -> Any:
        search, _, count = carry
        crossing = jnp.sign(search.f_near) != jnp.sign(search.f_far)
        return (count < 2) | (crossing & ~root_search.is_done(search, width) & (count < MOST))

    def step(carry: tuple) -> tuple:
        search, value, count = carry
        # both ends first, in the same loop, because each place that solves takes seconds to compile
        price = jnp.where(count == 0, lo, jnp.where(count == 1, hi, root_search.proposal(search)))
        excess, found = of_price(price, value)
        begun = root_search.begin_search(lo, search.f_far, hi, excess)
        first = search._replace(f_far=excess)
        later = root_search.narrowed(search, price, excess, width)
        search = jax.tree.map(
            lambda *each: jnp.select([count == 0, count == 1], each[:2], each[2]), first, begun, later
        )
        return search, jnp.where(jnp.all(jnp.isfinite(found)), found, nothing), count + 1

    blank = Search(*(jnp.ones((), ends.dtype),) * 7)
    search, value, _ = jax.lax.while_loop(unfinished, step, (blank, nothing, jnp.zeros((), jnp.int32)))
    found = jnp.isfinite(search.f_near * search.f_far) & (jnp.sign(search.f_near) != jnp.sign(search.f_far))
    return root_search.best(search)[0], value, found
