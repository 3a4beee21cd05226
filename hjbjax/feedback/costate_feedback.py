"""The minimiser of the Hamiltonian with the costate of a solution that has no grid: ``costate_feedback``."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.hamiltonian import pointwise
from hjbjax.hamiltonian.pointwise import Rule
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_jax, cast, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Numbers
from hjbjax.tracing import checks, closures
from hjbjax.tracing.dependence import influence


@runtime_checkable
class GridFreeFeedback(Protocol):
    """A feedback without a grid that reports whether it depends on time."""

    @property
    def timed(self) -> bool:
        """True if the methods take (t, x) instead of (x)."""

    @property
    def control_at(self) -> Callable[..., Array]:
        """The control, shape (..., m)."""


@runtime_checkable
class GridFreeSolution(GridFreeFeedback, Protocol):
    """A value without a grid: a HopfSolution, a NeuralSolution or a BlockSolution."""

    @property
    def ndim(self) -> int:
        """The number of states n."""

    @property
    def costate_at(self) -> Callable[..., Array]:
        """DV, shape (..., n)."""


@pytree_dataclass(static=("rule", "timed"))
class CostateFeedback:
    """u = argmin [L + f·DV] with DV from a solution without a grid; called with (x), or (t, x) if V depends on time.

    Args:
      problem: the problem whose Hamiltonian is minimised.
      solution: the solution, with ``costate_at``.
      rule: the method for the minimum.
      timed: True if the solution takes (t, x).
    """

    problem: Problem
    solution: GridFreeSolution
    rule: Rule
    timed: bool

    def __call__(self, *where: Numbers | Sequence) -> Any:
        """The control, as ``control_at``."""
        return self.control_at(*where)

    def control_at(self, *where: Numbers | Sequence) -> Any:
        """The minimising control, shape ``x.shape[:-1] + (m,)``: NumPy for numbers, otherwise in the tracer's dtype."""
        costate = self.solution.costate_at(*where)
        t, x = where if self.timed else (0.0, where[0])
        if is_traced(costate, self):
            return _minimisers(as_jax(self), jnp.asarray(t, costate.dtype), jnp.asarray(x, costate.dtype), costate)
        with own_settings(x64=True):
            return np.asarray(_compiled(*cast((self, np.asarray(t, float), np.asarray(x, float), costate), np.float64)))


def _minimisers(feedback: CostateFeedback, t: Array, x: Array, costate: Array) -> jax.Array:
    """The controls at states of shape (..., n)."""
    shape = costate.shape
    t, x = jnp.broadcast_to(t, shape[:-1]).reshape(-1), jnp.broadcast_to(x, shape).reshape(-1, shape[-1])

    def one(t: Array, x: Array, p: Array) -> jax.Array:
        found = pointwise.minimiser(feedback.problem, feedback.rule, t, x, p)
        return jnp.where(jnp.all(jnp.isfinite(p)), found, jnp.nan)

    found = jax.vmap(one)(t, x, costate.reshape(-1, shape[-1]))
    return found.reshape(*shape[:-1], found.shape[-1])


_compiled = jax.jit(_minimisers)


def costate_feedback(problem: Problem, solution: GridFreeSolution) -> CostateFeedback:
    """The feedback of a solution without a grid, after checks of the problem.

    Raises:
      ValueError: a problem without controls, with an opponent, with bounds that depend on the state, or with noise that
        depends on the control.
    """
    name = "greedy_feedback"
    for field, given in (("disturbances", problem.disturbances), ("modes", problem.modes)):
        if given is not None:
            raise ValueError(f"{name}: got a problem with {field} and a solution without a grid; use its control_at")
    if problem.controls is None or callable(problem.controls):
        raise ValueError(f"{name}: wanted controls in a fixed set, for a solution without a grid")
    n = solution.ndim
    with own_settings(x64=None if is_traced(problem, solution) else True):
        checks.of_one_state(problem, n, "the number of states of the solution")
        problem = closures.settled(problem, n)
        if not influence(problem, n, np.dtype(np.float64)).noise.is_constant:
            raise ValueError(f"{name}: the noise depends on the control, and a solution without a grid has no D²V")
        rule = pointwise.rule_of(problem, n)
    return CostateFeedback(problem, solution, rule, solution.timed)
