"""The answer: value, policy, how it ended, and how far it can be off.

A ``Solution`` is a pytree, so it may leave ``jit`` and ``vmap`` and be differentiated; timings and residuals
are host matter and do not survive such a passage. Certified bounds lower ≤ V_h ≤ upper on the exact discrete
solution V_h are affine in the value V, so that four numbers hold them; the error of V is at most
max(upper − V, V − lower).
"""

import dataclasses
import html
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import Labels
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.sets import Finite
from hjbjax.problem.types import Array, Numbers
from hjbjax.solution import archive, files, screen
from hjbjax.solution.files import FileError
from hjbjax.solution.interpolation import (
    Interpolation,
    Samples,
    between,
    between_defined,
    beyond,
    check_query,
    nearest,
    query,
    slopes_between,
)
from hjbjax.solution.placement import Path
from hjbjax.solution.status import Status, warn

__all__ = ["FileError", "Solution", "SolveError", "Status", "load"]


class SolveError(RuntimeError):
    """A solve that did not converge: the ``message`` says how it ended, ``.solution`` is the answer so far, if any.

    ``.solutions`` are those of all lanes of a batch, the finished ones among them.
    """

    def __init__(self, message: str, solution: Any = None, solutions: Sequence[Any] = ()):
        super().__init__(message)
        self.solution, self.solutions = solution, tuple(solutions)


