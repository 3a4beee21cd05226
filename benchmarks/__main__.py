"""``python -m benchmarks NAME [options]`` runs one benchmark; without a name it lists them.

A benchmark is a file of ``speed`` or ``accuracy`` with a click command called ``command``; ``NAMES`` says in which.
"""

import difflib
import importlib
import sys
from collections.abc import Sequence

from hjbjax.problem import streams

NAMES = {
    "accuracy": ("accuracy", "errors, orders and seconds over the zoo's problems with known answers"),
    "estimates": ("accuracy", "the estimated error of the grid beside the true one, over the same problems"),
    "sweep": ("speed", "node-controls per second of one sweep, against numba and the copy bandwidth"),
    "peers": ("speed", "a certified solve beside QuantEcon, mdpsolver and a hand-written numba solver"),
    "growth": ("speed", "seconds, steps and bytes a node of certified solves on finer and finer grids"),
    "scaling": ("speed", "the N^n law: seconds, steps and bytes a node in one to six dimensions"),
    "controls": ("speed", "seconds against the number of controls and against the error: O(1/ε^{2n+m}) and less"),
    "information": ("speed", "nodes, bytes and seconds of beliefs on grids, beside the counts of section 13.2"),
    "batch": ("speed", "solve_batch of pendulums of different mass, against one after the other"),
    "devices": ("speed", "one problem over two devices of a processor beside one, and outer steps on eight"),
    "gradients": ("speed", "value and gradient of a solve beside the value, and beside central differences"),
    "startup": ("speed", "the first answer of a process: importing, compiling, pictures; cold and with the cache"),
    "precision": ("accuracy", "error against seconds: what second order is worth"),
    "march": ("speed", "marching beside hj_reachability: seconds and bytes at equal scheme"),
    "memory": ("accuracy", "what was told of the memory beforehand, beside the peaks of processes of their own"),
    "mutants": ("accuracy", "fifteen seeded bugs, one after the other: which test of the default suite finds each"),
    "quoted": ("harness", "the table of what was seen, from the recorded rows"),
    "recorded": ("harness", "every recorded row, as Markdown tables"),
    "bounds": (
        "accuracy",
        "random problems beside a dense solver: which certified bounds hold, and how tight they are",
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
    if NAMES[name][0] != "harness":  # a table that nobody reads must not end hours of measuring before they are written
        sys.stdout, sys.stderr = streams.Expendable(sys.stdout), streams.Expendable(sys.stderr)
    module = importlib.import_module(f"benchmarks.{NAMES[name][0]}.{name}")
    module.command.main(rest, prog_name=f"python -m benchmarks {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
