"""Methods in time, as values: V at t − Δt from V at t. ``Tableau`` explains custom Runge–Kutta methods.

The discount is integrated exactly by steps in s with e^{−βτ} = 1 − β s, where τ = t₀ − t is the time since the step
began:

    dV/ds = (min max H − β V)/(1 − β s).

The right side is constant where H is, so any step is exact there. S = (1 − e^{−βΔt})/β is the length of a step in s,
and Δt without a discount.

Explicit: strong-stability-preserving Runge–Kutta methods of Shu and Osher, with F = dV/ds and S for Δt,

    W ← a_k V + (1 − a_k) (W + c Δt F(W)),    a = (0), (0, ½), (0, ¾, ⅓) with c = 1; (0, 0, ⅔, 0) with c = ½,

of order 1, 2, 3 and 3 in time. Each stage is a mean of Euler steps and preserves what an Euler step preserves: after
every stage V ← max(g, min(ψ, ·)) and the prescribed values, and for the monotone chain the order of two values and the
range of the data, if c S e^{βΔt} (max Q + β) ≤ 1, with Q the rate at which the chain leaves a node. Euler's step does
not require the factor e^{βΔt}. Slopes of higher order are up to 1.5 times as steep as in the chain. Where Euler
steps follow one another without a mean, as with 1 and with 4 stages, Q is then the rate for 1.5 times the drift. A
custom ``Tableau`` is passed to ``Explicit(stages=...)``.

Implicit (Euler): with V at t known and S' = S e^{βΔt}, W = V(·, t − Δt) solves the stationary problem

    min{ max{ (β + 1/S') W − V/S' − min max H(W), W − ψ }, W − g } = 0,

that is, with discount β + 1/S' and V/S' added to the running cost: any Δt, monotone, order 1. A step ends when the
additive certificate of that problem is small enough, or the residual is rounding.
"""

import abc
import dataclasses
import math
from typing import Any, Protocol, TypeAlias

import jax
import jax.numpy as jnp

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import adjoint, bellman, certificates, methods
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation
from hjbjax.iteration.certificates import Certificate, Iterate
from hjbjax.iteration.evaluation import Evaluation, check_evaluation, evaluate
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.layouts import Layout
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, is_traced, pytree_dataclass
from hjbjax.problem.types import DType, Field, Number, Numbers, Scalar, Verdict

ROUNDING = 16  # in units in the last place of max|V|: smaller residuals are rounding
TOL = 1e-6  # cost units, for a value whose range is one or more
REPLIES = 20  # largest number of responses of the inner player to one policy of the outer player


def stretched(dt: Number, problem: Problem, dtype: DType) -> Scalar:
    """(e^{βΔt} − 1)/β, the cost of a unit rate over Δt, growing with the discount; Δt without a discount."""
    dt = jnp.asarray(dt, dtype)
    if problem.discounted is False:
        return dt
    discount = jnp.asarray(problem.discount, dtype)
    some = discount > 0
    # the inner where keeps 0/0 out of the branch not taken, whose NaN would enter the derivative
    return jnp.where(some, jnp.expm1(discount * dt) / jnp.where(some, discount, 1), dt)


def longest_step(rate: Scalar, problem: Problem, share: Numbers, tableau: "Tableau") -> jax.Array:
    """The longest time step; inf if nothing moves. Its Euler stages are monotone if ``share`` is 1/c.

    Args:
      rate: the largest Q + β, per unit time.
      problem: with the discount β.
      share: the step in units of 1/(max Q + β), for a small discount; one or several.
      tableau: the stages.
    """
    moves = rate > 0
    # the inner where keeps 1/0 out of the branch not taken, whose NaN would enter the derivative
    step = jnp.where(moves, share / jnp.where(moves, rate, 1), jnp.inf)
    if problem.discounted is False or len(tableau.means) == 1:
        return step
    scaled = jnp.where(moves, jnp.asarray(problem.discount, step.dtype) * jnp.where(moves, step, 1), 0)
    some = scaled > 0  # S e^{βΔt} (Q + β) equals the share if βΔt = log(1 + β share/(Q + β))
    return step * jnp.where(some, jnp.log1p(scaled) / jnp.where(some, scaled, 1), 1)


