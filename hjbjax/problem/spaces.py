"""Spaces of Gymnasium as admissible sets and grids, and factors per step as discounts.

Gymnasium is not imported. A space is recognised by its attributes: ``low`` and ``high`` of a Box, ``n`` and ``start``
of a Discrete, ``nvec`` of a MultiDiscrete.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import front_door, is_traced
from hjbjax.problem.sets import Box, Finite
from hjbjax.problem.types import Number


def is_space(thing: object) -> bool:
    """True for a space of Gymnasium."""
    return hasattr(thing, "contains") and hasattr(thing, "sample") and hasattr(thing, "seed")


def is_environment(thing: object) -> bool:
    """True for an environment of Gymnasium."""
    return hasattr(thing, "action_space") and hasattr(thing, "observation_space")


@front_door
def from_gymnasium(
    space: Any,
    shape: Sequence[int] | None = None,
    *,
    lo: Sequence[float | None] | None = None,
    hi: Sequence[float | None] | None = None,
    **options: Any,
) -> Box | Finite | Grid:
    """The set of controls of an action space, or with ``shape`` the grid of an observation space.

    Actions keep their numbers: a Discrete(2) is the finite set {0, 1}, whose meaning, such as a force, belongs in the
    drift. A feedback then returns the action itself. A grid is useful if the observation is the state. An observation
    such as (cos θ, sin θ, θ') is not: write the ``Grid`` of (θ, θ') and compute the state in your policy.

    Args:
      space: a Box, a Discrete or a MultiDiscrete of Gymnasium, such as ``env.action_space``.
      shape: the number of nodes per axis, for a grid.
      lo: lower bounds that replace those of the space; one entry per axis, ``None`` keeps the bound.
      hi: upper bounds, in the same form.
      options: other arguments of ``Grid``: ``periodic``, ``names``, ``units``, ``stretch``, ``edges``.

    Returns:
      A ``Box`` or a ``Finite``; with ``shape`` a ``Grid``.

    Raises:
      TypeError: the space is not one of these.
      ValueError: a grid of a space that is discrete or has infinite bounds.

    Example:
      >>> from types import SimpleNamespace  # like make("MountainCarContinuous-v0").observation_space
      >>> space = SimpleNamespace(low=np.float32([-1.2, -0.07]), high=np.float32([0.6, 0.07]), shape=(2,))
      >>> from_gymnasium(space, (91, 71), names=("position", "velocity")).hi.tolist()
      [0.6, 0.07]
    """
    if is_environment(space):
        raise TypeError("from_gymnasium: got an environment, wanted env.action_space or env.observation_space")
    if shape is None and options:
        raise TypeError(f"from_gymnasium: {', '.join(options)} belong to a grid; give shape= as well")
    if hasattr(space, "low") and hasattr(space, "high"):
        bounds = _bounds(space.low, lo, "lo"), _bounds(space.high, hi, "hi")
        return Box(*bounds) if shape is None else _grid(bounds, shape, options)
    if shape is not None:
        raise ValueError(f"from_gymnasium: got the space {space}, wanted a Box for a grid; a discrete state is a mode")
    if hasattr(space, "nvec"):
        starts = np.ravel(getattr(space, "start", np.zeros(np.shape(space.nvec), int)))
        ranges = [range(first, first + count) for first, count in zip(starts, np.ravel(space.nvec), strict=True)]
    elif hasattr(space, "n") and hasattr(space, "start"):
        ranges = [range(int(space.start), int(space.start + space.n))]
    else:
        raise TypeError(
            f"from_gymnasium: got {space!r:.200}, wanted a Box, a Discrete or a MultiDiscrete.\n"
            "Write other spaces as hjb.Box(lo, hi), hjb.Finite(points) or hjb.Grid(lo, hi, shape)"
        )
    return Finite([[float(number) for number in point] for point in itertools.product(*ranges)])


@front_door
def discount_rate(gamma: Number, dt: Number) -> Any:
    """The discount per unit time, β = −log(γ)/dt, of a factor γ per step: γ^(t/dt) = e^(−βt).

    Args:
      gamma: the factor per step, 0 < γ ≤ 1.
      dt: the length of a step, in units of time.

    Raises:
      ValueError: a factor or a step that is not admissible.

    Example:
      >>> round(discount_rate(0.99, dt=0.05), 4)
      0.201
    """
    if is_traced(gamma, dt):
        import jax.numpy as jnp

        return -jnp.log(gamma) / dt
    if not 0 < gamma <= 1:
        raise ValueError(f"discount_rate: got gamma = {gamma!r}, wanted a factor per step, 0 < gamma <= 1")
    if not (math.isfinite(dt) and dt > 0):
        raise ValueError(f"discount_rate: got dt = {dt!r}, wanted the length of a step, positive and finite")
    return -math.log(gamma) / float(dt) + 0.0  # γ = 1 gives 0, not −0


def _bounds(of_space: Any, own: Sequence[float | None] | None, name: str) -> np.ndarray:
    """Bounds in float64 with the user's replacements; 0.07 in float32 becomes 0.07, its shortest decimal."""
    found = np.array([float(str(number)) for number in np.ravel(of_space)])
    if own is None:
        return found
    if len(own) != len(found):
        raise ValueError(f"from_gymnasium.{name}: got {len(own)} bounds, wanted {len(found)}, None to keep a bound")
    return np.array([old if new is None else float(new) for old, new in zip(found, own, strict=True)])


def _grid(bounds: tuple[np.ndarray, np.ndarray], shape: Sequence[int], options: dict[str, Any]) -> Grid:
    """The grid between bounds, which must be finite."""
    infinite = np.flatnonzero(~np.isfinite(bounds[0]) | ~np.isfinite(bounds[1]))
    if infinite.size:
        replaced = [3.0 if axis in infinite else None for axis in range(len(bounds[0]))]
        raise ValueError(
            f"from_gymnasium: the space has no bounds on the axes {infinite.tolist()}; wanted a finite box.\n"
            f"Give the range that matters, such as lo={[x and -x for x in replaced]}, hi={replaced}"
        )
    return Grid(*bounds, tuple(shape), **options)
