"""Methods of policy evaluation, as values, which solve δ = s + Σ_o w_o δ(x + o), and a guide to custom ones.

``PolicyIteration`` and ``Implicit`` accept any object of a class derived from ``Evaluation``. Evaluation by GMRES:

    >>> import dataclasses
    >>> import jax
    >>> import jax.numpy as jnp
    >>> import hjbjax as hjb
    >>> from hjbjax.iteration.evaluation import Evaluation, left_over
    >>> @jax.tree_util.register_static
    ... @dataclasses.dataclass(frozen=True)
    ... class Gmres(Evaluation):
    ...     restart: int = 20
    ...     open_ends = True
    ...
    ...     def solve(self, equation, grid):
    ...         zero = jnp.zeros_like(equation.source)
    ...
    ...         def matvec(delta):  # (I − W) δ
    ...             return equation.source - left_over(equation, grid, delta)
    ...
    ...         return jax.scipy.sparse.linalg.gmres(matvec, equation.source, zero, tol=1e-3, restart=self.restart)[0]
    >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), noise=0.5, discount=1.0)
    >>> hjb.solve(problem, hjb.Grid([-1.0], [1.0], (41,)), method=hjb.PolicyIteration(Gmres())).status.name
    'CONVERGED'

The object enters compiled programs as a pytree, here without numbers, and ``solve`` is traced.
"""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.landing import Landing
from hjbjax.iteration import gauss_seidel
from hjbjax.iteration.bellman import PolicyEquation
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.layouts import Layout
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, Field, Number, Scalar, Verdict

OPEN_FRACTION = 1e-8  # fraction of the residual to which a Krylov method reduces it with open ends


class Evaluation(abc.ABC):
    """The base class of evaluations: solvers of the linear equation of a policy, registered with JAX as pytrees.

    An evaluation defines ``solve``; everything else has a default.
    """

    @property
    def rough(self) -> bool:
        """True if the evaluation only relaxes. Steps are cheap, and the loop switches to a linear solve if it stalls.

        The residual of other evaluations is checked. If one fails, for example because the policy has no value, the
        equation is relaxed instead.
        """
        return False

    @property
    def open_ends(self) -> bool:
        """True if it solves equations that extrapolate the value beyond open ends from the inner nodes."""
        return False

    @property
    def calls_back(self) -> bool:
        """True if it calls Python on the host from a compiled program."""
        return False

    @property
    def in_parts(self) -> bool:
        """True if it accesses other nodes only through ``stencil`` and the grid, so nodes can be divided."""
        return False

    @abc.abstractmethod
    def solve(self, equation: PolicyEquation, grid: Grid) -> jax.Array:
        """δ with δ = s + Σ_o w_o δ(x + o), exactly or approximately, (*grid), in the dtype of the equation."""

    def relaxations(self, n: int) -> int | None:
        """The number of relaxations of every node in n dimensions, if it only relaxes, otherwise None."""
        return None

    def bytes_per_node(self, weights: int, word: int) -> int:
        """Memory per node in bytes, input included, for ``weights`` jumps of ``word`` bytes each."""
        return word * (2 * weights + 8)


@pytree_dataclass(static=("count",))
class Sweeps(Evaluation):
    """Approximate evaluation by Gauss–Seidel: ``count`` forward and backward sweeps in every order of the axes.

    The work is about equal to ``count`` 2^n relaxations of every node. The correction is computed in float32. If the
    grid exceeds the cache of a CPU, each slab of it is swept 2 ``count`` - 1 times (at least three) in each of two
    directions.
    """

    count: int = 3
    rough, in_parts = True, True

    def __post_init__(self) -> None:
        arguments.count(self.count, "Sweeps: count")

    def solve(self, equation: PolicyEquation, grid: Grid) -> jax.Array:
        """Rounds of Gauss–Seidel in single precision."""
        # saves half the memory; a rough correction has few digits anyway, and V + δ is computed in the dtype of V
        single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), _to_neighbours(equation))
        return relaxed(single, grid, self.count).astype(equation.source.dtype)

    def relaxations(self, n: int) -> int:
        """Two sweeps in every order of the axes, each worth a relaxation of every node."""
        return self.count * 2**n

    def bytes_per_node(self, weights: int, word: int) -> int:
        """Weights and source twice in single precision, plain and skewed."""
        return 4 * (2 * weights + 2) + 2 * word  # plus the equation's source and δ in their own dtype


