"""Relative degree, and exact linearisation from input to output.

An output h of ẋ = f(x) + Σ g_j(x) u_j has relative degree r at x when L_g L_f^k h = 0 near x for k < r − 1 and
L_g L_f^{r−1} h(x) ≠ 0. Then

    u = α(x) + β(x) v,   β = (L_g L_f^{r−1} h)⁻¹,   α = −β L_f^r h,   ξ = (h, L_f h, …, L_f^{r−1} h)

makes ξ a chain of integrators that ends in v. What n − r other coordinates do while ξ = 0 and v = 0 are the zero
dynamics. With several inputs and as many outputs r is a vector and β an inverse matrix.

"Near x" is decided at x and at points spread over the cube of half width ``radius`` around it, the same in every
call; for analytic fields that misses a set of measure zero. What counts as zero is ``tolerance``, √eps unless given,
relative to what it is made of; the margin of a verdict is to be compared with it.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.geometry.brackets import Field, along, as_fields, as_state, decide, floating, stacked
from hjbjax.problem import arguments
from hjbjax.problem.pytree import as_partial, is_traced, pytree_dataclass


@pytree_dataclass(static=("states",))
class RelativeDegree:
    """How often each output is differentiated before an input appears.

    Args:
      degrees: r_i, one an output; 0 where no input ever appears.
      decoupling: the matrix of L_{g_j} L_f^{r_i − 1} h_i at the state, shape (outputs, m).
      margin: its smallest singular value, each row relative to what it is made of; above ``tolerance`` where the
        relative degree is defined.
      tolerance: what the margin is compared with.
      states: n.
    """

    degrees: Any
    decoupling: Any
    margin: Any
    tolerance: Any
    states: int

    @property
    def defined(self) -> Any:
        """Whether inputs reach every output, and no combination of the outputs loses them at the state."""
        return plain((self.margin > self.tolerance) & jnp.all(jnp.asarray(self.degrees) > 0))

    @property
    def degree(self) -> int | None:
        """Σ r_i, the number of states that the outputs govern; ``None`` where it is not defined."""
        return int(np.sum(self.degrees)) if self.defined else None

    @property
    def message(self) -> str:
        """The verdict in words; it names the zero dynamics where there are any."""
        degrees = np.asarray(self.degrees)
        if np.any(degrees == 0):
            return f"not defined: no input ever reaches output {int(np.argmin(degrees))}"
        if not self.defined:
            return (
                f"not defined: nearby {_listed(degrees)}, but at this state the decoupling matrix is singular "
                f"(margin {float(self.margin):.2g}, tolerance {float(self.tolerance):.2g})"
            )
        return _named(degrees, self.states)


@pytree_dataclass(static=("degrees",))
class Linearisation:
    """u = α(x) + β(x) v, which makes v the r-th derivative of the output; unpacks as (alpha, beta, coordinates).

    Args:
      fields: f and the input fields, as pytrees.
      output: h.
      degrees: r_i, one an output; ``None`` to decide them around the origin when a state is first seen.
    """

    fields: Any
    output: Any
    degrees: tuple[int, ...] | None

    def __iter__(self):
        return iter((self.alpha, self.beta, self.coordinates))

    def alpha(self, x: Any) -> Any:
        """α(x) = −β (L_f^{r_i} h_i), shape (m,)."""
        last, matrix, _ = self._ladder(as_state(x))
        return -jnp.linalg.solve(matrix, last)

    def beta(self, x: Any) -> Any:
        """β(x), the inverse of the matrix of L_{g_j} L_f^{r_i − 1} h_i, shape (m, m)."""
        return jnp.linalg.inv(self._ladder(as_state(x))[1])

    def coordinates(self, x: Any) -> Any:
        """ξ = (h_1, L_f h_1, …, L_f^{r_1 − 1} h_1, h_2, …), shape (Σ r_i,): all coordinates where Σ r_i = n."""
        return self._ladder(as_state(x))[2]

    def control(self, x: Any, v: Any) -> Any:
        """α(x) + β(x) v, shape (m,)."""
        last, matrix, _ = self._ladder(as_state(x))
        return jnp.linalg.solve(matrix, v - last)

    def zero_dynamics(self, x: Any) -> Any:
        """f + g α, shape (n,): it keeps {ξ = 0}, and what it does there is the zero dynamics."""
        x = as_state(x)
        f, *gs = stacked(self.fields)(x)
        return f + jnp.stack(gs).T @ self.alpha(x)

    def zero_spectrum(self, x: Any) -> np.ndarray:
        """The eigenvalues of the zero dynamics at a rest point with ξ = 0, shape (n − r,); host level.

        All in the left half plane: minimum phase, and a v that brings ξ to zero brings the state to rest.

        Raises:
          ValueError: x is no such rest point.
        """
        with jax.enable_x64(True):
            x = jnp.asarray(x, float)
            size = float(jnp.max(jnp.abs(self.coordinates(x)), initial=0) + jnp.max(jnp.abs(self.zero_dynamics(x))))
            if not size < 1e-6:
                raise ValueError(
                    f"zero_spectrum: x = {x.tolist()} is no rest point with ξ = 0: it is off by {size:.2g}"
                )
            slopes, rates = np.asarray(jax.jacfwd(self.coordinates)(x)), np.asarray(jax.jacfwd(self.zero_dynamics)(x))
        kernel = np.linalg.svd(slopes)[2][len(slopes) :]
        return np.linalg.eigvals(kernel @ rates @ kernel.T)

    def message(self, states: int) -> str:
        """What the feedback reaches of ``states`` coordinates; it names the zero dynamics where there are any."""
        return _named(self._decided(states, float), states)

    def _ladder(self, x: Any) -> tuple:
        """L_f^{r_i} h_i, the decoupling matrix, and ξ."""
        degrees = self._decided(x.shape[0], x.dtype)
        values, slopes = along(_derivatives(self.fields[0], self.output, max(degrees)), x, stacked(self.fields)(x))
        top = [(r - 1, i) for i, r in enumerate(degrees)]
        last = jnp.stack([slopes[k][0, i] for k, i in top])
        matrix = jnp.stack([slopes[k][1:, i] for k, i in top])
        return last, matrix, jnp.stack([values[k][i] for i, r in enumerate(degrees) for k in range(r)])

    def _decided(self, states: int, dtype: Any) -> tuple[int, ...]:
        if self.degrees is not None:
            return self.degrees
        if is_traced(self.fields, self.output):
            raise ValueError("linearising_feedback: the fields are traced and no x was given; give a concrete x=")
        with jax.ensure_compile_time_eval():  # only the length of the state is needed, which a tracer has too
            origin = jnp.zeros(states, dtype)

            def rule(depth):
                tolerance = jnp.finfo(origin.dtype).eps ** 0.5
                return _relative_degree(
                    (self.fields, self.output), origin, tolerance, radius=0.1, samples=16, depth=depth
                )

            return _degrees_or_refuse(_deepen(rule, states), "the origin")


def relative_degree(
    f: Field,
    g: Field | Sequence[Field],
    h: Callable,
    x: Any,
    *,
    radius: float = 0.1,
    samples: int = 16,
    tolerance: Any = None,
) -> RelativeDegree:
    """How often the outputs are differentiated before the inputs appear, at a state.

    It is not defined where L_g L_f^{r−1} h vanishes at x but not near it, as on the ball and beam.

    Args:
      f: the drift.
      g: the input field, or a sequence of them.
      h: the output, a function of one state that returns one number or shape (outputs,).
      x: the state, shape (n,).

    Keyword Args:
      radius: how far from x is near, in the units of the state.
      samples: how many points near x are looked at.
      tolerance: what counts as zero, relative to what it is made of; ``None`` is √eps.

    Returns:
      A RelativeDegree, with ``degree``, ``defined`` and a ``message`` that names the zero dynamics.

    Raises:
      ValueError: a field of the wrong shape, or a derivative that is not finite near x.

    Example:
      >>> drift = lambda x: jnp.stack([x[1], -x[0], x[0] - x[2]])
      >>> print(relative_degree(drift, lambda x: jnp.array([0.0, 1.0, 0.0]), lambda x: x[0], jnp.zeros(3)).message)
      relative degree 2 of 3 states: zero dynamics of dimension 1 on {h = L_f h = 0}
    """
    arguments.count(samples, "relative_degree: samples", least=0)
    functions = (tuple(as_partial(field) for field in (f, *as_fields(g))), as_partial(h))
    settings = {"radius": float(radius), "samples": int(samples)}
    states = np.shape(x)[0] if np.ndim(x) else 1
    if is_traced(functions, x, tolerance):
        return decide(_relative_degree, functions, x, tolerance, **settings, depth=states)
    return _deepen(lambda depth: decide(_relative_degree, functions, x, tolerance, **settings, depth=depth), states)


def linearising_feedback(f: Field, g: Field | Sequence[Field], h: Callable, x: Any = None) -> Linearisation:
    """The feedback u = α(x) + β(x) v after which the r-th derivative of the output is v.

    Args:
      f: the drift.
      g: the input field, or a sequence of as many as there are outputs.
      h: the output, a function of one state that returns one number or shape (m,).
      x: the state around which the relative degree is decided, shape (n,); ``None`` is the origin.

    Returns:
      A Linearisation, which unpacks as α, β and the change of coordinates, each a function of one state.

    Raises:
      ValueError: the relative degree is not defined at x, or there are more inputs than outputs or fewer.

    Example:
      >>> swing = lambda x: jnp.stack([x[1], 9.81 * jnp.sin(x[0])])
      >>> alpha, beta, coordinates = linearising_feedback(swing, lambda x: jnp.array([0.0, 2.0]), lambda x: x[0])
      >>> x = jnp.array([1.0, 3.0])
      >>> float(alpha(x)[0] + 9.81 * jnp.sin(1.0) / 2), beta(x).tolist(), coordinates(x).tolist()
      (0.0, [[0.5]], [1.0, 3.0])
    """
    fields, output = tuple(as_partial(field) for field in (f, *as_fields(g))), as_partial(h)
    if x is None:
        return Linearisation(fields, output, None)
    if is_traced(fields, output, x):
        raise ValueError("linearising_feedback: got traced values; decide the relative degree outside of the trace")
    answer = relative_degree(f, g, h, x)
    return Linearisation(fields, output, _degrees_or_refuse(answer, f"x = {np.asarray(x).tolist()}"))


def _deepen(rule: Callable, states: int) -> RelativeDegree:
    """The rule with as many derivatives as it takes: every one more than doubles its program."""
    for depth in range(1, states):
        answer = rule(depth)
        if np.all(np.asarray(answer.degrees) > 0):
            return answer
    return rule(states)


def _degrees_or_refuse(answer: RelativeDegree, place: str) -> tuple[int, ...]:
    outputs, inputs = np.shape(answer.decoupling)
    if outputs != inputs:
        raise ValueError(f"linearising_feedback: got {outputs} outputs and {inputs} inputs, wanted as many of both")
    if not answer.defined:
        raise ValueError(
            f"linearising_feedback: at {place} the relative degree is {answer.message}; choose another output or x"
        )
    return tuple(int(r) for r in answer.degrees)


def _listed(degrees: Any) -> str:
    return str(int(degrees[0])) if len(degrees) == 1 else str(tuple(int(r) for r in degrees))


def _named(degrees: Any, states: int) -> str:
    total = int(np.sum(degrees))
    text = f"relative degree {_listed(degrees)} of {states} states: "
    if total == states:
        return text + "no zero dynamics"
    names = ["h", "L_f h", *(f"L_f^{k} h" for k in range(2, max(degrees)))][: max(degrees)]
    place = " = ".join(names) + " = 0" if len(degrees) == 1 else "ξ = 0"
    return text + f"zero dynamics of dimension {states - total} on {{{place}}}"


def near(x: Any, radius: float, samples: int) -> Any:
    """The state and points around it, shape (samples + 1, n)."""
    spread = np.random.default_rng(0).uniform(-1.0, 1.0, (samples, x.shape[0]))
    return x + radius * jnp.asarray(np.concatenate([np.zeros((1, x.shape[0])), spread]), x.dtype)


def _derivatives(f, h, count):
    """x ↦ (h, L_f h, …, L_f^{count − 1} h), each of shape (outputs,)."""

    def ladder(x):
        return (jnp.atleast_1d(floating(h)(x)),)

    def longer(shorter):
        def step(x):
            found, changes = along(shorter, x, stacked([f])(x))
            return (*found, changes[-1][0])

        return step

    for _ in range(count - 1):
        ladder = longer(ladder)
    return ladder


def _relative_degree(functions, x, tolerance, *, radius, samples, depth):
    """Looks at L_g L_f^k h for k < depth."""
    (f, *gs), h = functions
    n, ladder = x.shape[0], _derivatives(f, h, depth)

    def at(y):
        inputs = stacked(gs)(y)
        slopes = jnp.stack(jax.jacfwd(ladder)(y))  # (depth, outputs, n)
        steepness = jax.lax.cummax(jnp.sqrt(jnp.sum(slopes * slopes, axis=-1)), axis=0)
        return slopes @ inputs.T, steepness * jnp.sqrt(jnp.sum(inputs * inputs))

    effects, scales = jax.vmap(at)(near(x, radius, samples))  # (points, depth, outputs, m); without m
    appears = jnp.any(jnp.max(jnp.abs(effects), axis=-1) > tolerance * scales, axis=0)
    first, reached = jnp.argmax(appears, axis=0), jnp.any(appears, axis=0)
    outputs = jnp.arange(first.shape[0])
    decoupling, scale = effects[0][first, outputs], scales[0][first, outputs]
    rows = decoupling / jnp.where(scale > 0, scale, 1)[:, None]
    margin = jnp.linalg.svd(rows, compute_uv=False)[-1] if rows.shape[0] <= rows.shape[1] else jnp.zeros((), x.dtype)
    return RelativeDegree(jnp.where(reached, first + 1, 0), decoupling, margin, jnp.asarray(tolerance, x.dtype), n)


def plain(verdict: Any) -> Any:
    """A bool outside of a trace."""
    return verdict if is_traced(verdict) else bool(verdict)
