"""The optimum of the Hamiltonian over one player's actions, or both players', by trying all that may be best.

As a function of one component f of the drift the Hamiltonian is linear between the kinks 0, α/h⁺ and −α/h⁻, with one of
three slopes, so that its least and largest values over a box or a disc lie among finitely many points.
"""

import itertools

import numpy as np


def candidates(chain, value, admissible, gain, linear, square, offset):
    """Actions (K, S, m) among which the Hamiltonian, as it depends on this player, has its least and largest value.

    Args:
      chain, value: the chain and V.
      choices: the set.
      gain: (S, n, m), what the inputs add to the drift.
      linear, square: (m,), what they add to the cost.
      offset: (S, n), the drift without them.
    """
    size, m = chain.size, admissible.dim
    if admissible.kind == "none":
        return np.zeros((1, size, 0))
    if admissible.kind == "finite":
        return np.repeat(admissible.points[:, None, :], size, axis=1)
    slopes = [chain.slopes(value, i) for i in range(chain.n)]
    gradients = [
        linear + sum(p[:, None] * gain[:, i] for i, p in enumerate(pick)) for pick in itertools.product(*slopes)
    ]
    lines = [(gain[:, i], kink - offset[:, i]) for i in range(chain.n) for kink in chain.kinks(i)]
    if m > 2:
        found = _in_space(admissible, [(gain[:, i], [k - offset[:, i] for k in chain.kinks(i)], slopes[i])
                                       for i in range(chain.n)], linear, square, size)  # fmt: skip
    elif m == 1:
        found = _on_a_line(admissible, gradients, lines, square, size)
    else:
        found = _in_the_plane(admissible, gradients, lines, square, size)
    return admissible.nearest(np.stack(found))


def _on_a_line(admissible, gradients, lines, square, size):
    low, high = (
        (-admissible.radius, admissible.radius) if admissible.kind == "ball" else (admissible.lo[0], admissible.hi[0])
    )
    found = [np.full((size, 1), low), np.full((size, 1), high)]
    found += [_ratio(c[:, None], g) for g, c in lines]
    if square[0] != 0:
        found += [-g / (2 * square[0]) for g in gradients]
    return found


def _ratio(p, q):
    return np.where(q != 0, p / np.where(q != 0, q, 1), 0)


def _in_the_plane(admissible, gradients, lines, square, size):
    """Corners of all pieces, and stationary points inside pieces, along kinks and along the boundary."""
    found = [np.zeros((size, 2))]
    lines = [(g, c) for g, c in lines if np.any(g)]
    if admissible.kind == "box":
        ends = itertools.product(range(2), (admissible.lo, admissible.hi))
        lines += [(np.tile(np.eye(2)[j], (size, 1)), np.full(size, end[j])) for j, end in ends]
    else:
        assert square[0] == square[1] >= 0
        found += [-admissible.radius * g / _length(g) for g in gradients]
    for (g, c), (g2, c2) in itertools.combinations(lines, 2):
        det = g[:, 0] * g2[:, 1] - g[:, 1] * g2[:, 0]
        point = np.stack([c * g2[:, 1] - c2 * g[:, 1], g[:, 0] * c2 - g2[:, 0] * c], axis=-1)
        found.append(_ratio(point, det[:, None]))
    if np.any(square != 0):
        found += [_ratio(-g, 2 * square) for g in gradients]
    for g, c in lines:
        foot = _ratio(g * c[:, None], np.sum(g * g, axis=-1, keepdims=True))
        along = np.stack([-g[:, 1], g[:, 0]], axis=-1) / _length(g)
        if admissible.kind == "ball":
            reach = np.sqrt(np.maximum(admissible.radius**2 - np.sum(foot * foot, axis=-1, keepdims=True), 0))
            found += [foot + reach * along, foot - reach * along]
        bend = np.sum(square * along * along, axis=-1)
        if np.any(bend > 0):
            for slope in gradients:
                step = -np.sum((slope + 2 * square * foot) * along, axis=-1)
                found.append(foot + _ratio(step, 2 * np.maximum(bend, 0))[:, None] * along)
    return found


