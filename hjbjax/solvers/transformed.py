"""``solve`` inside ``jit``, ``vmap`` and ``grad``: the solution of the host, and its derivative.

Between programs the host decides which certificate holds, whether to use vanishing discounts, from which nodes a target
can be forced, which rest nodes are left, when to replace stalled sweeps by linear solves, and the order. A compiled
program could not make these decisions with the same method. It therefore calls the host, once for all lanes of a
``vmap``, and the result equals that from ``solve`` to the last bit. Derivatives do not involve the steps: they are the
derivatives of the equation that the solution satisfies, by the implicit function theorem, and are compiled.

Each lane runs as in ``solve``, on the caller's device, in float64 unless float32 was requested.
"""

import dataclasses
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.schemes import Limited, Upwind
from hjbjax.iteration import adjoint
from hjbjax.iteration.bellman import Greedy
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.fixed_point import Task
from hjbjax.iteration.methods import Method
from hjbjax.problem.grid import Grid, check_spacings
from hjbjax.problem.host_calls import call_on_host
from hjbjax.problem.problem import Problem, is_constrained, is_discounted
from hjbjax.problem.pytree import altered, cast, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Nodes, Number
from hjbjax.semi_lagrangian import arc_adjoint
from hjbjax.semi_lagrangian.arc_adjoint import ArcEquation
from hjbjax.solution.clock import Clock, Stopped, noting_interrupts
from hjbjax.solution.solution import Solution, question
from hjbjax.solution.status import Status, keeping_warnings
from hjbjax.solvers import host_loop, memory
from hjbjax.solvers.contact import contact_axes
from hjbjax.solvers.host_solve import Choices, settled_on_host
from hjbjax.solvers.result import finish
from hjbjax.solvers.semi_lagrangian import REPLACEMENT, Followed, can_replace_chain, finish_arcs
from hjbjax.solvers.setup import assumptions_of, check_on_one_state, choose, is_bare, may_raise_order, prepare

NOTHING = [[1.0, -np.inf], [1.0, np.inf]]  # an enclosure without information


@pytree_dataclass(static=("scheme", "max_steps", "time_limit", "throw", "dtype", "inner", "x64"))
class Asked:
    """The choices of a solve.

    Attributes:
      method, scheme: as in ``solve``.
      free_tol: True if the caller left the tolerance open.
      max_steps, time_limit, throw: as in ``solve``.
      dtype: the dtype of the result and its derivatives.
      inner: the floating-point type in which the host solves.
      x64: True if JAX has float64 enabled meanwhile, as the caller's functions may have been traced with it.
    """

    method: Method | None
    scheme: Scheme | None
    free_tol: bool
    max_steps: int | None
    time_limit: float | None
    throw: bool
    dtype: np.dtype
    inner: np.dtype
    x64: bool


@pytree_dataclass()
class Found:
    """The result of the host.

    Attributes:
      value: V, (*grid), at unreachable nodes a finite number above all others.
      policy: the optimal actions, and the defect of the equation under them.
      fixed, counted: bool (*grid), the nodes with prescribed values, and the nodes with a finite value.
      floor: the lower bound imposed on the values.
      code, steps: as in ``Solution``.
      sharp: True for a solution by high-order slopes.
      enclosure: as in ``Solution``; meaningless without a certificate.
      monotone_error: of the monotone solution, infinite without a certificate.
      followed: True for a solution on arcs; None if arcs are not possible.
      arc: the number of the best arc of every node, (*grid); None if arcs are not possible.
      touching: the sets ``stopping`` and ``active`` of the Solution, as far as the problem has them.
    """

    value: Any
    policy: Greedy
    fixed: Any
    counted: Any
    floor: Any
    code: Any
    steps: Any
    sharp: Any
    enclosure: Any
    monotone_error: Any
    followed: Any = None
    arc: Any = None
    touching: dict[str, Any] = dataclasses.field(default_factory=dict)


