"""Mechanical systems with one to three degrees of freedom, and the problems of bringing them to rest.

    pendulum         θ̈ = g sin θ + τ/m           θ from upright, on S¹ × R
    Van der Pol      ẍ = μ(1 − x²)ẋ − x + u
    ball and beam    r̈ = B(r θ̇² − g sin θ), θ̈ = u
    flexible joint   I q̈₁ + M g L sin q₁ + k(q₁ − q₂) = 0, J q̈₂ + k(q₂ − q₁) = u
    quadrotor        m ẍ = −T sin θ, m z̈ = T cos θ − m g, I θ̈ = τ, in a vertical plane

The pendulum follows from mθ̈ − mg sin θ = τ. Equation (9.4) of the chapter prints the input gain g/m, which
``as_printed=True`` reproduces, because figures 10 to 12 may use it.
"""

import math

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import QuadraticCost, QuadraticValue, check_positive


@pytree_dataclass(static=("as_printed",))
class Pendulum:
    """A pendulum with a torque at its pivot, state (θ, θ̇), θ = 0 upright.

    Args:
      mass: m, at unit length.
      g: gravity; 9.81 m/s².
      as_printed: use the input gain g/m printed in (9.4), instead of 1/m.

    Example:
      >>> Pendulum(mass=2.0).drift(jnp.zeros(2), jnp.ones(1)).tolist()
      [0.0, 0.5]
    """

    mass: Number = 1.0
    g: Number = 9.81
    as_printed: bool = False

    def __post_init__(self) -> None:
        check_positive("Pendulum", mass=self.mass)

    @property
    def gain(self) -> Number:
        """θ̈ per unit of torque."""
        # 1/(m·1²): the inertia at unit length
        return (self.g if self.as_printed else 1.0) / self.mass

    def drift(self, x: State, u: Control) -> State:
        """(θ̇, g sin θ + gain·τ)."""
        # gravity accelerates away from upright, so upright is the unstable equilibrium
        return jnp.stack([x[1], self.g * jnp.sin(x[0]) + self.gain * u[0]])

    def linearising_torque(self, x: State) -> Control:
        """(2.8), τ = −mg sin θ − 3mθ̇ − 2mθ: the closed loop is θ̈ + 3θ̇ + 2θ = 0 for any angle."""
        # the first term cancels gravity; θ̈ + 3θ̇ + 2θ has the roots −1 and −2
        return jnp.stack([-(self.g * jnp.sin(x[0]) + 3 * x[1] + 2 * x[0]) / self.gain])

    def linear_torque(self, x: State) -> Control:
        """The design of (2.8) for the pendulum linearised at upright, τ = −mgθ − 3mθ̇ − 2mθ."""
        # g(sin θ − θ), of third order, remains in the closed loop, so it is good only near upright
        return jnp.stack([-(self.g * x[0] + 3 * x[1] + 2 * x[0]) / self.gain])


@pytree_dataclass()
class VanDerPol:
    """The Van der Pol oscillator, state (x, ẋ), with a stable limit cycle.

    Args:
      stiffness: μ ≥ 0; at zero the oscillator is harmonic.
    """

    stiffness: Number = 1.0

    def drift(self, x: State, u: Control) -> State:
        """(ẋ, μ(1 − x²)ẋ − x + u)."""
        # μ(1 − x²)ẋ drives the oscillator for |x| < 1 and damps it outside, which creates the limit cycle
        return jnp.stack([x[1], self.stiffness * (1 - x[0] * x[0]) * x[1] - x[0] + u[0]])


@pytree_dataclass()
class BallAndBeam:
    """A ball that rolls on a beam, state (r, ṙ, θ, θ̇), control θ̈; the model of Hauser, Sastry and Kokotović (1992).

    The output r has no relative degree where r θ̇ = 0, in particular at rest, so feedback cannot linearise it.

    Args:
      inertia: B, a factor that depends on the ball; 5/7 for a solid ball.
      g: gravity; 9.81 m/s².
    """

    # 5/7 = 1/(1 + 2/5); a rolling solid ball has the moment of inertia ⅖·mass·radius²
    inertia: Number = 5 / 7
    g: Number = 9.81

    def drift(self, x: State, u: Control) -> State:
        """(ṙ, B(r θ̇² − g sin θ), θ̇, u)."""
        # r θ̇² is the centrifugal acceleration, g sin θ the effect of the slope
        return jnp.stack([x[1], self.inertia * (x[0] * x[3] * x[3] - self.g * jnp.sin(x[2])), x[3], u[0]])

    def output(self, x: State) -> Number:
        """r, the position of the ball."""
        return x[0]


@pytree_dataclass()
class FlexibleJoint:
    """A link driven through a spring, state (q₁, q̇₁, q₂, q̇₂): link angle q₁ from hanging, motor angle q₂.

    Feedback linearises it for k > 0. The link angle has relative degree 4.

    Args:
      link: I, the inertia of the link.
      motor: J, the inertia of the motor.
      weight: M g L, the torque of gravity on the horizontal link.
      stiffness: k, the stiffness of the spring.
    """

    link: Number = 1.0
    motor: Number = 1.0
    weight: Number = 9.81
    stiffness: Number = 10.0

    def __post_init__(self) -> None:
        # the drift divides by the inertias; zero weight is allowed and describes an arm in a horizontal plane
        check_positive("FlexibleJoint", link=self.link, motor=self.motor)

    def drift(self, x: State, u: Control) -> State:
        """(q̇₁, −(MgL sin q₁ + k(q₁ − q₂))/I, q̇₂, (k(q₁ − q₂) + u)/J)."""
        spring = self.stiffness * (x[0] - x[2])  # the torque that slows the link and turns the motor
        return jnp.stack(
            # the spring acts on link and motor with opposite signs, the control only on the motor
            [x[1], -(self.weight * jnp.sin(x[0]) + spring) / self.link, x[3], (spring + u[0]) / self.motor]
        )

    def output(self, x: State) -> Number:
        """q₁, the angle of the link."""
        return x[0]


