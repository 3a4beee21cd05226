"""Problems with exact answers that are hard for error estimates: jumps, corners, layers, ends, narrow features.

Each is a problem on one grid. Its exact value is a NumPy function of states, shape (k, n) -> (k,).
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hjbjax as hjb

Exact = Callable[[np.ndarray], np.ndarray]
DISC, SQUARE = hjb.Ball(1.0, 2), hjb.Box([-1.0, -1.0], [1.0, 1.0])
INF = np.inf


@dataclasses.dataclass(frozen=True)
class Known:
    """One problem, its grid and its exact value.

    Args:
      kind: the group in the table.
      name: within the group.
      problem: the problem.
      grid: its grid.
      exact: the exact value, (k, n) -> (k,).
      region: True where errors count, (k, n) -> bool (k,); None is the whole box.
      walls: the ends are part of the problem, so ``box_error`` does not belong to the estimate.
      horizon: of a march, of which V at time zero counts; None for ``solve``.
    """

    kind: str
    name: str
    problem: hjb.Problem
    grid: hjb.Grid
    exact: Exact
    region: Callable[[np.ndarray], np.ndarray] | None = None
    walls: bool = False
    horizon: float | None = None

    def solved(self) -> hjb.Solution:
        """The answer of the default solver."""
        if self.horizon is None:
            return hjb.solve(self.problem, self.grid, throw=False)
        return hjb.march(self.problem, self.grid, self.horizon, throw=False)


def plane(nodes: int, half: float = 1.0) -> hjb.Grid:
    """A square of nodes² nodes."""
    return hjb.Grid([-half, -half], [half, half], (nodes, nodes))


def line(lo: float, hi: float, nodes: int, **options: Any) -> hjb.Grid:
    """One axis."""
    return hjb.Grid([lo], [hi], (nodes,), **options)


def within(half: float) -> Callable[[np.ndarray], np.ndarray]:
    """The states with every coordinate at most ``half``."""
    return lambda x: np.max(np.abs(x), axis=1) <= half + 1e-9


def between(lo: float, hi: float) -> Callable[[np.ndarray], np.ndarray]:
    """The states with a first coordinate between two numbers."""
    return lambda x: (x[:, 0] >= lo - 1e-9) & (x[:, 0] <= hi + 1e-9)


# ------------------------------------------------------------------------------------------------------------ jumps


def disc_at(centre: tuple[float, ...], radius: float) -> Callable:
    """The signed distance to a disc."""
    return lambda x: jnp.sqrt(sum((x[i] - c) ** 2 for i, c in enumerate(centre)) + 1e-24) - radius


def box_at(centre: tuple[float, ...], half: tuple[float, ...]) -> Callable:
    """A level set of a box: the largest of |x_i − c_i| − r_i."""
    return lambda x: jnp.max(jnp.abs(x - jnp.array(centre)) - jnp.array(half))


def nearest(*levels: Callable) -> Callable:
    """The union of targets."""
    return lambda x: jnp.min(jnp.stack([level(x) for level in levels]))


def _hit_disc(x: np.ndarray, way: np.ndarray, centre: tuple[float, float], radius: float) -> np.ndarray:
    """The time until a straight path of unit speed meets a disc."""
    off = np.array(centre) - x
    along = off @ way
    root = radius**2 + 1e-9 - (np.sum(off**2, axis=1) - along**2)
    first = along - np.sqrt(np.maximum(root, 0))
    inside = np.sum(off**2, axis=1) <= radius**2 + 1e-9
    return np.where(inside, 0.0, np.where((root > 0) & (first >= 0), first, INF))


def _hit_box(x: np.ndarray, way: np.ndarray, centre: tuple[float, float], half: tuple[float, float]) -> np.ndarray:
    """The time until a straight path of unit speed meets a box."""
    sides = [(np.array(centre) - x + sign * np.array(half)) / way for sign in (-1, 1)]
    enter, leave = np.minimum(*sides).max(axis=1), np.maximum(*sides).min(axis=1)
    return np.where((enter <= leave) & (leave >= 0), np.maximum(enter, 0), INF)


def past(angle: float, level: Callable, hit: Callable, name: str, nodes: int, discount: float = 1.0) -> Known:
    """A flow without control that pays 5 if it meets a target, and nothing if it passes the target."""
    way = np.array([np.cos(angle), np.sin(angle)])
    problem = hjb.Problem(lambda x, u: jnp.asarray(way) + 0 * x, None, discount=discount, target=level, exit_cost=5.0)
    return Known("jump", name, problem, plane(nodes), lambda x: 5 * np.exp(-discount * hit(x, way)))


def circling(nodes: int, centre: float, radius: float, discount: float) -> Known:
    """A rotation; some of its circles meet a disc and some do not."""
    problem = hjb.Problem(
        lambda x, u: jnp.stack([-x[1], x[0]]), None, discount=discount, target=disc_at((centre, 0.0), radius),
        exit_cost=1.0,
    )  # fmt: skip

    def exact(x: np.ndarray) -> np.ndarray:
        from_origin, angle = np.hypot(x[:, 0], x[:, 1]), np.arctan2(x[:, 1], x[:, 0])
        with np.errstate(divide="ignore", invalid="ignore"):
            cosine = (from_origin**2 + centre**2 - radius**2 - 1e-9) / (2 * from_origin * centre)
        opening = np.arccos(np.clip(np.nan_to_num(cosine, nan=INF), -1, 1))
        wait = np.mod(-opening - angle, 2 * np.pi)
        wait = np.where(np.abs(angle) <= opening, 0.0, wait)
        return np.where(cosine < 1, np.exp(-discount * wait), 0.0)

    return Known(
        "jump", f"rotation past a disc, discount {discount:g}", problem, plane(nodes), exact,
        lambda x: np.hypot(x[:, 0], x[:, 1]) < 0.95,
    )  # fmt: skip


def jumps() -> list[Known]:
    """V is discontinuous along a path that touches the target."""
    first, second = ((0.0, 0.0), 0.3), ((0.4, -0.55), 0.2)
    both = lambda x, way: np.minimum(_hit_disc(x, way, *first), _hit_disc(x, way, *second))  # noqa: E731
    block = ((0.3, -0.2), (0.33, 0.21))
    return [
        past(0.3, disc_at(*first), lambda x, w: _hit_disc(x, w, *first), "flow past a disc", 41),
        past(-0.8, disc_at(*first), lambda x, w: _hit_disc(x, w, *first), "flow past a disc, discount 3", 61, 3.0),
        past(0.3, nearest(disc_at(*first), disc_at(*second)), both, "flow past two discs", 41),
        past(2.0, box_at(*block), lambda x, w: _hit_box(x, w, *block), "flow past a box", 41),
        circling(41, 0.55, 0.2, 0.5),
        circling(61, 0.5, 0.3, 1.0),
    ]


# ---------------------------------------------------------------------------------------------------------- corners


def outside_box(x: np.ndarray, centre: Any, half: Any) -> np.ndarray:
    """How far each coordinate lies outside of a box, (k, n)."""
    return np.maximum(np.abs(x - np.array(centre)) - np.array(half), 0)


def to(name: str, level: Callable, exact: Exact, grid: hjb.Grid, controls: Any = DISC, **options: Any) -> Known:
    """The shortest time to a target at unit speed."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: 1.0, controls, target=level, **options)
    return Known("eikonal", name, problem, grid, exact)


