"""The README and the pages of docs/ tell the truth: their commands, examples with their output, files and figures."""

import contextlib
import io
import json
import pkgutil
import re
from pathlib import Path

import pytest
from matplotlib import pyplot

from benchmarks.accuracy import estimates
from benchmarks.harness import quoted

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = {path.stem: path.read_text(encoding="utf-8") for path in [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]}
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMANDS = ["pip install . && hjbjax solve pendulum", "pip install '.[test]' && pytest"]
DRAWN = re.compile(r'\.save\("(\w+\.png)"')


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_stand_in_the_first_screen(command):
    assert command in README.splitlines()[:30]


def test_it_is_short():
    assert len(README.splitlines()) <= 150


def test_ci_runs_the_test_command_as_it_stands_here():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert f'tests="{COMMANDS[1]}"' in script.splitlines()


@pytest.mark.parametrize("page", PAGES)
def test_every_public_name_on_a_page_exists(page):
    for name in set(re.findall(r"\bhjb(?:jax)?((?:\.[a-zA-Z]\w*)+)", PAGES[page])):
        assert pkgutil.resolve_name(f"hjbjax{name}") is not None


def settled(text):
    """A printed screen without numbers that differ between machines: clocks, memory, steps to a tolerance, rounding."""
    text = re.sub(r"^( *(?:seconds|memory|device) ).*$", r"\1", text, flags=re.MULTILINE)
    text = re.sub(r"^( *steps +)\d+(?=, last residual)", r"\1", text, flags=re.MULTILINE)
    return re.sub(r"\d(\.\d+)?e-(0[7-9]|[1-9]\d)", "tiny", text)


def blocks(page):
    """The blocks of a page with the one that follows each, as (kind, text, kind after, text after)."""
    found = BLOCK.findall(PAGES[page])
    return [(*this, *after) for this, after in zip(found, [*found, ("", "")][1:], strict=True)]


WITH_CODE = [page for page in PAGES if any(kind == "python" for kind, *_ in blocks(page))]


# one namespace a page: a reader who starts there has nothing from another one
@pytest.mark.parametrize(
    "page", ["README", *(pytest.param(page, marks=pytest.mark.slow) for page in WITH_CODE if page != "README")]
)
def test_every_python_block_runs_and_prints_what_the_text_block_after_it_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pyplot.close("all")  # or this page would draw on the axes of the one before
    names = {}
    for kind, code, after, wanted in blocks(page):
        if kind != "python":
            continue
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(compile(code, f"{page}.md", "exec"), names)
        assert settled(printed.getvalue()) == (settled(wanted) if after == "text" else "")
        for picture in DRAWN.findall(code):
            assert (tmp_path / picture).stat().st_size > 5_000
            assert f"pictures/{picture})" in PAGES[page]


def test_the_examples_are_there():
    assert {page for page in PAGES if blocks(page)} >= {
        "README", "index", "getting_started", "troubleshooting", "games", "migration", "extending",
    }  # fmt: skip


@pytest.mark.parametrize("page", PAGES)
def test_the_files_it_names_exist(page):
    folder = ROOT if page == "README" else DOCS
    for path in re.findall(r"\]\((?!https?:|#)([^)#]+)", PAGES[page]):
        assert (folder / path).exists(), path
    for path in re.findall(r"`((?:tests|notebooks|benchmarks|docs)/[\w/]+\.\w+)`", PAGES[page]):
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize("page", PAGES)
def test_a_link_within_a_page_leads_to_one_of_its_headings(page):
    """On the site `#benchmarks` leads to another page, where the file alone is read nowhere."""
    headings = re.findall(r"^#+ (.*)$", PAGES[page], re.MULTILINE)
    places = {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}
    assert set(re.findall(r"\]\(#([^)]+)\)", PAGES[page])) <= places
    for other, place in re.findall(r"\]\(([\w/]+)\.md#([^)]+)\)", PAGES[page]):
        titles = re.findall(r"^#+ (.*)$", PAGES[other.split("/")[-1]], re.MULTILINE)
        assert place in {title.lower().replace(" ", "-") for title in titles}, place


def test_the_table_of_estimated_errors_is_what_the_benchmark_wrote():
    rows = json.loads((ROOT / "benchmarks/results/estimates.json").read_text(encoding="utf-8"))
    for line in estimates.quoted(rows):
        assert line in PAGES["bounds"].splitlines()
    assert f"{estimates.verdict(rows)}." in " ".join(PAGES["bounds"].split())
    assert len({(row["kind"], row["problem"]) for row in rows}) >= 60
    counted = [row for row in rows if row["counts"]]
    small = [row for row in counted if row["verdict"] == "too small"]
    assert len(small) <= 0.05 * len(counted)
    assert all(row["warned"] for row in small)


def test_the_tables_of_measurements_are_what_the_benchmarks_wrote():
    recorded = quoted.lines()
    whole = PAGES["benchmarks"].split("a test compares the two:\n\n")[1].split("\n\n")[0]
    assert whole.splitlines()[2:] == recorded
    missed = PAGES["benchmarks"].split("## Missed thresholds\n\n")[1].split("\n\n")[1]
    assert missed.splitlines()[2:] == quoted.missed()
    table = README.split("a test compares the two:\n\n")[1].split("\n\n")[0].splitlines()[2:]
    assert len(table) >= 4
    assert set(table) <= set(recorded)
    assert any("below 1 numba is faster" in line for line in table)  # the short table also shows the strongest peer
