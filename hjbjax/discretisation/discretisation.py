"""A problem on a grid, discretised by a scheme; and the base classes of schemes.

``schemes`` shows how to write a scheme of your own.
"""

import abc
import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation import stencil
from hjbjax.discretisation.stencil import Links
from hjbjax.problem import sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.parts import Parts
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, pytree_dataclass
from hjbjax.tracing import components, dependence

T = TypeVar("T", bound=Any)


class Scheme(abc.ABC):
    """The base class of schemes, which say what slopes the drift sees.

    A scheme is a frozen, hashable value without traced numbers. It defines ``chain`` and ``slopes``; everything else
    has a default, given here.
    """

    @property
    def monotone(self) -> bool:
        """True if the scheme is a Markov chain (``Chain``): only then are its answers certified."""
        return False

    @property
    def stationary(self) -> bool:
        """True if corrections with the matrix of ``chain`` can drive the residual with these slopes to zero."""
        return True

    @property
    def even(self) -> bool:
        """True if the scheme needs equal spacings along every axis."""
        return False

    @property
    def subcell(self) -> bool:
        """True if the boundary of a target is met between two nodes."""
        return False

    @property
    def split(self) -> bool:
        """True if the drifts of two players who drive one component are upwinded separately, see ``Upwind``."""
        return False

    @property
    def stages(self) -> int:
        """The number of stages, and the order, of the explicit Runge–Kutta method that suits it: 1, 2 or 3."""
        return 2

    @property
    def points(self) -> int:
        """The number of nodes that every axis must have."""
        return 2

    @property
    def blends(self) -> bool:
        """True if ``slopes`` returns the one-sided differences itself where ``Differences.first_order`` says so."""
        return False

    @property
    def in_parts(self) -> bool:
        """True if ``slopes`` reads other nodes through ``stencil`` only, so that many devices can share the nodes."""
        return False

    @property
    @abc.abstractmethod
    def chain(self) -> "Chain":
        """The monotone chain behind it, as ``Upwind()``: it starts and corrects, and limits explicit steps."""

    @abc.abstractmethod
    def slopes(self, around: "Differences") -> Sequence[tuple[jax.Array, jax.Array]]:
        """The slopes P⁺ and P⁻ along every axis, each (*grid): drift f has the gain f⁺ P⁺ + f⁻ P⁻; zero at a wall."""


class Chain(Scheme):
    """The base class of monotone schemes, which are Markov chains: along an axis drift f and diffusion a gain

        [(e + h⁻ f) D⁺ − (e − h⁺ f) D⁻]/(h⁺ + h⁻),    e ≥ max(a, h⁺ f, −h⁻ f),

    with distances h⁺ and h⁻ to the two neighbours; e(f) rises by at most h|f|. A chain defines ``excess`` and
    ``kinks``. ``schemes`` explains what happens at a wall, and shows an example.
    """

    monotone, stages = True, 1

    @property
    def one_way(self) -> bool:
        """True if e = max(h⁺ f, −h⁻ f) without noise, so that one of two opposite jumps has rate zero."""
        return False

    @property
    def chain(self) -> "Chain":
        """The chain itself."""
        return self

    def slopes(self, around: "Differences") -> Sequence[tuple[jax.Array, jax.Array]]:
        """The one-sided differences."""
        return around.one_sided

    @abc.abstractmethod
    def excess(self, f: Any, a: Any, link: Links) -> Any:
        """e, the diffusion along an axis."""

    @abc.abstractmethod
    def kinks(self, a: Any, slopes: tuple[Any, Any], link: Links) -> tuple[Sequence[Any], Sequence[Any]]:
        """The drifts f, in order, at which the gain's derivative jumps, and the derivatives between them: one more.

        ``slopes`` are D⁺ and D⁻. At most three kinks.
        """


