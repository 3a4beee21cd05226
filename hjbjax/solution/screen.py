"""Text for a terminal: the printed summary of a solution, and any text on one line.

The text may come from a file of another person. Long texts are therefore cut first, control characters are escaped as
in Python, and a statistic of an unexpected type is replaced by the name of its type.
"""

import base64
import functools
import html
import io
import math
import textwrap
from typing import Any, Protocol

import numpy as np

from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.streams import encodable, plain
from hjbjax.problem.types import Array, Number
from hjbjax.solution.status import Status

WIDTH = 80  # columns of the printed summary, the width of a page of the documentation
LABEL = 19  # columns of the labels
THUMBNAIL = 160  # pixels, and the largest number of nodes per axis
UNITS = ("bytes", "kB", "MB", "GB", "TB")


class _Answer(Protocol):
    """The attributes of a solution that are printed."""

    @property
    def grid(self) -> Grid: ...
    @property
    def value(self) -> Array: ...
    @property
    def times(self) -> Array | None: ...
    @property
    def reached(self) -> Array | None: ...
    @property
    def cut(self) -> Array | None: ...
    @property
    def stopping(self) -> Array | None: ...
    @property
    def pushing(self) -> Array | None: ...
    @property
    def steps(self) -> int: ...
    @property
    def residual(self) -> float | None: ...
    @property
    def error(self) -> Number | None: ...
    @property
    def grid_error(self) -> Array | None: ...
    @property
    def box_error(self) -> Array | None: ...
    @property
    def monotone_error(self) -> Number | None: ...
    @property
    def isaacs_gap(self) -> Number | None: ...
    @property
    def status(self) -> Status: ...
    @property
    def message(self) -> str: ...
    @property
    def stats(self) -> dict: ...


def show(solution: _Answer) -> str:
    """The printed summary of a solution: one line per entry, or two; unknown entries are left out."""
    stats, grid = solution.stats, solution.grid
    last = "" if solution.residual is None else f", last residual {solution.residual:.3g}"
    reached = 1.0 if solution.reached is None else float(np.mean(np.asarray(solution.reached)))
    compiling = f", and {number(stats['compile_seconds'])} to check and compile" if "compile_seconds" in stats else ""
    dtype = number(stats.get("dtype") or str(np.asarray(solution.value).dtype))
    # each statistic is checked separately: any may be missing, and in a file any may have the wrong type
    rows = {
        "grid": _grid_text(grid),
        "times": "" if solution.times is None else str(np.size(solution.times)),
        "method": ", ".join(number(stats[name]) for name in ("method", "scheme") if name in stats),
        "steps": f"{int(solution.steps)}{last}",
        "algebraic error": _error(solution),
        "grid error": _estimate(solution.grid_error) or number(stats.get("grid_error", "")),
        "box error": _estimate(solution.box_error) or number(stats.get("box_error", "")),
        "reached": f"{percent(reached)} of the nodes" if reached < 1 else "",
        "cut": _cuts(solution),
        "bounds": number(stats.get("bounds", "")),
        "stopping": _share(solution, solution.stopping),
        "pushing": _share(solution, None if solution.pushing is None else solution.pushing.any(axis=-1)),
        "isaacs gap": "" if solution.isaacs_gap is None else number(solution.isaacs_gap),
        "seconds": f"{number(stats['seconds'])}{compiling}" if "seconds" in stats else "",
        "memory": size(stats["bytes"]) if "bytes" in stats else "",
        "device": f"{_devices(stats)}, {dtype}" if "device" in stats else dtype,
    }
    said = plain(f"{solution.status.name}: {solution.message or solution.status.message}")
    head = textwrap.wrap(said, WIDTH)
    lines = head if len(head) < 4 else [*head[:2], one_line(" ".join(head[2:]))]
    return encodable("\n".join(lines + [_row(name, text) for name, text in rows.items() if text]))


def _row(name: str, text: str) -> str:
    """A label and its text, on one line or two."""
    width, text = WIDTH - LABEL, plain(text)
    first, *rest = [text] if len(text) <= width else textwrap.wrap(text, width)
    label = f"  {name}".ljust(LABEL)
    return f"{label}{first}" + (f"\n{' ' * LABEL}{one_line(' '.join(rest), width)}" if rest else "")


def _grid_text(grid: Grid) -> str:
    """The axes with their numbers of nodes; only the numbers if the names would not fit on two lines."""
    axes = " x ".join(map(functools.partial(_axis_text, grid), range(grid.ndim)))
    counts = f"{' x '.join(map(str, grid.shape))} = {grid.size:,} nodes"
    return f"{axes}: {counts}" if len(axes) + len(counts) + 2 <= 2 * (WIDTH - LABEL) - 20 else counts


def _devices(stats: dict[str, Any]) -> str:
    """The kind of device, with the shape of the mesh if the nodes are divided among several devices."""
    kind, mesh = number(stats["device"]), stats.get("mesh")
    return f"{' x '.join(map(number, mesh))} {kind}" if isinstance(mesh, (list, tuple)) else kind


