"""The result of ``pontryagin``: the extremal, how its solve ended, and how well it meets the necessary conditions.

This includes the points where the path meets the problem's target, because the equations contain only its end, while a
run stops at the first entry. After a failure ``way_out`` looks for causes in the problem: a start at which the
equations have no derivative (such as √y for a body at rest), a cost with kinks in u (such as |u|), under which u jumps
although the method expects a smooth minimum, and ends on the boundary of a target.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing
from hjbjax.extremals.collocation import on_mesh, pad_mesh
from hjbjax.hamiltonian import pointwise
from hjbjax.problem.labels import COST
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.sets import Ball, samples
from hjbjax.problem.streams import encodable
from hjbjax.problem.types import Array, Control, Number
from hjbjax.solution.status import Status

EMPTY = 1e-9  # fraction of the time below which an arc is removed from the path
BUDGET = 200  # number of controls with which the minimiser is compared
PARTS = 8  # samples per mesh interval, because the mesh is coarse where the path is smooth
ROUNDING = 1e-6  # depth in the target that counts as its boundary, relative to the largest |l| along the path
FLAT = 1e-5  # −l̇ times the final time, relative to the largest |l|: below, the path ends along the boundary
KINKS = 64  # number of controls at which H is differentiated
STRAIGHT = 1e-9  # |H_uu u²| relative to the spread of H that counts as zero curvature


@pytree_dataclass()
class Optimality:
    """Residuals of the necessary conditions along an extremal, in cost units per unit time.

    Args:
      hamiltonian: e^{−βt}(H − βw) minus the contribution of ∂H/∂t, at every time, shape (k+1,). It is constant. It is
        zero for an infinite horizon, and for a free final time unless ψ or the target depends on time.
      drift: the variation of ``hamiltonian``, largest minus least.
      gap: the largest excess of H(u) over the least H among many admissible controls, over all times.
      scale: the largest term of H; compare ``drift`` and ``gap`` with it.
    """

    hamiltonian: Array
    drift: Number
    gap: Number
    scale: Number


@pytree_dataclass(static=("payoff",), host=("message",))
class Extremal:
    """A path with costates that meets Pontryagin's conditions; ``plotting`` draws it like any path.

    Args:
      times: shape (k+1,), increasing; the mesh of the solver.
      states: shape (k+1, n), periodic states unwound.
      controls: shape (k, m), at the start of each interval.
      costates: p, shape (k+1, n); current-value, so compare with DV along the path: of the cost, or of the reward.
      values: the cost to go along the path, or the reward to come, discounted to each time, shape (k+1,).
      switches: the times at which the control jumps.
      cost: the total cost from x₀, including the cost at the end or after it; minus ``reward`` if the problem has
        rewards.
      horizon: the final time; for an infinite horizon, the time at which it was truncated.
      optimality_check: an ``Optimality``.
      code: a ``Status`` number.
      message: a sentence on how the solve ended; not traceable.
      payoff: "cost" or "reward", the payments of the problem.
    """

    times: Array
    states: Array
    controls: Array
    costates: Array
    values: Array
    switches: Array
    cost: Number
    horizon: Number
    optimality_check: Optimality
    code: int | Array
    message: str = ""
    payoff: str = COST

    @property
    def reward(self) -> Any:
        """The total reward from x₀, minus the cost."""
        return 0 - self.cost

    @property
    def status(self) -> Status:
        """The ``Status`` with which the solve ended."""
        return Status(int(self.code))

    def __repr__(self) -> str:
        paid = float(self.cost if self.payoff == COST else self.reward)
        return f"Extremal({self.status}: {self.payoff} {paid:.6g} over {float(self.horizon):.6g})"

    def __str__(self) -> str:
        return encodable(f"{self.status}: {self.message}")


def with_payoff(extremal: Extremal, payoff: str) -> Extremal:
    """A solver's extremal, which is about costs, with the costates, values and H of ``payoff``: costs or rewards."""
    if extremal.payoff == payoff:
        return extremal
    check = extremal.optimality_check
    return dataclasses.replace(
        extremal,
        costates=0 - extremal.costates,
        values=0 - extremal.values,
        optimality_check=dataclasses.replace(check, hamiltonian=0 - check.hamiltonian),
        payoff=payoff,
    )


