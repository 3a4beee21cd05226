"""``hjbjax gallery``: refusals before anything is solved, a whole page after an interrupt, and what a card says."""

import base64
import io
import os
import re
import types

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import hjbjax
from docs.pictures import write_pictures
from hjbjax import zoo
from hjbjax.cli import gallery, run_folder
from hjbjax.cli.gallery import Card, card, drawn_shape, page
from hjbjax.cli.main import main
from hjbjax.solution.solution import Solution, Status

PICTURE = b"RIFF....WEBP"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Every test writes into a folder of its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def made(name, status="CONVERGED"):
    """A card that was not computed."""
    return Card(
        name, "a <summary> & more", status, (("steps", "7"), ("off", "at most 1e-3")), (("the value", PICTURE),)
    )


@pytest.fixture
def cards(monkeypatch):
    """Cards that were not computed; a name in ``ends`` gets that status, or raises."""
    ends = {}

    def stand_in(entry):
        end = ends.get(entry.name, "CONVERGED")
        if isinstance(end, BaseException):
            raise end
        return made(entry.name, end)

    monkeypatch.setattr(gallery, "card", stand_in)
    return ends


def run(*words):
    return CliRunner().invoke(main, ["gallery", "--no-cache", *map(str, words)])


def test_all_of_the_catalogue_is_on_one_page_that_needs_no_other_file(cards, folder):
    result = run("--out", "page")
    assert result.exit_code == 0, result.output
    assert os.listdir("page") == ["index.html"]
    text = (folder / "page" / "index.html").read_text(encoding="utf-8")
    assert re.findall(r'<section id="([\w-]+)"', text) == list(zoo.catalogue)
    sources = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert all(source.startswith(("data:", "#")) for source in sources)
    assert base64.b64encode(PICTURE).decode() in text
    assert "a &lt;summary&gt; &amp; more" in text
    assert f"{len(zoo.catalogue)} of {len(zoo.catalogue)} converged" in text
    for number, name in enumerate(zoo.catalogue, 1):
        assert re.search(rf"^ *{number}/{len(zoo.catalogue)}  {name} +CONVERGED$", result.stdout, re.MULTILINE)


@pytest.mark.parametrize(
    ("held", "words", "parts"),
    [
        ("index.html", (), ("contains index.html already", "--force")),
        ("thesis.tex", (), ("not empty", "thesis.tex", "--force")),
        ("index.html/", ("--force",), ("is a folder",)),
    ],
)
def test_a_folder_that_holds_something_is_refused_before_anything_is_solved(held, words, parts, cards, folder):
    cards |= dict.fromkeys(zoo.catalogue, AssertionError("solved"))
    (folder / "page").mkdir()
    if held.endswith("/"):
        (folder / "page" / held).mkdir()
    else:
        (folder / "page" / held).write_text("mine")
    result = run("--out", "page", *words)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    for part in parts:
        assert part in result.stderr
    assert os.listdir(folder) == ["page"]


def test_force_replaces_the_page_and_leaves_what_is_beside_it(cards, folder):
    (folder / "page").mkdir()
    for name in ("index.html", "thesis.tex"):
        (folder / "page" / name).write_text("mine")
    assert run("--out", "page", "--force", "--only", "smooth").exit_code == 0
    assert (folder / "page" / "thesis.tex").read_text() == "mine"
    assert "smooth" in (folder / "page" / "index.html").read_text()


def test_a_path_that_is_no_folder_and_an_unknown_problem_are_refused(cards, folder):
    (folder / "page").write_text("mine")
    assert "is not a folder" in run("--out", "page").stderr
    result = run("--out", "other", "--only", "pendulm")
    assert (result.exit_code, "did you mean 'pendulum'?" in result.stderr) == (2, True)
    assert os.listdir(folder) == ["page"]


def test_one_that_does_not_converge_is_on_the_page_and_in_the_exit_code(cards, folder):
    cards["zermelo"] = "DIVERGED"
    result = run("--out", "page", "--only", "zermelo", "--only", "smooth")
    assert (result.exit_code, result.stderr) == (3, "hjbjax: not converged: zermelo\n")
    text = (folder / "page" / "index.html").read_text()
    assert "1 of 2 converged" in text
    assert '<span class="bad">DIVERGED</span>' in text


