"""A planar arm of n links by differentiating its Lagrangian.

    M(q) q̈ + V(q, w) + G(q) = τ                                             (5.5)
    τ = M(q) τ' + V(q, w) + G(q), which makes q̈ = τ'                        (5.6)

q₁ is the angle of the first link from upright, q_i that of link i from the one before; each link is massless with
a point mass at its far end, so that one link is the pendulum. With the kinetic energy T = ½ w'M(q)w and the
potential energy U,

    M e_j = ∂T/∂w at w = e_j,    V = (∂/∂q ∂T/∂w) w − ∂T/∂q,    G = ∂U/∂q,

and V = C w with the matrix C_ij = ½ Σ_k (∂M_ij/∂q_k + ∂M_ik/∂q_j − ∂M_jk/∂q_i) w_k, for which Ṁ − 2C is skew.

Everything is done on lists of scalars: n is static, the loops unroll, and only elementwise operations are left,
which a solver can evaluate on a whole grid without forming a matrix a node.
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
from hjbjax.zoo.ingredients import QuadraticCost, positive

Joints: TypeAlias = Sequence[Number] | Array  # one number a joint: a vector, or a list of scalars


@pytree_dataclass(static=("links",))
class Manipulator:
    """A planar arm, state (q, w) in R^2n, one torque a joint.

    Args:
      links: n.
      lengths: n lengths, or one for all; ``None`` is 1.
      masses: n point masses at the far ends of the links, or one for all; ``None`` is 1.
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
    # m/s²; lengths and masses are in metres and kilograms then, torques in newton metres
    g: Number = 9.81

    def __post_init__(self):
        # True would pass for an int, and be one link
        if isinstance(self.links, bool) or not isinstance(self.links, int) or self.links < 1:
            raise ValueError(f"Manipulator: got links = {self.links!r}, wanted a positive integer")
        for name in ("lengths", "masses"):
            numbers = getattr(self, name)
            if numbers is None:
                object.__setattr__(self, name, (1.0,) * self.links)
            elif not isinstance(numbers, (list, tuple)) and np.ndim(numbers) == 0:
                object.__setattr__(self, name, (numbers,) * self.links)
            elif len(numbers) != self.links:
                raise ValueError(f"Manipulator.{name}: got {len(numbers)} numbers, wanted {self.links}: one a link")
            positive("Manipulator", **{name: getattr(self, name)})

    @property
    def _lengths(self) -> Joints:
        return cast(Joints, self.lengths)  # one number, or none, has become n of them in __post_init__

    @property
    def _masses(self) -> Joints:
        return cast(Joints, self.masses)

    def kinetic_energy(self, q: Joints, w: Joints) -> Number:
        """T(q, w), of vectors or lists of n scalars."""
        total: Number = 0.0
        angle: Number = 0.0
        rate: Number = 0.0
        across: Number = 0.0
        up: Number = 0.0
        for i in range(self.links):
            # joint angles are relative, so they add up from joint to joint, and so do the velocities (across, up)
            angle, rate = angle + q[i], rate + w[i]
            across = across + self._lengths[i] * jnp.cos(angle) * rate
            up = up - self._lengths[i] * jnp.sin(angle) * rate
            # point masses: no term of a link that turns about its own middle
            total = total + 0.5 * self._masses[i] * (across * across + up * up)
        return total

    def potential_energy(self, q: Joints) -> Number:
        """U(q), zero at the height of the first joint."""
        total: Number = 0.0
        angle: Number = 0.0
        height: Number = 0.0
        for i in range(self.links):
            angle = angle + q[i]
            # angles from upright: U is largest at q = 0, which is the unstable rest
            height = height + self._lengths[i] * jnp.cos(angle)
            total = total + self._masses[i] * self.g * height
        return total

    def energy(self, x: State) -> Number:
        """T + U at the state x = (q, w): constant without torque, and dE/dt = w·τ with it."""
        return self.kinetic_energy(x[: self.links], x[self.links :]) + self.potential_energy(x)

    def mass_matrix(self, q: Joints) -> jax.Array:
        """M(q), shape (n, n), symmetric and positive definite."""
        columns = self._mass(_scalars(q, self.links))
        # columns stacked as rows: M is symmetric
        return jnp.stack([jnp.stack(column) for column in columns])

    def coriolis(self, q: Joints, w: Joints) -> jax.Array:
        """V(q, w), shape (n,): the centrifugal and Coriolis torques."""
        return jnp.stack(self._coriolis(_scalars(q, self.links), _scalars(w, self.links)))

    def coriolis_matrix(self, q: Joints, w: Joints) -> jax.Array:
        """C(q, w) of Christoffel's symbols, shape (n, n): C w is ``coriolis``, and Ṁ − 2C is skew."""
        # (i, j, k); the swaps below put ∂M_ik/∂q_j and ∂M_jk/∂q_i at that place
        slopes = jax.jacfwd(self.mass_matrix)(jnp.stack(_scalars(q, self.links)))  # ∂M_ij/∂q_k
        symbols = slopes + slopes.swapaxes(1, 2) - slopes.transpose(2, 1, 0)
        # the sum over k, the last axis of (n, n, n)
        return 0.5 * symbols @ jnp.stack(_scalars(w, self.links))

    def gravity(self, q: Joints) -> jax.Array:
        """G(q), shape (n,)."""
        return jnp.stack(self._gravity(_scalars(q, self.links)))

    def computed_torque(self, q: Joints, w: Joints, acceleration: Joints) -> Control:
        """(5.6), the torque M τ' + V + G under which q̈ is the acceleration τ', shape (n,).

        Example:
          >>> arm = Manipulator(links=2)
          >>> q, w = jnp.array([0.3, -0.2]), jnp.array([1.0, 2.0])
          >>> x, torque = jnp.concatenate([q, w]), arm.computed_torque(q, w, jnp.array([5.0, -4.0]))
          >>> arm.drift(x, torque)[2:].round(3).tolist()
          [5.0, -4.0]
        """
        n = self.links
        angles, rates, wanted = (_scalars(vector, n) for vector in (q, w, acceleration))
        # sums of scalars and no matrix product, which a solver could not take apart into components
        matrix, bias, weight = self._mass(angles), self._coriolis(angles, rates), self._gravity(angles)
        return jnp.stack([sum(matrix[i][j] * wanted[j] for j in range(n)) + bias[i] + weight[i] for i in range(n)])

    def tracking(
        self, reference: Callable[[Number], State] | None = None, damping: Number = 3.0, stiffness: Number = 2.0
    ) -> Callable[..., Control]:
        """A feedback for ``simulate`` by computed torque: q̈ = q̈* − damping·(w − q̇*) − stiffness·(q − q*).

        Args:
          reference: q*, a function of time that returns shape (n,); the feedback then takes ``(t, x)``, so give
            ``time_varying=True`` as well. ``None``: upright, and the feedback takes ``(x)``.
          damping: per unit of time.
          stiffness: per unit of time squared.
        """
        # Partials, so that the arm's numbers and the gains are leaves: another mass recompiles no simulation
        # the default gains make λ² + 3λ + 2, with the roots −1 and −2, as (2.8) does for the pendulum
        if reference is None:
            return jax.tree_util.Partial(_hold_upright, self, damping, stiffness)
        return jax.tree_util.Partial(_track, self, damping, stiffness, as_partial(reference, "Manipulator.tracking"))

    def drift(self, x: State, tau: Control) -> State:
        """(w, M⁻¹(τ − V − G))."""
        n = self.links
        numbers = _scalars(x, 2 * n)
        q, w = numbers[:n], numbers[n:]
        bias, weight = self._coriolis(q, w), self._gravity(q)
        # (5.5) for q̈: what torque is left to accelerate
        rest = [tau[i] - bias[i] - weight[i] for i in range(n)]
        return jnp.stack([*w, *_solve_positive(self._mass(q), rest)])

    def _mass(self, q: list[jax.Array]) -> list[list[jax.Array]]:
        """The columns of M(q)."""
        # T is quadratic in w, so its gradient at the unit vector e_j is the column j of M.
        zero, one = jnp.zeros((), q[0].dtype), jnp.ones((), q[0].dtype)
        # in the dtype of q: mixed ones would promote a float32 solve
        units = ([one if i == j else zero for i in range(self.links)] for j in range(self.links))
        return [jax.grad(self.kinetic_energy, argnums=1)(q, unit) for unit in units]

    def _coriolis(self, q: list[jax.Array], w: list[jax.Array]) -> list[jax.Array]:
        """V(q, w), one torque a joint."""

        def momentum(angles: list[jax.Array]) -> list[jax.Array]:
            return jax.grad(self.kinetic_energy, argnums=1)(angles, w)

        # (∂/∂q ∂T/∂w) w is a derivative along w, so one forward pass gives it without the matrix
        _, change = jax.jvp(momentum, (q,), (w,))
        pull = jax.grad(self.kinetic_energy, argnums=0)(q, w)
        return [change[i] - pull[i] for i in range(self.links)]

    def _gravity(self, q: list[jax.Array]) -> list[jax.Array]:
        """G(q), one torque a joint."""
        return jax.grad(self.potential_energy)(q)


