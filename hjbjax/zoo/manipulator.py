"""A planar arm with n links, whose dynamics are derivatives of its Lagrangian.

    M(q) q̈ + V(q, w) + G(q) = τ                                             (5.5)
    τ = M(q) τ' + V(q, w) + G(q), which makes q̈ = τ'                        (5.6)

q₁ is the angle of the first link from upright, and q_i the angle of link i relative to link i − 1. Each link is
massless with a point mass at its far end, so one link is the pendulum. With the kinetic energy T = ½ w'M(q)w and the
potential energy U,

    M e_j = ∂T/∂w at w = e_j,    V = (∂/∂q ∂T/∂w) w − ∂T/∂q,    G = ∂U/∂q,

and V = C w with the matrix C_ij = ½ Σ_k (∂M_ij/∂q_k + ∂M_ik/∂q_j − ∂M_jk/∂q_i) w_k, for which Ṁ − 2C is skew-symmetric.

The functions compute with lists of scalars. n is static, so the loops unroll into elementwise operations, and a solver
can evaluate them on a whole grid without forming a matrix per node.
"""

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, front_door, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Array, Control, Number, State
from hjbjax.zoo.ingredients import QuadraticCost, check_positive

Joints: TypeAlias = Sequence[Number] | Array  # one number per joint: a vector or a list of scalars


