"""Relative degree and exact input-output linearisation.

An output h of ẋ = f(x) + Σ g_j(x) u_j has relative degree r at x if L_g L_f^k h = 0 near x for k < r − 1 and
L_g L_f^{r−1} h(x) ≠ 0. Then

    u = α(x) + β(x) v,   β = (L_g L_f^{r−1} h)⁻¹,   α = −β L_f^r h,   ξ = (h, L_f h, …, L_f^{r−1} h)

turns ξ into a chain of integrators with the input v. The zero dynamics are the dynamics of the other n − r coordinates
for ξ = 0 and v = 0. With the same number of inputs and outputs, r is a vector and β an inverse matrix.

"Near x" means at x and at fixed sample points in the cube of half width ``radius`` around it. For analytic fields this
is wrong only for a set of sample points of measure zero. A number counts as zero if it is below ``tolerance`` (2e-13 by
default) relative to its terms (see ``scaling``). Compare the margin and the residue of a verdict with the tolerance.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.geometry.brackets import (
    Field,
    along,
    as_bool,
    as_fields,
    as_half_widths,
    as_pytree,
    as_state,
    compiled,
    decide,
    near,
    output_derivatives,
    rounding_of_terms,
    stack_fields,
    stack_outputs,
)
from hjbjax.geometry.scaling import Copies, balance, with_terms
from hjbjax.problem import arguments
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Control, DType, Number, State


@pytree_dataclass(static=("states",))
class RelativeDegree:
    """The result of ``relative_degree``: how often each output is differentiated before an input appears.

    Args:
      degrees: r_i, one per output; 0 if no input appears above the tolerance.
      decoupling: the matrix of L_{g_j} L_f^{r_i − 1} h_i at the state, shape (outputs, m).
      margin: its smallest singular value, in units that give the terms of every row and column size 1; above
        ``tolerance`` if the relative degree is defined.
      residue: the largest L_{g_j} L_f^k h_i, k < r_i − 1, that counts as zero, relative to its terms.
      tolerance: compare margin and residue with it.
      states: n.
    """

    degrees: Array
    decoupling: Array
    margin: Number
    residue: Number
    tolerance: Number
    states: int

    @property
    @front_door
    def defined(self) -> bool | jax.Array:
        """True if the inputs reach every output and the decoupling matrix has full rank at the state."""
        return as_bool((self.margin > self.tolerance) & jnp.all(jnp.asarray(self.degrees) > 0))

    @property
    @front_door
    def degree(self) -> int | None:
        """Σ r_i, the dimension of the linearised part; ``None`` if the relative degree is not defined."""
        return int(np.sum(self.degrees)) if self.defined else None

    @property
    @front_door
    def message(self) -> str:
        """The result in words, including the dimension of the zero dynamics."""
        degrees = np.asarray(self.degrees)
        if np.any(degrees == 0):
            return f"not defined: no input above the tolerance reaches output {int(np.argmin(degrees))}"
        if not self.defined:
            return (
                f"not defined: nearby {_in_words(degrees)}, but at this state the decoupling matrix is singular "
                f"(margin {float(self.margin):.2g}, tolerance {float(self.tolerance):.2g})"
            )
        return _verdict(degrees, self.states)


@pytree_dataclass(static=("degrees",))
class Linearisation:
    """The feedback u = α(x) + β(x) v that makes v the r-th derivative; unpacks as (alpha, beta, coordinates).

    Args:
      fields: f and the input fields, as pytrees.
      output: h.
      degrees: r_i, one per output; ``None`` to determine them around the origin at the first evaluation.
    """

    fields: tuple[Field, ...]
    output: Callable[[State], Array | Number]
    degrees: tuple[int, ...] | None

    def __iter__(self) -> Iterator[Callable]:
        return iter((self.alpha, self.beta, self.coordinates))

    def alpha(self, x: State) -> Control:
        """α(x) = −β (L_f^{r_i} h_i), shape (m,)."""
        with own_settings():
            last, matrix, _ = self._ladder(as_state(x))
            return -jnp.linalg.solve(matrix, last)  # more accurate than β times L_f^r h

    def beta(self, x: State) -> jax.Array:
        """β(x), the inverse of the matrix of L_{g_j} L_f^{r_i − 1} h_i, shape (m, m)."""
        with own_settings():
            return jnp.linalg.inv(self._ladder(as_state(x))[1])

    def coordinates(self, x: State) -> jax.Array:
        """ξ = (h_1, L_f h_1, …, L_f^{r_1 − 1} h_1, h_2, …), shape (Σ r_i,); a full set of coordinates if Σ r_i = n."""
        with own_settings():
            return self._ladder(as_state(x))[2]

    def control(self, x: State, v: Array) -> Control:
        """α(x) + β(x) v, shape (m,)."""
        with own_settings():
            last, matrix, _ = self._ladder(as_state(x))
            return jnp.linalg.solve(matrix, v - last)  # from ξ^(r) = L_f^r h + (L_g L_f^{r−1} h) u = v

    def zero_dynamics(self, x: State) -> State:
        """f + g α, shape (n,); the set {ξ = 0} is invariant, and the flow on it is the zero dynamics."""
        with own_settings():
            x = as_state(x)
            f, *gs = stack_fields(self.fields)(x)
            return f + jnp.stack(gs).T @ self.alpha(x)

    def zero_spectrum(self, x: State | Sequence[float]) -> np.ndarray:
        """The eigenvalues of the zero dynamics at a rest point with ξ = 0, shape (n − r,); not traceable.

        If all have negative real parts the system is minimum phase, and driving ξ to zero brings the state to rest.

        Raises:
          ValueError: x is not a rest point with ξ = 0.
        """
        with own_settings(x64=True):
            x = jnp.asarray(x, float)
            size = float(jnp.max(jnp.abs(self.coordinates(x)), initial=0) + jnp.max(jnp.abs(self.zero_dynamics(x))))
            # ``not <`` refuses NaN as well
            if not size < 1e-6:
                raise ValueError(
                    f"zero_spectrum: x = {x.tolist()} is not a rest point with ξ = 0; the deviation is {size:.2g}"
                )
            slopes, rates = np.asarray(jax.jacfwd(self.coordinates)(x)), np.asarray(jax.jacfwd(self.zero_dynamics)(x))
        # {ξ = 0} is invariant, so the linearised flow maps its tangent space, the kernel of ∂ξ/∂x, to itself
        kernel = np.linalg.svd(slopes)[2][len(slopes) :]
        return np.linalg.eigvals(kernel @ rates @ kernel.T)

    def message(self, states: int) -> str:
        """The relative degree of a system with n = ``states``, in words, including the zero dynamics."""
        with own_settings():
            return _verdict(self._known_degrees(states, float), states)

    def _ladder(self, x: State) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Compute L_f^{r_i} h_i, the decoupling matrix, and ξ."""
        degrees = self._known_degrees(x.shape[0], x.dtype)
        # values[k] is L_f^k h, shape (outputs,); slopes[k] are its derivatives along f, g_1, …, shape (1 + m, outputs)
        ladder = output_derivatives([stack_fields(self.fields[:1])] * (max(degrees) - 1), stack_outputs(self.output))
        values, slopes = along(ladder, x, stack_fields(self.fields)(x))
        top = [(r - 1, i) for i, r in enumerate(degrees)]
        last = jnp.stack([slopes[k][0, i] for k, i in top])
        matrix = jnp.stack([slopes[k][1:, i] for k, i in top])
        return last, matrix, jnp.stack([values[k][i] for i, r in enumerate(degrees) for k in range(r)])

    def _known_degrees(self, states: int, dtype: DType) -> tuple[int, ...]:
        """The prescribed r_i, or the r_i around the origin."""
        if self.degrees is not None:
            return self.degrees
        if is_traced(self.fields, self.output):
            raise ValueError("linearising_feedback: the fields are traced and x was not given; pass a concrete x=")
        with jax.ensure_compile_time_eval():  # uses only the length of the state, which is known under a tracer
            origin = jnp.zeros(states, dtype)

            # the default radius and samples of ``relative_degree``
            def rule(depth: int) -> RelativeDegree:
                tolerance = np.asarray(rounding_of_terms(origin.dtype))
                functions = (self.fields, self.output, np.full(states, 0.1))
                derive = compiled(_first_effects, (("samples", 16), ("depth", depth)))
                return compiled(_relative_degree, ())(derive(functions, origin, tolerance), origin, tolerance)

            return _degrees_or_refuse(_deepen(rule, states), "the origin")


