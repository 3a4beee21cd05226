"""Recurrent classes of a Markov chain and their stationary distributions.

A recurrent class is a set of states that lead to one another and nowhere else. A finite chain has at least one. Its
stationary law μ is unique if and only if it has only one recurrent class. On that class, with μ_k = 1 at one state k,
the other entries solve

    (−𝓛*) μ = (rates from k)        without the row and the column k,

an M-matrix that is diagonally dominant by columns, so elimination along the diagonal is stable and free of
cancellation. Rounding changes each entry of μ, to first order, by at most eps (−𝓛*)⁻¹ |𝓛*| μ, which one more solve
evaluates. If this is large, the class is connected by rates hardly larger than rounding, and numerically there are
several classes. The cost is one or two sparse LU factorisations, as for a stationary solve on the same grid.
"""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csc_array, csr_array

ROUNDINGS = 8  # units of eps in an entry of the matrix, from the number of operations that compute a rate
LARGEST_ERROR = 1e-6  # largest error of a law by rounding, in total variation
NEAR_PEAK = 1e3  # if the law exceeds this at another state than k, it is computed again with that state pinned
PASSES = 8  # largest number of changes of the pinned state, each to the peak of the last law


def classes(generator: "csr_array") -> list[np.ndarray]:
    """The recurrent classes of a chain, each as the indices of its states; host level.

    Args:
      generator: a SciPy sparse array of shape (S, S), rates off the diagonal.
    """
    from scipy.sparse.csgraph import connected_components

    # states that lead to one another are the strong components of the graph of jumps
    count, label = connected_components(generator, directed=True, connection="strong")
    entries = generator.tocoo()
    # ignore entries that are stored but zero
    leads_out = (label[entries.row] != label[entries.col]) & (entries.data != 0)
    closed = np.ones(count, bool)
    closed[label[entries.row[leads_out]]] = False
    return [np.flatnonzero(label == which) for which in np.flatnonzero(closed)]


def law(generator: "csr_array", states: np.ndarray) -> tuple[np.ndarray, float]:
    """The stationary probabilities of one recurrent class, with a bound on their rounding error.

    Args:
      generator: a SciPy sparse array of shape (S, S), per unit time; its rows sum to zero.
      states: the indices of the states of the class.

    Returns:
      Probabilities, shape (S,), and the bound on their rounding error in total variation; inf if there is none.
    """
    probabilities = np.zeros(generator.shape[0])
    if len(states) == 1:  # an absorbing state: nothing to solve, and no rate to divide by
        probabilities[states] = 1.0
        return probabilities, 0.0
    # −𝓛* on the class: columns sum to zero, since nothing leaves the class
    outflow = -generator.tocsr()[states][:, states].T.tocsc()
    found, error = np.zeros(len(states)), np.inf
    # start with a state in the middle of the box, where the law seldom vanishes; with μ_k = 1 at a state that is hardly
    # ever visited the other entries overflow
    pinned = len(states) // 2
    for _ in range(PASSES):
        found, error = _from(outflow, pinned)
        # seen from a state that is hardly ever visited, rounding may give the largest entries the wrong sign
        sizes = np.where(np.isfinite(found), np.abs(found), np.inf)
        peak = int(np.argmax(sizes))
        if sizes[peak] <= NEAR_PEAK:
            break
        pinned = peak
    total = found.sum()
    if not (0 < total < np.inf and error < np.inf):
        return probabilities, np.inf
    probabilities[states] = np.maximum(found, 0) / total  # rounding must not make a probability negative
    return probabilities, error / total


def deviation(generator: "csr_array", right: np.ndarray, law: np.ndarray, *, transposed: bool) -> np.ndarray:
    """Solve (Λ μ 1ᵀ − 𝓛*) δ = r, or the transposed system, with Λ the fastest rate; NaN if it is singular.

    With the law μ of the only recurrent class the matrix is regular. The rank-one term is eliminated: 𝓛*μ = 0 and
    1ᵀ𝓛* = 0, so Σ δ = Σ r/Λ, and −𝓛*δ = r − μ Σ r without the row and the column of the peak of μ.

    Args:
      generator: a SciPy sparse array of shape (S, S), per unit time.
      right: r, shape (S,).
      law: μ, shape (S,).
      transposed: solve (Λ 1 μᵀ − 𝓛) y = r instead.
    """
    from scipy.sparse.linalg import splu

    if not (np.all(np.isfinite(law)) and np.all(np.isfinite(right))):
        return np.full(right.shape, np.nan)
    peak, fastest = int(np.argmax(law)), -generator.diagonal().min() or 1.0
    rest = np.delete(np.arange(law.size), peak)
    if not rest.size:
        return right / fastest
    matrix = -generator.tocsr()[rest][:, rest].T.tocsc()
    total = law @ right if transposed else right.sum()
    found = np.zeros(law.size)
    left = right - (total if transposed else total * law)
    try:
        found[rest] = splu(matrix).solve(left[rest], "T" if transposed else "N")
    except RuntimeError:  # exactly singular
        return np.full(right.shape, np.nan)
    if transposed:
        return found + (total / fastest - law @ found)
    return found + (total / fastest - found.sum()) * law


def _from(outflow: "csc_array", pinned: int) -> tuple[np.ndarray, float]:
    """μ with μ = 1 at ``pinned``, and the bound on the sum of its rounding errors."""
    from scipy.sparse.linalg import splu

    rest = np.delete(np.arange(outflow.shape[0]), pinned)
    matrix, source = outflow[rest][:, rest], -outflow[rest][:, [pinned]].toarray().ravel()
    measure = np.ones(outflow.shape[0])
    try:
        factors = splu(
            matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )  # no pivoting: elimination along the diagonal only adds
    except RuntimeError:  # exactly singular
        return measure, np.inf
    # the peak may exceed the range of floats; ``law`` then pins the peak
    with np.errstate(over="ignore", invalid="ignore"):
        measure[rest] = factors.solve(source)
        size = abs(matrix) @ np.abs(measure[rest]) + source
        # the residual left by rounding is at most eps |𝓛*| μ, entry by entry; the inverse of an M-matrix is
        # non-negative, so one solve with this size as the right-hand side bounds the error
        error = np.abs(factors.solve(ROUNDINGS * np.finfo(np.float64).eps * size)).sum()
    return measure, float(error) if np.isfinite(error) else np.inf