@pytree_dataclass(static=("links",))
class Manipulator:
    """A planar arm, state (q, w) in R^2n, one torque per joint.

    Args:
      links: n.
      lengths: n lengths, or one length for all links; ``None`` is 1.
      masses: n point masses at the far ends of the links, or one mass for all links; ``None`` is 1.
      g: gravity.

    Example:
      >>> arm = Manipulator(links=2)
      >>> arm.mass_matrix(jnp.zeros(2)).tolist()
      [[5.0, 2.0], [2.0, 1.0]]
      >>> arm.gravity(jnp.array([jnp.pi / 2, 0.0])).astype(int).tolist()
      [-29, -9]
    """

    links: int = 1
    lengths: Number | Joints | None = None
    masses: Number | Joints | None = None
    # in m/s²; lengths are then in metres, masses in kilograms and torques in newton metres
    g: Number = 9.81

    def __post_init__(self) -> None:
        # bool is a subclass of int, so True would mean one link
        if isinstance(self.links, bool) or not isinstance(self.links, int) or self.links < 1:
            raise ValueError(f"Manipulator: got links = {self.links!r}, wanted a positive integer")
        for name in ("lengths", "masses"):
            numbers = getattr(self, name)
            if numbers is None:
                object.__setattr__(self, name, (1.0,) * self.links)
            elif not isinstance(numbers, (list, tuple)) and np.ndim(numbers) == 0:
                object.__setattr__(self, name, (numbers,) * self.links)
            elif len(numbers) != self.links:
                raise ValueError(f"Manipulator.{name}: got {len(numbers)} numbers, wanted {self.links}: one per link")
            check_positive("Manipulator", **{name: getattr(self, name)})

    @property
    def _lengths(self) -> Joints:
        return cast(Joints, self.lengths)  # __post_init__ has expanded None and a single number to n numbers

    @property
    def _masses(self) -> Joints:
        return cast(Joints, self.masses)

    def kinetic_energy(self, q: Joints, w: Joints) -> Number:
        """T(q, w) of vectors or lists of n scalars."""
        total: Number = 0.0
        angle: Number = 0.0
        rate: Number = 0.0
        across: Number = 0.0
        up: Number = 0.0
        for i in range(self.links):
            # joint angles are relative, so angles, rates and velocities (across, up) add up from joint to joint
            angle, rate = angle + q[i], rate + w[i]
            across = across + self._lengths[i] * jnp.cos(angle) * rate
            up = up - self._lengths[i] * jnp.sin(angle) * rate
            # point masses, so links have no rotational inertia
            total = total + 0.5 * self._masses[i] * (across * across + up * up)
        return total

    def potential_energy(self, q: Joints) -> Number:
        """U(q), zero at the height of the first joint."""
        total: Number = 0.0
        angle: Number = 0.0
        height: Number = 0.0
        for i in range(self.links):
            angle = angle + q[i]
            # angles are from upright, so U is largest at q = 0, the unstable equilibrium
            height = height + self._lengths[i] * jnp.cos(angle)
            total = total + self._masses[i] * self.g * height
        return total

    def energy(self, x: State) -> Number:
        """T + U at the state x = (q, w): constant without torques, and dE/dt = w·τ with torques."""
        return self.kinetic_energy(x[: self.links], x[self.links :]) + self.potential_energy(x)

    def mass_matrix(self, q: Joints) -> jax.Array:
        """M(q), shape (n, n), symmetric and positive definite."""
        columns = self._mass(_scalars(q, self.links))
        # columns are stacked as rows, because M is symmetric
        return jnp.stack([jnp.stack(column) for column in columns])

    def coriolis(self, q: Joints, w: Joints) -> jax.Array:
        """V(q, w), shape (n,): the centrifugal and Coriolis torques."""
        return jnp.stack(self._coriolis(_scalars(q, self.links), _scalars(w, self.links)))

    def coriolis_matrix(self, q: Joints, w: Joints) -> jax.Array:
        """C(q, w) from Christoffel symbols, shape (n, n): C w equals ``coriolis``, and Ṁ − 2C is skew-symmetric."""
        # axes (i, j, k); the two transpositions below give ∂M_ik/∂q_j and ∂M_jk/∂q_i
        slopes = jax.jacfwd(self.mass_matrix)(jnp.stack(_scalars(q, self.links)))  # ∂M_ij/∂q_k
        symbols = slopes + slopes.swapaxes(1, 2) - slopes.transpose(2, 1, 0)
        # sum over k, the last axis of (n, n, n)
        return 0.5 * symbols @ jnp.stack(_scalars(w, self.links))

    def gravity(self, q: Joints) -> jax.Array:
        """G(q), shape (n,)."""
        return jnp.stack(self._gravity(_scalars(q, self.links)))

    def computed_torque(self, q: Joints, w: Joints, acceleration: Joints) -> Control:
        """(5.6), the torque M τ' + V + G that produces the acceleration q̈ = τ', shape (n,).

        Example:
          >>> arm = Manipulator(links=2)
          >>> q, w = jnp.array([0.3, -0.2]), jnp.array([1.0, 2.0])
          >>> x, torque = jnp.concatenate([q, w]), arm.computed_torque(q, w, jnp.array([5.0, -4.0]))
          >>> arm.drift(x, torque)[2:].round(3).tolist()
          [5.0, -4.0]
        """
        n = self.links
        angles, rates, wanted = (_scalars(vector, n) for vector in (q, w, acceleration))
        # sums of scalars instead of a matrix product, which a solver could not split into components
        matrix, bias, weight = self._mass(angles), self._coriolis(angles, rates), self._gravity(angles)
        return jnp.stack([sum(matrix[i][j] * wanted[j] for j in range(n)) + bias[i] + weight[i] for i in range(n)])

    def tracking(
        self, reference: Callable[[Number], State] | None = None, damping: Number = 3.0, stiffness: Number = 2.0
    ) -> Callable[..., Control]:
        """Build a feedback for ``simulate`` by computed torque: q̈ = q̈* − damping·(w − q̇*) − stiffness·(q − q*).

        Args:
          reference: q*, a function of time that returns shape (n,). The feedback then takes ``(t, x)``, so pass
            ``time_varying=True`` to ``simulate``. With ``None``, q* is upright and the feedback takes ``(x)``.
          damping: per unit of time.
          stiffness: per unit of time squared.
        """
        # Partials keep the arm's numbers and the gains as leaves, so that another mass does not recompile a simulation;
        # the default gains give λ² + 3λ + 2 with the roots −1 and −2, as (2.8) does for the pendulum
        if reference is None:
            return jax.tree_util.Partial(_hold_upright, self, damping, stiffness)
        return jax.tree_util.Partial(_track, self, damping, stiffness, as_partial(reference, "Manipulator.tracking"))

    def drift(self, x: State, tau: Control) -> State:
        """(w, M⁻¹(τ − V − G))."""
        n = self.links
        numbers = _scalars(x, 2 * n)
        q, w = numbers[:n], numbers[n:]
        bias, weight = self._coriolis(q, w), self._gravity(q)
        # the torque that accelerates, by (5.5)
        rest = [tau[i] - bias[i] - weight[i] for i in range(n)]
        return jnp.stack([*w, *_solve_positive(self._mass(q), rest)])

    def _mass(self, q: list[jax.Array]) -> list[list[jax.Array]]:
        """The columns of M(q)."""
        # T is quadratic in w, so its gradient at the unit vector e_j is column j of M
        zero, one = jnp.zeros((), q[0].dtype), jnp.ones((), q[0].dtype)
        # the dtype of q, otherwise a float32 solve would be promoted
        units = ([one if i == j else zero for i in range(self.links)] for j in range(self.links))
        return [jax.grad(self.kinetic_energy, argnums=1)(q, unit) for unit in units]

    def _coriolis(self, q: list[jax.Array], w: list[jax.Array]) -> list[jax.Array]:
        """V(q, w), one torque per joint."""

        def momentum(angles: list[jax.Array]) -> list[jax.Array]:
            return jax.grad(self.kinetic_energy, argnums=1)(angles, w)

        # (∂/∂q ∂T/∂w) w is a derivative in the direction w, so one forward pass suffices
        _, change = jax.jvp(momentum, (q,), (w,))
        pull = jax.grad(self.kinetic_energy, argnums=0)(q, w)
        return [change[i] - pull[i] for i in range(self.links)]

    def _gravity(self, q: list[jax.Array]) -> list[jax.Array]:
        """G(q), one torque per joint."""
        return jax.grad(self.potential_energy)(q)