def solve_in_program(problem: Problem, grid: Grid, asked: Asked, guess: Nodes | None, tol: Number) -> Solution:
    """The solution, whose value and policy are functions of the numbers in the problem and in the grid."""
    method = choose(problem, grid, traced=True, method=asked.method).inner
    on = Discretisation(problem, grid, asked.scheme or _scheme(problem, method), asked.dtype)
    found = _on_host(asked, (problem, grid, asked.method, guess, tol), on, bare=is_bare(method))
    task = _task(on, method, tol, found)
    value, policy = _differentiable(task, on.scheme, found)
    if found.followed is not None:
        value, policy = jax.lax.cond(found.followed, lambda: _on_arcs(on, found), lambda: (value, policy))
    # a transformation drops the code, so a failure must show in the numbers; the derivative of NaN is NaN
    good = (found.code == Status.CONVERGED) if asked.throw else jnp.ones((), bool)
    value, policy = jax.tree.map(lambda leaf: leaf * jnp.where(good, 1, jnp.nan).astype(leaf.dtype), (value, policy))
    if task.has_lost:
        value = jnp.where(task.counted, value, jnp.inf)
    chain = on.scheme.monotone
    certified = chain and task.certificate not in (Certificate.NONE, Certificate.OPEN)
    controls, disturbances = policy.controls, policy.disturbances
    empty = jnp.zeros((*grid.shape, 0), asked.dtype)
    return Solution(
        grid, value, None if is_bare(method) else jnp.stack(controls, axis=-1) if controls else empty,
        jnp.stack(disturbances, axis=-1) if problem.is_game and not is_bare(method) else None,
        code=found.code, steps=found.steps,
        enclosure=found.enclosure if certified else None,
        monotone_error=None if chain else found.monotone_error,
        **found.touching,
        **question(problem),
    )  # fmt: skip


def _scheme(problem: Problem, method: Method) -> Scheme:
    """The scheme of ``choose_scheme`` as far as the structure determines it: high-order slopes, or certainly none."""
    tube = is_constrained(problem) and is_discounted(problem) is False
    return Upwind() if method.relaxes or tube else Limited()


def _task(on: Discretisation, method: Method, tol: Number, found: Found) -> Task:
    """The task that the solution solves, with tracers among its numbers, from the nodes that the host found."""
    problem, assumptions = on.problem, assumptions_of(on.chain)
    # the host has computed where the system rests, and at which cost
    plain = dataclasses.replace(assumptions, may_rest=False, costs_certify=False)
    task = prepare(on.chain, method=method, tol=tol, assumptions=plain)
    ends = problem.target is not None or assumptions.may_rest
    may_lose = ends and not is_constrained(problem) and not is_discounted(problem)
    obstacles = dataclasses.replace(task.obstacles, fixed=found.fixed)
    return dataclasses.replace(task, obstacles=obstacles, counted=found.counted, has_lost=bool(may_lose))


def _differentiable(task: Task, scheme: Scheme, found: Found) -> tuple[jax.Array, Greedy]:
    """Value and policy of the solution, as functions of the numbers in its task."""
    # impose the prescribed values again: in this dtype unreachable nodes must exceed all others
    answer = dataclasses.replace(found, value=jax.lax.stop_gradient(task).impose(found.value))

    def by(task: Task) -> tuple[jax.Array, Greedy]:
        value = adjoint.attach(task, answer)
        return value, adjoint.attach_policy(task, found.policy, value)

    if scheme.monotone:
        return by(task)
    sharp = dataclasses.replace(task, on=task.on.with_scheme(scheme), certificate=Certificate.RESIDUAL)
    if not task.constrained:
        sharp = dataclasses.replace(sharp, obstacles=dataclasses.replace(sharp.obstacles, lower=found.floor))
    return jax.lax.cond(found.sharp, lambda: by(sharp), lambda: by(task))


