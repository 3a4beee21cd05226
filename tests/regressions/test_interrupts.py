"""Ctrl-C at random moments of every long run, in a process of its own: it ends, with what there is.

The child works through tasks and prints a line before and after each one; a thread of it, in place of a hand, sends
the signal at a random moment. Functions are made anew for every task, so that the moment may fall into checks,
compilations, or steps alike. How long a run may go on after the signal: what is running in XLA is seen to its end, at
most one compilation or one chunk of steps. So the bound is the longest compilation that JAX's own log tells of in this
very run, on whatever machine, and a chunk, and a little for Python.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LATE = 5.0  # seconds: a chunk is half a second by the pace of the one before, and a program is traced before it is
# compiled, which takes as long again; on a machine that others use, too

CHILD = r"""
import json, logging, os, random, signal, sys, threading, time, warnings
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
seed, count = int(sys.argv[1]), int(sys.argv[2])
import jax, jax.numpy as jnp, numpy as np
import hjbjax as hjb
from hjbjax.solution import clock
warnings.simplefilter("ignore")

compiled = []  # when each compilation ended, and its seconds
class Notes(logging.Handler):
    def emit(self, record):
        words = record.getMessage().split()
        if "XLA" in words and words[-1] == "sec":
            compiled.append((time.perf_counter(), float(words[-2])))
logging.getLogger("jax._src.dispatch").addHandler(Notes())
logging.getLogger("jax._src.dispatch").propagate = False
jax.config.update("jax_log_compiles", True)

U, GRID = hjb.Box([-1.0], [1.0]), hjb.Grid([-1.0, -1.0], [1.0, 1.0], (41, 41))

def question(**more):
    def drift(x, u): return jnp.stack([x[1], u[0]])
    def cost(x, u): return 1.0 + x @ x
    return hjb.Problem(drift, cost, U, **({"discount": 1e-4} | more))

def disc(x): return jnp.linalg.norm(x) - 0.3

def solve():
    return hjb.solve(question(), GRID, method=hjb.ValueIteration(), tol=1e-12)

def to_target():
    fine = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (401, 401))  # without noise it is there within seconds
    noisy = question(discount=0.0, target=disc, noise=0.5)
    return hjb.solve(noisy, fine, tol=1e-14, max_steps=10**8, method=hjb.ValueIteration())

def march():
    return hjb.march(question(discount=0.0), GRID, 1e5, times=np.linspace(0, 1e5, 11))

def batch():
    problems = [question(discount=10.0**-k) for k in (0, 4, 5)]
    shared = [hjb.Problem(problems[0].drift, problems[0].cost, U, discount=p.discount) for p in problems]
    return hjb.solve_batch(shared, GRID, method=hjb.ValueIteration(), tol=1e-12)

def extremal():
    def drift(x, u): return jnp.stack([x[1], u[0]])
    problem = hjb.Problem(drift, lambda x, u: 1.0, U)
    while True:
        hjb.pontryagin(problem, np.array([random.uniform(1, 2), 0.0]), terminal=[0.0, 0.0])

def level():
    plant = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-4.0], [4.0]))
    wide = hjb.Box([-4.0], [4.0])
    grid = hjb.Grid([-1.0], [1.0], (21,))
    while True:
        hjb.hinf_level(lambda gamma: hjb.attenuation(plant, gamma, wide), grid, 0.5, 1.0, tol=1e-9, horizon=1e3)

def path():
    def drift(x, u): return jnp.stack([x[1], u[0]])
    def feedback(x): return -jnp.sign(x[:1] + x[1:] * jnp.abs(x[1:]))
    problem = hjb.Problem(drift, None, hjb.Box([-1.0], [1.0]))
    return hjb.simulate(problem, feedback, [1.0, 0.0], 1e6, steps=10**5, max_steps=10**9)

TASKS = [solve, to_target, march, batch, extremal, level, path]
random.seed(seed)
for number in range(count):
    task = TASKS[number % len(TASKS)]
    pressed = []
    def press(wait):
        while not clock._running:  # before that Python's own exception is right
            time.sleep(0.001)
        time.sleep(wait)
        pressed.append(time.perf_counter())
        os.kill(os.getpid(), signal.SIGINT)
    hand = threading.Thread(target=press, args=(random.choice([0.1, 1.0, 3.0, 6.0]) * random.random(),))
    row = {"task": task.__name__}
    hand.start()
    try:
        task()
        row["how"] = "returned"
    except hjb.SolveError as error:
        row["how"] = "SolveError"
        row["message"] = str(error)[:300]
        found = error.solution
        row["status"] = None if found is None else str(found.status)
        if hasattr(found, "steps"):
            row["steps"] = int(found.steps)
            row["finite"] = bool(np.all(np.isfinite(found.value)))
        if hasattr(found, "trials"):
            row["trials"] = len(found.trials)
        row["lanes"] = len(error.solutions)
    except KeyboardInterrupt as error:
        row["how"] = "KeyboardInterrupt"
        row["message"] = str(error)
        row["finite"] = hasattr(error, "path") and bool(np.all(np.isfinite(error.path.states)))
    ended = time.perf_counter()
    try:
        hand.join()
    except KeyboardInterrupt:
        row["how"] += " before the signal"
    ends = [(when, seconds) for when, seconds in compiled if when > pressed[0] and seconds > 0.2]
    row["late"] = ended - max([pressed[0], *(when for when, _ in ends[:1])])
    row["followed"] = sum(seconds > 1.0 for _, seconds in ends[1:])
    print(json.dumps(row), flush=True)
"""


def interrupted(seed, count):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", CHILD, str(seed), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=900)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "Exception ignored" not in done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def check(rows, count):
    assert len(rows) == count
    for row in rows:
        assert row["how"] == ("KeyboardInterrupt" if row["task"] == "path" else "SolveError"), row
        assert "interrupted" in row["message"].lower(), row
        assert row["followed"] == 0, row
        assert row["late"] < LATE, row
        if row["task"] == "batch":
            assert row["lanes"] == 3
        if row["task"] == "level":
            assert row["trials"] > 0
        elif row["task"] != "extremal":
            assert row["finite"] or any(
                words in row["message"] for words in ("did not leave", "before the path began")
            ), row


@pytest.mark.slow
def test_thirty_five_interrupts_at_random_moments():
    """The seed is another one every time, and stands in what fails."""
    seed = int.from_bytes(os.urandom(4), "big")
    rows = interrupted(seed, 35)
    check(rows, 35)
    assert {row["task"] for row in rows} == {"solve", "to_target", "march", "batch", "extremal", "level", "path"}
