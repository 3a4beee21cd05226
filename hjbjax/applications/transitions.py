"""Transitions to a stationary equilibrium: the path of prices at which a market clears at every time.

At t = 0 the parameters of an economy change, and its law μ_0 is still the old one. Over N steps of length Δt = T/N,
with a constant price p_n in each,

    V_n = min_u [ L + 𝓛V_n ] discounted, from V_{n+1}, by one step of ``Implicit``,    V_N = V of the new equilibrium,
    μ_{n+1} = (1 − Δt 𝓛*)⁻¹ μ_n,    with the jump rates of the chain at p_n under the policy of V_n,
    E_n = excess(p_n, V_n, μ_{n+1}) = 0.

Both steps are implicit and of first order in Δt, as in Achdou et al. (2022). The law stays non-negative with the same
sum. The excess is evaluated at the end of each step, because a wealth Σ μ a responds to an interest only after a time.

The N equations are solved by Newton steps with the Jacobian J at the new equilibrium. N linear steps give all of J,
because in a stationary economy the response to a price depends only on the time until it is paid. With
𝒱_k = ∂V_n/∂p_{n+k}, 𝒟_k the change of the law in the step n, and ℰ_j the mean excess of a unit mass j steps later,

    J[n, s] = J[n − 1, s − 1] + ℰ_n·𝒟_s,  plus  ∂E/∂p + ∂E/∂V·𝒱_{s−n}  for s ≥ n,

see Auclert, Bardóczy, Rognlie and Straub (2021). Broyden's update improves J from step to step, and a step that does
not decrease the correction |J⁻¹E| is halved.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.applications.equilibrium import Equilibrium, check_bracket
from hjbjax.discretisation.discretisation import Chain
from hjbjax.discretisation.rates import Rates
from hjbjax.discretisation.schemes import Upwind
from hjbjax.iteration.time_methods import Implicit
from hjbjax.markov_chain import laws
from hjbjax.markov_chain.policy_rates import traced_rates
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, front_door
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status, warn
from hjbjax.solvers.finite_horizon import march
from hjbjax.tracing.closures import refuse_traced

MOST = 60  # Newton steps: a moderate change needs 3 to 8
SHORTEST = 1 / 64  # the shortest fraction of a Newton step
SHIFT = 1e-3  # step of finite differences, as a fraction of the bracket; errors of the solves must not matter
NEAR = 0.02  # if more than this fraction of the change of the law is left at the horizon, it is too short
# fields of a solution that belong to the stationary problem
STATIONARY = ("enclosure", "isaacs_gap", "grid_error", "box_error", "monotone_error", "cut", "stopping", "active")
NODES = ("value", "policy", "disturbance")
ROUNDING = 1e-6  # difference of probabilities that two solves to the same tolerance may have
MESSAGES = {
    Status.CONVERGED: "The market clears in every time step to the requested tolerance.",
    Status.STALLED: "No part of a Newton step decreases the excess. Begin with guess= from a smaller change, or use "
    "more steps.",
    Status.MAX_STEPS: f"The excess is not below the tolerance after {MOST} Newton steps; raise tol or lower solve_tol.",
    Status.NONFINITE: "NaN or infinity appeared at these prices; move the end of the bracket that has no value.",
}


@dataclasses.dataclass(frozen=True)
class Transition:
    """A path of prices with the values, the policies and the laws of the population.

    Args:
      times: t_0 = 0, ..., t_N = T, shape (N + 1,).
      prices: the price from each time to the next, shape (N,).
      excess: the excess in each step, shape (N,).
      laws: the law at every time, shape (N + 1, *grid), with the modes first as in ``solution.value``.
      solution: value and policy at every time, like the solution of a march.
      error: the last Newton correction of the prices, an estimate of their largest error for these time steps.
      history: the largest |excess| and the largest correction before every Newton step, shape (k, 2).
      status: a ``Status``.
      message: an explanation of the status.
    """

    times: np.ndarray
    prices: np.ndarray
    excess: np.ndarray
    laws: np.ndarray
    solution: Solution
    error: float
    history: np.ndarray
    status: Status
    message: str

    def __repr__(self) -> str:
        return (
            f"Transition({self.status} after {len(self.history)} iterations, price {self.prices[0]:.6g} to "
            f"{self.prices[-1]:.6g} in {len(self.prices)} steps, excess {np.max(np.abs(self.excess)):.2g})"
        )


@front_door
def transition(
    problem_of: Callable[..., Problem],
    excess: Callable[..., Any],
    law: Array,
    after: Equilibrium,
    horizon: float,
    bracket: Sequence[float] | Array,
    *,
    steps: int = 100,
    time_dependent: bool = False,
    guess: Array | None = None,
    tol: float = 1e-6,
    solve_tol: float = 1e-8,
    scheme: Chain = Upwind(),
    throw: bool = True,
) -> Transition:
    """Find the path of prices from the law of an old equilibrium to a new equilibrium.

    Everybody knows the future prices from t = 0 on, and the market clears at the end of every time step. Value and law
    move by implicit steps, so the error is first order in the step; compare with ``2 * steps``.

    Args:
      problem_of: a function of the price that returns the ``Problem``, as in ``equilibrium``, after the change.
      excess: a function of the price, the solution and the law, as in ``equilibrium``. It is traced by JAX, so it must
        be written with ``jax.numpy``.
      law: the law at t = 0, shape (*grid), with the modes first: usually that of the old equilibrium on the same grid.
      after: the new equilibrium, from ``equilibrium`` with the same functions and the same scheme.
      horizon: T > 0, at which the economy has come close to ``after``, in units of time.
      bracket: two numbers between which all prices stay, increasing. Prices of a transition may lie outside of the
        bracket of a stationary equilibrium: for some time an interest may exceed the discount.
      steps: N, the number of time steps.
      time_dependent: call ``problem_of(t, price)`` and ``excess(t, price, solution, law)``, for a change that is not
        the same at all times, such as a shock that fades; ``after`` is then the equilibrium for large t.
      guess: initial prices, shape (N,), such as those of a similar transition; ``None`` is the new price everywhere.
      tol: the largest error of a price, as a fraction of the width of the bracket.
      solve_tol: the algebraic error of each time step, in cost units.
      scheme: the chain of the value and of the law.
      throw: raise if the prices are not found; otherwise ``status`` reports it.

    Returns:
      The transition; host level only. Warns if the law at the horizon is still far from the law of ``after``.

    Raises:
      ValueError: an argument is invalid, or ``march`` or ``chain.generator`` refuses the problem.
      SolveError: no prices in the bracket were found at which the market clears; ``.solution`` is the ``Transition``
        with the smallest correction.

    Example:
      >>> import hjbjax as hjb
      >>> def firm(price, decay):  # capital decays, is built at the cost u²/2, and earns the price
      ...     return hjb.Problem(
      ...         lambda x, u: u - decay * x, reward=lambda x, u: price * x[0] - u[0] ** 2 / 2,
      ...         controls=hjb.Box([-9.0], [9.0]), noise=0.3, discount=1.0,
      ...     )
      >>> grid = hjb.Grid([-3.0], [4.0], (71,))
      >>> def excess(price, solution, law):
      ...     return jnp.sum(law * grid.axis(0)) - (2 - price)
      >>> old, new = (hjb.equilibrium(lambda p: firm(p, d), grid, excess, (0.5, 3.0)) for d in (1.0, 1.2))
      >>> path = transition(lambda p: firm(p, 1.2), excess, old.law, new, 8.0, (0.5, 3.0), steps=32)
      >>> path.prices[[0, 5, -1]].round(3).tolist()  # from 4/3 to 1.451 as capital declines
      [1.366, 1.433, 1.451]
    """
    refuse_traced("transition", problem_of, excess, law, after.price, horizon, guess)
    arguments.positive(horizon, "transition: horizon", "in units of time")
    arguments.count(steps, "transition: steps")
    arguments.positive(tol, "transition: tol", "as a fraction of the bracket", most=0.5)
    arguments.positive(solve_tol, "transition: solve_tol", "in the units of the cost")
    ends = check_bracket(bracket, "transition")
    start = _start(guess, steps, float(after.price), ends)
    law = laws.check_law(law, after.solution.grid, "transition")
    economy = _Economy(problem_of, excess, after, law, float(horizon) / steps, time_dependent, scheme, solve_tol)
    with own_settings(x64=True):
        jax.eval_shape(economy.excess_of, 0, 0.0, economy.at_rest(), law)  # refused before anything is compiled
        found = _find(economy, start, ends, tol * (ends[1] - ends[0]))
    if throw and found.status is not Status.CONVERGED:
        raise SolveError(f"{found.status}: {found.message}", found)
    _warn_of_rest(found, np.asarray(after.law))
    return found


def _start(guess: Any, steps: int, price: float, ends: np.ndarray) -> np.ndarray:
    """The initial prices, shape (N,)."""
    if not ends[0] <= price <= ends[1]:
        raise ValueError(
            f"transition: the price of the new equilibrium is {price:.6g}, outside of the bracket {ends.tolist()}; "
            "wanted a\nbracket of all prices of the transition"
        )
    prices = np.full(steps, price) if guess is None else np.asarray(guess, np.float64)
    if prices.shape != (steps,) or not np.all(np.isfinite(prices)):
        raise ValueError(
            f"transition: got a guess of shape {prices.shape}, wanted {(steps,)}: one finite price per step"
        )
    return np.clip(prices, *ends)


def _warn_of_rest(found: Transition, law: np.ndarray) -> None:
    """Warn if the law at the horizon is far from the new stationary law."""
    apart = np.abs(found.laws - law).reshape(len(found.laws), -1).sum(axis=1) / 2
    if apart[-1] > NEAR * apart.max() + ROUNDING:
        warn(
            f"transition: at the horizon {found.times[-1]:g} the law differs from the new stationary law by "
            f"{apart[-1]:.2g}, after at most {apart.max():.2g} before. The last value is that of the new equilibrium, "
            "so prices near the horizon are wrong. Use a longer horizon"
        )


# --- the economy under a path of prices ---


class _Run(NamedTuple):
    """The population under a path of prices: excess (N,), laws (N + 1, *grid), values and actions by name (N, ...)."""

    prices: np.ndarray
    excess: np.ndarray
    laws: np.ndarray
    players: dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class _Economy:
    """The arguments of ``transition`` that define E; ``law`` is μ_0 and ``step`` is Δt."""

    problem_of: Callable[..., Problem]
    excess: Callable[..., Any]
    after: Equilibrium
    law: np.ndarray
    step: float
    time_dependent: bool
    scheme: Chain
    solve_tol: Number

    @property
    def grid(self) -> Grid:
        """The nodes, with the modes first."""
        return self.after.solution.grid

    def run(self, prices: np.ndarray) -> _Run:
        """Values backward and laws forward under these prices."""
        players, rates = self.backward(prices)
        path = np.empty((len(prices) + 1, *self.grid.shape))
        path[0] = self.law
        for n in range(len(prices)):
            path[n + 1] = _advanced(_at(rates, n), self.grid, path[n], self.step)
        return _Run(prices, self.excesses(prices, players, path[1:]), path, players)

    def backward(self, prices: np.ndarray) -> tuple[dict[str, np.ndarray], Rates]:
        """Values and actions in every step, by name, and the jump rates under the actions; each (N, ...)."""
        return jax.device_get(self._backward(prices, self.at_rest()["value"]))

    def excesses(self, prices: np.ndarray, players: dict[str, np.ndarray], ends: np.ndarray) -> np.ndarray:
        """The excess in every step, shape (N,), with the laws at the ends of the steps."""
        return np.asarray(self._excesses(np.arange(len(prices)), prices, players, ends))

    # programs of this economy, compiled once

    @functools.cached_property
    def _backward(self) -> Callable:
        def step(ahead: Any, entry: tuple) -> tuple[Any, Any]:
            n, price = entry
            players, rates = self._back(n, price, ahead)
            return players["value"], (players, rates)

        def backward(prices: Any, last: Any) -> Any:
            return jax.lax.scan(step, last, (jnp.arange(len(prices)), prices), reverse=True)[1]

        return jax.jit(backward)

    @functools.cached_property
    def _excesses(self) -> Callable:
        return jax.jit(jax.vmap(self.excess_of))

    def _back(self, n: Any, price: Any, ahead: Any) -> tuple[dict[str, Any], Rates]:
        """Value and actions in the step n from the value after it, by name, and the jump rates under the actions."""
        problem = self._problem(n, price)
        found = march(
            problem, self.grid, self.step, start=ahead, step=self.step, scheme=self.scheme,
            method=Implicit(tol=self.solve_tol),
        )  # fmt: skip
        players = {name: each[0] for name in NODES if (each := getattr(found, name)) is not None}
        rates = traced_rates(problem, self.grid, players.get("policy"), players.get("disturbance"), self.scheme)
        return players, rates

    def at_rest(self) -> dict[str, np.ndarray]:
        """Value and actions of the new equilibrium, by name."""
        found = {name: getattr(self.after.solution, name) for name in NODES}
        return {name: np.asarray(each, np.float64) for name, each in found.items() if each is not None}

    def excess_of(self, n: Any, price: Any, players: dict[str, Any], law: Any) -> jax.Array:
        """The excess in the step n, a number."""
        solution = altered(self.after.solution, **players, **dict.fromkeys(STATIONARY))
        found = jnp.asarray(self.excess(*self._where(n, price), solution, law), float)
        if found.shape != ():
            raise TypeError(f"transition: excess returned an array of shape {found.shape}, wanted one number")
        return found

    def _where(self, n: Any, price: Any) -> tuple:
        """The arguments of the user's functions in the step n."""
        return (n * self.step, price) if self.time_dependent else (price,)

    def _problem(self, n: Any, price: Any) -> Problem:
        """The problem in the step n."""
        problem = self.problem_of(*self._where(n, price))
        if not isinstance(problem, Problem):
            raise TypeError(f"transition: problem_of returned {arguments.shown(problem)}, wanted a Problem")
        if problem.time_dependent:
            raise ValueError(
                "transition: got a problem with time_dependent=True, wanted one whose functions do not take t.\n"
                "Pass transition(..., time_dependent=True), which calls problem_of(t, price)"
            )
        return problem