@pytree_dataclass(
    static=("discrete", "discrete_disturbance", "labels"), host=("residuals", "stats", "message", "problem")
)
class Solution:
    """A value function on a grid with its policy.

    Args:
      grid: the nodes.
      value: V, shape (*grid), in cost units; infinite where the target is out of reach.
      policy: u, shape (*grid, m); NaN at nodes where no control is defined.
      disturbance: d, shape (*grid, l), in a game.
      code: a ``Status`` number.
      steps: how many steps were taken.
      enclosure: shape (2, 2), or ``None`` without a certificate: the exact discrete solution is certified to lie
        between ``enclosure[0, 0] * value + enclosure[0, 1]`` and ``enclosure[1, 0] * value + enclosure[1, 1]``.
      isaacs_gap: the largest min-max minus max-min over the nodes, in cost units per unit time, in a game.
      reached: the nodes from which the target can be reached, bool (*grid); ``None`` means all.
      times: shape (k,) when marched; value and policy then have a leading axis.
      grid_error: an estimate of |V − V_exact| at the nodes, shape (*grid), in cost units, with V_exact the solution of
        the equation itself and not of the discrete one; zero where V is infinite. When marched it includes the error of
        the step in time, shape (k, *grid). ``None`` where none was made; ``stats["grid_error"]`` has the reason where
        the caller left the choice of the scheme, and of every march.
      box_error: an estimate of how far V moves if another assumption is made at the ends of the box, shape (*grid), or
        (k, *grid) when marched, in cost units. ``None`` where the ends cannot matter or nothing was estimated;
        ``stats["box_error"]`` has the reason.
      monotone_error: of a value of second order the certified bound on the error of the monotone answer from which it
        started, against the exact solution of the monotone scheme; ``None`` without one.
      cut: at how many nodes of each end of the box the optimal drift is cut off, shape (n, 2), lower and upper; when
        marched, the most in any step down to each kept time, (k, n, 2). Zero at ends that are not projected; ``None``
        where it was not counted.
      discrete: whether the controls are enumerated, so that a mean of two need not be admissible.
      discrete_disturbance: whether the disturbances are enumerated.
      labels: names and units of the controls, and the side of the level set, for pictures.
      residuals: one number a step; host level.
      stats: "method", "scheme", "device", "dtype", "seconds", "compile_seconds", "bytes", "tol",
        "certificate" (a sentence), "checkpoint" ("written", or why not), "mesh" (devices along each axis, where the
        nodes were divided) and "versions" (a dict), each where known; host level.
      message: what happened in this very solve; empty after a passage through ``jit``; host level.
      problem: the question, from which pictures take target and bounds; ``None`` after a passage through ``jit`` or a
        file, as functions are not saved; host level.

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
    discrete: bool = False
    discrete_disturbance: bool = False
    labels: Labels = Labels()
    residuals: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    stats: dict = dataclasses.field(default_factory=dict)
    message: str = ""
    problem: Problem | None = dataclasses.field(default=None, repr=False)

    def __post_init__(self):
        if isinstance(self.code, Status):
            object.__setattr__(self, "code", int(self.code))

    @property
    def status(self) -> Any:
        """The ``Status``; the bare numbers while traced, or of a batch."""
        if is_traced(self.code) or np.ndim(self.code):
            return self.code
        return Status(int(self.code))

    @property
    def bounds(self) -> tuple[Any, Any] | None:
        """The certified ``(lower, upper)``, each of shape (*grid), made when asked for; infinite where V is.

        ``None`` without a certificate.
        """
        if self.enclosure is None:
            return None
        xp: Any = jnp if is_traced(self.value, self.enclosure) else np
        value, (factors, shifts) = xp.asarray(self.value), self._lines(xp)
        # of a batch every lane has its own lines: factors (lanes,) against values (lanes, *grid)
        finite, numbers = xp.isfinite(value), (..., *(None,) * self.grid.ndim)
        center = xp.where(finite, value, 0)  # a factor of zero times infinity would be NaN
        lower, upper = (
            xp.where(finite, factors[..., side][numbers] * center + shifts[..., side][numbers], value)
            for side in (0, 1)
        )
        return lower, upper

    @property
    def error(self) -> Any:
        """The certified bound on |V − V_h|, the largest over the nodes where V is finite; ``None`` without one.

        A NaN among the values or the bounds, or no finite node at all, makes it infinite: nothing is certified.
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
        # NaN compares with nothing, and least and most look at finite values alone: neither may pass for a bound
        worst = xp.max(xp.stack(off))
        worst = xp.where(xp.isnan(worst) | xp.any(xp.isnan(value)) | ~xp.any(finite), xp.inf, worst)
        return worst if xp is jnp else float(worst)

    def _lines(self, xp: ModuleType) -> tuple[Array, Array]:
        """Factors and shifts of the two bounds, each of shape (..., 2)."""
        enclosure = xp.asarray(self.enclosure)
        return enclosure[..., 0], enclosure[..., 1]

    @property
    def residual(self) -> float | None:
        """The last residual; ``None`` where none was kept."""
        return float(self.residuals[-1]) if len(self.residuals) else None

    def value_at(self, *where: Numbers | Sequence, clamp: bool = False) -> Any:
        """V between the nodes: ``value_at(x)``, or ``value_at(t, x)`` of a marched solution; jit- and vmap-able.

        Multilinear interpolation, second order, in the time as well. Concrete states and data give float64 NumPy;
        under a tracer the answer has the tracer's dtype.

        Args:
          where: states x, shape (n,) or (..., n); of a marched solution first the time, a number or shape (...).
          clamp: outside the grid, and outside the kept times, take the nearest point; otherwise NaN.

        Returns:
          Shape ``x.shape[:-1]``, in cost units.

        Raises:
          ValueError: a state of another length; a time too many or too few; a batch of solutions.
          TypeError: states that are not numbers.
        """
        return self._query("value_at", between, self.value, 0, where, clamp)

    def costate_at(self, *where: Numbers | Sequence, clamp: bool = False) -> Any:
        """DV between the nodes, shape ``x.shape[:-1] + (n,)``; arguments and refusals as for ``value_at``.

        The costate of Pontryagin's principle, in current value. Central differences at the nodes (parabolas through
        three of them beside an end), interpolated: second order where V is smooth; a kink is smeared over two cells.
        Beside infinite values the differences are one-sided; where there are none, NaN.
        """
        return self._query("costate_at", slopes_between, self.value, 0, where, clamp)

    def control_at(self, *where: Numbers | Sequence, clamp: bool = False) -> Any:
        """u between the nodes, shape ``x.shape[:-1] + (m,)``; arguments and refusals as for ``value_at``.

        Only nodes of the cell where a control is defined count, with their weights scaled to sum to one, so
        that the feedback reaches up to a target or to the edge of the reachable states; where no node of the
        cell has one, the answer is NaN. Enumerated controls are not averaged: the nearest such node's is taken.
        """
        # the mean of "left" and "right" is no control of a finite set
        look = nearest if self.discrete else between_defined
        return self._query("control_at", look, self.policy, 1, where, clamp)

    def disturbance_at(self, *where: Numbers | Sequence, clamp: bool = False) -> Any:
        """The opponent's d between the nodes, shape ``x.shape[:-1] + (l,)``; as ``control_at``."""
        look = nearest if self.discrete_disturbance else between_defined
        return self._query("disturbance_at", look, self.disturbance, 1, where, clamp)

    def _query(
        self, name: str, look: Interpolation, values: Array | None, trailing: int, where: tuple, clamp: bool
    ) -> Array:
        """Values between the nodes by the rule ``look``; of entries per node with ``trailing`` axes."""
        if values is None:
            lacking = "policy" if name == "control_at" else "disturbance: the problem is not a game"
            raise ValueError(f"Solution.{name}: this solution has no {lacking}")
        t, x = check_query(self, name, values, trailing, where)
        samples = Samples(self.grid, values, self.times)
        found = query(look, samples, x, t, clamp=clamp, name=f"Solution.{name}")
        known = not clamp and t is not None and not is_traced(found, t, self.times)
        if known and np.any(late := beyond(self.times, t)):
            first, last = float(np.min(self.times)), float(np.max(self.times))
            warn(
                f"Solution.{name}: {np.sum(late)} of {np.size(late)} times lie outside the kept ones, from {first:.6g} "
                f"to {last:.6g}, where the answer is NaN; keep more in march(..., times=), or clamp=True takes the "
                "nearest",
                UserWarning,
            )
        if not clamp and not is_traced(found, x, self.grid) and np.any(outside := self.grid.beyond(x)):
            warn(
                f"Solution.{name}: {np.sum(outside)} of {np.size(outside)} states lie outside the grid, where the "
                "answer is NaN; clamp=True takes the nearest point in it",
                UserWarning,
            )
        return found

    def predict(
        self, observation: Numbers | Sequence, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """The control for an observed state, called as the policies of Stable-Baselines3 are.

        Args:
          observation: states x, shape (n,) or (..., n); outside the grid the nearest point in it counts.
          state: handed back as it came: the feedback has no memory.
          episode_start: not read, nor is ``deterministic``: the feedback is a function of the state alone.
          deterministic: see above.

        Returns:
          ``(control, state)``, the control of shape ``x.shape[:-1] + (m,)``; NaN where there is none, as in the target.

        Raises:
          ValueError: a marched solution, whose control depends on the time: ``control_at(t, x)``.
        """
        return self.control_at(observation, clamp=True), state

    def save(self, path: Path, *, force: bool = False) -> None:
        """Write the solution to ``path``, whole or not at all; ``load`` gives back the same bits.

        Statistics come back as JSON has them: tuples as lists, objects as their text. A file that is replaced keeps its
        permissions; those of a new one follow the umask.

        Raises:
          FileExistsError: the file exists; another name or ``force=True`` helps.
          FileError: it cannot be written; nothing is left behind.
          ValueError: traced, or a batch: arrays that do not fit the grid.
        """
        if is_traced(self):
            raise ValueError("Solution.save: got a traced solution; save it outside of jit, vmap and grad")
        files.write(path, *archive.contents(self), force=force)

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset``: ``value``, each control and disturbance by its name, and what else there is at nodes.

        The axes have the names and units of the states, and ``time`` where marched; needs ``hjbjax[io]``.
        """
        if is_traced(self) or np.ndim(self.code):
            raise ValueError(
                "Solution.to_xarray: got a traced solution or a batch; take one outside of transformations"
            )
        return archive.dataset(self)

    def to_netcdf(self, path: Path, *, force: bool = False) -> None:
        """Write ``to_xarray()`` as netCDF for other tools, whole or not at all; ``load`` reads only files of ``save``.

        The file is made in memory first. A slash in a name, which means a path of groups in netCDF, is written as the
        fraction slash, ⁄.

        Raises:
          FileExistsError: the file exists; another name or ``force=True`` helps.
          FileError: it cannot be written; nothing is left behind.
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
        """The screen with a thumbnail of V, for notebooks."""
        text = html.escape(str(self))
        if is_traced(self) or np.ndim(self.code):
            return f"<pre>{text}</pre>"
        return f'<div style="display: flex; gap: 1em">{screen.thumbnail(self)}<pre>{text}</pre></div>'

    def __str__(self) -> str:
        if is_traced(self) or np.ndim(self.code):
            return repr(self)
        return screen.show(self)


def load(path: Path) -> Solution:
    """The solution in the file ``path`` that ``Solution.save`` wrote; code in a file is never run.

    Raises:
      FileError: the file is missing, truncated, damaged, foreign, of a newer format, or contradicts itself.
    """
    return Solution(**files.read(path, archive.FORMAT, archive.VERSION, archive.plan, archive.fields))


def question(problem: Problem) -> dict[str, Any]:
    """The fields of a ``Solution`` that follow from the problem alone: its words, and which sets are enumerated."""
    return {
        "discrete": isinstance(problem.controls, Finite),
        "discrete_disturbance": isinstance(problem.disturbances, Finite),
        "labels": problem.labels,
        "problem": None if is_traced(problem) else problem,
    }
