"""The methods of a stationary solve, as values, and a guide to custom methods.

Every method repeats one step: at V the greedy policy leaves a defect, and the method computes the correction δ. A
method of damped Jacobi sweeps:

    >>> import dataclasses
    >>> import jax
    >>> import hjbjax as hjb
    >>> from hjbjax.iteration.evaluation import jacobi
    >>> from hjbjax.iteration.methods import Method
    >>> @jax.tree_util.register_static
    ... @dataclasses.dataclass(frozen=True)
    ... class Jacobi(Method):
    ...     sweeps: int = 8
    ...     evaluation = hjb.Sweeps()  # for derivatives
    ...
    ...     def correct(self, step):
    ...         return jacobi(step.equation(), step.grid, self.sweeps)
    ...
    ...     def patience(self, grid):
    ...         return 100_000
    >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    >>> hjb.solve(problem, hjb.Grid([-1.0], [1.0], (41,)), method=Jacobi()).status.name
    'CONVERGED'

``correct`` is traced, and the object enters compiled programs as a pytree, here without numbers. The loop does the
rest: the certificate, the constraints, and stopping when steps make no progress.

In a game the value of the outer player's policy is the value of the inner player's problem against it (``evaluated``).
The inner player responds, the response is evaluated, and so on, until the residual of this problem is a tenth of the
outer residual, or a millionth after the outer residual has risen. Then the outer player improves. Improving both at
once may cycle. After A. J. Hoffman and R. M. Karp.
"""

import abc
from typing import Protocol

import jax
import jax.numpy as jnp

from hjbjax.iteration.bellman import Greedy, PolicyEquation
from hjbjax.iteration.evaluation import Evaluation, check_choice, check_evaluation, evaluate
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Field, Number, Scalar, Verdict

CLIMB = 100_000  # steps of value iteration without progress: without discount V rises by L Δt per step for a long time
# Goal of the inner residual relative to the outer one. While the outer residual falls, an accurate response to a policy
# that is about to change is wasted. Once it rises, the inner player was far from its optimum, because its residual
# counts up to (Q + β)/β times as much in V, and improving against it may continue indefinitely.
SHARE, EXACT = 0.1, 1e-6
SHIFT = 1.2  # growth factor of the pseudo-time step; with 2, other solutions of the equation with open ends are found
SHIFTS = 150  # steps after which the shift is zero: 1.2¹⁵⁰ is 10¹²


class Step(Protocol):
    """The view of a solve at one of its values that is passed to a method."""

    @property
    def grid(self) -> Grid:
        """The grid."""

    def equation(self) -> PolicyEquation:
        """The linear equation of the greedy policy for a correction δ, in cost units."""

    def relaxed(self) -> jax.Array:
        """r/(Q + β), with the rate of the fastest action: one relaxation of every node, (*grid)."""

    def evaluated(self, evaluation: Evaluation, replies: int) -> jax.Array:
        """The correction that makes V approximately the value of its greedy policy; in a game, of the outer policy."""


class Method(abc.ABC):
    """The base class of methods, which correct V in a stationary solve; registered with JAX as pytrees.

    A method defines ``correct``; everything else has a default.
    """

    @property
    def relaxes(self) -> bool:
        """True if it uses the largest rate as the matrix, so that V rises or falls to its fixed point step by step."""
        return False

    @property
    def policy(self) -> bool:
        """True if the solution contains the policy; otherwise a method that ``relaxes`` stores only V."""
        return True

    @property
    def by_defect(self) -> bool:
        """True if ``correct`` requires only the defect at V, so that the actions are computed once, at the end."""
        return False

    @property
    def evaluation(self) -> Evaluation | None:
        """The solver for the equation of a policy, also for derivatives. None if it is never solved."""
        return None

    @property
    def inner(self) -> "Method":
        """The method on a single grid: the method itself, unless it uses coarser grids."""
        return self

    @property
    def coarsest(self) -> int | None:
        """The number of nodes of the coarsest grid; None for a method on a single grid."""
        return None

    @property
    def in_parts(self) -> bool:
        """True if ``correct`` reads other nodes through ``stencil`` only, so that devices can share the nodes."""
        return False

    def filled(self, evaluation: Evaluation) -> "Method":
        """The method with the evaluation that suits the problem, unless it has its own."""
        return self

    @abc.abstractmethod
    def correct(self, step: Step) -> jax.Array:
        """The correction δ, (*grid), in cost units."""

    def patience(self, grid: Grid) -> int:
        """The number of steps without progress after which the solve has stalled.

        A good policy advances by one cell per improvement, and a wave of improvements may cross the box four times.
        """
        return 100 + 4 * sum(grid.shape)  # a hundred for small grids

    def described(self, game: bool) -> str:
        """The method as source text, with the numbers that matter only in a game if it is one."""
        return repr(self)