@pytree_dataclass(static=("max_steps",))
class Krylov(Evaluation):
    """Evaluation by BiCGStab, preconditioned by one round of Gauss–Seidel, to a fraction of the residual.

    In one dimension the preconditioner is elimination, which solves most equations exactly, without BiCGStab.

    Args:
      fraction: stop when the 2-norm of the residual has fallen by this factor.
      max_steps: largest number of steps, with two products and two preconditionings each.
    """

    fraction: Number = 1e-3
    max_steps: int = 200
    open_ends, in_parts = True, True

    def __post_init__(self) -> None:
        arguments.positive(self.fraction, "Krylov: fraction", most=1)
        arguments.count(self.max_steps, "Krylov: max_steps")

    def solve(self, equation: PolicyEquation, grid: Grid) -> jax.Array:
        """BiCGStab on (I − W) δ = s, or elimination."""
        if is_tridiagonal(equation, grid):
            return tridiagonal(equation, grid)

        def matvec(delta: Field) -> Field:  # (I − W) δ: minus the residual for a zero source
            return -left_over(PolicyEquation(jnp.zeros_like(delta), equation.weights), grid, delta)

        def precondition(residual: Field) -> Field:
            left = PolicyEquation(residual, equation.weights)
            return tridiagonal(left, grid) if grid.ndim == 1 else relaxed(left, grid, 1)

        fraction = self.fraction
        if grid.sides("open"):  # with 1e-3 the errors of the solves led a time step to another solution
            fraction = jnp.minimum(fraction, OPEN_FRACTION)
        return bicgstab(matvec, precondition, equation.source, grid.layout, fraction=fraction, most=self.max_steps)

    def bytes_per_node(self, weights: int, word: int) -> int:
        """The weights twice, and the vectors of BiCGStab."""
        return word * (2 * weights + 12)


@pytree_dataclass()
class Direct(Evaluation):
    """Exact evaluation by a sparse LU factorisation (SciPy's SuperLU, on the host): for small grids and references."""

    open_ends, calls_back = True, True

    def solve(self, equation: PolicyEquation, grid: Grid) -> jax.Array:
        """Solve by factorisation."""
        return direct(equation, grid)

    def bytes_per_node(self, weights: int, word: int) -> int:
        """The weights twice, without the fill-in of the factors on the host, which depends on the ordering."""
        return word * (2 * weights + 4)


def check_evaluation(evaluation: object, name: str) -> None:
    """Refuse, by ``name``, an object that is not an evaluation of a policy.

    Raises:
      TypeError: lists the available evaluations.
    """
    check_choice(evaluation, Evaluation, name, "hjb.Sweeps(...), hjb.Krylov(...) or hjb.Direct()")


def check_choice(value: object, base: type, name: str, wanted: str) -> None:
    """Refuse, by ``name``, a value whose class is not derived from ``base``, or that JAX treats as a leaf.

    Raises:
      TypeError: lists the choices in ``wanted``, or explains how to make the class a pytree.
    """
    if not isinstance(value, base):
        own = f"an object of a class derived from {base.__module__}.{base.__name__}"
        raise TypeError(f"{name} is {arguments.shown(value)}; wanted {wanted}, or {own}")
    check_pytree(value, name)


def check_pytree(value: object, name: str) -> None:
    """Refuse, by ``name``, a value that JAX treats as a leaf.

    Raises:
      TypeError: names the decorators that make a class a pytree.
    """
    if any(leaf is value for leaf in jax.tree.leaves(value)):
        raise TypeError(
            f"{name}: {type(value).__name__} is not a pytree, as compiled programs require; decorate the class with "
            "jax.tree_util.register_static, or register_dataclass if it holds numbers"
        )


def evaluate(method: Evaluation, equation: PolicyEquation, grid: Grid) -> Field:
    """An approximate solution δ, shape (*grid), in the dtype of the equation."""
    if grid.sides("open") and not method.open_ends:
        raise ValueError(
            f"{type(method).__name__}(...) relaxes node by node, which does not converge with open ends; "
            "use hjb.PolicyIteration(hjb.Direct()) or Krylov(), in a march Implicit(hjb.Direct())"
        )
    delta = _with_exact_interventions(equation, method.solve(equation, grid))
    if method.rough:  # its residual is checked in the next step
        return delta
    size, left = (grid.layout.largest(jnp.abs(each)) for each in (equation.source, left_over(equation, grid, delta)))
    # an improper policy has no value, and BiCGStab may break down; relaxation is always safe
    return jax.lax.cond(left <= size, lambda: delta, lambda: relaxed(equation, grid, 2))


def _with_exact_interventions(equation: PolicyEquation, delta: Field) -> Field:
    """The correction with δ(x) = s + δ(x + o) exact at nodes with an intervention; linear solves meet it roughly."""
    table = dict(zip(equation.weights.offsets, equation.weights.values, strict=True))
    goes = [table[offset] == 1 for offset in equation.interventions.offsets]
    return equation.interventions.followed(goes, equation.source, delta)


