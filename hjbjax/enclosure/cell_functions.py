"""The functions of a problem over cells of the grid, which do not depend on the candidate W.

Drift and cost are quadratic polynomials of the inputs, with coefficients that are scalars over the cells. The controls
of a finite set are listed instead: for each of them drift and cost are constants of such polynomials.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from hjbjax.problem.problem import Problem, is_discounted
from hjbjax.problem.sets import Finite, ranges
from hjbjax.tracing import quadratics as qu
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import Interval, point
from hjbjax.tracing.taylor_forms import Form

T = TypeVar("T", Form, qu.Polynomial)


@dataclasses.dataclass(frozen=True)
class Functions:
    """The functions of a problem over parts of cells.

    Attributes:
      problem: a problem of one player with costs.
      x: the state.
      radii: the largest distance from the centre along every axis.
      rate: the discount.
      unit: the positive number by which a defect is divided: the discount; a lower bound of the running cost if there
        is no discount; one for a tube.
      options: cost and drift as polynomials of the control, or for every action of a finite set; empty if they are not
        quadratic polynomials.
    """

    problem: Problem
    x: list[Form]
    radii: list[np.ndarray]
    rate: Form
    unit: Interval
    options: list[tuple[qu.Polynomial, list[qu.Polynomial]]]


@dataclasses.dataclass(frozen=True)
class Cell:
    """A candidate W over parts of cells.

    Attributes:
      functions: the functions of the problem.
      w: the candidate.
      p: its gradient.
    """

    functions: Functions
    w: Form
    p: list[Form]


def functions_over(problem: Problem, x: list[Form], radii: list[np.ndarray]) -> Functions:
    """The functions of a problem over parts of cells.

    Args:
      problem: a problem with costs.
      x: the state.
      radii: the largest distance from the centre along every axis.

    Raises:
      ValueError: the functions of a game are not quadratic polynomials of the inputs.
    """
    rate, unit = _rate_and_unit(problem, x, radii)
    try:
        choices = map(choices_of, admissible_sets(problem))
        options = [_cost_and_drift(problem, x, inputs) for inputs in itertools.product(*choices)]
    except qu.NotQuadraticError:
        if problem.is_game:
            raise ValueError(NOT_QUADRATIC) from None
        options = []
    return Functions(problem, x, radii, rate, unit, options)


NOT_QUADRATIC = (
    "enclose: got a game whose drift or cost is not a quadratic polynomial of the inputs, or has products of inputs\n"
    "of one player; wanted such a polynomial, or a Finite set for the player that it depends on otherwise"
)


def admissible_sets(problem: Problem) -> list[Any]:
    """The admissible set of every player."""
    return [problem.controls] + [problem.disturbances] * problem.is_game


def choices_of(admissible: Any) -> Sequence[int | np.ndarray]:
    """Every control of a finite set, or one entry for another set: the number of its inputs."""
    if isinstance(admissible, Finite):
        return list(np.asarray(admissible.points, float))
    return [0 if admissible is None else admissible.dim]


def _cost_and_drift(
    problem: Problem, x: list[Form], inputs: Sequence[int | np.ndarray]
) -> tuple[qu.Polynomial, list[qu.Polynomial]]:
    """Cost and drift as polynomials of the inputs; ``inputs`` has the number of inputs, or a listed control, of every
    player.
    """
    if not any(isinstance(each, int) for each in inputs):
        actions = [[tf.constant(number) for number in np.asarray(each)] for each in inputs]
        forms = cost_form(problem, x, *actions), *tf.taylor_forms(problem.drift, x, *actions)
        cost, *drift = (qu.Polynomial({(): each}) for each in forms)
        return cost, drift
    cost = qu.Polynomial({(): tf.constant(0.0)})
    if problem.cost is not None:
        cost = qu.quadratics(problem.cost, x, *inputs)[0]
    return cost, qu.quadratics(problem.drift, x, *inputs)


def _rate_and_unit(problem: Problem, x: list[Form], radii: list[np.ndarray]) -> tuple[Form, Interval]:
    """The discount, and the number by which a defect is divided (see ``Functions``)."""
    (rate,) = tf.taylor_forms(problem.discount, *([x] * callable(problem.discount))).reshape(-1)
    if is_discounted(problem):  # an interval that contains zero makes the defect infinite
        return rate, rate.range
    if problem.target is None:  # a tube, where only the sign of the defect counts
        return rate, point(1.0)
    least = cost_form(problem, x, *any_actions(problem)).bounds(radii).lo
    return rate, point(np.maximum(least, 0.0))


def any_actions(problem: Problem) -> list[list[Form]]:
    """Every input of each player as one interval."""
    return [_any_action(each) for each in admissible_sets(problem)]


def _any_action(admissible: Any) -> list[Form]:
    """Every input of the control as one interval."""
    if admissible is None:
        return []
    inputs = [Interval(np.asarray(lo), np.asarray(hi)) for lo, hi in zip(*ranges(admissible), strict=True)]
    return [Form(each, each) for each in inputs]


def cost_form(problem: Problem, x: list[Form], *inputs: list[Form]) -> Form:
    """The running cost over boxes of states and inputs."""
    return tf.constant(0.0) if problem.cost is None else tf.taylor_forms(problem.cost, x, *inputs).item()


def gain(cost: T, drift: Sequence[T], p: Sequence[Form], without: frozenset[int] = frozenset()) -> T:
    """G = L + f·p, without some components of the drift."""
    for i, (component, slope) in enumerate(zip(drift, p, strict=True)):
        if i not in without:
            cost = cost + component * slope
    return cost
