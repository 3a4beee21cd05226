"""Plots of residuals, convergence studies and perturbation studies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from hjbjax.plotting.shading import bands
from hjbjax.plotting.style import (
    COLOURS,
    GREY,
    Picture,
    axes_of,
    drawing,
    label_axes,
    legend,
    logarithmic,
    pair_of_axes,
)

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from hjbjax.applications.convergence import Study
    from hjbjax.applications.perturbations import Perturbation
    from hjbjax.solution.solution import Solution


@drawing
def convergence(study: Study, *, ax: Axes | Sequence[Axes] | np.ndarray | None = None) -> Picture:
    """Plot the errors of a convergence study against the spacing and the run time, with the fitted orders.

    Filled markers are the largest errors and open markers the mean errors. The grey line next to the filled markers has
    the fitted slope. Zero errors are omitted. Estimated errors are labelled as such on the axis.

    Args:
      study: the result of ``convergence_study``.

    Keyword Args:
      ax: matplotlib axes to draw on: one for the errors against the spacing, or two, the second against the seconds;
        ``None`` makes a pyplot figure with both.

    Returns:
      The artists, first the line of the largest errors against the spacing.

    Raises:
      ValueError: no error is positive and finite.
    """
    if not np.any((study.errors > 0) & np.isfinite(study.errors)):
        raise ValueError(f"convergence: got the errors {study.errors}, wanted a positive finite one")
    axes: list[Axes] = pair_of_axes() if ax is None else list(np.ravel(cast(Any, ax)))
    quality = "estimated error" if study.estimated else "error"
    own = ax is None  # in a new figure the second axes share the scale and the label of the first
    artists: list[Artist] = []
    for place, x, name in zip(axes, (study.h, study.seconds), ("h", "seconds"), strict=False):
        for y, order, kind, fill in (
            (study.errors, study.order, "largest", COLOURS[0]),
            (study.mean_errors, study.mean_order, "mean", "white"),
        ):
            label = f"{kind}, order {order:.2f}" if np.isfinite(order) and name == "h" else kind
            shown = np.ma.masked_where(~(np.isfinite(y) & (y > 0)), y)
            style: dict[str, Any] = {"color": COLOURS[0], "markerfacecolor": fill, "linewidth": 1.2, "markersize": 5}
            artists += place.plot(x, shown, marker="o", label=label, **style)
        fitted = study.fitted & np.isfinite(study.errors) & (study.errors > 0)
        if name == "h" and np.isfinite(study.order) and fitted.any():
            # log E = log C + p log h: for the fitted slope p, the mean of the logarithms gives C
            middle = np.exp(np.mean(np.log(study.errors[fitted])) - study.order * np.mean(np.log(x[fitted])))
            artists += place.plot(x[fitted], middle * x[fitted] ** study.order, color=GREY, linewidth=3, zorder=0)
        logarithmic(place, study.h if name == "h" else None)
        label_axes(place, name, "" if own and name == "seconds" else quality)
        legend(place)
    return Picture(artists, axes[0])


@drawing
def perturbation(study: Perturbation, *, ax: Axes | None = None) -> Picture:
    """Plot the changes of value and feedback against ε and against 1/γ, with the fitted orders.

    Filled markers are values and open markers feedbacks. The grey line next to the filled markers has the fitted slope.

    Args:
      study: the result of ``perturbation_study``.

    Keyword Args:
      ax: matplotlib axes to draw on; ``None`` makes a new figure.

    Returns:
      The artists, first the line of the values against ε.

    Raises:
      ValueError: no change is positive and finite.
    """
    artists: list[Artist] = []
    ax = axes_of(ax)
    for series, color in ((study.noise, COLOURS[0]), (study.gain, COLOURS[1])):
        if not np.any((series.errors > 0) & np.isfinite(series.errors)):
            raise ValueError(f"perturbation: got changes {series.errors} over {series.name}, wanted a positive one")
        for what, y, order, fill in (
            ("V", series.errors, series.order, color),
            ("u", series.feedback_errors, series.feedback_order, "white"),
        ):
            shown = np.ma.masked_where(~(np.isfinite(y) & (y > 0)), y)
            label = f"{what} over {series.name}" + (f", order {order:.2f}" if np.isfinite(order) else "")
            style: dict[str, Any] = {"color": color, "markerfacecolor": fill, "linewidth": 1.2, "markersize": 5}
            artists += ax.plot(series.parameters, shown, marker="o", label=label, **style)
        if np.isfinite(series.order):
            x, y = series.parameters[series.fitted], series.errors[series.fitted]
            middle = np.exp(np.mean(np.log(y)) - series.order * np.mean(np.log(x)))
            artists += ax.plot(x, middle * x**series.order, color=GREY, linewidth=3, zorder=0)
    logarithmic(ax, np.unique(np.concatenate([study.noise.parameters, study.gain.parameters])))
    label_axes(ax, "ε, 1/γ", "largest change")
    # the lines rise, so this corner is free
    artists.append(ax.legend(loc="upper left", fontsize=8, frameon=False, borderaxespad=0.2, handlelength=1.4))
    return Picture(artists, ax)


@drawing
def residuals(solution: Solution, *, ax: Axes | None = None, label: str | None = None) -> Picture:
    """Plot the residual after each step on a logarithmic scale; steps with a residual that is not finite are hatched.

    Args:
      solution: the solution of ``solve``. Its history is stored on the host, and ``jit`` and ``vmap`` drop it.

    Keyword Args:
      ax: matplotlib axes to draw on; ``None`` makes a new figure.
      label: label of the line in the legend, to compare several solutions.

    Raises:
      ValueError: the solution has no history.
    """
    history = np.asarray(solution.residuals if solution.residuals is not None else (), dtype=float).ravel()
    if history.size == 0:
        raise ValueError(
            "residuals: the solution has no history, because jit and vmap drop it; call solve outside of them"
        )
    ax = axes_of(ax, wide=True)
    steps = np.arange(1, history.size + 1)
    drawable = np.isfinite(history) & (history > 0)  # zero has no logarithm
    shown = np.ma.masked_where(~drawable, history)
    line = ax.plot(steps, shown, color=None if label else COLOURS[0], label=label)[0]
    if history.size < 60:  # more markers would overlap
        line.set(marker="o", markersize=3)
    ax.set_yscale("log")
    artists: list[Artist] = [line, *bands(ax, steps, ~np.isfinite(history), "not finite")]
    label_axes(ax, "step", "residual")
    if label or len(artists) > 1:
        legend(ax)
    return Picture(artists, ax)
