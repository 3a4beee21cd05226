"""The methods of a stationary solve, as values, and how to write one of your own.

Every method repeats one step: at V the greedy policy leaves a defect, and the method says which correction δ is added.
A method of damped Jacobi sweeps:

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

``correct`` is traced, and the object enters compiled programs as a pytree, here one without numbers. The loop does the
rest: the certificate, the constraints, and stopping where steps make no progress.

In a game the value of a policy is that of the inner player's problem against it (``evaluated``): the inner player
answers, the answer is evaluated, and so on until the residual of that problem is a tenth of the outer one's, or a
millionth once the outer one has risen; then the outer player improves. Improving both at once may cycle. After A. J.
Hoffman and R. M. Karp.
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
from hjbjax.problem.types import Field, Number, Scalar

CLIMB = 100_000  # steps of value iteration without progress: without discount V climbs by L Δt a step for long
# Of the outer residual that of the inner problem: a better answer to a policy that is about to change is work for
# nothing, while the outer residual falls. Where it rose the inner player was far from its optimum, since its residual
# counts for up to (Q + β)/β times as much in V: improving against that may go on for ever.
SHARE, EXACT = 0.1, 1e-6
SHIFT = 1.2  # by which the time of a pseudo-step grows; at 2 other solutions of the equation with open ends are found
SHIFTS = 150  # steps after which there is no shift any more: 1.2¹⁵⁰ is 10¹²


class Step(Protocol):
    """A solve at one of its values, as a method sees it."""

    @property
    def grid(self) -> Grid:
        """The nodes."""

    def equation(self) -> PolicyEquation:
        """The linear equation of the greedy policy for a correction δ, in cost units."""

    def relaxed(self) -> jax.Array:
        """r/(Q + β), with the rate of the fastest action: one relaxation of every node, (*grid)."""

    def evaluated(self, evaluation: Evaluation, replies: int) -> jax.Array:
        """The correction that makes V the value of its greedy policy, roughly; in a game of the outer player's."""


class Method(abc.ABC):
    """The base class of methods, which correct V in a stationary solve; registered with JAX as pytrees.

    A method defines ``correct``; everything else has a default, given here.
    """

    @property
    def relaxes(self) -> bool:
        """True if it takes the largest rate for the matrix: V climbs or falls to its fixed point step by step."""
        return False

    @property
    def policy(self) -> bool:
        """True if the solution holds the policy; without it a method that ``relaxes`` keeps nothing but V."""
        return True

    @property
    def by_defect(self) -> bool:
        """True if ``correct`` needs only the defect at V, so that the actions are found once, at the end."""
        return False

    @property
    def evaluation(self) -> Evaluation | None:
        """The solver of the equation of a policy, also for derivatives. None if that is never solved."""
        return None

    @property
    def inner(self) -> "Method":
        """The method that runs on one grid: the method itself, unless it uses coarser grids."""
        return self

    @property
    def coarsest(self) -> int | None:
        """The number of nodes of the coarsest grid; None for a method of one grid."""
        return None

    @property
    def in_parts(self) -> bool:
        """True if ``correct`` reads other nodes through ``stencil`` only, as many devices need."""
        return False

    def filled(self, evaluation: Evaluation) -> "Method":
        """The method with the evaluation that suits the problem, if it needs one and has none."""
        return self

    @abc.abstractmethod
    def correct(self, step: Step) -> jax.Array:
        """δ, (*grid), in cost units."""

    def patience(self, grid: Grid) -> int:
        """The number of steps without progress after which the solve has stalled.

        A good policy moves one cell per improvement, and a wave may cross the box four times.
        """
        return 100 + 4 * sum(grid.shape)  # a hundred for grids so small that crossing them takes no time

    def described(self, game: bool) -> str:
        """The method as one would write it, without the numbers that only matter in a game."""
        return repr(self)


