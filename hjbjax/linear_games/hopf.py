"""The generalised Hopf formula as a solution without a grid: ``hopf`` and its ``HopfSolution``.

For x' = A x + B u + C d + c and a convex terminal cost J, with no running cost, the value at time t is

    V(t, x) = −min_p [ J*(p) − p·x(T) + ∫ σ_U(−B'e^{A's}p) − σ_D(C'e^{A's}p) ds ]

where x(T) is the end of the path without control. The integrand H(s, p) must be convex in p, as it is without a
disturbance, and if the control can undo the disturbance. Otherwise the formula is a lower bound of V for a convex J:
each p gives the value of the game with a linear terminal cost ≤ J. In ``avoid`` the players are exchanged, and the
formula is an upper bound.

The formula is due to E. Hopf, Generalized solutions of nonlinear equations of first order, J. Math. Mech. 14 (1965).
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.linear_games import archive, costate
from hjbjax.linear_games.costate import Flow, StateSolution
from hjbjax.linear_games.linear_dynamics import LinearGame, linear_game
from hjbjax.linear_games.support import smooth_support
from hjbjax.problem import arguments
from hjbjax.problem import labels as labelling
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import Labels
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast, front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, Numbers
from hjbjax.solution import files
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status

LANES = 256  # the largest number of states that one compiled program computes together
ENTRIES = 2_000_000  # entries of the matrices of all these states: 16 MB


@front_door
def hopf(
    problem: Problem,
    horizon: Number,
    *,
    intervals: int = 100,
    states: int | None = None,
    bound: bool = False,
    tol: float = 1e-6,
) -> "HopfSolution":
    """Value, costate and control of linear dynamics with a convex terminal cost, in any dimension and without a grid.

    Nothing is computed until the result is evaluated: one convex minimisation per state.

    Args:
      problem: drift A x + B u + C d + c, convex control sets, and only a terminal cost: a function of ``hjb.convex``,
        a convex quadratic polynomial, or minus one of these, as in ``reach`` and ``avoid`` with ``tube=False``. The
        points of a ``Finite`` set may be mixed by fast switching, so its convex hull counts.
      horizon: T, in units of time.

    Keyword Args:
      intervals: number of intervals of a piecewise constant control for the upper bound. The bounds then differ by
        O(1/intervals²).
      states: the number of states, if the terminal cost is a polynomial.
      bound: accept a game whose Hamiltonian is not convex; the formula then gives a bound of V. Default: refuse it.
      tol: tolerance of the minimisation, relative to the effect of the control on the terminal cost.

    Returns:
      A HopfSolution.

    Raises:
      ValueError: the problem has nonlinear dynamics, another terminal cost or a running cost, or its Hamiltonian is not
        convex.

    Example:
      >>> import hjbjax as hjb
      >>> sphere = hjb.convex.ball(np.zeros(20), 0.5)
      >>> problem = hjb.reach(lambda x, u: u, hjb.Ball(1.0, 20), sphere, tube=False)
      >>> round(float(hjb.hopf(problem, 1.0, intervals=4).value_at(0.0, 3.0 * np.eye(20)[0])), 6)
      1.5
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"hopf: got {type(problem).__name__}, wanted a Problem")
    if not is_traced(horizon):
        arguments.positive(horizon, "hopf: horizon", "in units of time")
    count = arguments.count(intervals, "hopf: intervals")
    game = linear_game(problem, states)
    if not game.exact and not bound:
        side = "an upper" if game.negated else "a lower"
        raise ValueError(
            "hopf: got a game whose Hamiltonian is not known to be convex: it is convex if every column of C is\n"
            "parallel to a column of B with at least the same range, or if C = B with a smaller ball.\n"
            f"Pass bound=True for {side} bound of V, or use march on a grid in up to six states"
        )
    return HopfSolution(
        game, horizon, problem.controls, problem.disturbances, count, float(tol), problem.labels, problem=problem
    )