def corners() -> list[Known]:
    """Distances to targets with corners, to small targets and to several targets."""
    block, ell = ((0.3, -0.2), (0.33, 0.21)), (((-0.2, 0.1), (0.43, 0.17)), ((0.1, -0.2), (0.13, 0.47)))
    round_, other = ((0.37, -0.21), 0.26), ((-0.5, 0.45), 0.17)
    cube = ((0.1, 0.2, -0.1), (0.35, 0.25, 0.3))
    norm, largest = (lambda v: np.sqrt(np.sum(v**2, axis=1))), (lambda v: np.max(v, axis=1))
    to_disc = lambda x, disc: np.maximum(norm(x - np.array(disc[0])) - disc[1], 0)  # noqa: E731
    rim = np.stack([np.cos(np.linspace(0, 2 * np.pi, 2000)), np.sin(np.linspace(0, 2 * np.pi, 2000))], axis=1)

    def squarely(x: np.ndarray) -> np.ndarray:  # the smallest maximum-norm distance to the disc
        points = np.array(round_[0]) + round_[1] * rim
        found = np.min(np.max(np.abs(x[:, None] - points), axis=2), axis=1)
        return np.where(norm(x - np.array(round_[0])) <= round_[1], 0, found)

    ells = lambda x: np.minimum(norm(outside_box(x, *ell[0])), norm(outside_box(x, *ell[1])))  # noqa: E731
    solid = hjb.Grid([-1.0] * 3, [1.0] * 3, (21,) * 3)
    to_ball = lambda x: np.maximum(norm(x - np.array([0.1, 0.0, -0.2])) - 0.35, 0)  # noqa: E731
    point = disc_at((0.0, 0.0), 1e-6)
    return [
        to("box", box_at(*block), lambda x: norm(outside_box(x, *block)), plane(41)),
        to("box, 81 nodes", box_at(*block), lambda x: norm(outside_box(x, *block)), plane(81)),
        to("box by a box of controls", box_at(*block), lambda x: largest(outside_box(x, *block)), plane(41), SQUARE),
        to("L-shape", nearest(*(box_at(*each) for each in ell)), ells, plane(41)),
        to("two discs", nearest(disc_at(*round_), disc_at(*other)),
           lambda x: np.minimum(to_disc(x, round_), to_disc(x, other)), plane(41)),
        to("disc off the centre", disc_at(*round_), lambda x: to_disc(x, round_), plane(41)),
        to("disc by a box of controls", disc_at(*round_), squarely, plane(41), SQUARE),
        to("disc, discounted", disc_at(*round_), lambda x: -np.expm1(-2 * to_disc(x, round_)) / 2, plane(41), DISC,
           discount=2.0),
        to("box, discounted", box_at(*block), lambda x: -np.expm1(-norm(outside_box(x, *block))), plane(51), DISC,
           discount=1.0),
        to("a point", point, norm, plane(41)),
        to("a point by a box of controls", point, lambda x: largest(np.abs(x)), plane(41), SQUARE),
        to("a point, discounted", point, lambda x: -np.expm1(-norm(x)), plane(61), DISC, discount=1.0),
        to("ball in three dimensions", disc_at((0.1, 0.0, -0.2), 0.35), to_ball, solid, hjb.Ball(1.0, 3)),
        to("box in three dimensions", box_at(*cube), lambda x: norm(outside_box(x, *cube)), solid, hjb.Ball(1.0, 3)),
        to("disc on stretched axes", disc_at(*round_), lambda x: to_disc(x, round_),
           hjb.Grid([-1.0, -1.0], [1.0, 1.0], (41, 51), stretch=(hjb.Sinh(2.0, 0.3), None))),
    ]  # fmt: skip


