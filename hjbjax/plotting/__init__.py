"""Plots of values, feedbacks and closed loops.

Every function draws on the ``ax`` argument, by default on a new figure, and returns a ``Picture``: the list of its
artists, the main one first, with ``.ax``, ``.figure`` and ``.save(path)``. To draw on a picture pass its ``.ax``.
The functions do not show figures and do not change rcParams. If axes are given, pyplot is not imported.

A plot has one or two axes. Fields over more states are cut by ``fixed={axis or name: coordinate}``, with linear
interpolation between nodes as in ``value_at``. Entries that are not finite are hatched and explained in the legend. A
periodic axis is closed at its seam. Names and units come from ``Grid(names=, units=)`` and
``Problem(control_names=, control_units=)``. Two axes with the same unit of length have the same scale, and angles have
ticks at multiples of π. If a solution carries its problem, its target is outlined.
"""

from typing import TYPE_CHECKING, NoReturn

from hjbjax.plotting.enclosures import enclosure
from hjbjax.plotting.estimates import density, estimates
from hjbjax.plotting.histories import controls, costates
from hjbjax.plotting.level_sets import Scene, animation, turning_surface, zero_level_set
from hjbjax.plotting.maps import closed_loop, policy, switching_curve, trajectory, value
from hjbjax.plotting.studies import convergence, perturbation, residuals
from hjbjax.plotting.style import COLOURS, GREY, Picture, styled
from hjbjax.plotting.surfaces import level_surface
from hjbjax.problem import words

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
    "enclosure",
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

if not TYPE_CHECKING:  # otherwise type checkers would accept any name

    def __getattr__(name: str) -> NoReturn:
        """Refuse a name that does not exist, with the way out; Python calls this function for no other name."""
        raise AttributeError(words.missing(f"module {__name__!r}", name, words.OF_PLOTTING, __all__), name=name)