def left_over(equation: PolicyEquation, grid: Grid, delta: Field) -> Field:
    """s + Σ_o w_o δ(x + o) − δ, the residual of a correction."""
    return sum(equation.weights.products(grid, delta, change=True), start=equation.source - delta)


def _to_neighbours(equation: PolicyEquation) -> PolicyEquation:
    """The equation without the weights of jumps to nodes that are not neighbours, which sweeps do not follow."""
    return dataclasses.replace(equation, weights=dataclasses.replace(equation.weights, landings=()))


# x, its residual, (alpha, omega, rho), the direction, its product with A, and the number of steps
Recurrence: TypeAlias = tuple[Field, Field, tuple[Scalar, Scalar, Scalar], Field, Field, Scalar]


def bicgstab(
    matvec: Callable[[Field], Field],
    precondition: Callable[[Field], Field],
    source: Field,
    layout: Layout,
    *,
    fraction: Number,
    most: int,
) -> Field:
    """Solve A x = source by preconditioned BiCGStab from zero, with scalar products over all devices.

    H. A. van der Vorst, SIAM J. Sci. Stat. Comput. 13. JAX's own version would sum over the nodes of one device only.

    Args:
      matvec: A.
      precondition: approximately A⁻¹.
      source: the right-hand side, (*grid).
      layout: the layout of the nodes.
      fraction: the target for the 2-norm of the residual, relative to the source.
      most: largest number of steps.
    """

    def dot(a: Field, b: Field) -> Scalar:
        return layout.total(a * b)

    least = jnp.square(jnp.asarray(fraction, source.dtype)) * dot(source, source)

    def unfinished(carry: Recurrence) -> Verdict:
        _, residual, _, _, _, count = carry
        return (dot(residual, residual) > least) & (count < most) & (count >= 0)

    def step(carry: Recurrence) -> Recurrence:
        x, residual, (alpha, omega, rho), direction, moved, count = carry
        new = dot(source, residual)
        direction = residual + new / rho * alpha / omega * (direction - omega * moved)
        towards = precondition(direction)
        moved = matvec(towards)
        alpha = new / dot(source, moved)
        half = residual - alpha * moved
        done = dot(half, half) < least
        across = precondition(half)
        turned = matvec(across)
        omega = dot(turned, half) / dot(turned, turned)
        x = x + alpha * towards + jnp.where(done, 0, omega) * across
        residual = jnp.where(done, half, half - omega * turned)
        # a negative count means breakdown and ends the loop
        count = jnp.where((omega == 0) | (alpha == 0) | (new == 0), -1, count + 1)
        return x, residual, (alpha, omega, new), direction, moved, count

    ones = (jnp.ones((), source.dtype),) * 3
    start = (jnp.zeros_like(source), source, ones, source, source, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, step, start)[0]


def jacobi(equation: PolicyEquation, grid: Grid, sweeps: int) -> Field:
    """Damped Jacobi sweeps with ½(I + T), since the star stencil has an eigenvalue near −1."""

    # half a step: I − W has eigenvalues up to 2, for which a whole step would oscillate
    def sweep(_: Scalar, delta: Field) -> Field:
        return delta + 0.5 * left_over(equation, grid, delta)

    return jax.lax.fori_loop(0, sweeps, sweep, jnp.zeros_like(equation.source))


def relaxed(equation: PolicyEquation, grid: Grid, rounds: int) -> Field:
    """Rounds of wavefront Gauss–Seidel from zero; damped Jacobi if diagonal jumps break the wavefront.

    At open ends the correction is extrapolated as a constant. For an equation with a parabola beyond them this is a
    preconditioner, not a solver, since the values outside depend on δ inside. Jumps to nodes that are not neighbours
    are left out, so it is only a preconditioner for them too.
    """
    equation = _walled(_to_neighbours(equation), grid)
    # a diagonal jump may stay on its hyperplane i₀ + i₁ + … = const, whose nodes are updated simultaneously
    if any(sum(abs(offset[axis]) for axis in grid.state_axes) > 1 for offset in equation.weights.offsets):
        return jacobi(equation, grid, 4 * rounds * 2**grid.ndim)  # four for each relaxation of a round
    return gauss_seidel.sweep(equation, grid, rounds)


def is_tridiagonal(equation: PolicyEquation, grid: Grid) -> bool:
    """True if a node of the equation is coupled to the two neighbours on its axis only, all on this device."""
    line = grid.ndim == 1 and not (grid.periodic[0] or grid.sides("open") or grid.layout.axes)
    return line and not equation.weights.landings and {(-1,), (1,)} >= set(equation.weights.offsets)


