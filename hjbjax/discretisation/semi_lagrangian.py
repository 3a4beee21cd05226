"""The semi-Lagrangian scheme, as a value: which arcs are tried, and which problems it is for.

    V(x) = min over arcs of ∫₀^τ e^{−βs} L(y, u) ds + e^{−βτ} I[V](y(τ))        (see ``arcs``)

A chain of jumps to neighbours spreads V by diffusion of the order of a cell all the way along a path. An arc of many
cells is interpolated once, at its end, so that there is the less of that the longer it is; but its control is held.
Where the optimal control jumps, as along the switching curve of a minimum time, the optimal path runs along a kink of
V, and what is held leaves it. So arcs of several lengths are tried beside each other, the shortest of one cell: the
minimum takes long ones far from a switch, and short ones up to it.

Source: M. Falcone and R. Ferretti, Semi-Lagrangian Approximation Schemes for Linear and Hamilton–Jacobi Equations, for
the scheme with a held control.
"""

import math
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.arcs import Plan
from hjbjax.problem import arguments, sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_discounted
from hjbjax.problem.pytree import is_traced, known, pytree_dataclass
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Finite
from hjbjax.problem.types import DType
from hjbjax.tracing import dependence


@runtime_checkable
class PathScheme(Protocol):
    """A scheme that follows paths in place of slopes, as a value: frozen and hashable."""

    @property
    def points(self) -> int:
        """The nodes that an axis must have."""

    @property
    def in_parts(self) -> bool:
        """True if many devices can share the nodes."""

    def check(self, problem: Problem, grid: Grid) -> None:
        """Refuse a problem, or a grid, that it is not for."""

    def plan(self, problem: Problem, grid: Grid, dtype: DType) -> Plan:
        """The arcs that are tried."""


@pytree_dataclass(static=("cells", "actions"))
class SemiLagrangian:
    """Long characteristic steps with monotone interpolation, for deterministic problems whose paths run along kinks.

    From each node arcs of 1, about √``cells`` and ``cells`` cells are tried, each under one action that is held. V_h is
    the fixed point of the least of them, a Markov chain with long jumps, and the certificates are those of ``Upwind``
    with jumps in place of rates: V + min r/(1 − e^{−βτ}) ≤ V_h ≤ V + max r/(1 − e^{−βτ}) under a discount, and
    V/(1 + max(−r/c)) ≤ V_h ≤ V/(1 − max(r/c)) without, r what an arc is worth less V, on the left of all arcs and on
    the right of the best one from each node, and c its running cost. First order in general, with a far smaller
    constant than the chain's where V has kinks: on the double integrator's minimum time a seventh of its mean error. A
    target ends where its l is zero, between the nodes; one of a single node is met by interpolation.

    What is minimised over are these arcs and nothing between them. The actions are those of a ``Finite`` set; of a box
    or a ball for which drift and cost are affine in the control the corners, or about ``actions`` directions on the
    rim; else about ``actions`` samples, so that the optimal control is met up to the distance between two of them. The
    policy is the action of the best arc.

    For ``solve``, by ``ValueIteration()`` or ``PolicyIteration(Sweeps(...))``, at host level, without noise,
    disturbances or a ``running_max``, with projected or periodic ends; without a discount it wants a target or a
    ``stopping_cost``, and a positive running cost. No error of the grid is estimated. Memory: 36 bytes a node and arc
    in the plane, three arcs an action.

    Args:
      cells: the cells that the longest arc crosses. More of them interpolate less and hold the control longer.
      actions: directions on the rim of a ball, or samples of a set whose corners do not suffice, about.

    Example:
      >>> import hjbjax as hjb
      >>> problem, grid = hjb.zoo.double_integrator(shape=(41, 41))
      >>> exact = hjb.zoo.double_integrator_exact()
      >>> for scheme in (hjb.Upwind(), hjb.SemiLagrangian()):
      ...     print(abs(float(hjb.solve(problem, grid, scheme=scheme).value_at([1.0, 0.0]) - exact([1.0, 0.0]))) < 0.02)
      False
      True
    """

    cells: int = 16
    actions: int = 64
    points, in_parts = 2, False

    def __post_init__(self):
        arguments.count(self.cells, "SemiLagrangian: cells")
        arguments.count(self.actions, "SemiLagrangian: actions")

    def check(self, problem: Problem, grid: Grid) -> None:
        """Refuse what has no arcs, or no certificate on them.

        Raises:
          ValueError: with what to use in its place.
        """
        for present, what in (
            (problem.noise is not None, "a problem with noise: its paths spread"),
            (problem.is_game, "a game: the disturbance would have to answer in the middle of an arc"),
            (problem.running_max is not None, "a running_max: the maximum is looked for at nodes alone"),
            (bool(grid.sides("open")), "open ends, beyond which there is nothing to interpolate"),
            (bool(grid.prescribed()), "prescribed ends, which arcs may cross on their way"),
            (bool(grid.sides("constrained")), "constrained ends, which all long arcs near them may cross"),
        ):
            if present:
                raise ValueError(f"solve: SemiLagrangian() is not for {what}; use hjb.Upwind() or Limited()")
        if is_discounted(problem) is False and problem.target is None and problem.stopping_cost is None:
            raise ValueError(
                "solve: SemiLagrangian() without discount wants a target or a stopping_cost, where paths end; at a "
                "rest point they never arrive: give one of them, a discount > 0, or use hjb.Upwind()"
            )

    def plan(self, problem: Problem, grid: Grid, dtype: DType) -> Plan:
        """Arcs of all actions and of three lengths, or fewer where these coincide."""
        # without those of one cell V is worse beside a switch, a target of one node, or a stopping cost
        legs = sorted({1, round(math.sqrt(self.cells)), self.cells})
        return Plan(_actions(problem, grid.ndim, dtype, self.actions), np.array(legs, np.int32))


def _actions(problem: Problem, n: int, dtype: DType, budget: int) -> Any:
    """The actions that arcs are made of, shape (K, m)."""
    admissible = problem.controls
    if admissible is None:
        return np.zeros((1, 0), dtype)
    points = _rim(admissible, budget) if _bang_bang(problem, n, dtype) else sets.samples(admissible, budget)
    # bounds of a set may be traced, so that arcs are differentiated with respect to them
    return jnp.asarray(points, dtype) if is_traced(points) else np.asarray(known(points), dtype)


def _bang_bang(problem: Problem, n: int, dtype: DType) -> bool:
    """True if drift and cost are affine in the control, so that the rim of its set suffices along a path."""
    found = dependence.influence(problem, n, dtype)
    inputs = found.control
    straight = found.cost.separable_quadratic_in(inputs) and not any(found.cost.has_square([j]) for j in inputs)
    return bool(found.drift.affine_in(inputs) and straight)


def _rim(admissible: AdmissibleSet, budget: int) -> Any:
    """The corners of a box, directions on the sphere, all of a finite set."""
    if isinstance(admissible, Box):
        return sets.extremes(admissible)
    if isinstance(admissible, Finite):
        return admissible.points
    assert isinstance(admissible, Ball)
    if admissible.dim == 2:  # at equal angles, the axes among them where their number is a multiple of four
        angles = 2 * np.pi * np.arange(budget) / budget
        return admissible.radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    points = np.asarray(sets.samples(Ball(1.0, admissible.dim), budget))
    return admissible.radius * points[np.linalg.norm(points, axis=1) > 0.99]
