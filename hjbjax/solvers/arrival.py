"""A test by simulation that the feedback of a solution reaches the target.

Suppose that there is no discount and that continuing costs nothing. Then V does not distinguish a policy that reaches a
reward from a policy that rests on the way: under the resting policy a path of the system never arrives, but the chain
arrives eventually by numerical diffusion and pays nothing until then. Following a few paths shows the difference.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST
from hjbjax.problem.problem import is_constrained, is_random
from hjbjax.problem.pytree import cast
from hjbjax.problem.types import AtNodes, Nodes
from hjbjax.semi_lagrangian import arcs
from hjbjax.semi_lagrangian.arcs import ArcPath
from hjbjax.solution.status import warn
from hjbjax.tracing import components

PATHS = 64  # largest number of paths
LONG = 20  # legs per path, times the number of nodes summed over the axes: about 20 crossings of the box
PROMISED = 0.05  # fraction of the largest reward: where V promises less, resting is equally good
SHARE = 0.1  # fraction of the paths: if more never arrive, warn


def warn_of_no_arrival(task: Task, state: State) -> None:
    """Warn if the feedback never reaches the reward that V promises; host level, for a converged solution."""
    if not _may_rest(task):
        return
    value, counted = np.asarray(state.value), np.asarray(task.counted)
    free = counted & ~np.asarray(task.obstacles.fixed)
    best = float(np.min(value[counted], initial=0))
    places = np.argwhere(free & (value < PROMISED * best))
    if best >= 0 or not len(places):
        return
    places = places[:: -(-len(places) // PATHS)]
    start = [np.asarray(task.grid.axis(axis))[index] for axis, index in enumerate(places.T)]
    on, most = task.on.chain, LONG * sum(task.grid.shape)
    payoff, costs = task.problem.payoff, task.problem.payoff == COST
    share = 1 - float(np.mean(_arrive(on, state.policy.controls, start, most=most)))
    if share > SHARE:
        bound, price = (f"down to {best:.4g}", "positive") if costs else (f"up to {-best:.4g}", "negative")
        warn(
            f"the feedback never arrives from about {share:.0%} of the nodes where V promises a reward on the target "
            f"(V {bound}): time costs nothing there, so resting indefinitely looks as good as arriving. "
            f"Give time a price: a discount > 0, or a {price} running {payoff}"
        )


def _may_rest(task: Task) -> bool:
    """True if nothing else makes a policy arrive: no discount, no positive running cost, no noise."""
    problem = task.problem
    undiscounted = np.all(np.asarray(problem.discount) == 0)
    one_player = not problem.is_game and not is_random(problem) and task.mesh is None
    if not (undiscounted and one_player) or problem.target is None or problem.exit_cost is None:
        return False
    if task.least_cost is not None:  # stored only where it is positive: resting then costs indefinitely
        return False
    if is_constrained(problem) or task.grid.sides("open") or task.grid.prescribed():
        return False
    # if something can be earned on the way, a policy may stay away for that reason
    return problem.cost is None or (task.floor is not None and bool(task.floor > np.finfo(task.tol.dtype).min / 16))


@functools.partial(jax.jit, static_argnames="most")
def _arrive(on: Discretisation, policy: tuple[Nodes, ...], start: list[Nodes], *, most: int) -> jax.Array:
    """The paths of a feedback that meet the target within ``most`` legs, bool, one per start."""
    on = cast(on, on.dtype)
    grid, x = on.grid, [jnp.asarray(place, on.dtype) for place in start]
    everywhere = [jnp.broadcast_to(place, grid.shape) for place in on.coordinates()]
    actions = [jnp.broadcast_to(action, grid.shape) for action in policy]
    drift = [jnp.broadcast_to(f, grid.shape) for f in on.drift(actions, [], everywhere)]
    slowest = arcs.SLOWEST * jnp.max(arcs.speed(grid, everywhere, drift))
    level = components.of_state(on.problem, on.problem.target, x, on.t, on.dtype)
    zero = jnp.zeros_like(x[0])

    def further(carry: tuple[ArcPath, jax.Array]) -> tuple[ArcPath, jax.Array]:
        path, count = carry
        nearest = _nearest(grid, path.x)
        return arcs.leg(on, path, [action[nearest] for action in actions], slowest), count + 1

    def goes_on(carry: tuple[ArcPath, jax.Array]) -> jax.Array:
        return (carry[1] < most) & ~jnp.all(carry[0].ended)

    path = ArcPath(x, zero, zero, level, level <= 0)
    return jax.lax.while_loop(goes_on, further, (path, jnp.zeros((), jnp.int32)))[0].ended


def _nearest(grid: Grid, x: list[AtNodes]) -> tuple[jax.Array, ...]:
    """The indices of the nodes nearest to the states."""
    found = []
    for axis, place in enumerate(x):
        lower, fraction, _ = grid._locate(axis, place)
        index = lower + (fraction > 0.5)
        found.append(index % grid.shape[axis] if grid.periodic[axis] else index)
    return tuple(found)