# ----------------------------------------------------------------------------------------------------- lost targets


def arrival(x: np.ndarray) -> np.ndarray:
    """The least time of the double integrator to the origin."""
    side = np.where(x[:, 0] > -0.5 * x[:, 1] * np.abs(x[:, 1]), 1.0, -1.0)
    return side * x[:, 1] + np.sqrt(np.maximum(4 * side * x[:, 0] + 2 * x[:, 1] ** 2, 0))


def pushed(shape: tuple[int, int], speed: float, radius: float, discount: float) -> Known:
    """The double integrator to the origin, or to a disc of a few cells."""
    problem = hjb.Problem(
        lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), discount=discount,
        target=disc_at((0.0, 0.0), radius),
    )  # fmt: skip
    exact = (lambda x: -np.expm1(-discount * arrival(x)) / discount) if discount else arrival
    name = f"{' x '.join(map(str, shape))}{', discounted' if discount else ''}"
    inside = lambda x: (np.abs(x[:, 0]) <= 0.5) & (np.abs(x[:, 1]) <= 0.75)  # noqa: E731
    return Known("to the origin", name, problem, hjb.Grid([-1.0, -speed], [1.0, speed], shape), exact, inside)


def lost_targets() -> list[Known]:
    """Targets of one node, which the coarser grid may lose."""
    shapes = ((31, 121), (41, 41), (61, 81), (51, 51))
    cases = [pushed(shape, 1.5, 1e-6, 1.0) for shape in shapes]
    return [*cases, *(pushed(shape, 1.5, 1e-6, 0.0) for shape in ((31, 31), (61, 61), (41, 81)))]


