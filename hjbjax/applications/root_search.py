"""Bracketing search for a root of a continuous function of one number, as a state and its step.

Chandrupatla's method keeps a bracket and three points. The next point is the inverse quadratic interpolation of the
three if that is safe, and otherwise the middle of the bracket. It needs about the same number of evaluations as Brent's
method, and never many more than bisection. The step works on numbers and on tracers, so the same search runs on the
host and in a compiled loop.

Source: T. R. Chandrupatla, A new hybrid quadratic/bisection algorithm for finding the zero of a nonlinear function
without using derivatives, Adv. Eng. Software 28 (1997).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import is_traced


class Search(NamedTuple):
    """The points of a search; f has different signs at ``near`` and ``far``.

    Attributes:
      near: the last point, with its value ``f_near``.
      far: the other end of the bracket.
      old: the point before.
      share: the place of the next point in the bracket, from ``near`` at 0 to ``far`` at 1.
    """

    near: Any
    f_near: Any
    far: Any
    f_far: Any
    old: Any
    f_old: Any
    share: Any


def begin_search(lo: Any, f_lo: Any, hi: Any, f_hi: Any) -> Search:
    """The search before its first step."""
    return Search(hi, f_hi, lo, f_lo, lo, f_lo, 0.5 * (hi - lo) / (hi - lo))


def proposal(search: Search) -> Any:
    """The next point to evaluate."""
    return search.near + search.share * (search.far - search.near)


def best(search: Search) -> tuple[Any, Any]:
    """The end of the bracket with the smaller value, and its value."""
    xp = _arrays(search)
    nearer = xp.abs(search.f_near) < xp.abs(search.f_far)
    return xp.where(nearer, search.near, search.far), xp.where(nearer, search.f_near, search.f_far)


def is_done(search: Search, tol: Any) -> Any:
    """True if the root is found or the bracket is no wider than twice the tolerance; also for NaN."""
    xp = _arrays(search)
    return (best(search)[1] == 0) | ~(xp.abs(search.far - search.near) > 2 * tol) | ~xp.isfinite(search.f_near)


def narrowed(search: Search, x: Any, f: Any, tol: Any) -> Search:
    """The search after f was evaluated at x."""
    xp = _arrays((search, x, f))
    same = xp.sign(f) == xp.sign(search.f_near)
    old, f_old = xp.where(same, search.near, search.far), xp.where(same, search.f_near, search.f_far)
    far, f_far = xp.where(same, search.far, search.near), xp.where(same, search.f_far, search.f_near)
    # inverse quadratic interpolation is monotone between the points if both inequalities hold
    xi, phi = _ratio(xp, x - far, old - far), _ratio(xp, f - f_far, f_old - f_far)
    safe = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi)
    share = _ratio(xp, f, f_far - f) * _ratio(xp, f_old, f_far - f_old) + _ratio(xp, old - x, far - x) * _ratio(
        xp, f, f_old - f
    ) * _ratio(xp, f_far, f_old - f_far)
    least = xp.minimum(_ratio(xp, tol, xp.abs(far - x)), 0.5)  # at least the tolerance away from both ends
    return Search(x, f, far, f_far, old, f_old, xp.clip(xp.where(safe, share, 0.5), least, 1 - least))


def _ratio(xp: Any, a: Any, b: Any) -> Any:
    """a/b, and 0 for b = 0."""
    return xp.where(b == 0, 0, a / xp.where(b == 0, 1, b))


def _arrays(tree: Any) -> Any:
    """The library for a search: JAX for tracers, otherwise NumPy."""
    return jnp if is_traced(tree) else np
