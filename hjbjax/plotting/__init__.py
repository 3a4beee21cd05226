"""Pictures of values, feedbacks and closed loops.

Every function draws on the ``ax`` it is given, or on a new figure of its own, and returns the list of
artists it drew, the main one first; ``artists[0].get_figure().savefig("value.png")`` writes the picture.
Nothing is shown and no global state is touched (no pyplot, no rcParams), so all of it works without a display.

A picture has one or two axes. Fields over more states are cut by ``fixed={axis or name: coordinate}``,
linearly between nodes as ``value_at`` does. Entries that are not finite are never drawn as
numbers: they get a grey of their own and a line in the legend. A periodic axis is closed at its seam.
"""

from hjbjax.plotting.costates import costates
from hjbjax.plotting.estimates import density, estimates
from hjbjax.plotting.level_sets import animation, zero_level_set
from hjbjax.plotting.maps import closed_loop, controls, policy, residuals, switching_curve, trajectory, value
from hjbjax.plotting.studies import convergence, perturbation
from hjbjax.plotting.style import COLOURS, GREY, styled

__all__ = [
    "COLOURS",
    "GREY",
    "animation",
    "closed_loop",
    "controls",
    "convergence",
    "costates",
    "density",
    "estimates",
    "perturbation",
    "policy",
    "residuals",
    "styled",
    "switching_curve",
    "trajectory",
    "value",
    "zero_level_set",
]
