"""Text for a terminal: the printed screen of a solution, and one line of any text.

The text may come from somebody else's file. So long texts are cut first, control characters are shown as Python writes
them, and a statistic of an unexpected type is replaced by the name of its type.
"""

import base64
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

WIDTH = 100  # columns of the printed screen
THUMBNAIL = 160  # pixels, and the largest number of nodes an axis that it shows
UNITS = ("bytes", "kB", "MB", "GB", "TB")


class _Answer(Protocol):
    """The part of a solution that is printed."""

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
    """The screen of a solution: at most 15 lines; lines of which nothing is known are left out."""
    stats, grid = solution.stats, solution.grid
    axes = " x ".join(name + " (periodic)" * flag for name, flag in zip(grid.labels, grid.periodic, strict=True))
    last = "" if solution.residual is None else f", last residual {solution.residual:.3g}"
    reached = 1.0 if solution.reached is None else float(np.mean(np.asarray(solution.reached)))
    compiling = f", and {number(stats['compile_seconds'])} to check and compile" if "compile_seconds" in stats else ""
    dtype = number(stats.get("dtype") or str(np.asarray(solution.value).dtype))
    # each with its own guard: any of the statistics may be unknown, and in a file any may be of another kind
    rows = {
        "grid": f"{axes}: {' x '.join(map(str, grid.shape))} = {grid.size:,} nodes",
        "times": "" if solution.times is None else str(np.size(solution.times)),
        "method": ", ".join(number(stats[name]) for name in ("method", "scheme") if name in stats),
        "steps": f"{int(solution.steps)}{last}",
        "algebraic error": _error(solution),
        "grid error": _estimate(solution.grid_error) or number(stats.get("grid_error", "")),
        "box error": _estimate(solution.box_error) or number(stats.get("box_error", "")),
        "reached": f"{percent(reached)} of the nodes" if reached < 1 else "",
        "cut": _cuts(solution),
        "isaacs gap": "" if solution.isaacs_gap is None else number(solution.isaacs_gap),
        "seconds": f"{number(stats['seconds'])}{compiling}" if "seconds" in stats else "",
        "memory": size(stats["bytes"]) if "bytes" in stats else "",
        "device": f"{_devices(stats)}, {dtype}" if "device" in stats else dtype,
    }
    said = plain(f"{solution.status.name}: {solution.message or solution.status.message}")
    head = textwrap.wrap(said, WIDTH)
    lines = head if len(head) < 4 else [*head[:2], one_line(" ".join(head[2:]))]
    return encodable("\n".join(lines + [f"  {name:15}  {one_line(text)}" for name, text in rows.items() if text]))


def _devices(stats: dict[str, Any]) -> str:
    """The kind of the device, or of the devices that had parts of the nodes, and how they lay."""
    kind, mesh = number(stats["device"]), stats.get("mesh")
    return f"{' x '.join(map(number, mesh))} {kind}" if isinstance(mesh, (list, tuple)) else kind


def thumbnail(solution: _Answer) -> str:
    """A small picture of V as HTML: a line over one axis, an image over the first two, the middle of all others.

    Of a marched solution at the earliest kept time. Dark is low; where V is not finite there is nothing.
    """
    from matplotlib import colormaps, image  # a second of importing, for notebooks alone

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
    """The ends of the box at which the optimal drift is cut off, with the number of nodes at each."""
    if solution.cut is None or not np.any(solution.cut):
        return ""
    # of a marched solution the worst of the kept times, shape (n, 2)
    counts = np.max(np.asarray(solution.cut).reshape(-1, solution.grid.ndim, 2), axis=0)

    # short, as a screen has one line for it: an axis takes some 30 characters
    def both(lower: int, upper: int) -> str:
        return ", ".join(f"{count} {end}" for count, end in ((lower, "lower"), (upper, "upper")) if count)

    axes = np.flatnonzero(np.any(counts, axis=1))
    ends = ", ".join(f"{solution.grid.names[axis]} ({both(*counts[axis].tolist())})" for axis in axes)
    return f"drift out of the box, nodes at the ends: {ends}"


def _error(solution: _Answer) -> str:
    """The certified error and its certificate, or why there is none; beside it that of the monotone answer."""
    error, tol = solution.error, solution.stats.get("tol")
    if error is None and solution.monotone_error is not None and tol is not None:
        said = f"residual at most {number(tol)} at high order"
        # a bound above the range of V says nothing
        finite = np.asarray(solution.value)[np.isfinite(np.asarray(solution.value))]
        useful = finite.size and solution.monotone_error < np.ptp(finite)
        return f"{said}; of the monotone start at most {number(solution.monotone_error)}" if useful else said
    what = "no certificate" if error is None else f"at most {error:.3g}"
    asked = "" if error is None or tol is None else f" (tol {number(tol)})"
    why = solution.stats.get("certificate")
    return what + asked + (f": {number(why)}" if why else "")


def _estimate(error: Any) -> str:
    """The largest and the mean of an error that was estimated at every node; nothing without an estimate."""
    if error is None:
        return ""
    found = np.asarray(error)
    found = found[np.isfinite(found)]
    return f"about {np.max(found):.3g}, {np.mean(found):.3g} in the mean" if found.size else ""


def one_line(text: str, width: int = WIDTH) -> str:
    """A text in one line of at most ``width`` characters."""
    text = plain(text)
    return text if len(text) <= width else text[: width - 4] + " ..."


def number(value: Any) -> str:
    """A number in three digits; a text as it is; of anything else its type."""
    if arguments.is_number(value):
        return f"{float(value):.3g}"
    return value if isinstance(value, str) else f"a {type(value).__name__}"


def percent(share: float) -> str:
    """A share in per cent, rounded down to a tenth, so that 100 % is all and nothing else."""
    return f"{math.floor(1000 * share) / 10:.1f} %"


def size(count: Any) -> str:
    """A number of bytes in the unit that suits it."""
    if not arguments.is_number(count):
        return number(count)
    count, unit = float(count), 0
    while count >= 1000 and unit < len(UNITS) - 1:
        count, unit = count / 1000, unit + 1
    return f"{count:.3g} {UNITS[unit]}"