# ------------------------------------------------------------------------------------------------- ends and layers


def reflected(drift: float, noise: float, discount: float, nodes: int, walls: bool = True) -> Known:
    """dx = −b dt + σ dw between reflecting walls, cost −x: V = −x/ρ + b/ρ² + A e^(m₁ x) + B e^(m₂ (x − 1))."""
    problem = hjb.Problem(lambda x, u: 0 * x - drift, lambda x, u: -x[0], noise=noise, discount=discount)
    root = math.sqrt(drift**2 + 2 * discount * noise**2)
    up, down = (drift + root) / noise**2, (drift - root) / noise**2
    matrix = [[down, up * math.exp(-up)], [down * math.exp(down), up]]
    first, second = np.linalg.solve(np.array(matrix), np.full(2, 1 / discount))

    def exact(x: np.ndarray) -> np.ndarray:
        wave = first * np.exp(down * x[:, 0]) + second * np.exp(up * (x[:, 0] - 1))
        return -x[:, 0] / discount + drift / discount**2 + wave

    return Known("layer", f"b {drift:g}, s {noise:g}, {nodes} nodes", problem, line(0, 1, nodes), exact, walls=walls)


def hitting(noise: float, nodes: int) -> Known:
    """The least mean time to the origin, with noise that a wall at 1 reflects."""
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), noise=noise, target=lambda x: x[0]
    )  # fmt: skip
    rate = 2 / noise**2
    exact = lambda x: x[:, 0] - (np.exp(-rate * (1 - x[:, 0])) - np.exp(-rate)) / rate  # noqa: E731
    return Known("layer", f"hitting time, s {noise:g}", problem, line(0, 1, nodes), exact, walls=True)


def geometric(nodes: int, kind: str) -> Known:
    """Geometric Brownian motion, cost −x: V = −x/ρ."""
    problem = hjb.Problem(lambda x, u: 0 * x, lambda x, u: -x[0], noise=lambda x, u: 0.2 * x, discount=0.02)
    return Known(
        "ends", f"geometric Brownian motion, {kind}", problem, line(0, 1, nodes, edges=kind), lambda x: -x[:, 0] / 0.02
    )


def firm() -> Known:
    """A firm invests: V = −(q k + c)."""
    problem = hjb.Problem(
        lambda k, i: i - 0.1 * k, lambda k, i: -(0.2 * k[0] - i[0] - 0.5 * i[0] ** 2), hjb.Box([-5.0], [5.0]),
        discount=0.05,
    )  # fmt: skip
    return Known("ends", "firm with investment", problem, line(0, 5, 101), lambda x: -(x[:, 0] * 4 / 3 + 10 / 9))


def exponential(nodes: int, kind: str) -> Known:
    """A present value that grows like an exponential."""
    problem = hjb.Problem(lambda y, u: 0 * y - 0.01125, lambda y, u: jnp.exp(y[0]), noise=0.25, discount=0.06)
    return Known(
        "ends", f"exponential, {kind}", problem, line(-3, 3, nodes, edges=kind), lambda x: np.exp(x[:, 0]) / 0.04
    )


def default(nodes: int, logs: bool) -> Known:
    """Leland's equity with endogenous default: assets pay δA − c until the owners stop."""
    r, pays, sigma, coupon = 0.06, 0.03, 0.25, 0.05
    drift = r - pays - sigma**2 / 2
    gamma = (drift + math.sqrt(drift**2 + 2 * r * sigma**2)) / sigma**2
    barrier = gamma / (1 + gamma) * coupon / r

    def exact(x: np.ndarray) -> np.ndarray:
        assets = np.exp(x[:, 0]) if logs else x[:, 0]
        equity = assets - coupon / r + (coupon / r - barrier) * (np.maximum(assets, 1e-9) / barrier) ** -gamma
        return -np.where(assets > barrier, equity, 0)

    if logs:
        problem = hjb.Problem(
            lambda y, u: 0 * y + drift, lambda y, u: coupon - pays * jnp.exp(y[0]), noise=sigma, discount=r,
            stopping_cost=lambda y: 0.0,
        )  # fmt: skip
        grid = line(math.log(0.1), math.log(8.0), nodes, edges="open")
        return Known("ends", "Leland's equity in logs", problem, grid, exact, between(-INF, math.log(3.0)))
    problem = hjb.Problem(
        lambda a, u: (r - pays) * a, lambda a, u: coupon - pays * a[0], noise=lambda a, u: sigma * a, discount=r,
        stopping_cost=lambda a: 0.0,
    )  # fmt: skip
    return Known("ends", "Leland's equity", problem, line(0, 6, nodes, edges="open"), exact, between(0, 3))