def test_an_interrupt_leaves_a_whole_page_of_what_was_done(cards, folder):
    cards["zermelo"] = KeyboardInterrupt()
    assert run("--out", "page").exit_code == 130
    names = list(zoo.catalogue)
    text = (folder / "page" / "index.html").read_text()
    assert re.findall(r'<section id="([\w-]+)"', text) == names[: names.index("zermelo")]
    assert os.listdir(folder) == ["page"]  # the hidden folder is gone


def test_shapes_for_pictures_keep_proportions_and_parity():
    for entry in zoo.catalogue.values():
        _, grid = entry.build()
        shape = drawn_shape(grid.shape)
        assert np.prod(shape) <= 1.1 * gallery.NODES.get(len(shape), gallery.MOST)
        assert all((drawn - count) % 2 == 0 for drawn, count in zip(shape, grid.shape, strict=True))
        shares = np.divide(shape, grid.shape)
        assert np.ptp(shares) * min(grid.shape) <= 2  # a node more or less, for the parity
        assert entry.build(shape=shape)[1].shape == shape
        if len(shape) == 2:
            assert np.prod(shape) >= 0.9 * gallery.NODES[2]  # cells of a few pixels


def test_a_picture_is_compressed_without_loss():
    """A smooth shade has the colours that matplotlib draws; lossy compression leaves stripes."""
    figure = Figure(figsize=(2.0, 1.5), dpi=gallery.DPI)
    figure.add_subplot().pcolormesh(np.linspace(0, 1, 40)[:, None] * np.ones(30), shading="gouraud", cmap="cividis")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    shown = np.asarray(Image.open(io.BytesIO(gallery.webp(figure))).convert("RGB"))
    np.testing.assert_array_equal(shown, np.asarray(canvas.buffer_rgba())[..., :3])


def test_a_constant_feedback_is_a_number_and_not_a_picture(monkeypatch):
    grid = hjbjax.Grid([0.0], [1.0], (101,))
    x = grid.nodes()
    wiggle = 0.5 + 1e-4 * np.sin(7 * x)
    solution = Solution(grid, x[:, 0], np.concatenate([wiggle, x], axis=-1))
    assert run_folder.constant_input(solution, 0, {}) == pytest.approx(0.5, abs=1e-4)
    assert run_folder.constant_input(solution, 1, {}) is None
    figure = run_folder.plot_policies(hjbjax.Problem(lambda x, u: u, lambda x, u: 1.0), solution, {}, False)
    assert [ax.get_ylabel() for ax in figure.axes] == ["u2"]
    level = Solution(grid, x[:, 0], wiggle)
    figure = run_folder.plot_policies(hjbjax.Problem(lambda x, u: u, lambda x, u: 1.0), level, {}, False)
    assert [ax.get_ylabel() for ax in figure.axes] == ["u"]  # `hjbjax solve` always draws a feedback


