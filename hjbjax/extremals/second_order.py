"""Second-order conditions, which detect extremals that are saddle points or maxima.

Let A = ∂(ẋ, ṗ)/∂(x, p) along a path with a continuous control. The neighbouring extremals that meet the end conditions
are the frames (X, P)' = A (X, P), integrated backward from the end. Where X becomes singular they cross, and the path
is not a minimum from earlier times on: this is a conjugate point (Jacobi). W = P X⁻¹ is the Hessian
D²V that the neighbouring extremals define. A backward step (a, b; c, d) of the midpoint rule is symplectic and maps W
to (c + dW)(a + bW)⁻¹. It passes one conjugate point per negative eigenvalue of I + a⁻¹bW, where a⁻¹b is B H_uu⁻¹ B'
times the step and semidefinite.

With a free final time, the cost J(T) of the extremals with prescribed T is stationary. Its second derivative is the
slope of the free-time condition along them, from the linearised equations. If it is negative, T is a maximum of J.
"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing, Law
from hjbjax.extremals.collocation import on_mesh, slopes_at_ends

SINGULAR = 1e-6  # relative singular value of X below which W = P X⁻¹ would have no correct digits
FLAT, STEEP = 1e-4, 1e4  # for T J'' relative to the terms of H: less is rounding, more means that T cannot change


def verdict(bvp: BoundaryValueProblem, s: np.ndarray, y: np.ndarray, theta: np.ndarray, scale: float) -> str:
    """The reason why the extremal is not a minimum; empty if none is found, or if the control jumps.

    Args:
      bvp: the boundary-value problem.
      s: the mesh of its solution.
      y: (x, p, w) on the mesh.
      theta: the final time, if it is free, and ν.
      scale: the size of the terms of H, in cost units per unit time.
    """
    if bvp.law is not Law.MINIMUM or bvp.rule.jumps or bvp.count > 1:
        return ""
    arrays = jax.tree.map(jnp.asarray, bvp)
    kept = np.append(True, np.diff(s) > 0)  # a crowded mesh may repeat a node
    both = slice(2 * bvp.n)  # the rows of x and p; no rate depends on the cost to go except its own
    _, by_state, by_theta = on_mesh(arrays, s, y, theta)
    matrices = np.moveaxis(by_state[both, both], -1, 0)[kept]
    _, by_last, ends_by_theta = slopes_at_ends(arrays, y, theta)
    closing, sliding = by_last[bvp.n :, both], ends_by_theta[bvp.n :]
    if not all(np.all(np.isfinite(part)) for part in (matrices, by_theta, closing, sliding)):
        return ""
    # neighbours have the same final time, so the conditions on the cost to go and on a free time do not restrict them
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
    """The last s in (0, 1) at which neighbours cross; None if they do not cross or if it is undecided.

    Args:
      matrices: ∂(ẋ, ṗ)/∂(x, p) at the nodes, per unit of s, shape (N, 2n, 2n).
      s: the nodes, increasing.
      end: the rows of the end conditions in (δx, δp), and δν if there is a target.
    """
    identity, n = np.eye(matrices.shape[1]), matrices.shape[1] // 2
    half = 0.25 * np.diff(s)[:, None, None] * (matrices[1:] + matrices[:-1])
    back = np.linalg.solve(identity + half, identity - half)
    # the n directions that the end conditions leave free
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
        # prescribed end states give δx = 0 at first, and states that no control reaches always have δx = 0
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
    """The derivative with respect to T of the free-time condition, while the other conditions hold.

    Args:
      matrices: ∂(ẋ, ṗ)/∂(x, p) at the nodes, per unit of s, shape (N, 2n, 2n).
      driven: ∂(ẋ, ṗ)/∂T at the nodes, shape (N, 2n).
      s: the nodes, increasing.
      closing: slopes of the end conditions with respect to (x, p), shape (k, 2n).
      sliding: slopes of the end conditions with respect to T, and ν if there is a target, shape (k, 1 or 2).
      rows: the end conditions that determine (x, p) and ν.
    """
    from scipy import sparse
    from scipy.sparse.linalg import MatrixRankWarning, spsolve

    count, m = matrices.shape[:2]
    half, identity = 0.5 * np.diff(s)[:, None, None], np.eye(m)
    # trapezoidal rule: −(I + ½hA) δz_k + (I − ½hA) δz_{k+1} = ½h (b_k + b_{k+1}) δT
    left, right = -identity - half * matrices[:-1], identity - half * matrices[1:]
    blocks = [sparse.block_diag([sparse.coo_matrix(each) for each in side]) for side in (left, right)]
    empty = sparse.csr_matrix(((count - 1) * m, m))
    steps = sparse.hstack([blocks[0], empty]) + sparse.hstack([empty, blocks[1]])
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
        warnings.simplefilter("ignore", MatrixRankWarning)  # the slope is then infinite: no other T has an extremal
        answer = spsolve(system, load)
    last = answer[(count - 1) * m : count * m]
    return float(closing[-1] @ last + sliding[-1, 0] + sliding[-1, 1:] @ answer[count * m :])