def _in_space(admissible, components, linear, square, size):
    """Stationary points with some inputs at their ends, some components at a kink, and a slope for each of the others.

    ``components`` are the rows, the places of the kinks on them, and the slopes between them.
    """
    found = [np.zeros((size, admissible.dim))]
    options = [[(g, c, None) for c in kinks] + [(g, None, p) for p in slopes] for g, kinks, slopes in components]
    for choice in itertools.product(*options):
        held = [(g, c) for g, c, _ in choice if c is not None]
        slope = (
            linear + sum(np.asarray(p)[..., None] * g for g, _, p in choice if p is not None) + np.zeros(found[0].shape)
        )
        rows = np.stack([g for g, _ in held], 1) if held else np.zeros((size, 0, admissible.dim))
        ends = np.stack([c for _, c in held], 1) if held else np.zeros((size, 0))
        if admissible.kind == "ball":
            found += _on_a_sphere(admissible.radius, rows, ends, slope, square)
        else:
            found += [
                _stationary(rows, ends, slope, square, face)
                for face in itertools.product(
                    *([None, lo, hi] for lo, hi in zip(admissible.lo, admissible.hi, strict=True))
                )
            ]
    return found


def _stationary(rows, ends, slope, square, face):
    """Where slope + 2 square u is a combination of the rows, with rows at their places and a face's inputs fixed."""
    size, held, m = rows.shape
    unit = max(np.max(np.abs(slope)), np.max(square)) or 1.0  # ``pinv`` drops what is tiny next to the rest
    slope, square, wide = slope / unit, square / unit, np.max(np.abs(rows), axis=-1, initial=0)
    wide = np.where(wide > 0, wide, 1)
    rows, ends = rows / wide[..., None], ends / wide
    matrix, right = np.zeros((size, m + held, m + held)), np.zeros((size, m + held))
    matrix[:, :m, :m], right[:, :m] = np.diag(2 * square), -slope
    matrix[:, :m, m:], matrix[:, m:, :m], right[:, m:] = np.swapaxes(rows, 1, 2), rows, ends
    for j, end in enumerate(face):
        if end is not None:
            matrix[:, j], right[:, j] = np.eye(m + held)[j], end
    return np.einsum("sij,sj->si", np.linalg.pinv(matrix), right)[:, :m]


def _on_a_sphere(radius, rows, ends, slope, square):
    """Of one square for all inputs: the stationary points on the rows' places, inside the ball and on its sphere."""
    assert np.all(square == square[0])
    wide = np.max(np.abs(rows), axis=-1, initial=0)
    wide = np.where(wide > 0, wide, 1)
    rows, ends = rows / wide[..., None], ends / wide
    inverse = np.linalg.pinv(rows)
    foot = np.einsum("sij,sj->si", inverse, ends)
    along = slope - np.einsum("sij,sjk,sk->si", inverse, rows, slope)
    reach = np.sqrt(np.maximum(radius**2 - np.sum(foot * foot, axis=-1, keepdims=True), 0)) * along / _length(along)
    return [foot - reach, foot + reach, *([foot - along / (2 * square[0])] if square[0] else [])]


def _length(g):
    length = np.sqrt(np.sum(g * g, axis=-1, keepdims=True))
    return np.where(length > 0, length, 1)


def pick(values, actions, largest=False):
    """The best value at every node and the action that has it; ``values`` (K, S), ``actions`` (K, S, m)."""
    values = np.where(np.isnan(values), -np.inf if largest else np.inf, values)
    best = np.argmax(values, axis=0) if largest else np.argmin(values, axis=0)
    here = np.arange(values.shape[1])
    return values[best, here], actions[best, here]


def best_control(chain, value, d=None):
    """min over u of H, against one disturbance a node in a game."""
    model = chain.model
    offset = model.b if d is None else model.b + np.einsum("snm,sm->sn", model.E, d)
    tried = candidates(chain, value, model.controls, model.G, model.l, model.s, offset)
    return pick(
        chain.hamiltonian(value, tried, None if d is None else np.broadcast_to(d, (len(tried), *d.shape))), tried
    )


