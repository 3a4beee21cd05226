"""The chain in the formats of other solvers: SciPy's sparse matrices, QuantEcon's state-action pairs.

Host level, float64, nodes in C order. ``chain`` computes the rates; this module checks problem and policy for the
exports, and lays out their arrays.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import Rates
from hjbjax.discretisation.schemes import Upwind
from hjbjax.markov_chain import stationary_law
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_constrained
from hjbjax.problem.pytree import is_traced
from hjbjax.problem.sets import AdmissibleSet, Finite
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Mask

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Table = tuple[Rates, np.ndarray, np.ndarray]


def time_step(leaving: np.ndarray) -> float:
    """Δt = 1/max Q, the largest for which all probabilities are non-negative; 1 if nothing moves."""
    fastest = float(np.max(leaving))
    return 1 / fastest if fastest > 0 else 1.0


def refuse(what: str, where: Mask, grid: Grid, name: str = "chain") -> None:
    """Raise a ValueError with the fault ``what``, the number of nodes and the first node, if there are any.

    ``name`` is the function named in the message. Traced nodes pass.
    """
    if not is_traced(where) and np.any(where):
        first = tuple(int(i) for i in np.argwhere(where)[0])
        state = np.array2string(grid.state(first), separator=", ")
        raise ValueError(f"{name}: {what} at {int(np.sum(where))} nodes, the first {first} with state {state}")


def single_law(generator: "csr_array", grid: Grid, name: str) -> np.ndarray:
    """The stationary probabilities of a chain with one recurrent class, shape (S,).

    ``name`` is the function named in a message.

    Raises:
      ValueError: there is more than one class, or rounding may split the class.
    """
    why = "where the chain is found after a long time depends on where it starts"
    fix = "connect them by noise, or restrict the box to one part"
    classes = stationary_law.classes(generator)
    if len(classes) > 1:
        first = [np.array2string(grid.state(np.unravel_index(c[0], grid.shape)), separator=", ") for c in classes[:2]]
        raise ValueError(
            f"{name}: got {len(classes)} recurrent classes, wanted one: {why};\nthe first two contain the "
            f"states {first[0]} and {first[1]}, {len(classes[0])} and {len(classes[1])} nodes; {fix}"
        )
    probabilities, error = stationary_law.law(generator, classes[0])
    if error > stationary_law.LARGEST_ERROR:
        raise ValueError(
            f"{name}: parts of the box exchange so little that rounding may move {error:.2g} of the "
            f"probability between them, wanted at most {stationary_law.LARGEST_ERROR:g}:\n{why}; {fix}"
        )
    return probabilities


def target(problem: Problem, grid: Grid, t: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The nodes on the target, bool, and the exit cost; both (*grid)."""
    # double precision regardless of the session's, because other solvers use double precision
    with own_settings(x64=True):
        on = Discretisation(problem, grid, Upwind(), np.dtype(np.float64), t)
        paid = np.asarray(on.at_nodes(problem.exit_cost))
        inside = np.zeros(grid.shape, bool)
        if problem.target is not None:
            inside = np.asarray(on.level <= 0)
    return inside, paid


def policy_components(problem: Problem, grid: Grid, policy: Any, disturbance: Any) -> tuple[list, list, Any]:
    """The components of both players' policies, each (*grid), and the nodes where no entry is NaN."""
    xp: Any = jnp if is_traced(policy, disturbance) else np
    u = _entries(policy, problem.controls, grid, "policy")
    d = _entries(disturbance, problem.disturbances, grid, "disturbance")
    # a solution marks nodes without an action by NaN; drift and cost are evaluated there with zeros
    active = ~xp.any(xp.isnan(xp.concatenate([u, d], axis=-1)), axis=-1)
    return *(list(xp.moveaxis(xp.where(active[..., None], action, 0), -1, 0)) for action in (u, d)), active


def _entries(action: Any, admissible: AdmissibleSet | None, grid: Grid, name: str) -> Any:
    """One player's action at every node, (*grid, m); m = 0 if there is no such player. In NumPy unless traced."""
    wanted = (*grid.shape, 0 if admissible is None else admissible.dim)
    if action is None and admissible is None:
        return np.zeros(wanted)
    entries = action if is_traced(action) else np.asarray(action, np.float64)
    if entries.shape != wanted:
        raise ValueError(f"chain: got a {name} of shape {entries.shape}, wanted {wanted}: one action per node")
    if not is_traced(entries) and np.any(np.isinf(entries)):
        raise ValueError(f"chain: the {name} is infinite at some node; wanted numbers, or NaN where there is no action")
    return entries