def _on_arcs(on: Discretisation, found: Found) -> tuple[jax.Array, Greedy]:
    """Value and policy of a solution on arcs, as functions of the numbers in the problem and in the grid."""
    on = cast(on.with_scheme(Upwind()), on.dtype)
    plan = REPLACEMENT.plan(on.problem, on.grid, on.dtype)
    legs = tuple(int(leg) for leg in plan.legs)
    equation = ArcEquation(on, plan.actions, legs, found.arc, found.fixed, found.counted)
    value = arc_adjoint.attach_arcs(found.value, equation)
    actions = jnp.asarray(plan.actions, on.dtype)[found.arc // len(legs)]
    return value, Greedy(found.policy.defect, tuple(actions[..., j] for j in range(actions.shape[-1])), ())


def _may_follow(asked: Asked, problem: Problem, grid: Grid) -> bool:
    """True if the host may solve on arcs, as far as the structure of the problem determines it."""
    return asked.method is None and asked.scheme is None and can_replace_chain(problem, grid)


def _on_host(asked: Asked, given: Any, on: Discretisation, *, bare: bool) -> Found:
    """The result of the host, lane by lane if some of its arguments are batched."""
    leaves, structure = jax.tree.flatten(given)
    # JAX keeps a float32 copy of a NumPy array that the caller's program uses, and would pass it to the host's float64
    # programs as well, so these get arrays of their own
    leaves = [jax.lax.stop_gradient(leaf) if is_traced(leaf) else _own(leaf) for leaf in leaves]
    varying = [i for i, leaf in enumerate(leaves) if is_traced(leaf)]
    ranks = [jnp.ndim(leaves[i]) for i in varying]
    like = _shapes(on, may_follow=_may_follow(asked, on.problem, on.grid), bare=bare)
    setting = host_loop.setting("jax_default_device")

    def all_lanes(*arrays: np.ndarray) -> Found:
        clock = Clock(asked.max_steps or 10**9, asked.time_limit, progress=False)

        def one(*numbers: np.ndarray) -> Found:
            mine = list(leaves)
            for i, number in zip(varying, numbers, strict=True):
                mine[i] = number
            with jax.default_device(setting):
                return _solved(asked, clock.beside_from_now(), *jax.tree.unflatten(structure, mine))

        with noting_interrupts(clock):
            found = _in_lanes(one, arrays, ranks)
        if clock.interrupted:  # the caller would otherwise go on with NaN
            raise KeyboardInterrupt
        return found

    return call_on_host(all_lanes, like, *(leaves[i] for i in varying), vmap_method="expand_dims")


def _own(leaf: Any) -> Any:
    """A copy of a NumPy array; anything else is unchanged."""
    return leaf.copy() if isinstance(leaf, np.ndarray) else leaf


def _shapes(on: Discretisation, *, may_follow: bool, bare: bool) -> Found:
    """The shapes and dtypes of the host's result; ``may_follow``: it may be a solution on arcs; ``bare``: only V."""
    shape, inputs = on.grid.shape, (on.problem.controls, on.problem.disturbances)

    def array(*axes: int, dtype: Any = on.dtype) -> Any:
        return jax.ShapeDtypeStruct(axes, dtype)

    players = (tuple(array(*shape) for _ in range(0 if each is None else each.dim)) for each in inputs)
    mask, number, count = array(*shape, dtype=np.dtype(bool)), array(), array(dtype=np.dtype(np.int32))
    return Found(
        array(*shape), Greedy(array(*shape), *players), mask, mask, number, count, count,
        array(dtype=np.dtype(bool)), array(2, 2), number,
        array(dtype=np.dtype(bool)) if may_follow else None, array(*shape, dtype=count.dtype) if may_follow else None,
        {} if bare else {name: array(*shape, *p, dtype=mask.dtype) for name, p in contact_axes(on.problem).items()},
    )  # fmt: skip


def _in_lanes(one: Callable[..., Found], arrays: tuple[np.ndarray, ...], ranks: list[int]) -> Found:
    """The results of all lanes, with their axes in front; in parallel if there are several cores."""
    fronts = [array.shape[: array.ndim - rank] for array, rank in zip(arrays, ranks, strict=True)]
    front = np.broadcast_shapes(*fronts)
    rows = [np.broadcast_to(array, front + array.shape[len(own) :]) for array, own in zip(arrays, fronts, strict=True)]
    lanes = list(np.ndindex(front))
    settings = host_loop.settings()

    def lane(index: tuple[int, ...]) -> Found:
        with settings():
            return one(*(row[index] for row in rows))

    found = [one(*(row[index] for row in rows)) for index in lanes[:1]]  # first on its own, to compile for the others
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if cores > 1 and len(lanes) > 2:
        with ThreadPoolExecutor(cores) as pool:
            found += pool.map(lane, lanes[1:])
    else:
        found += [one(*(row[index] for row in rows)) for index in lanes[1:]]
    return jax.tree.map(lambda *leaves: np.reshape(np.stack(leaves), front + np.shape(leaves[0])), *found)


def _solved(
    asked: Asked, clock: Clock, problem: Problem, grid: Grid, method: Method | None, guess: Nodes | None, tol: Number
) -> Found:
    """The result of one lane, in NumPy; its warnings are dropped, because the user's line is not on the stack."""
    with own_settings(x64=asked.x64), keeping_warnings():
        check_spacings(grid, asked.inner)
        free = method is None
        choices = Choices(scheme=asked.scheme is None, method=free, levels=free, tol=asked.free_tol)
        may_follow = _may_follow(asked, problem, grid)
        method = choose(problem, grid, traced=False, method=method)
        on = Discretisation(problem, grid, asked.scheme or Upwind(subcell=True), asked.inner)
        check_on_one_state(problem, grid, on.scheme)
        memory.require(
            problem, grid, method, asked.inner, None, high_order=may_raise_order(problem, method, asked.scheme)
        )
        try:
            settled, _ = settled_on_host(on, method, float(tol), guess, clock, choices)
        except Stopped as stop:
            like = _shapes(
                dataclasses.replace(on, dtype=asked.inner), may_follow=may_follow, bare=is_bare(method.inner)
            )
            nothing = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), like)
            return altered(nothing, code=np.int32(stop.status), enclosure=np.array(NOTHING))
        if isinstance(settled, Followed):
            return _found_on_arcs(settled)
        solution = finish(settled, grid)
    task, state = settled.task, jax.device_get(settled.state)
    error = solution.error if settled.origin is None else solution.monotone_error
    lower, least = task.obstacles.lower, np.finfo(asked.dtype).min / 8
    floor = least if lower is None or np.ndim(lower) else max(float(lower), least)
    return Found(
        value=np.asarray(state.value),
        policy=jax.tree.map(lambda leaf: np.broadcast_to(leaf, grid.shape), _whole(state.policy, problem)),
        fixed=np.broadcast_to(np.asarray(task.obstacles.fixed), grid.shape),
        counted=np.broadcast_to(np.asarray(task.counted), grid.shape),
        floor=np.asarray(floor),
        code=np.int32(solution.code),
        steps=np.int32(solution.steps),
        sharp=np.asarray(not task.scheme.monotone),
        enclosure=np.asarray(NOTHING if solution.enclosure is None else solution.enclosure),
        monotone_error=np.asarray(np.inf if error is None else error),
        followed=np.asarray(False) if may_follow else None,
        arc=np.zeros(grid.shape, np.int32) if may_follow else None,
        touching={} if is_bare(method.inner) else _touching(solution, problem),
    )