@pytree_dataclass(static=("policy",))
class ValueIteration(Method):
    """V ← max(g, min(ψ, V + (min max H − β V)/(max_u Q + β))): monotone, converges from every guess.

    The error falls by 1/(1 + βΔt) per step: many cheap steps. For reference, for games, and where memory is scarce.

    Args:
      policy: return the policy with the value. Otherwise only V is stored, in about three arrays, for tubes and
        discounted problems. The solution then has no ``policy``, ``cut``, ``reached`` or ``isaacs_gap``, and
        ``hjb.greedy_feedback`` computes controls from V. Host level.
    """

    policy: bool = True
    relaxes, in_parts, by_defect = True, True, True

    def __post_init__(self) -> None:
        if not isinstance(self.policy, bool):
            raise TypeError(f"ValueIteration: policy is {self.policy!r}; wanted True or False")

    def correct(self, step: Step) -> jax.Array:
        """One relaxation of every node."""
        return step.relaxed()

    def patience(self, grid: Grid) -> int:
        """A large number: a value that rises by L Δt per step shows no progress for a long time."""
        return CLIMB

    def described(self, game: bool) -> str:
        """The method as source text."""
        return "ValueIteration()" if self.policy else "ValueIteration(policy=False)"


@pytree_dataclass(static=("replies",))
class PolicyIteration(Method):
    """Improve the policy, evaluate it, repeat; methods of this family differ in the evaluation.

    Args:
      evaluation: ``Sweeps(count)`` is modified policy iteration; ``Krylov()`` and ``Direct()`` are Howard's; ``None``
        chooses by the problem, as ``solve`` does: a linear solve with noise or open ends, else sweeps.
      replies: in a game, the largest number of the inner player's improvements per improvement of the outer player.
    """

    evaluation: Evaluation | None = None
    replies: int = 20

    @property
    def in_parts(self) -> bool:
        """True if the evaluation supports divided nodes; without an evaluation, one that supports them is chosen."""
        return self.evaluation is not None and self.evaluation.in_parts

    def __post_init__(self) -> None:
        if self.evaluation is not None:
            check_evaluation(self.evaluation, "PolicyIteration: evaluation")
        arguments.count(self.replies, "PolicyIteration: replies")

    def filled(self, evaluation: Evaluation) -> "PolicyIteration":
        """The method with this evaluation, unless it has its own."""
        return PolicyIteration(self.evaluation or evaluation, self.replies)

    def correct(self, step: Step) -> jax.Array:
        """The correction towards the value of the greedy policy."""
        assert self.evaluation is not None
        return step.evaluated(self.evaluation, self.replies)

    def described(self, game: bool) -> str:
        """The method as source text, without ``replies`` unless in a game."""
        chosen = [] if self.evaluation is None else [repr(self.evaluation)]
        return f"PolicyIteration({', '.join([*chosen, *[f'replies={self.replies}'] * game])})"


