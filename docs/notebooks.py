"""``python -m docs notebooks``: the notebooks, run from top to bottom, as Markdown pages with their figures.

The pages are committed, so that the site is built without running anything; a test holds their cells to the notebooks.
"""

import base64
import os
from collections.abc import Sequence
from pathlib import Path

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


def names() -> list[str]:
    """The names of all notebooks."""
    return sorted(path.stem for path in NOTEBOOKS.glob("*.py"))


def render(folder: Path, names: Sequence[str] = ()) -> None:
    """Write one page per notebook and its pictures into a folder, for all notebooks or for the named ones."""
    import jupytext
    import nbformat
    from nbclient import NotebookClient

    from docs.pictures import shrink

    folder.mkdir(parents=True, exist_ok=True)
    os.environ.pop("MPLBACKEND", None)  # the kernel brings its own, which keeps the pictures
    for path in sorted(NOTEBOOKS.glob("*.py")):
        if names and path.stem not in names:
            continue
        print(path.stem, flush=True)
        notebook = jupytext.read(path)
        # ``shrink`` halves the resolution afterwards, which smooths surfaces of small triangles
        notebook.cells.insert(0, nbformat.v4.new_code_cell("%config InlineBackend.figure_format = 'retina'"))
        # consecutive printed lines become one block
        NotebookClient(notebook, timeout=1200, kernel_name="python3", coalesce_streams=True).execute()
        for picture in folder.glob(f"{path.stem}-*.*"):  # old pictures, only once there are new ones
            picture.unlink()
        lines: list[str] = []
        for cell in notebook.cells[1:]:
            lines += [cell.source, ""] if cell.cell_type == "markdown" else ["```py", cell.source, "```", ""]
            for output in cell.get("outputs", ()):
                lines += shown(output, folder, f"{path.stem}-{sum(line.startswith('![') for line in lines) + 1}.png")
        (folder / f"{path.stem}.md").write_text("\n".join(lines), encoding="utf-8")
        for picture in folder.glob(f"{path.stem}-*.png"):
            shrink(picture)


def shown(output: dict, folder: Path, name: str) -> list[str]:
    """The lines of one output: a link to its picture, which is saved in the folder, or its text."""
    data = output.get("data", {})
    for kind, ending in (("image/png", ".png"), ("image/webp", ".webp")):
        if kind in data:
            picture = (folder / name).with_suffix(ending)
            picture.write_bytes(base64.b64decode(data[kind]))
            return [f"![a figure of this notebook]({picture.name})", ""]
    text = output.get("text") or data.get("text/plain", "")
    return ["```text", text.rstrip(), "```", ""] if text.strip() else []


def cells(page: str) -> list[str]:
    """The code cells of a page; a test compares them with the cells of the notebook."""
    import re

    return re.findall(r"^```py\n(.*?)\n```$", page, re.MULTILINE | re.DOTALL)
