"""Checks of a problem at every node before a solve starts; host level, never under a tracer.

All functions are evaluated at all nodes for representative actions. A first pass, which compiles fast, detects any
fault. If there is one, a second pass computes counts and first nodes for the error message.
"""

import functools
import itertools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation import correlated_noise, schemes, stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.schemes import Upwind
from hjbjax.problem import sets
from hjbjax.problem.grid import Grid, division, tabulated
from hjbjax.problem.layouts import Layout
from hjbjax.problem.problem import Problem, is_discounted
from hjbjax.problem.pytree import altered
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Mask, Numbers, Scalar, Verdict
from hjbjax.solution.clock import Clock
from hjbjax.tracing import components
from hjbjax.tracing.checks import OF_ACTION, STATE_COSTS, call

ACTIONS = 33  # largest number of actions of one player, 9 per player in a game; includes ends and middle
FREE = 1024  # units of eps of the largest cost of a push: a smaller total cost of a round trip is rounding
ROUNDING = 16  # units of eps of the largest rate: a smaller negative rate is rounding
LOOK = 10**7  # nodes times actions between two checks of the clock: about a second for a drift with some sines


def check_values(on: Discretisation, clock: Clock | None = None, mesh: Mesh | None = None) -> None:
    """Refuse a problem by its values at the nodes: NaN, an empty target, noise or drift that no chain can represent.

    Args:
      on: the problem on its grid; must have passed ``checks.shapes``. The functions are evaluated in its dtype. The
        chain is checked too if it is a custom one.
      clock: checks the limits between batches of actions; raises ``Stopped``.
      mesh: the devices over which the nodes are divided; None for one device. A problem that is refused is evaluated on
        one device, for the message.

    Raises:
      ValueError: a value is refused; names the number of nodes, the first one with its state, and a remedy.
    """
    clock, problem, grid, scheme = clock or Clock(), on.problem, on.grid, on.scheme
    actions = _actions(problem)
    # one compiled program for all schemes whose chain is correct by construction
    chain = Upwind() if scheme.chain.is_proven else scheme.chain
    on = on.with_scheme(chain).on_grid(tabulated(on.grid))
    # x64 for 64-bit counts; the functions are still evaluated in ``dtype``
    with own_settings(x64=True):
        # nearly every problem passes and skips the counts and first nodes, which are slow on a CPU
        if problem.switching_costs is not None:
            _check_round_trips(np.asarray(_switching_costs(on)), grid)
        if problem.push_steps:
            _check_pushes(on)
        if _all_pass(on, actions, clock, division(grid, mesh)):
            return
        clock.look()
        found = jax.device_get(_survey(on, actions))
    # values that are not finite first: comparisons with NaN are false, which would hide the cause
    for name in (*OF_ACTION, "target", *STATE_COSTS, "killing"):
        if name in found and found[name].nodes:
            _refuse_not_finite(problem, grid, name, found[name], actions)
    if "negative" in found and found["negative"].nodes:
        where = _where(problem, grid, found["negative"], actions)
        raise ValueError(
            f"{call(problem, 'noise')} is negative at {where}.\nWanted numbers ≥ 0: it is σ in dx = f dt + σ dw; "
            "only an (n, k) matrix may hold negative entries"
        )
    if "negative rate" in found and found["negative rate"].nodes:
        where = _where(problem, grid, found["negative rate"], actions)
        raise ValueError(f"{call(problem, 'mode_rates')} is negative at {where}.\nWanted rates ≥ 0, per unit time")
    if "negative intensity" in found and found["negative intensity"].nodes:
        where = _where(problem, grid, found["negative intensity"], actions)
        raise ValueError(f"{call(problem, 'intensities')} is negative at {where}.\nWanted rates ≥ 0, per unit time")
    if "leaving jump" in found and found["leaving jump"].nodes:
        raise ValueError(
            f"{call(problem, 'landings')} is outside the box, across a constrained or Robin end, at "
            f"{_where(problem, grid, found['leaving jump'], actions)}.\nWanted jumps inside the box: limit the "
            "landing, as in jnp.maximum(y, lo), or choose another end"
        )
    if "correlation" in found and found["correlation"].nodes:
        _refuse_noise(on, found["correlation"], actions)
    if "diffusion" in found and found["diffusion"].nodes:
        raise ValueError(
            f"scheme: the chain of {scheme!r} has too little diffusion at "
            f"{_where(problem, grid, found['diffusion'], actions)}.\nWanted e ≥ max(a, h⁺ f, −h⁻ f) along every axis: "
            "with less, the chain represents only a part of the drift"
        )
    if problem.target is not None:
        _check_target(problem, grid, int(found["inside"]), found["nearest"])


