"""Memory of compiled programs, as reported by XLA; nothing is allocated, because arrays are shapes."""

from typing import Any

import jax
import numpy as np

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import fixed_point
from hjbjax.problem.pytree import cast
from hjbjax.solvers import stationary_run
from hjbjax.solvers.setup import assumptions_of, choose, prepare


def bytes_of(lowered: Any) -> int:
    """Bytes of arguments, results and scratch of a lowered program after compiling."""
    found = lowered.compile().memory_analysis()
    total = found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes
    return int(total - found.alias_size_in_bytes)


def of_solve(problem: Any, grid: Any, tol: float, *, method: Any = None, dtype: Any = np.float64) -> dict[str, Any]:
    """Bytes per node of the loop at the finest level of a solve."""
    method = choose(problem, grid, traced=False, method=method)
    inner = method.inner if isinstance(method, hjb.Nested) else method
    kind = np.dtype(dtype)
    with jax.enable_x64(kind == np.float64):
        on = Discretisation(*cast((problem, grid), kind), hjb.Upwind(), kind)
        assumptions = assumptions_of(on)

        def begin(on):
            task = prepare(on, method=inner, tol=tol, assumptions=assumptions)
            return task, fixed_point.start(task, jax.numpy.zeros(grid.shape, kind))

        shapes = jax.eval_shape(begin, on)
        return {"bytes_per_node": bytes_of(stationary_run.run.lower(*shapes, 1)) / grid.size}
