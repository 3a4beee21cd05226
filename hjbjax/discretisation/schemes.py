"""Discretisations of the derivatives, as values, and how to write one of your own.

A scheme says what slopes the drift sees. A class derived from ``Scheme`` defines them: ``march`` steps with its slopes,
and ``solve`` starts from the answer of its monotone ``chain`` and drives the residual with the new slopes to zero. A
second-order scheme that limits slopes by minmod, on equal spacings:

    >>> import dataclasses
    >>> import jax.numpy as jnp
    >>> import hjbjax as hjb
    >>> from hjbjax.discretisation import stencil
    >>> from hjbjax.discretisation.schemes import Chain, Scheme
    >>> @dataclasses.dataclass(frozen=True)
    ... class Minmod(Scheme):
    ...     even, points, chain = True, 3, hjb.Upwind()
    ...
    ...     def slopes(self, around):
    ...         def least(a, b):
    ...             return jnp.where(a * b > 0, jnp.where(jnp.abs(a) < jnp.abs(b), a, b), 0)
    ...
    ...         grid, found = around.on.grid, []
    ...         for axis, (up, down) in enumerate(around.one_sided):
    ...             bend = up - down
    ...             above, below = (stencil.neighbour(bend, grid, stencil.unit(grid, axis, s)) for s in (1, -1))
    ...             up, down = up - least(bend, above) / 2, down + least(bend, below) / 2
    ...             found.append(stencil.stopped(up, down, grid, axis))
    ...         return found
    >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-4.0], [4.0]))
    >>> grid = hjb.Grid([-2.0], [2.0], (41,))
    >>> for scheme in (hjb.Upwind(), Minmod()):
    ...     print(round(float(hjb.march(problem, grid, 1.0, scheme=scheme).value_at(0.0, [1.0])), 3))
    0.785
    0.762

The exact value is tanh 1 = 0.762. A monotone scheme derives from ``Chain`` and says how much diffusion e it has along
an axis, and where the gain of a drift component has kinks; its answers are certified. The Lax–Friedrichs scheme:

    >>> @dataclasses.dataclass(frozen=True)
    ... class LaxFriedrichs(Chain):
    ...     speed: float
    ...     even = True
    ...
    ...     def excess(self, f, a, link):
    ...         return a + self.speed * link.up + 0 * f
    ...
    ...     def kinks(self, a, slopes, link):
    ...         return (), (sum(slopes) / 2,)  # central differences, whatever the drift
    >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-2.0], [2.0]), discount=1.0)
    >>> solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (201,)), scheme=LaxFriedrichs(2.0))
    >>> solution.status.name, round(float(solution.value_at([0.5])), 2)
    ('CONVERGED', 0.17)

The exact value is (√5 − 1)/8 = 0.155; the difference is the price of so much diffusion. There must be enough of it,
e ≥ max(a, h⁺f, −h⁻f), here a ``speed`` of at least |f|: a probability cannot be negative, so with less diffusion the
chain would carry only part of the drift, which is refused. The class must be hashable, since compiled programs are
cached by it, and its methods are traced, so they must not branch on numbers. Under ``jit``, ``vmap`` and ``grad`` a
solve needs a monotone scheme, and checks no values.

A scheme that follows paths over many cells instead of using slopes is of another kind: see ``semi_lagrangian``.

The treatment of walls does not depend on the scheme. A wall stands on a node, whose cell is half a cell. With noise a,
drift n out of the box (f at an upper end, −f at a lower one) and ∂V/∂n = 0 on the wall, the balance over that cell is

    (h/2)(βV − L) = −(a/2h − n/2)(V_N − V_{N−1}),      so that the chain leaves inwards at the rate (a − h n)/h²:

the mirrored neighbour V_{N+1} = V_{N−1}, a/h² (V_{N−1} − V_N), and the drift on the inner difference. In V the drift
matters little, O(h) at one node and so O(h²), whichever way it is taken. In the law of the chain outward drift has to
hold noise back as inward drift helps it: then p_N/p_{N−1} = (a + h n)/(a − h n), as between two nodes inside. A chain
takes (e(n⁺) − h n)/h², with e for as much of the drift as leaves: never negative, |n|/h for n < 0 without noise, and
zero for n > 0, which is cut off.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.discretisation import correlated_noise, slopes, stencil
from hjbjax.discretisation.discretisation import Chain, Differences, Discretisation, Scheme
from hjbjax.discretisation.semi_lagrangian import PathScheme
from hjbjax.discretisation.stencil import Links
from hjbjax.problem import arguments, sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass

Slopes = Sequence[tuple[jax.Array, jax.Array]]
ROUNDING = 64  # units of eps of what is wanted, by which the diffusion of a chain may fall short


def weights(scheme: Chain, f: Any, a: Any, link: Links, grid: Grid, axis: int) -> tuple[Any, Any]:
    """The weights w⁺, w⁻ of the gain w⁺ D⁺ − w⁻ D⁻ of drift f and noise a (None: none) along an axis, not negative.

    (e + h⁻ f)/(h⁺ + h⁻) and (e − h⁺ f)/(h⁺ + h⁻), at a wall over h; the chain jumps at the rates w⁺/h⁺ and w⁻/h⁻. What
    leads across a wall has no meaning: the difference is zero there.
    """
    if a is None and scheme.one_way:  # the same numbers, without a difference
        return jnp.maximum(f, 0), jnp.maximum(-f, 0)
    a = 0 if a is None else jnp.maximum(a, 0)  # correlated noise may leave a rounding error below zero
    leaving, span = f, link.up + link.down
    if stencil.has_walls(grid, axis):  # the link beyond is the mirror image of the one inside
        lower, upper = stencil.wall(grid, axis, -1), stencil.wall(grid, axis, 1)
        leaving = jnp.where(upper, jnp.maximum(f, 0), jnp.where(lower, jnp.minimum(f, 0), f))
        span = jnp.where(upper | lower, link.up, span)
    e = scheme.excess(leaving, a, link)
    # e = h⁺ f in exact arithmetic may be a rounding below it: a rate of −1e-17 is a negative probability
    return jnp.maximum(e + link.down * f, 0) / span, jnp.maximum(e - link.up * f, 0) / span


def falls_short(scheme: Chain, f: Any, a: Any, link: Links) -> Any:
    """Where e is less than max(a, h⁺ f, −h⁻ f) by more than rounding, bool: there ``weights`` cuts the drift down."""
    a = jnp.zeros(()) if a is None else jnp.maximum(a, 0)
    e, wanted = scheme.excess(f, a, link), jnp.maximum(a, jnp.maximum(link.up * f, -link.down * f))
    return wanted - e > ROUNDING * jnp.finfo(jnp.result_type(wanted)).eps * wanted


def kinks(
    scheme: Chain, a: Any, slopes: tuple[Any, Any], link: Links, grid: Grid, axis: int
) -> tuple[Sequence[Any], Sequence[Any]]:
    """The drifts at which the derivative of the gain of ``weights`` jumps, and its derivatives: one more."""
    found, derivatives = scheme.kinks(a, slopes, link)
    if not stencil.has_walls(grid, axis):
        return found, derivatives
    wall = stencil.walls(grid, axis)
    # over half a cell twice the derivative where drift leaves, the inner difference where it does not: the lesser,
    # since e rises by at most h n
    inner = slopes[0] + slopes[1]
    # by identity: two pieces with one derivative keep one, which says that there is no kink between them
    made = {id(d): jnp.where(wall, jnp.where(jnp.abs(2 * d) > jnp.abs(inner), inner, 2 * d), d) for d in derivatives}
    return found, [made[id(d)] for d in derivatives]


def check(scheme: Any, name: str, grid: Grid, *, stationary: bool = False, paths: bool = False) -> None:
    """Refuse what is no scheme, none for stationary problems, or none for the grid's spacings.

    With ``paths`` a scheme that follows paths will do as well.

    Raises:
      TypeError: another kind of thing.
      ValueError: a stretched grid where the scheme wants equal spacings.
    """
    hashable = type(scheme).__hash__ is not None
    if paths and hashable and not isinstance(scheme, type) and isinstance(scheme, PathScheme):
        return
    if not (hashable and isinstance(scheme, Scheme)) or (stationary and not scheme.stationary):
        others = "Eno2() " * (not stationary) + "SemiLagrangian() " * paths
        offered = f"hjb.Upwind(), Limited(), {others}or Weno5()"
        own = "one of your own, derived from hjbjax.discretisation.schemes.Scheme"
        raise TypeError(f"{name} is {arguments.shown(scheme)}; wanted {offered}, or {own}")
    if not isinstance(scheme.chain, Chain):
        raise TypeError(
            f"{name} is {arguments.shown(scheme)}, whose chain {arguments.shown(scheme.chain)} is not derived from "
            "hjbjax.discretisation.schemes.Chain; that module shows how to write one"
        )
    if scheme.even and any(each is not None for each in grid.stretch):
        caller = name.partition(":")[0]
        raise ValueError(
            f"{caller}: {scheme!r} wants equal spacings; leave out Grid.stretch, or use Upwind() or Limited()"
        )


@pytree_dataclass(static=("central", "subcell", "split"))
class Upwind(Chain):
    """First-order upwind differences: the Kushner–Dupuis chain, monotone on every grid.

    Order 1 where the drift rules. With ``central=True`` the artificial diffusion of upwinding is taken out as
    far as the chain stays monotone: an axis on which the noise is strong enough, a_ii ≥ h|f_i|, gets central
    differences, which are of order 2; the least diffusion that keeps the probabilities non-negative is added
    elsewhere. Without noise both are the same scheme.

    Args:
      central: whether to use central differences where they stay monotone.
      subcell: whether the boundary of a target {l ≤ 0} is met where l = 0 between two nodes, which wants l to be a
        signed distance or like one; otherwise the target is the nodes with l ≤ 0.
      split: whether in a game whose players both drive a component each one's drift is upwinded by itself. Where
        f = f₁(x, u) + f₂(x, d), L = L₁ + L₂ and noise is nobody's,

            H = min_u [L₁ + Σ_i f₁ᵢ⁺ D_i⁺ + f₁ᵢ⁻ D_i⁻ + noise]  +  max_d [L₂ + Σ_i f₂ᵢ⁺ D_i⁺ + f₂ᵢ⁻ D_i⁻]

        is consistent and monotone like upwinding the sum f: two optimisations of one player in place of a nested
        one, and min max = max min on the grid as well (with f = u + d, D⁺ = 1, D⁻ = −1 the sum has min max 1, max
        min 0). There |f₁| + |f₂| takes the place of |f₁ + f₂| in the dissipation, as in a Lax–Friedrichs flux, and
        who is held back by the other is still shaken: a target that can only just be kept off is reached in the end.
    """

    central: bool = True
    subcell: bool = False
    split: bool = False
    one_way, in_parts = True, True

    def excess(self, f: Any, a: Any, link: Links) -> Any:
        """a + h⁺ f⁺ + h⁻ f⁻, or as far as the chain stays monotone with central differences the larger of the two."""
        least = jnp.maximum(link.up * f, -link.down * f)
        return jnp.maximum(a, least) if self.central else a + least

    def kinks(self, a: Any, slopes: tuple[Any, Any], link: Links) -> tuple[Sequence[Any], Sequence[Any]]:
        """f = 0; with central differences also f = −a/h⁻ and a/h⁺, between which the derivative is their mean."""
        up, down = slopes
        if not self.central:
            return (0.0,), (down, up)
        middle = (link.down * up + link.up * down) / (link.up + link.down)
        return (-a / link.down, 0.0, a / link.up), (down, middle, middle, up)


@pytree_dataclass(static=("subcell", "split"))
class Limited(Scheme):
    """Second order where the solution is smooth: one-sided differences with limited slopes.

    With the second differences s_i along an axis the slopes are

        D⁺ − (h/2) φ(s_i, s_{i+1}),   D⁻ + (h/2) φ(s_i, s_{i−1}),   φ(a, b) = ab (a + b)/(a² + b²) if ab > 0 else 0

    (van Albada), with quadratic ghost values at ends that are not periodic, and mirrored ones where noise reflects. An
    axis of two nodes has no second difference and keeps its one-sided differences: it is a chain of two states.
    The scheme is no chain: the residual of the equation with these slopes is driven to zero by corrections with the
    matrix of the monotone one, from its answer. There is no certificate; the tolerance bounds that residual and the
    last step, in cost units.

    Args:
      subcell: as for ``Upwind``; on by default, since a target snapped to nodes is of first order.
      split: as for ``Upwind``.
    """

    subcell: bool = True
    split: bool = False
    blends, in_parts = True, True

    @property
    def chain(self) -> Upwind:
        """The monotone chain whose matrix makes the corrections."""
        return Upwind(subcell=self.subcell, split=self.split)

    def slopes(self, around: Differences) -> Slopes:
        """Limited slopes; central ones where noise keeps those monotone, a_ii ≥ h |f_i| for all actions."""
        grid, pairs = around.on.grid, list(zip(around.one_sided, around.links, strict=True))
        noisy, first = around.on.noisy_walls(around.x), around.first_order

        def mean(*bends: jax.Array) -> jax.Array:
            return stencil.van_albada(*bends) if first is None else jnp.where(first, 0, stencil.van_albada(*bends))

        found = []
        for axis, (pair, link) in enumerate(pairs):
            if grid.shape[axis] == 2:  # no second difference: the axis is a chain of two states
                found.append(pair)
                continue
            if link.meets_up is link.meets_down is None and _is_plain(grid, axis):
                # from V where that is all: the differences are then no arrays
                sharp = slopes.of_second_order(around.value, grid, axis, mean, noisy)
            else:
                sharp = stencil.limited(*pair, grid, axis, link, noisy[axis])
                sharp = sharp if first is None else jax.tree.map(functools.partial(jnp.where, first), pair, sharp)
            found.append(sharp)
        if around.on.problem.noise is None:
            return found
        for axis, quiet in enumerate(calm(around.on, around.x, around.links)):
            (up, down), link = pairs[axis]
            middle = (link.down * up + link.up * down) / (link.up + link.down)
            # at a wall the inner difference, as in ``weights``; the other one is zero
            middle = jnp.where(stencil.walls(grid, axis), up + down, middle)
            found[axis] = (jnp.where(quiet, middle, found[axis][0]), jnp.where(quiet, middle, found[axis][1]))
        return found


def _is_plain(grid: Grid, axis: int) -> bool:
    """True if an axis has equal spacings, three nodes, and all of them here."""
    return grid.stretch[axis] is None and grid.shape[axis] > 2 and not grid.is_divided(axis)


def calm(on: Discretisation, x: list, links: Sequence[Links]) -> list:
    """Where central differences are monotone under all representative actions, along every axis."""
    problem = on.problem
    # whether H is central must not depend on the action that is tried, or its kinks would move with it
    found: list = [True] * on.grid.ndim
    for u, d in itertools.product(sets.probes(problem.controls, on.dtype), sets.probes(problem.disturbances, on.dtype)):
        f, a = on.drift(u, d, x), on.diffusion(u, d, x)
        for axis, link in enumerate(links):
            left = correlated_noise.along_axis(a, on.grid, axis)
            found[axis] &= left >= jnp.maximum(link.up, link.down) * jnp.abs(f[axis])
    return found


@pytree_dataclass()
class Eno2(Scheme):
    """Second order for ``march``: one-sided differences corrected by the smaller of two second differences.

        D⁺ − (h/2) m(s_i, s_{i+1}),   D⁻ + (h/2) m(s_i, s_{i−1}),   m(a, b) = a if |a| < |b| else b.

    The smoother stencil, node by node, as C.-W. Shu and S. Osher choose it. Wants equal spacings.
    """

    stationary, even, split, in_parts, points = False, True, True, True, 3

    @property
    def chain(self) -> Upwind:
        """The monotone chain with the same fastest rate."""
        return Upwind(split=True)

    def slopes(self, around: Differences) -> Slopes:
        """Those of the smoother of two stencils."""
        return slopes.eno2(around.value, around.on.grid, around.on.noisy_walls(around.x))


@pytree_dataclass(static=("subcell", "split"))
class Weno5(Scheme):
    """Fifth order where the value is smooth: weighted essentially non-oscillatory slopes.

    Each one-sided slope is a mean of three third-order ones with weights that favour the smoothest (see ``slopes``).
    Wants equal spacings and at least seven points an axis. Where some of the seven nodes around one lie in a target, or
    have no finite value, the slopes are those of ``Limited``. A stationary problem is solved as by ``Limited``, without
    a certificate; noise is seen by central differences, of order 2.

    Args:
      subcell: as for ``Limited``.
      split: as for ``Upwind``.
    """

    subcell: bool = True
    split: bool = True
    even, in_parts, stages, points = True, True, 3, 7

    @property
    def chain(self) -> Upwind:
        """The monotone chain with the same fastest rate, whose matrix makes the corrections."""
        return Upwind(subcell=self.subcell, split=self.split)

    def slopes(self, around: Differences) -> Slopes:
        """A mean of three stencils with weights that favour the smoothest; limited slopes beside what breaks them."""
        grid, noisy = around.on.grid, around.on.noisy_walls(around.x)
        found = slopes.weno5(around.value, grid, around.lost, noisy)
        for axis, (pair, link) in enumerate(zip(around.one_sided, around.links, strict=True)):
            if (broken := slopes.broken(link, grid, axis, around.lost)) is not None:
                near, (up, down) = stencil.limited(*pair, grid, axis, link, noisy[axis]), found[axis]
                found[axis] = jnp.where(broken, near[0], up), jnp.where(broken, near[1], down)
        return found
