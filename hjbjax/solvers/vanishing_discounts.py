"""The start of an undiscounted solve: the solutions for vanishing discounts.

If an undiscounted problem is iterated from zero, its policies do not move, although staying has a cost. With a small
discount they move to the target. A stopping cost or a running maximum is a start itself: ψ is above all fixed points, g
below.
"""

import numpy as np

from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.fixed_point import Task
from hjbjax.problem.pytree import altered, known
from hjbjax.problem.types import Nodes
from hjbjax.solution.clock import Clock
from hjbjax.solvers.stationary_run import iterate

VANISHING = (2.0, 0.2, 0.02)  # discounts, in units of one over the time to cross the box
FURTHER = ((2e-3, 2e-4), (2e-5, 2e-6), (2e-7, 2e-8))  # for parts of the box that are that much slower than the fastest
WARM_STEPS = 60  # largest number of improvements per discount, as the last value is only a guess


def warm(task: Task, guess: Nodes | None, clock: Clock) -> Nodes:
    """The guess if there is one; else zero, or without discount a start that leads to the right fixed point."""
    if guess is not None:
        return guess
    value = task.start() if task.constrained else np.zeros(task.grid.shape, task.tol.dtype)
    return follow(task, value, VANISHING, clock) if needs_a_way(task) else value


def needs_a_way(task: Task) -> bool:
    """True if the iteration from zero may be trapped by policies that stay where they are, at a cost."""
    return task.certificate is Certificate.MULTIPLICATIVE and not task.constrained


def follow(task: Task, value: Nodes, discounts: tuple[float, ...], clock: Clock) -> Nodes:
    """The solution for the last of these discounts, in units of one over the crossing time.

    The iteration for each discount starts from the solution for the one before.
    """
    for discount in discounts:
        value = iterate(under(task, discount), value, clock, most=WARM_STEPS)[0].value
    return value


def under(task: Task, discount: float) -> Task:
    """The task with a discount in units of one over the crossing time."""
    # only a number changes: with the same structure and certificate the program of the solve itself is reused
    return task.asking(altered(task.problem, discount=np.asarray(discount / known(task.crossing), task.tol.dtype)))
