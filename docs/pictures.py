"""``python -m docs pictures`` draws the pictures of the README, of the pages and of the gallery, in some minutes.

The Python blocks of a page run in ``docs/pictures`` and save their pictures there. Then every ready problem is solved
for the gallery.
"""

import contextlib
import os
import re
from collections.abc import Sequence
from pathlib import Path

from hjbjax import zoo
from hjbjax.cli import gallery, run_folder

COLOURS = 256  # size of the palette; a picture has a quarter of the bytes of full colours
ALIKE = 16  # this number of adjacent shades of red, green or blue count as one colour
EXACT = 16  # the most frequent colours, which are not averaged: paper, panes, frames and lines
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PAGES = ("README.md", "docs/getting_started.md", "docs/enclose.md")


def draw(docs: Path, names: Sequence[str] = ()) -> None:
    """Draw all pictures and write the page of the gallery, or draw only the pictures of the named problems."""
    folder = docs / "pictures"
    if not names:
        pictures_of_pages(docs, folder)
    cards = []
    for entry in (zoo.catalogue[name] for name in names or zoo.catalogue):
        print(entry.name, flush=True)
        cards.append(gallery.card(entry))
        write_pictures(cards[-1], folder / "gallery")  # immediately, so that finished pictures survive an interrupt
    if not names:
        (docs / "gallery.md").write_text(gallery_page(cards), encoding="utf-8")


def pictures_of_pages(docs: Path, folder: Path) -> None:
    """Run the pages; the new pictures replace the old ones once all are drawn."""
    with run_folder.staging(folder) as new:
        for page in PAGES:
            run(docs.parent / page, new)
        made = sorted(new.glob("*.png"))
        for picture in made:
            shrink(picture)
        for old in folder.glob("*.png"):
            old.unlink()
        for picture in made:
            os.replace(picture, folder / picture.name)


def run(page: Path, folder: Path) -> None:
    """Run the Python blocks of a page in one namespace; they save their files in a folder."""
    from matplotlib import pyplot

    pyplot.close("all")  # otherwise this page would draw on the axes of the previous page
    names: dict[str, object] = {}
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.chdir(folder):
        for code in BLOCK.findall(page.read_text(encoding="utf-8")):
            exec(compile(code, page.name, "exec"), names)
        for left in folder.glob("*.npz"):
            os.unlink(left)


def shrink(picture: Path) -> None:
    """Halve the resolution of a PNG and reduce its colours to a palette.

    Groups of similar colours enter the palette with the square root of their frequency as weight. With the frequency
    itself the large areas would take the whole palette, and a colour bar would become a staircase. A picture drawn at
    200 dots per inch and halved is smoother than one drawn at 100.
    """
    import numpy as np
    from PIL import Image

    with Image.open(picture) as image:
        full = image.convert("RGB")
    full = full.resize((full.width // 2, full.height // 2), Image.Resampling.LANCZOS)
    pixels = np.asarray(full).reshape(-1, 3)
    found, place, often = np.unique(pixels, axis=0, return_inverse=True, return_counts=True)
    _, group = np.unique(found // ALIKE, axis=0, return_inverse=True)
    size = np.bincount(group.ravel(), often)
    mean = np.stack([np.bincount(group.ravel(), often * shade) / size for shade in found.T], axis=-1)
    row = np.repeat(mean.astype(np.uint8), np.ceil(np.sqrt(size)).astype(int), axis=0)
    # without three rounds of k-means the palette has only the colour map, and an orange line turns brown
    means = Image.fromarray(row[None]).quantize(COLOURS - EXACT, kmeans=3, dither=Image.Dither.NONE).getpalette()
    # frequent colours are not averaged; the mean of near whites would be grey
    palette = np.concatenate([found[np.argsort(-often)[:EXACT]], np.reshape(means, (-1, 3))])
    # computed here, because Pillow rounds colours before it searches for the nearest
    nearest = [np.argmin(np.sum((palette - colour.astype(int)) ** 2, axis=1)) for colour in found]
    small = Image.fromarray(np.asarray(nearest, np.uint8)[place.ravel()].reshape(full.height, full.width))
    small.putpalette(palette.astype(np.uint8).ravel().tolist())
    small.save(picture, optimize=True)


def write_pictures(card: gallery.Card, folder: Path) -> None:
    """Write the pictures of a ready problem into a folder, instead of its old ones."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob(f"{card.name}-[0-9].webp"):
        old.unlink()
    for number, (_, data) in enumerate(card.pictures, 1):
        (folder / f"{card.name}-{number}.webp").write_bytes(data)


def gallery_page(cards: list[gallery.Card]) -> str:
    """The page of the gallery, whose pictures ``write_pictures`` writes."""
    lines = [
        "# Gallery",
        "",
        "Every ready problem of `hjb.zoo`, solved on a grid for pictures by `python -m docs pictures`.",
        "`hjbjax gallery --out FOLDER` makes this page on your machine. `hjbjax solve NAME` solves one problem on its",
        "own grid.",
        "",
        gallery.SYMBOLS,
        "",
    ]
    for card in cards:
        lines += [f"## {card.name}", "", f"{card.summary[0].upper()}{card.summary[1:]}: {card.status}.", ""]
        for number, (caption, _) in enumerate(card.pictures, 1):
            lines += [f"![{card.name}: {caption}](pictures/gallery/{card.name}-{number}.webp)", ""]
            lines += [f"*{caption[0].upper()}{caption[1:]}.*", ""]
        lines += ["| | |", "|---|---|", *(f"| {word} | {figure} |" for word, figure in card.facts), ""]
    return "\n".join(lines)
