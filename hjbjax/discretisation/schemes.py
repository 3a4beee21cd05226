"""Discretisations of the derivatives, as values, and a guide to custom schemes.

A scheme defines the slopes of V in the drift term. A class derived from ``Scheme`` computes them: ``march`` steps with
its slopes, and ``solve`` starts from the value of its monotone ``chain`` and drives the residual with the new slopes to
zero. A second-order scheme with minmod-limited slopes, for equal spacings:

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
    ...         grid, found = around.grid, []
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

The exact value is tanh 1 = 0.762. A monotone scheme derives from ``Chain`` and defines the diffusion e along an axis,
and the kinks of the gain of a drift component; its solutions are certified. The Lax–Friedrichs scheme:

    >>> @dataclasses.dataclass(frozen=True)
    ... class LaxFriedrichs(Chain):
    ...     speed: float
    ...     even = True
    ...
    ...     def excess(self, f, a, link):
    ...         return a + self.speed * link.up + 0 * f
    ...
    ...     def kinks(self, a, slopes, link):
    ...         return (), (sum(slopes) / 2,)  # central differences for any drift
    >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-2.0], [2.0]), discount=1.0)
    >>> solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (201,)), scheme=LaxFriedrichs(2.0))
    >>> solution.status.name, round(float(solution.value_at([0.5])), 2)
    ('CONVERGED', 0.17)

The exact value is (√5 − 1)/8 = 0.155; the difference is due to the large diffusion. The diffusion must satisfy
e ≥ max(a, h⁺f, −h⁻f), here a ``speed`` of at least |f|, because probabilities cannot be negative. With a smaller e the
chain would represent only part of the drift, and the solve is refused. The class must be hashable, since compiled
programs are cached by it. Its methods are traced, so they must not branch on numbers. Under ``jit``, ``vmap`` and
``grad`` a solve requires a monotone scheme, and does not check values.

For a scheme that follows paths over many cells instead of using slopes, see ``hjbjax.semi_lagrangian``.

All schemes treat walls in the same way. A wall passes through a node, so the cell of that node is half as wide. With
noise a, outward drift n (f at an upper end, −f at a lower one) and ∂V/∂n = 0 on the wall, the balance over that cell is

    (h/2)(βV − L) = −(a/2h − n/2)(V_N − V_{N−1}),      so the chain moves inwards at the rate (a − h n)/h²:

the mirrored neighbour V_{N+1} = V_{N−1} gives a/h² (V_{N−1} − V_N), and the drift acts on the inner difference. The
drift at the wall hardly affects V: an error O(h) at this one node changes V by O(h²). It does affect the law of the
chain: outward drift must reduce the rate by as much as inward drift raises it. Then p_N/p_{N−1} = (a + h n)/(a − h n),
as between two interior nodes. A chain uses (e(n⁺) − h n)/h², with e for the outward part of the drift. This rate is
never negative. Without noise it is |n|/h for n < 0 and zero for n > 0, where the drift is cut off.
"""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.discretisation import slopes, stencil
from hjbjax.discretisation.discretisation import Chain, Differences, Scheme
from hjbjax.discretisation.stencil import Links
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass

Slopes = Sequence[tuple[jax.Array, jax.Array]]
ROUNDING = 64  # units of eps of the required diffusion by which a chain may fall short


def weights(scheme: Chain, f: Any, a: Any, link: Links, grid: Grid, axis: int) -> tuple[Any, Any]:
    """The non-negative weights w⁺, w⁻ of the gain w⁺ D⁺ − w⁻ D⁻ of drift f and noise a (None: no noise) along an axis.

    They are (e + h⁻ f)/(h⁺ + h⁻) and (e − h⁺ f)/(h⁺ + h⁻), at a wall divided by h. The chain jumps at the rates w⁺/h⁺
    and w⁻/h⁻. The weight across a wall is arbitrary, since the difference is zero there.
    """
    if a is None and scheme.one_way:  # the same numbers, without subtraction
        return jnp.maximum(f, 0), jnp.maximum(-f, 0)
    a = 0 if a is None else jnp.maximum(a, 0)  # correlated noise may leave a rounding error below zero
    leaving, span = f, link.up + link.down
    if stencil.has_walls(grid, axis):  # the link beyond is the mirror image of the inner one
        lower, upper = stencil.wall(grid, axis, -1), stencil.wall(grid, axis, 1)
        leaving = jnp.where(upper, jnp.maximum(f, 0), jnp.where(lower, jnp.minimum(f, 0), f))
        span = jnp.where(upper | lower, link.up, span)
    e = scheme.excess(leaving, a, link)
    # e = h⁺ f may be lower by rounding, and a rate of −1e-17 would be a negative probability
    return jnp.maximum(e + link.down * f, 0) / span, jnp.maximum(e - link.up * f, 0) / span


def falls_short(scheme: Chain, f: Any, a: Any, link: Links) -> Any:
    """True where e is less than max(a, h⁺ f, −h⁻ f) by more than rounding, so that ``weights`` reduces the drift."""
    a = jnp.zeros(()) if a is None else jnp.maximum(a, 0)
    e, wanted = scheme.excess(f, a, link), jnp.maximum(a, jnp.maximum(link.up * f, -link.down * f))
    return wanted - e > ROUNDING * jnp.finfo(jnp.result_type(wanted)).eps * wanted


