"""``python -m docs`` builds the site; ``python -m docs pictures`` and ``notebooks`` make what it shows again,
all of it or what is named: problems of the zoo, or notebooks.

The site is built from committed pages and pictures: nothing is solved. A warning is an error.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from docs import notebooks, pictures
from hjbjax import zoo
from hjbjax.cli import command_line, run_folder

HERE = Path(__file__).parent
SITE = HERE.parent / "site"


WANTED = "wanted build [FOLDER], pictures [NAME ...] or notebooks [NAME ...]"


def build(out: Path = SITE) -> int:
    """Build the site into a folder; the exit code of Sphinx, not zero after any warning."""
    from sphinx.cmd.build import main as sphinx

    from benchmarks.harness import recorded

    recorded.write(HERE / "generated" / "recorded.md")
    return sphinx(["-W", "--keep-going", "-q", "-j", "2", "-b", "html", str(HERE), str(out)])


def complaint(name: str, rest: Sequence[str]) -> str | None:
    """The reason why a command cannot be done, found before anything is computed; None if it can be done."""
    known = {"pictures": lambda: list(zoo.catalogue), "notebooks": notebooks.names}
    if name not in ("build", *known):
        return f"got {name!r}, {WANTED}"
    place = HERE / name
    if name == "build":
        place = Path(rest[0]) if rest else SITE
    else:
        for word in rest:
            if word not in (names := known[name]()):
                return command_line.unknown(name, word, names)
    try:
        run_folder.check_folder(place, force=True)
        run_folder.check_writable(place)
    except OSError as error:
        return str(error)
    return None


def main(arguments: Sequence[str]) -> int:
    """The command: ``build`` without a word, into a folder where one is named."""
    name, *rest = arguments or ("build",)
    if (reason := complaint(name, rest)) is not None:
        print(f"docs: {reason}", file=sys.stderr)
        return 2
    if name == "build":
        out = Path(rest[0]) if rest else SITE
        code = build(out)
        print(f"{'built' if code == 0 else 'failed:'} {out / 'index.html'}")
        return code
    if name == "pictures":
        pictures.draw(HERE, rest)
    else:
        notebooks.render(HERE / "notebooks", rest)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