@front_door
def relative_degree(
    f: Field,
    g: Field | Sequence[Field],
    h: Callable,
    x: State | Sequence[float],
    *,
    radius: float | Array = 0.1,
    samples: int = 16,
    tolerance: Number | None = None,
) -> RelativeDegree:
    """Compute the relative degree at a state: how often the outputs are differentiated before the inputs appear.

    It is not defined if L_g L_f^{r−1} h is zero at x but not near x, as for the ball and beam.

    Args:
      f: the drift.
      g: the input field, or a sequence of input fields.
      h: the output, a function of one state that returns one number or shape (outputs,).
      x: the state, shape (n,).

    Keyword Args:
      radius: half width of the neighbourhood of x, in the units of the state; one number, or shape (n,).
      samples: number of points sampled near x.
      tolerance: numbers below it, relative to their terms, count as zero; ``None`` is 1024 eps, 2e-13 in float64.

    Returns:
      A RelativeDegree, with ``degree``, ``defined`` and a ``message`` that names the zero dynamics.

    Raises:
      ValueError: a field or the radius has the wrong shape, or a derivative is not finite near x.

    Example:
      >>> drift = lambda x: jnp.stack([x[1], -x[0], x[0] - x[2]])
      >>> print(relative_degree(drift, lambda x: jnp.array([0.0, 1.0, 0.0]), lambda x: x[0], jnp.zeros(3)).message)
      relative degree 2 of 3 states: zero dynamics of dimension 1 on {h = L_f h = 0}
    """
    arguments.count(samples, "relative_degree: samples", least=0)
    states = np.shape(x)[0] if np.ndim(x) else 1
    functions = (as_fields(f, g), as_pytree(h), as_half_widths(radius, states, "relative_degree"))

    def rule(depth: int) -> RelativeDegree:
        options = {"samples": int(samples), "depth": depth}
        return decide(_first_effects, _relative_degree, functions, x, tolerance, rounding_of_terms, **options)

    # a traced verdict cannot end the loop of _deepen, so the program takes all n derivatives
    return rule(states) if is_traced(functions, x, tolerance) else _deepen(rule, states)