def _at(rates: Rates, n: int) -> Rates:
    """The jump rates in one step."""
    return jax.tree.map(lambda leaf: leaf[n], rates)


def _advanced(rates: Rates, grid: Grid, law: np.ndarray, duration: float) -> np.ndarray:
    """The law after an implicit step; NaN if a rate is not finite."""
    if not np.all(np.isfinite(rates.total())):
        return np.full(law.shape, np.nan)
    return laws.implicit_step(rates, grid, duration).solve(law.ravel()).reshape(law.shape)


# --- Newton's method ---


def _jacobian(economy: _Economy, count: int, shift: float) -> np.ndarray:
    """∂E/∂p at the new equilibrium, shape (N, N), from central differences by the price in the last step."""
    price, grid = float(economy.after.price), economy.grid
    law = np.asarray(economy.after.law, np.float64)
    generators, direct = [], []
    for sign in (1, -1):
        prices = np.full(count, price)
        prices[-1] += sign * shift
        players, rates = economy.backward(prices)
        generators.append([laws.sparse_generator(_at(rates, n), grid) for n in range(count)])
        direct.append(economy.excesses(prices, players, np.broadcast_to(law, (count, *law.shape))))
    # entries k = 0, ..., N − 1: the response k steps before the price
    flows = np.stack([(up - down).T @ law.ravel() for up, down in zip(*generators, strict=True)])[::-1] / (2 * shift)
    direct = (direct[0] - direct[1])[::-1] / (2 * shift)
    # the first step is so far from the price that it is stationary
    step = laws.implicit_step(_at(rates, 0), grid, economy.step)
    changes = step.solve(economy.step * flows.T)  # 𝒟_k, one column per k
    first = {name: each[0] for name, each in players.items()}
    means = [np.asarray(jax.jit(jax.grad(economy.excess_of, 3))(count - 1, price, first, law)).ravel()]
    for _ in range(count - 1):
        means.append(step.solve(means[-1], "T"))
    found = np.stack(means) @ changes
    for n in range(1, count):
        found[n, 1:] += found[n - 1, :-1]
    for later in range(count):
        found[np.arange(count - later), np.arange(later, count)] += direct[later]
    return found