@jax.jit
def measure(bvp: BoundaryValueProblem, t: Array, z: Array, corner: Array) -> dict[str, jax.Array]:
    """Control, H, and its excess over the minimum at all times of one arc; ``z`` has shape (2n+1, k+1)."""
    controls = bvp.problem.controls
    assert controls is not None
    tried = jnp.asarray(samples(controls, BUDGET), z.dtype)

    def one(t: Array, z: Array) -> dict[str, jax.Array]:
        x, p, w = bvp.split(z)
        at, weights = bvp.mixture(t, x, p, corner)
        u = weights @ at
        energy = weights @ jax.vmap(lambda u: bvp.hamiltonian(t, x, p, u))(at)
        # samples of the whole set, which cannot miss the global minimum, and the minimiser, which is more accurate
        least = jnp.min(jax.vmap(lambda u: bvp.hamiltonian(t, x, p, u))(tried))
        least = jnp.minimum(
            least, bvp.hamiltonian(t, x, p, pointwise.minimiser(bvp.problem, bvp.rule, t, bvp.wrap(x), p))
        )
        # the terms of H, because H itself cancels to 0 near rest or at a free end
        terms = bvp.problem.drift(*bvp.problem.arguments(bvp.wrap(x), u, t=t)) * p
        cost = pointwise.running_cost(bvp.problem, t, bvp.wrap(x), u)
        now = jnp.exp(-bvp.problem.discount * t)
        # d/dt of e^{−βt}(H − βw) along an extremal is e^{−βt} ∂H/∂t
        moving = now * jax.grad(bvp.hamiltonian, 0)(t, x, p, u) if bvp.problem.time_dependent else 0.0 * t
        size = jnp.maximum(jnp.max(jnp.abs(terms)), jnp.abs(cost))
        constant = now * (energy - bvp.problem.discount * w)
        return {"u": u, "constant": constant, "moving": moving, "gap": energy - least, "size": size}

    return jax.vmap(one, (0, 1))(t, z)


def assemble_extremal(
    bvp: BoundaryValueProblem, s: np.ndarray, y: np.ndarray, theta: np.ndarray, code: Status, message: str
) -> Extremal:
    """Assemble the extremal from the functions on [0, 1] that solve ``bvp``; requires float64 mode."""
    from scipy.integrate import cumulative_simpson

    arrays = jax.tree.map(jnp.asarray, bvp)  # NumPy leaves would be copied to the device in every call
    lengths = np.asarray(bvp.durations(jnp.asarray(theta)))
    begins, stacked = np.cumsum(lengths) - lengths, y.reshape(bvp.count, -1, len(s))
    parts, moved = [], 0.0  # moved: the integral of e^{−βt} ∂H/∂t over the arcs so far
    for number, (begin, length, z, corner) in enumerate(
        zip(begins, lengths, stacked, np.asarray(bvp.arcs), strict=True)
    ):
        t = begin + s * length
        part = {name: np.asarray(each) for name, each in measure(arrays, t, z, corner).items()}
        gone = np.full(len(s), moved)
        if bvp.problem.time_dependent:  # a crowded mesh may repeat a node
            once, back = np.unique(s, return_index=True, return_inverse=True)[1:]
            # Simpson's rule, of order 4 like the collocation; a less accurate rule would dominate the check
            gone += length * cumulative_simpson(part["moving"][once], x=s[once], initial=0.0)[back]
        # continue from the integral over the arcs before
        part["constant"], moved = part["constant"] - gone, gone[-1]
        if code is Status.CONVERGED and length <= EMPTY * lengths.sum():  # skip an empty arc
            continue
        states = z[: bvp.n].T + (0.0 if bvp.shifts is None else bvp.shifts[number])
        parts.append({**part, "t": t, "z": np.concatenate([states, z[bvp.n :].T], 1)})

    def join(name: str, last: bool = True) -> np.ndarray:
        """Join a quantity over all arcs; a switch gets the next arc's entry. Without ``last``: one per interval."""
        rows = [part[name][:-1] for part in parts]
        return np.concatenate([*rows, parts[-1][name][-1:]] if last else rows)

    n, z = bvp.n, join("z")
    # both sides of every switch, so that the check sees a jump of H there
    every = np.concatenate([part["constant"] for part in parts])
    check = Optimality(
        hamiltonian=join("constant"),
        drift=float(np.max(every) - np.min(every)),
        gap=float(max(np.max(part["gap"]) for part in parts)),
        scale=float(max(np.max(part["size"]) for part in parts)),
    )
    return Extremal(
        times=join("t"),
        states=z[:, :n],
        controls=join("u", last=False),
        costates=z[:, n : 2 * n],
        values=z[:, -1],
        switches=np.array([part["t"][0] for part in parts[1:] if not bvp.seams]),
        cost=float(z[0, -1]),
        horizon=float(lengths.sum()),
        optimality_check=check,
        code=int(code),
        message=message,
    )


