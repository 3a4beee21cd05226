"""Second-order conditions: an extremal that meets all of the first order may still be a saddle, or the worst of all.

With A = ∂(ẋ, ṗ)/∂(x, p) along a path whose control is continuous, the neighbours that meet the end conditions are the
frames (X, P)' = A (X, P), run backward from the end. Where X is singular on the way they cross, and from earlier on the
path is no minimum: a conjugate point (Jacobi). With W = P X⁻¹, the D²V of the neighbours, one step of the midpoint rule
backward, (a, b; c, d), which is symplectic, is W ← (c + dW)(a + bW)⁻¹, and passes as many conjugate points as I + a⁻¹bW
has negative eigenvalues: a⁻¹b is B H_uu⁻¹ B' times the step, and semidefinite.

Where the final time is free, J(T) of the extremals with given T is stationary, and its second derivative is the slope
of that condition along them, which the linearised equations have. Where J falls on either side, T is the worst.
"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing, Law
from hjbjax.extremals.collocation import at_ends, on_mesh

SINGULAR = 1e-6  # share of X's largest singular value below which W = P X⁻¹ would have lost its digits
FLAT, STEEP = 1e-4, 1e4  # T² J'' over T times H's terms: less is rounding, more a T that the others do not allow


def verdict(bvp: BoundaryValueProblem, s: np.ndarray, y: np.ndarray, theta: np.ndarray, scale: float) -> str:
    """Why the extremal is no minimum, in words; empty where nothing says so, and where the control jumps.

    Args:
      bvp: the boundary-value problem.
      s: the mesh of its solution.
      y: (x, p, w) on it.
      theta: the final time, if it is sought, and ν.
      scale: the size of the terms of H, in cost units per unit time.
    """
    if bvp.law is not Law.MINIMUM or bvp.rule.jumps or bvp.count > 1:
        return ""
    arrays = jax.tree.map(jnp.asarray, bvp)
    kept = np.append(True, np.diff(s) > 0)  # a mesh that crowds may repeat a node
    both = slice(2 * bvp.n)  # the cost to go drives nothing
    _, by_state, by_theta = on_mesh(arrays, s, y, theta)
    matrices = np.moveaxis(by_state[both, both], -1, 0)[kept]
    _, by_last, ends_by_theta = at_ends(arrays, y, theta)
    closing, sliding = by_last[bvp.n :, both], ends_by_theta[bvp.n :]
    if not all(np.all(np.isfinite(part)) for part in (matrices, by_theta, closing, sliding)):
        return ""
    # the rows of the cost to go, and of a free time, say nothing of the neighbours that end in the same time
    rows = [*range(bvp.n)] + [bvp.n + 1] * (bvp.closing is Closing.TARGET)
    multiplier = sliding[rows, -1:] if bvp.closing is Closing.TARGET else np.zeros((len(rows), 0))
    horizon = float(np.sum(bvp.durations(theta)))
    where = _conjugate_point(matrices, s[kept], np.concatenate([closing[rows], multiplier], 1))
    if where is not None:
        return f"an extremal, not a minimum: t = {where * horizon:.4g} is conjugate to the end; give another guess"
    if not bvp.free:
        return ""
    driven = by_theta[both, 0].T[kept]
    slope = _slope_in_time(matrices, driven, s[kept], closing, sliding, rows)
    if -STEEP * scale < slope * horizon < -FLAT * scale:
        return (
            f"an extremal, not a minimum: the cost as a function of the final time is largest at T = {horizon:.4g} "
            f"(its second derivative is {slope:.3g}); give another guess"
        )
    return ""


def _conjugate_point(matrices: np.ndarray, s: np.ndarray, end: np.ndarray) -> float | None:
    """The last s in (0, 1) at which neighbours cross; None without, or where it stays undecided.

    Args:
      matrices: ∂(ẋ, ṗ)/∂(x, p) at the nodes, per unit of s, shape (N, 2n, 2n).
      s: the nodes, increasing.
      end: the rows of the end conditions, in (δx, δp) and perhaps δν.
    """
    identity, n = np.eye(matrices.shape[1]), matrices.shape[1] // 2
    half = 0.25 * np.diff(s)[:, None, None] * (matrices[1:] + matrices[:-1])
    back = np.linalg.solve(identity + half, identity - half)
    # what the conditions leave: n directions
    frame, curvature = np.linalg.svd(end)[2][len(end) :].T[: 2 * n], None
    for k in range(len(back), -1, -1):
        if k < len(back):
            a, b, c, d = back[k][:n, :n], back[k][:n, n:], back[k][n:, :n], back[k][n:, n:]
            if curvature is not None:
                if np.min(np.linalg.eigvals(np.eye(n) + np.linalg.solve(a, b) @ curvature).real) < 0:
                    return float(s[k])
                frame = np.concatenate([a + b @ curvature, c + d @ curvature])
            else:
                frame = np.linalg.qr(back[k] @ frame)[0]
        # given end states leave no δx at first, and states that no control reaches never have any
        sizes = np.linalg.svd(frame[:n], compute_uv=False)
        if curvature is not None or sizes[-1] > SINGULAR * np.linalg.norm(frame, 2):
            curvature = np.linalg.solve(frame[:n].T, frame[n:].T)
            curvature = 0.5 * (curvature + curvature.T)
    return None


def _slope_in_time(
    matrices: np.ndarray,
    driven: np.ndarray,
    s: np.ndarray,
    closing: np.ndarray,
    sliding: np.ndarray,
    rows: list[int],
) -> float:
    """The derivative in T of the last condition, that of a free time, while the others hold.

    Args:
      matrices: ∂(ẋ, ṗ)/∂(x, p) at the nodes, per unit of s, shape (N, 2n, 2n).
      driven: ∂(ẋ, ṗ)/∂T there, shape (N, 2n).
      s: the nodes, increasing.
      closing: slopes of the end conditions in (x, p), shape (k, 2n).
      sliding: slopes of the end conditions in T and perhaps ν, shape (k, 1 or 2).
      rows: the end conditions that determine (x, p) and ν.
    """
    from scipy import sparse
    from scipy.sparse.linalg import MatrixRankWarning, spsolve

    count, m = matrices.shape[:2]
    half, identity = 0.5 * np.diff(s)[:, None, None], np.eye(m)
    # the trapezoidal rule: −(I + ½hA) δz_k + (I − ½hA) δz_{k+1} = ½h (b_k + b_{k+1}) δT
    left, right = -identity - half * matrices[:-1], identity - half * matrices[1:]
    steps = sparse.hstack([sparse.block_diag(left), sparse.csr_matrix(((count - 1) * m, m))])
    steps = steps + sparse.hstack([sparse.csr_matrix(((count - 1) * m, m)), sparse.block_diag(right)])
    begin = sparse.csr_matrix(identity[: m // 2])
    ends = [sparse.csr_matrix(closing[rows]), sparse.csr_matrix(sliding[rows, 1:])]
    nothing = sliding.shape[1] - 1
    system = sparse.vstack(
        [
            sparse.hstack([begin, sparse.csr_matrix((m // 2, (count - 1) * m + nothing))]),
            sparse.hstack([steps, sparse.csr_matrix(((count - 1) * m, nothing))]),
            sparse.hstack([sparse.csr_matrix((len(rows), (count - 1) * m)), *ends]),
        ]
    ).tocsc()
    load = np.concatenate([np.zeros(m // 2), (half[:, 0] * (driven[1:] + driven[:-1])).ravel(), -sliding[rows, 0]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MatrixRankWarning)  # infinite then, as where no other T has an extremal
        answer = spsolve(system, load)
    last = answer[(count - 1) * m : count * m]
    return float(closing[-1] @ last + sliding[-1, 0] + sliding[-1, 1:] @ answer[count * m :])