@pytree_dataclass(static=("scheme", "dtype", "mesh"))
class Discretisation:
    """A problem on a grid by a scheme, in one floating-point type and at one time.

    Its methods evaluate the functions of one state on all nodes at once: an action is a list of its components, each a
    number or an array that broadcasts over the nodes, and so is what they return.

    Args:
      problem: the question.
      grid: the nodes.
      scheme: how derivatives are made.
      dtype: the floating-point type of all node values.
      t: the time, which matters if the problem's functions depend on it.
      cut: the links that end on the boundary of a target, kept by ``cut_cells``; None: made anew wherever they are
        wanted.
      mesh: the devices over which the nodes are divided while steps are made; None: one.
    """

    problem: Problem
    grid: Grid
    scheme: Scheme
    dtype: Any
    t: Any = 0.0
    cut: tuple[Links, ...] | None = None
    mesh: Mesh | None = None

    def __post_init__(self):
        # jnp.float32 and "float32" are other keys than np.dtype: one program would be compiled for each
        object.__setattr__(self, "dtype", np.dtype(self.dtype))

    @property
    def chain(self) -> "Discretisation":
        """The monotone chain that goes with the scheme."""
        return dataclasses.replace(self, scheme=self.scheme.chain)

    def at(self, t: Any) -> "Discretisation":
        """The discretisation at another time."""
        return dataclasses.replace(self, t=t, cut=None)

    def asking(self, problem: Problem) -> "Discretisation":
        """The discretisation of another problem."""
        same = problem.target is self.problem.target and problem.exit_cost is self.problem.exit_cost
        return dataclasses.replace(self, problem=problem, cut=self.cut if same else None)

    def on_grid(self, grid: Grid) -> "Discretisation":
        """The discretisation on another grid."""
        return dataclasses.replace(self, grid=grid, cut=None)

    @property
    def settled(self) -> "Discretisation":
        """The discretisation for a program in which the grid does not change: see ``Grid.settled``."""
        return altered(self, grid=self.grid.settled())

    @property
    def parts(self) -> Parts | None:
        """The parts of the grid over the mesh; None for one device, and for grids too small for it, as coarser ones."""
        parts = None if self.mesh is None else Parts(self.mesh, self.grid.shape)
        return parts if parts is not None and parts.fits else None

    def coordinates(self) -> list:
        """The n coordinates of all nodes, each of a shape that broadcasts to (*grid)."""
        return self.grid.components(self.dtype)

    def drift(self, u: list, d: list | None = None, x: list | None = None) -> list:
        """The n components of f; at the nodes, or where ``x`` is."""
        return list(components.components(self.problem.drift, *self._arguments(u, d, x), dtype=self.dtype))

    @property
    def apart(self) -> bool:
        """Whether each player's drift is upwinded by itself: the scheme does, and they meet in a component.

        Then drift and cost must be sums of what each does, f = f(x, u, 0) + [f(x, 0, d) − f(x, 0, 0)]. At constrained
        ends what is admissible depends on the sum.
        """
        if not (self.scheme.split and self.problem.is_game) or self.grid.sides("constrained"):
            return False
        found = dependence.influence(self.problem, self.grid.ndim, self.dtype)
        return found.separable and found.meet

    def drifts(self, u: list, d: list | None = None, x: list | None = None) -> list[list]:
        """The drift in the parts that are upwinded each by itself: the whole, or what each player adds.

        The noise goes with the first part; components that the disturbance does not drive are exactly zero in its own.
        """
        if not self.apart:
            return [self.drift(u, d, x)]
        found = dependence.influence(self.problem, self.grid.ndim, self.dtype)
        driven, zero = found.drift.driven_by(found.disturbance), jnp.zeros((), self.dtype)
        # at zero even where that is not admissible: a sum of two parts is told apart by any point
        no_u, no_d = ([zero] * len(inputs) for inputs in (found.control, found.disturbance))
        still, pushed = self.drift(no_u, no_d, x), self.drift(no_u, d, x)
        # an exact zero, and not pushed − still = 1e-17, where the disturbance does not act: its sign would be upwinded
        theirs = [pushed[i] - still[i] if i in driven else zero for i in range(self.grid.ndim)]
        return [self.drift(u, no_d, x), theirs]

    def running_cost(self, u: list, d: list | None = None, x: list | None = None) -> Any:
        """L, in cost per unit time; zero where the problem has none."""
        if self.problem.cost is None:
            return jnp.zeros((), self.dtype)
        return components.scalar(self.problem.cost, *self._arguments(u, d, x), dtype=self.dtype)

    def diffusion(self, u: list, d: list | None = None, x: list | None = None) -> dict[tuple[int, int], Any]:
        """The entries a_ij, i ≤ j, of a = σσᵀ; those that are zero by construction are left out."""
        noise, n = self.problem.noise, self.grid.ndim
        if noise is None:  # and no zeros: what is not there costs no pass over the nodes
            return {}
        if callable(noise):
            sigma = components.components(noise, *self._arguments(u, d, x), dtype=self.dtype)
        else:
            places = self.coordinates() if x is None else x
            sigma = components.components(lambda x: jnp.asarray(noise, self.dtype), places, dtype=self.dtype)
        if sigma.ndim < 2:  # one number, or one an axis: independent noise, a diagonal a
            return {(i, i): s * s for i, s in enumerate(np.broadcast_to(sigma, (n,)))}
        # σ of shape (n, k): a_ij = Σ_l σ_il σ_jl, of which the half i ≤ j says all
        pairs = itertools.combinations_with_replacement(range(n), 2)
        return {(i, j): sum(p * q for p, q in zip(sigma[i], sigma[j], strict=True)) for i, j in pairs}

    def noisy_walls(self, x: list) -> list[dict[int, jax.Array]]:
        """Where noise reflects, for every axis and the steps −1 and 1 that lead across its walls: bool, one slice each.

        There ∂V/∂n = 0, and slopes must see the mirror image. With the parabola through the last three nodes instead
        the node beside a wall takes its slope from the node behind it, without a limit, while noise ties the value on
        the wall to that node: under drift towards the wall with a < h f both grow like e^{.15 f t/h}.
        """
        found: list[dict[int, jax.Array]] = [{} for _ in range(self.grid.ndim)]
        if self.problem.noise is None:
            return found
        pairs = list(itertools.product(sets.probes(self.problem.controls, self.dtype),
                                       sets.probes(self.problem.disturbances, self.dtype)))  # fmt: skip
        for axis, step in itertools.product(range(self.grid.ndim), (-1, 1)):
            if self.grid.periodic[axis] or not stencil.has_wall(self.grid, axis, step):
                continue
            ends = [stencil.slices(c, self.grid, axis, step) if i == axis else c for i, c in enumerate(x)]
            noise = [self.diffusion(u, d, ends).get((axis, axis), jnp.zeros((), self.dtype)) for u, d in pairs]
            found[axis][step] = functools.reduce(jnp.logical_or, [a > 0 for a in noise])
        return found

    def at_nodes(self, ingredient: Any) -> jax.Array:
        """A function of the state alone, or a number, at every node, shape (*grid); None is zero."""
        found = components.of_state(self.problem, ingredient, self.coordinates(), self.t, self.dtype)
        return jnp.broadcast_to(found, self.grid.shape)

    def _arguments(self, u: list, d: list | None, x: list | None) -> tuple:
        return self.problem.arguments(self.coordinates() if x is None else x, u, d, self.t)


