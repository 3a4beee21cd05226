"""What random problems are made of: their functions, and the families that fix what is compiled."""

import dataclasses

import jax.numpy as jnp

# --- the functions, of one state, and with the states of all nodes in rows ---


def bare(xp, p, x):
    """The drift without players: a swing, a linear part, and beyond a wall a current along the first axis."""
    swing = xp.sin(x @ p["turn"] + p["phase"])
    drift = p["base"] + x @ p["linear"] + swing[..., None] * p["swing"]
    return drift + xp.where(x[..., :1] > p["wall"], 1.0, 0.0) * p["current"]


def drift_full(p, x, u):
    return bare(jnp, p, x) + p["gain"] @ u


def drift_own(p, x, u):
    free, gain = bare(jnp, p, x), p["gain"]
    return jnp.stack([free[i] + gain[i, i] * u[i] for i in range(len(x))])


def drift_game(p, x, u, d):
    return bare(jnp, p, x) + p["gain"] @ u + p["push"] @ d


def drift_apart(p, x, u, d):
    free = bare(jnp, p, x)
    return jnp.stack([free[0] + p["gain"][0] @ u, free[1] + p["push"][1] @ d])


def of_state(xp, p, x):
    return p["toll"] + xp.abs(x - p["middle"]) @ p["slope"] + p["wave"] * xp.sin(x @ p["turn"])


def cost_linear(p, x, u, *d):
    total = of_state(jnp, p, x) + p["price"] @ u
    return total + p["harm"] @ d[0] if d else total


def cost_square(p, x, u, *d):
    return cost_linear(p, x, u, *d) + p["square"] @ (u * u)


def target(p, x):
    return p["side"] * (jnp.max(jnp.abs(x - p["goal"])) - p["reach"])


def level(p, x):
    return p["height"] + jnp.abs(x[0] - p["spot"]) * p["steep"]


def noise_of_state(p, x, u):
    return p["sigma"] * (1.2 + jnp.sin(x @ p["turn"]))


# --- families ---


@dataclasses.dataclass(frozen=True)
class Family:
    """What fixes the compiled programs of a random problem.

    Args:
      name: for tables.
      shape: nodes an axis.
      controls, disturbances: "none", "finite", "box" or "ball", and the number of inputs after it, as in "box2".
      drift: "full", "own", "game" or "apart", as the functions are called.
      cost: "linear", "square" or "none".
      noise: "none", "diagonal", "matrix" or "state".
      discounted: whether there is a discount.
      ends: which of "target", "exit", "stop", "floor", "rest", "lost" there are.
      periodic, stretched: one bool an axis.
      lower: whether the game is max min.
      single: whether to solve in float32.
      edges: "constrained" where no action may leave the box; projected otherwise.
    """

    name: str
    shape: tuple
    controls: str = "box1"
    disturbances: str = ""
    drift: str = "full"
    cost: str = "square"
    noise: str = "none"
    discounted: bool = True
    ends: tuple = ()
    periodic: tuple = None
    stretched: tuple = None
    lower: bool = False
    single: bool = False
    edges: str = ""


