"""Laws of a chain as functions of its jump rates: the stationary law with its derivative, and laws forward in time.

A law μ holds one probability per node. The forward equation is dμ/dt = 𝓛*μ with the transposed generator,

    (𝓛*μ)(x) = Σ_o c_o(x − o) μ(x − o) − Q(x) μ(x),    Q = Σ_o c_o.

Its sum over the nodes is zero, so Σ μ is conserved.

Forward in time, uniformisation is exact. With Λ = max Q the matrix P = I + 𝓛/Λ is a transition matrix, and

    exp(t𝓛*) μ = Σ_k w_k (P*)^k μ,    w_k = e^{−Λt} (Λt)^k / k!.

All terms are non-negative, so nothing cancels. The series is cut where the rest of the weights is below rounding, and
divided by the sum of the weights that are kept. Finally the sum of μ is set to what it was. The series takes about Λt
products with P, in blocks of at most ``LONGEST`` mean jumps, whose first weight does not underflow.

The stationary law solves 𝓛*μ = 0 with Σ μ = 1. A change of the rates changes it by δ with

    −𝓛*δ = 𝓛̇*μ,    Σ δ = 0,

one sparse linear solve, transposed in reverse mode. With the rank-one term Λ μ Σδ on the left the matrix is regular.
"""

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.landing import Landing
from hjbjax.discretisation.rates import Rates
from hjbjax.hamiltonian.derivatives import once
from hjbjax.markov_chain import stationary_law
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.host_calls import call_on_host
from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Field, Number

if TYPE_CHECKING:
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import SuperLU

ROUNDING = 1e-12  # relative amount by which a time may exceed the horizon
LONGEST = {8: 400.0, 4: 60.0}  # mean jumps per block, by the bytes of a number: e^-400 and e^-60 are normal numbers


@pytree_dataclass(static=("timed",))
class LawSteps:
    """The steps of a law forward in time.

    Attributes:
      moments: the times at which rates are evaluated, shape (k,); one time for constant rates.
      timed: True if the policy has an axis of these times.
      kept: the times of the result.
      steps: four arrays with one entry per step: the number of the moment at or before the step, the weight of the next
        moment in the rates, the duration, and the place of the law after the step in the result.
    """

    moments: Any
    timed: bool
    kept: Any
    steps: Any

    @property
    def count(self) -> int:
        """The number of times of the result."""
        return len(self.kept)


def plan_steps(horizon: Any, times: Any, moments: Any) -> LawSteps:
    """The steps from 0 to the horizon, from each kept time and each moment to the next.

    Raises:
      ValueError: a horizon that is not positive; times that are traced, not increasing, or outside [0, horizon];
        moments that do not cover it.
    """
    arguments.positive(horizon, "evolve: horizon", "in units of time")
    if is_traced(horizon, times, moments):
        raise ValueError("evolve: got traced times; wanted known numbers for horizon, times and policy_times")
    horizon = float(horizon)
    kept = _increasing([horizon] if times is None else times, "times")
    if kept[0] < 0 or kept[-1] > horizon * (1 + ROUNDING):
        raise ValueError(f"evolve: times are from {kept[0]:.6g} to {kept[-1]:.6g}, wanted them in [0, {horizon:.6g}]")
    known = np.zeros(1) if moments is None else _increasing(moments, "policy_times")
    if moments is not None and (known[0] > 0 or known[-1] < horizon * (1 - ROUNDING)):
        raise ValueError(
            f"evolve: policy_times are from {known[0]:.6g} to {known[-1]:.6g}, wanted them to cover [0, {horizon:.6g}];"
            "\nkeep these times in the march: hjb.march(..., times=np.linspace(0, horizon, k))"
        )
    ends = np.unique(np.concatenate([[0.0], kept, known[(known > 0) & (known < kept[-1])]]))
    starts, ends = np.append(0.0, ends[:-1]), ends  # the first step has length zero, for the law at t = 0
    middle = (starts + ends) / 2
    first = np.clip(np.searchsorted(known, middle, side="right") - 1, 0, max(len(known) - 2, 0))
    weight = (middle - known[first]) / (known[first + 1] - known[first]) if len(known) > 1 else np.zeros(len(ends))
    return LawSteps(known, moments is not None, kept, (first, weight, ends - starts, np.searchsorted(kept, ends)))


def _increasing(given: Any, name: str) -> np.ndarray:
    """Finite times in increasing order, shape (k,)."""
    times = np.asarray(given, np.float64)
    if times.ndim != 1 or not times.size or not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
        raise ValueError(f"evolve: {name} is {arguments.shown(given)}; wanted one or more finite times, increasing")
    return times


def check_law(law: Any, grid: Grid, name: str = "evolve") -> np.ndarray:
    """A law of known numbers, in float64; ``name`` is the function that the user called.

    Raises:
      ValueError: not one finite non-negative number per node.
    """
    found = np.asarray(law, np.float64)
    if found.shape != grid.shape:
        raise ValueError(f"{name}: got a law of shape {found.shape}, wanted {grid.shape}: one probability per node")
    if not np.all(np.isfinite(found)) or np.any(found < 0):
        count = int(np.sum(~(np.isfinite(found) & (found >= 0))))
        raise ValueError(f"{name}: the law is negative or not finite at {count} nodes; wanted probabilities")
    return found


def flow(jumps: Rates, grid: Grid, law: Field) -> Field:
    """𝓛*μ, the probability that every node gains per unit time, shape (*grid); its sum is zero."""
    gained = -jumps.total() * law
    for offset, c in zip(jumps.offsets, jumps.values, strict=True):
        back = tuple(-step for step in offset)
        gained = gained + stencil.neighbour(c * law, grid, back, ghost=False)
    return sum((landing.reversed().product(law) for landing in jumps.landings), start=gained)