class Marching(Protocol):
    """The view of a march that is passed to its method."""

    @property
    def on(self) -> Discretisation:
        """The problem on its grid."""

    @property
    def horizon(self) -> Number:
        """The time at which the terminal cost is paid."""

    def obstacles_at(self, t: Number) -> Obstacles:
        """Fixed nodes and constraints at the time t."""

    def rate(self, value: Field, t: Number) -> tuple[Field, Any]:
        """F = min max H − β V, cost per unit time, with the rates and the noise under the optimal actions."""

    def look(self, value: Field, u: list, d: list, t: Number) -> Any:
        """The fastest rate under these actions, noise that the chain cannot represent, and drift that is cut off."""

    def nothing_seen(self) -> Any:
        """The outcome before the first evaluation."""


@dataclasses.dataclass(frozen=True)
class Tableau:
    """An explicit Runge–Kutta method made of Euler steps: W ← a_k V + (1 − a_k) (W + c Δt F(W)), starting at W = V.

    Such a method is strong-stability preserving with steps 1/c times as long as Euler's. Its order is not checked.

    Args:
      means: a_k, the weight of V in the result of every stage, from 0 to below 1.
      euler: c, the length of the Euler steps relative to the whole step.

    Raises:
      ValueError: weights or length are out of range, or the stages do not end at the end of the step.

    Example:
      >>> Tableau((0.0, 0.0, 1 / 3), 1 / 2).times  # of second order, with steps twice as long as Euler's
      (0.0, 0.5, 1.0, 1.0)
    """

    means: tuple[float, ...]
    euler: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "means", tuple(map(float, self.means)))
        if not self.means or not all(0 <= share < 1 for share in self.means):
            raise ValueError(f"Tableau: got means = {self.means!r}, wanted one number per stage, from 0 to below 1")
        arguments.positive(self.euler, "Tableau: euler", most=1)
        if self.times[-1] != 1:
            raise ValueError(f"Tableau: the last stage ends at {self.times[-1]:g} of a step, wanted 1: see .times")

    @property
    def in_succession(self) -> bool:
        """True if an Euler step starts where another one ended, without a mean in between."""
        return len(self.means) == 1 or 0 in self.means[1:]

    @property
    def times(self) -> tuple[float, ...]:
        """The times at which the stages evaluate F, and the end of the last stage, in units of the step."""
        found = [0.0]
        for share in self.means:
            # 1/3 and 2/3 are not binary fractions: rounded to 12 digits the last stage of a valid tableau ends exactly
            # at 1
            found.append(round((1 - share) * (found[-1] + self.euler), 12))
        return tuple(found)


TABLEAUX = {
    1: Tableau((0.0,)),  # Euler
    2: Tableau((0.0, 1 / 2)),  # Heun
    3: Tableau((0.0, 3 / 4, 1 / 3)),  # Shu and Osher's
    4: Tableau((0.0, 0.0, 2 / 3, 0.0), 1 / 2),  # Spiteri and Ruuth's, of order 3
}


class TimeMethod(abc.ABC):
    """The base class of methods that advance V from t to t − Δt; registered with JAX as pytrees.

    A method defines ``step``; everything else has a default.
    """

    @property
    def limited(self) -> bool:
        """True if steps longer than ``courant``/(max Q + β) are unstable."""
        return False

    @property
    def courant(self) -> Number:
        """The length of its steps times max Q + β."""
        return math.inf

    @property
    def tableau(self) -> Tableau:
        """Its stages, that is, the times within a step at which rates are evaluated."""
        return TABLEAUX[1]

    @property
    def monotone_only(self) -> bool:
        """True if it uses the matrix of a chain, and so requires a monotone scheme."""
        return False

    @property
    def evaluation(self) -> Evaluation | None:
        """The solver for the equation of a policy; None if the method does not solve any, or if the problem decides."""
        return None

    @property
    def tol(self) -> Number | None:
        """A bound on the sum of the steps' algebraic errors over a march, in cost units; None for the default."""
        return None

    @property
    def in_parts(self) -> bool:
        """True if ``step`` reads other nodes through ``stencil`` only, so that devices can share the nodes."""
        return False

    def filled(self, on: Discretisation, evaluation: Evaluation | None = None) -> "TimeMethod":
        """The method with open settings taken from the scheme and from the ``evaluation`` for the problem."""
        return self

    @abc.abstractmethod
    def step(self, march: Marching, value: Field, t: Number, end: Number, dt: Number) -> tuple[Field, Scalar, Any]:
        """V at ``end`` = t − Δt from V at t, true if the step succeeded, and the rates and the noise."""

    def described(self) -> str:
        """The method as source text."""
        return repr(self)