def action_table(problem: Problem) -> np.ndarray:
    """The K actions of a discounted decision problem, shape (K, m).

    Raises:
      ValueError: the problem is a game, has no discount, has constraints, depends on time, or its controls are not
        finite.
    """
    if problem.is_game:
        raise ValueError("transition_arrays: got a game; a decision problem has one player. Leave out disturbances")
    if not problem.discount > 0:
        raise ValueError(
            "transition_arrays: got discount = 0, wanted > 0: the factor would be 1, and stationary decision problems "
            "require a factor < 1 (QuantEcon's methods refuse 1)"
        )
    if is_constrained(problem):
        what = problem.labels.word("a stopping_cost or running_max")
        raise ValueError(f"transition_arrays: got {what}, which a decision problem cannot hold")
    if problem.push_steps:
        raise ValueError(
            "transition_arrays: got a problem with pushes, which take effect at once, while an action of a decision "
            "problem\ntakes a time step; leave out pushes, or bound the speed of the motion by a control"
        )
    if problem.switching_costs is not None:
        raise ValueError(
            "transition_arrays: got modes with a switching_cost, which takes effect at once, while an action of a "
            "decision problem\ntakes a time step; leave out switching_cost, or let the control set the rates"
        )
    if problem.time_dependent:
        raise ValueError("transition_arrays: got time_dependent=True, wanted a stationary problem")
    if problem.controls is None:
        return np.zeros((1, 0))  # a single action without inputs: an uncontrolled chain
    if not isinstance(problem.controls, Finite):  # the resolution of the sampling is the user's choice
        kind = type(problem.controls).__name__
        raise ValueError(
            f"transition_arrays: got controls in a {kind}, wanted Finite: sample it, e.g. Box.grid(num) or "
            "Simplex.grid(num)"
        )
    return np.asarray(problem.controls.points, np.float64)


def surcharge(links: Sequence[stencil.Links], given: np.ndarray, grid: Grid) -> dict[tuple[int, ...], np.ndarray]:
    """For each jump the exit cost on the boundary of the target minus the exit cost of the node behind it, (*grid)."""
    extra = {}
    for axis, link in enumerate(links):
        for step, meets in ((1, link.meets_up), (-1, link.meets_down)):
            if meets is not None:
                # the table pays the exit cost of the node behind the boundary, a cut link pays the exit cost at the
                # crossing
                offset = stencil.unit(grid, axis, step)
                beyond = np.asarray(stencil.neighbour(jax.numpy.asarray(given), grid, offset))
                crosses, there = (np.asarray(entry) for entry in meets)
                extra[offset] = np.where(crosses, there - beyond, 0)
    return extra


def paid(jumps: Rates, extra: dict[tuple[int, ...], np.ndarray]) -> np.ndarray | float:
    """The surcharges per unit time, Σ_o c_o extra_o."""
    return sum(c * extra.get(offset, 0.0) for offset, c in zip(jumps.offsets, jumps.values, strict=True))


def decision_problem(
    tables: Iterable[Table], grid: Grid, count: int, held: np.ndarray, given: np.ndarray, discount: float
) -> tuple[np.ndarray, "csr_array", np.ndarray, np.ndarray, float]:
    """Costs, probabilities, indices and factor for pairs of state and action; see ``chain.transition_arrays``.

    Args:
      tables: for each action the jumps, the running cost and the nodes where it is admissible; only one action is in
        memory at a time.
      grid: the grid.
      count: the number K of actions.
      held: the nodes of the target, where the tables are zero.
      given: the exit cost on the target.
      discount: β.
    """
    from scipy.sparse import csr_array

    costs, admissible = np.empty((grid.size, count)), np.ones((grid.size, count), bool)
    entries, columns = np.empty((0,)), np.empty((0,), int)
    number = np.arange(grid.size).reshape(grid.shape)
    for k, (jumps, cost, allowed) in enumerate(tables):
        ends = (np.roll(number, [-step for step in offset], axis=range(grid.ndim)) for offset in jumps.offsets)
        found = list(zip(ends, jumps.values, strict=True))
        found += [(landing.nodes, landing.rate) for landing in jumps.landings]
        if k == 0:  # the last entry of a row is its diagonal
            entries = np.empty((grid.size, count, len(found) + 1))
            # 32-bit indices halve the memory; SciPy requires 64 bits for longer row pointers
            columns = np.empty(entries.shape, np.int32 if entries.size < 2**31 else np.int64)
            columns[..., -1] = number.reshape(-1, 1)
        costs[:, k], admissible[:, k] = cost.ravel(), allowed.ravel()
        for place, (end, c) in enumerate(found):
            entries[:, k, place], columns[:, k, place] = c.ravel(), end.ravel()
    # (S, K, jumps + 1): one Δt for all states and actions, because the decision problem has a single factor
    leaving = entries[..., :-1].sum(axis=-1)
    dt = time_step(leaving)
    entries[..., :-1] *= dt
    entries[..., -1] = np.maximum(1 - leaving * dt, 0)  # 1 − 1 in the fastest row, which may round below zero
    factor = 1 / (1 + discount * dt)
    # a target keeps its state: (1 − γ) g per step, for all steps, is worth g
    paid = np.where(held.reshape(-1, 1), (1 - factor) * given.reshape(-1, 1), factor * dt * costs)
    # every row has the entries of all jumps, so the row pointers are an arithmetic sequence
    starts = np.arange(0, entries.size + 1, entries.shape[-1], dtype=columns.dtype)
    layout = (entries.ravel(), columns.ravel(), starts)
    probabilities = csr_array(layout, shape=(costs.size, grid.size))
    probabilities.sum_duplicates()  # jumps across the seam of an axis with two nodes coincide; also sorts the columns
    probabilities.eliminate_zeros()
    refuse(
        "no action is admissible: all actions leave the box across a constrained end",
        np.logical_not(np.any(admissible, axis=1)).reshape(grid.shape),
        grid,
    )
    pairs = np.flatnonzero(admissible)  # rows of the matrix, sorted by state and then by action
    state, action = np.divmod(pairs, count)
    if pairs.size < costs.size:
        probabilities = probabilities[pairs]
    return paid.ravel()[pairs], probabilities, state, action, factor