@pytree_dataclass(static=("coarsest",))
class Nested(Method):
    """Solve on coarser grids first, and start each finer one from the interpolated solution.

    From a cold start the number of policy improvements grows with N, since a good policy advances by one cell per
    improvement; from the coarser grid's solution only a few are needed. Host level only: every level is compiled
    separately.

    Args:
      inner: the method on each level.
      coarsest: the least number of nodes of the coarsest grid.
    """

    inner: Method = PolicyIteration()
    coarsest: int = 2000

    def __post_init__(self) -> None:
        check_method(self.inner, "Nested: inner")
        if self.inner.coarsest is not None:  # every level would start again at the coarsest grid
            wanted = "hjb.PolicyIteration(...) or hjb.ValueIteration(), which run on one grid"
            raise TypeError(f"Nested: inner is {self.inner!r}; wanted {wanted}")
        arguments.count(self.coarsest, "Nested: coarsest")

    @property
    def relaxes(self) -> bool:
        """The property of the inner method."""
        return self.inner.relaxes

    @property
    def evaluation(self) -> Evaluation | None:
        """The evaluation of the inner method."""
        return self.inner.evaluation

    @property
    def in_parts(self) -> bool:
        """The property of the inner method."""
        return self.inner.in_parts

    def filled(self, evaluation: Evaluation) -> "Nested":
        """The method with an evaluation on every level."""
        return Nested(self.inner.filled(evaluation), self.coarsest)

    def correct(self, step: Step) -> jax.Array:
        """The correction of the inner method."""
        return self.inner.correct(step)

    def patience(self, grid: Grid) -> int:
        """The patience of the inner method."""
        return self.inner.patience(grid)

    def described(self, game: bool) -> str:
        """The method as source text, with the method of each level."""
        return f"Nested({self.inner.described(game)}, coarsest={self.coarsest})"


def check_method(method: object, name: str) -> None:
    """Refuse, by ``name``, an object that is not a method of a stationary solve.

    Raises:
      TypeError: lists the available methods.
    """
    check_choice(method, Method, name, "hjb.PolicyIteration(...) or hjb.ValueIteration()")


def shift(largest: Scalar, step: Scalar) -> Scalar:
    """κ, per unit time, added to the discount in a correction with open ends; decreases geometrically.

    Each correction is then an implicit time step of length 1/κ. The equation with open ends has several solutions, of
    which the stable one is required, and policies that leave may have no finite value.
    """
    dying = jnp.asarray(SHIFT, largest.dtype) ** -step
    return jnp.where(step < SHIFTS, largest * dying, 0)


def shift_factor(shift: Scalar, discount: Number) -> Scalar:
    """Approximately the factor by which a step without the shift κ would have been longer: 1 + κ/β."""
    discount = jnp.asarray(discount, shift.dtype)
    safe = jnp.where(discount > 0, discount, 1)
    return jnp.where(shift == 0, 1, jnp.where(discount > 0, 1 + shift / safe, jnp.inf))


class Question(Protocol):
    """A stationary problem, or one step in time, for policy evaluation."""

    @property
    def grid(self) -> Grid:
        """The grid."""

    def equation(self, value: Field, policy: Greedy) -> PolicyEquation:
        """The linear equation of a policy for a correction of ``value``."""

    def reply(self, value: Field, policy: Greedy) -> Greedy:
        """The inner player's best response to the outer player's policy, with its defect."""

    def impose(self, value: Field) -> Field:
        """``value`` with fixed values inserted and constraints imposed."""

    def residual(self, equation: PolicyEquation) -> Scalar:
        """The largest |source| at the counted nodes, in cost units."""


def inner_goal(residual: Number, least: Number) -> Scalar:
    """The goal for the inner residual, cost units, from the outer residual and the least outer residual so far."""
    return jnp.where(residual > least, EXACT, SHARE) * residual


def evaluated(
    question: Question, value: Field, policy: Greedy, evaluation: Evaluation, *, goal: Number, replies: int
) -> Field:
    """The value of the outer player's policy, from the inner player's problem.

    Args:
      question: the game.
      value: V, (*grid).
      policy: both players' greedy actions at V.
      evaluation: the solver for the linear equation of a pair of policies.
      goal: the residual at which the inner problem is solved, in cost units.
      replies: the largest number of responses of the inner player.
    """

    def reply(carry: tuple[Field, Greedy, Scalar, Scalar]) -> tuple[Field, Greedy, Scalar, Scalar]:
        value, policy, _, count = carry
        delta = evaluate(evaluation, question.equation(value, policy), question.grid)
        value = question.impose(value + delta)
        policy = question.reply(value, policy)
        # the response at the new value leaves a residual of the inner problem only, since the outer policy is fixed
        return value, policy, question.residual(question.equation(value, policy)), count + 1

    def unfinished(carry: tuple[Field, Greedy, Scalar, Scalar]) -> Verdict:
        return (carry[2] > goal) & (carry[3] < replies)

    # infinite, so that the outer player's policy is evaluated at least once, against the response it was found with
    start = (value, policy, jnp.asarray(jnp.inf, value.dtype), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, reply, start)[0]  # the caller recomputes the policy