@pytree_dataclass(static=("stages",))
class Explicit(TimeMethod):
    """Explicit steps by a strong-stability-preserving Runge–Kutta method.

    Args:
      stages: 1 (Euler), 2 or 3, which is also the order in time; 4, of order 3 with longer steps; a custom
        ``Tableau``; or ``None`` for the choice of the scheme: 1 for ``Upwind``, 3 for ``Weno5``, else 2. With 4 stages
        the steps are twice as long with ``Upwind`` and where noise dominates, which takes two thirds of the
        evaluations of 3. Otherwise they are 1.3 times as long, and it takes about the evaluations of 3.
      fraction: the step in units of the stability limit, at most 1. The limit is 1/(max Q + β), or twice that with 4
        stages. With 1 and 4 stages the drift counts 1.5 times, except with ``Upwind``.
    """

    stages: int | Tableau | None = None
    fraction: Number = 0.9
    limited, in_parts = True, True

    def __post_init__(self) -> None:
        # True equals 1 in Python, and would select Euler's method
        named = not isinstance(self.stages, bool) and self.stages in (None, *TABLEAUX)
        if not named and not isinstance(self.stages, Tableau):
            raise ValueError(f"Explicit: got stages = {self.stages!r}, wanted 1, 2, 3, 4, a Tableau or None")
        arguments.positive(self.fraction, "Explicit: fraction", most=1)

    @property
    def tableau(self) -> Tableau:
        """The tableau of the stages, which must not be open."""
        assert self.stages is not None
        return self.stages if isinstance(self.stages, Tableau) else TABLEAUX[self.stages]

    @property
    def courant(self) -> Number:
        """The length of a step times max Q + β."""
        return self.fraction / self.tableau.euler

    def filled(self, on: Discretisation, evaluation: Evaluation | None = None) -> "Explicit":
        """The method with the stages of the scheme, unless it has its own; its numbers in the dtype of the march."""
        return Explicit(self.stages or on.scheme.stages, _as(self.fraction, on.dtype))

    def step(self, march: Marching, value: Field, t: Number, end: Number, dt: Number) -> tuple[Field, Scalar, Any]:
        """V at ``end`` = t − Δt from V at t by the stages of the tableau, true, and the rates and the noise."""
        dtype, tableau, fine = value.dtype, self.tableau, jnp.ones((), bool)
        length = -stretched(-dt, march.on.problem, dtype)  # S
        if len(tableau.means) == 1:  # Euler: avoids a loop with one iteration
            rate, seen = march.rate(value, t)
            return march.obstacles_at(t - dt).impose(value + length * rate), fine, seen
        means, starts, ends = (
            jnp.asarray(table, dtype) for table in (tableau.means, tableau.times[:-1], tableau.times[1:])
        )

        def stage(k: Scalar, carry: tuple[Field, Any]) -> tuple[Field, Any]:
            w, seen = carry
            begun, factor = _elapsed(march.on.problem, starts[k], length, dt)
            rate, now = march.rate(w, t - begun)
            # a mean of V and an Euler step with weights ≥ 0 preserves what an Euler step preserves
            moved = means[k] * value + (1 - means[k]) * (w + tableau.euler * length * factor * rate)
            ended, _ = _elapsed(march.on.problem, ends[k], length, dt)
            return march.obstacles_at(t - ended).impose(moved), seen.joined(now)

        # a loop, so that the slopes are compiled once instead of once per stage
        value, seen = jax.lax.fori_loop(0, len(tableau.means), stage, (value, march.nothing_seen()))
        return value, fine, seen

    def described(self) -> str:
        """The method as source text."""
        return f"Explicit(stages={self.stages}, fraction={float(self.fraction):g})"


