"""From a prepared task to the end of its iteration, with everything that has to happen in between."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.iteration.bellman import Greedy
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.evaluation import Krylov
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.iteration.methods import PolicyIteration
from hjbjax.problem.types import Mask, Nodes
from hjbjax.solution.clock import Clock, Stopped
from hjbjax.solution.status import Status
from hjbjax.solvers.coarse_levels import CoarserAnswer
from hjbjax.solvers.order import at_order
from hjbjax.solvers.setup import Assumptions, forced_only
from hjbjax.solvers.stationary_run import evaluated_state, iterate
from hjbjax.solvers.vanishing_discounts import FURTHER, follow, needs_a_way, warm
from hjbjax.well_posedness import resting

FAILED = (Status.STALLED, Status.DIVERGED, Status.NONFINITE)


class Settled(NamedTuple):
    """The end of an iteration.

    Attributes:
      task: the task as it was solved in the end.
      assumptions: what was assumed about it.
      reached: the nodes that can be brought to the target, bool (*grid); None if this was not computed.
      state: the last state.
      code: its status.
      residuals: the residuals of all steps.
      origin: the end of the monotone iteration from which a second-order iteration started.
      coarser: the answer of the same scheme on the next coarser grid, if it was computed on the way.
      note: a further sentence of the solution's message.
    """

    task: Task
    assumptions: Assumptions
    reached: Mask | None
    state: State
    code: Status
    residuals: np.ndarray
    origin: "Settled | None" = None
    coarser: CoarserAnswer | None = None
    note: str = ""

    def without_actions(self) -> "Settled":
        """The same result without its policy, if the policy follows from V, to free its memory."""
        if self.task.keeps_actions or not self.task.on.players.exact:
            return self
        return self._replace(state=dataclasses.replace(self.state, policy=Greedy(jnp.zeros(()), (), ())))

    def with_actions(self) -> "Settled":
        """The same result with its policy, which is computed again if it was left out."""
        if self.task.bare or jnp.ndim(self.state.policy.defect):
            return self
        policy = evaluated_state(self.running, self.state.value).policy
        return self._replace(state=dataclasses.replace(self.state, policy=policy))

    @property
    def running(self) -> Task:
        """The task of the compiled program: for a high-order solution this may be the program of its chain."""
        if self.origin is None or self.origin.task.first_order is None:
            return self.task
        return dataclasses.replace(at_order(self.origin.task, first=False), weights=self.task.weights)

    def of_chain(self) -> "Settled":
        """The same result with the task of the chain, if the iteration ran in the program of a second-order scheme."""
        return self if self.task.first_order is None else self._replace(task=self.task.of_chain)


def may_go_on(task: Task, assumptions: Assumptions, state: State, code: Status) -> bool:
    """True if a run with this outcome may have to continue: leaving a rest node may pay, or a game or start failed."""
    if code is Status.CONVERGED:
        return assumptions.may_rest and float(np.min(np.asarray(state.value), initial=0)) < 0
    return code in FAILED and (task.problem.is_game or needs_a_way(task))


def settle(task: Task, assumptions: Assumptions, reached: Mask | None, guess: Nodes | None, clock: Clock) -> Settled:
    """The end of the iteration of a task.

    Rest nodes are fixed first, at the cost of resting, and released where it pays to leave them. Their fixed value is
    an upper bound, from which the iteration only descends: a released node that was too low would stay too low, since
    resting costs nothing. If a game does not converge, the nodes from which its target can be forced are found, and the
    game is solved there. Sweeps that stall, for example because the drift circulates under a small discount, are
    replaced by a linear solve.
    """
    value = warm(task, guess, clock)
    state, code, residuals = iterate(task, value, clock)
    if needs_a_way(task):
        for discounts in FURTHER:  # under a larger discount a policy stays and pays if the path is too long
            if code not in FAILED:
                break
            value = follow(task, value, discounts, clock)
            state, code, residuals = iterate(task, value, clock)
    evaluation = task.method.evaluation
    # sweeps follow the drift from the target; on a cycle no node is first, and with β Δt ≪ 1 they take 1/(β Δt) rounds
    if code is Status.STALLED and evaluation is not None and evaluation.rough:
        task = dataclasses.replace(task, method=PolicyIteration(Krylov()))
        state, code, residuals = iterate(task, state.value, clock)
    if code in FAILED:
        try:
            fewer, forced = forced_only(task, clock)
        except Stopped as stop:
            return Settled(task, assumptions, reached, state, stop.status, residuals)
        # where the disturbance can keep the state from the target, V is infinite and the iteration never ends
        if forced is not None and not forced.all():
            task, reached = fewer, forced
            # start again: the value so far comes from the endless iteration at these nodes
            state, code, residuals = iterate(task, warm(task, None, clock), clock)
    while code is Status.CONVERGED and may_go_on(task, assumptions, state, code):
        pays = _leaving_pays(task, state.value)
        if not np.any(np.asarray(pays)):
            break
        # the bound by the least running cost needs it to be positive wherever V is not fixed; at rest it is zero
        assumptions = dataclasses.replace(assumptions, certificate=Certificate.NONE)
        task = dataclasses.replace(
            task, obstacles=resting.release(task.obstacles, pays), certificate=Certificate.NONE, least_cost=None
        )
        state, code, more = iterate(task, state.value, clock)
        residuals = np.concatenate([residuals, more])
    return Settled(task, assumptions, reached, state, code, residuals)


@jax.jit
def _leaving_pays(task: Task, value: jax.Array) -> jax.Array:
    """The fixed rest nodes that it pays to leave, bool (*grid)."""
    return resting.leaving_pays(task.on.chain, task.obstacles, task.counted, value)