@front_door
def linearising_feedback(
    f: Field, g: Field | Sequence[Field], h: Callable, x: State | Sequence[float] | None = None
) -> Linearisation:
    """Construct the feedback u = α(x) + β(x) v that makes v the r-th derivative of the output.

    Args:
      f: the drift.
      g: the input field, or a sequence of input fields, one per output.
      h: the output, a function of one state that returns one number or shape (m,).
      x: the state around which the relative degree is determined, shape (n,); ``None`` is the origin.

    Returns:
      A Linearisation, which unpacks as α, β and the change of coordinates, each a function of one state.

    Raises:
      ValueError: the relative degree is not defined at x, or the numbers of inputs and outputs differ.

    Example:
      >>> swing = lambda x: jnp.stack([x[1], 9.81 * jnp.sin(x[0])])
      >>> alpha, beta, coordinates = linearising_feedback(swing, lambda x: jnp.array([0.0, 2.0]), lambda x: x[0])
      >>> x = jnp.array([1.0, 3.0])
      >>> float(alpha(x)[0] + 9.81 * jnp.sin(1.0) / 2), beta(x).tolist(), coordinates(x).tolist()
      (0.0, [[0.5]], [1.0, 3.0])
    """
    fields, output = as_fields(f, g), as_pytree(h)
    if x is None:
        return Linearisation(fields, output, None)
    if is_traced(fields, output, x):
        raise ValueError("linearising_feedback: got traced values; call it outside the trace")
    answer = relative_degree(f, g, h, x)
    return Linearisation(fields, output, _degrees_or_refuse(answer, f"x = {np.asarray(x).tolist()}"))


def _deepen(rule: Callable[[int], RelativeDegree], states: int) -> RelativeDegree:
    """Evaluate ``rule`` with as few derivatives as necessary."""
    # every derivative makes the program 2.7 times as long: for the ball and beam 30 operations at L_f h, 639 at
    # L_f^4 h. The depth grows by two, because each program takes two thirds of the compile time of the next one.
    for depth in range(2, states, 2):
        answer = rule(depth)
        if np.all(np.asarray(answer.degrees) > 0):
            return answer
    return rule(states)