def _check_round_trips(costs: np.ndarray, grid: Grid) -> None:
    """Refuse costs of changing the mode, (k − 1, *grid), that are not numbers ≥ 0, and round trips that cost nothing.

    At no cost the controller could change the mode without end.
    """
    count = len(costs) + 1
    # least[d] is the cheapest way from mode i to mode i + d by the changes so far; d = 0 is a round trip
    least = np.concatenate([np.full((1, *costs.shape[1:]), np.inf), costs])
    for _ in range(count):
        through = [least[d] + np.roll(costs[e - 1], -d, axis=0) for d in range(count) for e in range(1, count)]
        ends = [(d + e) % count for d in range(count) for e in range(1, count)]
        for d, cost in zip(ends, through, strict=True):
            least[d] = np.minimum(least[d], cost)
    bad = np.isnan(costs).any(axis=0) | (costs < 0).any(axis=0) | ~(least[0] > 0)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        where = f"in mode {grid.modes[index[0]]!r} at x = {_numbers(grid.state(index)[1:])}"
        raise ValueError(
            f"Modes.switching_cost: a cost is negative or NaN, or a round trip of changes costs nothing, {where}.\n"
            "Wanted costs ≥ 0, infinity to forbid a change, and more than zero for every round trip: otherwise the "
            "controller would change the mode without end"
        )


def _check_pushes(on: Discretisation) -> None:
    """Refuse costs of pushes that are NaN or minus infinity, and round trips of pushes that cost nothing or earn."""
    for fault, mask in jax.device_get(_faulty_pushes(on)).items():
        if not mask.any():
            continue
        index = tuple(int(i) for i in np.argwhere(mask)[0])
        x = on.grid.state(index)
        where = f"at x = {_numbers(x[1:] if on.grid.modes else x)}"
        if fault == "number":
            raise ValueError(
                f"Push: the cost of a push is NaN, or its reward infinite, {where}, the first of {int(mask.sum())} "
                "nodes;\nwanted numbers per unit of length; a cost of infinity forbids a push"
            )
        raise ValueError(
            f"Push: a round trip of pushes costs nothing or earns, {where}: the controller would repeat it "
            "without end.\nWanted a positive total cost for pushing there and back, and around a periodic axis: "
            "make a cost higher or a reward lower"
        )


@jax.jit
def _faulty_pushes(on: Discretisation) -> dict[str, jax.Array]:
    """The nodes with faulty costs of pushes, and those from which a round trip costs nothing; bool (*grid) each."""
    found = on.interventions()
    if on.problem.target is not None:
        found = found.outside(on.level <= 0)
    amiss = functools.reduce(jnp.logical_or, (~(cost > -jnp.inf) for cost in found.costs))
    size = jnp.max(jnp.stack([jnp.max(jnp.where(jnp.isfinite(cost), jnp.abs(cost), 0)) for cost in found.costs]))
    # lower all costs by more than rounding: a free round trip then earns, and repeating it has no cheapest path
    lower = altered(found, costs=tuple(cost - FREE * jnp.finfo(on.dtype).eps * size for cost in found.costs))
    value = lower.cheapest(jnp.zeros(on.grid.shape, on.dtype))
    return {"number": amiss, "free": ~amiss & (lower.least(value) < value)}


_switching_costs = jax.jit(lambda on: jnp.stack(on.switching_costs()))


class _Finding(NamedTuple):
    """The number of faulty nodes, the flat index of the first, and the index of the action."""

    nodes: Array
    first: Array
    action: Array


