"""A launcher of cheap children, as a script without JAX: it prints ``ready``, and at its end what became of them.

The first argument is JSON: ``children``, the Python code of each, and optionally ``follow``, true for children that
follow their launcher, ``grace``, ``settle`` and ``patience`` in seconds, ``farewell``, ``arrival``, its words and
seconds, ``broken``, true for a last child that cannot be started, and ``ignored``, the names of signals that the
launcher ignores. Each child finds its number in ``sys.argv[-1]`` and the functions of ``PRELUDE``.
"""

import dataclasses
import importlib.util
import json
import math
import os
import signal
import sys
from pathlib import Path

FILE = Path(__file__).parents[2] / "hjbjax" / "cli" / "children.py"
PRELUDE = """
import os, signal, sys, time
number = sys.argv[-1]
def up():
    os.replace(os.open(f"{number}.new", os.O_CREAT) and f"{number}.new", f"up-{number}-{os.getpid()}")
def on_request(code):
    def end(*_):
        open(f"kept-{number}", "w").close()
        os._exit(code)
    signal.signal(signal.SIGTERM, end)
"""


def children_module():
    """``hjbjax.cli.children`` without the package around it, whose import takes a second."""
    spec = importlib.util.spec_from_file_location("children", FILE)
    module = sys.modules["children"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main():
    asked, children = json.loads(sys.argv[1]), children_module()
    for number in children.SIGNALS:  # tests that run in the background ignore some
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in asked.get("ignored", ()):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    children.GRACE, children.SETTLE = asked.get("grace", children.GRACE), asked.get("settle", children.SETTLE)
    commands = []
    scripts = Path.cwd() / "scripts"
    scripts.mkdir()
    sys.path.append(str(scripts))
    for number, code in enumerate(asked["children"]):
        script = scripts / f"child{number}.py"
        script.write_text(PRELUDE + code)
        if asked.get("follow"):
            commands.append(children.followed(script.stem, [str(number)], os.environ))
        else:
            commands.append(children.Command([sys.executable, "-IS", str(script), str(number)], os.environ))
    if asked.get("broken"):
        commands.append(children.Command(["/no/such/program"], os.environ))
    print("ready", flush=True)
    try:
        words, seconds = asked.get("arrival", ("", math.inf))
        outcome = children.run_children(
            commands,
            [2, 3, 4, 130],
            [b"[muted]"],
            asked.get("patience", math.inf),
            asked.get("farewell", "").encode(),
            (words.encode(), seconds),
        )
    except OSError as error:
        print(json.dumps({"error": str(error)}))
    else:
        culprit = outcome.culprit and outcome.culprit.number
        found = {**dataclasses.asdict(outcome), "culprit": culprit, "unwritten": repr(outcome.unwritten)}
        print(json.dumps(found), file=sys.stdout if outcome.unwritten is None else sys.stderr)
        if outcome.unwritten is not None:
            os._exit(0)


if __name__ == "__main__":
    main()