def best_disturbance(chain, value, u):
    """max over d of H against one control a node."""
    model = chain.model
    offset = model.b + np.einsum("snm,sm->sn", model.G, u)
    tried = candidates(chain, value, model.disturbances, model.E, model.k, 0 * model.k, offset)
    return pick(chain.hamiltonian(value, np.broadcast_to(u, (len(tried), *u.shape)), tried), tried, largest=True)


def saddle(chain, value):
    """min max of H, or max min: the value and both actions. The outer set is finite, or both are intervals."""
    model, lower = chain.model, chain.model.lower
    if not np.any(np.any(model.G, axis=(0, 2)) & np.any(model.E, axis=(0, 2))):  # a sum: neither matters to the other
        u = best_control(chain, value, np.zeros((chain.size, model.disturbances.dim)))[1]
        best, d = best_disturbance(chain, value, u)
        return best, u, d
    outer, inner = (model.disturbances, best_control) if lower else (model.controls, best_disturbance)
    tried = [outer.points[k] for k in range(len(outer.points))] if outer.kind == "finite" else _outer(chain, value)
    found = []
    for action in tried:
        action = np.broadcast_to(action, (chain.size, outer.dim))
        best, answer = inner(chain, value, action)
        found.append((best, action, answer))
    values, mine, theirs = (np.stack(column) for column in zip(*found, strict=True))
    best, both = pick(values, np.concatenate([mine, theirs], axis=-1), largest=lower)
    first, second = both[:, : outer.dim], both[:, outer.dim :]
    return (best, second, first) if lower else (best, first, second)


def _outer(chain, value):
    """Where the outer player's optimum may lie when both move one interval and all costs are linear.

    Against a fixed answer H is linear between kinks; the answers are the ends and the kinks of the inner player. The
    outer function is made of linear pieces that meet at kinks of one of these or where two of them are equal.
    """
    model, lower = chain.model, chain.model.lower
    mine, theirs = (model.disturbances, model.controls) if lower else (model.controls, model.disturbances)
    g, e = (model.E, model.G) if lower else (model.G, model.E)
    low, high = _interval(mine)
    ends = _interval(theirs)
    breaks = [np.full((chain.size, 1), low), np.full((chain.size, 1), high)]
    for i in range(chain.n):
        for kink in chain.kinks(i):
            breaks += [_ratio((kink - model.b[:, i] - e[:, i, 0] * end)[:, None], g[:, i]) for end in ends]
            breaks.append(_ratio((kink - model.b[:, i])[:, None], g[:, i]))
    breaks = np.sort(np.clip(np.stack(breaks), low, high), axis=0)

    def branches(u):
        answers = [np.full((chain.size, 1), end) for end in ends]
        for i in range(chain.n):
            for kink in chain.kinks(i):
                answers.append(_ratio((kink - model.b[:, i] - g[:, i, 0] * u[:, 0])[:, None], e[:, i]))
        answers = [np.clip(a, *ends) for a in answers]
        pairs = [(a, u) if lower else (u, a) for a in answers]
        return np.stack([chain.hamiltonian(value, *pair) for pair in pairs])

    tried, left = list(breaks), branches(breaks[0])
    for start, end in itertools.pairwise(breaks):
        right = branches(end)
        for p, q in itertools.combinations(range(len(left)), 2):
            before, after = left[p] - left[q], right[p] - right[q]
            share = _ratio(before, before - after)
            tried.append(start + np.clip(share, 0, 1)[:, None] * (end - start))
        left = right
    return tried


def _interval(admissible):
    return (
        (-admissible.radius, admissible.radius) if admissible.kind == "ball" else (admissible.lo[0], admissible.hi[0])
    )


def optimum(chain, value):
    """The Hamiltonian's optimum at every node, and the actions."""
    if chain.model.disturbances is None:
        best, u = best_control(chain, value)
        return best, u, None
    return saddle(chain, value)