@pytree_dataclass(static=("max_steps",))
class Implicit(TimeMethod):
    """Implicit Euler steps, each by policy iteration: any length, first order in time.

    Args:
      evaluation: the method of policy evaluation; ``None`` is ``Krylov()`` with noise and ``Sweeps()`` without.
      tol: bound on the sum of the policy iterations' errors over the march, in cost units; ``None`` is 1e-6, times the
        range max V − min V if this is less than one.
      max_steps: the largest number of policy improvements in one step.
    """

    evaluation: Evaluation | None = None
    tol: Number | None = None
    max_steps: int = 100
    monotone_only, in_parts = True, True

    def __post_init__(self) -> None:
        if self.evaluation is not None:
            check_evaluation(self.evaluation, "Implicit: evaluation")
        if self.tol is not None:
            arguments.positive(self.tol, "Implicit: tol", "in the units of the cost")
        arguments.count(self.max_steps, "Implicit: max_steps")

    def filled(self, on: Discretisation, evaluation: Evaluation | None = None) -> "Implicit":
        """The method with this evaluation, unless it has its own, and its numbers in the dtype of the march."""
        tol = None if self.tol is None else _as(self.tol, on.dtype)
        return Implicit(self.evaluation or evaluation, tol, self.max_steps)

    def step(self, march: Marching, value: Field, t: Number, end: Number, dt: Number) -> tuple[Field, Scalar, Any]:
        """V at ``end`` from V at t, true if the policy iteration converged, and rates and noise of its last policy."""
        # the chain, the costs and the constraints at the time of W, and V/Δt from the previous time
        question = ImplicitStep.of(march.on.at(end), march.obstacles_at(end), value, dt)
        assert self.evaluation is not None
        # the errors of the steps add up over the march, so each step gets a fraction of the tolerance
        tol = Tolerance((TOL if self.tol is None else self.tol) * dt / march.horizon, of_spread=self.tol is None)
        # the derivative of the solution, not of the iteration
        known, start, tol = jax.lax.stop_gradient((question, value, tol))
        value, policy, ok = known.solve(start, self.evaluation, tol, self.max_steps)
        found = value, policy, known.equation(value, policy)
        value = adjoint.attach_step(question.on, question.obstacles, question.arriving, found, self.evaluation)
        return value, ok, march.look(value, list(policy.controls), list(policy.disturbances), end)

    def described(self) -> str:
        """The method as source text."""
        tol = "" if self.tol is None else f", tol={float(self.tol):g}"
        return f"Implicit({self.evaluation!r}{tol})"


def _elapsed(problem: Problem, share: Scalar, length: Scalar, dt: Number) -> tuple[Scalar, Scalar | float]:
    """τ at a fraction of the step's length S in s, and the factor 1/(1 − β s) there."""
    if problem.discounted is False:
        return share * dt, 1.0
    discount = jnp.asarray(problem.discount, length.dtype)
    some = discount > 0
    left = 1 - discount * share * length
    time = -jnp.log(left) / jnp.where(some, discount, 1)
    # at the end exactly Δt, which the logarithm returns only up to rounding
    return jnp.where(some & (share < 1), time, share * dt), 1 / left


def _as(number: Number, dtype: DType) -> Number:
    """A number in the dtype of a march; a traced number keeps its dtype."""
    return number if is_traced(number) else jnp.asarray(number, dtype)


@pytree_dataclass(static=("of_spread",))
class Tolerance:
    """The allowed error of W in a step: ``size`` cost units, times max W − min W if this is less than one."""

    size: Number
    of_spread: bool

    def at(self, value: Field, layout: Layout) -> Scalar:
        """The bound at W, cost units."""
        if not self.of_spread:
            return jnp.asarray(self.size, value.dtype)
        return jnp.asarray(self.size * jnp.minimum(1, layout.largest(value) - layout.least(value)), value.dtype)


# the value, its policy, the residual, True if it is small enough, the least residual before, and the number of steps
Improvement: TypeAlias = tuple[Field, Greedy, Scalar, Verdict, Scalar, Scalar]