@pytree_dataclass(static=("policy",))
class ValueIteration(Method):
    """V ← max(g, min(ψ, V + (min max H − β V)/(max_u Q + β))): monotone, converges from every guess.

    The error falls by 1/(1 + βΔt) a step: many cheap steps. For reference, for games, and where memory rules.

    Args:
      policy: whether the policy comes with the value. Without it nothing is kept but V, in some three arrays in place
        of many, for tubes and under a discount; the solution has no ``policy``, ``cut``, ``reached`` or
        ``isaacs_gap``, and ``hjb.greedy_feedback`` finds the controls from V where they are wanted. Host level.
    """

    policy: bool = True
    relaxes, in_parts, by_defect = True, True, True

    def __post_init__(self):
        if not isinstance(self.policy, bool):
            raise TypeError(f"ValueIteration: policy is {self.policy!r}; wanted True or False")

    def correct(self, step: Step) -> jax.Array:
        """One relaxation of every node."""
        return step.relaxed()

    def patience(self, grid: Grid) -> int:
        """Long: a value that climbs by L Δt a step shows no progress for long."""
        return CLIMB

    def described(self, game: bool) -> str:
        """As it is written."""
        return "ValueIteration()" if self.policy else "ValueIteration(policy=False)"


@pytree_dataclass(static=("replies",))
class PolicyIteration(Method):
    """Improve the policy, evaluate it, repeat; the methods of this family differ in the evaluation.

    Args:
      evaluation: ``Sweeps(count)`` is modified policy iteration; ``Krylov()`` and ``Direct()`` are Howard's; ``None``
        picks by the problem, as ``solve`` does: a linear solve with noise or open ends, else sweeps.
      replies: in a game, the inner player's improvements for each of the outer player's, at most.
    """

    evaluation: Evaluation | None = None
    replies: int = 20

    @property
    def in_parts(self) -> bool:
        """True if the evaluation runs in parts; an open choice is made among those that do."""
        return self.evaluation is not None and self.evaluation.in_parts

    def __post_init__(self):
        if self.evaluation is not None:
            check_evaluation(self.evaluation, "PolicyIteration: evaluation")
        arguments.count(self.replies, "PolicyIteration: replies")

    def filled(self, evaluation: Evaluation) -> "PolicyIteration":
        """The method with an evaluation, if none was asked for."""
        return PolicyIteration(self.evaluation or evaluation, self.replies)

    def correct(self, step: Step) -> jax.Array:
        """The way to the value of the greedy policy."""
        assert self.evaluation is not None
        return step.evaluated(self.evaluation, self.replies)

    def described(self, game: bool) -> str:
        """As it is written, without the replies where there is no opponent."""
        chosen = [] if self.evaluation is None else [repr(self.evaluation)]
        return f"PolicyIteration({', '.join([*chosen, *[f'replies={self.replies}'] * game])})"


@pytree_dataclass(static=("coarsest",))
class Nested(Method):
    """Solve on coarser grids first, and start each finer one from the interpolated answer.

    From a cold start the count of policy improvements grows with N, one cell of good policy an improvement; from
    the coarser grid's answer it stays at a few. Host level only: every level is compiled on its own.

    Args:
      inner: what runs on each level.
      coarsest: do not go on to grids with fewer nodes than this.
    """

    inner: Method = PolicyIteration()
    coarsest: int = 2000

    def __post_init__(self):
        check_method(self.inner, "Nested: inner")
        if self.inner.coarsest is not None:  # nested in nested: every level would start at the coarsest grid anew
            wanted = "hjb.PolicyIteration(...) or hjb.ValueIteration(), which run on one grid"
            raise TypeError(f"Nested: inner is {self.inner!r}; wanted {wanted}")
        arguments.count(self.coarsest, "Nested: coarsest")

    @property
    def relaxes(self) -> bool:
        """As on every level."""
        return self.inner.relaxes

    @property
    def evaluation(self) -> Evaluation | None:
        """As on every level."""
        return self.inner.evaluation

    @property
    def in_parts(self) -> bool:
        """As on every level."""
        return self.inner.in_parts

    def filled(self, evaluation: Evaluation) -> "Nested":
        """With an evaluation on every level."""
        return Nested(self.inner.filled(evaluation), self.coarsest)

    def correct(self, step: Step) -> jax.Array:
        """As on every level."""
        return self.inner.correct(step)

    def patience(self, grid: Grid) -> int:
        """As on every level."""
        return self.inner.patience(grid)

    def described(self, game: bool) -> str:
        """As it is written, with the method of each level."""
        return f"Nested({self.inner.described(game)}, coarsest={self.coarsest})"


