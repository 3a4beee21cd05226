"""Random problems for the package and, as numbers at the nodes, for the dense oracle.

A family is what costs a compilation: functions, sizes, kinds of sets, which ingredients there are. Everything else is a
number, drawn anew for every problem: discounts from 1e-6 to 10, costs times 1e-9 to 1e9, times 1e-6 to 1e6.
"""

import dataclasses
import functools

import dense
import families
import numpy as np
from families import BY_NAME, FAMILIES, Family, bare, of_state
from jax.tree_util import Partial

import hjbjax as hjb

__all__ = ["BY_NAME", "FAMILIES", "Case", "draw"]


@dataclasses.dataclass(frozen=True)
class Case:
    """One random problem: for the package, for the oracle, and what it must get."""

    family: Family
    problem: hjb.Problem
    grid: hjb.Grid
    model: dense.Model
    refusal: str = ""  # why it must be refused, or nothing


def draw(family, rng):
    """A random problem of a family."""
    n = len(family.shape)
    time, money = (10.0 ** (rng.uniform(*span) if rng.random() < 0.5 else 0) for span in ((-6, 6), (-9, 9)))
    grid, axes, periods = _grid(family, rng)
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, n)
    controls, mine = _set(family.controls, rng)
    disturbances, theirs = _set(family.disturbances or "none0", rng)
    p = _dynamics(family, rng, axes, mine.dim, theirs.dim, time)
    p |= _costs(family, rng, axes, mine, theirs, money / time, money)
    noise, a = _noise(family, rng, p, x, axes, time)
    discount = 10.0 ** rng.uniform(-6, 1) / time if family.discounted else 0.0
    ends, numbers = _ends(family, rng, p, x, axes, money)
    drift, cost = getattr(families, f"drift_{family.drift}"), getattr(families, f"cost_{family.cost}", None)
    game = {"disturbances": disturbances, "isaacs": "lower" if family.lower else "upper"} if family.disturbances else {}
    problem = hjb.Problem(
        _bound(drift, p), cost and _bound(cost, p), controls, noise=noise, discount=discount, **game, **ends
    )
    size = len(x)
    model = dense.Model(
        axes, grid.periodic, bare(np, p, x), of_state(np, p, x), mine,
        np.tile(p["gain"], (size, 1, 1)), p["price"], p["square"], discount, a, periods=periods,
        disturbances=theirs if family.disturbances else None, E=np.tile(p["push"], (size, 1, 1)), k=p["harm"],
        lower=family.lower, constrained=_sides(family, grid), **numbers,
    )  # fmt: skip
    return Case(family, problem, grid, model, _refusal(family, model))


def _bound(function, numbers):
    """A function with its numbers, all of one type: a number of another type would be another program."""
    return Partial(function, {name: np.asarray(number, np.float64) for name, number in numbers.items()})


def _refusal(family, model):
    if model.held is not None and "target" in family.ends and np.all(model.held):
        return "the target covers the grid"
    if model.held is not None and "target" in family.ends and not np.any(model.held):
        return "no node lies in the target"
    if model.a is not None and not dense.Chain(model).representable:
        return "noise that the chain cannot represent"
    if model.constrained and not np.all(dense.admissible(model)):
        return "a node without an admissible action"
    return ""


def _sides(family, grid):
    """The sides that no action may cross, as (axis, step)."""
    ends = [(axis, step) for axis in range(grid.ndim) if not grid.periodic[axis] for step in (-1, 1)]
    return tuple(ends) if family.edges == "constrained" else ()


def _grid(family, rng):
    n = len(family.shape)
    periodic, stretched = family.periodic or (False,) * n, family.stretched or (False,) * n
    lo = np.where([p or rng.random() < 0.5 for p in periodic], rng.integers(-3, 0, n), rng.uniform(-3, -0.2, n))
    length = np.where(rng.random(n) < 0.5, rng.integers(1, 5, n), rng.uniform(0.5, 6, n))
    if "rest" in family.ends:  # a node stands at the origin
        spacing = length / (np.array(family.shape) - 1)
        lo = -spacing * rng.integers(0, family.shape)
    hi = lo + length
    if "rest" in family.ends:
        at = np.round(-lo / spacing).astype(int)
        last = np.array(family.shape) - 1
        hi = np.where(at < last, -lo * (last - at) / np.where(at > 0, at, 1), hi)
        hi, lo = np.where(at == 0, length, np.where(at == last, 0.0, hi)), np.where(at == 0, 0.0, lo)
    stretching = tuple(
        (float(rng.uniform(0.5, 5)), float(rng.choice([0.5, rng.uniform(0, 1)]))) if s else None for s in stretched
    )
    stretch = tuple(pair and hjb.Sinh(*pair) for pair in stretching)
    axes = [_axis(*parts) for parts in zip(lo, hi, family.shape, periodic, stretching, strict=True)]
    extra = {"stretch": stretch} if any(stretched) else {}
    if family.edges:
        extra["edges"] = family.edges
    return hjb.Grid(lo, hi, family.shape, periodic, **extra), axes, tuple(hi - lo)


