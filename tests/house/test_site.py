"""The site: every public name is there, it builds without a warning, and no link or picture in it leads nowhere."""

import html.parser
import re
import shutil
import subprocess
import sys
import urllib.parse
from pathlib import Path

import jupytext
import numpy as np
import pytest
from click.testing import CliRunner
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from matplotlib import colormaps
from PIL import Image

import hjbjax as hjb
from docs import mathml, notebooks
from docs.docstrings import prepared
from docs.pictures import shrink
from hjbjax import zoo
from hjbjax.cli.main import main

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
LIMIT = 300_000  # bytes of the first page with all that it needs; further pictures are loaded when they come in sight
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def names_of(module):
    """The public names of a module, under the name where their module is."""
    return [f"{module.__name__}.{name}" for name in module.__all__ if not name.startswith("__")]


MODULES = (hjb.zoo, hjb.filtering, hjb.neural, hjb.plotting, hjb.geometry, hjb.chain, hjb.stability, hjb.convex)
PUBLIC = [
    f"hjbjax.{name}" for name in hjb.__all__ if not name.startswith("__") and getattr(hjb, name) not in MODULES
] + [name for module in MODULES for name in names_of(module)]


def test_every_public_name_has_an_entry():
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (DOCS / "api").glob("*.md"))
    entries = re.findall(r"^\.\. (?:auto\w+|py:\w+):: ([\w.]+)", pages, re.MULTILINE)
    assert len(PUBLIC) > 150
    assert not set(PUBLIC) - set(entries)
    assert len(entries) == len(set(entries))