def put(nodes: int, logs: bool) -> Known:
    """The perpetual American put, K = 1, r = 0.05, σ = 0.3."""
    r, sigma = 0.05, 0.3
    power = 2 * r / sigma**2
    best = power / (1 + power)

    def exact(x: np.ndarray) -> np.ndarray:
        s = np.exp(x[:, 0]) if logs else x[:, 0]
        return -np.where(s < best, 1 - s, (1 - best) * (np.maximum(s, best) / best) ** -power)

    if logs:
        problem = hjb.Problem(
            lambda y, u: 0 * y + r - sigma**2 / 2, None, noise=sigma, discount=r,
            stopping_cost=lambda y: jnp.minimum(jnp.exp(y[0]) - 1, 0.0),
        )  # fmt: skip
        return Known("ends", "perpetual put in logs", problem, line(-2, 4, nodes), exact, between(-2, 1))
    problem = hjb.Problem(
        lambda s, u: r * s, None, noise=lambda s, u: sigma * s, discount=r,
        stopping_cost=lambda s: jnp.minimum(s[0] - 1, 0.0),
    )  # fmt: skip
    return Known("ends", "perpetual put", problem, line(0, 6, nodes), exact, between(0, 2))


def merton_levels(nodes: int, kind: str) -> Known:
    """Merton's problem in the level of wealth, γ = 2: V = 493.827/w."""
    r, mu, sigma, rho = 0.03, 0.07, 0.2, 0.05
    problem = hjb.Problem(
        lambda w, u: w * (r + u[0] * (mu - r) - u[1]), lambda w, u: 1 / (u[1] * w[0]), hjb.Box([0.0, 0.02], [1.0, 0.2]),
        noise=lambda w, u: u[0] * sigma * w, discount=rho,
    )  # fmt: skip
    return Known(
        "ends", f"Merton in levels, {kind}", problem, line(0.5, 2.5, nodes, edges=kind),
        lambda x: 493.8271605 / x[:, 0], between(0.8, 2.0),
    )  # fmt: skip


def ends() -> list[Known]:
    """Reflecting walls and open ends, most of them with noise."""
    return [
        *(reflected(0.01, 0.01, 0.05, nodes) for nodes in (26, 51, 101)),
        reflected(0.05, 0.05, 0.1, 41),
        reflected(0.02, 0.05, 0.1, 51),
        reflected(0.0, 0.2, 0.02, 41),
        reflected(0.1, 0.1, 1.0, 41),
        hitting(0.5, 41),
        hitting(0.2, 41),
        geometric(101, "projected"),
        geometric(101, "open"),
        firm(),
        exponential(101, "open"),
        exponential(101, "linear"),
        default(121, True),
        default(121, False),
        put(121, True),
        put(81, False),
        merton_levels(81, "open"),
        merton_levels(81, "projected"),
    ]


# --------------------------------------------------------------------------------------------------- two-node axes


def income(nodes: int, rate: float, square: bool, back: float = 1.0) -> Known:
    """A state that follows a two-state income chain z, dx = (z − x) dt, cost x² or −x.

    V = a x² + b(z) x + c(z), where a, b and c solve a small linear system.
    """
    discount, z = 0.1, np.array([0.0, 1.0])
    up, down = rate, rate * back
    cost = (lambda x, u: x[0] ** 2) if square else (lambda x, u: -x[0])
    problem = hjb.Problem(
        lambda x, u: jnp.stack([x[1] - x[0], up * (1 - x[1]) - down * x[1]]), cost, discount=discount
    )  # fmt: skip
    chain = np.array([[-up, up], [down, -down]])
    a = 1 / (discount + 2) if square else 0.0
    source = 2 * a * z if square else np.full(2, -1.0)
    b = np.linalg.solve((discount + 1) * np.eye(2) - chain, source)
    c = np.linalg.solve(discount * np.eye(2) - chain, b * z)

    def exact(x: np.ndarray) -> np.ndarray:
        state = (x[:, 1] > 0.5).astype(int)
        return a * x[:, 0] ** 2 + b[state] * x[:, 0] + c[state]

    name = f"income, rate {rate:g} and {down:g}, cost {'x²' if square else '−x'}"
    return Known("two nodes", name, problem, hjb.Grid([0.0, 0.0], [1.0, 1.0], (nodes, 2)), exact, walls=True)