def _hold_upright(arm: Manipulator, damping: Number, stiffness: Number, x: State) -> Control:
    """The torque under which every joint is a damped spring around upright."""
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
    """The torque under which the error from the reference is a damped spring in every joint."""

    def rate(time: Number) -> State:  # q̇*; forward mode, since time is one number and q* may be many
        return jax.jvp(reference, (time,), (jnp.ones_like(time),))[1]

    q, w = x[: arm.links], x[arm.links :]
    acceleration = jax.jvp(rate, (t,), (jnp.ones_like(t),))[1]
    # ë + damping·ė + stiffness·e = 0 for e = q − q*, joint by joint
    wanted = acceleration - damping * (w - rate(t)) - stiffness * (q - reference(t))
    return arm.computed_torque(q, w, wanted)


def _scalars(vector: Joints, count: int) -> list[jax.Array]:
    """The first entries of a vector, each for itself."""
    vector = jnp.asarray(vector)
    # angles written as integers have no derivative: jax.grad would refuse them
    vector = vector if jnp.issubdtype(vector.dtype, jnp.inexact) else vector.astype(float)
    return [vector[i] for i in range(count)]


def _solve_positive(matrix: list[list[jax.Array]], rest: list[jax.Array]) -> list[jax.Array]:
    """The solution of a symmetric positive definite system by elimination without pivoting, on scalars."""
    # positive pivots come by themselves, so no order has to be chosen by values, which differ from node to node
    n, matrix, rest = len(rest), [list(row) for row in matrix], list(rest)
    for k in range(n):
        for i in range(k + 1, n):
            # entries below the pivot are not set to zero, since nothing reads them again
            factor = matrix[i][k] / matrix[k][k]
            rest[i] = rest[i] - factor * rest[k]
            for j in range(k + 1, n):
                matrix[i][j] = matrix[i][j] - factor * matrix[k][j]
    # upper triangular by now: from the last unknown back
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

    To hang down for ever costs ½π²/β with one link, to raise it from there 32 with the defaults: with a discount above
    .15 or so hanging is the cheaper, and the arm is not raised. The grid of two links or more is a coarse one: it gives
    a value, and hardly a feedback that holds.

    Args:
      links: n; the state has 2n dimensions.
      lengths: n lengths, or one for all; ``None`` is 1.
      masses: n masses, or one for all; ``None`` is 1.
      g: gravity.
      torque: the bound on each |τ_i|.
      discount: β.
      shape: nodes in the n angles (even) and the n velocities (odd), on [−π, π)ⁿ × [−8, 8]ⁿ; ``None`` is
        60 and 61 with one link, 20 and 21 with more.
    """
    system = Manipulator(links=links, lengths=lengths, masses=masses, g=g)
    if shape is None:  # an even number of angles has a node upright, an odd number of velocities one at rest
        shape = (60, 61) if links == 1 else (20,) * links + (21,) * links
    # with lengths and masses of 1 the level arm asks g of one link, 3g = 29.4 of the first of two: 30 holds it
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
    grid = Grid(
        # n angles, then n velocities, as in the state; a free fall of one link reaches 2√g = 6.3 at the bottom
        [-math.pi] * links + [-8.0] * links,
        [math.pi] * links + [8.0] * links,
        shape,
        periodic=(True,) * links + (False,) * links,
        names=names if links == 1 else tuple(f"{name} {i + 1}" for name in names for i in range(links)),
        units=("rad",) * links + ("rad/s",) * links,
    )
    return problem, grid
