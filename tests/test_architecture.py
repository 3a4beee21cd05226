"""The house: imports run one way, importing is cheap, and what is public is documented."""

import ast
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


def public():
    """What hjbjax exports: its own names, and those of the modules among them."""
    for name in hjb.__all__:
        thing = getattr(hjb, name)
        if not isinstance(thing, types.ModuleType):
            yield name, thing
            continue
        for inner, member in vars(thing).items():
            if not inner.startswith("_") and getattr(member, "__module__", "").startswith(thing.__name__):
                yield f"{name}.{inner}", member


PUBLIC = {name: thing for name, thing in public() if callable(thing)}


def test_what_is_exported_is_there_and_sorted():
    assert list(hjb.__all__) == sorted(hjb.__all__)
    assert {"Problem", "Grid"} <= set(PUBLIC)


@pytest.mark.parametrize("name", PUBLIC)
def test_what_is_public_is_documented_with_every_parameter(name):
    documentation = inspect.getdoc(PUBLIC[name]) or ""
    assert documentation, f"{name} has no docstring"
    missing = [
        parameter
        for parameter in inspect.signature(PUBLIC[name]).parameters
        if parameter != "self" and not re.search(rf"\b{parameter}\b", documentation)
    ]
    assert not missing, f"{name}: the docstring says nothing of {', '.join(missing)}"