def two_nodes() -> list[Known]:
    """An axis of two nodes is a chain of two states."""
    return [income(41, 0.3, True), income(41, 0.3, False), income(61, 2.0, True), income(41, 0.1, True, 5.0)]


# ------------------------------------------------------------------------------------------------------- the others


def ornstein(power: int, nodes: int, noise: float = 0.5, **options: Any) -> Known:
    """An Ornstein–Uhlenbeck process between open ends, cost x² or x⁴."""
    theta, discount = 1.0, 0.5
    problem = hjb.Problem(lambda x, u: -theta * x, lambda x, u: x[0] ** power, noise=noise, discount=discount)
    a = 1 / (discount + power * theta)
    b = 6 * noise**2 * a / (discount + 2 * theta) if power == 4 else a
    c = noise**2 * b / discount

    def exact(x: np.ndarray) -> np.ndarray:
        return (a * x[:, 0] ** 4 if power == 4 else 0) + b * x[:, 0] ** 2 + c

    name = f"Ornstein–Uhlenbeck, cost x^{power}{', stretched' if options else ''}"
    return Known("smooth", name, problem, line(-2, 2, nodes, edges="open", **options), exact, within(1.0))


def drifting(drift: float, nodes: int, radius: float = 0.2) -> Known:
    """Minimum time on a line with constant drift."""
    problem = hjb.Problem(
        lambda x, u: u + drift, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), target=lambda x: jnp.abs(x[0]) - radius
    )  # fmt: skip
    exact = lambda x: np.maximum(np.abs(x[:, 0]) - radius, 0) / (1 - drift * np.sign(x[:, 0]))  # noqa: E731
    return Known("kink", f"minimum time with drift {drift:g}", problem, line(-1, 1, nodes), exact)


def swirl(noise: float) -> Known:
    """A fast rotation with noise and a quadratic V, prescribed at the boundary."""
    discount = 1.0
    flow = np.array([[0.0, 3.0], [-3.0, -1.0]])
    quadratic = np.array([[1.0, 0.15], [0.15, 1.0]])

    def value(x: Any) -> Any:
        return x[0] ** 2 + 0.3 * x[0] * x[1] + x[1] ** 2

    def cost(x: Any, u: Any) -> Any:
        slope = 2 * jnp.asarray(quadratic) @ x
        rest = discount * value(x) - (jnp.asarray(flow) @ x) @ slope + 0.25 * slope @ slope
        return rest - noise**2 * quadratic[1, 1] + u @ u

    problem = hjb.Problem(
        lambda x, u: jnp.asarray(flow) @ x + u, cost, hjb.Box([-4.0] * 2, [4.0] * 2), noise=jnp.array([0.0, noise]),
        discount=discount, target=lambda x: 1 - 1e-9 - jnp.max(jnp.abs(x)), exit_cost=value,
    )  # fmt: skip
    return Known("smooth", "rotation with noise", problem, plane(41), lambda x: value(x.T))


