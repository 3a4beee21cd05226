"""One step: the residual of the variational inequality, the greedy policy, and the policy's linear equation.

At a free node let r = min_u max_d H(u, d) − β V, in cost per unit time, and s = r/(Q + β), its size in cost units. The
Bellman operator of the chain is T V = V + s at the greedy action. Then

    residual = max(min(s, ψ − V), g − V),      V ← V + residual  is  V ← max(g, min(ψ, T V)).

Nodes on the target, and rest points of an undiscounted problem, have fixed values. For one policy the equation is
linear: δ = s + Σ_o w_o δ(x + o) with weights w_o = c_o/(Q + β). Where the constraint is the active branch, s = ψ − V
  and
w = 0 (or s = g − V). Every method solves this equation for the correction δ, exactly or approximately.
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from hjbjax.discretisation import edges, stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.interventions import Interventions
from hjbjax.discretisation.rates import Rates, fastest_rate, jump_rates
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.hamiltonian.search import Action
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Field, Nodes, Number, Scalar

LEAK = 64  # units of eps of Q: a smaller rate towards an unreachable node is rounding
ROUNDING = 8  # units of eps in (Q + β)|V|: a smaller gain of one action over another is rounding


@pytree_dataclass()
class Obstacles:
    """Constraints on the value in addition to the equation, at every node.

    Args:
      fixed: bool (*grid), the nodes with prescribed values.
      fixed_value: the prescribed values, (*grid) or a number.
      upper: ψ at the nodes, or None.
      lower: g at the nodes, or None.
      ended: bool (*grid), the fixed nodes that are targets, where no further action is taken.
      least_exit: the least exit cost on boundaries between the nodes, a number; zero if none is negative.
      interventions: the changes of the mode and the pushes that the controller may make at once.
    """

    fixed: jax.Array
    fixed_value: Scalar | Field
    upper: Field | None = None
    lower: Field | None = None
    ended: jax.Array | bool = False
    least_exit: Number = 0.0
    interventions: Interventions = Interventions()

    def ceiling(self, value: Nodes) -> Field | None:
        """The bound that stopping and interventions put on V: min(ψ, M V); None without either."""
        bounds = [*([] if self.upper is None else [self.upper]), *self.interventions.after(value)]
        return functools.reduce(jnp.minimum, bounds) if bounds else None

    def impose(self, value: Field) -> Field:
        """``value`` with fixed values inserted and constraints imposed: max(g, min(ψ, V))."""
        # ψ before g: where g > ψ the running maximum takes precedence, as in the residual
        if self.upper is not None:
            value = jnp.minimum(value, self.upper)
        if self.interventions:
            value = self.interventions.impose(jnp.where(self.fixed, self.fixed_value, value))
        if self.lower is not None:
            value = jnp.maximum(value, self.lower)
        return jnp.where(self.fixed, self.fixed_value, value)

    def clipped(self, step: Field, value: Field) -> Field:
        """max(min(s, ψ − V), g − V) for a step s, and zero where V is fixed."""
        if self.upper is not None:
            step = jnp.minimum(step, self.upper - value)
        if self.interventions:  # to one step at the node to which they lead, so that V = M V after it
            step = self.interventions.cheapest(value + jnp.where(self.fixed, 0, step)) - value
        if self.lower is not None:
            step = jnp.maximum(step, self.lower - value)
        return jnp.where(self.fixed, 0, step)

    def acting(self, value: Nodes) -> jax.Array:
        """The nodes at which actions matter, bool (*grid): not fixed, and no constraint is the active branch."""
        acts = ~self.fixed  # where V = ψ the run stops, and where V = g the maximum is attained, so no action matters
        if (ceiling := self.ceiling(value)) is not None:
            acts &= value < ceiling
        return acts if self.lower is None else acts & (value > self.lower)


@pytree_dataclass()
class Greedy:
    """The greedy policy of a value function and its defect in the equation.

    Args:
      defect: r = min max H − β V, (*grid), cost per unit time; zero where fixed.
      controls: the m components of u, each (*grid).
      disturbances: the components of d, each (*grid).
    """

    defect: Field
    controls: tuple[Field, ...]
    disturbances: tuple[Field, ...]


@pytree_dataclass()
class PolicyEquation:
    """The linear equation δ = source + Σ_o weights_o δ(x + o) for a correction δ of the value, in cost units.

    ``fastest`` is the largest Q + β of its policy, per unit time; None if no rate counts as rounding. The rows of
    ``interventions`` have the weight one, δ(x) = source + δ(x + o).
    """

    source: Field
    weights: Rates
    fastest: Scalar | None = None
    interventions: Interventions = Interventions()


def obstacles(on: Discretisation) -> Obstacles:
    """The target, stopping cost and running maximum at the nodes."""
    problem = on.problem
    exit_cost, stop, floor = (
        None if ingredient is None else on.at_nodes(ingredient)
        for ingredient in (problem.exit_cost, problem.stopping_cost, problem.running_max)
    )
    held = jnp.zeros(on.grid.shape, bool) if problem.target is None else on.level <= 0
    # outside the target the exit cost is irrelevant and may be NaN
    given = jnp.zeros((), on.dtype) if exit_cost is None else jnp.where(held, exit_cost, 0)
    for axis, step, end in on.grid.prescribed("dirichlet"):
        edge = jnp.asarray(stencil.on_edge(on.grid, axis, step))
        given = jnp.where(edge & ~held, jnp.asarray(end.value, on.dtype), given)
        held = held | edge
    return Obstacles(held, given, stop, floor, ended=held, interventions=on.interventions().outside(held))


def greedy(
    on: Discretisation,
    value: Field,
    held: jax.Array,
    *,
    incumbent: Greedy | None = None,
    lost: jax.Array | None = None,
    first_order: jax.Array | None = None,
) -> Greedy:
    """The optimal actions at ``value`` and the defect r; an incumbent policy is among the candidates.

    Drift that is only rounding does not lead to ``lost`` nodes, bool (*grid). Where ``first_order`` is true
    the slopes of the chain are used.
    """
    return _with_defect(on, value, held, *optimum.optimise(_around(on, value, incumbent, lost, first_order)))


def relaxation(on: Discretisation, value: Field, outflow: Field | None = None) -> tuple[Field, Field]:
    """The defect r = min max H − β V before constraints, and Q + β of the fastest action, for s = r/(Q + β).

    Actions are not stored. Without the ``outflow`` Q + β, (*grid), memory is saved: rates are computed where they are
    used, at best in a single pass over V.
    """
    hamiltonian = dataclasses.replace(discrete.around(on, value), bare=outflow is None)
    players, discount = on.players, on.decay
    outflow = fastest_rate(on) + discount if outflow is None else outflow
    if players.control.fastest_at_ends and players.disturbance.fastest_at_ends:
        best = optimum.optimal_value(hamiltonian)
    else:
        best, u, d = optimum.optimise(hamiltonian)
        outflow = jnp.maximum(outflow, jump_rates(on, u, d).total() + discount)  # a fast action between the samples
    # the outflow is 1 where nothing moves, because the sweeps divide by it
    return best - discount * value, jnp.where(outflow > 0, outflow, 1)


def improvement(on: Discretisation, value: Field, fixed: jax.Array, new: Greedy, old: Greedy) -> Greedy:
    """The new policy where it is better by more than rounding or where nodes are ``fixed``, else the old one.

    Keeping the old action on ties keeps a proper policy proper: the first action found leads to the node from which the
    value came, while an equally good one may lead into a cycle. There is no disturbance.
    """
    hamiltonian, u, discount = _around(on, value, None), list(old.controls), on.decay
    rates = jump_rates(on, u, [])
    # H − β V is a sum of c V(x + o) − c V(x): terms of size (Q + β)|V|, each rounded
    rounding = ROUNDING * jnp.finfo(on.dtype).eps * (rates.total() + discount) * jnp.abs(value)
    rate = hamiltonian.at(u, []) - discount * value
    stays = ~fixed & (rate <= new.defect + rounding)
    controls = (jnp.where(stays, before, after) for before, after in zip(old.controls, new.controls, strict=True))
    return Greedy(jnp.where(stays, rate, new.defect), tuple(controls), ())


def respond(
    on: Discretisation,
    value: Field,
    held: jax.Array,
    current: Greedy,
    *,
    lost: jax.Array | None = None,
    first_order: jax.Array | None = None,
) -> Greedy:
    """The inner player's best response to the outer player's current policy, in a game; masks as in ``greedy``."""
    players = on.players
    # the current response is among the candidates, so a sampled player never gets worse
    hamiltonian = _around(on, value, current, lost, first_order)
    u, d = list(current.controls), list(current.disturbances)
    if on.problem.isaacs == "upper":  # min max: the control moves first, and the disturbance responds
        best, d = optimum.best_response(hamiltonian, players.disturbance, lambda d: (u, d))
    else:
        best, u = optimum.best_response(hamiltonian, players.control, lambda u: (u, d))
    return _with_defect(on, value, held, best, u, d)


def _around(
    on: Discretisation,
    value: Field,
    policy: Greedy | None,
    lost: jax.Array | None = None,
    first_order: jax.Array | None = None,
) -> discrete.DiscreteHamiltonian:
    """The Hamiltonian around V, with the actions of a policy among the candidates of a search."""
    hamiltonian = discrete.around(on, value, lost, first_order)
    if policy is None:
        return hamiltonian
    return dataclasses.replace(hamiltonian, tried=(list(policy.controls), list(policy.disturbances)))


def _with_defect(on: Discretisation, value: Field, held: jax.Array, best: Field, u: Action, d: Action) -> Greedy:
    """The policy u, d with its defect r = H − β V, zero at fixed nodes; ``best`` is H."""
    rate = jnp.where(held, 0, best - on.decay * value)
    # broadcast actions that are one number for all nodes: the carry of a loop has fixed shapes
    full = [tuple(jnp.broadcast_to(jnp.asarray(c, on.dtype), on.grid.shape) for c in action) for action in (u, d)]
    return Greedy(rate, *full)


def policy_equation(
    on: Discretisation, value: Field, policy: Greedy, obstacles: Obstacles, *,
    fastest: Scalar | None = None, every_rate: bool = False,
) -> PolicyEquation:  # fmt: skip
    """The linear equation for δ under one policy; the active branch of the constraints is chosen at every node.

    Rates that are small compared with the largest Q + β are rounding, and do not count unless ``every_rate`` is true.
    ``fastest`` is the largest Q + β, if it is known for the same policy and time; it saves a pass over the nodes.
    """
    u, d = list(policy.controls), list(policy.disturbances)
    rates = jump_rates(on, u, d)
    leaving = rates.total() + on.decay
    if every_rate:
        outflow = jnp.where(leaving > 0, leaving, 1)
    else:
        fastest = on.grid.layout.largest(leaving) if fastest is None else fastest
        moves = leaving > 8 * jnp.finfo(value.dtype).eps * fastest  # a drift that cancels leaves rounding
        # where nothing moves the cost accumulates
        outflow = jnp.where(moves, leaving, jnp.where(fastest > 0, fastest, 1))
    # s, then min(s, ψ − V), then max(·, g − V); a row whose branch is a constraint reads δ = source
    source, free = policy.defect / outflow, ~obstacles.fixed
    goes: list[jax.Array] = []
    interventions = obstacles.interventions
    if interventions:
        # compare with one step in the other mode, not with its value: otherwise two modes may change to each other
        worth = jnp.where(free, value + source, value)
        worth = worth if obstacles.upper is None else jnp.minimum(worth, obstacles.upper)
        goes = [free & each for each in interventions.chosen(worth, value)]
        for each, after in zip(goes, interventions.after(value), strict=True):
            source, free = jnp.where(each, after - value, source), free & ~each
    if obstacles.upper is not None:
        stops = free & (obstacles.upper - value < source)
        source, free = jnp.where(stops, obstacles.upper - value, source), free & ~stops
    if obstacles.lower is not None:
        floored = ~obstacles.fixed & (obstacles.lower - value > source)
        source, free = jnp.where(floored, obstacles.lower - value, source), free & ~floored
        goes = [each & ~floored for each in goes]
    weights = rates.scaled(jnp.where(free, 1 / outflow, 0))
    if on.cuts_links:  # links to fixed nodes end on the boundary of the target, where the correction is zero
        loose = ~obstacles.fixed
        jumps = zip(weights.offsets, weights.values, strict=True)
        cut = tuple(jnp.where(stencil.neighbour(loose, on.grid, offset), w, 0) for offset, w in jumps)
        weights = dataclasses.replace(weights, values=cut)
    weights = with_interventions(weights, interventions, goes)
    return PolicyEquation(source, weights, None if every_rate else fastest, interventions.without_costs)


def with_interventions(weights: Rates, interventions: Interventions, goes: Sequence[jax.Array]) -> Rates:
    """The weights with a weight of one to the node to which an intervention leads, where ``goes`` is true.

    An intervention is a jump that takes no time: V(x) = c + V(x + o), so the row reads δ(x) = s + δ(x + o).
    """
    if not goes:
        return weights
    table = dict(zip(weights.offsets, weights.values, strict=True))
    for offset, each in zip(interventions.offsets, goes, strict=True):
        table[offset] = table.get(offset, 0) + jnp.asarray(each, weights.values[0].dtype)
    return dataclasses.replace(weights, offsets=tuple(table), values=tuple(table.values()))


def leaks(on: Discretisation, policy: Greedy, held: jax.Array, lost: jax.Array) -> jax.Array:
    """True if the policy leads from a counted node to a ``lost`` one, by more than rounding."""
    grid, u, d = on.grid, list(policy.controls), list(policy.disturbances)
    rates, ends = jump_rates(on, u, d), list(zip(edges.beside(lost, grid), edges.slack(on), strict=True))
    # each part of the drift separately: if players are upwinded separately, one may lead there although the sum does
    # not
    leads = [
        functools.reduce(jnp.logical_or, (edges.leads(part[axis], *end) for part in on.drifts(u, d)))
        for axis, end in enumerate(ends)
    ]
    leaking = jnp.zeros(grid.shape, on.dtype)
    for offset, c in zip(rates.offsets, rates.values, strict=True):
        leak = jnp.where(stencil.neighbour(~lost, grid, offset), 0, c)
        if on.problem.noise is None:  # jumps along one axis
            axis = next(axis for axis, step in enumerate(offset) if step)
            leak = jnp.where(leads[axis], leak, 0) if axis in grid.state_axes else leak
        leaking = leaking + leak  # rates per unit time, (*grid): several small leaks add up
    for landing in rates.landings:
        leaking = leaking + jnp.where(landing.ahead(lost), landing.rate, 0)
    # relative to all rates of the node, since terms of the drift may cancel up to their rounding
    limit = LEAK * jnp.finfo(on.dtype).eps * rates.total()
    return grid.layout.some(~lost & ~held & (leaking > limit))
