"""Solutions: value, policy, outcome, and bounds on the error.

A ``Solution`` is a pytree, so ``jit`` and ``vmap`` can return it and it can be differentiated. Timings and residuals
are host data and are dropped on the way. Certified bounds lower ≤ V_h ≤ upper on the exact discrete solution V_h are
affine in the value V, so four numbers store them. The error of V is at most max(upper − V, V − lower).
"""

import dataclasses
import functools
import html
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem import settings
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST, Labels
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import is_traced, pytree_dataclass, with_ways_out
from hjbjax.problem.sets import Finite
from hjbjax.problem.types import Array, Numbers
from hjbjax.problem.words import OF_SOLUTION
from hjbjax.solution import archive, files, screen
from hjbjax.solution.files import FileError
from hjbjax.solution.free_boundary import boundary_of
from hjbjax.solution.interpolation import (
    Interpolation,
    Samples,
    between,
    between_defined,
    check_query,
    compile_query,
    nearest,
    query,
    slopes_between,
    times_outside,
)
from hjbjax.solution.modes import of_one_mode, refuse_unknown_modes, states_in_mode, switching_modes
from hjbjax.solution.placement import Path
from hjbjax.solution.status import Status, warn

__all__ = ["FileError", "Solution", "SolveError", "Status", "load"]


class SolveError(RuntimeError):
    """A solve did not converge: the ``message`` explains the outcome, ``.solution`` is the solution so far, if any.

    ``.solutions`` are the solutions of all lanes of a batch, including the finished lanes.
    """

    def __init__(self, message: str, solution: Any = None, solutions: Sequence[Any] = ()):
        super().__init__(message)
        self.solution, self.solutions = solution, tuple(solutions)


