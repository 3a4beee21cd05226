"""Random problems against a dense solver in NumPy: checks the certified bounds, family by family.

Problems and solver are in ``tests/oracles``. Seeds are random, and a failing seed is printed.
"""

import collections
import sys
import time
from pathlib import Path

import click
import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "oracles"))

import agreement
import random_problems

from benchmarks.harness.report import RESULTS, Folder, publish, table

COLUMNS = ("problem", "count", "certified", "refused", "held", "unfinished", "tightest", "seconds")


@click.command()
@click.option(
    "--problems", default=4000, show_default=True, help="Number of problems, spread evenly over the families."
)
@click.option("--family", "names", multiple=True, help="Only these families.")
@click.option("--quick", is_flag=True, help="Two of each family.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(problems, names, quick, out):
    """Draw random problems, solve each twice, and print how many bounds held and how tight they were."""
    families = [random_problems.BY_NAME[name] for name in names] or random_problems.FAMILIES
    each = 2 if quick else -(-problems // len(families))
    rows = []
    for family in families:
        began, failures = time.perf_counter(), []
        verdicts = _verdicts(family, each, failures)
        rows.append(_row(family.name, verdicts, failures, time.perf_counter() - began))
        click.echo(f"{family.name}: {len(verdicts)} in {rows[-1]['seconds']:.0f} s")
        for name, seed, complaint in failures:
            click.echo(f"{name}, seed {seed}: {complaint}", err=True)
    rows.append(_total(rows))
    click.echo(table(rows, COLUMNS))
    publish(out, "bounds", rows)
    raise SystemExit(1 if rows[-1]["status"] == "FAILED" else 0)


def _verdicts(family, count, failures):
    """One verdict per problem; violated bounds are appended to ``failures``."""
    found = []

    @settings(max_examples=count, deadline=None, database=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(seed=st.integers(0, 2**32 - 1))
    def draw(seed):
        rng = np.random.default_rng(seed)
        try:
            verdict = agreement.compare(random_problems.draw(family, rng), rng)
        except Exception as error:  # a crash counts as a failure of this problem; the others continue
            verdict = agreement.Verdict("uncertified", (f"{type(error).__name__}: {error}",))
        found.append(verdict)
        failures.extend((family.name, seed, complaint) for complaint in verdict.complaints[:1])

    draw()
    return found


def _row(name, verdicts, failures, seconds):
    kinds = collections.Counter(verdict.kind for verdict in verdicts)
    ratios = [verdict.ratio for verdict in verdicts if np.isfinite(verdict.ratio)]
    return {
        "benchmark": "bounds", "problem": name, "count": len(verdicts), "certified": kinds["certified"],
        "refused": kinds["refused"], "held": sum(not v.complaints for v in verdicts),
        "unfinished": sum(bool(v.unfinished) for v in verdicts), "tightest": max(ratios, default=None),
        "seconds": seconds, "dtype": "float64", "status": "FAILED" if failures else "OK",
        "failed": [f"seed {seed}: {complaint}" for _, seed, complaint in failures],
    }  # fmt: skip


def _total(rows):
    sums = {key: sum(row[key] for row in rows) for key in (*COLUMNS[1:6], "seconds")}
    tightest = max((row["tightest"] for row in rows if row["tightest"] is not None), default=None)
    status = "FAILED" if any(row["status"] == "FAILED" for row in rows) else "OK"
    return {"benchmark": "bounds", "problem": "all", **sums, "tightest": tightest, "dtype": "float64", "status": status}


if __name__ == "__main__":
    command()