def last_iterate(
    bvp: BoundaryValueProblem, s: np.ndarray, y: np.ndarray, lengths: np.ndarray, code: Status
) -> Extremal:
    """The last iterate of an interrupted solve, without controls, which would require compilation."""
    begins, n = np.cumsum(lengths) - lengths, bvp.n
    # from (k, 2n+1, nodes) to (k, nodes, 2n+1); a copy, because the solver owns ``y``
    z = np.moveaxis(y.reshape(bvp.count, -1, len(s)), 1, 2).copy()
    if bvp.shifts is not None:
        z[..., :n] += np.asarray(bvp.shifts)[:, None]
    inner = np.append(np.tile(np.arange(len(s)) < len(s) - 1, bvp.count)[:-1], True)  # the next arc's at a switch
    times, z = (begins[:, None] + s * lengths[:, None]).ravel()[inner], z.reshape(-1, z.shape[-1])[inner]
    return Extremal(
        times=times,
        states=z[:, :n],
        controls=np.full((len(times) - 1, np.shape(bvp.arcs)[1]), np.nan),
        costates=z[:, n : 2 * n],
        values=z[:, -1],
        switches=np.zeros(0) if bvp.seams else begins[1:],
        cost=float(z[0, -1]),
        horizon=float(lengths.sum()),
        optimality_check=Optimality(np.full(len(times), np.nan), np.nan, np.nan, np.nan),
        code=int(code),
        message="this is the last iterate, without controls; the conditions have not been checked",
    )


def only_touches(bvp: BoundaryValueProblem, s: np.ndarray, y: np.ndarray, theta: np.ndarray) -> bool:
    """True if the path ends along the boundary of the target or on its way out, l̇ ≥ 0 up to rounding.

    If l̇ = 0 at the end, the condition H = βψ − ψ_t − ν l_t does not depend on ν, so ending and continuing cost the same
    and the free-time condition does not select an entry.
    """
    arrays = jax.tree.map(jnp.asarray, bvp)
    lengths = np.asarray(bvp.durations(theta))
    begins = np.cumsum(lengths) - lengths
    states, rates = (z.reshape(bvp.count, -1, len(s))[:, : bvp.n] for z in (y, on_mesh(arrays, s, y, theta)[0]))
    levels = _levels(arrays, *pad_mesh(s, y), theta)
    # the last arc that is not empty
    last = np.flatnonzero(lengths > ROUNDING * lengths.sum())[-1]
    velocity = rates[last, :, -1] / lengths[last]
    time = jnp.asarray(begins[last] + lengths[last])
    _, falling = jax.jvp(
        bvp.level, (time, jnp.asarray(states[last, :, -1])), (jnp.ones_like(time), jnp.asarray(velocity))
    )
    return bool(falling * lengths.sum() >= -FLAT * np.max(np.abs(levels)))


def entry_time(bvp: BoundaryValueProblem, s: np.ndarray, y: np.ndarray, theta: np.ndarray) -> float | None:
    """The time at which the path enters the interior of the target, accurate to a sample; None if it does not."""
    if bvp.problem.target is None:
        return None
    arrays = jax.tree.map(jnp.asarray, bvp)
    fine, dense = _interpolate(s, y, on_mesh(arrays, s, y, theta)[0])
    levels = np.asarray(_levels(arrays, *pad_mesh(fine, dense), theta))[:, : len(fine)]
    lengths = np.asarray(bvp.durations(theta))
    times = (np.cumsum(lengths) - lengths)[:, None] + fine * lengths[:, None]
    # the boundary itself is not an entry, because paths end on it and may follow it
    inside = np.flatnonzero(levels.ravel() < -ROUNDING * np.max(np.abs(levels)))
    return float(times.ravel()[inside[0]]) if len(inside) else None


