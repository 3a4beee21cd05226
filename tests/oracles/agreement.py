"""What the package says of a random problem beside what the dense oracle says."""

import dataclasses
import warnings

import dense
import numpy as np

import hjbjax as hjb

SLACK = 16  # times what rounding may do to a residual: the package rounds as the oracle does, in another order


@dataclasses.dataclass(frozen=True)
class Verdict:
    """How one problem went.

    Attributes:
      kind: "certified", "searched" (an optimum over actions was), "uncertified" or "refused".
      complaints: what was said and does not hold; none is good.
      unfinished: the status of a solve that says itself that it has not come to its end, or nothing.
      ratio: |V − V_h| over the certified error, NaN without one.
      off: |V − V_h| over the tolerance.
    """

    kind: str
    complaints: tuple
    ratio: float = np.nan
    off: float = np.nan
    unfinished: str = ""


def compare(case, rng):
    """Solve a case both ways, to a tolerance drawn in the units of its value."""
    if case.refusal:
        return _refused(case)
    eps = np.finfo(np.float32 if case.family.single else np.float64).eps
    answer = dense.solve(case.model, eps)
    finite = np.isfinite(answer.value)
    size, rounding = np.max(np.abs(answer.value[finite]), initial=0), np.where(finite, SLACK * answer.rounding, 0)
    rounding = rounding + 64 * eps * size  # of the numbers themselves, which both compute in their own order
    tol = max(10.0 ** rng.uniform(-7, -2) * size, 100 * np.max(rounding), 1e-300)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            solution = hjb.solve(
                case.problem, case.grid, tol=tol, throw=False, progress=False,
                dtype="float32" if case.family.single else None, max_steps=100_000,
            scheme=hjb.Upwind())  # fmt: skip
        except ValueError as error:
            return Verdict("refused", (f"refused: {str(error).splitlines()[0]}",))
    return _judged(solution, answer, finite, rounding, tol)


def _refused(case):
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            solution = hjb.solve(
                case.problem, case.grid, throw=False, progress=False, max_steps=1000, scheme=hjb.Upwind()
            )
    except ValueError:
        return Verdict("refused", ())
    return Verdict("refused", (f"not refused but {solution.status.name}: {case.refusal}",))


def _judged(solution, answer, finite, rounding, tol):
    """What does not hold of a solution, next to the dense answer."""
    value = np.asarray(solution.value, float).ravel()
    complaints = []
    if np.any(np.isnan(value)):
        return Verdict("uncertified", ("NaN",))
    if np.any(np.isinf(value) != ~finite):
        wrong = np.isinf(value) != ~finite
        nodes = f"{np.sum(np.isinf(value))} nodes, the oracle at {np.sum(~finite)}"
        complaints.append(f"infinite at {nodes}: {np.sum(wrong)} differ")
        finite = finite & np.isfinite(value)
    exact = np.where(finite, answer.value, 0)
    off = np.abs(np.where(finite, value, 0) - exact)
    beyond = np.max(off - rounding, initial=0)
    converged = solution.status is hjb.Status.CONVERGED
    unfinished = "" if converged else solution.status.name
    if solution.enclosure is None:
        if "searched" in solution.stats.get("certificate", ""):  # a search may miss more than tol
            return Verdict("searched", tuple(complaints), np.nan, np.max(off, initial=0) / tol, unfinished)
        if converged and beyond > tol:
            complaints.append(f"converged without certificate, off by {beyond / tol:.3g} tol")
        return Verdict("uncertified", tuple(complaints), np.nan, np.max(off, initial=0) / tol, unfinished)
    low, high = (np.where(finite, np.asarray(bound, float).ravel(), 0) for bound in solution.bounds)
    far = np.maximum(np.abs(low), np.abs(high))  # an unfinished solve may be far off, and rounds what it bounds
    rounding = rounding + 8 * np.finfo(solution.value.dtype).eps * far
    if np.any(low > exact + rounding):
        complaints.append(f"lower bound too high by {np.max(low - exact) / tol:.3g} tol")
    if np.any(high < exact - rounding):
        complaints.append(f"upper bound too low by {np.max(exact - high) / tol:.3g} tol")
    if np.max(off - rounding) > solution.error:
        complaints.append(f"off by {beyond:.3g}, certified {solution.error:.3g}, tol {tol:.3g}")
    if converged and not solution.error <= tol:
        complaints.append("converged above its tolerance")
    ratio = beyond / solution.error if solution.error > 0 and np.isfinite(solution.error) else np.nan
    return Verdict("certified", tuple(complaints), ratio, np.max(off, initial=0) / tol, unfinished)