def exit_from(name: str, noise: float, nodes: int) -> Known:
    """The mean time of Brownian motion to leave a square, by its series."""
    problem = hjb.Problem(
        lambda x, u: 0 * x, lambda x, u: 1.0, noise=noise, target=lambda x: 1 - 1e-9 - jnp.max(jnp.abs(x))
    )  # fmt: skip

    def exact(x: np.ndarray) -> np.ndarray:
        total = 1 - x[:, 0] ** 2
        for k in range(1, 80, 2):
            wave = np.cos(k * np.pi * x[:, 0] / 2) * np.cosh(k * np.pi * x[:, 1] / 2) / np.cosh(k * np.pi / 2)
            total = total - 32 / (k * np.pi) ** 3 * (-1) ** ((k - 1) // 2) * wave
        return total / noise**2

    return Known("smooth", name, problem, plane(nodes), exact)


def bent(nodes: int, discount: float) -> Known:
    """ẋ = −x without control, cost |x|: V = |x|/(1 + λ), whose kink lies between the nodes."""
    problem = hjb.Problem(lambda x, u: 0.13 - x, lambda x, u: jnp.abs(x[0] - 0.13), discount=discount)
    return Known(
        "kink", f"a kink between the nodes, discount {discount:g}", problem, line(-1, 1, nodes),
        lambda x: np.abs(x[:, 0] - 0.13) / (1 + discount),
    )  # fmt: skip


def others() -> list[Known]:
    """Smooth values and kinks on lines and planes."""
    return [
        ornstein(2, 41),
        ornstein(4, 41),
        ornstein(4, 41, stretch=(hjb.Sinh(2.0, 0.5),)),
        drifting(0.5, 41),
        drifting(-0.3, 61, 0.23),
        swirl(0.1),
        exit_from("exit from a square", 1.0, 41),
        bent(41, 0.5),
        bent(42, 2.0),
    ]


# ---------------------------------------------------------------------------------------------------------- marches


def marches() -> list[Known]:
    """Marches, compared at time zero."""
    obstacle = lambda t, x: jnp.abs(x[0] + 3.0 - 2.0 * t) - 0.5  # noqa: E731
    evading = hjb.avoid(lambda t, x, u: u, hjb.Box([-1.0], [1.0]), obstacle, time_dependent=True)
    times = np.linspace(0, 2, 201)

    def nearest_approach(x: np.ndarray) -> np.ndarray:  # optimal is full speed to one side, starting at any time
        ways = [np.min(np.abs(x[:, :1] + side * times + 3 - 2 * times) - 0.5, axis=1) for side in (-1, 1)]
        return -np.maximum(*ways)

    lax = hjb.Problem(
        lambda x, u: u, lambda x, u: 0.5 * u @ u, hjb.Box([-3.0] * 2, [3.0] * 2), terminal_cost=lambda x: 0.5 * x @ x
    )  # fmt: skip
    hopf = hjb.Problem(
        lambda x, u: u, lambda x, u: 0.5 * u @ u, hjb.Box([-4.0], [4.0]), noise=1.0,
        terminal_cost=lambda x: 0.5 * x @ x,
    )  # fmt: skip
    american = hjb.Problem(
        lambda y, u: 0 * y + 0.06 - 0.02, None, noise=0.2, discount=0.06,
        stopping_cost=lambda y: jnp.minimum(jnp.exp(y[0]) - 1, 0.0),
    )  # fmt: skip
    riccati = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-5.0], [5.0]))
    heat = hjb.Problem(lambda x, u: 0 * x, None, noise=0.7, terminal_cost=lambda x: jnp.cos(2 * x[0]))
    front = hjb.Problem(lambda x, u: 0 * x + 1, None, terminal_cost=lambda x: jnp.where(x[0] > 0.123, 1.0, 0.0))
    waiting = hjb.Problem(
        lambda t, x, u: 0 * x, lambda t, x, u: jnp.sin(3 * t) * (1 + x[0] ** 2), discount=2.0, time_dependent=True
    )
    paid = (3 - math.exp(-2) * (2 * math.sin(3) + 3 * math.cos(3))) / 13  # ∫ sin(3 t) e^(−2 t) dt from 0 to 1
    return [
        *(Known("march", f"Riccati, {count} nodes", riccati, line(-2, 2, count),
                lambda x: math.tanh(1) * x[:, 0] ** 2, horizon=1.0) for count in (21, 41)),
        Known("march", "heat on a circle", heat, line(-math.pi, math.pi, 20, periodic=(True,)),
              lambda x: np.cos(2 * x[:, 0]) * math.exp(-0.98), horizon=1.0),
        Known("march", "a front", front, line(-2, 2, 81, edges="open"),
              lambda x: np.where(x[:, 0] > -0.877, 1.0, 0.0), horizon=1.0),
        Known("march", "cost of the time", waiting, line(-1, 1, 41), lambda x: paid * (1 + x[:, 0] ** 2), horizon=1.0),
        Known("march", "moving obstacle", evading, line(-6, 2, 81), nearest_approach, None, horizon=2.0),
        Known("march", "Hopf–Lax", lax, plane(31, 2.0), lambda x: np.sum(x**2, axis=1) / 4, within(1.0), horizon=1.0),
        Known("march", "Cole–Hopf", hopf, line(-4, 4, 81, edges="open"),
              lambda x: x[:, 0] ** 2 / 4 + 0.5 * math.log(2), within(2.0), horizon=1.0),
        Known("march", "American put at the money", american, line(-1, 1, 81),
              lambda x: np.full(len(x), -2.31958 / 40), lambda x: np.abs(x[:, 0]) < 1e-9, horizon=1.0),
    ]  # fmt: skip


