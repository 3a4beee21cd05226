"""Extremals whose control jumps: the order of its values by smoothing, the switching times by the arcs themselves.

Mixtures with smaller and smaller ε (see ``boundary_value``) show in which order the values come; then all arcs are
solved at once. Where the final time is free, a smoothed problem need not have a solution: effort is charged that the
true one does not know, and discounted away by waiting. So there the mixtures have given final times, first one that
is long enough to get to the end, then nearer and nearer to the time at which H fits. An arc may come out empty; one
that comes out negative is left out. A start on a switching curve needs an empty arc in front, whose condition fixes
the costate.
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

SMOOTHING = (1.0, 0.3, 0.1, 0.03, 0.01)  # ε over the size of the Hamiltonian, so far that the order of arcs shows
FASTER = 0.3  # the factor of ε on a walk through given final times
BRIDGES = (1.3, 2.5, 4.7, 8.9, 17.0)  # first final times over the guess; a round guess is often the least time itself
STRIDE, WALK = 1.2, 16  # from the first that is long enough, by which factor and how often it is changed
MOST_ARCS = 12  # more switches than that are chattering, or an arc on which the Hamiltonian is singular
SHORT = 1e-3  # share of the time of arcs that are left out when all arcs together find no solution
TRUSTED = 0.02  # share of the time that an arc of an interpolated guess must last: along a kink its costates blur
NODES = 17  # of an arc's first mesh


def switching(
    bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, limits: Limits, *, trusted: bool
) -> Outcome:
    """The extremal of a Hamiltonian whose minimiser jumps, from a guess of one arc.

    Args:
      bvp: the boundary-value problem with the law of the minimum.
      times: increasing from 0.
      columns: the guess at these times, shape (2n+1, len(times)).
      limits: how far to go.
      trusted: whether the costates of the guess are worth to be asked for the order of the arcs.
    """
    mixture = dataclasses.replace(bvp, law=Law.MIXTURE)
    failure = None
    # a trusted guess stands in for a mixture: it has costates, and these have an order of arcs
    known = Outcome(mixture, times / times[-1], columns, unknowns(bvp, times, columns), Status.CONVERGED)
    for blurred in itertools.chain([known] * trusted, _mixtures(mixture, times, columns, limits.rough)):
        # a check of the clock after each stage, since the next one compiles for other shapes and that cannot be cut
        least = TRUSTED if blurred is known else 0.0
        carry_on(blurred, limits)
        found = _with_arcs(bvp, blurred, limits, least) if blurred.solved else blurred
        carry_on(found, limits)
        if found.solved and report(found).status is Status.CONVERGED:
            return found
        # a mixture that was solved and did not sharpen tells more than one that was not
        if failure is None or (blurred.solved and not failure.solved):
            failure = found
    assert failure is not None
    return failure


def _mixtures(bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, rough: Limits) -> Iterator[Outcome]:
    """Smoothed extremals, the likeliest first; a failure where there are no more."""
    # ε has the units of H, cost per time: relative to its size, the same problem in other units has the same mixtures
    size, found = initial_guess.hamiltonian_size(bvp, times, columns), None
    if bvp.free:
        yield from _walk(dataclasses.replace(bvp, epsilon=size), times, columns, rough)
        return
    start = (times / times[-1], columns, unknowns(bvp, times, columns))
    # each from the one before: the smaller ε, the sharper the jumps, and the nearer a guess has to be
    for share in SMOOTHING:
        tried = attempt(dataclasses.replace(bvp, epsilon=share * size), *start, rough)
        if not tried.solved:
            break
        found, start = tried, (tried.s, tried.y, tried.theta)
    yield found or tried


def _walk(bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, rough: Limits) -> Iterator[Outcome]:
    """Mixtures with given final times, from one that is long enough to where H fits a free one."""
    columns = np.concatenate([columns[: bvp.n], 0 * columns[bvp.n :]])  # no costate prefers a control
    for factor in BRIDGES:
        fixed = dataclasses.replace(bvp, free=False, horizon=factor * times[-1])
        found = attempt(fixed, times / times[-1], columns, unknowns(fixed, times, columns), rough)
        if found.solved:
            break
    yield found  # also if it failed, for the caller to report
    stride, least = STRIDE, SMOOTHING[-1] * float(bvp.epsilon)
    for _ in range(WALK * found.solved):
        # the last condition of the problem with a free time: H − βψ + ψ_t + ν l_t, negative where a longer time pays
        last = conditions(bvp, found.y[:, 0], found.y[:, -1], np.append(found.horizon, found.theta))[-1]
        # Where a longer time pays, that is as often the price of smoothing as the truth.
        if last < 0 and found.bvp.epsilon > least:
            nearer = dataclasses.replace(found.bvp, epsilon=FASTER * found.bvp.epsilon)
        else:
            nearer = dataclasses.replace(found.bvp, horizon=found.horizon * (stride if last < 0 else 1 / stride))
        moved = attempt(nearer, found.s, found.y, found.theta, rough)
        if moved.solved:
            found = moved
            yield found
        else:  # too long a step: half of it on a logarithmic scale
            stride = stride**0.5


def _with_arcs(bvp: BoundaryValueProblem, blurred: Outcome, limits: Limits, least: float) -> Outcome:
    """The outcome with one arc for every value, in the order that a mixture shows."""
    # finer than its mesh: a switch is found to half a sample, 1/4000 of the time
    fine = np.linspace(0, 1, 2001)
    y = np.stack([np.interp(fine, blurred.s, row) for row in blurred.y])
    order, starts = initial_guess.arc_order(blurred.bvp, fine * blurred.horizon, y, least)
    carry_on(blurred, limits)
    if len(order) > MOST_ARCS:
        trouble = f"{len(order) - 1} switches: the control chatters, or an arc is singular; this is a smoothed extremal"
        return dataclasses.replace(blurred, code=Status.STALLED, trouble=trouble)
    # every round leaves out at least one arc, so that MOST_ARCS of them are enough
    first = found = _arcs(bvp, blurred, order, starts, limits)
    for _ in range(MOST_ARCS):
        lengths = found.lengths
        kept = lengths > (-EMPTY if found.solved else SHORT) * max(lengths.sum(), 0.0)
        # solved, arcs that came out negative go; unsolved, all short ones, for any of them may stand in the way
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
    """The outcome after an arc of another value that may stay empty; None where none of these is solved."""
    for value in initial_guess.values(blurred.bvp):
        if not np.array_equal(value, order[0], equal_nan=True):
            found = _arcs(bvp, blurred, np.concatenate([value[None], order]), np.append(0.0, starts), limits)
            if found.solved and np.min(found.lengths) > -EMPTY * found.horizon:
                return found
    return None


def _merge_equal_neighbours(order: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Neighbouring arcs of one value made one."""
    # NaN, in inputs that do not jump, equals NaN here
    new = [True] + [not np.array_equal(a, b, equal_nan=True) for a, b in itertools.pairwise(order)]
    return order[new], np.append(0.0, starts[new][1:])


def _arcs(
    bvp: BoundaryValueProblem, blurred: Outcome, order: np.ndarray, starts: np.ndarray, limits: Limits
) -> Outcome:
    """All arcs at once, from a mixture; roughly first, since a failure is cheap on few nodes."""
    bvp = dataclasses.replace(bvp, law=Law.ARCS, arcs=order)
    lengths = np.diff(np.append(starts, blurred.horizon))
    s = np.linspace(0, 1, NODES)
    pieces = [
        [np.interp(begin + s * length, blurred.times, row) for row in blurred.y]
        for begin, length in zip(starts, lengths, strict=True)
    ]
    # ν alone from the mixture; its durations, if any, give way to those of the arcs
    nu = blurred.theta[len(blurred.theta) - (bvp.closing is Closing.TARGET) :]
    theta = np.concatenate([lengths if bvp.timed else [], nu])
    found = attempt(bvp, s, np.concatenate(pieces), theta, limits.rough)
    return attempt(bvp, found.s, found.y, found.theta, limits) if found.solved else found
