"""One problem over many devices: the answer of one, to the last bits where the sweeps are the same.

Eight virtual devices require a separate process. It runs all requested cases of one group.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import xla

from hjbjax.cli import launch

SCRIPT = Path(__file__).parents[1] / "support" / "over_devices.py"
ROOT = Path(__file__).parents[2]
CHEAP = (
    "not_a_number_is_not_lost", "compiled_program", "value_iteration", "sweeps", "checkpoints", "faults", "refusals",
    "bytes_per_device",
)  # fmt: skip
DEAR = (
    "stencils", "batch", "two_integrators", "march_of_first_order",
    "value_alone", "value_iteration_to_a_target", "value_iteration_of_a_game", "value_iteration_with_correlated_noise",
    "march_of_the_value_alone", "march_of_second_order", "march_of_fifth_order", "sweeps_of_flat_parts",
    "sweeps_in_slabs", "sweeps_to_a_target", "sweeps_of_a_game", "krylov", "krylov_with_correlated_noise",
    "krylov_with_modes", "krylov_with_switching_costs", "krylov_with_pushes", "sweeps_with_switching_costs",
    "march_with_switching_costs", "implicit_march", "open_ends", "without_a_choice", "three_integrators",
)  # fmt: skip
EXACT = ("value_iteration", "march_of_first_order", *(name for name in DEAR if name.startswith(("value", "march"))))
TO_A_TOLERANCE = (
    *(name for name in DEAR if name.startswith(("sweeps", "krylov"))), "implicit_march", "open_ends", "without_a_choice"
)  # fmt: skip
CERTIFIED = ("sweeps", *(name for name in DEAR if name.startswith(("sweeps", "krylov"))))
ULP = 8  # roundings of the largest value: XLA fuses the same operations otherwise in a smaller array


def found_by(names, emitters=True):
    """What these cases found, by their names.

    The new emitters of fusions round alike in arrays of any shape. The old ones compile faster.
    """
    flags = os.environ["XLA_FLAGS"]
    flags = flags.replace(xla.OLD_EMITTERS, "") if emitters else flags
    path = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_NUM_CPU_DEVICES": "8", "PYTHONPATH": path}
    command = [sys.executable, str(SCRIPT), *names]
    answer = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert answer.returncode == 0, answer.stderr
    return json.loads(answer.stdout)


@pytest.fixture(scope="module")
def cheap():
    return found_by(CHEAP)


@pytest.fixture(scope="module")
def dear():
    return found_by([name for name in DEAR if name not in TO_A_TOLERANCE])


@pytest.fixture(scope="module")
def to_a_tolerance():
    return found_by(TO_A_TOLERANCE, emitters=False)


@pytest.fixture
def found(request):
    """What the case of a test found."""
    name = request.node.callspec.params.get("name") if hasattr(request.node, "callspec") else None
    name = name or request.node.originalname.removeprefix("test_")
    group = "cheap" if name in CHEAP else "to_a_tolerance" if name in TO_A_TOLERANCE else "dear"
    answer = request.getfixturevalue(group)[name]
    assert "failed" not in answer, answer["failed"]
    return answer


def slow_if_dear(names):
    """The names as parameters, the dear ones marked."""
    return [pytest.param(name, marks=pytest.mark.slow) if name in DEAR else name for name in names]


@pytest.mark.slow
def test_stencils(found):
    """All that is read of other nodes is read alike across the seams between parts, and all reductions are exact."""
    assert len(found) == 36
    assert {name: apart for name, apart in found.items() if apart > 0} == {}


def test_not_a_number_is_not_lost(found):
    assert found == [True, True]


def test_compiled_program(found):
    """Two permutes for every divided axis in a step, no collecting, and at the end only what the actions depend on.

    The torque depends on the slope along the second axis, which eight devices in a row do not divide.
    """
    assert found["8"]["collective-permute"] == 2
    assert found["4x2"]["collective-permute"] == 2 * 2 + 2
    for counts in found.values():
        assert counts["all-gather"] == counts["all-to-all"] == 0
        assert counts["all-reduce"] > 0


@pytest.mark.parametrize("name", slow_if_dear(EXACT))
def test_the_same_sweeps_give_the_same_value(found, name):
    for mesh in found:
        assert mesh["same"]
        assert mesh["ulp"] <= ULP


@pytest.mark.parametrize("name", slow_if_dear(CERTIFIED))
def test_certificates_hold_on_every_mesh(found, name):
    for mesh in found:
        assert mesh["status"] == ["CONVERGED", "CONVERGED"]
        assert mesh["alike"]  # where the value is infinite
        assert max(mesh["errors"]) <= 1e-6
        assert mesh["apart"] <= sum(mesh["errors"])
        one, many = mesh["steps"]
        # slabs exchange twice an order in place of three times
        assert many <= (1.5 if name == "sweeps_in_slabs" else 1.2) * one + 2


@pytest.mark.parametrize("name", slow_if_dear(["two_integrators", "three_integrators"]))
def test_the_value_of_systems_side_by_side_is_the_sum_of_theirs(found, name):
    """4096 nodes in four dimensions, 8^6 in six: at every node the sum of values in the plane (see ``decoupled``)."""
    assert found["status"] == "CONVERGED"
    assert found["apart"] <= sum(found["errors"])
    assert max(found["errors"]) <= 1e-2
    assert found["ulp"] <= ULP


@pytest.mark.slow
def test_batch(found):
    """Eleven lanes on eight devices, one of which fails, as each by itself."""
    for mesh in found:
        assert [lane for lane, status in enumerate(mesh["status"]) if status != "CONVERGED"] == [5]
        assert mesh["status"][5] == "NONFINITE"
        alone, spread = mesh["steps"]
        assert spread == alone
        assert len(set(alone)) > 2
        assert mesh["residuals"]
        assert mesh["ulp"] <= ULP


BATCH = """
import sys
import jax, numpy as np, hjbjax as hjb

jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(sys.argv[1], 2, int(sys.argv[2]), heartbeat_timeout_seconds=30)
grid = hjb.Grid([-1.0], [1.0], (41,))
lanes = [
    hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-1.0], [1.0]), discount=b) for b in (9.0, 1.0, 0.1)
]
options = {"scheme": hjb.Upwind(), "tol": 1e-6}
alone = hjb.solve_batch(lanes, grid, **options)
spread = hjb.solve_batch(lanes, grid, mesh=jax.make_mesh((2,), ("lanes",)), **options)
assert [each.steps for each in alone] == [each.steps for each in spread]
print(max(float(np.max(np.abs(a.value - b.value)) / np.max(b.value)) for a, b in zip(alone, spread)), flush=True)
jax.distributed.shutdown()
"""


@pytest.mark.slow
def test_a_batch_over_two_processes():
    """Each process has lanes of its own, and the answers of all of them."""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    with launch.reserved_port() as port:
        running = []
        for rank in range(2):
            command = [sys.executable, "-c", BATCH, f"127.0.0.1:{port}", str(rank)]
            running.append(subprocess.Popen(command, env=environment, stdout=-1, stderr=-1, text=True))
        for process in running:
            said, err = process.communicate(timeout=300)
            assert process.returncode == 0, err
            assert float(said.split()[-1]) <= ULP * 2.3e-16


def test_bytes_per_device(found):
    """Checks, preparation and survey are divided like the steps: an eighth, and the shared numbers."""
    one, eight = found
    assert set(one) == set(eight) == {"_actions_pass", "_prepare_jit", "_more_open_jumps"}
    for name, alone in one.items():
        assert alone > 9_000  # an array of all nodes, at least
        assert eight[name] < alone / 6


def test_checkpoints(found):
    """What eight devices began goes on on two, and on one."""
    for mesh in found:
        assert (mesh["steps"], mesh["residuals"]) == (40, 41)
        assert mesh["apart"] <= 1e-15


def test_faults(found):
    """A value that is not finite in one part stops them all, at the same step, and the last finite one is kept."""
    assert found[:2] == ["NONFINITE", "NONFINITE"]
    assert found[2] == found[3]
    assert found[4]


def test_refusals(found):
    wanted = {
        "no mesh": ("TypeError: solve: mesh is 8", "jax.make_mesh"),
        "axes": ("ValueError: solve: got a mesh of 3 axes", "wanted at most 2"),
        "few points": ("ValueError: solve: mesh divides the 23 points of axis 0 into 8 parts", "at most 7 parts"),
        "paths": ("ValueError: solve: SemiLagrangian", "leave out mesh"),
        "direct": ("ValueError: solve: PolicyIteration(evaluation=Direct()", "leave out mesh"),
        "direct in time": ("ValueError: march: Direct()", "leave out mesh"),
        "traced": ("ValueError: solve: mesh divides the nodes at host level only", "jit"),
        "traced march": ("ValueError: march: mesh divides the nodes at host level only", "jit"),
        "host": ("ValueError: solve: a function of the problem calls Python on the host", "leave out mesh"),
        "jumps": ("ValueError: solve: got a mesh and a problem with jumps", "Leave out mesh"),
        "pushes": ("ValueError: solve: mesh divides axis 0, along which the problem has pushes", "Divide other axes"),
        "pushes in modes": ("ValueError: solve: mesh divides axis 1, along which", "Divide other axes"),
        "no mesh of lanes": ("TypeError: solve_batch: mesh is 8", "jax.make_mesh"),
        "lanes to a file": ("ValueError: solve_batch: checkpoint= is not supported together with mesh=", "only one"),
        "lanes by the host": ("ValueError: solve_batch: a function of the problem calls Python on", "leave out mesh"),
        "direct lanes": ("ValueError: solve_batch: PolicyIteration(evaluation=Direct()", "leave out mesh"),
    }
    assert set(found) == set(wanted)
    for name, (start, way_out) in wanted.items():
        assert found[name].startswith(start)
        assert way_out in found[name]
        assert len(found[name].splitlines()) <= 6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["implicit_march", "open_ends"])
def test_linear_solves_go_on_to_their_tolerance(found, name):
    status, one, many, apart = found
    assert status == "CONVERGED"
    assert many <= one + 2
    assert apart <= 1e-7


@pytest.mark.slow
def test_without_a_choice(found):
    """Nested grids, of which the coarsest is too small for its parts, second order, and the error of the grid."""
    assert found["status"] == "CONVERGED"
    assert found["scheme"].startswith("Limited")
    assert found["levels"][0] == found["levels"][1]
    assert found["apart"] <= 2e-3
    one, many = found["error of the grid"]
    assert many == pytest.approx(one, rel=0.05)
