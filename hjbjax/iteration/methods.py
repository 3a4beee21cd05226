"""The methods of a stationary solve, as values: what is done, and not how."""

from hjbjax.iteration.evaluation import Evaluation, Sweeps, check_evaluation
from hjbjax.problem import arguments
from hjbjax.problem.pytree import node


@node()
class ValueIteration:
    """V ← max(g, min(ψ, V + (min max H − β V)/(max_u Q + β))): monotone, converges from every guess.

    The error falls by 1/(1 + βΔt) a step: many cheap steps. For reference, for games, and where memory rules.
    """


@node(static=("replies",))
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


@node(static=("coarsest",))
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
