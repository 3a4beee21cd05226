"""The house: imports run one way, importing is cheap, and what is public is documented."""

import ast
import enum
import inspect
import re
import subprocess
import sys
import types
from pathlib import Path

import pytest

import hjbjax as hjb

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "hjbjax"

# The table of docs/architecture.md: a folder imports from folders before it, and inside it a file from files before.
TABLE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("# Architecture")[1].split("\n## ")[0]
ROWS = [[re.findall(r"`(\w+)`", cell) for cell in row.split("|")[1:3]] for row in TABLE.splitlines()]
FOLDERS = {folder[0]: files for folder, files in (row for row in ROWS if len(row) == 2) if folder}
ORDER = [f"{folder}.{file}" for folder, files in FOLDERS.items() for file in files if file != "zoo"]
SOURCES = sorted(path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE)
LOOSE = {"__init__.py", "__main__.py", "_names.py", "_version.py", "py.typed"}


def name_of(path):
    """As in ORDER: "folder.file", or the folder alone for its ``__init__`` and for all of the zoo."""
    folder, file = path.relative_to(PACKAGE).with_suffix("").parts
    return folder if folder == "zoo" or file == "__init__" else f"{folder}.{file}"


def test_the_folders_are_those_of_the_table_and_hold_the_files_that_it_names():
    entries = {path.name for path in PACKAGE.iterdir()} - LOOSE - {"__pycache__"}
    assert entries == set(FOLDERS)
    assert len(set(ORDER)) == len(ORDER)
    names = {name_of(path) for path in SOURCES}
    assert {name for name in names if "." in name} == set(ORDER)


def imports_of(path):
    """What a file imports of the package, inside functions too, as "folder.file", "folder" or "" for the whole."""
    found = set()
    for statement in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(statement, ast.ImportFrom):
            assert statement.level == 0, f"{path.name}: imports are absolute"
            names = [f"{statement.module}.{alias.name}" for alias in statement.names]
        else:
            names = [alias.name for alias in statement.names] if isinstance(statement, ast.Import) else []
        for package, *rest in (name.split(".") for name in names):
            if package == "hjbjax":
                known = ".".join(rest[:2]) in ORDER
                found.add(
                    ".".join(rest[:2]) if known else rest[0] if rest and rest[0] in (*FOLDERS, "_version") else ""
                )
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_imports_only_from_above(path):
    folder, _, file = name_of(path).partition(".")
    folders = list(FOLDERS)
    inside = FOLDERS[folder][: FOLDERS[folder].index(file)] if file else FOLDERS[folder]
    allowed = {"_version", *(f"{folder}.{each}" for each in inside)} | ({"zoo"} if folder == "zoo" else set())
    earlier = folders[: folders.index(folder)]
    if folder == "zoo":
        earlier = ["problem"]  # problems know nothing of how they are solved
    allowed |= {name for name in ORDER if name.partition(".")[0] in earlier}
    if folder == "cli":  # the command alone may see the package as its users do
        allowed |= {"", "zoo", "plotting"}
    assert imports_of(path) <= allowed


def uses_of_streams(path):
    """The lines of a file that call a method of ``sys.stdout`` or ``sys.stderr``, or ``warnings.warn``."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute):
            owner = ast.unparse(node.value)
            if owner in ("sys.stdout", "sys.stderr") or (owner, node.attr) == ("warnings", "warn"):
                yield node.lineno


def test_only_one_file_uses_the_standard_streams():
    """They may be missing, closed or full, and a solve must not end with them."""
    others = [path for path in SOURCES if path != PACKAGE / "problem" / "streams.py"]
    assert [(path.name, line) for path in others for line in uses_of_streams(path)] == []


def test_importing_brings_nothing_heavy():
    heavy = {"matplotlib", "scipy", "diffrax", "equinox", "optax", "tqdm", "click", "plotly", "xarray"}
    code = (
        "import jax, sys; before = set(sys.modules); import hjbjax as h; h.solve; print(*(set(sys.modules) - before))"
    )
    answer = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    names = answer.stdout.split()
    loaded = {name.split(".")[0] for name in names}
    assert "hjbjax" in loaded
    assert not loaded & heavy
    # the names of these folders are imported one by one
    rare = ("calibration", "decomposition", "enclosure", "linear_games", "neural")
    assert [name for name in names if name.startswith(tuple(f"hjbjax.{folder}" for folder in rare))] == []


def members(module):
    """The functions and classes that a public module defines, its own files included."""
    for name, member in vars(module).items():
        if not name.startswith("_") and getattr(member, "__module__", "").startswith(module.__name__):
            yield f"{module.__name__}.{name}", member


OWN = {name: getattr(hjb, name) for name in hjb.__all__}
MODULES = [thing for thing in OWN.values() if isinstance(thing, types.ModuleType)]
INNER = {name: member for module in MODULES for name, member in members(module) if callable(member)}
OUTER = {name: thing for name, thing in OWN.items() if callable(thing)}


def unmentioned(thing):
    """The parameters on which a docstring is silent; an enumeration and an exception have none of their own."""
    if inspect.isclass(thing) and issubclass(thing, (enum.Enum, Exception)):
        return []
    names = inspect.signature(thing).parameters
    return [name for name in names if not re.search(rf"\b{name}\b", inspect.getdoc(thing) or "")]


def test_what_is_exported_is_there_and_sorted():
    assert list(hjb.__all__) == sorted(hjb.__all__)
    assert {"Problem", "Grid"} <= set(OUTER)


@pytest.mark.parametrize("name", OUTER)
def test_the_front_door_documents_every_parameter(name):
    assert OUTER[name].__doc__, f"{name} has no docstring"
    assert not unmentioned(OUTER[name])


@pytest.mark.parametrize("name", INNER)
def test_the_rooms_behind_it_have_no_incomplete_list_of_arguments(name):
    documentation = INNER[name].__doc__
    assert documentation, f"{name} has no docstring"
    if "Args:" in documentation or name.startswith("hjbjax.zoo."):
        assert not unmentioned(INNER[name])
