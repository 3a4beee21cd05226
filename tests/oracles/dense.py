"""Dense solutions of the chain: Howard's iteration, Hoffman and Karp's for games, value iteration for tubes.

Each checks that its answer solves the equation, and says what rounding of the equation may do to it.
"""

import dataclasses
import itertools

import numpy as np
from dense_actions import best_control, best_disturbance, candidates, optimum, saddle
from dense_chain import EPS, Actions, Chain, Model

__all__ = [
    "EPS",
    "Actions",
    "Answer",
    "Chain",
    "Model",
    "best_control",
    "best_disturbance",
    "optimum",
    "saddle",
    "solve",
]


@dataclasses.dataclass(frozen=True)
class Answer:
    """The value at the nodes (infinite where no end can be reached), what rounding may do to it, and its policy."""

    value: np.ndarray
    rounding: np.ndarray
    residual: float
    u: np.ndarray
    d: np.ndarray


def solve(model, eps=EPS):
    """The exact solution of the chain; ``eps`` is the unit of rounding that ``rounding`` is told for."""
    chain = Chain(model)
    free = model.discount == 0 and not np.any(model.q)
    if free and (model.floor is not None or model.disturbances is not None):
        return _iterate(chain)
    if model.disturbances is not None:
        return _two_players(chain, eps)
    value, u, lost = _start(chain)
    return _one_player(chain, value, u, lost, eps)


def admissible(model):
    """Where some action leaves through no side that none may cross, or no action is taken, bool (S,)."""
    chain = Chain(model)
    allowed = np.any(~chain.forbidden(chain.drift(_supports(chain))), axis=0)
    return allowed | _obstacles(model, chain.size)[0]


def _obstacles(model, size):
    held = np.zeros(size, bool) if model.held is None else model.held
    stop = np.full(size, np.inf) if model.stop is None else model.stop
    if model.rest is not None and model.discount == 0:
        stop = np.where(model.rest, np.minimum(stop, 0), stop)
    return held, np.zeros(size) if model.given is None else model.given, stop


def _evaluate(chain, u, d, ended, at_end, source=None):
    """The value of one policy: (β − 𝓛) V = L, and V given where the path has ended."""
    matrix = chain.model.discount * np.eye(chain.size) - chain.matrix(u, d)
    right = chain.cost(u, d) if source is None else source
    matrix[ended] = np.eye(chain.size)[ended]
    right = np.where(ended, np.where(np.isfinite(at_end), at_end, 0), right)
    value = np.linalg.solve(matrix, right)
    exact, wanted = matrix.astype(np.longdouble), right.astype(np.longdouble)
    for _ in range(3):  # with little discount residuals of rounding hide which of two policies is better
        value = value + np.linalg.solve(matrix, (wanted - exact @ value).astype(float))
    return np.where(ended, at_end, value.astype(float))  # to the last bit


def _start(chain):
    """A policy with a finite value where there is one, and the nodes where there is none."""
    model = chain.model
    held, given, stop = _obstacles(model, chain.size)
    lost = np.zeros(chain.size, bool)
    if model.discount > 0:
        value = np.where(held, given, np.where(np.isfinite(stop), stop, 0))
        return value, best_control(chain, value)[1], lost
    tried = _supports(chain)
    ends = held | np.isfinite(stop)
    inside = np.ones(chain.size, bool)
    while True:
        found, u = _towards(chain, tried, ends, inside)
        if np.array_equal(found, inside):
            break
        inside = found
    lost = ~inside
    ended = ends | lost
    value = _evaluate(chain, u, None, ended, np.where(held, given, np.where(lost, 0, stop)))
    return np.where(lost, np.inf, value), u, lost


def _supports(chain):
    """Actions (K, S, m) that between them make every set of jumps that some action makes."""
    tried = candidates(chain, np.zeros(chain.size), chain.model.controls, chain.model.G, chain.model.l,
                       chain.model.s, chain.model.b)  # fmt: skip
    admissible, gain = chain.model.controls, chain.model.G
    if admissible.kind in ("none", "finite"):
        return tried
    if admissible.kind == "ball":  # the part of a disc that a line cuts off may hold no other candidate
        length = np.linalg.norm(gain, axis=-1, keepdims=True)
        outmost = np.moveaxis(admissible.radius * gain / np.where(length > 0, length, 1), 1, 0)
        tried = np.concatenate([tried, outmost, -outmost])
    if tried.shape[-1] == 1:
        ordered = np.sort(tried, axis=0)
        return np.concatenate([tried, (ordered[1:] + ordered[:-1]) / 2])
    pairs = itertools.combinations(range(len(tried)), 2)
    return np.concatenate([tried, np.stack([(tried[p] + tried[q]) / 2 for p, q in pairs])])


