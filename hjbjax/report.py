"""From a state of the iteration to a Solution: NumPy arrays, masks, the Isaacs gap, the message."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import certificates, hamiltonian, players
from hjbjax.certificates import Certificate
from hjbjax.grid import Grid
from hjbjax.iteration import Method, Nested, PolicyIteration, State, Task
from hjbjax.preparation import SolveWarning, Verdict
from hjbjax.problem import Problem
from hjbjax.pytree import is_traced
from hjbjax.sets import Finite
from hjbjax.solution import Solution
from hjbjax.status import Status


def finish(
    task: Task,
    state: State,
    code: Status,
    reached: np.ndarray | None,
    residuals: np.ndarray,
    verdict: Verdict,
    grid: Grid,
) -> Solution:
    """The solution in NumPy, with infinite values where the target cannot be reached and no policy where none is."""
    gap = _isaacs_gap(task, state)
    state = jax.device_get(state)
    solution = assemble(task, state, verdict)
    lost = ~np.asarray(task.counted)
    arrays = {name: getattr(solution, name) for name in ("value", "policy", "disturbance")}
    arrays = {name: None if array is None else np.require(array, requirements="W") for name, array in arrays.items()}
    arrays["value"][lost] = np.inf
    idle = lost | np.asarray(task.rules.ended)
    for array in (arrays["policy"], arrays["disturbance"]):
        if array is not None:
            array[idle] = np.nan
    return Solution(
        **arrays,
        enclosure=solution.enclosure,
        grid=grid,
        code=int(code),
        steps=max(int(state.step), 0),
        isaacs_gap=gap,
        reached=reached,
        discrete=solution.discrete,
        discrete_disturbance=solution.discrete_disturbance,
        residuals=residuals,
        message=_message(code, task, state, residuals),
        stats={
            "scheme": repr(task.scheme),
            "device": str(jax.devices()[0].device_kind),
            "dtype": str(state.value.dtype),
            "certificate": verdict.sentence,
            "versions": {"jax": jax.__version__, "numpy": np.__version__},
        },
    )


def assemble(task: Task, state: State, verdict: Verdict) -> Solution:
    """The solution as it stands in the state; pure."""
    problem = task.problem
    controls, disturbances = state.policy.controls, state.policy.disturbances
    xp: Any = jnp if is_traced(state) else np
    return Solution(
        value=state.value,
        policy=xp.stack(controls, axis=-1) if controls else xp.zeros((*task.grid.shape, 0), state.value.dtype),
        disturbance=xp.stack(disturbances, axis=-1) if problem.is_game else None,
        code=state.code,
        steps=state.step,
        enclosure=certificates.enclosure(verdict.certificate, state.gap),
        grid=task.grid,
        discrete=isinstance(problem.controls, Finite),
        discrete_disturbance=isinstance(problem.disturbances, Finite),
    )


@jax.jit
def _gap_at(task: Task, value: jax.Array) -> tuple[jax.Array, jax.Array]:
    """max over the nodes of min max − max min, and the size of H and of the cost, at one value function."""
    how = players.setting(task.problem, task.grid.ndim, value.dtype)
    here = hamiltonian.local(task.problem, task.grid, value, scheme=task.scheme)
    upper = hamiltonian.optimise(here, how, isaacs="upper")[0]
    lower = hamiltonian.optimise(here, how, isaacs="lower")[0]
    nowhere = hamiltonian.local(task.problem, task.grid, jnp.zeros_like(value), scheme=task.scheme)
    cost = hamiltonian.optimise(nowhere, how)[0]
    free = task.counted & ~task.rules.held
    size = jnp.abs(upper) + jnp.abs(cost) + jnp.finfo(value.dtype).eps
    return jnp.max(jnp.where(free, upper - lower, 0)), jnp.max(jnp.where(free, size, 0))


def _isaacs_gap(task: Task, state: State) -> float | None:
    if not task.problem.is_game:
        return None
    gap, size = (float(number) for number in _gap_at(task, state.value))
    if gap > 0.05 * size:
        warnings.warn(
            f"the Isaacs condition fails: min max and max min of the Hamiltonian differ by up to {gap:.3g} per unit "
            f"time; the value is the {task.problem.isaacs} one, isaacs= gives the other",
            SolveWarning,
            stacklevel=4,
        )
    return gap


def _message(code: Status, task: Task, state: State, residuals: np.ndarray) -> str:
    best, tol = float(state.best[0]), float(task.tol)
    if code is Status.STALLED and np.isfinite(best):
        return f"{code.message} The smallest error was {best:.2g}: a tolerance of {2 * best:.2g} is within reach."
    if code is Status.CONVERGED and task.certificate is Certificate.NONE:
        return f"Residual and last step are at most {tol:.2g}; no certificate bounds the error."
    if code is Status.CONVERGED and task.certificate is Certificate.RESIDUAL:
        return f"Residual of the second-order equation and last step are at most {tol:.2g} in cost units."
    return code.message


def describe(method: Method, problem: Problem) -> str:
    """The method as one would write it, without what the problem does not use."""
    if isinstance(method, Nested):
        return f"Nested({describe(method.inner, problem)})"
    if isinstance(method, PolicyIteration):
        game = f", replies={method.replies}" if problem.is_game else ""
        return f"PolicyIteration({method.evaluation!r}{game})"
    return repr(method)
