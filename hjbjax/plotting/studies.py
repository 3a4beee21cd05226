"""Pictures of how a solve went and of studies: residuals, errors over spacings, changes over noise, fitted orders."""

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
    """The errors of a convergence study over the spacing and over the seconds, with the fitted orders.

    Full marks are the largest errors, rings the mean ones; the thin line beside the full marks has the fitted
    slope. Errors of zero have no logarithm and are left out; an estimate is called one in the label of the axis.

    Args:
      study: the result of ``convergence_study``.

    Keyword Args:
      ax: matplotlib axes to draw on: one for the errors over the spacing, or two, the second for the seconds;
        ``None`` makes a figure of pyplot's with both.

    Returns:
      The artists: the line of the largest errors over the spacing first.

    Raises:
      ValueError: no error is positive and finite.
    """
    if not np.any((study.errors > 0) & np.isfinite(study.errors)):
        raise ValueError(f"convergence: the errors are {study.errors}; there is none with a logarithm to draw")
    axes: list[Axes] = pair_of_axes() if ax is None else list(np.ravel(cast(Any, ax)))
    quality = "estimated error" if study.estimated else "error"
    own = ax is None  # of a figure of our own the second axes share the first one's scale, and its label
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
            # log E = log C + p log h: with the slope p known, the mean of the logarithms gives C
            middle = np.exp(np.mean(np.log(study.errors[fitted])) - study.order * np.mean(np.log(x[fitted])))
            artists += place.plot(x[fitted], middle * x[fitted] ** study.order, color=GREY, linewidth=3, zorder=0)
        logarithmic(place, study.h if name == "h" else None)
        label_axes(place, name, "" if own and name == "seconds" else quality)
        legend(place)
    return Picture(artists, axes[0])


@drawing
def perturbation(study: Perturbation, *, ax: Axes | None = None) -> Picture:
    """The changes of value and feedback over ε and over 1/γ in one picture, with the fitted orders.

    Full marks are values, rings feedbacks; the thin grey line beside the full marks has the fitted slope.

    Args:
      study: the result of ``perturbation_study``.

    Keyword Args:
      ax: matplotlib axes to draw on; ``None`` takes pyplot's current ones.

    Returns:
      The artists: the line of the values over ε first.

    Raises:
      ValueError: no change is positive and finite.
    """
    artists: list[Artist] = []
    ax = axes_of(ax)
    for series, color in ((study.noise, COLOURS[0]), (study.gain, COLOURS[1])):
        if not np.any((series.errors > 0) & np.isfinite(series.errors)):
            raise ValueError(f"perturbation: the changes over {series.name} are {series.errors}; none has a logarithm")
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
    logarithmic(ax)
    label_axes(ax, "ε, 1/γ", "largest change")
    # lines that rise leave this corner free
    artists.append(ax.legend(loc="upper left", fontsize=8, frameon=False, borderaxespad=0.2, handlelength=1.4))
    return Picture(artists, ax)


@drawing
def residuals(solution: Solution, *, ax: Axes | None = None, label: str | None = None) -> Picture:
    """The residual after each step on a logarithmic scale; steps where it is not finite are marked grey.

    Args:
      solution: the solution of ``solve``; its history lives on the host and is kept by neither ``jit`` nor ``vmap``.

    Keyword Args:
      ax: matplotlib axes to draw on; ``None`` takes pyplot's current ones.
      label: of the line in the legend, to compare several.

    Raises:
      ValueError: the solution carries no history.
    """
    history = np.asarray(solution.residuals if solution.residuals is not None else (), dtype=float).ravel()
    if history.size == 0:
        raise ValueError(
            "residuals: the solution carries no history; it stays behind under jit and vmap: use solve directly"
        )
    ax = axes_of(ax, wide=True)
    steps = np.arange(1, history.size + 1)
    drawable = np.isfinite(history) & (history > 0)  # an exact zero has no logarithm
    shown = np.ma.masked_where(~drawable, history)
    line = ax.plot(steps, shown, color=None if label else COLOURS[0], label=label)[0]
    if history.size < 60:  # more marks than that would run together
        line.set(marker="o", markersize=3)
    ax.set_yscale("log")
    artists: list[Artist] = [line, *bands(ax, steps, ~np.isfinite(history), "not finite")]
    label_axes(ax, "step", "residual")
    if label or len(artists) > 1:
        legend(ax)
    return Picture(artists, ax)