@pytree_dataclass()
class ImplicitStep:
    """The stationary problem of one implicit step.

    Args:
      on: the problem with discount β + 1/Δt on its grid at the time of W.
      obstacles: fixed nodes and constraints at that time.
      arriving: V/Δt, a part of the running cost.
    """

    on: Discretisation
    obstacles: Obstacles
    arriving: Field

    @classmethod
    def of(cls, on: Discretisation, obstacles: Obstacles, value: Field, dt: Number) -> "ImplicitStep":
        """The problem whose solution is V a time Δt before ``value``, for the chain at that earlier time."""
        rate = 1 / stretched(dt, on.problem, value.dtype)
        # not by Problem(...), which refuses a discount together with a running maximum
        shifted = altered(on.problem, discount=on.problem.discount + rate)
        return cls(on.asking(shifted), obstacles, value * rate)

    @property
    def grid(self) -> Grid:
        """The nodes."""
        return self.on.grid

    @property
    def layout(self) -> Layout:
        """The layout of the nodes."""
        return self.grid.layout

    def equation(self, value: Field, policy: Greedy) -> PolicyEquation:
        """The linear equation of a policy at ``value``."""
        return bellman.policy_equation(self.on, value, policy, self.obstacles)

    def reply(self, value: Field, policy: Greedy) -> Greedy:
        """The inner player's response to the outer player's policy."""
        return self._complete(bellman.respond(self.on, value, self.obstacles.fixed, policy))

    def impose(self, value: Field) -> Field:
        """``value`` with fixed values inserted and constraints imposed."""
        return self.obstacles.impose(value)

    def residual(self, equation: PolicyEquation) -> Scalar:
        """The largest |source|, in cost units."""
        return self.layout.largest(jnp.abs(equation.source))

    def solve(
        self, value: Field, evaluation: Evaluation, tol: Tolerance, max_steps: int
    ) -> tuple[Field, Greedy, jax.Array]:
        """W, its policy, and true if the error of W is below ``tol`` or rounding.

        Args:
          value: the initial guess.
          evaluation: the method of policy evaluation.
          tol: bound on the algebraic error of the step.
          max_steps: the largest number of policy improvements.
        """

        def look(value: Field, incumbent: Greedy) -> tuple[Greedy, Scalar, Verdict]:
            # the incumbent stays a candidate, since a search between samples may miss it and alternate between two
            # actions
            policy = self._complete(bellman.greedy(self.on, value, self.obstacles.fixed, incumbent=incumbent))
            equation = self.equation(value, policy)
            iterate = Iterate(self.layout, value, policy, equation, self.obstacles, counted=True)
            bound = certificates.error_bound(Certificate.ADDITIVE, iterate, discount=self.on.problem.discount)
            # the tolerance of a short step may be less than the rounding error of V, and could not be reached
            rounding = ROUNDING * jnp.finfo(value.dtype).eps * self.layout.largest(jnp.abs(value))
            # below this, relative accuracy is lost to underflow, as for a horizon of 1e-300
            rounding = jnp.maximum(rounding, jnp.finfo(value.dtype).tiny / jnp.finfo(value.dtype).eps)
            enough = (bound.error <= tol.at(value, self.layout)) | (bound.residual <= rounding)
            return policy, bound.residual, enough

        def unfinished(carry: Improvement) -> Verdict:
            _, _, residual, done, _, count = carry
            # the march reports NaN
            return ~done & (count <= max_steps) & ((count == 0) | jnp.isfinite(residual))

        def improve(carry: Improvement) -> Improvement:
            value, policy, residual, _, least, count = carry
            before = residual
            policy, residual, done = look(value, policy)

            def evaluated() -> Field:
                goal = methods.inner_goal(residual, jnp.minimum(least, before))
                return self._evaluated(value, policy, goal, evaluation)

            goes_on = ~done & jnp.isfinite(residual) & (count < max_steps)
            value = jax.lax.cond(goes_on, evaluated, lambda: value)
            return value, policy, residual, done, jnp.minimum(least, before), count + 1

        start = self.impose(value)  # V at t is a guess for W with an error of O(Δt)
        endless, zero = jnp.asarray(jnp.inf, start.dtype), jnp.zeros_like(start)
        sizes = (0 if each is None else each.dim for each in (self.on.problem.controls, self.on.problem.disturbances))
        undecided = Greedy(zero, *((zero,) * size for size in sizes))  # projected into the sets before use
        carry = (start, undecided, endless, jnp.zeros((), bool), endless, jnp.zeros((), jnp.int32))
        value, policy, _, done, _, _ = jax.lax.while_loop(unfinished, improve, carry)
        return value, policy, done

    def _complete(self, policy: Greedy) -> Greedy:
        """A policy of the problem with its defect, including V/Δt."""
        # V/Δt is not part of the problem's cost; it is the same for all actions, so it does not affect the choice
        return dataclasses.replace(policy, defect=jnp.where(self.obstacles.fixed, 0, policy.defect + self.arriving))

    def _evaluated(self, value: Field, policy: Greedy, goal: Number, evaluation: Evaluation) -> Field:
        """The approximate value of the policy, or of the outer player's policy in a game."""
        if self.on.problem.is_game:
            return methods.evaluated(self, value, policy, evaluation, goal=goal, replies=REPLIES)
        return self.impose(value + evaluate(evaluation, self.equation(value, policy), self.grid))
