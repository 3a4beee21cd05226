"""Pictures of values, feedbacks and closed loops.

Every function draws on the ``ax`` it is given, or else on pyplot's current axes, and returns a ``Picture``: the list
of the artists it drew, the main one first, with ``.figure`` and ``.save(path)``. Nothing is shown, no rcParams are
touched, and where axes are given pyplot is not even imported.

A picture has one or two axes. Fields over more states are cut by ``fixed={axis or name: coordinate}``,
linearly between nodes as ``value_at`` does. Entries that are not finite are never drawn as
numbers: they are hatched, with a line in the legend. A periodic axis is closed at its seam. Names and units come
from ``Grid(names=, units=)`` and ``Problem(control_names=, control_units=)``; two axes with one unit of length have
one scale, and angles have ticks at multiples of π. A solution that remembers its problem has its target outlined.
"""

from hjbjax.plotting.estimates import density, estimates
from hjbjax.plotting.histories import controls, costates
from hjbjax.plotting.level_sets import Scene, animation, turning_surface, zero_level_set
from hjbjax.plotting.maps import closed_loop, policy, switching_curve, trajectory, value
from hjbjax.plotting.studies import convergence, perturbation, residuals
from hjbjax.plotting.style import COLOURS, GREY, Picture, styled
from hjbjax.plotting.surfaces import level_surface

__all__ = [
    "COLOURS",
    "GREY",
    "Picture",
    "Scene",
    "animation",
    "closed_loop",
    "controls",
    "convergence",
    "costates",
    "density",
    "estimates",
    "level_surface",
    "perturbation",
    "policy",
    "residuals",
    "styled",
    "switching_curve",
    "trajectory",
    "turning_surface",
    "value",
    "zero_level_set",
]
