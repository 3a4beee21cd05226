"""Seeded bugs in a copy of the checkout, one after the other, to check that the default suite finds each of them.

A mutant replaces one text by another. The test files that are most likely to find it run first, up to the first
failure. If they pass, the whole default suite runs. At the end the tests that found a bug run again without any bug; a
test that fails there too does not count.
"""

import dataclasses
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import click

from benchmarks.harness.report import RESULTS, Folder, publish, table

ROOT = Path(__file__).parents[2]
LEFT_OUT = (".git", ".venv", "__pycache__", "site", "build", "dist", "*.egg-info", ".*_cache", ".hypothesis")
COLUMNS = ("mutant", "file", "caught_by", "seconds", "status")
LONGEST = 1800.0  # seconds of one run of tests, including the whole suite


@dataclasses.dataclass(frozen=True)
class Mutant:
    """A bug as a replacement of one text, and the test files that are most likely to find it, in order.

    Attributes:
      name: the bug, in words.
      file: its file within the package.
      old: a text that occurs exactly once in the file.
      new: its replacement.
      likely: test files.
    """

    name: str
    file: str
    old: str
    new: str
    likely: tuple[str, ...]

    def applied(self, text: str) -> str:
        """The text of the file with the bug in it.

        Raises:
          ValueError: the old text does not occur exactly once.
        """
        if (count := text.count(self.old)) != 1:
            raise ValueError(
                f"mutants: {self.name}: hjbjax/{self.file} holds {self.old!r} {count} times, wanted once; "
                "the code has changed: write the mutant again"
            )
        return text.replace(self.old, self.new)


MUTANTS = (
    Mutant(
        "sign of the drift",
        "discretisation/discretisation.py",
        "return list(components.components(self.problem.drift, *self._arguments(u, d, x), dtype=self.dtype))",
        "return [-f for f in components.components(self.problem.drift, *self._arguments(u, d, x), dtype=self.dtype)]",
        ("tests/markov_chain/test_chain.py",),
    ),
    Mutant(
        "upwind side",
        "hamiltonian/discrete.py",
        "jnp.maximum(f, 0) * self.up[axis] + jnp.minimum(f, 0) * self.down[axis]",
        "jnp.maximum(f, 0) * self.down[axis] + jnp.minimum(f, 0) * self.up[axis]",
        ("tests/hamiltonian/test_discrete.py",),
    ),
    Mutant(
        "ghost cell",
        "discretisation/stencil.py",
        "        return slices(values, grid, axis, step)\n    weights",
        "        return slices(values, grid, axis, step, 1)\n    weights",
        ("tests/discretisation/test_stencil.py",),
    ),
    Mutant(
        'missing "1 −" of the self-transition',
        "markov_chain/chain.py",
        "np.maximum(1 - steps.total(), 0)",
        "np.maximum(steps.total(), 0)",
        ("tests/markov_chain/test_chain.py",),
    ),
    Mutant(
        "discount of a march",
        "iteration/time_stepping.py",
        "return best - on.decay * value, self.look(value, u, d, t)",
        "return best, self.look(value, u, d, t)",
        ("tests/discretisation/test_schemes.py",),
    ),
    Mutant(
        "periodic wrap",
        "discretisation/stencil.py",
        "given = slices(values, grid, axis, -step, count",
        "given = slices(values, grid, axis, step, count",
        ("tests/discretisation/test_stencil.py",),
    ),
    Mutant(
        "min for max",
        "iteration/bellman.py",
        "value = jnp.maximum(value, self.lower)",
        "value = jnp.minimum(value, self.lower)",
        ("tests/iteration/test_bellman.py", "tests/applications/test_reachability.py"),
    ),
    Mutant(
        "width of the ghost cells of Eno2",
        "discretisation/slopes.py",
        "np.array(known)[3 - reach :]",
        "np.array(known)[:reach]",
        ("tests/discretisation/test_slopes.py",),
    ),
    Mutant(
        "½ of the noise",
        "discretisation/discretisation.py",
        "return {(i, i): spread[i] * spread[i]",
        "return {(i, i): spread[i] * spread[i] / 2",
        ("tests/markov_chain/test_chain.py", "tests/laws/test_accuracy.py"),
    ),
    Mutant(
        "target mask",
        "iteration/bellman.py",
        "else on.level <= 0",
        "else on.level < 0",
        ("tests/regressions/test_boundary_nodes.py",),
    ),
    Mutant(
        "time of a cost in an implicit step",
        "iteration/time_methods.py",
        "ImplicitStep.of(march.on.at(end), march.obstacles_at(end), value, dt)",
        "ImplicitStep.of(march.on.at(t), march.obstacles_at(end), value, dt)",
        ("tests/solvers/test_finite_horizon.py",),
    ),
    Mutant(
        "spacing of a stretched axis",
        "discretisation/stencil.py",
        "up, down = jnp.append(gaps, gaps[-1:]), jnp.append(gaps[:1], gaps)",
        "down, up = jnp.append(gaps, gaps[-1:]), jnp.append(gaps[:1], gaps)",
        ("tests/discretisation/test_stencil.py",),
    ),
    Mutant(
        "coefficient of a Runge–Kutta method",
        "iteration/time_methods.py",
        "3: Tableau((0.0, 3 / 4, 1 / 3))",
        "3: Tableau((0.0, 1 / 2, 1 / 2))",
        ("tests/regressions/test_time_steps.py",),
    ),
    Mutant(
        "seam of an interpolation",
        "problem/grid.py",
        "index = tuple((cell + bit) % count for",
        "index = tuple(jnp.minimum(cell + bit, count - 1) for",
        ("tests/problem/test_grid.py", "tests/solution/test_interpolation.py"),
    ),
    Mutant(
        "half an error bound",
        "iteration/certificates.py",
        "return layout.least(policy.defect) / discount, layout.largest(policy.defect) / discount",
        "return layout.least(policy.defect) / (2 * discount), layout.largest(policy.defect) / (2 * discount)",
        ("tests/iteration/test_certificates.py",),
    ),
)
QUICK = ("ghost cell", "seam of an interpolation")


