"""The pictures of the benchmarks, from the rows in ``benchmarks/results``: one message each.

Nothing is measured here. ``publish`` draws the picture of a benchmark together with its rows, and
``python -m benchmarks charts`` draws all of them again.
"""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

RESULTS = Path(__file__).parents[1] / "results"
WIDTH, HEIGHT, DPI = 11.0, 5.6, 120  # inches, and pixels per inch: 1320 pixels wide
APART = 0.062  # the distance of two labels, relative to the height of the axes

Row = dict[str, Any]


class Line(NamedTuple):
    """A line with its name at its end."""

    label: str
    x: list[float]
    y: list[float]


class Chart(NamedTuple):
    """Two logarithmic axes with lines, and laws: slopes that are drawn grey through the end of the longest line."""

    x: str
    y: str
    lines: list[Line]
    laws: tuple[tuple[str, float], ...] = ()
    title: str = ""


class Drawing(NamedTuple):
    """A picture: its message and its charts, side by side."""

    message: str
    charts: list[Chart]


def lines_of(rows: Sequence[Row], name: str | Callable[[Row], str], x: str, y: str) -> list[Line]:
    """One line per name, of the rows with positive finite numbers, in the order of x."""
    label = name if callable(name) else lambda row: str(row[name])
    known = [row for row in rows if all(_positive(row.get(key)) for key in (x, y))]
    found = []
    for each in dict.fromkeys(map(label, known)):
        points = sorted((row[x], row[y]) for row in known if label(row) == each)
        found.append(Line(each, [p[0] for p in points], [p[1] for p in points]))
    return found


def with_slopes(lines: Sequence[Line]) -> list[Line]:
    """The lines with the fitted slope of their last three points in the label."""
    found = []
    for line in lines:
        if len(line.x) > 1:
            slope = np.polyfit(np.log(line.x[-3:]), np.log(line.y[-3:]), 1)[0]
            line = line._replace(label=f"{line.label}: exponent {slope:.2f}")
        found.append(line)
    return found


def scaling(rows: Sequence[Row]) -> dict[str, Drawing]:
    """The N^n law."""
    lines = lines_of(rows, lambda row: f"{row['dimension']} state{'s' * (row['dimension'] > 1)}", "nodes", "seconds")
    chart = Chart("nodes, N^n", "seconds of a certified solve", with_slopes(lines), (("exponent 1", 1.0),))
    message = "N nodes per axis are N^n nodes; seconds grow like the number of nodes"
    return {"scaling": Drawing(message, [chart])}


def growth(rows: Sequence[Row]) -> dict[str, Drawing]:
    """Finer and finer grids."""
    lines = with_slopes(lines_of(rows, "problem", "nodes", "seconds"))
    chart = Chart("nodes", "seconds of a certified solve", lines, (("exponent 1", 1.0),))
    return {"growth": Drawing("Ten times the nodes take about ten times the seconds", [chart])}


def peers(rows: Sequence[Row]) -> dict[str, Drawing]:
    """One certified solve by several packages."""
    chart = Chart("nodes", "seconds, compiled", lines_of(rows, "code", "nodes", "seconds"))
    return {"peers": Drawing("A pendulum with 21 controls, certified to 1e-3, by several packages", [chart])}


def sweep(rows: Sequence[Row]) -> dict[str, Drawing]:
    """One sweep, with the copy of the value as the limit."""
    words = {"numba": "numba loop", "sweep": "one sweep", "loop": "sweeps in a loop", "improve": "an improvement",
             "copy": "a copy of the value: the limit", "step": "a step of solve"}  # fmt: skip
    shown = [row for row in rows if row.get("problem") == "pendulum" and row.get("kernel") in words]
    chart = Chart("nodes", "seconds", lines_of(shown, lambda row: words[row["kernel"]], "nodes", "seconds"))
    return {"sweep": Drawing("One sweep over a pendulum with 21 controls in float32", [chart])}


