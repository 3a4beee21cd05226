"""A hand-written competitor: an expert's numba solver for one problem.

Pendulum θ̈ = g sin θ + u on [−π, π) × [−8, 8] (angle periodic), cost (θ² + ω² + u²)/2, discount beta, K equally
spaced controls in [−30, 30], first-order Kushner–Dupuis upwinding, projection at |ω| = 8.

    jacobi_sweep(V, W, controls, beta, pace)  one Bellman sweep on all threads, float32, given max_u |f|/h + beta
    solve(N, K, beta, tol)                    nested grids and Gauss–Seidel modified policy iteration, float64, one
                                              thread; stops when max |residual| / beta < tol; V has shape (N, N + 1)

Needs numba (pip install '.[bench]'). Run: python -m benchmarks.peers.numba_pendulum 200 400 800
"""

import math
import sys
import time

import numba as nb
import numpy as np

GRAVITY, UMAX, WMAX = 9.81, 30.0, 8.0


@nb.njit(parallel=True, fastmath=True)
def jacobi_sweep(V, W, controls, beta, pace):
    n0, n1 = V.shape
    h0 = np.float32(2 * np.pi / n0)
    h1 = np.float32(2 * WMAX / (n1 - 1))
    r0 = np.float32(1) / h0
    r1 = np.float32(1) / h1
    rho = np.float32(beta)
    for i in nb.prange(n0):
        ip = (i + 1) % n0
        im = (i - 1) % n0
        x0 = np.float32(-np.pi) + h0 * np.float32(i)
        s = np.float32(GRAVITY * math.sin(x0))
        for j in range(n1):
            x1 = np.float32(-WMAX) + h1 * np.float32(j)
            v = V[i, j]
            dp = (V[i, min(j + 1, n1 - 1)] - v) * r1
            dm = (v - V[i, max(j - 1, 0)]) * r1
            slope = (V[ip, j] - v) * r0 if x1 > 0 else (v - V[im, j]) * r0
            base = np.float32(0.5) * (x0 * x0 + x1 * x1) + x1 * slope
            best = np.float32(1e30)
            for k in range(controls.size):
                u = controls[k]
                f = s + u
                best = min(best, np.float32(0.5) * u * u + max(f, np.float32(0)) * dp + min(f, np.float32(0)) * dm)
            W[i, j] = v + (best + base - rho * v) / pace[i, j]


@nb.njit(fastmath=True)
def _evaluate(V, policy, beta, si, sj):
    n0, n1 = V.shape
    h0 = 2 * np.pi / n0
    h1 = 2 * WMAX / (n1 - 1)
    for a in range(n0):
        i = a if si > 0 else n0 - 1 - a
        ip = (i + 1) % n0
        im = (i - 1) % n0
        x0 = -np.pi + h0 * i
        s = GRAVITY * math.sin(x0)
        for b in range(n1):
            j = b if sj > 0 else n1 - 1 - b
            x1 = -WMAX + h1 * j
            u = policy[i, j]
            f = s + u
            if (j == 0 and f < 0) or (j == n1 - 1 and f > 0):
                f = 0.0
            r0 = abs(x1) / h0
            r1 = abs(f) / h1
            v0 = V[ip, j] if x1 > 0 else V[im, j]
            v1 = V[i, min(j + 1, n1 - 1)] if f > 0 else V[i, max(j - 1, 0)]
            V[i, j] = (r0 * v0 + r1 * v1 + 0.5 * (x0 * x0 + x1 * x1 + u * u)) / (r0 + r1 + beta)


@nb.njit(fastmath=True)
def _improve(V, policy, controls, beta):
    n0, n1 = V.shape
    h0 = 2 * np.pi / n0
    h1 = 2 * WMAX / (n1 - 1)
    worst = 0.0
    for i in range(n0):
        ip = (i + 1) % n0
        im = (i - 1) % n0
        x0 = -np.pi + h0 * i
        s = GRAVITY * math.sin(x0)
        for j in range(n1):
            x1 = -WMAX + h1 * j
            v = V[i, j]
            base = 0.5 * (x0 * x0 + x1 * x1) - beta * v + abs(x1) / h0 * ((V[ip, j] if x1 > 0 else V[im, j]) - v)
            best = 1e30
            for k in range(controls.size):
                u = controls[k]
                f = s + u
                if (j == 0 and f < 0) or (j == n1 - 1 and f > 0):
                    f = 0.0
                c = (
                    base
                    + 0.5 * u * u
                    + abs(f) / h1 * ((V[i, min(j + 1, n1 - 1)] if f > 0 else V[i, max(j - 1, 0)]) - v)
                )
                if c < best:
                    best = c
                    policy[i, j] = u
            worst = max(worst, abs(best))
    return worst


def _prolong(V):
    n = V.shape[0]
    wrapped = np.concatenate([V, V[:1]], 0)
    rows = np.zeros((2 * n + 1, n + 1))
    rows[::2] = wrapped
    rows[1::2] = 0.5 * (wrapped[1:] + wrapped[:-1])
    out = np.zeros((2 * n + 1, 2 * n + 1))
    out[:, ::2] = rows
    out[:, 1::2] = 0.5 * (rows[:, 1:] + rows[:, :-1])
    return out[:-1].copy()


def solve(N, K=21, beta=0.1, tol=1e-3, sweeps=3):  # with 5 sweeps it is 4 to 18 % slower
    levels = [N]
    while levels[0] % 2 == 0 and levels[0] > 50:
        levels.insert(0, levels[0] // 2)
    controls = np.linspace(-UMAX, UMAX, K)
    V = np.zeros((levels[0], levels[0] + 1))
    updates = []
    for n in levels:
        if n != levels[0]:
            V = _prolong(V)
        policy = np.zeros_like(V)
        count = 0
        while _improve(V, policy, controls, beta) / beta >= tol:
            for _ in range(sweeps):
                for si, sj in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
                    _evaluate(V, policy, beta, si, sj)
            count += 1
        updates.append(count)
    return V, updates


if __name__ == "__main__":
    solve(8)
    for N in map(int, sys.argv[1:] or ["200", "400", "800"]):
        start = time.perf_counter()
        V, updates = solve(N)
        seconds = time.perf_counter() - start
        print(f"{N} x {N + 1}: {seconds:.3f} s, policy updates per level {updates}, max V {V.max():.6f}")