def _axis(lo, hi, count, periodic, stretching):
    last = count if periodic else count - 1
    place = np.arange(count)
    if stretching is not None:  # sinh with its inflection so placed that the centre is mapped onto itself
        k, center = map(np.longdouble, stretching)  # arctanh near 1 would leave little of a double
        middle = 0.5 if center == 0.5 else np.arctanh(center * np.sinh(k) / (1 - center + center * np.cosh(k))) / k
        place = place / last
        low, high = np.sinh(k * middle), np.sinh(k * (1 - middle))
        place = last * (np.sinh(k * (place - middle)) + low) / (low + high)
    return np.asarray((lo * (last - place) + hi * place) / last, float)


def _set(kind, rng):
    name, m = kind[:-1], int(kind[-1])
    if name == "none":
        return None, dense.Actions("none", dim=0)
    if name == "finite":
        points = np.round(rng.uniform(-1.5, 1.5, (4 if m == 2 else 3, m)), 2)
        return hjb.Finite(points), dense.Actions("finite", points=points, dim=m)
    if name == "ball":
        radius = rng.uniform(0.2, 2)
        return hjb.Ball(radius, m), dense.Actions("ball", radius=radius, dim=m)
    lo = -rng.uniform(0.1, 2, m)
    hi = np.where(rng.random(m) < 0.5, -lo, rng.uniform(0.1, 2, m))
    return hjb.Box(lo, hi), dense.Actions("box", lo=lo, hi=hi, dim=m)


