"""The house: imports run one way, importing is cheap, and what is public is documented."""

import ast
import enum
import inspect
import itertools
import re
import subprocess
import sys
import types
from pathlib import Path

import pytest

import hjbjax as hjb

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "hjbjax"

# The README's architecture table, top to bottom and left to right: a file imports only from files before it.
TABLE = (ROOT / "README.md").read_text(encoding="utf-8").split("## Architecture")[1].split("\n## ")[0]
ROWS = [re.findall(r"`(\w+)`", row.split("|")[2]) for row in TABLE.splitlines() if row.startswith("| ")]
*PIPELINE, COMMAND = ROWS  # the command alone may see the package as its users do
ORDER = ["_version", *itertools.chain.from_iterable(PIPELINE), "__init__", *COMMAND, "__main__"]
SOURCES = sorted(PACKAGE.rglob("*.py"))


def module_of(path):
    """The name in ORDER: a package such as zoo counts as one file."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def test_the_table_names_each_file_once():
    assert len(set(ORDER)) == len(ORDER)
    assert COMMAND[-1] == "cli"


def imports_of(path):
    """The names in ORDER that a file imports, inside functions too; a name of the package's own is its __init__."""
    found = set()
    for statement in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(statement, ast.ImportFrom):
            assert statement.level == 0, f"{path.name}: imports are absolute"
            names = [f"{statement.module}.{alias.name}" for alias in statement.names]
        else:
            names = [alias.name for alias in statement.names] if isinstance(statement, ast.Import) else []
        for package, *rest in (name.split(".") for name in names):
            if package == "hjbjax":
                found.add(rest[0] if rest and rest[0] in ORDER else "__init__")
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_imports_only_from_above(path):
    name = module_of(path)
    assert name in ORDER, f"{path.name} has no place in the README's architecture table"
    above = set(ORDER[: ORDER.index(name)])
    if name == "solver":
        above -= {"files"}  # a Solution reads and writes itself; solving touches no file
    if name == "zoo":
        above = {"pytree", "sets", "grid", "problem", "zoo"}  # problems know nothing of how they are solved
    assert imports_of(path) <= above


def test_importing_brings_nothing_heavy():
    heavy = {"matplotlib", "scipy", "diffrax", "equinox", "optax", "tqdm", "click", "plotly", "xarray"}
    code = "import jax, sys; before = set(sys.modules); import hjbjax; print(*(set(sys.modules) - before))"
    answer = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in answer.stdout.split()}
    assert "hjbjax" in loaded
    assert not loaded & heavy


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
