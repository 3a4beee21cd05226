"""The README tells the truth: its commands, its examples with their output, its files."""

import contextlib
import io
import json
import re
from pathlib import Path

import pytest

from benchmarks.harness import quoted

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
COMMANDS = ["pip install . && hjbjax solve pendulum", "pip install '.[test]' && pytest"]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_stand_in_the_first_screen(command):
    assert command in README.splitlines()[:30]


def test_ci_runs_the_test_command_as_it_stands_here():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert f'tests="{COMMANDS[1]}"' in script.splitlines()


def settled(text):
    """A printed screen without what differs between machines: clocks, memory, and numbers made of rounding."""
    text = re.sub(r"^( *(?:seconds|memory|device) ).*$", r"\1", text, flags=re.MULTILINE)
    return re.sub(r"\d(\.\d+)?e-(0[7-9]|[1-9]\d)", "tiny", text)


def test_every_python_block_runs_and_prints_what_the_text_block_after_it_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names, ran = {}, 0
    for (kind, code), (after, wanted) in zip(BLOCKS, [*BLOCKS[1:], ("", "")], strict=True):
        if kind != "python":
            continue
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(compile(code, "README.md", "exec"), names)
        ran += 1
        if after == "text":
            assert settled(printed.getvalue()) == settled(wanted)
    assert ran, "the README has no example"


def test_the_files_it_names_exist():
    linked = re.findall(r"\]\((?!https?:)([^)#]+)", README)
    named = re.findall(r"`((?:tests|notebooks|benchmarks)/[\w/.]+)`", README)
    assert named
    for path in linked + named:
        assert (ROOT / path).exists(), path


def test_the_table_of_estimated_errors_is_what_the_benchmark_wrote():
    rows = json.loads((ROOT / "benchmarks/results/estimates.json").read_text(encoding="utf-8"))
    ratios = [row["ratio"] for row in rows if row["counts"]]
    table = README.split("over the largest true error, on three grids each")[1].split("\n\n")[1]
    quoted = [float(cell) for cell in re.findall(r"\| (\d*\.\d+)(?= \|)", table)]
    assert quoted == pytest.approx(ratios, abs=0.006, rel=0.002)
    within = sum(1 / 3 <= ratio <= 5 for ratio in ratios)
    assert f"Between a third and five in {within} of {len(ratios)}" in README


def test_the_table_of_measurements_is_what_the_benchmarks_wrote():
    table = README.split("holds it to them:\n\n")[1].split("\n\n")[0]
    assert table.splitlines()[2:] == quoted.lines()
