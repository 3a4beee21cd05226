"""Plots of output feedback: states and their estimates over time, and the density of the state on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.plotting.scales import is_angle, set_ticks, time_label
from hjbjax.plotting.shading import Look, draw
from hjbjax.plotting.slices import section_of
from hjbjax.plotting.style import COLOURS, Picture, axes_of, drawing, label_axes, legend
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Array

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from hjbjax.filtering.output_loop import OutputPath


@drawing
def estimates(
    path: OutputPath,
    *,
    components: Sequence[int] | None = None,
    measurements: bool = False,
    grid: Grid | None = None,
    ax: Axes | None = None,
    names: Sequence[str] | None = None,
) -> Picture:
    """Plot the states of a path over time as solid lines, and their estimates as dashed lines of the same colour.

    Args:
      path: one path of ``simulate_output``; for a batch select one, ``jax.tree.map(lambda a: a[0], paths)``.

    Keyword Args:
      components: indices of the states to plot; ``None`` for all.
      measurements: plot the mean rates of the measurement record, dy/dt over each interval, as dots.
      grid: a grid with the names of the states; along its periodic axes the estimates are shifted next to the state.
      ax: matplotlib axes to draw on; ``None`` makes a new figure.
      names: names of the states, instead of the grid's.

    Returns:
      The picture: for each state its line and the line of its estimate, then the dots, then the legend.

    Raises:
      ValueError: the path is a batch of paths, or does not have these states.

    Example:
      >>> from types import SimpleNamespace
      >>> path = SimpleNamespace(times=np.array([0.0, 1.0]), states=np.ones((2, 1)), estimates=np.zeros((2, 1)))
      >>> [line.get_ydata().tolist() for line in estimates(path)[:2]]
      [[1.0, 1.0], [0.0, 0.0]]
    """
    times, states, guessed = (np.asarray(array) for array in (path.times, path.states, path.estimates))
    if states.ndim != 2:
        raise ValueError(
            f"estimates: got states of shape {states.shape}, wanted one path, (k+1, n): for a batch select one, "
            "jax.tree.map(lambda a: a[0], paths)"
        )
    count = states.shape[1]
    shown = list(range(count)) if components is None else [int(i) for i in components]
    if not shown or not all(0 <= i < count for i in shown):
        raise ValueError(f"estimates: got components = {components!r}; the path has states 0 to {count - 1}")
    names = tuple(names or (grid.labels if grid is not None else (f"x{i + 1}" for i in range(count))))
    ax = axes_of(ax, wide=True)
    artists: list[Artist] = []
    for k, i in enumerate(shown):
        colour, estimate = COLOURS[k % len(COLOURS)], guessed[:, i]
        if grid is not None and grid.periodic[i]:
            # the states of a path are unwound, while the mean of a density on a grid is inside the box
            period = float(grid.hi[i] - grid.lo[i])
            estimate = estimate + period * np.round((states[:, i] - estimate) / period)
        artists += ax.plot(times, states[:, i], color=colour, linewidth=1.4, label=names[i])
        artists += ax.plot(times, estimate, "--", color=colour, linewidth=1.4, label=f"{names[i]}, estimated")
    if measurements:
        lengths = np.diff(times)[:, None]
        # intervals of length zero follow the end of a path
        rates = np.ma.masked_invalid(
            np.where(lengths > 0, path.measurements / np.where(lengths > 0, lengths, 1), np.nan)
        )
        for j in range(rates.shape[1]):
            label = "dy/dt" if rates.shape[1] == 1 else f"dy{j + 1}/dt"
            style: dict[str, Any] = {"color": COLOURS[(len(shown) + j) % len(COLOURS)], "markersize": 2, "alpha": 0.5}
            artists += ax.plot((times[:-1] + times[1:]) / 2, rates[:, j], ".", zorder=0, label=label, **style)
    label_axes(ax, time_label(grid), names[shown[0]] if len(shown) == 1 else "state")
    set_ticks(ax.xaxis, False)
    set_ticks(ax.yaxis, len(shown) == 1 and grid is not None and is_angle(grid, shown[0]))
    return Picture([*artists, legend(ax)], ax)


@drawing
def density(
    values: Array,
    grid: Grid,
    *,
    axes: Sequence[int] | None = None,
    state: Array | Sequence[float] | None = None,
    estimate: Array | Sequence[float] | None = None,
    ax: Axes | None = None,
    colorbar: bool = True,
) -> Picture:
    """Plot a density on a grid over one or two of its axes, integrated over the others, with the true state.

    Args:
      values: the density at the nodes, (*grid), as in an ``InformationState`` at one time.
      grid: the grid.

    Keyword Args:
      axes: indices of one or two axes; ``None`` for the first two, or the only one.
      state: the true state, shape (n,), drawn as a circle over two axes and as a line over one.
      estimate: the estimated state, shape (n,), drawn as a cross over two axes and as a dashed line over one.
      ax: matplotlib axes to draw on; ``None`` makes a new figure.
      colorbar: draw a colour bar next to a two-dimensional plot.

    Returns:
      The picture: the line or the mesh first, then the markers.

    Raises:
      ValueError: the density does not have the shape of the grid, or the grid does not have these axes.

    Example:
      >>> grid = Grid([-1.0, 0.0], [1.0, 2.0], (3, 5), names=("x", "parameter"))
      >>> line, mark = density(np.full((3, 5), 0.25), grid, axes=[0], state=[0.5, 1.0])
      >>> line.get_ydata().tolist(), mark.get_xdata()
      ([0.5, 0.5, 0.5], [0.5, 0.5])
    """
    field = np.asarray(values, float)
    if field.shape != grid.shape:
        raise ValueError(f"density: got values of shape {field.shape} on a grid of shape {grid.shape}")
    kept = list(range(min(grid.ndim, 2))) if axes is None else [int(i) for i in axes]
    if len(kept) not in (1, 2) or len(set(kept)) < len(kept) or not all(0 <= i < grid.ndim for i in kept):
        raise ValueError(f"density: got axes = {axes!r}, wanted one or two of 0 to {grid.ndim - 1}")
    kept = sorted(kept)
    plane = Grid(
        [grid.lo[i] for i in kept],
        [grid.hi[i] for i in kept],
        tuple(grid.shape[i] for i in kept),
        tuple(grid.periodic[i] for i in kept),
        tuple(grid.names[i] for i in kept),
        stretch=tuple(grid.stretch[i] for i in kept),
        units=tuple(grid.units[i] for i in kept),
    )
    others = tuple(i for i in range(grid.ndim) if i not in kept)
    marginal = np.sum(field * grid.volumes(), axis=others) / plane.volumes()
    ax = axes_of(ax)
    section = section_of("density", marginal, plane, None, "")
    artists = draw(ax, section, Look("density", "not finite", colorbar))
    for point, style, marker, label in ((state, "-", "o", "state"), (estimate, "--", "x", "estimate")):
        if point is None:
            continue
        place = np.asarray(grid.wrap(np.asarray(point, float)))[kept]
        if len(kept) == 1:
            artists.append(ax.axvline(float(place[0]), color=COLOURS[1], linestyle=style, label=label))
        else:
            mark: dict[str, Any] = {"markerfacecolor": "none", "markeredgecolor": COLOURS[1], "markeredgewidth": 1.6}
            artists += ax.plot(*place, marker, linestyle="none", label=label, zorder=5, **mark)
    if len(artists) > 1 and (state is not None or estimate is not None):
        legend(ax)
    return Picture(artists, ax)