def _axis_text(grid: Grid, axis: int) -> str:
    """The name of an axis, and whether it is periodic; of an axis of modes their names."""
    if axis not in grid.state_axes:
        return f"modes {', '.join(grid.modes)}"
    return grid.labels[axis] + " (periodic)" * grid.periodic[axis]


def thumbnail(solution: _Answer) -> str:
    """A small plot of V as HTML: a line in 1-D, otherwise an image over the first two axes at the middle of the others.

    A marched solution is shown at its earliest kept time. Dark is low; nodes where V is not finite are transparent.
    """
    from matplotlib import colormaps, image  # takes a second to import, needed in notebooks only

    values = np.asarray(solution.value, float)
    values = values if solution.times is None else values[0]
    values = values[(slice(None), slice(None), *(count // 2 for count in values.shape[2:]))[: values.ndim]]
    finite = values[np.isfinite(values)]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    share = (values - low) / (high - low if high > low else 1.0)
    if values.ndim == 1:
        share = np.where(np.arange(THUMBNAIL)[:, None] / (THUMBNAIL - 1) <= share, share, np.nan).T
    every = [-(-count // THUMBNAIL) for count in share.shape]
    pixels = colormaps["viridis"](np.ma.masked_invalid(share[:: every[0], :: every[1]].T[::-1]), bytes=True)
    png = io.BytesIO()
    image.imsave(png, pixels, format="png")
    code = base64.b64encode(png.getvalue()).decode()
    axes = " and ".join(html.escape(name) for name in solution.grid.labels[:2])
    size = f"width: {THUMBNAIL}px; height: {THUMBNAIL}px"
    return f'<img alt="V over {axes}" style="{size}" src="data:image/png;base64,{code}">'


def _cuts(solution: _Answer) -> str:
    """The ends of the box at which the optimal drift is cut off, with the number of nodes at each end."""
    if solution.cut is None or not np.any(solution.cut):
        return ""
    # the largest count over the kept times of a marched solution, shape (n, 2)
    counts = np.max(np.asarray(solution.cut).reshape(-1, solution.grid.ndim, 2), axis=0)

    # short, because everything must fit on one line: an axis takes some 30 characters
    def both(lower: int, upper: int) -> str:
        return ", ".join(f"{count} {end}" for count, end in ((lower, "lower"), (upper, "upper")) if count)

    axes = np.flatnonzero(np.any(counts, axis=1))
    ends = ", ".join(f"{solution.grid.names[axis]} ({both(*counts[axis].tolist())})" for axis in axes)
    return f"drift out of the box, nodes at the ends: {ends}"


def _share(solution: _Answer, mask: Any) -> str:
    """The share of the nodes where it is optimal to stop or to push, at the earliest kept time."""
    if mask is None:
        return ""
    first = mask if solution.times is None else mask[0]
    return f"optimal at {percent(float(np.mean(np.asarray(first))))} of the nodes"


def _error(solution: _Answer) -> str:
    """The certified error and its certificate, or the reason why there is none, and the error of the monotone value."""
    error, stats = solution.error, solution.stats
    tol = stats.get("tol")
    if error is None and solution.monotone_error is not None and tol is not None:
        said = f"residual at most {number(stats.get('high_order_tol', tol))} at high order"
        # a bound above the range of V is useless
        finite = np.asarray(solution.value)[np.isfinite(np.asarray(solution.value))]
        useful = finite.size and solution.monotone_error < np.ptp(finite)
        return f"{said}; of the monotone start at most {number(solution.monotone_error)}" if useful else said
    what = "no certificate" if error is None else f"at most {error:.3g}"
    asked = "" if error is None or tol is None else f" (tol {number(tol)})"
    why = stats.get("certificate")
    return what + asked + (f": {number(why)}" if why else "")


def _estimate(error: Any) -> str:
    """The largest and the mean estimated error over the nodes; empty without an estimate."""
    if error is None:
        return ""
    found = np.asarray(error)
    found = found[np.isfinite(found)]
    return f"about {np.max(found):.3g}, {np.mean(found):.3g} in the mean" if found.size else ""


def one_line(text: str, width: int = WIDTH) -> str:
    """A text on one line of at most ``width`` characters."""
    text = plain(text)
    return text if len(text) <= width else text[: width - 4] + " ..."


def number(value: Any) -> str:
    """A number with three digits; a text unchanged; for anything else its type."""
    if arguments.is_number(value):
        return f"{float(value):.3g}"
    return value if isinstance(value, str) else f"a {type(value).__name__}"


def percent(share: float) -> str:
    """A fraction in per cent, rounded down to a tenth, so that 100 % means all."""
    return f"{math.floor(1000 * share) / 10:.1f} %"


def size(count: Any) -> str:
    """A number of bytes in a suitable unit."""
    if not arguments.is_number(count):
        return number(count)
    count, unit = float(count), 0
    while count >= 1000 and unit < len(UNITS) - 1:
        count, unit = count / 1000, unit + 1
    return f"{count:.3g} {UNITS[unit]}"
