"""The methods of a stationary solve and those of a march, as values: what is done, and not how."""

import dataclasses
from typing import Any

from hjbjax.iteration.evaluation import Evaluation, Sweeps, check_evaluation
from hjbjax.problem import arguments
from hjbjax.problem.pytree import pytree_dataclass


@pytree_dataclass()
class ValueIteration:
    """V ← max(g, min(ψ, V + (min max H − β V)/(max_u Q + β))): monotone, converges from every guess.

    The error falls by 1/(1 + βΔt) a step: many cheap steps. For reference, for games, and where memory rules.
    """


@pytree_dataclass(static=("replies",))
class PolicyIteration:
    """Improve the policy, evaluate it, repeat; the evaluation is what distinguishes the methods of this family.

    Args:
      evaluation: ``Sweeps(count)`` is modified policy iteration; ``Krylov()`` and ``Direct()`` are Howard's.
      replies: in a game, the inner player's improvements for each of the outer player's, at most.
    """

    evaluation: Evaluation = Sweeps()
    replies: int = 20

    def __post_init__(self):
        check_evaluation(self.evaluation, "PolicyIteration: evaluation")
        arguments.count(self.replies, "PolicyIteration: replies")


@pytree_dataclass(static=("coarsest",))
class Nested:
    """Solve on coarser grids first, and start each finer one from the interpolated answer.

    From a cold start the count of policy improvements grows with N, one cell of good policy an improvement; from
    the coarser grid's answer it stays at a few. Host level only: every level is compiled on its own.

    Args:
      inner: what runs on each level.
      coarsest: do not go on to grids with fewer nodes than this.
    """

    inner: PolicyIteration | ValueIteration = PolicyIteration()
    coarsest: int = 2000

    def __post_init__(self):
        wanted = "hjb.PolicyIteration(...) or hjb.ValueIteration()"
        arguments.one_of(self.inner, "Nested: inner", (PolicyIteration, ValueIteration), wanted)
        arguments.count(self.coarsest, "Nested: coarsest")


Method = ValueIteration | PolicyIteration | Nested


# --- in time ---


@dataclasses.dataclass(frozen=True)
class Tableau:
    """An explicit Runge–Kutta method made of Euler steps: W ← a_k V + (1 − a_k) (W + c Δt F(W)), from W = V on.

    Such a method is strong-stability preserving with steps 1/c times as long as Euler's. Its order is for who writes it
    to know.

    Args:
      means: a_k, the share of V in the result of every stage, from 0 to below 1.
      euler: c, the length of the Euler steps over that of the whole one.

    Raises:
      ValueError: shares or a length out of range, or stages that do not end at the end of the step.

    Example:
      >>> Tableau((0.0, 0.0, 1 / 3), 1 / 2).times  # of second order, with steps twice as long as Euler's
      (0.0, 0.5, 1.0, 1.0)
    """

    means: tuple[float, ...]
    euler: float = 1.0

    def __post_init__(self):
        object.__setattr__(self, "means", tuple(map(float, self.means)))
        if not self.means or not all(0 <= share < 1 for share in self.means):
            raise ValueError(f"Tableau: got means = {self.means!r}, wanted one number a stage, from 0 to below 1")
        arguments.positive(self.euler, "Tableau: euler", most=1)
        if self.times[-1] != 1:
            raise ValueError(f"Tableau: the last stage ends at {self.times[-1]:g} of a step, wanted 1: see .times")

    @property
    def times(self) -> tuple[float, ...]:
        """Where each stage evaluates F, and where the last one ends, in steps."""
        found = [0.0]
        for share in self.means:
            found.append(round((1 - share) * (found[-1] + self.euler), 12))
        return tuple(found)


TABLEAUX = {
    1: Tableau((0.0,)),
    2: Tableau((0.0, 1 / 2)),
    3: Tableau((0.0, 3 / 4, 1 / 3)),
    4: Tableau((0.0, 0.0, 2 / 3, 0.0), 1 / 2),
}


@pytree_dataclass(static=("stages",))
class Explicit:
    """Explicit steps by a strong-stability-preserving Runge–Kutta method.

    Args:
      stages: 1 (Euler), 2 or 3, which is also the order in time; 4, of order 3 with steps twice as long, which takes
        two thirds of the evaluations of 3; a ``Tableau`` of your own; or ``None`` for what goes with the scheme: 1 for
        ``Upwind``, 3 for ``Weno5``, else 2.
      fraction: the length of a step over the stability limit, 1/(max Q + β) or twice that with 4 stages; at most 1.
    """

    stages: int | Tableau | None = None
    fraction: Any = 0.9
    halves = True  # players who meet in a component are upwinded each by itself, see ``splitting``

    def __post_init__(self):
        named = not isinstance(self.stages, bool) and self.stages in (None, *TABLEAUX)
        if not named and not isinstance(self.stages, Tableau):
            raise ValueError(f"Explicit: got stages = {self.stages!r}, wanted 1, 2, 3, 4, a Tableau or None")
        arguments.positive(self.fraction, "Explicit: fraction", most=1)

    @property
    def tableau(self) -> Tableau:
        """The method of the stages; they must be known."""
        assert self.stages is not None
        return self.stages if isinstance(self.stages, Tableau) else TABLEAUX[self.stages]

    @property
    def courant(self) -> Any:
        """The length of a step times max Q + β."""
        return self.fraction / self.tableau.euler


@pytree_dataclass(static=("max_steps",))
class Implicit:
    """Implicit Euler steps, each by policy iteration: any length, first order in time.

    Args:
      evaluation: how a policy is evaluated; ``None`` is ``Krylov()`` with noise and ``Sweeps()`` without.
      tol: bound on what the policy iterations leave over the whole march, in cost units.
      max_steps: policy improvements in one step, at most.
    """

    evaluation: Evaluation | None = None
    tol: Any = 1e-6
    max_steps: int = 100
    halves = False  # a chain has one drift, the sum of both players'

    def __post_init__(self):
        if self.evaluation is not None:
            check_evaluation(self.evaluation, "Implicit: evaluation")
        arguments.positive(self.tol, "Implicit: tol", "in the units of the cost")
        arguments.count(self.max_steps, "Implicit: max_steps")
