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


def test_the_figures_of_the_chapter_are_named():
    """From 3 to 16: singly, or as "Figures 3 to 5"."""
    named = set()
    for path in NOTEBOOKS:
        for first, last in re.findall(
            r"[Ff]igures? (\d+)(?: (?:to|and) (\d+))?", path.read_text().replace("\n# ", " ")
        ):
            named.update(range(int(first), int(last or first) + 1))
    assert named >= set(range(3, 17))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    check(run(path, tmp_path, monkeypatch))