def _find(economy: _Economy, start: np.ndarray, ends: np.ndarray, width: float) -> Transition:
    """The prices with excess zero, as far as Newton steps lead; ``width`` is the largest admissible correction."""
    inverse = np.linalg.inv(_jacobian(economy, len(start), SHIFT * (ends[1] - ends[0])))
    now, history, status = economy.run(start), [], Status.RUNNING
    while status is Status.RUNNING:
        correction = -inverse @ now.excess
        size = float(np.max(np.abs(correction)))
        history.append((float(np.max(np.abs(now.excess))), size))
        if not np.isfinite(size):
            status = Status.NONFINITE
        elif size <= width:
            status = Status.CONVERGED
        elif len(history) > MOST:
            status = Status.MAX_STEPS
        else:
            after = _shorter(economy, now, correction, inverse, ends)
            if after is None:
                status = Status.STALLED
            else:
                inverse = _updated(inverse, after.prices - now.prices, after.excess - now.excess)
                now = after
    return _result(economy, now, np.array(history), status, ends)


def _shorter(
    economy: _Economy, now: _Run, correction: np.ndarray, inverse: np.ndarray, ends: np.ndarray
) -> _Run | None:
    """The population after the longest part of a Newton step that decreases the correction; None without one."""
    share, size = 1.0, np.max(np.abs(correction))
    while share >= SHORTEST:
        after = economy.run(np.clip(now.prices + share * correction, *ends))
        if np.max(np.abs(inverse @ after.excess)) < (1 - share / 4) * size:  # False for NaN
            return after
        share /= 2
    return None


def _updated(inverse: np.ndarray, moved: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Broyden's update of J⁻¹ after the prices moved and the excess changed."""
    gained = inverse @ change
    return inverse + np.outer(moved - gained, moved @ inverse) / (moved @ gained)


def _result(economy: _Economy, run: _Run, history: np.ndarray, status: Status, ends: np.ndarray) -> Transition:
    """The transition for the last prices, with an explanation."""
    after, count = economy.after.solution, len(run.prices)
    times = economy.step * np.arange(count + 1)
    players = {name: np.concatenate([run.players[name], [each]]) for name, each in economy.at_rest().items()}
    solution = altered(after, times=times, **players, **dict.fromkeys(STATIONARY))
    message = MESSAGES.get(status, status.message)
    held = int(np.sum((run.prices <= ends[0]) | (run.prices >= ends[1])))
    if held:
        message += f" {held} prices are at an end of the bracket {ends.tolist()}; widen it."
    return Transition(times, run.prices, run.excess, run.laws, solution, history[-1, 1], history, status, message)