@pytree_dataclass(static=("intervals", "tol", "labels"), host=("problem",))
class HopfSolution(files.Saved):
    """The value of a linear game with a convex terminal cost, evaluated state by state; made by ``hopf``.

    All times are between 0 and the horizon. Results are float64 NumPy for numbers; under ``jit``, ``vmap`` and ``grad``
    they follow the dtype of the state, and are NaN instead of an error if a minimisation does not converge or a time is
    outside the horizon.

    Args:
      game: matrices, sets and the terminal cost.
      horizon: T, in units of time.
      controls: the admissible set of the control; ``None`` if there is none.
      disturbances: the admissible set of the disturbance; ``None`` if there is none.
      intervals: number of intervals of the piecewise constant control.
      tol: tolerance of the minimisation.
      labels: names and units of the controls.
      problem: the problem; ``None`` on return from ``jit``; host data.
    """

    FORMAT = "hjbjax.HopfSolution"
    KINDS: ClassVar = {
        **dict.fromkeys(("exact", "negated", "playing"), (bool,)),
        **dict.fromkeys((*archive.SETS, "terminal"), (dict,)),
        **dict.fromkeys(("horizon", "tol"), files.REAL), **dict.fromkeys(("labels", "players"), (list,)),
        "intervals": (int,),
    }  # fmt: skip

    game: LinearGame
    horizon: Any
    controls: Any
    disturbances: Any
    intervals: int = 100
    tol: float = 1e-6
    labels: Labels = Labels()
    problem: Problem | None = None

    @property
    def ndim(self) -> int:
        """The number of states n."""
        return self.game.terminal.dim

    @property
    def timed(self) -> bool:
        """True: the methods take (t, x)."""
        return True

    @property
    def bound(self) -> str | None:
        """ "lower" or "upper" if the formula is only this bound of V; ``None`` if it is V."""
        return None if self.game.exact else "upper" if self.game.negated else "lower"

    @property
    def status(self) -> Status:
        """CONVERGED: a state whose minimisation does not converge raises a ``SolveError`` when it is evaluated."""
        return Status.CONVERGED

    def value_at(self, t: Numbers, x: Numbers | Sequence) -> Any:
        """V at time t, or its bound if ``bound`` is not None.

        Args:
          t: times, a number or shape (...).
          x: states, shape (n,) or (..., n).

        Returns:
          Shape (...), in cost units.

        Raises:
          ValueError: a state of the wrong length, or a time outside [0, T].
          SolveError: the minimisation did not converge at some state.
        """
        return self._evaluate("value_at", t, x)

    def bounds_at(self, t: Numbers, x: Numbers | Sequence) -> tuple[Any, Any]:
        """Bounds ``(lower, upper)`` of V; arguments and errors as for ``value_at``.

        They hold for the differential game itself, without discretisation error, up to rounding: the cost of an
        admissible control is one of them, the formula at any costate the other. If ``bound`` is not None, only one is
        finite.
        """
        found = self._evaluate("bounds_at", t, x)
        return found[..., 0], found[..., 1]

    def error_at(self, t: Numbers, x: Numbers | Sequence) -> Any:
        """The duality gap, upper minus lower bound: a bound of |value − V|; arguments as for ``value_at``."""
        lower, upper = self.bounds_at(t, x)
        return upper - lower

    def costate_at(self, t: Numbers, x: Numbers | Sequence) -> Any:
        """DV, shape (..., n); one of several subgradients where V has a kink; arguments as for ``value_at``."""
        return self._evaluate("costate_at", t, x)

    def control_at(self, t: Numbers, x: Numbers | Sequence) -> Any:
        """The optimal control, shape (..., m); arguments as for ``value_at``.

        It minimises p·Bu up to a barrier of relative size 1e-9. Where the control has no effect on V it is in the
        middle of its set. For a ``Finite`` set it is in the convex hull.

        Raises:
          ValueError: the problem has no control.
        """
        if self.controls is None:
            raise ValueError("HopfSolution.control_at: the problem has no controls")
        return self._evaluate("control_at", t, x)

    def disturbance_at(self, t: Numbers, x: Numbers | Sequence) -> Any:
        """The worst disturbance, shape (..., k); see ``control_at``."""
        if self.disturbances is None:
            raise ValueError("HopfSolution.disturbance_at: the problem has no disturbances")
        return self._evaluate("disturbance_at", t, x)

    def on_grid(self, grid: Grid, times: Sequence[float] | None = None) -> Solution:
        """Value and feedback at the nodes of a grid, as the solution of a march.

        A grid of few axes gives pictures, or a feedback for ``simulate`` and ``greedy_feedback``. The grid must have
        one axis per state.

        Args:
          grid: the nodes.
          times: increasing times in [0, T]. Default: 11 of them.
        """
        when = np.linspace(0.0, float(self.horizon), 11) if times is None else np.asarray(times, float)
        if when.ndim != 1 or when.size < 2 or np.any(np.diff(when) <= 0):
            raise ValueError(f"HopfSolution.on_grid: got times = {times!r}, wanted at least two increasing times")
        nodes = np.asarray(grid.nodes()).reshape(-1, grid.ndim)
        each = [self._everything("on_grid", t, nodes) for t in when]

        def table(name: str) -> np.ndarray:
            found = np.stack([one[name] for one in each])
            return found.reshape(len(when), *grid.shape, *found.shape[2:])

        bounds, policy = table("bounds_at"), table("control_at")
        return Solution(
            grid, table("value_at"), policy[..., :0] if self.controls is None else policy,
            None if self.disturbances is None else table("disturbance_at"), code=Status.CONVERGED, times=when,
            grid_error=bounds[..., 1] - bounds[..., 0] if self.game.exact else None, labels=self.labels,
            problem=self.problem, message="The generalised Hopf formula at the nodes.", stats={"method": repr(self)},
        )  # fmt: skip

    def _evaluate(self, name: str, t: Numbers, x: Numbers | Sequence) -> Any:
        """The part of the answers with this name for states (..., n) at times (...)."""
        return _evaluate_traced(self, name, t, x) if is_traced(self, t, x) else self._everything(name, t, x)[name]

    def _everything(self, name: str, t: Numbers, x: Numbers | Sequence) -> dict[str, np.ndarray]:
        """All parts of the answers, for the method ``name``."""
        n = self.game.terminal.dim
        times, states = np.asarray(t, float), np.asarray(x, float)
        _check_states(name, n, states.shape)
        shape = np.broadcast_shapes(times.shape, states.shape[:-1])
        times, states = np.broadcast_to(times, shape).reshape(-1), np.broadcast_to(states, (*shape, n)).reshape(-1, n)
        end = float(self.horizon)
        if not np.all((times >= 0) & (times <= end * (1 + 1e-12))):
            raise ValueError(
                f"HopfSolution.{name}: got times from {times.min():g} to {times.max():g}, wanted 0 to {end:g}"
            )
        if not len(times):
            raise ValueError(f"HopfSolution.{name}: got no states")
        found = _in_blocks(self, times, states)
        gap = found["gap"]
        if np.any(bad := ~(gap <= self.tol)):
            worst = int(np.argmax(bad))
            raise SolveError(
                f"HopfSolution.{name}: the minimisation did not converge at {np.sum(bad)} of {len(bad)} "
                f"states,\nsuch as {states[worst].tolist()}: the duality gap there is {gap[worst]:.2g} of the effect "
                f"of the control, and tol is {self.tol:g}. Raise tol, or scale states of different sizes"
            )
        return {part: each.reshape((*shape, *each.shape[1:])) for part, each in found.items()}

    def _contents(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        header, arrays = archive.game_contents(self.game)
        header |= {
            "horizon": float(self.horizon), "intervals": self.intervals, "tol": self.tol, "labels": self.labels,
            "players": [self.controls is not None, self.disturbances is not None],
        }  # fmt: skip
        return header, arrays

    @staticmethod
    def _plan(header: dict) -> dict[str, files.Expected]:
        # the shapes are checked when the game is rebuilt
        numbers = files.Expected(((), (None,), (None, None)), (np.float64,))
        return {name: numbers for name in header["arrays"] if name != "header"}

    @classmethod
    def _from_file(cls, header: dict, arrays: dict[str, np.ndarray]) -> Self:
        """The solution with a header and arrays of a file."""
        game = archive.rebuild(header, arrays)
        sets = (game.other_set, game.own_set) if game.negated else (game.own_set, game.other_set)
        controls, disturbances = (each if there else None for each, there in zip(sets, header["players"], strict=True))
        labels = labelling.of_file(header["labels"])
        return cls(
            game,
            float(header["horizon"]),
            controls,
            disturbances,
            header["intervals"],
            float(header["tol"]),
            labels,
        )

    def __repr__(self) -> str:
        what = "V" if self.bound is None else f"{self.bound} bound of V"
        horizon = "traced" if is_traced(self.horizon) else f"{float(self.horizon):g}"
        return f"HopfSolution({what} in {self.game.terminal.dim} states, horizon {horizon})"


def _check_states(name: str, n: int, shape: tuple[int, ...]) -> None:
    """Refuse states of the wrong length."""
    if not shape or shape[-1] != n:
        raise ValueError(f"HopfSolution.{name}: got states of shape {shape}, wanted (..., {n})")


def _value(sign: int, answer: StateSolution, along: Flow, game: LinearGame) -> jax.Array:
    """V."""
    return sign * answer.value


def _bounds(sign: int, answer: StateSolution, along: Flow, game: LinearGame) -> jax.Array:
    """Lower and upper bound of V, shape (2,)."""
    return jnp.stack([answer.lower, answer.upper] if sign > 0 else [-answer.upper, -answer.lower])


def _slope(sign: int, answer: StateSolution, along: Flow, game: LinearGame) -> jax.Array:
    """DV, the costate at the start of the path."""
    return sign * (along.end.T @ answer.costate)


def _control(sign: int, answer: StateSolution, along: Flow, game: LinearGame) -> Array:
    """The control, which minimises DV·Bu."""
    matrix, admissible = (game.own, game.own_set) if sign > 0 else (game.other, game.other_set)
    w = -_slope(sign, answer, along, game) @ jnp.asarray(matrix, answer.costate.dtype)
    return smooth_support(admissible, w, answer.mu)[1]


def _disturbance(sign: int, answer: StateSolution, along: Flow, game: LinearGame) -> Array:
    """The disturbance, which maximises DV·Cd."""
    matrix, admissible = (game.other, game.other_set) if sign > 0 else (game.own, game.own_set)
    w = _slope(sign, answer, along, game) @ jnp.asarray(matrix, answer.costate.dtype)
    return smooth_support(admissible, w, answer.mu)[1]


PARTS = {
    "value_at": _value,
    "bounds_at": _bounds,
    "costate_at": _slope,
    "control_at": _control,
    "disturbance_at": _disturbance,
}


def _lanes(solution: HopfSolution, t: Number, x: Array) -> dict[str, Array]:
    """All parts of the answers for states (k, n) at one time, and "gap", the relative gaps, shape (k,)."""
    game = solution.game
    along = costate.flow_over(game, solution.horizon - t, solution.intervals, x.dtype)

    def one(x: Array) -> dict[str, Array]:
        found = costate.solve_state(game, along, x)
        sign = -1 if game.negated else 1
        return {"gap": found.gap} | {name: part(sign, found, along, game) for name, part in PARTS.items()}

    return jax.vmap(one)(x)


_compiled = jax.jit(_lanes)  # one program for all parts, because compiling takes longer than a thousand states


def _evaluate_traced(solution: HopfSolution, name: str, t: Numbers, x: Numbers | Sequence) -> jax.Array:
    """The same inside a transformation, in the dtype of the states; NaN without convergence."""
    n, x = solution.game.terminal.dim, jnp.asarray(x)
    x = x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))
    _check_states(name, n, x.shape)
    solution, t = cast(solution, x.dtype), jnp.asarray(t, x.dtype)
    if t.ndim:  # every state has its own tables of the dynamics
        t, x = jnp.broadcast_to(t, x.shape[:-1]).reshape(-1, 1), x.reshape(*x.shape[:-1], n)
        each = jax.vmap(lambda t, x: _lanes(solution, t[0], x[None]))(t, x.reshape(-1, n))
        found, gap = each[name][:, 0], each["gap"][:, 0]
    else:
        each = _lanes(solution, t, x.reshape(-1, n))
        found, gap = each[name], each["gap"]
    tol = max(solution.tol, 20 * float(jnp.finfo(x.dtype).eps) ** 0.57)  # what the dtype allows
    gap = gap.reshape(-1, *(1,) * (found.ndim - 1))
    within = (t >= 0) & (t <= solution.horizon * (1 + 4 * float(jnp.finfo(x.dtype).eps)))
    within = jnp.broadcast_to(within.reshape(-1), len(gap)).reshape(gap.shape)
    return jnp.where((gap <= tol) & within, found, jnp.nan).reshape((*x.shape[:-1], *found.shape[1:]))


def _in_blocks(solution: HopfSolution, times: np.ndarray, states: np.ndarray) -> dict[str, np.ndarray]:
    """All parts, in blocks of states at the same time; the last block is filled up by repeating its states."""
    largest = int(np.clip(ENTRIES // (solution.intervals * np.size(solution.game.own)), 1, LANES))
    results: dict[str, np.ndarray] = {}
    with own_settings(x64=True):
        solution = cast(solution, np.float64)
        for t in np.unique(times):
            places = np.nonzero(times == t)[0]
            # few different sizes, because each is another program
            block = min(largest, next(size for size in (1, 16, LANES, len(places)) if size >= min(len(places), LANES)))
            for first in range(0, len(places), block):
                rows = places[first : first + block]
                for name, found in _compiled(solution, t, states[np.resize(rows, block)]).items():
                    whole = results.setdefault(name, np.zeros((len(times), *found.shape[1:])))
                    whole[rows] = np.asarray(found)[: len(rows)]
    return results