LINE, PLANE = (21,), (7, 6)
RING, TUBE = (True,), (False, True)
FAMILIES = [
    Family("line", LINE, ends=("target", "exit")),
    Family("line, stop", LINE, noise="diagonal", ends=("stop",)),
    Family("line, state noise", LINE, noise="state", cost="linear", ends=("target", "exit")),
    Family("line, stretched", LINE, noise="diagonal", ends=("target", "exit", "stop"), stretched=(True,)),
    Family("ring, finite", LINE, "finite1", periodic=RING),
    Family("ring, ball", LINE, "ball1", noise="diagonal", cost="linear", periodic=RING, ends=("target",)),
    Family("line, float32", LINE, ends=("target", "exit"), single=True),
    Family("time, line", LINE, discounted=False, ends=("target", "exit", "lost")),
    Family("time, stretched", LINE, discounted=False, ends=("target",), stretched=(True,)),
    Family("time, noise", LINE, "finite1", discounted=False, noise="diagonal", ends=("target", "exit")),
    Family("time, stop", LINE, discounted=False, ends=("stop",)),
    Family("rest, line", LINE, discounted=False, ends=("rest",)),
    Family("rest, exit", LINE, discounted=False, ends=("rest", "target", "exit")),
    Family("reach, line", LINE, cost="none", discounted=False, ends=("stop",)),
    Family("avoid, line", LINE, cost="none", discounted=False, ends=("floor",)),
    Family("reach-avoid, line", LINE, "finite1", cost="none", discounted=False, ends=("stop", "floor")),
    Family("line, constrained", LINE, edges="constrained", ends=("stop",)),
    Family("line, constrained noise", LINE, "ball1", cost="linear", noise="diagonal", edges="constrained",
           ends=("target", "exit")),
    Family("time, constrained", LINE, discounted=False, edges="constrained", ends=("target", "exit")),
    Family("plane, constrained", PLANE, "box2", drift="own", edges="constrained", periodic=TUBE),
    Family("game, line", LINE, "box1", "box1", "game", "linear", ends=("target", "exit")),
    Family("game, lower", LINE, "box1", "box1", "game", "linear", periodic=RING, lower=True),
    Family("game, finite", LINE, "finite1", "finite1", "game", "linear", noise="diagonal", lower=True, ends=("stop",)),
    Family("game, reach", LINE, "finite1", "finite1", "game", "none", discounted=False, ends=("stop",)),
    Family("plane, pairs", PLANE, "box2"),
    Family("plane, one input", PLANE, "box1", noise="diagonal", periodic=TUBE, ends=("target", "exit")),
    Family("plane, ball", PLANE, "ball2", drift="own", cost="linear", ends=("target", "exit")),
    Family("plane, three inputs", PLANE, "box3", ends=("target", "exit")),
    Family("plane, three inputs, noise", PLANE, "box3", noise="diagonal", periodic=TUBE),
    Family("plane, shared ball", PLANE, "ball2", ends=("stop",)),
    Family("plane, ball of three", PLANE, "ball3", noise="diagonal", ends=("target", "exit")),
    Family("plane, correlated", PLANE, "finite2", noise="matrix", ends=("stop",)),
    Family("plane, correlated box", PLANE, "box1", noise="matrix", ends=("target", "exit"), periodic=TUBE),
    Family("plane, stretched", PLANE, "box2", drift="own", noise="diagonal", stretched=(True, True)),
    Family("plane, uncontrolled", PLANE, "none0", noise="matrix", cost="linear", discounted=False, ends=("target",)),
    Family("plane, float32", PLANE, "box2", drift="own", ends=("stop",), single=True),
    Family("time, plane", PLANE, "ball2", drift="own", cost="linear", discounted=False,
           ends=("target", "exit", "lost")),
    Family("time, correlated", PLANE, "box2", drift="own", noise="matrix", discounted=False, ends=("target", "exit")),
    Family("rest, plane", PLANE, "box2", drift="own", discounted=False, ends=("rest",)),
    Family("game, plane", PLANE, "box1", "box1", "apart", "linear", ends=("target", "exit")),
    Family("game, three inputs", PLANE, "box3", "box2", "apart", ends=("target", "exit")),
    Family("game, plane lower", PLANE, "finite1", "finite2", "game", "linear", noise="diagonal", lower=True),
    Family("reach, plane", PLANE, "ball2", drift="own", cost="none", discounted=False, ends=("stop",)),
    Family("reach-avoid, plane", PLANE, "finite2", cost="none", discounted=False, ends=("stop", "floor")),
    Family("avoid game, plane", PLANE, "finite1", "finite1", "apart", "none", discounted=False, ends=("floor",)),
]  # fmt: skip
BY_NAME = {family.name: family for family in FAMILIES}