@pytest.mark.parametrize("page", ["getting_started", "troubleshooting"])
def test_code_on_the_first_pages_fits_the_column(page):
    """At a width of 1280 pixels the column has room for 90 characters."""
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```\w+\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    lines = "".join(blocks).splitlines()
    assert len(lines) > 30
    assert [line for line in lines if len(line) > 90] == []


def test_docstrings_keep_their_bars_and_stars_and_equations():
    lines = ["The bound |V − V_h|.", "", "    V* = min", "", "Args:", "  x_: the ``|x|`` of it.", "", ">>> 2 * 3", "6"]
    wanted = [
        r"The bound \|V − V_h\|.", "", "::", "", "    V* = min", "", "Args:", r"  x\_: the ``|x|`` of it.",
        "", ">>> 2 * 3", "6",
    ]  # fmt: skip
    assert prepared(lines) == wanted


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.py")), ids=lambda path: path.stem)
def test_the_page_of_a_notebook_has_its_cells(path):
    cells = [cell.source for cell in jupytext.read(path).cells if cell.cell_type == "code"]
    assert notebooks.cells((DOCS / "notebooks" / f"{path.stem}.md").read_text(encoding="utf-8")) == cells


@pytest.mark.parametrize(
    ("tex", "top", "bottom"),
    [(r"\tfrac12 \mathrm{tr}(x)", "1", "2"), (r"\tfrac32P", "3", "2"), (r"\tfrac12\tau^2", "1", "2")],
)
def test_a_fraction_of_two_digits_is_one(tex, top, bottom):
    """TeX takes one digit for each; docutils takes both for the numerator, and what follows for the denominator."""
    shown = re.sub(r"\s", "", tex2mathml(mathml.plain(tex)))
    assert f"<mn>{top}</mn><mn>{bottom}</mn></mfrac>" in shown


def test_a_subscript_stands_next_to_an_accented_letter():
    """docutils puts it below, in one element with the accent above."""
    shown = re.sub(r"\s", "", mathml.converted(r"\dot x_1 = \sum_i^n x"))
    assert '<msub><moveraccent="true"><mi>x</mi><mostretchy="false">˙</mo></mover><mn>1</mn></msub>' in shown
    assert "<munderover>" in shown  # the limits of a sum stay where they are


def equations(page):
    """The equations of a page in Markdown, without those in code."""
    text = re.sub(r"^(```+|~~~+).*?^\1|`[^`\n]+`", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    around, blocks = text.split("$$")[::2], text.split("$$")[1::2]
    return blocks + [piece for prose in around for piece in prose.split("$")[1::2]]


def test_every_equation_of_the_pages_can_be_drawn():
    """docutils knows a part of LaTeX, and a command outside it ends the build."""
    pages = sorted(DOCS.rglob("*.md"))
    found = [(page.name, tex) for page in pages for tex in equations(page)]
    assert len(found) > 200
    unknown = []
    for page, tex in found:
        try:
            mathml.converted(tex)
        except MathError as error:
            unknown.append((page, tex, str(error)))
    assert not unknown


def test_no_page_of_a_notebook_shows_the_text_of_an_object():
    for page in (DOCS / "notebooks").glob("*.md"):
        assert not re.search(r"<IPython|object at 0x", page.read_text(encoding="utf-8")), page.name


def test_a_picture_made_small_keeps_its_paper_white_and_its_scale_even(tmp_path):
    image = np.full((200, 400, 3), 255, np.uint8)
    red, green = np.meshgrid(np.linspace(120, 255, 160), np.linspace(0, 120, 280), indexing="ij")
    image[20:180, 20:300] = np.stack([red, green, np.full_like(red, 40)], axis=-1)  # thousands of colours on half of it
    shades = (colormaps["viridis"](np.linspace(0, 1, 160))[:, :3] * 255).astype(np.uint8)
    image[20:180, 340:350] = shades[:, None]  # the scale: one pixel in fifty
    picture = tmp_path / "picture.png"
    Image.fromarray(image).save(picture)
    shrink(picture)
    small = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    assert small.shape == (100, 200, 3)
    assert small[0, 0].tolist() == [255, 255, 255]
    scale = small[12:88, 172]
    assert np.abs(scale - shades[5:157:2]).max() < 16  # by Pillow's own palette 31, in 9 steps
    assert len(np.unique(scale, axis=0)) > 30


def test_the_gallery_has_all_ready_problems():
    page = (DOCS / "gallery.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (.*)$", page, re.MULTILINE) == list(zoo.catalogue)


class Page(html.parser.HTMLParser):
    """The links, the anchors and the files of a page."""

    def __init__(self, path):
        super().__init__()
        self.links, self.anchors, self.files, self.lazy = [], set(), [], []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        if "id" in found:
            self.anchors.add(found["id"])
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        if tag in ("img", "script", "source") and "src" in found:
            (self.lazy if found.get("loading") == "lazy" else self.files).append(found["src"])
        if tag == "link" and found.get("rel") in ("stylesheet", "icon"):
            self.files.append(found["href"])


def place_of(page, link):
    """The file and the anchor that a link of a page leads to; no file for one that leaves the site."""
    parts = urllib.parse.urlsplit(link)
    if parts.scheme or parts.netloc:
        return None, ""
    path = urllib.parse.unquote(parts.path)
    return (page.parent / path).resolve() if path else page, urllib.parse.unquote(parts.fragment)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built as by ``python -m docs``, where a warning is an error."""
    pytest.importorskip("sphinx")
    pytest.importorskip("furo")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "docs", "build", str(out)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return out


@pytest.mark.slow
def test_no_link_and_no_picture_leads_nowhere(site):
    pages = {path.resolve(): Page(path) for path in site.rglob("*.html")}
    assert len(pages) > 25
    missing = []
    for path, page in pages.items():
        for link in page.links + page.files + page.lazy:
            place, anchor = place_of(path, link)
            there = place is None or place.exists()
            if not there or (anchor and place in pages and anchor not in pages[place].anchors):
                missing.append((path.name, link))
    assert not missing


@pytest.mark.slow
def test_the_first_page_is_light(site):
    first = site / "index.html"
    files = {place_of(first, link)[0] for link in Page(first).files} - {None}
    assert sum(path.stat().st_size for path in [first, *files]) < LIMIT


def complaints(address, folder):
    """The errors that a browser writes to its console on a page, and the page as it stands after its scripts."""
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0", "--dump-dom",
        "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={folder}", "--virtual-time-budget=5000", address,
    ]  # fmt: skip
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert shown.returncode == 0, shown.stderr
    return [line for line in shown.stderr.splitlines() if ":CONSOLE" in line], shown.stdout


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no browser")
@pytest.mark.parametrize("page", ["index.html", "getting_started.html", "api/solving.html", "gallery.html"])
def test_a_browser_has_nothing_to_complain_of(site, page, tmp_path):
    said, shown = complaints((site / page).as_uri(), tmp_path)
    assert not said
    assert "</article>" in shown
    if page == "getting_started.html":
        assert shown.count("copybtn") >= 5  # one button per block, made by its script


@pytest.fixture(scope="module")
def gallery(tmp_path_factory):
    """The page of the gallery, of two problems: a game over one axis, and a stochastic one without a control."""
    out = tmp_path_factory.mktemp("gallery") / "page"
    words = ["gallery", "--out", str(out), "--only", "lq-game", "--only", "brownian-exit", "--no-cache"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    return out / "index.html"


@pytest.mark.slow
def test_the_gallery_needs_no_other_file(gallery):
    page = Page(gallery)
    assert page.anchors == {"lq-game", "brownian-exit"}
    assert page.links == ["#lq-game", "#brownian-exit"]
    sources = page.lazy + page.files
    assert len(sources) >= 5
    assert all(source.startswith("data:") for source in sources)
    text = gallery.read_text(encoding="utf-8")
    assert "2 of 2 converged" in text
    assert text.count("off the exact answer") == 2


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no browser")
def test_a_browser_shows_the_gallery(gallery, tmp_path):
    said, shown = complaints(gallery.as_uri(), tmp_path)
    assert not said
    assert shown.count("<figure>") >= 5
