"""The notebooks run from top to bottom, without a warning, and draw their pictures."""

import re
from pathlib import Path

import jupytext
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))


def run(path, folder, monkeypatch):
    """Execute a notebook in ``folder`` against this checkout; its cells with their outputs."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel brings its own, which keeps the pictures
    notebook = jupytext.read(path)
    NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def check(cells):
    outputs = [output for cell in cells for output in cell.outputs]
    complaints = [output.text for output in outputs if output.get("name") == "stderr"]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert not complaints
    assert len(pictures) >= sum("plt.show()" in cell.source for cell in cells) > 0


def test_they_are_there():
    assert {path.stem for path in NOTEBOOKS} >= {"minimum_time", "pendulum", "output_feedback", "feedback"}


def test_each_figure_of_the_chapter_has_its_heading():
    """From 3 to 16, one a heading, so that who looks for a number finds it."""
    texts = [path.read_text(encoding="utf-8") for path in NOTEBOOKS]
    headings = [int(number) for text in texts for number in re.findall(r"^# ## Figure (\d+):", text, re.MULTILINE)]
    assert sorted(headings) == list(range(3, 17))


HEAVY = {"reachability": pytest.mark.optimised}  # Air3D: ten times as long without XLA's optimiser


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", [pytest.param(path, id=path.stem, marks=HEAVY.get(path.stem, ())) for path in NOTEBOOKS]
)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    check(run(path, tmp_path, monkeypatch))