def check_method(method: object, name: str) -> None:
    """Refuse, by ``name``, anything that is no method of a stationary solve.

    Raises:
      TypeError: with the methods that there are.
    """
    check_choice(method, Method, name, "hjb.PolicyIteration(...) or hjb.ValueIteration()")


def shift(largest: Scalar, step: Scalar) -> Scalar:
    """κ, per unit time, by which the discount of a correction is raised: with open ends; it dies geometrically.

    Each correction is then an implicit step in time of length 1/κ. The equation with open ends has several solutions,
    of which the stable one is wanted, and policies that leave may be worth no finite value.
    """
    dying = jnp.asarray(SHIFT, largest.dtype) ** -jnp.maximum(step, 0)
    return jnp.where(step < SHIFTS, largest * dying, 0)


def shift_factor(shift: Scalar, discount: Number) -> Scalar:
    """The factor, about, by which a step without the shift κ would have been longer: 1 + κ/β."""
    discount = jnp.asarray(discount, shift.dtype)
    safe = jnp.where(discount > 0, discount, 1)
    return jnp.where(shift == 0, 1, jnp.where(discount > 0, 1 + shift / safe, jnp.inf))


class Question(Protocol):
    """A stationary problem, or one step in time, whose policies are to be evaluated."""

    @property
    def grid(self) -> Grid:
        """The nodes."""

    def equation(self, value: Field, policy: Greedy) -> PolicyEquation:
        """The linear equation of a policy for a correction of ``value``."""

    def reply(self, value: Field, policy: Greedy) -> Greedy:
        """The inner player's best answer to the outer player's policy, with the defect that it leaves."""

    def impose(self, value: Field) -> Field:
        """``value`` with the fixed values put in and the constraints respected."""

    def residual(self, equation: PolicyEquation) -> Scalar:
        """The largest |source| at the nodes that count, in cost units."""


def inner_goal(residual: Number, least: Number) -> Scalar:
    """The residual, cost units, with which the inner problem is done, from the outer one's and the least so far."""
    return jnp.where(residual > least, EXACT, SHARE) * residual


def evaluated(
    question: Question, value: Field, policy: Greedy, evaluation: Evaluation, *, goal: Number, replies: int
) -> Field:
    """The value of the outer player's policy from its inner player's problem.

    Args:
      question: the game.
      value: V, (*grid).
      policy: both players' greedy actions at V.
      evaluation: how the linear equation of a pair of policies is solved.
      goal: the residual of the inner problem that ends it, in cost units.
      replies: at most so many answers of the inner player.
    """

    def reply(carry):
        value, policy, _, count = carry
        delta = evaluate(evaluation, question.equation(value, policy), question.grid)
        value = question.impose(value + delta)
        policy = question.reply(value, policy)
        # the answer at the new value leaves a residual of the inner problem alone: the outer policy is kept
        return value, policy, question.residual(question.equation(value, policy)), count + 1

    def unfinished(carry):
        return (carry[2] > goal) & (carry[3] < replies)

    # infinite: the outer player's policy is evaluated once at least, against the answer that it was found with
    start = (value, policy, jnp.asarray(jnp.inf, value.dtype), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, reply, start)[0]  # the policy is found anew by whoever asks