def _interpolate(s: np.ndarray, y: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A finer mesh, and the cubic of the collocation on it from values and slopes at the nodes."""
    r, h = np.arange(PARTS) / PARTS, np.diff(s)[:, None]
    first, last = y[:, :-1, None], y[:, 1:, None]
    # the four Hermite polynomials on [0, 1]
    dense = first * (1 + 2 * r) * (1 - r) ** 2 + last * r * r * (3 - 2 * r)
    dense += h * r * (1 - r) * (slopes[:, :-1, None] * (1 - r) - slopes[:, 1:, None] * r)
    fine = np.append((s[:-1, None] + h * r).ravel(), s[-1])
    return fine, np.concatenate([dense.reshape(len(y), -1), y[:, -1:]], 1)


@jax.jit
def _levels(bvp: BoundaryValueProblem, s: Array, y: Array, theta: Array) -> jax.Array:
    """The target function along every arc, in the arc's own coordinates, because l may not accept unwound angles."""
    lengths = bvp.durations(theta)
    begins = jnp.cumsum(lengths) - lengths
    states = y.reshape(bvp.count, -1, len(s))[:, : bvp.n]
    along = jax.vmap(bvp.level, (0, 1))
    return jax.vmap(lambda begin, length, x: along(begin + s * length, x))(begins, lengths, states)


def way_out(bvp: BoundaryValueProblem) -> str:
    """Advice after a failure, as the rest of a sentence; empty if no cause is known."""
    arrays = jax.tree.map(jnp.asarray, bvp)
    if not is_smooth_at_start(bvp):
        return (
            f"; at x0 = {np.asarray(bvp.start).tolist()} drift or cost has no finite derivative: start slightly off, "
            "or choose states in which it has one (a speed as a state instead of √(2gy))"
        )
    if not bvp.rule.jumps and not bvp.rule.exact and (kinked := _kinked(arrays)):
        return kinked
    # without a guess the search starts from 1, in any unit of time
    sought = "; give horizon=FreeTime(guess) with the size of the final time" if bvp.free else ""
    if bvp.closing is Closing.TARGET:
        return sought + (
            "; if the end in the target is known, pass it as terminal= without the target: "
            "dataclasses.replace(problem, target=None, exit_cost=None)"
        )
    return sought


def is_smooth_at_start(bvp: BoundaryValueProblem) -> bool:
    """True if the equations have finite derivatives at x₀, where every path starts."""
    return bool(np.all(np.isfinite(_slopes_at_start(jax.tree.map(jnp.asarray, bvp)))))


def _kinked(bvp: BoundaryValueProblem) -> str:
    """Advice for inputs in which H is piecewise affine; empty if H is curved in all of them."""
    bends, along, spread = (np.asarray(part) for part in _curvature(bvp))
    if isinstance(bvp.problem.controls, Ball) and len(bends) > 1:
        if along > STRAIGHT * spread:
            return ""
        return (
            "; the cost is a multiple of |u|, and u jumps between zero and the sphere: write u as a size times a "
            "direction, two inputs of a Box, or enumerate the controls with Finite"
        )
    straight = np.flatnonzero(bends <= STRAIGHT * spread)
    if not len(straight):
        return ""
    names = ", ".join(f"u[{j}]" for j in straight)
    return (
        f"; in {names} cost and drift are piecewise linear, like |u|, so u jumps: write u = u⁺ − u⁻ with two inputs "
        "≥ 0 and the cost u⁺ + u⁻, or enumerate ends and kinks with Finite"
    )


@jax.jit
def _slopes_at_start(bvp: BoundaryValueProblem) -> jax.Array:
    """The derivatives of H with respect to the state at x₀, for a few controls and a costate of ones."""
    assert bvp.problem.controls is not None
    x = jnp.asarray(bvp.start)
    tried = jnp.asarray(samples(bvp.problem.controls, KINKS), x.dtype)
    return jax.vmap(lambda u: jax.grad(bvp.hamiltonian, 1)(0.0, x, jnp.ones_like(x), u))(tried)


@jax.jit
def _curvature(bvp: BoundaryValueProblem) -> tuple[Array, Array, Array]:
    """The largest |H_uu| of every input times its squared width, (m,); the largest |u'H_uu u|; the spread of H."""
    assert bvp.problem.controls is not None
    x = jnp.asarray(bvp.start)
    tried = jnp.asarray(samples(bvp.problem.controls, KINKS), x.dtype)
    middle = (jnp.max(tried, axis=0) + jnp.min(tried, axis=0)) / 2
    width = jnp.max(tried, axis=0) - jnp.min(tried, axis=0)
    # shift the samples, because kinks are likely at zero and at the middle of the set
    tried = middle + (tried - middle) * 0.917 + 0.0123 * width

    def energy(u: Control) -> jax.Array:
        return bvp.hamiltonian(0.0, x, jnp.ones_like(x), u)

    bends = jax.vmap(jax.hessian(energy))(tried)  # (samples, m, m)
    sizes = jnp.max(jnp.abs(bends) * width, axis=(0, 1)) * width
    along = jnp.max(jnp.abs(jnp.einsum("ki,kij,kj->k", tried, bends, tried)))
    energies = jax.vmap(energy)(tried)
    return sizes, along, jnp.max(energies) - jnp.min(energies)