def tridiagonal(equation: PolicyEquation, grid: Grid) -> Field:
    """The solution for the jumps to the two neighbours on a grid with one axis, by elimination.

    Jumps across the seam of a periodic axis, across open ends, and to nodes of another device are left out.
    """
    equation = _walled(_to_neighbours(equation), grid)
    table = dict(zip(equation.weights.offsets, equation.weights.values, strict=True))
    nothing = jnp.zeros_like(equation.source)
    below, above = (nothing - table.get((step,), nothing) for step in (-1, 1))
    diagonals = below.at[0].set(0), jnp.ones_like(nothing), above.at[-1].set(0)
    return jax.lax.linalg.tridiagonal_solve(*diagonals, equation.source[:, None])[:, 0]


def _walled(equation: PolicyEquation, grid: Grid) -> PolicyEquation:
    """The equation with the weights that leave across open ends added to the node itself."""
    if not grid.sides("open"):
        return equation
    inside, outside = [], jnp.zeros_like(equation.source)
    for offset, w in zip(equation.weights.offsets, equation.weights.values, strict=True):
        leaves = np.zeros((1,) * grid.ndim, bool)  # broadcasts; a diagonal jump may leave across two ends
        for axis, step in grid.sides("open"):
            if offset[axis] == step:
                leaves = leaves | stencil.on_edge(grid, axis, step)
        inside.append(jnp.where(leaves, 0, w))
        outside = outside + jnp.where(leaves, w, 0)
    # δ = s + w_in δ_in + w_out δ, solved for the node's δ; a node with only outward weights keeps its row
    scale = 1 / jnp.where(outside < 1, 1 - outside, 1)
    weights = dataclasses.replace(equation.weights, values=tuple(scale * w for w in inside))
    return PolicyEquation(scale * equation.source, weights)


def direct(equation: PolicyEquation, grid: Grid, *, transposed: bool = False) -> Field:
    """(I − W)⁻¹ s, or with the transpose, by SuperLU through a host callback; batches run sequentially.

    Numbers are passed as 32-bit words, because ``jax.enable_x64`` does not apply in the callback's thread.
    """
    dtype = equation.source.dtype
    offsets, weights = stencil.inward(equation.weights.offsets, equation.weights.values, grid)
    word = np.uint32

    def numbers(words: Array) -> np.ndarray:
        return np.ascontiguousarray(words).view(dtype).reshape(grid.shape).astype(np.float64)

    def on_host(source: Array, far: list, *weights: Array) -> np.ndarray:
        landings = [Landing(nodes, numbers(rate), back) for (nodes, rate), back in zip(far, backwards, strict=True)]
        given = [numbers(w) for w in weights]
        delta = factored(offsets, given, grid, landings=landings, transposed=transposed)(numbers(source))
        return np.ascontiguousarray(delta.astype(dtype)).view(word).reshape(source.shape)

    # a double is two words on an additional axis, a single is one word
    source, *words = [jax.lax.bitcast_convert_type(array, word) for array in (equation.source, *weights)]
    backwards = [each.transposed for each in equation.weights.landings]
    far = [(each.nodes, jax.lax.bitcast_convert_type(each.rate, word)) for each in equation.weights.landings]
    result = jax.ShapeDtypeStruct(source.shape, word)
    # a callback, since XLA has no sparse LU; sequential, since SuperLU factors one matrix at a time
    delta = jax.pure_callback(on_host, result, source, far, *words, vmap_method="sequential")
    return jax.lax.bitcast_convert_type(delta, dtype)


def factored(
    offsets: Sequence[tuple[int, ...]],
    weights: list[np.ndarray],
    grid: Grid,
    *,
    landings: Sequence[Landing] = (),
    transposed: bool = False,
) -> Callable[[np.ndarray], np.ndarray]:
    """The function s ↦ (I − W)⁻¹ s of arrays (*grid), or of the transpose; NaN if the matrix is singular."""
    from scipy.sparse.linalg import splu

    # I − W with the nodes in C order; CSC is what SuperLU factors
    far = [each.weighed(-1) for each in landings]
    matrix = stencil.sparse(offsets, [-w for w in weights], np.ones(grid.shape), grid, far)
    try:
        factors = splu(matrix.tocsc())
    except RuntimeError:  # exactly singular, such as an improper policy; the solve detects the NaN
        return lambda source: np.full(grid.shape, np.nan)
    return lambda source: factors.solve(source.ravel(), "T" if transposed else "N").reshape(grid.shape)
