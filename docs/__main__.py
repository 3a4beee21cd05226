"""``python -m docs`` builds the site; ``python -m docs pictures`` and ``notebooks`` make what it shows again,
all of it or what is named: problems of the zoo, or notebooks.

The site is built from committed pages and pictures: nothing is solved. A warning is an error.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent
SITE = HERE.parent / "site"


def build(out: Path = SITE) -> int:
    """Build the site into a folder; the exit code of Sphinx, not zero after any warning."""
    from sphinx.cmd.build import main as sphinx

    from benchmarks.harness import recorded

    recorded.write(HERE / "generated" / "recorded.md")
    return sphinx(["-W", "--keep-going", "-q", "-j", "2", "-b", "html", str(HERE), str(out)])


def main(arguments: Sequence[str]) -> int:
    """The command: ``build`` without a word, into a folder where one is named."""
    name, *rest = arguments or ("build",)
    if name == "build":
        out = Path(rest[0]) if rest else SITE
        code = build(out)
        print(f"{'built' if code == 0 else 'failed:'} {out / 'index.html'}")
        return code
    if name == "pictures":
        from docs import pictures

        pictures.draw(HERE, rest)
        return 0
    if name == "notebooks":
        from docs import notebooks

        notebooks.render(HERE / "notebooks", rest)
        return 0
    print(f"docs: got {name!r}, wanted build [FOLDER], pictures [NAME ...] or notebooks [NAME ...]", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