def _dynamics(family, rng, axes, m, k, time):
    n, rest = len(axes), "rest" in family.ends
    some = functools.partial(rng.choice, [0.0, 1.0])
    gain, push = rng.normal(size=(n, m)), 0.4 * rng.normal(size=(n, k))
    if family.drift == "own":
        gain = np.diag(np.sign(np.diag(gain)) * (0.2 + np.abs(np.diag(gain))))
    if family.drift == "apart":
        gain, push = gain * [[1.0], [0.0]], push * [[0.0], [1.0]]
    if not family.discounted and family.drift == "game":
        push = 0.3 * rng.choice([-1.0, 1.0]) * gain[:, :k]
    p = {
        "base": np.where(rest, 0.0, some() * rng.normal(size=n)), "linear": some() * 0.5 * rng.normal(size=(n, n)),
        "swing": some() * rng.normal(size=n), "turn": rng.normal(size=n), "phase": 0.0 if rest else rng.uniform(0, 6),
        "gain": gain, "push": push,
    }  # fmt: skip
    calm = 1.0 if family.discounted else rng.choice([0.0, 0.2, 1.0])  # so that the control often rules
    calm = 0.2 * calm if family.edges else calm
    p |= {name: calm * p[name] for name in ("base", "linear", "swing")}
    wall, current = np.inf, np.zeros(n)
    if "lost" in family.ends and rng.random() < 0.6:
        at = rng.integers(len(axes[0]) // 2, len(axes[0]) - 1)
        wall, current = (axes[0][at] + axes[0][at + 1]) / 2, np.where(np.arange(n) == 0, 20.0, 0.0)
    p |= {"wall": wall, "current": current}
    return p | {name: p[name] / time for name in ("base", "linear", "swing", "gain", "push", "current")}


def _costs(family, rng, axes, mine, theirs, rate, money):
    n, m = len(axes), mine.dim
    positive, rest = not family.discounted, "rest" in family.ends
    price = (0.0 if rest else 1.0) * rng.choice([0.0, 1.0]) * rng.normal(size=m)
    square = rng.uniform(0, 1, m) * rng.choice([0.0, 1.0]) if family.cost == "square" else np.zeros(m)
    if family.cost == "square" and not positive:
        square = square * rng.choice([-1.0, 1.0], m)
    square = np.full(m, abs(square[0])) if mine.kind == "ball" else square  # the oracle knows convex spheres only
    harm = rng.normal(size=theirs.dim) if family.cost == "linear" and family.disturbances else np.zeros(theirs.dim)
    slope = rng.choice([0.0, 1.0]) * rng.normal(size=n)
    p = {"toll": rng.normal(), "slope": slope, "middle": np.array([rng.choice(axis) for axis in axes]),
         "wave": rng.choice([0.0, 1.0]) * rng.normal(), "price": price, "square": square, "harm": harm}  # fmt: skip
    if positive:
        spread = np.sum(np.abs(price)) * 2.2
        p |= {"toll": spread + rng.uniform(0.05, 2), "slope": np.abs(slope), "wave": 0.0}
    if rest:
        p |= {"toll": 0.0, "slope": rng.uniform(0.1, 1, n), "middle": np.zeros(n)}
    rate = 0.0 if family.cost == "none" else rate
    return p | {name: p[name] * rate for name in ("toll", "slope", "wave", "price", "square", "harm")}


def _noise(family, rng, p, x, axes, time):
    """σ for the package and a at the nodes."""
    n = len(axes)
    if family.noise == "none":
        return None, None
    strength = rng.choice([0.05, 0.3, 1.0, 3.0]) / np.sqrt(time)
    if family.noise == "matrix":
        periodic = family.periodic or (False,) * n
        h = np.array(
            [(a[1] - a[0]) if p_ else (a[-1] - a[0]) / (len(a) - 1) for a, p_ in zip(axes, periodic, strict=True)]
        )
        b = np.array([[1.0, 0.0], [0.0, 1.0]]) * rng.uniform(0.1, 1, 2) + np.full((2, 2), rng.uniform(-1, 1))
        b[[0, 1], [0, 1]] = np.abs(b[0, 1]) + rng.choice([0.0, 1e-3, 1.0]) * rng.uniform(0.1, 1, 2)
        if rng.random() < 0.05:
            b[0, 0] = 0.5 * np.abs(b[0, 1])  # too little along one axis
            b[1, 1] = 4 * np.abs(b[0, 1])
        a = b * np.outer(h, h) * (strength / np.max(h)) ** 2
        sigma = np.linalg.cholesky(a + 1e-12 * np.diag(np.diag(a)))
        return sigma, np.tile(sigma @ sigma.T, (len(x), 1, 1))
    sigma = strength * rng.uniform(0.2, 1, n) * (rng.random(n) < 0.8)
    if family.noise == "diagonal":
        return sigma, np.tile(np.diag(sigma**2), (len(x), 1, 1))
    p["sigma"] = sigma
    here = sigma * (1.2 + np.sin(x @ p["turn"]))[:, None]
    return _bound(families.noise_of_state, p), np.einsum("si,ij->sij", here**2, np.eye(n))


def _ends(family, rng, p, x, axes, money):
    """The ingredients that end a path: for the package, and at the nodes."""
    ends, numbers = {}, {}
    if "rest" in family.ends:
        numbers["rest"] = np.all(np.abs(x) <= 1e-12 * np.ptp(x, axis=0), axis=1)
    if "target" in family.ends:
        ends, numbers = _target(family, rng, x, axes, money, numbers)
    for name, field in (("stop", "stopping_cost"), ("floor", "running_max")):
        if name in family.ends:
            lean = rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 2)
            shape = {"height": rng.normal() * money, "spot": rng.choice(axes[0]), "steep": lean * money}
            ends[field] = _bound(families.level, shape)
            numbers[name] = shape["height"] + np.abs(x[:, 0] - shape["spot"]) * shape["steep"]
    return ends, numbers


def _target(family, rng, x, axes, money, numbers):
    goal, group = np.array([rng.choice(axis) for axis in axes]), np.zeros(0)
    far = np.max(np.abs(x - goal), axis=1)
    inside = rng.choice(np.unique(far)[: max(2, len(np.unique(far)) // 3)])
    if rng.random() < 0.3:
        group = far[np.abs(far - inside) <= 1e-9 * np.max(far)]  # nodes stand on the boundary, all of them inside
        reach = np.max(group)
    else:
        beyond = far[far > inside * (1 + 1e-9) + 1e-12]
        reach = (inside + np.min(beyond)) / 2
    side = rng.choice([1.0, 1.0, -1.0])
    if side < 0 and reach == np.max(group, initial=-1):
        reach = np.min(group)
    if rng.random() < 0.03:
        side, reach = 1.0, -1.0
    shape = {"side": side, "goal": goal, "reach": reach}
    held = side * (far - reach) <= 0
    given = np.zeros(len(x))
    ends = {"target": _bound(families.target, shape)}
    if "exit" in family.ends:
        fee = {"height": rng.choice([0.0, 1.0, 10.0]) * rng.normal() * money, "spot": goal[0],
               "steep": rng.choice([0.0, 1.0]) * rng.normal() * money}  # fmt: skip
        ends["exit_cost"] = _bound(families.level, fee)
        given = fee["height"] + np.abs(x[:, 0] - fee["spot"]) * fee["steep"]
    return ends, numbers | {"held": held, "given": np.where(held, given, 0)}