@pytree_dataclass()
class PlanarQuadrotor:
    """A quadrotor in a vertical plane, state (x, z, θ, ẋ, ż, θ̇), control (T, τ): thrust along its axis and torque.

    A grid for six states with 21 nodes per axis has 8.6e7 nodes; the value takes 0.34 GB in single precision.

    Args:
      mass: m.
      inertia: I, about the axis perpendicular to the plane.
      g: gravity; 9.81 m/s².

    Example:
      >>> quadrotor = PlanarQuadrotor(mass=0.5)
      >>> bool(jnp.all(quadrotor.drift(jnp.zeros(6), jnp.array([quadrotor.hover, 0.0])) == 0))
      True
    """

    mass: Number = 1.0
    inertia: Number = 0.1
    g: Number = 9.81

    def __post_init__(self) -> None:
        check_positive("PlanarQuadrotor", mass=self.mass, inertia=self.inertia)

    @property
    def hover(self) -> Number:
        """m g, the thrust that balances the weight."""
        return self.mass * self.g

    def drift(self, x: State, u: Control) -> State:
        """(ẋ, ż, θ̇, −T sin θ/m, T cos θ/m − g, τ/I)."""
        # for θ > 0 the thrust points towards negative x
        lift = u[0] / self.mass
        return jnp.stack([x[3], x[4], x[5], -lift * jnp.sin(x[2]), lift * jnp.cos(x[2]) - self.g, u[1] / self.inertia])


@front_door
def pendulum(
    *,
    mass: Number = 1.0,
    as_printed: bool = False,
    g: Number = 9.81,
    torque: Number | None = None,
    discount: Number = 0.0,
    shape: tuple[int, ...] = (200, 201),
) -> tuple[Problem, Grid]:
    """Swing a pendulum up and hold it there, at the cost ½(|x|² + τ²).

    There is no discount by default, because rest at upright costs nothing. An even number of angles and an odd number
    of velocities put a node exactly there.

    Args:
      mass: m.
      as_printed: use the input gain g/m printed in (9.4), instead of 1/m.
      g: gravity.
      torque: the bound on |τ|; ``None`` is 30, or 6 with ``as_printed``.
      discount: β.
      shape: number of nodes in angle (even) and velocity (odd), on [−π, π) × [−8, 8].
    """
    # for m = 1 the torque raises the pendulum without a swing: 30 > g, and 6g > g with the gain g/m as printed
    bound = (6.0 if as_printed else 30.0) if torque is None else torque
    system = Pendulum(mass=mass, g=g, as_printed=as_printed)
    # the cost θ² is not periodic: it has a kink at hanging, where both directions cost the same
    problem = Problem(
        system.drift,
        QuadraticCost(0.5, 0.5).rate,
        Box([-bound], [bound]),
        discount=discount,
        control_names=("torque",),
        control_units=("N m",),
    )
    # hanging is one node, because the nodes include −π but not π; a free fall reaches the speed 2√g = 6.3 < 8
    names, units = ("angle", "velocity"), ("rad", "rad/s")
    return problem, Grid([-math.pi, -8.0], [math.pi, 8.0], shape, periodic=(True, False), names=names, units=units)


@front_door
def pendulum_near_upright(
    *, mass: float = 1.0, as_printed: bool = False, g: float = 9.81, discount: float = 0.0
) -> QuadraticValue:
    """The leading term ½x'Px of the pendulum's value at upright, from SciPy's Riccati solver; not traceable.

    sin θ is odd, so the next term of the value is of fourth order in the state.

    Args:
      mass: m.
      as_printed: use the input gain g/m printed in (9.4), instead of 1/m.
      g: gravity.
      discount: β.
    """
    # imported here, because nothing else in this file needs SciPy
    from scipy.linalg import solve_continuous_are

    gain = Pendulum(mass, g, as_printed).gain  # raises for a mass ≤ 0, as the problem does
    # sin θ ≈ θ at upright; βV in the equation acts like the drift A − ½βI
    a = np.array([[0.0, 1.0], [g, 0.0]]) - 0.5 * discount * np.eye(2)
    matrix = solve_continuous_are(a, np.array([[0.0], [gain]]), np.eye(2), np.eye(1))
    return QuadraticValue(0.5 * matrix)  # the running cost is ½(|x|² + τ²), SciPy's cost is |x|² + τ²


@front_door
def van_der_pol(
    *, stiffness: Number = 1.0, bound: Number = 1.0, discount: Number = 0.5, shape: tuple[int, ...] = (121, 121)
) -> tuple[Problem, Grid]:
    """Damp a Van der Pol oscillator at the cost ½(|x|² + u²), |u| ≤ bound, on [−3, 3]².

    The discount keeps the value finite even if the bound is too small to leave the limit cycle.

    Args:
      stiffness: μ ≥ 0.
      bound: the bound on |u|.
      discount: β.
      shape: number of nodes in position and velocity; odd numbers put a node at rest.
    """
    problem = Problem(
        VanDerPol(stiffness).drift, QuadraticCost(0.5, 0.5).rate, Box([-bound], [bound]), discount=discount
    )
    # the box contains the limit cycle, whose amplitude in position is 2
    return problem, Grid([-3.0, -3.0], [3.0, 3.0], shape, names=("position", "velocity"))
