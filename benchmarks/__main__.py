"""``python -m benchmarks NAME [options]`` runs one benchmark; without a name it lists them.

A benchmark is a file in ``speed`` or ``accuracy`` with a click command called ``command``; ``NAMES`` gives its folder.
"""

import difflib
import importlib
import sys
from collections.abc import Sequence

from hjbjax.problem import streams

NAMES = {
    "accuracy": ("accuracy", "errors, orders and seconds over the zoo's problems with known answers"),
    "estimates": ("accuracy", "the estimated grid error against the true error, over the same problems"),
    "sweep": ("speed", "node-controls per second of one sweep, against numba and the copy bandwidth"),
    "peers": ("speed", "a certified solve against QuantEcon, mdpsolver and a hand-written numba solver"),
    "eikonal": ("speed", "the eikonal equation against scikit-fmm, at equal nodes and at equal error"),
    "growth": ("speed", "seconds, steps and bytes per node of certified solves on finer and finer grids"),
    "scaling": ("speed", "the N^n law: seconds, steps and bytes per node in one to six dimensions"),
    "controls": ("speed", "seconds against the number of controls and against the error, compared with O(1/ε^{2n+m})"),
    "information": ("speed", "nodes, bytes and seconds of beliefs on grids, and the counts of section 13.2"),
    "batch": ("speed", "solve_batch of pendulums of different mass, against one after the other"),
    "devices": ("speed", "one problem on two devices of a processor against one device, and outer steps on eight"),
    "gradients": ("speed", "value and gradient of a solve against the value, and against central differences"),
    "startup": ("speed", "the first answer of a process: importing, compiling, pictures; cold and with the cache"),
    "agents": ("accuracy", "returns of feedbacks in four environments of Gymnasium, next to published agents"),
    "precision": ("accuracy", "error against seconds: the gain of second order"),
    "march": ("speed", "marches against hj_reachability with equal schemes: seconds and bytes"),
    "memory": ("accuracy", "the memory estimate against the peak of separate processes"),
    "mutants": ("accuracy", "fifteen seeded bugs: the test of the default suite that finds each of them"),
    "quoted": ("harness", "the table of measurements in the documentation, from the recorded rows"),
    "charts": ("harness", "the pictures of all recorded rows"),
    "recorded": ("harness", "every recorded row, as Markdown tables"),
    "bounds": (
        "accuracy",
        "random problems against a dense solver: validity and tightness of certified bounds",
    ),
}


def main(arguments: Sequence[str]) -> None:
    name, *rest = arguments or ("--help",)
    if name in ("-h", "--help"):
        print("usage: python -m benchmarks NAME [options]\n")
        print("\n".join(f"  {each:12} {summary}" for each, (_, summary) in NAMES.items()))
        return
    if name not in NAMES:
        near = difflib.get_close_matches(name, NAMES, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        print(f"benchmarks: got {name!r}, wanted one of {', '.join(NAMES)}{hint}", file=sys.stderr)
        raise SystemExit(2)
    if NAMES[name][0] != "harness":  # a closed output must not end hours of measuring before the rows are written
        sys.stdout, sys.stderr = streams.Expendable(sys.stdout), streams.Expendable(sys.stderr)
    module = importlib.import_module(f"benchmarks.{NAMES[name][0]}.{name}")
    module.command.main(rest, prog_name=f"python -m benchmarks {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
