"""What annotations say of an array, its type and its axes, holds while problems are solved and looked at."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LEAST = 150  # functions whose arrays were looked at: fewer would mean that the hook found nothing

SCRIPT = """
import warnings
warnings.simplefilter("ignore")
from jaxtyping import install_import_hook
with install_import_hook("hjbjax", "array_checks.check"):
    import hjbjax as hjb
    hjb.solve  # the package loads its modules when a name is asked for
import array_checks
import jax.numpy as jnp

def swing(x, u):
    return jnp.stack([x[1], jnp.sin(x[0]) + u[0]])

def square(x, *actions):
    return x @ x

def near(x):
    return jnp.linalg.norm(x) - 0.5

grid, line, box = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (11, 12)), hjb.Grid([-1.0], [1.0], (11,)), hjb.Box([-1.0], [1.0])
problem = hjb.Problem(swing, square, box, discount=0.3)
pendulum = hjb.Problem(swing, lambda x, u: x @ x + u @ u, hjb.Box([-4.0], [4.0]), discount=1.0)
game = hjb.Problem(lambda x, u, d: u + d, square, box, disturbances=hjb.Box([-0.5], [0.5]), discount=1.0, noise=0.3)
hjb.solve(problem, grid)
hjb.solve(problem, grid, scheme=hjb.Limited(), method=hjb.PolicyIteration(hjb.Krylov()))
hjb.solve(hjb.Problem(swing, lambda x, u: 1.0, box, target=near), grid, dtype="float32")
hjb.solve(hjb.Problem(swing, None, box, stopping_cost=near), grid)
hjb.solve(hjb.Problem(swing, lambda x, u: 1.0, box, target=near), grid, scheme=hjb.SemiLagrangian())
hjb.solve(game, line)
hjb.solve_batch([problem, problem], grid)
hjb.march(problem, grid, 0.3, scheme=hjb.Weno5())
hjb.march(game, line, 0.3, method=hjb.Implicit())
answer = hjb.solve(pendulum, grid)
hjb.simulate(pendulum, answer, [0.5, 0.0], 1.0)
hjb.simulate(pendulum, hjb.greedy_feedback(pendulum, answer), [0.5, 0.0], 1.0)
hjb.pontryagin(pendulum, [0.5, 0.0], horizon=1.0)
hjb.reach_probability(hjb.Problem(swing, None, box, noise=0.5), grid, near, horizon=0.2)
hjb.geometry.reachability_distribution(*hjb.geometry.affine_fields(swing, 1), jnp.zeros(2), depth=3)
hjb.geometry.relative_degree(*hjb.geometry.affine_fields(swing, 1), lambda x: x[0], jnp.zeros(2))
hjb.stability.brockett_check(*hjb.geometry.affine_fields(swing, 1), jnp.zeros(2))
print(len(array_checks.SEEN))
"""


@pytest.mark.slow
def test_arrays_are_what_the_annotations_say():
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support"), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path}
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert int(run.stdout) >= LEAST


@pytest.mark.slow
def test_a_wrong_annotation_would_be_found(tmp_path):
    package = tmp_path / "wrong"
    package.mkdir()
    (package / "__init__.py").write_text(
        "from hjbjax.problem.types import Field, Scalar\n\n\ndef sum_of(values: Field) -> Scalar:\n    return values\n"
    )
    script = (
        "from jaxtyping import install_import_hook\n"
        'with install_import_hook("wrong", "array_checks.check"):\n    import wrong\n'
        "import jax.numpy as jnp\nwrong.sum_of(jnp.ones(3))\n"
    )
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support"), str(tmp_path)])
    run = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path}
    )
    assert run.returncode != 0
    assert "sum_of" in run.stderr
