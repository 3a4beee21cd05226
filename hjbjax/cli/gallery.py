"""The gallery, a page of all ready problems: pictures, numbers, and the error if the exact answer is known.

Each problem is solved on a grid for pictures and becomes a ``Card``. ``page`` builds one self-contained HTML file of
the cards, with embedded pictures.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import math
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from hjbjax import plotting
from hjbjax._version import __version__
from hjbjax.cli import run_folder
from hjbjax.cli.command_line import text_of
from hjbjax.feedback.path import Path as Trajectory
from hjbjax.problem.labels import COST
from hjbjax.problem.settings import own_settings
from hjbjax.solution import placement
from hjbjax.solution.solution import Solution, SolveError, Status
from hjbjax.solution.status import SolveWarning

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hjbjax.problem.problem import Problem
    from hjbjax.zoo.entry import Entry

PAGE = "index.html"
SYMBOLS = "In the pictures T is the time until the target is reached, β the discount rate and E[·] the expectation."
# number of nodes by number of states: cells of two to four pixels over two axes, in seconds once compiled
NODES = {2: 40_000, 3: 400_000}
MOST = 20_000  # for other numbers of states
TOL = 1e-6  # cost units, over two states or more; by default a switching curve wanders where V is nearly constant
DPI = 100  # as in the other pages; labels of 9 points are legible


@dataclasses.dataclass(frozen=True)
class Card:
    """One problem of the gallery.

    Args:
      name: as in the catalogue.
      summary: one line.
      status: the name of a ``Status``, or of the error that ended the solve.
      facts: pairs of label and text.
      pictures: pairs of caption and WebP file.
    """

    name: str
    summary: str
    status: str
    facts: tuple[tuple[str, str], ...]
    pictures: tuple[tuple[str, bytes], ...]


def check_page_folder(out: Path, force: bool = False) -> None:
    """Raise if a folder is not empty; with ``force`` its page may be replaced.

    Raises:
      OSError: with advice in one line.
    """
    placement.current_folder()  # otherwise JAX raises FileNotFoundError when it filters a traceback
    if os.path.lexists(out) and not os.path.isdir(out):
        raise NotADirectoryError(f"{out} exists but is not a folder; give another name")
    placement.check_place(out / PAGE, force=True)  # refuse a folder named index.html even with force
    # ignore hidden folders of this command
    found = sorted(name for name in os.listdir(out) if not placement.OWN.fullmatch(name)) if os.path.isdir(out) else []
    if not force and PAGE in found:
        raise FileExistsError(f"{out} contains {PAGE} already; give another --out, or --force to replace it")
    if not force and found:
        shown = ", ".join(map(text_of, found[:3])) + (", ..." if len(found) > 3 else "")
        raise FileExistsError(f"{out} is not empty: {shown}; give another --out, or --force to add {PAGE} to them")


def drawn_shape(shape: Sequence[int]) -> tuple[int, ...]:
    """The shape of a grid with the proportions of ``shape`` that is fine enough for pictures and solved in seconds.

    Over two and three axes it has about ``NODES`` nodes, otherwise at most ``MOST``. The parity of each count is kept:
    an odd count has a node at zero, and an even periodic axis has antipodal nodes.

    Example:
      >>> drawn_shape((121, 121)), drawn_shape((41, 40, 40)), drawn_shape((81,))
      ((201, 201), (75, 74, 74), (81,))
    """
    nodes = NODES.get(len(shape)) or min(MOST, math.prod(shape))
    share = (nodes / math.prod(shape)) ** (1 / len(shape))
    return tuple(count - 2 * round(count * (1 - share) / 2) for count in shape)


def card(entry: Entry, *, options: dict[str, Any] | None = None) -> Card:
    """Solve one problem on a grid for pictures and plot it; an error gives a card as well.

    Args:
      entry: an entry of the catalogue.

    Keyword Args:
      options: more keywords of ``hjbjax.solve``.

    Raises:
      KeyboardInterrupt: the solve was interrupted.
    """
    import hjbjax as hjb

    _, grid = entry.build()
    problem, grid = entry.build(shape=drawn_shape(grid.shape))
    try:
        # put warnings on the card instead of the terminal, which shows one line per problem
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always", SolveWarning)
            chosen: dict[str, Any] = {"tol": TOL} if grid.ndim > 1 else {}
            if entry.kinked:
                chosen["scheme"] = hjb.SemiLagrangian()
            solution = hjb.solve(problem, grid, throw=False, **(chosen | (options or {})))
    except (SolveError, ValueError, jax.errors.JaxRuntimeError) as error:
        return Card(entry.name, entry.summary, type(error).__name__, (("refused", " ".join(str(error).split())),), ())
    if solution.status == Status.INTERRUPTED:
        raise KeyboardInterrupt
    pictures, path = _figures(problem, solution, entry)
    facts = [*_facts(solution), *_exact(entry, solution)]
    if constants := _constants(solution, dict(enumerate(entry.initial_state(len(solution.grid.state_axes))[2:], 2))):
        facts.append(("constant feedback", ", ".join(constants)))
    if path is not None:
        promised = "" if path.promised is None else f"; V at its start {float(path.promised):.4g}"
        paid = path.cost if path.payoff == COST else path.reward
        facts.append((f"{path.payoff} of the path", f"{float(paid):.4g}{promised}"))
    facts += [("warning", str(each.message)) for each in heard]
    drawn = tuple((caption, webp(figure)) for caption, figure in pictures)
    return Card(entry.name, entry.summary, solution.status.name, tuple(facts), drawn)


def _figures(problem: Problem, solution: Solution, entry: Entry) -> tuple[list[tuple[str, Figure]], Trajectory | None]:
    """Captions and figures, and the path: value and closed loop in one figure if there is a path, then the feedback."""
    states = len(solution.grid.state_axes)
    start = entry.initial_state(states)
    fixed = dict(enumerate(start[2:], 2))  # cut all axes from the third on at the start of the path
    jumps = run_folder.is_bang_bang(problem, solution)
    finish = None if entry.finish is None else entry.finish()
    path = None
    if solution.status == Status.CONVERGED:
        path = run_folder.closed_path(problem, solution, start, entry.duration, jumps, finish, entry.mode)
    drawn: list[tuple[str, Figure]] = []
    if path is None or states == 1 or solution.grid.modes:  # otherwise the figure of the loop shows the value
        drawn.append(("the value", run_folder.plot_values(problem, solution, fixed, jumps)))
    if path is not None:
        figure = run_folder.figure_of(plotting.maps.closed_loop_size(solution, path))
        target = run_folder.target_in(problem, entry.mode)
        plotting.closed_loop(solution, path, fixed=fixed, target=target, figure=figure)
        drawn.append(("the closed loop" if states == 1 else "the value, and the closed loop on it", figure))
    if len(_constants(solution, fixed)) < solution.policy.shape[-1]:
        drawn.append(("the feedback", run_folder.plot_policies(problem, solution, fixed, jumps)))
    return drawn, path


def _constants(solution: Solution, fixed: dict[int, float]) -> list[str]:
    """The inputs of the feedback that do not vary in the pictures, with their numbers."""
    count = solution.policy.shape[-1]
    found = {i: run_folder.constant_input(solution, i, fixed) for i in range(count)}
    return [f"{solution.labels.control(i, count)} = {number:.4g}" for i, number in found.items() if number is not None]


def webp(figure: Figure) -> bytes:
    """A figure as a WebP file.

    It is lossless, because lossy compression draws stripes and blocks on smooth shades.
    """
    stream = io.BytesIO()
    figure.savefig(stream, format="webp", dpi=DPI, pil_kwargs={"lossless": True, "quality": 100, "method": 6})
    return stream.getvalue()


def _facts(solution: Solution) -> list[tuple[str, str]]:
    """Facts about the solve: nodes, steps, errors, seconds."""
    stats = solution.stats
    facts = [
        ("grid", " x ".join(map(str, solution.grid.shape)) + f" = {solution.grid.size:,} nodes"),
        ("method", f"{stats.get('method')}, {stats.get('scheme')}"),
        ("steps", f"{int(solution.steps)}"),
    ]
    if solution.error is not None:
        facts.append(("algebraic error, certified", f"at most {float(solution.error):.2g}"))
    elif solution.monotone_error is not None:
        facts.append(("algebraic error of the monotone start, certified", f"at most {solution.monotone_error:.2g}"))
    if solution.grid_error is not None and np.any(np.isfinite(solution.grid_error)):
        facts.append(("grid error, estimated", f"about {float(np.nanmax(solution.grid_error)):.2g}"))
    facts.append(("seconds", f"{stats['seconds']:.2g}, and {stats['compile_seconds']:.2g} to check and compile"))
    return facts


def _exact(entry: Entry, solution: Solution) -> list[tuple[str, str]]:
    """The exact value at the start of the path, and the largest difference, if the exact value is known."""
    if entry.exact is None:
        return [("exact answer", "not known")]
    exact = entry.exact()
    off = run_folder.difference(exact, solution)
    start = entry.initial_state(solution.grid.ndim)
    with own_settings(x64=True):
        there = float(exact(np.array(start)))
    state = ", ".join(f"{entry:g}" for entry in start)
    return [
        (f"V({state})", f"{float(solution.value_at(np.array(start))):.5g}; exactly {there:.5g}"),
        ("off the exact answer on the inner half", "nothing finite there" if off is None else f"at most {off:.2g}"),
    ]


# ------------------------------------------------------------------------------------------------- the page

STYLE = """
body { font: 16px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 0 auto; max-width: 76rem;
       padding: 1rem 1.5rem }