def _degrees_or_refuse(answer: RelativeDegree, place: str) -> tuple[int, ...]:
    """The r_i of a defined relative degree; raises ValueError if it is not defined or outputs and inputs differ."""
    # β is an inverse matrix: with more inputs v does not determine u, with fewer most v are unreachable
    outputs, inputs = np.shape(answer.decoupling)
    if outputs != inputs:
        raise ValueError(f"linearising_feedback: got {outputs} outputs and {inputs} inputs, wanted the same number")
    if not answer.defined:
        raise ValueError(
            f"linearising_feedback: at {place} the relative degree is {answer.message}; choose another output or x"
        )
    return tuple(int(r) for r in answer.degrees)


def _in_words(degrees: Sequence[int] | np.ndarray) -> str:
    return str(int(degrees[0])) if len(degrees) == 1 else str(tuple(int(r) for r in degrees))


def _verdict(degrees: Sequence[int] | np.ndarray, states: int) -> str:
    """The relative degree and the dimension of its zero dynamics, in words."""
    text, total = f"relative degree {_in_words(degrees)} of {states} states: ", int(np.sum(degrees))
    if total == states:
        return text + "no zero dynamics"
    names = ["h", "L_f h", *(f"L_f^{k} h" for k in range(2, max(degrees)))][: max(degrees)]
    place = " = ".join(names) + " = 0" if len(degrees) == 1 else "ξ = 0"
    return text + f"zero dynamics of dimension {states - total} on {{{place}}}"


def _first_effects(
    functions: tuple[tuple[Field, ...], Callable, Array], x: State, tolerance: Number, *, samples: int, depth: int
) -> dict[str, jax.Array]:
    """For every output, find the first nonzero L_g L_f^k h, k < depth: degrees, decoupling, its terms, residue."""
    (f, *gs), h, radius = functions
    stacked = [stack_fields([f]), stack_fields(gs), stack_outputs(h)]

    def build(copies: Copies, y: State) -> jax.Array:
        drifts, inputs, outputs = copies
        slopes = jnp.stack(jax.jacfwd(output_derivatives(drifts[1:], outputs[0]))(y))  # (depth, outputs, n)
        return slopes @ inputs[0](y).T

    # both (points, depth, outputs, m)
    effects, terms = jax.vmap(lambda y: with_terms(build, stacked, y, depth))(near(x, radius, samples))
    # nonzero at any point near x: for the ball and beam L_g L_f² h = 2B r θ̇ is 0 only at rest, so the degree is not 4
    ratio = jnp.max(jnp.abs(effects) / jnp.where(terms > 0, terms, 1), axis=(0, -1))  # (depth, outputs)
    appears = ratio > tolerance
    # argmax of booleans is the first True, or 0 if there is none; ``reached`` distinguishes the two
    first, reached, outputs = jnp.argmax(appears, axis=0), jnp.any(appears, axis=0), jnp.arange(appears.shape[1])
    zeros = ~reached | (jnp.arange(depth)[:, None] < first)
    return {
        "degrees": jnp.where(reached, first + 1, 0),
        "decoupling": effects[0][first, outputs],
        "terms": terms[0][first, outputs],
        "residue": jnp.max(jnp.where(zeros, ratio, 0)),
    }


def _relative_degree(found: Mapping[str, Array], x: State, tolerance: Number) -> RelativeDegree:
    """The relative degree from the first nonzero effects of the inputs on the outputs."""
    decoupling, terms = found["decoupling"], found["terms"]
    if terms.size == 1:  # same result without compiling ``balance``, which takes as long as two derivatives
        margin = (jnp.abs(decoupling) / jnp.where(terms > 0, terms, 1))[0, 0]
    elif terms.shape[0] > terms.shape[1]:  # more outputs than inputs: the rows are dependent
        margin = jnp.zeros((), x.dtype)
    else:
        rows, columns = balance(terms)
        margin = jnp.linalg.svd(rows[:, None] * decoupling * columns, compute_uv=False)[-1]
    allowed = jnp.asarray(tolerance, x.dtype)
    return RelativeDegree(found["degrees"], decoupling, margin, found["residue"], allowed, x.shape[0])