def one_way(nodes: int, place: float, costs: tuple[float, float], speeds: tuple[float, float]) -> Known:
    """x' = s > 0 until x = 1, discount ½; cost and speed jump at a fraction of the link up from the node near 0.1."""
    jump, discount = 0.1 + place * 2 / (nodes - 1), 0.5

    def exact(x: np.ndarray) -> np.ndarray:
        first = np.maximum(jump - x[:, 0], 0) / speeds[0]
        second = (1 - np.maximum(x[:, 0], jump)) / speeds[1]
        late = costs[1] * -np.expm1(-discount * second) / discount
        return costs[0] * -np.expm1(-discount * first) / discount + np.exp(-discount * first) * late

    problem = hjb.Problem(
        lambda x, u: jnp.where(x > jump, speeds[1], speeds[0]) + 0 * u,
        lambda x, u: jnp.where(x[0] > jump, costs[1], costs[0]),
        hjb.Box([-1.0], [1.0]),
        discount=discount,
        target=lambda x: 1 - x[0] - 1e-9,
    )
    return Known("cost jump", f"costs {costs}, speeds {speeds}, at {place}", problem, line(-1, 1, nodes), exact)


def between_nodes(shape: tuple[int, ...], centre: tuple[float, ...], wind: float) -> Known:
    """V = −2 Π cos 3(x − c) with |u| ≤ 1, discount 0.12: paths rest at minima of V, where L/β is lowest by far."""
    speed, weight, discount, n = 1.7, 0.5, 0.12, len(shape)

    def value(x: Any) -> Any:
        return -2 * jnp.prod(jnp.cos(3 * (x - np.array(centre))))

    def cost(x: Any, u: Any) -> Any:
        slope = jax.grad(value)(x)
        best = jnp.clip(-speed * slope / (2 * weight), -1, 1)
        least = jnp.sum(speed * best * slope + weight * best**2)
        return discount * value(x) - wind * jnp.cos(x) @ slope - least + weight * u @ u

    problem = hjb.Problem(
        lambda x, u: wind * jnp.cos(x) + speed * u, cost, hjb.Box([-1.0] * n, [1.0] * n), discount=discount
    )
    grid = hjb.Grid([0.0] * n, [2 * np.pi] * n, shape, periodic=(True,) * n)

    def exact(x: np.ndarray) -> np.ndarray:
        return -2 * np.prod(np.cos(3 * (x - np.array(centre))), axis=1)

    return Known("rest", f"c = {centre}, wind {wind}", problem, grid, exact)


def unresolved() -> list[Known]:
    """Jumps of cost and speed, and narrow minima of the cost, between nodes."""
    pairs = [((0.3, 2.0), (1.0, 1.0)), ((2.0, 0.3), (1.0, 1.0)), ((1.0, 1.0), (1.0, 2.0))]
    found = [one_way(nodes, place, *pair) for pair in pairs for nodes in (41, 161) for place in (0.02, 0.6, 0.98)]
    centres = [(0.03,), (0.05,), (0.079,)]
    found += [between_nodes((nodes,), centre, wind) for centre in centres for nodes in (40, 80) for wind in (0.0, 0.3)]
    return [*found, between_nodes((40, 36), (0.03, 0.05), 0.3)]


def problems() -> list[Known]:
    """The problems of all groups."""
    return [*jumps(), *corners(), *lost_targets(), *ends(), *two_nodes(), *others(), *unresolved(), *marches()]