nav a { display: inline-block; margin: 0 .9rem .3rem 0 }
section { border-top: 1px solid #ccc; padding: .4rem 0 1.2rem }
h2 { margin: .6rem 0 .1rem; font-size: 1.25rem }
p { margin: .2rem 0 .6rem }
.pictures { display: flex; flex-wrap: wrap; gap: 1rem; align-items: flex-start }
figure { margin: 0 } figcaption { color: #555; font-size: .85rem } img { max-width: 100%; height: auto }
table { border-collapse: collapse; font-size: .9rem } td { padding: .1rem 1.2rem .1rem 0; vertical-align: top }
.bad { color: #a40000; font-weight: 600 }
"""


def page(cards: Sequence[Card]) -> str:
    """One self-contained HTML page of the cards."""
    links = "".join(f'<a href="#{card.name}">{html.escape(card.name)}</a>' for card in cards)
    good = sum(card.status == Status.CONVERGED.name for card in cards)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>hjbjax gallery</title>'
        # an empty icon, otherwise a browser requests /favicon.ico
        '<link rel="icon" href="data:,"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE}</style></head>\n<body><h1>The ready problems of hjbjax</h1>\n"
        f"<p>{good} of {len(cards)} converged, by hjbjax {__version__} on {html.escape(_device())}, on grids for "
        "pictures. <code>hjbjax solve NAME</code> takes the grid of the problem.</p>\n"
        f"<p>{SYMBOLS}</p>\n<nav>{links}</nav>\n{''.join(map(_section, cards))}</body></html>\n"
    )


def _section(card: Card) -> str:
    """The HTML of one card."""
    rows = "".join(
        f"<tr><td>{html.escape(word)}</td><td>{html.escape(figure)}</td></tr>" for word, figure in card.facts
    )
    pictures = "".join(
        f'<figure><img loading="lazy" alt="{html.escape(f"{card.name}: {caption}")}" '
        f'src="data:image/webp;base64,{base64.b64encode(data).decode()}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, data in card.pictures
    )
    tone = "" if card.status == Status.CONVERGED.name else ' class="bad"'
    return (
        f'<section id="{card.name}"><h2>{html.escape(card.name)}</h2>\n<p>{html.escape(card.summary)}; '
        f'<span{tone}>{card.status}</span></p>\n<div class="pictures">{pictures}</div>\n'
        f"<table>{rows}</table></section>\n"
    )


def _device() -> str:
    """The name of the device that JAX uses."""
    device = jax.devices()[0]
    return device.platform if device.platform == "cpu" else device.device_kind


def publish_page(cards: Sequence[Card], staging: Path, out: Path, force: bool = False) -> Path:
    """Write the page of the cards to ``out`` atomically: write to ``staging`` on the same file system, then move.

    Raises:
      OSError: ``out`` cannot be written, or is no longer empty.
    """
    made = write_page(cards, staging)
    out.mkdir(parents=True, exist_ok=True)
    check_page_folder(out, force)  # check again, because the solves may have taken long
    placement.place(made, out / PAGE, force)
    return out / PAGE


def write_page(cards: Sequence[Card], folder: Path) -> Path:
    """Write the page of the cards into a folder and return the file."""
    made = folder / PAGE
    made.write_text(page(cards), encoding="utf-8")
    return made