def _hold_upright(arm: Manipulator, damping: Number, stiffness: Number, x: State) -> Control:
    """The torque that makes every joint a damped spring around upright."""
    q, w = x[: arm.links], x[arm.links :]
    return arm.computed_torque(q, w, -damping * w - stiffness * q)


def _track(
    arm: Manipulator,
    damping: Number,
    stiffness: Number,
    reference: Callable[[Number], State],
    t: Number,
    x: State,
) -> Control:
    """The torque that makes the tracking error of every joint a damped spring."""

    def rate(time: Number) -> State:  # q̇*; forward mode, because q* has one input and several outputs
        return jax.jvp(reference, (time,), (jnp.ones_like(time),))[1]

    q, w = x[: arm.links], x[arm.links :]
    acceleration = jax.jvp(rate, (t,), (jnp.ones_like(t),))[1]
    # ë + damping·ė + stiffness·e = 0 for e = q − q*, joint by joint
    wanted = acceleration - damping * (w - rate(t)) - stiffness * (q - reference(t))
    return arm.computed_torque(q, w, wanted)


def _scalars(vector: Joints, count: int) -> list[jax.Array]:
    """The first ``count`` entries of a vector as a list of scalars."""
    vector = jnp.asarray(vector)
    # jax.grad refuses integers
    vector = vector if jnp.issubdtype(vector.dtype, jnp.inexact) else vector.astype(float)
    return [vector[i] for i in range(count)]


def _solve_positive(matrix: list[list[jax.Array]], rest: list[jax.Array]) -> list[jax.Array]:
    """Solve a symmetric positive definite system of scalars by elimination without pivoting."""
    # all pivots are positive, so no pivoting is needed, whose order would differ between nodes
    n, matrix, rest = len(rest), [list(row) for row in matrix], list(rest)
    for k in range(n):
        for i in range(k + 1, n):
            # entries below the pivot are not zeroed, because nothing reads them again
            factor = matrix[i][k] / matrix[k][k]
            rest[i] = rest[i] - factor * rest[k]
            for j in range(k + 1, n):
                matrix[i][j] = matrix[i][j] - factor * matrix[k][j]
    # the matrix is upper triangular now: back substitution
    for k in reversed(range(n)):
        for j in range(k + 1, n):
            rest[k] = rest[k] - matrix[k][j] * rest[j]
        rest[k] = rest[k] / matrix[k][k]
    return rest


@front_door
def manipulator(
    *,
    links: int = 1,
    lengths: Number | Joints | None = None,
    masses: Number | Joints | None = None,
    g: Number = 9.81,
    torque: Number = 30.0,
    discount: Number = 0.0,
    shape: tuple[int, ...] | None = None,
) -> tuple[Problem, Grid]:
    """Raise an arm and hold it upright, at the cost ½(|x|² + |τ|²).

    Hanging down indefinitely costs ½π²/β with one link, and raising it from there costs 32 with the defaults. With a
    discount above about 0.15 hanging is cheaper, and the arm is not raised. The default grid for two or more links is
    coarse: it gives an approximate value, but hardly a feedback that holds the arm.

    Args:
      links: n; the state has 2n dimensions.
      lengths: n lengths, or one length for all links; ``None`` is 1.
      masses: n masses, or one mass for all links; ``None`` is 1.
      g: gravity.
      torque: the bound on each |τ_i|.
      discount: β.
      shape: number of nodes in the n angles (even) and the n velocities (odd), on [−π, π)ⁿ × [−8, 8]ⁿ, with one link
        on [−π, π) × [−10, 10]; ``None`` is 60 and 61 with one link, 20 and 21 with more links.
    """
    system = Manipulator(links=links, lengths=lengths, masses=masses, g=g)
    if shape is None:  # even numbers of angles and odd numbers of velocities put a node at rest upright
        shape = (60, 61) if links == 1 else (20,) * links + (21,) * links
    # with unit lengths and masses the horizontal arm needs the torque g with one link, 3g = 29.4 at joint 1 with two
    controls = Box([-torque] * links, [torque] * links)
    torques = ("torque",) if links == 1 else tuple(f"torque {i + 1}" for i in range(links))
    problem = Problem(
        system.drift,
        QuadraticCost(0.5, 0.5).rate,
        controls,
        discount=discount,
        control_names=torques,
        control_units=("N m",) * links,
    )
    names = ("angle", "velocity")
    fastest = 10.0 if links == 1 else 8.0  # with 8 the ends decide V at one node in twenty of one link
    grid = Grid(
        # n angles, then n velocities, as in the state; a free fall of one link reaches the speed 2√g = 6.3
        [-math.pi] * links + [-fastest] * links,
        [math.pi] * links + [fastest] * links,
        shape,
        periodic=(True,) * links + (False,) * links,
        names=names if links == 1 else tuple(f"{name} {i + 1}" for name in names for i in range(links)),
        units=("rad",) * links + ("rad/s",) * links,
    )
    return problem, grid