def test_new_pictures_replace_all_old_ones(tmp_path):
    for number in (1, 2):
        (tmp_path / f"smooth-{number}.webp").write_bytes(b"old")
    (tmp_path / "smooth-game-1.webp").write_bytes(b"other")
    write_pictures(made("smooth"), tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["smooth-1.webp", "smooth-game-1.webp"]
    assert (tmp_path / "smooth-1.webp").read_bytes() == PICTURE


def solved(value, code=Status.CONVERGED):
    """In place of ``hjbjax.solve``: a value that is a function of the states, and no control."""

    def stand_in(problem, grid, **options):
        x = grid.nodes()
        stats = {"method": "none", "scheme": "none", "seconds": 0.0, "compile_seconds": 0.0}
        return Solution(grid, value(x), np.zeros((*grid.shape, 0)), code=code, steps=3, stats=stats)

    return stand_in


@pytest.mark.slow
def test_a_card_says_how_far_the_value_is_from_the_exact_one(monkeypatch):
    monkeypatch.setattr(hjbjax, "solve", solved(lambda x: 1.01 * (1 - x[..., 0] ** 2)))
    found = card(zoo.catalogue["brownian-exit"])
    facts = dict(found.facts)
    assert facts["V(0)"] == "1.01; exactly 1"
    assert facts["off the exact answer on the inner half"] == "at most 0.01"
    assert [caption for caption, _ in found.pictures] == ["the value", "the closed loop"]
    assert all(data[:4] == b"RIFF" and data[8:12] == b"WEBP" for _, data in found.pictures)
    assert "the closed loop" in page([found])


def test_a_refusal_is_a_card_and_an_interrupt_none(monkeypatch):
    def refuse(problem, grid, **options):
        raise ValueError("got this,\nwanted that")

    monkeypatch.setattr(hjbjax, "solve", refuse)
    found = card(zoo.catalogue["smooth"])
    assert (found.status, found.facts, found.pictures) == ("ValueError", (("refused", "got this, wanted that"),), ())
    monkeypatch.setattr(hjbjax, "solve", solved(lambda x: x[..., 0], Status.INTERRUPTED))
    with pytest.raises(KeyboardInterrupt):
        card(zoo.catalogue["smooth"])


def test_a_card_is_solved_to_the_tolerance_of_pictures_unless_the_caller_gives_one(monkeypatch):
    asked = []

    def refuse(problem, grid, **options):
        asked.append(options.get("tol"))
        raise ValueError("not now")

    monkeypatch.setattr(hjbjax, "solve", refuse)
    for name in ("pursuit", "double-integrator", "bang-bang"):
        card(zoo.catalogue[name])
    card(zoo.catalogue["smooth"], options={"tol": 0.1})
    assert asked == [gallery.TOL, gallery.TOL, None, 0.1]  # over one state there is no curve


def test_a_control_that_jumps_is_held_while_the_path_crosses_a_cell():
    grid = hjbjax.Grid([0.0, 0.0], [1.0, 8.0], (11, 9))
    times = np.linspace(0.0, 10.0, 101)
    path = types.SimpleNamespace(times=times, states=np.stack([0.02 * times, 2.5 * times], axis=-1))
    assert run_folder.crossing_time(path, grid, 20.0) == pytest.approx(0.4)  # a unit at the speed 2.5
    assert run_folder.crossing_time(path, grid, 2.0) == 2.0 / run_folder.FEWEST
    still = types.SimpleNamespace(times=times, states=np.zeros((101, 2)))
    assert run_folder.crossing_time(still, grid, 10.0) == 10.0 / run_folder.SAMPLES


@pytest.mark.slow
def test_a_point_held_at_a_switching_point_does_not_chatter():
    """Exactly: full speed for a time of 1.5 from 1.5, then no control."""
    entry = zoo.catalogue["bang-bang"]
    problem, grid = entry.build()
    solution = hjbjax.solve(problem, grid)
    path = run_folder.closed_path(problem, solution, entry.start, entry.duration, True, None)
    controls = path.controls[:, 0]
    assert controls[path.times[:-1] < 1.4] == pytest.approx(-1.0)
    assert np.abs(controls[path.times[:-1] > 2.0]).max() < 1e-3
    assert float(path.cost) == pytest.approx(float(path.promised), rel=0.02)


@pytest.mark.slow
def test_the_double_integrator_switches_once():
    """Exactly: full force, then full force the other way; V = 1 − exp(−2) for a time of 2 from rest at 1."""
    entry = zoo.catalogue["double-integrator"]
    problem, grid = entry.build(shape=(101, 101))
    solution = hjbjax.solve(problem, grid, scheme=hjbjax.SemiLagrangian())
    path = run_folder.closed_path(problem, solution, entry.start, entry.duration, True, None)
    assert np.count_nonzero(np.diff(path.controls[:, 0])) == 1
    assert float(path.cost) == pytest.approx(1 - np.exp(-2.0), abs=1e-3)


def test_a_name_that_is_too_long_is_refused_in_words():
    """pathlib raises the bare error of the system."""
    name = "a" * 300
    found = CliRunner().invoke(main, ["gallery", "--out", name])
    assert found.exit_code == 2
    assert f"--out: {name} cannot be written: File name too long; give another folder" in found.output
    found = CliRunner().invoke(main, ["solve", "bang-bang", "--out", "free", "--checkpoint", name])
    assert found.exit_code == 5
    assert "cannot be written: File name too long" in found.output
    assert "Errno" not in found.output