def over_nodes(task: T, shape: tuple[int, ...]) -> T:
    """The leaves of a task, or of a march, with a value at every node, as truth values: those of this ``shape``."""

    def mark(leaf: Any) -> bool:
        return np.shape(leaf) == shape

    on = task.on
    # without those of the problem and the grid, which may have the shape of the nodes by chance
    nothing, cut = jax.tree.map(lambda _: False, on), jax.tree.map(mark, on.cut)
    return altered(jax.tree.map(mark, altered(task, on=None)), on=altered(nothing, cut=cut))


def on_part(task: T, parts: Parts) -> T:
    """A task, or a march, as one of the devices sees it, inside ``shard_map``."""
    return altered(task, on=altered(task.on, grid=task.on.grid.divided(parts)))


@dataclasses.dataclass(frozen=True)
class Differences:
    """What a scheme makes slopes of: V at the nodes and how it changes from node to node.

    Attributes:
      on: the problem on its grid.
      x: the coordinates of the nodes.
      value: V, (*grid).
      links: the distances to the neighbours along every axis.
      one_sided: D⁺ and D⁻ along every axis, each (*grid); zero across a wall.
      lost: the nodes without a finite value, far above all others, bool (*grid); None where there is none.
      first_order: true where the one-sided differences themselves are the slopes, a truth value that may be traced;
        None: nowhere. Only schemes with ``blends`` read it, which saves them an array per slope.
    """

    on: Discretisation
    x: list
    value: jax.Array
    links: tuple[Links, ...]
    one_sided: tuple[tuple[jax.Array, jax.Array], ...]
    lost: jax.Array | None = None
    first_order: jax.Array | None = None