def controls(rows: Sequence[Row]) -> dict[str, Drawing]:
    """Seconds against the number of controls, and against the error."""
    number = [row for row in rows if row.get("part") == "number"]
    error = [row for row in rows if row.get("part") == "error"]
    first = Chart(
        "controls", "seconds of a certified solve", with_slopes(lines_of(number, "minimum", "controls", "seconds")),
        (("exponent 1", 1.0),),
    )  # fmt: skip
    second = Chart(
        "error of V", "seconds of a certified solve", with_slopes(lines_of(error, "minimum", "error", "seconds")),
        (("the bound, exponent −5", -5.0),),
    )  # fmt: skip
    return {
        "controls": Drawing("Thirty times the controls take less than three times the seconds", [first]),
        "controls_error": Drawing("The work grows more slowly than the bound O(1/ε^(2n+m)), n = 2, m = 1", [second]),
    }


def information(rows: Sequence[Row]) -> dict[str, Drawing]:
    """The error of a belief on grids."""
    measured = [row for row in rows if row.get("part") == "measured"]
    lines = lines_of(measured, "problem", "nodes", "error")
    return {
        "information": Drawing("Each hidden state adds one dimension to the belief", [Chart("nodes", "error", lines)])
    }


def by_problem(rows: Sequence[Row], name: str, x: str) -> list[Chart]:
    """One chart per problem: the error against ``x``, called ``name``, with one line per scheme."""
    problems = dict.fromkeys(row["problem"] for row in rows if _positive(row.get("error")))
    found = []
    for problem in problems:
        lines = lines_of([row for row in rows if row.get("problem") == problem], "scheme", x, "error")
        found.append(Chart(name, "error", lines, title=problem))
    return found


def precision(rows: Sequence[Row]) -> dict[str, Drawing]:
    """Error against seconds, one chart per problem."""
    message = "Second and fifth order reach a smaller error in the same time"
    return {"precision": Drawing(message, by_problem(rows, "seconds", "seconds"))}


def accuracy(rows: Sequence[Row]) -> dict[str, Drawing]:
    """Error against the spacing, one chart per problem."""
    return {"accuracy": Drawing("Errors against known answers fall with the spacing", by_problem(rows, "spacing", "h"))}


CHARTS: dict[str, Callable[[Sequence[Row]], dict[str, Drawing]]] = {
    "accuracy": accuracy, "controls": controls, "growth": growth, "information": information, "peers": peers,
    "precision": precision, "scaling": scaling, "sweep": sweep,
}  # fmt: skip


def draw(folder: Path, name: str, rows: Sequence[Row]) -> list[Path]:
    """Draw the pictures of a benchmark from its rows, and return their files; none without numbers."""
    made = []
    for stem, drawing in CHARTS[name](rows).items() if name in CHARTS else ():
        charts = [chart for chart in drawing.charts if chart.lines]
        if charts:
            made.append(folder / f"{stem}.png")
            _picture(made[-1], drawing._replace(charts=charts), _caption(name, rows))
    return made


def _caption(name: str, rows: Sequence[Row]) -> str:
    """The machine, the versions and the dates of the rows."""
    last = max(rows, key=lambda row: row.get("date", ""))
    versions = last.get("versions", {})
    days = sorted({row["date"][:10] for row in rows if row.get("date")})
    when = " to ".join(dict.fromkeys((days[0], days[-1]))) if days else ""
    return (
        f"python -m benchmarks {name}; {last.get('device')}, {last.get('cores')} cores, {last.get('cores')} threads; "
        f"hjbjax {versions.get('hjbjax')}, JAX {versions.get('jax')}; {when}"
    )