def kinks(
    scheme: Chain, a: Any, slopes: tuple[Any, Any], link: Links, grid: Grid, axis: int
) -> tuple[Sequence[Any], Sequence[Any]]:
    """The drifts at which the derivative of the gain of ``weights`` jumps, and its derivatives between them."""
    found, derivatives = scheme.kinks(a, slopes, link)
    if not stencil.has_walls(grid, axis):
        return found, derivatives
    wall = stencil.walls(grid, axis)
    # over half a cell: twice the derivative where drift leaves, the inner difference where it does not; the smaller of
    # the two, since e increases by at most h n
    inner = slopes[0] + slopes[1]
    # compare by identity: pieces with the same derivative object have no kink between them
    made = {id(d): jnp.where(wall, jnp.where(jnp.abs(2 * d) > jnp.abs(inner), inner, 2 * d), d) for d in derivatives}
    return found, [made[id(d)] for d in derivatives]


def check_scheme(scheme: Any, name: str, grid: Grid, *, stationary: bool = False) -> None:
    """Refuse an object that is not a scheme, not suitable for stationary problems, or not for the grid's spacings.

    Raises:
      TypeError: not a suitable scheme.
      ValueError: a stretched grid for a scheme that requires equal spacings.
    """
    is_scheme = type(scheme).__hash__ is not None and isinstance(scheme, Scheme)
    if not is_scheme or not (scheme.stationary if stationary else scheme.paths is None):
        other = "SemiLagrangian()" if stationary else "Eno2()"
        own = "a custom one derived from hjbjax.discretisation.schemes.Scheme"
        offered = f"hjb.Upwind(), Limited(), {other} or Weno5(), or {own}"
        raise TypeError(f"{name} is {arguments.shown(scheme)}; wanted {offered}")
    if not isinstance(scheme.chain, Chain):
        raise TypeError(
            f"{name} is {arguments.shown(scheme)}, whose chain {arguments.shown(scheme.chain)} is not derived from "
            "hjbjax.discretisation.schemes.Chain; that module shows how to write one"
        )
    if scheme.even and any(each is not None for each in grid.stretch):
        caller = name.partition(":")[0]
        raise ValueError(
            f"{caller}: {scheme!r} requires equal spacings; remove Grid.stretch, or use Upwind() or Limited()"
        )


def check_slopes(scheme: Scheme | None, name: str) -> None:
    """Refuse a scheme that follows paths instead of using slopes.

    Raises:
      TypeError: offers schemes with slopes.
    """
    if scheme is not None and scheme.paths is not None:
        offered = "a scheme with slopes: hjb.Upwind(), Limited() or Weno5()"
        raise TypeError(f"{name} is {arguments.shown(scheme)}, which follows paths; wanted {offered}")


