"""CONTRIBUTING.md names files, folders and Python names that exist."""

import pkgutil
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
WORDS = {word for span in re.findall(r"`([^`\n]+)`", TEXT) for word in span.split()}
WORDS = {word for word in WORDS if not re.fullmatch(r"\d+/\d+", word)}  # a share of the tests
PATHS = sorted(word for word in WORDS if re.fullmatch(r"(?!https?:)[\w.-]+/[\w./-]*|\w+\.(?:md|py)", word))
NAMES = sorted(word for word in WORDS if re.fullmatch(r"(?:hjbjax|benchmarks|docs)(?:\.\w+)+", word))
MADE = {"site/", ".venv/bin/activate"}  # by the commands of the page


def exists(path):
    """True if a path leads somewhere from the root of the checkout or from the package."""
    return any((place / path).exists() for place in (ROOT, ROOT / "hjbjax"))


@pytest.mark.parametrize("path", [path for path in PATHS if path not in MADE])
def test_every_path_leads_to_a_file_or_folder(path):
    assert exists(path)


@pytest.mark.parametrize("name", NAMES)
def test_every_dotted_name_can_be_imported(name):
    assert pkgutil.resolve_name(name) is not None


def test_every_link_leads_to_a_file():
    links = re.findall(r"\]\((?!https?:|#)([^)#]+)", TEXT)
    assert links
    assert all((ROOT / link).exists() for link in links)


def test_every_code_word_with_a_dot_or_slash_is_a_path_a_name_or_a_command():
    """A mention that is neither would be checked by nobody; the commands are the ones in the table and the release."""
    known = {*PATHS, *NAMES, "'.[bench]'", ".", ".ci/run", "__init__.py", "vX.Y.Z", "PYTHON=python3.11"}
    assert len(PATHS) > 30
    assert len(NAMES) >= 6
    assert not {word for word in WORDS if "." in word or "/" in word} - known


def test_a_path_or_name_that_is_gone_is_found():
    assert not exists("iteration/gone.py")
    with pytest.raises(AttributeError):
        pkgutil.resolve_name("hjbjax.iteration.fixed_point._judge")