def _actions(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Representative pairs of control and disturbance, shapes (K, m) and (K, l)."""
    most = 9 if problem.is_game else ACTIONS
    mine, theirs = (_representatives(admissible, most) for admissible in (problem.controls, problem.disturbances))
    # all pairs, at most 81, because the functions of a game may fail for a single pair
    pairs = list(itertools.product(mine, theirs))
    return np.array([u for u, _ in pairs]), np.array([d for _, d in pairs])


def _representatives(admissible: sets.AdmissibleSet | None, most: int) -> np.ndarray:
    """At most ``most`` actions of one player, shape (K, m), including the first and the last of its samples."""
    if admissible is None:
        return np.zeros((1, 0))
    points = np.asarray(sets.samples(admissible, 9))
    return points[np.unique(np.linspace(0, len(points) - 1, min(most, len(points))).round().astype(int))]


def _all_pass(on: Discretisation, actions: tuple[np.ndarray, np.ndarray], clock: Clock, layout: Layout) -> bool:
    """True if ``check_values`` refuses nothing; evaluates the actions in batches."""
    count, some, on = len(actions[0]), max(1, LOOK // on.grid.size), layout.copied(on)
    # In batches of about a second, as ten million nodes and 33 actions take half a minute. All batches use one program,
    # because first and last are arguments.
    for first in range(0, count, some):
        clock.enter(f"the survey of the nodes, {first} of {count} actions")
        if not _actions_pass(on, actions, first, min(first + some, count), layout=layout):
            return False
    return True


@functools.partial(jax.jit, static_argnames="layout")
def _actions_pass(
    on: Discretisation, actions: tuple[Array, Array], first: int | Scalar, last: int | Scalar, *, layout: Layout
) -> Verdict:
    """``_part_passes`` for the nodes of all devices."""

    def here(on: Discretisation, *arguments: Any) -> Verdict:
        return _part_passes(on.on_part(layout), *arguments)

    return layout.mapped(here, False, False)(on, actions, first, last)


def _part_passes(on: Discretisation, actions: tuple[Array, Array], first: Scalar, last: Scalar) -> Verdict:
    """The verdict on the actions ``first``, …, ``last`` − 1; the first batch also checks functions of the state."""
    layout = on.grid.layout
    # functions of the state are checked once, with the first batch
    amiss = jax.lax.cond(first == 0, lambda: state_fails(on), lambda: jnp.zeros((), bool))
    x, tried = on.coordinates(), jax.tree.map(lambda rows: jnp.asarray(rows, on.dtype), actions)

    def look(k: Scalar, amiss: Verdict) -> Verdict:
        here, (u, d) = jax.lax.optimization_barrier((x, jax.tree.map(lambda rows: rows[k], tried)))  # see _survey
        bad = _faults(on, here, list(u), list(d)).values()
        # as integers: for booleans XLA would make two passes
        return amiss | (jnp.max(layout.cleared(functools.reduce(jnp.logical_or, bad)).astype(jnp.int32)) > 0)

    return ~layout.some(jax.lax.fori_loop(first, last, look, amiss))


def state_fails(on: Discretisation) -> Verdict:
    """True if ``check_values`` refuses the values of the functions of the state."""
    problem, some = on.problem, on.grid.layout.some
    amiss, inside = jnp.zeros((), bool), jnp.ones((), bool)
    if problem.target is not None:
        distance = on.level
        inside = distance <= 0
        # a target that contains no node, or all nodes
        amiss |= some(~jnp.isfinite(distance)) | ~some(inside) | ~some(~inside)
    for name in (*STATE_COSTS, "killing"):
        ingredient = getattr(problem, name)
        if ingredient is not None:
            relevant = inside if name == "exit_cost" else True
            amiss |= some(relevant & ~_admissible(problem, name, on.at_nodes(ingredient)))
    return amiss


def _admissible(problem: Problem, name: str, values: jax.Array) -> jax.Array:
    """The nodes where a function of the state has an admissible value: a number, or no stopping, ψ = ∞.

    Without a discount and a horizon ψ is the initial value of the iteration, and must be a number.
    """
    if name == "stopping_cost" and (problem.terminal_cost is not None or is_discounted(problem)):
        return values > -jnp.inf
    return jnp.isfinite(values)


@jax.jit
def _survey(on: Discretisation, actions: tuple[Array, Array]) -> dict[str, Any]:
    """Counts and first nodes of everything that ``check_values`` refuses."""
    problem, grid, x = on.problem, on.grid, on.coordinates()
    found: dict[str, Any] = {}
    inside: Mask | bool = True
    if problem.target is not None:
        distance = on.level
        inside = distance <= 0
        found["target"] = _count(~jnp.isfinite(distance), grid)
        found["inside"] = jnp.sum(inside)
        # the least value shows how much too coarse the grid is, or how much too small the target
        found["nearest"] = (jnp.min(distance), jnp.argmin(distance))
    for name in (*STATE_COSTS, "killing"):
        ingredient = getattr(problem, name)
        if ingredient is not None:
            relevant = inside if name == "exit_cost" else True
            found[name] = _count(relevant & ~_admissible(problem, name, on.at_nodes(ingredient)), grid)

    def body(
        carry: dict[str, _Finding], index_and_action: tuple[Scalar, jax.Array, jax.Array]
    ) -> tuple[dict[str, _Finding], None]:
        index, u, d = index_and_action
        here, u, d = jax.lax.optimization_barrier((x, u, d))  # otherwise XLA stores loop invariants at all nodes
        new = {name: _count(bad, grid, index) for name, bad in _faults(on, here, list(u), list(d)).items()}
        kept = {
            name: jax.tree.map(functools.partial(jnp.where, carry[name].nodes > 0), carry[name], new[name])
            for name in new
        }
        return kept, None

    us, ds = (jnp.asarray(action, on.dtype) for action in actions)
    # keep the first action with a fault and its count, not the sum over all actions
    nothing = _Finding(*(jnp.zeros((), jnp.int64),) * 3)
    names = jax.eval_shape(lambda: _faults(on, x, list(us[0]), list(ds[0])))
    carry, _ = jax.lax.scan(body, dict.fromkeys(names, nothing), (jnp.arange(len(us)), us, ds))
    return found | carry


def _faults(on: Discretisation, x: list, u: list, d: list | None) -> dict[str, jax.Array]:
    """The nodes where drift, cost or noise is faulty under one action, by the name of the fault."""
    problem, arguments = on.problem, on.problem.arguments(x, u, d, 0.0)

    def faulty(entries: Iterable[Numbers]) -> jax.Array:
        return functools.reduce(jnp.logical_or, (~jnp.isfinite(jnp.asarray(entry, on.dtype)) for entry in entries))

    # a problem without cost or noise does not compile their checks
    bad = {"drift": faulty(on.drift(u, d, x))}
    if problem.cost is not None:
        bad["cost"] = faulty([on.running_cost(u, d, x)])
    if rates := on.growth(u, d, x):
        bad["growth"] = faulty(rates)
    a = on.diffusion(u, d, x)
    if a:
        bad["noise"] = faulty(a.values())
    if callable(problem.noise):
        sigma = components.components(problem.noise, *arguments, dtype=on.dtype)
        # entries of a matrix may be negative, like correlations; a number or a diagonal is a size
        if sigma.ndim < 2:
            bad["negative"] = functools.reduce(jnp.logical_or, (jnp.asarray(entry) < 0 for entry in sigma.flat))
    if rates := on.mode_rates(u, d, x):
        bad["mode_rates"] = faulty(rates)
        bad["negative rate"] = _negative(on, on.mode_rates, rates)
    if rates := on.intensities(u, d, x):
        bad["intensities"] = faulty(rates)
        bad["negative intensity"] = _negative(on, on.intensities, rates)
        bad["landings"] = faulty(components.components(problem.landings, *arguments, dtype=on.dtype).flat)
        bad["leaving jump"] = functools.reduce(jnp.logical_or, (each.leaves for each in on.landings(u, d, x)))
    # diagonal jumps take their rates from the jumps along the axes, which must not become negative
    lacking = correlated_noise.lacking(on, a)
    if lacking is not None:
        bad["correlation"] = lacking
    if not on.scheme.chain.is_proven:
        links = [stencil.grid_links(on.grid, axis) for axis in range(on.grid.ndim)]
        short = [
            schemes.falls_short(on.scheme.chain, part[axis], stencil.noise_along(a, on.grid, axis), link)
            for part in on.drifts(u, d, x)
            for axis, link in enumerate(links)
        ]
        bad["diffusion"] = functools.reduce(jnp.logical_or, short)
    return bad


def _negative(on: Discretisation, rates_at: Callable[..., list], rates: list) -> jax.Array:
    """The nodes where a rate is negative by more than rounding: 0.3 − 0.2 − 0.1 is −3e-17."""
    sets_of = (on.problem.controls, on.problem.disturbances)
    probes = itertools.product(*(sets.probes(each, on.dtype) for each in sets_of))
    sizes = [on.grid.layout.largest(jnp.abs(rate)) for u, d in probes for rate in rates_at(u, d)]
    least = -ROUNDING * jnp.finfo(on.dtype).eps * functools.reduce(jnp.maximum, sizes)
    return functools.reduce(jnp.logical_or, (rate < least for rate in rates))


def _count(bad: Mask, grid: Grid, action: int | Scalar = 0) -> _Finding:
    """The finding for the nodes ``bad`` under the action with this index."""
    bad = jnp.broadcast_to(bad, grid.shape)
    # counting and argmax are slow on a CPU, so they run only if there is a fault
    count, first = jax.lax.cond(
        jnp.any(bad),
        lambda: (jnp.sum(bad, dtype=jnp.int64), jnp.argmax(bad).astype(jnp.int64)),
        lambda: (jnp.zeros((), jnp.int64),) * 2,
    )
    return _Finding(count, first, jnp.asarray(action, jnp.int64))


# --- messages ---


def _numbers(entries: Numbers) -> str:
    """Format a vector for a message."""
    return "[" + ", ".join(f"{entry:.6g}" for entry in np.asarray(entries, dtype=float)) + "]"


def _place(grid: Grid, flat: Array) -> tuple[tuple[int, ...], np.ndarray]:
    """The index and the state of a node from its flat index."""
    index = tuple(int(i) for i in np.unravel_index(int(flat), grid.shape))
    return index, grid.state(index)


def _where(problem: Problem, grid: Grid, finding: _Finding, actions: tuple[np.ndarray, np.ndarray] | None) -> str:
    """ "3 of 100 nodes, first at node (0, 1), x = [...], with u = [...]"."""
    index, x = _place(grid, finding.first)
    x = x[1:] if grid.modes else x
    mode = f" in mode {grid.modes[index[0]]!r}" if grid.modes else ""
    text = f"{int(finding.nodes)} of {grid.size} nodes, first{mode} at node {index}, x = {_numbers(x)}"
    if actions is not None:
        given = zip("ud", actions, strict=True)
        played = [f"{letter} = {_numbers(rows[finding.action])}" for letter, rows in given if rows.shape[1]]
        text += ", with " + " and ".join(played) if played else ""
    return text


def _refuse_not_finite(problem: Problem, grid: Grid, name: str, finding: _Finding, actions: tuple) -> NoReturn:
    """Refuse a function that is NaN or infinite at some nodes."""
    ingredient = getattr(problem, name)
    # a constant is wrong everywhere, so no node is named
    forbids = name in ("exit_cost", "stopping_cost")  # users forbid a set with a large cost
    if not callable(ingredient):
        cure = "; to forbid a set, use a number larger than any V, such as 1e3" if forbids else ""
        word = problem.labels.word(name)
        raise ValueError(f"Problem.{word}: got {np.asarray(ingredient)}, wanted finite numbers{cure}")
    where = _where(problem, grid, finding, actions if name in OF_ACTION else None)
    raise ValueError(
        f"{call(problem, name)} is NaN or infinite at {where}.\n"
        "Keep the singularity out of the box (lo, hi) or between nodes (shape), or define the function there:\n"
        "jnp.where(bad, finite, f(jnp.where(bad, safe_x, x)))"
        + ("\nTo forbid a set, use a number larger than any V, such as 1e3" if forbids else "")
    )


def _check_target(problem: Problem, grid: Grid, inside: int, nearest: tuple[Array, Array]) -> None:
    """Refuse a target with no node or all nodes; ``nearest`` is the least value and its node."""
    if 0 < inside < grid.size:
        return
    if inside:
        raise ValueError(
            f"target: all {grid.size} nodes lie in the target ({call(problem, 'target')} ≤ 0 inside), so nothing is "
            "left to solve: enlarge the box or make the target smaller; check its sign"
        )
    index, x = _place(grid, nearest[1])
    raise ValueError(
        f"target: no node lies in the target: {call(problem, 'target')} ≤ 0 inside, but its least value is "
        f"{float(nearest[0]):.6g}, at node {index}, x = {_numbers(x)}: refine the grid or enlarge the target"
    )


def _refuse_noise(on: Discretisation, finding: _Finding, actions: tuple) -> NoReturn:
    """Refuse correlated noise for which the diagonal jumps leave a negative probability at these spacings."""
    _, x = _place(on.grid, finding.first)
    u, d = (rows[finding.action] for rows in actions)
    sigma = np.asarray(on.problem.diffusion(x, u, d, 0.0), dtype=float)
    raise ValueError(
        f"noise: correlated noise that the chain cannot represent with non-negative probabilities at "
        f"{_where(on.problem, on.grid, finding, actions)}.\n" + correlated_noise.advice(on, sigma @ sigma.T, actions)
    )


def representatives(problem: Problem, u: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The representative pairs of actions, and one more, shapes (K, m) and (K, l)."""
    us, ds = _actions(problem)
    return np.concatenate([us, [u]]), np.concatenate([ds, [d]])
