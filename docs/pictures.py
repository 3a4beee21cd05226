"""``python -m docs pictures``: what the README and the pages show, made by the code that stands beside it.

The Python blocks of a page run in ``docs/pictures``, where their ``savefig`` leaves the pictures; then every ready
problem is solved for the page of the gallery. All of it takes some minutes.
"""

import contextlib
import os
import re
from pathlib import Path

from hjbjax import zoo
from hjbjax.cli import gallery

COLOURS = 256  # of a palette: a third of the bytes of full colours
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PAGES = ("README.md", "docs/getting_started.md")


def draw(docs: Path) -> None:
    """The pictures of the pages, and the gallery."""
    for page in PAGES:
        run(docs.parent / page, docs / "pictures")
    for picture in sorted((docs / "pictures").glob("*.png")):
        shrink(picture)
    cards = []
    for entry in zoo.catalogue.values():
        print(entry.name, flush=True)
        cards.append(gallery.card(entry))
    (docs / "gallery.md").write_text(gallery_page(cards, docs / "pictures" / "gallery"), encoding="utf-8")


def run(page: Path, folder: Path) -> None:
    """The Python blocks of a page, in one namespace, with their files in a folder."""
    names: dict[str, object] = {}
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.chdir(folder):
        for code in BLOCK.findall(page.read_text(encoding="utf-8")):
            exec(compile(code, page.name, "exec"), names)
        for left in folder.glob("*.npz"):
            os.unlink(left)


def shrink(picture: Path) -> None:
    """A PNG with a palette in place of colours."""
    from PIL import Image

    with Image.open(picture) as image:
        # three rounds of k-means: without them the palette is the colour map alone, and an orange line turns brown
        small = image.convert("RGB").quantize(COLOURS, kmeans=3, dither=Image.Dither.NONE)
    small.save(picture, optimize=True)


def gallery_page(cards: list[gallery.Card], folder: Path) -> str:
    """The page of the gallery, with its pictures put into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [
        "# Gallery",
        "",
        "Every ready problem of `hjb.zoo` on a small grid, by `python -m docs pictures`. `hjbjax gallery --out FOLDER` "
        "makes this",
        "page on your machine, `hjbjax solve NAME` takes the full grids.",
        "",
    ]
    for card in cards:
        lines += [f"## {card.name}", "", f"{card.summary[0].upper()}{card.summary[1:]}: {card.status}.", ""]
        for number, (caption, data) in enumerate(card.pictures, 1):
            picture = folder / f"{card.name}-{number}.webp"
            picture.write_bytes(data)
            lines += [f"![{card.name}: {caption}](pictures/gallery/{picture.name})", ""]
        lines += ["| | |", "|---|---|", *(f"| {word} | {figure} |" for word, figure in card.facts), ""]
    return "\n".join(lines)