@with_ways_out(OF_SOLUTION)
@pytree_dataclass(
    static=("discrete", "discrete_disturbance", "labels"), host=("residuals", "stats", "message", "problem")
)
class Solution:
    """A value function on a grid with its policy.

    Args:
      grid: the grid.
      value: V, shape (*grid), in cost units: the least cost, or for a problem with rewards the largest reward. Where
        the target is unreachable it is infinite, or minus infinite with rewards.
      policy: u, shape (*grid, m); NaN at nodes where no control is defined.
      disturbance: d, shape (*grid, l), in a game.
      code: a ``Status`` number.
      steps: number of steps.
      enclosure: shape (2, 2), or ``None`` without a certificate: the exact discrete solution is certified to lie
        between ``enclosure[0, 0] * value + enclosure[0, 1]`` and ``enclosure[1, 0] * value + enclosure[1, 1]``.
      isaacs_gap: in a game, the largest min-max minus max-min over the nodes, in cost units per unit time.
      reached: the nodes from which the target can be reached, bool (*grid); ``None`` means all.
      times: shape (k,) for a marched solution, whose value and policy have a leading time axis.
      grid_error: an estimate of |V − V_exact| at the nodes, shape (*grid), in cost units, where V_exact solves the
        equation itself, not its discretisation; zero where V is infinite. For a marched solution it includes the time
        discretisation error, shape (k, *grid). ``None`` without an estimate; ``stats["grid_error"]`` then gives the
        reason, for marches and if the scheme was chosen automatically.
      box_error: an estimate of the change of V under another assumption at the ends of the box, shape (*grid), or
        (k, *grid) for a marched solution, in cost units. ``None`` if the ends cannot matter or there is no estimate;
        ``stats["box_error"]`` gives the reason.
      monotone_error: for a second-order value, the certified error bound of the monotone value it started from, against
        the exact solution of the monotone scheme; otherwise ``None``.
      cut: number of nodes at the lower and upper end of each axis at which the optimal drift is cut off, shape (n, 2);
        for a marched solution the largest number in any step down to each kept time, (k, n, 2). Zero at ends that are
        not projected; ``None`` if not counted.
      stopping: the nodes where it is optimal to stop, V = ψ, bool (*grid) or (k, *grid). Ties count, so in a march all
        nodes with V = ψ at the horizon stop. A node of the target stops only next to a node outside that stops.
        ``None`` without a stopping payment, and if only V is stored.
      active: the nodes where the running maximum is attained, V = g, like ``stopping``; ``None`` without
        ``running_max``.
      pushing: the nodes where each of the ``pushes`` is optimal, bool (*grid, p) or (k, *grid, p). Ties count. ``None``
        without pushes, and if only V is stored.
      discrete: True if the controls are enumerated, so that the mean of two need not be admissible.
      discrete_disturbance: True if the disturbances are enumerated.
      labels: names and units of the controls, the side of the level set, and whether V is a cost or a reward.
      residuals: one number per step; host data.
      stats: "method", "scheme", "device", "dtype", "seconds", "compile_seconds", "bytes", "tol",
        "high_order_tol" (the tolerance of a high-order iteration, in words), "certificate" (a sentence), "bounds" (the
        number of nodes at which a bound holds a control, if there are any and the cost is not affine in the control),
        "checkpoint" ("written", or the reason why not), "mesh" (devices along each axis, if the nodes were divided)
        and "versions" (a dict), each if known; host data.
      message: an explanation of the outcome of this solve; empty on return from ``jit``; host data.
      problem: the problem, for target and bounds in plots; ``None`` on return from ``jit`` or from a file, because
        functions are not saved; host data.

    Example:
      >>> grid = Grid([0.0], [1.0], (3,))
      >>> solution = Solution(grid, np.array([0.0, 1.0, 4.0]), np.zeros((3, 1)), code=Status.CONVERGED, steps=2)
      >>> solution, float(solution.value_at([0.75]))
      (Solution(CONVERGED after 2 steps on 3 nodes), 2.5)
    """

    grid: Grid
    value: Array
    policy: Any
    disturbance: Any = None
    code: Any = 0
    steps: Any = 0
    enclosure: Any = None
    isaacs_gap: Any = None
    reached: Any = None
    times: Any = None
    grid_error: Any = None
    box_error: Any = None
    monotone_error: Any = None
    cut: Any = None
    stopping: Any = None
    active: Any = None
    pushing: Any = None
    discrete: bool = False
    discrete_disturbance: bool = False
    labels: Labels = Labels()
    residuals: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    stats: dict = dataclasses.field(default_factory=dict)
    message: str = ""
    problem: Problem | None = dataclasses.field(default=None, repr=False)

    def __post_init__(self) -> None:
        if isinstance(self.code, Status):
            object.__setattr__(self, "code", int(self.code))

    @property
    def status(self) -> Any:
        """The ``Status``; the plain numbers while traced, or for a batch."""
        if is_traced(self.code) or np.ndim(self.code):
            return self.code
        return Status(int(self.code))

    @property
    def bounds(self) -> tuple[Any, Any] | None:
        """The certified ``(lower, upper)``, each of shape (*grid), computed on access; infinite where V is.

        ``None`` without a certificate.
        """
        if self.enclosure is None:
            return None
        xp: Any = jnp if is_traced(self.value, self.enclosure) else np
        value, (factors, shifts) = xp.asarray(self.value), self._lines(xp)
        # in a batch every lane has its own coefficients: factors (lanes,) and values (lanes, *grid)
        finite, numbers = xp.isfinite(value), (..., *(None,) * self.grid.ndim)
        center = xp.where(finite, value, 0)  # zero times infinity would be NaN
        lower, upper = (
            xp.where(finite, factors[..., side][numbers] * center + shifts[..., side][numbers], value)
            for side in (0, 1)
        )
        return lower, upper

    @property
    def error(self) -> Any:
        """The certified bound on |V − V_h| over the nodes where V is finite; ``None`` without a certificate.

        It is infinite if a value or bound is NaN or if no node is finite, because nothing is certified then.
        """
        if self.enclosure is None:
            return None
        xp: Any = jnp if is_traced(self.value, self.enclosure) else np
        value, (factors, shifts) = xp.asarray(self.value), self._lines(xp)
        finite, nodes = xp.isfinite(value), tuple(range(-self.grid.ndim, 0))
        ends = xp.min(xp.where(finite, value, xp.inf), axis=nodes), xp.max(xp.where(finite, value, -xp.inf), axis=nodes)
        least, most = (xp.where(xp.isfinite(end), end, 0) for end in ends)
        off = [
            sign * ((factors[..., side] - 1) * end + shifts[..., side])  # an affine function is largest at an end
            for side, sign in enumerate((-1, 1))
            for end in (least, most)
        ]
        # comparisons with NaN are false, and least and most ignore NaN, so NaN must be tested separately
        worst = xp.max(xp.stack(off))
        worst = xp.where(xp.isnan(worst) | xp.any(xp.isnan(value)) | ~xp.any(finite), xp.inf, worst)
        return worst if xp is jnp else float(worst)

    def _lines(self, xp: ModuleType) -> tuple[Array, Array]:
        """Factors and shifts of the two bounds, each of shape (..., 2)."""
        enclosure = xp.asarray(self.enclosure)
        return enclosure[..., 0], enclosure[..., 1]

    @property
    def residual(self) -> float | None:
        """The last residual; ``None`` if none was recorded."""
        return float(self.residuals[-1]) if len(self.residuals) else None

    def in_mode(self, mode: str | int) -> "Solution":
        """The solution in one mode, on the grid of the states: for pictures and for everything that knows no modes.

        Args:
          mode: the name or the number of a mode.

        Raises:
          ValueError: there is no such mode.
        """
        return of_one_mode(self, mode)

    @property
    def switching(self) -> Any:
        """For every node the number of the mode after the controller's change, or of the current mode without a change.

        Integers of the shape of the value. ``None`` if the controller cannot change the mode.

        Raises:
          ValueError: the solution came from a file or from ``jit``, where the problem is not known.
        """
        return switching_modes(self)

    def value_at(self, *where: Numbers | Sequence, mode: str | int | None = None, clamp: bool = False) -> Any:
        """V between the nodes: ``value_at(x)``, or ``value_at(t, x)`` for a marched solution; works under jit and vmap.

        Multilinear interpolation, second order, also in time. For concrete states and data the result is float64 NumPy,
        under a tracer it has the tracer's dtype.

        Args:
          where: states x, shape (n,) or (..., n); for a marched solution preceded by the time, a number or shape (...).
          mode: the name or the number of the mode, if the problem has modes; otherwise the states begin with it.
          clamp: use the nearest point for states outside the grid and times outside the kept times; otherwise NaN.

        Returns:
          Shape ``x.shape[:-1]``, in cost units.

        Raises:
          ValueError: a state of the wrong length, a missing or unknown mode, a missing or unneeded time, or a batch of
            solutions.
          TypeError: the states are not numbers.
        """
        return self._query("value_at", between, self.value, 0, where, clamp, mode)

    def costate_at(self, *where: Numbers | Sequence, mode: str | int | None = None, clamp: bool = False) -> Any:
        """DV between the nodes, shape ``x.shape[:-1] + (n,)``; arguments and errors as for ``value_at``.

        This is the current-value costate of Pontryagin's principle. Central differences at the nodes (parabolas through
        three nodes next to an end) are interpolated: second order where V is smooth; a kink is smeared over two cells.
        Next to infinite values the differences are one-sided; the result is NaN where none exists.
        """
        found = self._query("costate_at", slopes_between, self.value, 0, where, clamp, mode)
        return found[..., 1:] if self.grid.modes else found  # V has no slope along the modes

    def control_at(self, *where: Numbers | Sequence, mode: str | int | None = None, clamp: bool = False) -> Any:
        """u between the nodes, shape ``x.shape[:-1] + (m,)``; arguments and errors as for ``value_at``.

        Only the nodes of the cell where a control is defined are used, with weights scaled to sum to one. The feedback
        is therefore defined up to a target or the boundary of the reachable states. The result is NaN if the control is
        undefined at all nodes of the cell. Enumerated controls are not averaged; the nearest node with a control
        decides.
        """
        # the mean of two elements of a finite set is not in the set
        look = nearest if self.discrete else between_defined
        return self._query("control_at", look, self.policy, 1, where, clamp, mode)

    def disturbance_at(self, *where: Numbers | Sequence, mode: str | int | None = None, clamp: bool = False) -> Any:
        """The opponent's d between the nodes, shape ``x.shape[:-1] + (l,)``; see ``control_at``."""
        look = nearest if self.discrete_disturbance else between_defined
        return self._query("disturbance_at", look, self.disturbance, 1, where, clamp, mode)

    def _query(
        self, name: str, look: Interpolation, values: Array | None, trailing: int, where: tuple, clamp: bool,
        mode: str | int | None,
    ) -> Array:  # fmt: skip
        """Values between the nodes by the rule ``look``; ``trailing`` is the number of axes per node."""
        if values is None:
            lacking = "policy" if name == "control_at" else "disturbance: the problem is not a game"
            raise ValueError(f"Solution.{name}: this solution has no {lacking}")
        t, x = check_query(self, name, values, trailing, where)
        if mode is not None:
            x = states_in_mode(self.grid, x, mode, f"Solution.{name}")
        refuse_unknown_modes(self.grid, x, f"Solution.{name}")
        samples = Samples(self.grid, values, self.times)
        found = query(look, samples, x, t, clamp=clamp, name=f"Solution.{name}")
        known = not clamp and t is not None and not is_traced(found, t, self.times)
        if known and np.any(late := times_outside(self.times, t)):
            first, last = float(np.min(self.times)), float(np.max(self.times))
            warn(
                f"Solution.{name}: {np.sum(late)} of {np.size(late)} times lie outside the kept times, from "
                f"{first:.6g} to {last:.6g}; the result there is NaN. Keep more times with march(..., times=), or pass "
                "clamp=True to use the nearest time",
                UserWarning,
            )
        if not clamp and not is_traced(found, x, self.grid) and np.any(outside := self.grid.beyond(x)):
            warn(
                f"Solution.{name}: {np.sum(outside)} of {np.size(outside)} states lie outside the grid, where "
                "the result is NaN. Pass clamp=True to use the nearest point of the grid",
                UserWarning,
            )
        return found

    def free_boundary(self, inside: Any = None, *, time: float | None = None) -> np.ndarray:
        """The boundary of the stopping set or push region between the nodes: points over one axis, segments over two.

        If V leaves ψ smoothly (smooth pasting) or at an angle, the error is of second order in the spacing; otherwise
        it is half a cell.

        Args:
          inside: another set of nodes, such as ``active`` or ``pushing[..., 0]`` of the same solution; a mask like
            ``stopping``. Default: the stopping set, or without one the nodes at which any push is optimal.
          time: for a marched solution, the kept time nearest to which the boundary is computed; ``None`` is the
            earliest.

        Returns:
          Shape (k,), increasing, over one axis. Over two axes shape (k, 2, 2): k segments with two ends each. Ends of
          the box are not part of the boundary.

        Raises:
          ValueError: there is neither a stopping set nor a push region, the grid has more than two axes, or ``time``
            for a stationary solution.

        Example:
          >>> import jax.numpy as jnp, hjbjax as hjb  # stop at a price of x², or wait for a rate of 1
          >>> wait = hjb.Problem(lambda x, u: 0 * x, lambda x, u: 1.0, discount=1.0, stopping_cost=lambda x: x[0] ** 2)
          >>> solution = hjb.solve(wait, hjb.Grid([-2.0], [2.0], (82,)))
          >>> solution.free_boundary().round(3).tolist()
          [-1.0, 1.0]
        """
        inside = self.stopping if inside is None else inside
        if inside is None and self.pushing is not None:
            inside = self.pushing.any(axis=-1)
        if is_traced(self, inside):
            raise ValueError("Solution.free_boundary: got a traced solution; call it outside of jit, vmap and grad")
        if inside is None:
            raise ValueError(
                "Solution.free_boundary: this solution has no stopping set; wanted a problem with a stopping_cost, a "
                "stopping_reward or pushes,\nsolved with its policy, or another set such as solution.active"
            )
        if time is not None and self.times is None:
            raise ValueError(
                f"Solution.free_boundary: got time = {time!r}, but the solution is stationary; leave it out"
            )
        value, inside = np.asarray(self.value), np.asarray(inside, bool)
        if self.times is not None:
            times = np.asarray(self.times)
            index = int(np.argmin(times if time is None else np.abs(times - time)))
            value, inside = value[index], inside[index]
        return boundary_of(self.grid, value, inside)

    def predict(
        self, observation: Numbers | Sequence, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """The control for an observed state, with the signature of the policies of Stable-Baselines3.

        Args:
          observation: states x, shape (n,) or (..., n); outside the grid the nearest point of the grid is used.
          state: returned unchanged, because the feedback has no memory.
          episode_start: ignored, because the feedback is a function of the state.
          deterministic: ignored for the same reason.

        Returns:
          ``(control, state)``, the control of shape ``x.shape[:-1] + (m,)``; NaN where undefined, as in the target.

        Raises:
          ValueError: a marched solution, whose control depends on time; use ``control_at(t, x)``. An observation that
            is not a state, such as the cosine and sine of an angle.
        """
        if self.times is None and np.ndim(observation) and np.shape(observation)[-1] != self.grid.ndim:
            raise ValueError(
                f"Solution.predict: got states of shape {np.shape(observation)}, wanted (..., {self.grid.ndim}): "
                f"{', '.join(self.grid.names)}.\nIf the observation is not the state, compute the state from it, for "
                "example an angle as numpy.arctan2(sine, cosine)"
            )
        if settings.are_usual() and (isinstance(observation, np.ndarray) or not is_traced(observation)):
            x, lookup = np.asarray(observation), self._lookup
            if lookup is not None and x.dtype.kind in "fiu" and x.shape[-1:] == (self.grid.ndim,):
                refuse_unknown_modes(self.grid, x, "Solution.predict")
                with jax.enable_x64(True):
                    control = lookup(np.asarray(x, np.float64))
                    if not isinstance(control, jax.core.Tracer):
                        return np.array(control), state
        return self.control_at(observation, clamp=True), state  # refuses a batch or a march with the reason

    @functools.cached_property
    def _lookup(self) -> Callable[[np.ndarray], jax.Array] | None:
        """``control_at`` as one program; None for a batch, a march and a traced solution."""
        if self.times is not None or self.policy is None or np.ndim(self.code) or is_traced(self):
            return None
        return compile_query(nearest if self.discrete else between_defined, self.grid, self.policy)

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: vars(self)[field.name] for field in dataclasses.fields(self)}  # programs are not pickled

    def save(self, path: Path, *, force: bool = False) -> None:
        """Write the solution to ``path`` atomically; ``load`` restores the same bits.

        Statistics are stored as JSON: tuples come back as lists, objects as their text. A file that is replaced keeps
        its permissions; the permissions of a new file follow the umask.

        Raises:
          FileExistsError: the file exists; choose another name or pass ``force=True``.
          FileError: the file cannot be written; nothing is left behind.
          ValueError: the solution is traced, or is a batch, whose arrays do not fit the grid.
        """
        if is_traced(self):
            raise ValueError("Solution.save: got a traced solution; save it outside of jit, vmap and grad")
        files.write(path, *archive.contents(self), force=force)

    def export(self, path: Path, *, force: bool = False) -> None:
        """Write value and feedback to a file that needs only NumPy to use: on a robot, in a loop, in another language.

        Copy ``hjbjax/solution/numpy_feedback.py`` next to your code. Its ``load(path)`` returns an object whose
        ``value(x)`` and ``control(x)``, or ``(t, x)`` after ``march``, equal ``value_at`` and ``control_at`` up to
        rounding. Its docstring describes the file format, for other languages. ``hjb.load`` does not read the file.
        A loaded solution does not have its problem, which determines where the controller changes the mode; set it
        first with ``dataclasses.replace(solution, problem=problem)``.

        Raises:
          FileExistsError: the file exists; choose another name or pass ``force=True``.
          FileError: the file cannot be written; nothing is left behind.
          ValueError: the solution is traced, or is a batch.
        """
        if is_traced(self) or np.ndim(self.code):
            raise ValueError("Solution.export: got a traced solution or a batch; export one outside of transformations")
        files.write(path, *archive.feedback_contents(self), force=force)

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset``: ``value``, each control and disturbance by its name, and all other node arrays.

        The axes have the names and units of the states, and ``time`` if marched; requires ``hjbjax[io]``.
        """
        if is_traced(self) or np.ndim(self.code):
            raise ValueError(
                "Solution.to_xarray: got a traced solution or a batch; take one outside of transformations"
            )
        return archive.dataset(self)

    def to_netcdf(self, path: Path, *, force: bool = False) -> None:
        """Write ``to_xarray()`` as netCDF for other tools, atomically; ``load`` reads only files of ``save``.

        The file is made in memory first. A slash in a name would mean a path of groups in netCDF; it is written as the
        fraction slash, ⁄.

        Raises:
          FileExistsError: the file exists; choose another name or pass ``force=True``.
          FileError: the file cannot be written; nothing is left behind.
          ImportError: ``hjbjax[io]`` is not installed.
        """
        found = self.to_xarray()
        files.write_whole(path, lambda stream: stream.write(archive.netcdf(found)), force=force)

    def __repr__(self) -> str:
        status = self.status
        if not isinstance(status, Status):
            return f"Solution({'traced' if is_traced(status) else 'a batch'}, grid of shape {self.grid.shape})"
        return f"Solution({status.name} after {self.steps} steps on {self.grid.size:,} nodes)"

    def _repr_html_(self) -> str:
        """The printed summary with a thumbnail of V, for notebooks."""
        text = html.escape(str(self))
        if is_traced(self) or np.ndim(self.code):
            return f"<pre>{text}</pre>"
        return f'<div style="display: flex; gap: 1em">{screen.thumbnail(self)}<pre>{text}</pre></div>'

    def __str__(self) -> str:
        if is_traced(self) or np.ndim(self.code):
            return repr(self)
        return screen.show(self)


def load(path: Path) -> Solution:
    """Load the solution in the file ``path`` written by ``Solution.save``; never runs code from the file.

    Raises:
      FileError: the file is missing, truncated, damaged, foreign, of a newer format, or inconsistent.
    """
    return Solution(**files.read(path, archive.FORMAT, archive.VERSION, archive.plan, archive.fields))


def attach_solution(error: Exception, solution: Solution | None) -> None:
    """Make a partial solution the ``.solution`` of an exception of any type, as it is in ``SolveError``."""
    reported: Any = error
    reported.solution = solution


def change_solutions(error: BaseException, change: Callable[[Solution, int | None], Solution]) -> None:
    """Replace the partial solutions of an exception in place, so that the traceback stays the same.

    Args:
      error: any exception; one without partial solutions is left as it is.
      change: a function of a solution and the number of its lane, which is None outside of a batch.
    """
    reported: Any = error
    solution, solutions = getattr(error, "solution", None), getattr(error, "solutions", ())
    if solutions:
        changed = tuple(change(each, lane) for lane, each in enumerate(solutions))
        reported.solution = next(new for old, new in zip(solutions, changed, strict=True) if old is solution)
        reported.solutions = changed
    elif isinstance(solution, Solution):
        reported.solution = change(solution, None)


def question(problem: Problem) -> dict[str, Any]:
    """The fields of a ``Solution`` that follow from the problem: labels, and which sets are enumerated.

    The value of a solver is a cost; ``rewards.with_rewards`` gives it the sign of the user's problem.
    """
    return {
        "discrete": isinstance(problem.controls, Finite),
        "discrete_disturbance": isinstance(problem.disturbances, Finite),
        "labels": problem.labels._replace(payoff=COST),
        "problem": None if is_traced(problem) else problem,
    }