def _towards(chain, tried, ends, inside):
    """The nodes that some actions lead to an end without a jump out of ``inside``, and these actions."""
    rates = chain.rates(chain.drift(tried)) > 0
    leads = np.stack(chain.leads)
    allowed = np.all(~rates | inside[leads][:, None, :], axis=0) & inside & ~chain.forbidden(chain.drift(tried))
    found, u = ends & inside, tried[0].copy()
    while True:
        arrives = allowed & np.any(rates & found[leads][:, None, :], axis=0) & ~found
        new = np.any(arrives, axis=0)
        if not np.any(new):
            return found, u
        u[new] = tried[np.argmax(arrives, axis=0)[new], np.flatnonzero(new)]
        found = found | new


def _noise(chain, value, u, d, eps):
    """What rounding of the given unit does to the residual of a policy at every node."""
    finite = np.where(np.isfinite(value), np.abs(value), 0)
    size = np.abs(chain.cost(u, d)) + np.abs(chain.model.q) + chain.model.discount * finite
    for lead, rate in zip(chain.leads, chain.rates(chain.drift(u, d)), strict=True):
        size = size + rate * (finite[lead] + finite)
    return eps * size


def _cancelled(chain, value, u, d, eps):
    """What rounding leaves of costs and of drift where their parts cancel, as in a control that holds its place."""
    model, finite = chain.model, np.where(np.isfinite(value), value, 0)
    size = np.full(chain.size, np.max(np.abs(model.q), initial=0)) + np.sum(np.abs(model.l * u), axis=-1)
    drift = np.abs(model.b) + np.einsum("snm,sm->sn", np.abs(model.G), np.abs(u))
    if d is not None:
        size = size + np.sum(np.abs(model.k * d), axis=-1)
        drift = drift + np.einsum("snm,sm->sn", np.abs(model.E), np.abs(d))
    for way in (drift, -drift):
        for lead, rate in zip(chain.leads, chain.rates(way), strict=True):
            size = size + rate * np.abs(finite[lead] - finite)
    for i in range(chain.n if model.a is not None else 0):  # what correlation leaves of the noise along an axis
        taken = sum(np.abs(model.a[:, i, j]) * chain.mean[i] / chain.mean[j] for j in range(chain.n))  # with a_ii
        for lead in chain.leads[2 * i : 2 * i + 2]:
            size = size + taken / chain.mean[i] ** 2 * np.abs(finite[lead] - finite)
    return eps * size


def _one_player(chain, value, u, lost, eps):
    """Howard's iteration over actions and stopping; an action is kept unless another is better beyond rounding."""
    held, given, stop = _obstacles(chain.model, chain.size)
    beta = chain.model.discount
    stopped = ~held & ~lost & (value >= stop)
    for step in range(500):
        best, new = best_control(chain, value)
        here = chain.hamiltonian(value, u)
        slack = 16 * np.maximum(_noise(chain, value, new, None, EPS), _noise(chain, value, u, None, EPS))
        better = ~held & ~lost & (best < here - slack)
        u = np.where(better[:, None], new, u)
        with np.errstate(invalid="ignore"):
            left = np.minimum(best, np.where(better, best, here)) - beta * value
        goes_on = stopped & (left < -slack)
        stops = ~stopped & ~held & ~lost & (value > stop * (1 + 8 * EPS * np.sign(stop)))
        stopped = (stopped & ~goes_on) | stops
        ended = held | lost | stopped
        after = _evaluate(chain, u, None, ended, np.where(held, given, np.where(lost, 0, stop)))
        value = np.where(lost, np.inf, after)
        if step > 0 and not np.any(better | goes_on | stops):
            break
    else:
        raise AssertionError("the oracle's policy iteration does not end")
    return _answer(chain, value, u, None, ended, eps)


def _answer(chain, value, u, d, ended, eps):
    going = 16 * (_noise(chain, value, u, d, eps) + _cancelled(chain, value, u, d, eps))
    noise = np.where(ended, 4 * eps * np.where(np.isfinite(value), np.abs(value), 0), going)
    rounding = _evaluate(chain, u, d, ended, noise, source=noise)
    best, *played = optimum(chain, value)
    with np.errstate(invalid="ignore"):
        left = np.where(ended | np.isinf(value), 0, best - chain.model.discount * value)
    # a rate of 1e-11 is what cancellation leaves of drift or noise: next to a value of 1e16 its last bits count
    each = [_noise(chain, value, *pair, EPS) + _cancelled(chain, value, *pair, EPS) for pair in (played, (u, d))]
    allowed = 100 * np.maximum(*each)
    assert np.all(np.abs(left) <= allowed), "the oracle has not solved its equation"
    return Answer(value, np.abs(rounding), float(np.max(np.abs(left))), u, d)


