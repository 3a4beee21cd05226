"""Where a Markov chain stays for ever, and how often it is where.

A recurrent class is a set of states that lead to one another and to nothing else; a finite chain has at least one, and
a single stationary law μ exactly if it has one only. On that class, with μ_k = 1 at one of its states, the others solve

    (−𝓛*) μ = (rates from k)        without the row and the column k,

an M-matrix that is diagonally dominant by columns, so that elimination along the diagonal is stable and subtracts
nothing. Rounding moves μ by at most eps (−𝓛*)⁻¹ |𝓛*| μ, entry by entry to first order, which one more solve
tells. Where that is much, the class hangs together by rates that are hardly more than rounding: to the computer it is
several. Cost: one or two sparse LU factorisations, as of a stationary solve on the same grid.
"""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csc_array, csr_array

ROUNDINGS = 8  # units of eps in an entry of the matrix: a rate is made of so many operations
LARGEST_ERROR = 1e-6  # in total variation, of what rounding does to a law
NEAR_PEAK = 1e3  # a law larger than this at another state than k is solved for again from there
PASSES = 8  # changes of the pinned state, at most: each goes to the peak of the last law


def classes(generator: "csr_array") -> list[np.ndarray]:
    """The recurrent classes of a chain, each the numbers of its states; host level.

    Args:
      generator: a SciPy sparse array of shape (S, S), rates off the diagonal.
    """
    from scipy.sparse.csgraph import connected_components

    # states that lead to one another are the strong components of the graph of jumps
    count, label = connected_components(generator, directed=True, connection="strong")
    entries = generator.tocoo()
    # an entry that is stored although it is zero leads nowhere
    leads_out = (label[entries.row] != label[entries.col]) & (entries.data != 0)
    closed = np.ones(count, bool)
    closed[label[entries.row[leads_out]]] = False
    return [np.flatnonzero(label == which) for which in np.flatnonzero(closed)]


def law(generator: "csr_array", states: np.ndarray) -> tuple[np.ndarray, float]:
    """The stationary probabilities of one recurrent class, and the bound on their error by rounding.

    Args:
      generator: a SciPy sparse array of shape (S, S), per unit time; its rows sum to zero.
      states: the numbers of the states of the class.

    Returns:
      Probabilities, shape (S,), and the bound on their error by rounding in total variation; inf if there is none.
    """
    probabilities = np.zeros(generator.shape[0])
    if len(states) == 1:  # absorbing: nothing to solve, and no rate to divide by
        probabilities[states] = 1.0
        return probabilities, 0.0
    # −𝓛* on the class: columns sum to zero, since nothing leads out of it
    outflow = -generator.tocsr()[states][:, states].T.tocsc()
    found, error = np.zeros(len(states)), np.inf
    # a state in the middle of the box to begin with, which is seldom where the law vanishes: with μ_k = 1 at a state
    # that is hardly ever visited the others overflow
    pinned = len(states) // 2
    for _ in range(PASSES):
        found, error = _from(outflow, pinned)
        peak = int(np.argmax(np.where(np.isfinite(found), found, np.inf)))
        if np.all(np.isfinite(found)) and found[peak] <= NEAR_PEAK:
            break
        pinned = peak
    total = found.sum()
    if not (np.isfinite(total) and error < np.inf):
        return probabilities, np.inf
    probabilities[states] = np.maximum(found, 0) / total  # no probability below zero, not even by rounding
    return probabilities, error / total


def _from(outflow: "csc_array", pinned: int) -> tuple[np.ndarray, float]:
    """μ with μ = 1 at ``pinned``, and the bound on the sum of its errors by rounding."""
    from scipy.sparse.linalg import splu

    rest = np.delete(np.arange(outflow.shape[0]), pinned)
    matrix, source = outflow[rest][:, rest], -outflow[rest][:, [pinned]].toarray().ravel()
    measure = np.ones(outflow.shape[0])
    try:
        factors = splu(
            matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )  # no pivoting: what is eliminated along the diagonal is added up, not subtracted
    except RuntimeError:  # exactly singular
        return measure, np.inf
    # over: the peak may be larger than what floats hold; ``law`` then pins it there
    with np.errstate(over="ignore", invalid="ignore"):
        measure[rest] = factors.solve(source)
        size = abs(matrix) @ np.abs(measure[rest]) + source
        # the residual that rounding leaves is at most eps |𝓛*| μ, entry by entry; the inverse of an M-matrix is
        # not negative, so that one solve with its size bounds what comes of it
        error = np.abs(factors.solve(ROUNDINGS * np.finfo(np.float64).eps * size)).sum()
    return measure, float(error) if np.isfinite(error) else np.inf