@pytree_dataclass(static=("central", "subcell", "split"))
class Upwind(Chain):
    """First-order upwind differences: the Kushner–Dupuis chain, monotone on every grid.

    The scheme has order 1 where drift dominates. With ``central=True`` the artificial diffusion of upwinding is reduced
    as far as the chain stays monotone: an axis with strong noise, a_ii ≥ h|f_i|, uses central differences, which have
    order 2; elsewhere the scheme adds the least diffusion that keeps the probabilities non-negative. Without noise the
    option has no effect.

    Args:
      central: use central differences where they are monotone.
      subcell: resolve the boundary of a target {l ≤ 0} between nodes, where l = 0. This requires that l is close to a
        signed distance. Otherwise the target consists of the nodes with l ≤ 0.
      split: in a game, upwind the drifts of the two players separately where both drive a component. If
        f = f₁(x, u) + f₂(x, d), L = L₁ + L₂ and the noise does not depend on the actions,

            H = min_u [L₁ + Σ_i f₁ᵢ⁺ D_i⁺ + f₁ᵢ⁻ D_i⁻ + noise]  +  max_d [L₂ + Σ_i f₂ᵢ⁺ D_i⁺ + f₂ᵢ⁻ D_i⁻]

        is consistent and monotone like upwinding the sum f. It replaces a nested optimisation by two single ones, and
        min max = max min also holds on the grid (with f = u + d, D⁺ = 1, D⁻ = −1, upwinding the sum gives min max 1 and
        max min 0). The dissipation contains |f₁| + |f₂| instead of |f₁ + f₂|, as in a Lax–Friedrichs flux. It therefore
        also acts where the players cancel, and a target that can just be avoided is reached in the end.
    """

    central: bool = True
    subcell: bool = False
    split: bool = False
    is_proven, one_way, in_parts = True, True, True

    def excess(self, f: Any, a: Any, link: Links) -> Any:
        """a + h⁺ f⁺ + h⁻ f⁻, or with ``central`` the larger of a and h⁺ f⁺ + h⁻ f⁻."""
        least = jnp.maximum(link.up * f, -link.down * f)
        return jnp.maximum(a, least) if self.central else a + least

    def kinks(self, a: Any, slopes: tuple[Any, Any], link: Links) -> tuple[Sequence[Any], Sequence[Any]]:
        """f = 0; with central differences f = −a/h⁻, 0 and a/h⁺, between which the derivative is the mean."""
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
    axis with two nodes has no second difference and keeps its one-sided differences. The scheme is not a chain:
    starting from the value of the monotone chain, the residual with these slopes is driven to zero by corrections with
    the matrix of that chain. There is no certificate; the tolerance bounds that residual and the last step, in cost
    units.

    Args:
      subcell: see ``Upwind``; on by default, since a target snapped to nodes is first order.
      split: see ``Upwind``.
    """

    subcell: bool = True
    split: bool = False
    blends, in_parts = True, True

    @property
    def chain(self) -> Upwind:
        """The monotone chain whose matrix gives the corrections."""
        return Upwind(subcell=self.subcell, split=self.split)

    def slopes(self, around: Differences) -> Slopes:
        """Limited slopes; central ones where these are monotone, a_ii ≥ h |f_i| for all actions."""
        grid, pairs = around.grid, list(zip(around.one_sided, around.links, strict=True))
        noisy, first = around.reflecting, around.first_order

        def mean(*bends: jax.Array) -> jax.Array:
            return stencil.van_albada(*bends) if first is None else jnp.where(first, 0, stencil.van_albada(*bends))

        found = []
        for axis, (pair, link) in enumerate(pairs):
            if grid.shape[axis] == 2 or axis not in grid.state_axes:  # no second difference
                found.append(pair)
                continue
            if link.meets_up is link.meets_down is None and _is_plain(grid, axis):
                # computed from V directly, so that the differences are not stored as arrays
                sharp = slopes.of_second_order(around.value, grid, axis, mean, noisy)
            else:
                sharp = stencil.limited(*pair, grid, axis, link, noisy[axis])
                sharp = sharp if first is None else jax.tree.map(functools.partial(jnp.where, first), pair, sharp)
            found.append(sharp)
        for axis, central in enumerate(around.central or ()):
            (up, down), link = pairs[axis]
            middle = (link.down * up + link.up * down) / (link.up + link.down)
            # at a wall the inner difference, as in ``weights``; the other one is zero
            middle = jnp.where(stencil.walls(grid, axis), up + down, middle)
            found[axis] = (jnp.where(central, middle, found[axis][0]), jnp.where(central, middle, found[axis][1]))
        return found


def _is_plain(grid: Grid, axis: int) -> bool:
    """True if an axis has equal spacings and at least three nodes, and is not divided among devices."""
    return grid.stretch[axis] is None and grid.shape[axis] > 2 and not grid.layout.is_divided(axis)


@pytree_dataclass()
class Eno2(Scheme):
    """Second order for ``march``: one-sided differences corrected by the smaller of two second differences.

        D⁺ − (h/2) m(s_i, s_{i+1}),   D⁻ + (h/2) m(s_i, s_{i−1}),   m(a, b) = a if |a| < |b| else b.

    At each node the smoother stencil is used, after C.-W. Shu and S. Osher. Requires equal spacings.
    """

    stationary, even, split, in_parts, points = False, True, True, True, 3

    @property
    def chain(self) -> Upwind:
        """The monotone chain with the same fastest rate."""
        return Upwind(split=True)

    def slopes(self, around: Differences) -> Slopes:
        """The slopes of the smoother of two stencils."""
        return slopes.eno2(around.value, around.grid, around.reflecting)


@pytree_dataclass(static=("subcell", "split"))
class Weno5(Scheme):
    """Fifth order where the value is smooth: weighted essentially non-oscillatory slopes.

    Each one-sided slope is a mean of three third-order slopes with weights that favour the smoothest (see ``slopes``).
    Requires equal spacings and at least seven points per axis. If some of the seven nodes around a node are in a target
    or unreachable, it uses the slopes of ``Limited``. A stationary problem is solved as with ``Limited``, without a
    certificate. Noise is discretised by central differences, of order 2.

    Args:
      subcell: see ``Limited``.
      split: see ``Upwind``.
    """

    subcell: bool = True
    split: bool = True
    even, in_parts, stages, points = True, True, 3, 7

    @property
    def chain(self) -> Upwind:
        """The monotone chain with the same fastest rate, whose matrix gives the corrections."""
        return Upwind(subcell=self.subcell, split=self.split)

    def slopes(self, around: Differences) -> Slopes:
        """Slopes weighted over three stencils; limited slopes near targets and unreachable nodes."""
        grid, noisy = around.grid, around.reflecting
        found = slopes.weno5(around.value, grid, around.unreachable, noisy)
        for axis, (pair, link) in enumerate(zip(around.one_sided, around.links, strict=True)):
            broken = slopes.broken_stencils(link, grid, axis, around.unreachable) if axis in grid.state_axes else None
            if broken is not None:
                near, (up, down) = stencil.limited(*pair, grid, axis, link, noisy[axis]), found[axis]
                found[axis] = jnp.where(broken, near[0], up), jnp.where(broken, near[1], down)
        return found