def _picture(path: Path, drawing: Drawing, caption: str) -> None:
    """Write one picture."""
    from matplotlib.figure import Figure

    across = min(3, len(drawing.charts))
    down = -(-len(drawing.charts) // across)
    figure = Figure(figsize=(WIDTH, HEIGHT if down == 1 else 3.0 * down + 1.0), layout="constrained")
    axes = figure.subplots(down, across, squeeze=False).ravel()
    colours = _colours([line.label for chart in drawing.charts for line in chart.lines])
    together = len(drawing.charts) > 1
    for ax, chart in zip(axes, drawing.charts, strict=False):
        _chart(ax, chart, colours, at_end=not together)
    for ax in axes[len(drawing.charts) :]:
        ax.remove()
    if together:  # one legend for all, because names at the ends would cover the next chart
        handles = {line.get_label(): line for ax in axes[: len(drawing.charts)] for line in ax.get_lines()}
        figure.legend(handles.values(), handles.keys(), loc="outside lower right", ncols=6, frameon=False, fontsize=10)
    figure.suptitle(drawing.message, x=0.01, ha="left", fontsize=14)
    figure.supxlabel(caption, fontsize=8, color="0.4", x=0.01, ha="left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)


def _colours(labels: Sequence[str]) -> dict[str, str]:
    """One colour per name."""
    from hjbjax.plotting.style import COLOURS

    return {label: COLOURS[k % len(COLOURS)] for k, label in enumerate(dict.fromkeys(labels))}


def _chart(ax: Any, chart: Chart, colours: dict[str, str], *, at_end: bool) -> None:
    """Draw one chart: laws in grey, lines with markers, and their names at their ends."""
    from hjbjax.plotting.style import logarithmic, styled

    styled(ax)
    for line in chart.lines:
        ax.plot(line.x, line.y, marker="o", markersize=5, linewidth=1.6, color=colours[line.label], label=line.label)
    logarithmic(ax)
    for axis in (ax.xaxis, ax.yaxis):
        ticks = axis.get_ticklocs()
        axis.set_ticks(ticks, labels=[f"{tick:,.0f}" if tick >= 1000 else f"{tick:g}" for tick in ticks])
    limits = ax.get_xlim(), ax.get_ylim()
    longest = max(chart.lines, key=lambda line: line.x[-1] / line.x[0])
    for text, slope in chart.laws:
        x = np.geomspace(*limits[0], 401)
        y = longest.y[-1] * (x / longest.x[-1]) ** slope
        shown = (y > limits[1][0]) & (y < limits[1][1])
        x, y = x[shown], y[shown]
        ax.plot(x, y, color="0.75", linewidth=4, zorder=0)
        side: dict[str, Any] = {"ha": "left", "xytext": (10, -4)} if slope > 0 else {"ha": "right", "xytext": (-10, 0)}
        ax.annotate(
            text, (x[len(x) // 4], y[len(x) // 4]), textcoords="offset points", color="0.5", fontsize=10, **side
        )
    ax.set(xlim=limits[0], ylim=limits[1], xlabel=chart.x, ylabel=chart.y)
    ax.set_title(chart.title, fontsize=11, loc="left")
    if at_end:
        _names(ax, chart.lines, colours)


def _names(ax: Any, lines: Sequence[Line], colours: dict[str, str]) -> None:
    """Write the name of every line next to the axes at the height of its last point, without overlaps."""
    to_axes = ax.transAxes.inverted().transform
    ends = [to_axes(ax.transData.transform((line.x[-1], line.y[-1]))) for line in lines]
    order = np.argsort([end[1] for end in ends])
    heights, least = {}, -math.inf
    for k in order:
        heights[k] = least = max(float(ends[k][1]), least + APART)
    over = max(heights.values()) - 1.0
    for k, line in enumerate(lines):
        place = (1.03, heights[k] - max(over, 0.0))
        ax.annotate(
            line.label, xy=(line.x[-1], line.y[-1]), xytext=place, textcoords="axes fraction", va="center", fontsize=10,
            color=colours[line.label], annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colours[line.label], "linewidth": 0.5, "alpha": 0.6},
        )  # fmt: skip


def _positive(value: Any) -> bool:
    """True for a positive finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < math.inf


@click.command()
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Folder of the rows.")
def command(out: Path) -> None:
    """Draw the pictures of all recorded benchmarks again."""
    for path in sorted(out.glob("*.json")):
        for made in draw(out, path.stem, json.loads(path.read_text(encoding="utf-8"))):
            click.echo(made)
