"""Extremals whose control jumps: smoothing finds the order of the values, then the switching times are solved for.

Mixtures with decreasing ε (see ``boundary_value``) show the order of the values. Then all arcs are solved at once.
With a free final time a smoothed problem need not have a solution, because smoothing adds a cost that waiting can
discount away. In this case the mixtures have prescribed final times: first one that is long enough to reach the end,
then times closer and closer to the one at which the condition on H holds. An arc may be empty, and an arc with a
negative duration is removed. A start on a switching curve needs an empty first arc, whose condition determines the
costate.
"""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np

from hjbjax.extremals import initial_guess
from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing, Law, Limits, conditions
from hjbjax.extremals.continuation import Outcome, attempt, carry_on, report, unknowns
from hjbjax.extremals.necessary_conditions import EMPTY
from hjbjax.solution.status import Status

SMOOTHING = (1.0, 0.3, 0.1, 0.03, 0.01)  # ε relative to the size of H; the last one shows the order of the arcs
FASTER = 0.3  # factor of ε in the search over prescribed final times
BRIDGES = (1.3, 2.5, 4.7, 8.9, 17.0)  # initial final times over the guess; not 1, which may be the least time itself
STRIDE, WALK = 1.2, 16  # factor and number of the changes of the final time after the initial one
MOST_ARCS = 12  # more arcs mean that the control chatters, or that an arc is singular
SHORT = 1e-3  # fraction of the time: shorter arcs are removed if the arcs together have no solution
TRUSTED = 0.02  # fraction of the time: shorter arcs of an interpolated guess come from blurred costates at a kink
NODES = 17  # initial number of mesh nodes per arc


def switching(
    bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, limits: Limits, *, trusted: bool
) -> Outcome:
    """Solve for the extremal of a Hamiltonian whose minimiser jumps, from a guess with one arc.

    Args:
      bvp: the boundary-value problem with the law of the minimum.
      times: increasing from 0.
      columns: the guess at these times, shape (2n+1, len(times)).
      limits: the limits of the solve.
      trusted: True if the costates of the guess are good enough to show the order of the arcs.
    """
    mixture = dataclasses.replace(bvp, law=Law.MIXTURE)
    failure = None
    # the costates of a trusted guess show an order of arcs, so the guess can replace a mixture
    known = Outcome(mixture, times / times[-1], columns, unknowns(bvp, times, columns), Status.CONVERGED)
    for blurred in itertools.chain([known] * trusted, _mixtures(mixture, times, columns, limits.rough)):
        # check the clock after each stage, because the next one compiles and compilation cannot be interrupted
        least = TRUSTED if blurred is known else 0.0
        carry_on(blurred, limits)
        found = _with_arcs(bvp, blurred, limits, least) if blurred.solved else blurred
        carry_on(found, limits)
        if found.solved and report(found).status is Status.CONVERGED:
            return found
        # report a solved mixture whose arcs failed rather than a mixture that was not solved
        if failure is None or (blurred.solved and not failure.solved):
            failure = found
    assert failure is not None
    return failure


def _mixtures(bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, rough: Limits) -> Iterator[Outcome]:
    """Smoothed extremals, the most promising first; the last one may be a failure."""
    # ε has the units of H, so it is relative to the size of H and does not depend on the units of the problem
    size, found = initial_guess.hamiltonian_size(bvp, times, columns), None
    if bvp.free:
        yield from _walk(dataclasses.replace(bvp, epsilon=size), times, columns, rough)
        return
    start = (times / times[-1], columns, unknowns(bvp, times, columns))
    # start each solve from the one before: the smaller ε, the sharper the jumps and the better the guess must be
    for share in SMOOTHING:
        tried = attempt(dataclasses.replace(bvp, epsilon=share * size), *start, rough)
        if not tried.solved:
            break
        found, start = tried, (tried.s, tried.y, tried.theta)
    yield found or tried


