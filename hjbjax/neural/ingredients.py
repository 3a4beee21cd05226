"""Checks of the problem of a network: what is refused, and the rule for the minimum of its Hamiltonian."""

import numpy as np

from hjbjax.hamiltonian import pointwise
from hjbjax.hamiltonian.pointwise import Rule
from hjbjax.problem.problem import Problem
from hjbjax.problem.rewards import refuse_rewards
from hjbjax.tracing import checks, closures

REFUSED = {  # ingredients for which there is no ansatz, with the reason
    "disturbances": "a game has a saddle point, and only a minimum over controls is computed",
    "stopping_cost": "there is no ansatz for stopping",
    "running_max": "a running maximum is not an integral",
    "growth": "the discount must be a number",
    "modes": "the value has no jumps between modes",
}


def settled_problem(problem: object, n: int, name: str, refused: dict[str, str]) -> tuple[Problem, Rule | None]:
    """The problem with settled functions, and the rule for its minimum; None without controls.

    Args:
      problem: the problem.
      n: the number of states.
      name: the function that the user called.
      refused: further ingredients that are refused, with the reasons.

    Raises:
      ValueError: an ingredient that is not supported.
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"{name}: got {type(problem).__name__}, wanted a Problem")
    closures.refuse_traced(name, problem)
    refuse_rewards(problem, name, "a network is trained on costs")
    for field, why in (REFUSED | refused).items():
        if getattr(problem, field) is not None:
            raise ValueError(f"{name}: got a problem with {field}, wanted one without: {why}.\nSolve it on a grid")
    for field in ("jumps", "pushes"):
        if getattr(problem, field):
            raise ValueError(f"{name}: got a problem with {field}, wanted one without. Solve it on a grid")
    if callable(problem.discount):
        raise ValueError(f"{name}: got a discount that is a function of the state, wanted a number")
    if callable(problem.controls):
        raise ValueError(f"{name}: got bounds of the controls that depend on the state, wanted a fixed set")
    checks.of_one_state(problem, n, "the number of states")
    problem = closures.settled(problem, n)
    if problem.controls is None:
        return problem, None
    rule = pointwise.rule_of(problem, n)
    if not rule.exact:
        raise ValueError(
            f"{name}: the minimum over the controls has no formula here; wanted drift and cost that are sums of\n"
            "quadratic polynomials of one control each, or an enumerated set: Finite(points), or box.grid(num)"
        )
    return problem, rule


def state(value: object, label: str) -> np.ndarray:
    """One finite number per state in float64."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"{label}: got {value!r:.100}, wanted one number per state") from None
    if array.ndim != 1 or array.size == 0 or not np.all(np.isfinite(array)):
        raise ValueError(f"{label}: got {value!r:.100}, wanted shape (n,): one finite number per state")
    return array


def box_corners(lo: object, hi: object, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The corners of a box, after checks."""
    low, high = state(lo, f"{name}: lo"), state(hi, f"{name}: hi")
    if low.shape != high.shape or np.any(low >= high):
        raise ValueError(f"{name}: got lo = {low.tolist()} and hi = {high.tolist()}; lo must be smaller than hi")
    return low, high


def known_seed(seed: object, name: str) -> int:
    """The seed as an integer."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"{name}: got seed = {seed!r}, wanted an integer ≥ 0")
    return int(seed)