def _touching(solution: Solution, problem: Problem) -> dict[str, np.ndarray]:
    """The sets of the solution that the problem has; empty sets if the solve failed."""
    axes, found = contact_axes(problem), {}
    for name, more in axes.items():
        mask = getattr(solution, name)
        found[name] = np.zeros(solution.grid.shape + more, bool) if mask is None else mask
    return found


def _found_on_arcs(followed: Followed) -> Found:
    """A solution on arcs, in NumPy."""
    solution, task, state = finish_arcs(followed), followed.task, jax.device_get(followed.state)
    counted = np.asarray(task.counted)
    policy: Any = np.where(np.isnan(solution.policy), 0, solution.policy)
    no_defect: Any = np.zeros(counted.shape)
    return Found(
        value=np.where(counted, solution.value, 0),
        policy=Greedy(no_defect, tuple(policy[..., j] for j in range(policy.shape[-1])), ()),
        fixed=np.asarray(task.obstacles.fixed) | ~counted,
        counted=counted,
        floor=np.asarray(np.finfo(solution.value.dtype).min / 8),
        code=np.int32(solution.code),
        steps=np.int32(solution.steps),
        sharp=np.asarray(False),
        enclosure=np.asarray(NOTHING if solution.enclosure is None else solution.enclosure),
        monotone_error=np.asarray(np.inf if solution.error is None else solution.error),
        followed=np.asarray(True),
        arc=np.asarray(state.number),
        touching=_touching(solution, followed.on.problem),
    )


def _whole(policy: Greedy, problem: Problem) -> Greedy:
    """The policy with an array of zeros for every action that was not stored."""
    kept: list[tuple[Any, ...]] = []
    for actions, admissible in (
        (policy.controls, problem.controls),
        (policy.disturbances, problem.disturbances),
    ):
        count = 0 if admissible is None else admissible.dim
        kept.append(tuple(actions) if len(actions) == count else (np.zeros(()),) * count)
    return Greedy(policy.defect, *kept)