@click.command()
@click.option("--mutant", "names", multiple=True, help="Only mutants whose names contain this text.")
@click.option("--quick", is_flag=True, help="Two mutants, without the whole suite.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the rows.")
def command(names: Sequence[str], quick: bool, out: Path) -> None:
    """Seed one bug after the other in a copy of the checkout, and print which test found it."""
    chosen = [each for each in MUTANTS if any(name in each.name for name in (names or ("",)))]
    if quick:
        chosen = [each for each in chosen if each.name in QUICK]
    if not chosen:
        raise click.UsageError(f"--mutant: none of {', '.join(each.name for each in MUTANTS)} holds that text")
    for each in chosen:  # a stale mutant raises before the first test
        each.applied(source(ROOT, each).read_text(encoding="utf-8"))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*LEFT_OUT))
        for each in chosen:
            rows.append(measured(each, copy, whole=not quick))
            click.echo(f"{each.name}: {rows[-1]['caught_by'] or 'SURVIVED'}, {rows[-1]['seconds']:.0f} s", err=True)
        found = [row["caught_by"] for row in rows if row["caught_by"]]
        anyway = failures(copy, list(dict.fromkeys(found)), "--maxfail=100") if found else []
    for row in rows:
        if row["caught_by"] in anyway:
            row["status"] = "FAILED"
    click.echo(table(rows, COLUMNS))
    publish(out, "mutants", rows)
    raise SystemExit(1 if any(row["status"] != "OK" for row in rows) else 0)


def source(root: Path, mutant: Mutant) -> Path:
    """The file of the package that a mutant changes, in a checkout."""
    return root / "hjbjax" / mutant.file


def measured(mutant: Mutant, copy: Path, *, whole: bool) -> dict:
    """The row of one mutant; its bug is in the copy while its tests run."""
    path, began = source(copy, mutant), time.perf_counter()
    before = path.read_text(encoding="utf-8")
    path.write_text(mutant.applied(before), encoding="utf-8")
    try:
        caught = failures(copy, mutant.likely, "-x")
        if not caught and whole:
            caught = failures(copy, (), "-x")
    finally:
        path.write_text(before, encoding="utf-8")
    return {
        "benchmark": "mutants", "mutant": mutant.name, "file": mutant.file, "dtype": None,
        "caught_by": caught[0] if caught else None, "seconds": time.perf_counter() - began,
        "status": "OK" if caught else "SURVIVED",
    }  # fmt: skip


def failures(copy: Path, tests: Sequence[str], *options: str) -> list[str]:
    """The names of the failing tests of some files or tests of a copy, or of the default suite if none are named.

    Raises:
      RuntimeError: the tests could not run.
    """
    # no compiled files: Python would use stale ones if a file changes within the same second
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    one = ("-n", "0") if tests else ()  # two processes do not pay for a few files
    command = [sys.executable, "-m", "pytest", "-q", "--tb=no", "-rfE", "-p", "no:cacheprovider", *one, *options]
    done = subprocess.run(
        [*command, *tests], cwd=copy, env=environment, capture_output=True, text=True, timeout=LONGEST, check=False
    )
    # 0: all passed, 1: some failed; anything else, and a file that cannot be imported, is not a verdict
    if done.returncode not in (0, 1) or "\nERROR " in done.stdout:
        raise RuntimeError(f"mutants: pytest ended with {done.returncode}:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    lines = done.stdout.splitlines()
    return [line.removeprefix("FAILED ").split(" - ")[0] for line in lines if line.startswith("FAILED ")]


if __name__ == "__main__":
    command()