def after_duration(jumps: Rates, grid: Grid, law: Field, duration: Number) -> Field:
    """exp(t𝓛*) μ for constant rates: non-negative, with the same sum."""
    dtype = law.dtype
    leaving = jumps.total()
    # any Λ ≥ Q gives the same result, so it has no derivative; above max Q, so that no 1 − Q/Λ rounds below zero
    fastest = jax.lax.stop_gradient(jnp.max(leaving)) * (1 + 8 * jnp.finfo(dtype).eps)
    fastest = jnp.where(fastest > 0, fastest, 1)
    blocks = jnp.maximum(jnp.ceil(fastest * duration / LONGEST[dtype.itemsize]), 1)
    mean = (fastest * duration / blocks).astype(dtype)
    terms = jnp.ceil(mean + 8 * jnp.sqrt(mean) + 20).astype(jnp.int32)  # the rest of the weights is below 1e-15
    stays, moves = 1 - leaving / fastest, jumps.inflow(grid).scaled(1 / fastest)

    def moved(p: Field) -> Field:
        return sum(moves.products(grid, p), start=stays * p)

    def term(k: Any, carry: tuple) -> tuple:
        p, weight, total, weights = carry
        p, weight = moved(p), weight * mean / (k + 1)
        return p, weight, total + weight * p, weights + weight

    def block(_: Any, p: Field) -> Field:
        first = jnp.exp(-mean)
        _, _, total, weights = jax.lax.fori_loop(0, terms, term, (p, first, first * p, first))
        return total / weights

    found = jax.lax.fori_loop(0, blocks.astype(jnp.int32), block, law)
    # thousands of products may change the sum by thousands of roundings
    before, after = jnp.sum(law), jnp.sum(found)
    return found * jnp.where(after > 0, before / jnp.where(after > 0, after, 1), 1)


def sparse_generator(jumps: Rates, grid: Grid) -> "csr_array":
    """The generator of known rates as a sparse matrix; host level."""
    return stencil.sparse(jumps.offsets, jumps.values, -jumps.total(), grid, jumps.landings)


def implicit_step(jumps: Rates, grid: Grid, duration: float) -> "SuperLU":
    """The factors of 1 − t𝓛* on the host: ``solve`` makes one implicit Euler step of a law.

    The step keeps the law non-negative and preserves its sum.

    The matrix is an M-matrix that is diagonally dominant by columns, so it is factored without pivoting.
    """
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import splu

    matrix = (eye_array(grid.size) - duration * sparse_generator(jumps, grid).T).tocsc()
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


@jax.custom_jvp
def stationary(jumps: Rates, grid: Grid) -> Field:
    """The stationary law of a chain with one recurrent class, shape (*grid); NaN if it has several.

    The host computes it, in float64. It has a first derivative with respect to the rates.
    """
    shape, dtype = jumps.values[0].shape, jumps.values[0].dtype

    def on_host(*leaves: np.ndarray) -> np.ndarray:
        moves = _generator(jumps, grid, leaves)
        if not np.all(np.isfinite(moves.data)):
            return np.full(shape, np.nan)
        classes = stationary_law.classes(moves)
        if len(classes) > 1:
            return np.full(shape, np.nan)
        law, error = stationary_law.law(moves, classes[0])
        return (law if error <= stationary_law.LARGEST_ERROR else law * np.nan).reshape(shape)

    like: Any = jax.ShapeDtypeStruct(shape, dtype)
    return call_on_host(on_host, like, *jax.tree.leaves(jumps), vmap_method="sequential")


@stationary.defjvp
@own_settings()
def _stationary_tangent(primals: Any, tangents: Any) -> tuple[Field, Field]:
    """The stationary law, and its tangent by one linear solve."""
    jumps, grid = primals
    law = stationary(jumps, grid)
    kept, peak, fastest = jax.lax.stop_gradient((jumps, law, jnp.max(jumps.total())))
    far = zip(jumps.landings, tangents[0].landings, strict=True)
    moved = dataclasses.replace(tangents[0], landings=tuple(Landing(at.nodes, change.rate) for at, change in far))
    gained = flow(moved, grid, law) + once((jumps, grid), "a stationary law").astype(law.dtype)

    def matvec(change: Field) -> Field:
        return fastest * peak * jnp.sum(change) - flow(kept, grid, change)

    def solver(transposed: bool) -> Any:
        def on_host(right: np.ndarray, peak: np.ndarray, *leaves: np.ndarray) -> np.ndarray:
            moves, number = (
                _generator(jumps, grid, leaves),
                [array.astype(np.float64).ravel() for array in (right, peak)],
            )
            return stationary_law.deviation(moves, *number, transposed=transposed).reshape(right.shape)

        like: Any = jax.ShapeDtypeStruct(law.shape, law.dtype)
        leaves = jax.tree.leaves(kept)
        return lambda _, right: call_on_host(on_host, like, right, peak, *leaves, vmap_method="sequential")

    return law, jax.lax.custom_linear_solve(matvec, gained, solver(False), solver(True))


def _generator(jumps: Rates, grid: Grid, leaves: tuple[np.ndarray, ...]) -> Any:
    """The generator of ``jumps`` with these numbers as its leaves, on the host."""
    numbers = [leaf.astype(np.float64) if leaf.dtype.kind == "f" else leaf for leaf in map(np.asarray, leaves)]
    known = jax.tree.unflatten(jax.tree.structure(jumps), numbers)
    return sparse_generator(known, grid)