def _two_players(chain, eps):
    """The inner player's best answer to the outer policy by Howard's iteration, then a better outer policy."""
    model = chain.model
    held, given, stop = _obstacles(model, chain.size)
    value = np.where(held, given, np.where(np.isfinite(stop), np.minimum(stop, 0), 0.0))
    assert model.discount > 0, "games without discount are tubes here"
    _, u, d = saddle(chain, value)
    stopped = np.zeros(chain.size, bool)
    for step in range(5000):
        if step == 300:  # along a ridge of the outer player's H it only falls by 3 % a step, or by 3 ‰: seed 959
            found = _both_at_once(chain, u, d, stopped)
            if found is not None:
                return _answer(chain, *found, eps)
        value, u, d, stopped = _inner(chain, value, u, d, stopped)
        best, new_u, new_d = saddle(chain, value)
        here = chain.hamiltonian(value, u, d)
        slack = 64 * np.maximum(_noise(chain, value, new_u, new_d, EPS), _noise(chain, value, u, d, EPS))
        better = ~held & ((best > here + slack) if model.lower else (best < here - slack))
        if not np.any(better):
            return _answer(chain, value, u, d, held | stopped, eps)
        u, d = np.where(better[:, None], new_u, u), np.where(better[:, None], new_d, d)
    raise AssertionError("the oracle's game does not end")


def _both_at_once(chain, u, d, stopped):
    """Both players improve at once: Newton's iteration, which may go round; None if it has not ended soon."""
    model = chain.model
    held, given, stop = _obstacles(model, chain.size)
    for _ in range(300):
        value = _evaluate(chain, u, d, held | stopped, np.where(held, given, stop))
        best, new_u, new_d = saddle(chain, value)
        left = best - model.discount * value
        slack = 16 * np.maximum(_noise(chain, value, new_u, new_d, EPS), _noise(chain, value, u, d, EPS))
        goes_on, stops = stopped & (left < -slack), ~stopped & ~held & (value > stop * (1 + 8 * EPS * np.sign(stop)))
        if not np.any(goes_on | stops | (~held & ~stopped & (np.abs(left) > slack))):
            return value, u, d, held | stopped
        stopped, u, d = (stopped & ~goes_on) | stops, new_u, new_d
    return None


def _inner(chain, value, u, d, stopped):
    """The value of the outer player's policy: the other one answers as well as possible, the controller may stop."""
    model = chain.model
    held, given, stop = _obstacles(model, chain.size)
    for _ in range(500):
        value = _evaluate(chain, u, d, held | stopped, np.where(held, given, stop))
        here = chain.hamiltonian(value, u, d)
        best, new = best_control(chain, value, d) if model.lower else best_disturbance(chain, value, u)
        slack = 64 * _noise(chain, value, u, d, EPS)
        better = ~held & ((best < here - slack) if model.lower else (best > here + slack))
        if model.lower:
            u = np.where(better[:, None], new, u)
        else:
            d = np.where(better[:, None], new, d)
        left = np.where(better, best, here) - model.discount * value
        goes_on, stops = stopped & (left < -slack), ~stopped & ~held & (value > stop * (1 + 8 * EPS * np.sign(stop)))
        stopped = (stopped & ~goes_on) | stops
        if not np.any(better | goes_on | stops):
            return value, u, d, stopped
    raise AssertionError("the oracle's inner iteration does not end")


def _outflow(chain):
    """The largest Q at every node: rates are convex in the drift, so that ends and corners of the sets suffice."""
    model, corners = chain.model, []
    for admissible in (model.controls, model.disturbances):
        if admissible is None or admissible.kind == "none":
            corners.append([None])
        elif admissible.kind == "finite":
            corners.append(list(admissible.points))
        else:  # the corners of a square around a disc lie beyond it, which does no harm
            lo, hi = (
                (admissible.lo, admissible.hi) if admissible.kind == "box" else (-admissible.radius, admissible.radius)
            )
            picks = itertools.product((False, True), repeat=admissible.dim)
            corners.append([np.where(pick, np.broadcast_to(hi, admissible.dim), lo) for pick in picks])
    rates = []
    for u, d in itertools.product(*corners):
        u = np.zeros((chain.size, 0)) if u is None else np.broadcast_to(u, (chain.size, len(u)))
        rates.append(
            np.sum(chain.rates(chain.drift(u, None if d is None else np.broadcast_to(d, (chain.size, len(d))))), axis=0)
        )
    outflow = np.max(np.stack(rates), axis=0)
    return np.where(outflow > 0, outflow, 1)


def _iterate(chain):
    """A tube: V ← max(g, min(ψ, V + H/Q)) from the constraint itself, until only rounding changes."""
    model = chain.model
    held, given, stop = _obstacles(model, chain.size)
    floor = np.full(chain.size, -np.inf) if model.floor is None else model.floor
    value = np.maximum(stop, floor) if model.stop is not None else floor
    value, outflow = np.where(held, given, value), _outflow(chain)
    scale = np.max(np.abs(value))
    for _ in range(30_000):
        new = np.maximum(floor, np.minimum(stop, value + optimum(chain, value)[0] / outflow))
        new = np.where(held, given, new)
        change = np.max(np.abs(new - value))
        value = new
        if change <= 2 * EPS * scale:
            break
    return Answer(value, np.full(chain.size, 1e-9 * scale), change, None, None)
