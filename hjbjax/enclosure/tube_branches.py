"""Values of a tube with one player fixed at a vertex of its set, near which the other side of a kink continues.

Where a player has two equally good actions, V is the least, or the largest, of two functions, and no smooth function
touches its kink from the side that this player guarantees. The value V_i with this player fixed at one action has no
such kink. It is a bound of V, and often the least V_i, or the largest, is V.
"""

import itertools
import warnings
from dataclasses import replace

import numpy as np

from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import Box, Finite
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status
from hjbjax.solvers.finite_horizon import march

MOST = 4  # vertices of a set: each costs one march, and its cells are evaluated
NEAR = 0.9  # fraction of the nodes near the level at which the branches must be near V


def vertices(problem: Problem, side: int) -> list[Box | Finite]:
    """The vertices of the set of the player that guarantees a side, each as a set; empty if they are not used.

    Args:
      problem: the problem.
      side: 0 for the lower side, which the disturbance guarantees, and 1 for the upper one.
    """
    admissible = problem.controls if side else problem.disturbances
    if isinstance(admissible, Finite):
        found: list[Box | Finite] = [Finite(each[None]) for each in np.asarray(admissible.points, float)]
    elif isinstance(admissible, Box):
        ends = zip(np.asarray(admissible.lo, float), np.asarray(admissible.hi, float), strict=True)
        found = [Box(np.array(each), np.array(each)) for each in itertools.product(*(sorted({*pair}) for pair in ends))]
        if not all(np.all(np.isfinite(np.asarray(each.lo))) for each in found if isinstance(each, Box)):
            return []
    else:
        return []
    return found if 1 < len(found) <= MOST else []


def branches(problem: Problem, solution: Solution, side: int, level: float, band: float) -> list[np.ndarray]:
    """The values with the player of a side fixed at a vertex of its set, each (k, *grid); empty if they are far from V.

    Args:
      problem: the problem.
      solution: its solution.
      side: 0 for the lower and 1 for the upper side.
      level: v.
      band: the distance from v in which V counts; a quarter of it is near.
    """
    times, own, found = np.asarray(solution.times, float), np.asarray(solution.value, float)[0], []
    near = np.abs(own - level) <= band
    if not np.any(near):
        return []
    for each in vertices(problem, side):
        question = replace(problem, controls=each) if side else replace(problem, disturbances=each)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of errors of a function that proves nothing by itself
            fixed = march(
                question, solution.grid, float(times[-1]), times=times, policy=False, throw=False, progress=False
            )
        value = np.asarray(fixed.value, float)
        if fixed.status is not Status.CONVERGED or not np.all(np.isfinite(value)):
            return []
        found.append(value)
    if not found:
        return []
    first = [each[0] for each in found]
    best = np.min(first, axis=0) if side else np.max(first, axis=0)
    return found if np.quantile(np.abs(best - own)[near], NEAR) <= band / 4 else []