def _walk(bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, rough: Limits) -> Iterator[Outcome]:
    """Mixtures with prescribed final times, from one that is long enough towards the free final time."""
    columns = np.concatenate([columns[: bvp.n], 0 * columns[bvp.n :]])  # zero costates do not prefer any control
    for factor in BRIDGES:
        fixed = dataclasses.replace(bvp, free=False, horizon=factor * times[-1])
        found = attempt(fixed, times / times[-1], columns, unknowns(fixed, times, columns), rough)
        if found.solved:
            break
    yield found  # also after a failure, so that the caller can report it
    stride, least = STRIDE, SMOOTHING[-1] * float(bvp.epsilon)
    for _ in range(WALK * found.solved):
        # the condition of a free final time, H − βψ + ψ_t + ν l_t; negative if a longer time reduces the cost
        last = conditions(bvp, found.y[:, 0], found.y[:, -1], np.append(found.horizon, found.theta))[-1]
        # a longer time may reduce only the cost of smoothing, so reduce ε first
        if last < 0 and found.bvp.epsilon > least:
            nearer = dataclasses.replace(found.bvp, epsilon=FASTER * found.bvp.epsilon)
        else:
            nearer = dataclasses.replace(found.bvp, horizon=found.horizon * (stride if last < 0 else 1 / stride))
        moved = attempt(nearer, found.s, found.y, found.theta, rough)
        if moved.solved:
            found = moved
            yield found
        else:  # the step was too long: halve it on a logarithmic scale
            stride = stride**0.5


def _with_arcs(bvp: BoundaryValueProblem, blurred: Outcome, limits: Limits, least: float) -> Outcome:
    """The outcome with one arc per value, in the order that a mixture shows."""
    # finer than the mesh, so a switch is located to half a sample, 1/4000 of the time
    fine = np.linspace(0, 1, 2001)
    y = np.stack([np.interp(fine, blurred.s, row) for row in blurred.y])
    order, starts = initial_guess.arc_order(blurred.bvp, fine * blurred.horizon, y, least)
    carry_on(blurred, limits)
    if len(order) > MOST_ARCS:
        trouble = f"{len(order) - 1} switches: the control chatters or an arc is singular; this is a smoothed extremal"
        return dataclasses.replace(blurred, code=Status.STALLED, trouble=trouble)
    # every round removes at least one arc, so MOST_ARCS rounds are enough
    first = found = _arcs(bvp, blurred, order, starts, limits)
    for _ in range(MOST_ARCS):
        lengths = found.lengths
        kept = lengths > (-EMPTY if found.solved else SHORT) * max(lengths.sum(), 0.0)
        # if solved, remove arcs with negative durations; otherwise remove all short arcs, any of which may be the cause
        if kept.all() or not kept.any():
            break
        order, starts = _merge_equal_neighbours(order[kept], (np.cumsum(lengths) - lengths)[kept])
        found = _arcs(bvp, blurred, order, starts, limits)
    if not found.solved:
        found = _with_an_empty_arc(bvp, blurred, order, starts, limits) or first
    if found.solved:
        return found
    count = len(first.bvp.arcs)
    return dataclasses.replace(found, trouble=f"with {count} arc{'s' * (count > 1)}, {found.trouble}")


def _with_an_empty_arc(
    bvp: BoundaryValueProblem, blurred: Outcome, order: np.ndarray, starts: np.ndarray, limits: Limits
) -> Outcome | None:
    """The outcome with an additional first arc that may be empty; None if no value of this arc gives a solution."""
    for value in initial_guess.switching_values(blurred.bvp):
        if not np.array_equal(value, order[0], equal_nan=True):
            found = _arcs(bvp, blurred, np.concatenate([value[None], order]), np.append(0.0, starts), limits)
            if found.solved and np.min(found.lengths) > -EMPTY * found.horizon:
                return found
    return None


def _merge_equal_neighbours(order: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge neighbouring arcs of the same value."""
    # inputs that do not jump are NaN here, and NaN equals NaN
    new = [True] + [not np.array_equal(a, b, equal_nan=True) for a, b in itertools.pairwise(order)]
    return order[new], np.append(0.0, starts[new][1:])


def _arcs(
    bvp: BoundaryValueProblem, blurred: Outcome, order: np.ndarray, starts: np.ndarray, limits: Limits
) -> Outcome:
    """Solve for all arcs at once, from a mixture; first with rough limits, so that failures are cheap."""
    bvp = dataclasses.replace(bvp, law=Law.ARCS, arcs=order)
    lengths = np.diff(np.append(starts, blurred.horizon))
    s = np.linspace(0, 1, NODES)
    pieces = [
        [np.interp(begin + s * length, blurred.times, row) for row in blurred.y]
        for begin, length in zip(starts, lengths, strict=True)
    ]
    # keep only ν of the mixture; its durations are replaced by the durations of the arcs
    nu = blurred.theta[len(blurred.theta) - (bvp.closing is Closing.TARGET) :]
    theta = np.concatenate([lengths if bvp.timed else [], nu])
    found = attempt(bvp, s, np.concatenate(pieces), theta, limits.rough)
    return attempt(bvp, found.s, found.y, found.theta, limits) if found.solved else found
