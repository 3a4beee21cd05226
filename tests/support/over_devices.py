"""Solves and marches on eight virtual devices beside the same on one: a script, as a process begins with its devices.

``JAX_NUM_CPU_DEVICES=8 python over_devices.py CASE ...`` prints one JSON object: the findings of each case, or how it
failed. ``tests/solvers/test_mesh.py`` reads it.
"""

import contextlib
import dataclasses
import functools
import json
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

import hjbjax as hjb
from hjbjax.discretisation import slopes, stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import gauss_seidel
from hjbjax.problem.grid import placed
from hjbjax.problem.layouts import Parts
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.stretching import Sinh
from hjbjax.solvers import setup, stationary_run
from hjbjax.well_posedness import attainability, node_checks

RAN, FOUND = {}, {}


def case(function):
    """Decorator: a case by its name."""
    RAN[function.__name__] = function
    return function


def mesh_of(*shape):
    """A mesh of the first devices."""
    return Mesh(np.array(jax.devices()[: int(np.prod(shape))]).reshape(shape), ("a", "b", "c")[: len(shape)])


def swing(x, u):
    return jnp.stack([x[1], jnp.sin(x[0]) + 2 * u[0]])


def effort(x, u):
    return 1 - jnp.cos(x[0]) + 0.1 * x[1] ** 2 + 0.1 * u @ u


U = hjb.Box([-1.0], [1.0])
ANGLE = hjb.Grid([-np.pi, -3.0], [np.pi, 3.0], (42, 29), periodic=(True, False))  # 8 does not divide 42, nor 2 29
FLAT = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (32, 31))
ROOM = hjb.Grid([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi], (15, 14, 12), periodic=(False, False, True))
PLAIN = hjb.Problem(swing, effort, U, discount=0.5)
TARGET = hjb.Problem(
    lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: 1.0, U, target=lambda x: jnp.linalg.norm(x) - 0.7
)
CHASE = hjb.Problem(  # a game with a target, and noise along one axis
    lambda x, u, d: jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]) + d[0], u[0]]), lambda x, u, d: 1.0, U,
    disturbances=hjb.Box([-0.3], [0.3]), noise=np.array([0.5, 0.0, 0.0]),
    target=lambda x: jnp.hypot(x[0], x[1]) - 0.6, discount=0.3,
)  # fmt: skip
SHAKEN = hjb.Problem(swing, effort, U, noise=0.6, discount=0.5)
SKEW = hjb.Problem(swing, effort, U, noise=np.array([[0.5, 0.0], [0.2, 0.4]]), discount=0.5)
MODES = hjb.Problem(
    lambda x, u, mode: swing(x, (1.0, 0.2, 0.0)[mode] * u), lambda x, u, mode: effort(x, u) + 0.1 * mode, U, noise=0.6,
    discount=0.5, modes=hjb.Modes(("whole", "weak", "lost"), rates=[[0, 0.3, 0.1], [0.5, 0, 0.2], [0.4, 0, 0]]),
)  # fmt: skip
PRICES = np.array([[0.0, 0.2, 0.4], [0.1, 0.0, np.inf], [0.3, 0.2, 0.0]])
REPAIRED = hjb.Modes(MODES.modes.names, MODES.modes.rates, switching_cost=lambda x: PRICES * (1.5 + jnp.sin(x[0])))
SWITCHED = dataclasses.replace(MODES, modes=REPAIRED)  # the controller repairs what fails; dearer to the right
STILL = {"drift": lambda x, u: 0 * x, "discount": 0.5}
STEPS = {"method": hjb.ValueIteration(), "scheme": hjb.Upwind(), "max_steps": 40, "throw": False}


ROUGH = hjb.Grid([-np.pi, -3.0], [np.pi, 3.0], (14, 11), periodic=(True, False))
TORQUES = np.linspace(-1.0, 1.0, 41)[:, None]  # more than the checks try: they pass over the fourth


@pytree_dataclass()
class Weighted:
    """A cost with the logarithm of a weight for one torque, which the checks before a solve pass over."""

    weight: object

    def cost(self, x, u):
        return effort(x, u) + jnp.where(jnp.abs(u[0] - TORQUES[3, 0]) < 1e-3, jnp.log(self.weight), 0.0)


def beside(ask, *meshes):
    """What an answer on each mesh differs from that on one device, in units in the last place of its largest value."""
    one = ask(None)
    scale = np.finfo(one.value.dtype).eps * np.max(np.abs(one.value[np.isfinite(one.value)]))
    found = []
    for shape in meshes:
        other = ask(mesh_of(*shape))
        same = (other.status, other.steps) == (one.status, one.steps)
        apart = np.where(one.value == other.value, 0, np.abs(one.value - other.value))  # inf − inf
        found.append({"same": same, "ulp": float(np.max(apart) / scale), "status": one.status.name})
    return found


@case
def value_iteration():
    return beside(lambda mesh: hjb.solve(PLAIN, ANGLE, mesh=mesh, **STEPS), (8,), (4, 2))


@case
def value_iteration_to_a_target():
    return beside(lambda mesh: hjb.solve(TARGET, FLAT, mesh=mesh, **STEPS), (4, 2), (1, 3))


@case
def value_iteration_of_a_game():
    return beside(lambda mesh: hjb.solve(CHASE, ROOM, mesh=mesh, **STEPS), (2, 2, 2))


@case
def value_iteration_with_correlated_noise():
    return beside(lambda mesh: hjb.solve(SKEW, FLAT, mesh=mesh, **STEPS), (2, 4))


@case
def march_of_first_order():
    # the terminal cost bends where no node is, and the target moves
    problem = hjb.Problem(
        lambda t, x, u: swing(x, u), lambda t, x, u: effort(x, u), U, terminal_cost=lambda t, x: jnp.abs(x[0] - 0.3),
        target=lambda t, x: jnp.hypot(x[0] - t, x[1]) - 0.8, exit_cost=lambda t, x: t, time_dependent=True,
    )  # fmt: skip
    options = {"scheme": hjb.Upwind(), "times": [0.0, 0.1], "step": 0.01}
    return beside(lambda mesh: hjb.march(problem, ANGLE, 0.2, mesh=mesh, **options), (8,), (4, 2))


@case
def value_alone():
    """Nothing but V is kept, and what is given at the nodes is made anew in every step."""
    alone = {**STEPS, "method": hjb.ValueIteration(policy=False)}
    tube = hjb.reach(swing, U, lambda x: jnp.hypot(x[0] - 0.4, x[1]) - 0.7)
    return [
        *beside(lambda mesh: hjb.solve(PLAIN, ANGLE, mesh=mesh, **alone), (4, 2)),
        *beside(lambda mesh: hjb.solve(tube, FLAT, mesh=mesh, **alone), (8,)),
    ]


@case
def march_of_the_value_alone():
    tube = hjb.reach(swing, U, lambda x: jnp.hypot(x[0] - 0.4, x[1]) - 0.7)
    options = {"scheme": hjb.Upwind(), "times": [0.0, 0.1], "step": 0.01, "policy": False}
    return beside(lambda mesh: hjb.march(tube, ANGLE, 0.2, mesh=mesh, **options), (4, 2))


@case
def march_of_second_order():
    problem = hjb.reach(swing, U, lambda x: jnp.hypot(x[0] - 0.4, x[1]) - 0.7, disturbances=None)
    return beside(lambda mesh: hjb.march(problem, FLAT, 0.2, mesh=mesh), (4, 2))


@case
def march_of_fifth_order():
    problem = hjb.Problem(swing, effort, U, terminal_cost=lambda x: jnp.cos(x[0]) + jnp.sin(x[1] + 0.4))
    return beside(lambda mesh: hjb.march(problem, ANGLE, 0.1, scheme=hjb.Weno5(), mesh=mesh), (8,), (4, 2))


def read_of_others(grid, value, mask):
    """All that is read of other nodes, by names, and all that is found of the nodes together."""
    moves = [stencil.unit(grid, axis, step) for axis in range(grid.ndim) for step in (1, -1)]
    moves += [tuple(1 if axis else -1 for axis in range(grid.ndim))]
    links = [stencil.grid_links(grid, axis) for axis in range(grid.ndim)]
    sides = [stencil.one_sided(value, grid, axis, link) for axis, link in enumerate(links)]
    both, even = enumerate(zip(sides, links, strict=True)), not any(grid.stretch)
    read = {
        "neighbour": [stencil.neighbour(value, grid, move) for move in moves],
        "none beyond": [stencil.neighbour(value, grid, move, ghost=False) for move in moves],
        "of a mask": [stencil.neighbour(mask, grid, move) for move in moves],
        "mirrored": [stencil.continued(value, grid, move, mirror=True) for move in moves],
        "continued": [stencil.continued(value, grid, move) for move in moves],
        "one-sided": sides,
        "limited": [stencil.limited(*side, grid, axis, link) for axis, (side, link) in both],
        "weno": slopes.weno5(value, grid) if even else [],
        "eno": slopes.eno2(value, grid) if even else [],
        "walls": [jnp.broadcast_to(stencil.walls(grid, axis), value.shape) for axis in range(grid.ndim)],
        "coordinates": [jnp.broadcast_to(x, value.shape) for x in grid.components(value.dtype)],
    }
    layout = grid.layout
    places = [find(mask) for find in (layout.first, layout.some) for mask in (value > 2, value > 100)]
    return read, [layout.largest(value), layout.least(value), *places, layout.total(jnp.round(100 * value))]


@case
def stencils():
    """What is read of other nodes, and what is found of all of them, next to one device."""
    ends = {"edges": ("open", ("projected", "open")), "stretch": (None, Sinh(2.0))}
    grids = {
        "ordinary and periodic": (ANGLE, (4, 2)),
        "open and stretched": (hjb.Grid([-2.0, -2.0], [2.0, 2.0], (29, 26), **ends), (2, 4)),
        "three axes": (ROOM, (2, 2, 2)),
    }
    found = {}
    for name, (grid, shape) in grids.items():
        parts, value = Parts(grid.shape, mesh_of(*shape)), np.random.default_rng(0).normal(size=grid.shape)

        def here(grid, value, mask, parts=parts):
            return read_of_others(placed(grid, parts), value, mask)

        with jax.enable_x64(True):
            given, over = (grid, value, value > 0), (jax.tree.map(lambda _: False, grid), True, True)
            whole = jax.device_get(jax.jit(read_of_others)(*given))
            marks = tuple(jax.tree.map(lambda _, m=m: m, each) for each, m in zip(whole, (True, False), strict=True))
            divided = jax.jit(parts.mapped(here, over, marks))(*parts.spread(given, over))
            divided = parts.gathered(divided, marks)
        for what, arrays in whole[0].items():
            pairs = zip(jax.tree.leaves(arrays), jax.tree.leaves(divided[0][what]), strict=True)
            found[f"{name}: {what}"] = max((float(np.max(np.abs(1.0 * a - 1.0 * b))) for a, b in pairs), default=0.0)
        found[f"{name}: of all"] = float(np.max(np.abs(np.array(whole[1], float) - np.array(divided[1], float))))
    return found


@case
def not_a_number_is_not_lost():
    """A NaN at one node of one part is the largest of all."""
    parts = Parts(FLAT.shape, mesh_of(4, 2))
    values = np.zeros(FLAT.shape, np.float32)
    values[30, 3] = np.nan

    def here(grid, values):
        grid = placed(grid, parts)
        return grid.layout.largest(values), grid.layout.least(values)

    given = jax.tree.map(lambda _: False, FLAT), True
    found = jax.jit(parts.mapped(here, given, (False, False)))(*parts.spread((FLAT, values), given))
    return [bool(np.isnan(np.asarray(each))) for each in found]


@case
def compiled_program():
    """The collectives of one step of value iteration, as they stand in the compiled program."""
    found = {}
    with jax.enable_x64(True):
        for shape in ((8,), (4, 2)):
            on = Discretisation(PLAIN, ANGLE, hjb.Upwind(), np.float64)
            task, *_ = setup.prepare_on_host(on, method=hjb.ValueIteration(), tol=1e-3, mesh=mesh_of(*shape))
            parts = task.division
            run = stationary_run.RunInParts(task, np.zeros(ANGLE.shape), 10)
            text = stationary_run._run_in_parts.lower(run.task, run.state, 5, parts=parts).compile().as_text()
            names = ("collective-permute", "all-gather", "all-to-all", "all-reduce")
            found["x".join(map(str, shape))] = {
                name: sum(f" {name}(" in line or f" {name}-start(" in line for line in text.splitlines())
                for name in names
            }
    return found


# gain of the input, weight of the position, half of the box of positions and of speeds: no two axes are alike
PLANTS = ((1.0, 1.0, 1.0, 1.5), (2.0, 0.5, 1.2, 1.0), (0.5, 2.0, 0.8, 1.3))


def integrators(plants, nodes):
    """Double integrators side by side, each with its own input and its own cost, on so many nodes an axis."""
    gain, weight, far, fast = map(np.array, zip(*plants, strict=True))

    def drift(x, u):
        return jnp.stack([x[1::2], gain * u], axis=1).ravel()

    def cost(x, u):
        return weight @ x[::2] ** 2 + x[1::2] @ x[1::2] + u @ u

    def at_the_end(x):
        return jnp.sum(jnp.abs(x[::2] - 0.1))

    count, hi = len(plants), np.stack([far, fast], axis=1).ravel()
    controls = hjb.Box([-1.0] * count, [1.0] * count)
    problem = hjb.Problem(drift, cost, controls, discount=2.0)
    return problem, dataclasses.replace(problem, terminal_cost=at_the_end), hjb.Grid(-hi, hi, (nodes,) * 2 * count)


def decoupled(plants, nodes, mesh, steps):
    """Integrators on the product of their grids over a mesh, beside the sum of their values in the plane.

    On the product grid the generator is the sum of those of the factors, and so are the costs: min over all inputs is
    the sum of the minima. If W_i solve β W_i = min {L_i + L^u W_i}, their sum solves the equation of the product, at
    every node and not up to O(h), and the chain has no other solution. An explicit step adds dt times the right-hand
    side, so that a march is the sum of marches of as many steps, too, up to rounding.
    """
    settled, moving, grid = integrators(plants, nodes)
    step, chain = 0.02, {"scheme": hjb.Upwind()}
    alone = {"method": hjb.ValueIteration(policy=False), "tol": 1e-2, **chain}
    whole = hjb.solve(settled, grid, mesh=mesh, **alone)
    marched = hjb.march(moving, grid, steps * step, step=step, policy=False, mesh=mesh, **chain)
    planes = [integrators([plant], nodes) for plant in plants]
    answers = [hjb.solve(plane, flat, tol=1e-6, **chain) for plane, _, flat in planes]
    marches = [hjb.march(plane, flat, steps * step, step=step, policy=False, **chain) for _, plane, flat in planes]
    apart, moved = (
        np.max(
            np.abs(one.value.reshape(grid.shape) - functools.reduce(np.add.outer, [w.value.squeeze() for w in many]))
        )
        for one, many in ((whole, answers), (marched, marches))
    )
    scale = np.finfo(float).eps * np.max(np.abs(marched.value))
    return {
        "nodes": grid.size, "status": whole.status.name, "steps": [whole.steps, marched.steps],
        "apart": float(apart), "errors": [float(whole.error), *(float(each.error) for each in answers)],
        "ulp": float(moved / scale),
    }  # fmt: skip


@case
def two_integrators():
    return decoupled(PLANTS[:2], 8, mesh_of(2, 2, 2), 10)


@case
def three_integrators():
    return decoupled(PLANTS, 8, mesh_of(2, 2, 2), 10)


def within_certificates(problem, grid, method, *meshes):
    """Answers of policy iteration on meshes beside that on one device: how far apart, certified errors, steps."""
    options = {"method": method, "scheme": hjb.Upwind(), "tol": 1e-6, "throw": False}
    one, found = hjb.solve(problem, grid, **options), []
    for shape in meshes:
        other = hjb.solve(problem, grid, mesh=mesh_of(*shape), **options)
        finite = np.isfinite(one.value)
        found.append({
            "status": [one.status.name, other.status.name],
            "alike": bool(np.array_equal(finite, np.isfinite(other.value))),
            "apart": float(np.max(np.abs(one.value - other.value)[finite])),
            "errors": [float(one.error), float(other.error)],
            "steps": [one.steps, other.steps],
        })  # fmt: skip
    return found


@case
def sweeps():
    return within_certificates(PLAIN, ANGLE, hjb.PolicyIteration(hjb.Sweeps()), (4, 2))


@case
def sweeps_of_flat_parts():
    return within_certificates(PLAIN, ANGLE, hjb.PolicyIteration(hjb.Sweeps()), (8,), (1, 8))


@case
def sweeps_in_slabs():
    """As on parts that outgrow a processor's cache."""
    outgrows, slab = gauss_seidel._outgrows_the_cache, gauss_seidel.SLAB
    gauss_seidel._outgrows_the_cache, gauss_seidel.SLAB = (lambda *_: True), 4
    jax.clear_caches()
    try:
        return within_certificates(PLAIN, ANGLE, hjb.PolicyIteration(hjb.Sweeps()), (2, 2))
    finally:
        gauss_seidel._outgrows_the_cache, gauss_seidel.SLAB = outgrows, slab
        jax.clear_caches()


@case
def sweeps_to_a_target():
    return within_certificates(TARGET, FLAT, hjb.PolicyIteration(hjb.Sweeps()), (4, 2))


@case
def sweeps_of_a_game():
    return within_certificates(CHASE, ROOM, hjb.PolicyIteration(hjb.Sweeps()), (2, 2, 2))


@case
def krylov():
    return within_certificates(SHAKEN, ANGLE, None, (4, 2))


@case
def krylov_with_modes():
    return within_certificates(MODES, ANGLE, None, (4, 2))


@case
def krylov_with_switching_costs():
    return within_certificates(SWITCHED, ANGLE, None, (4, 2))


@case
def sweeps_with_switching_costs():
    return within_certificates(dataclasses.replace(SWITCHED, noise=None), ANGLE, None, (8,))


@case
def krylov_with_pushes():
    """Pushes along the second axis in both directions; eight devices divide the first."""
    pushes = [hjb.Push([0.0, 1.0], 0.4), hjb.Push([0.0, -1.0], lambda x: 0.3 + 0.1 * x[0] ** 2)]
    return within_certificates(dataclasses.replace(SHAKEN, pushes=pushes), ANGLE, None, (8,))


@case
def march_with_switching_costs():
    return beside(lambda mesh: hjb.march(SWITCHED, ANGLE, 0.3, scheme=hjb.Upwind(), mesh=mesh), (8,), (4, 2))


@case
def krylov_with_correlated_noise():
    return within_certificates(SKEW, FLAT, None, (4, 2))


@case
def without_a_choice():
    """The solve that nobody asked for details of: nested, of second order, with an estimate of the grid's error."""
    grid, method = dataclasses.replace(ANGLE, shape=(64, 49)), hjb.Nested(coarsest=500)
    one, other = (hjb.solve(PLAIN, grid, method=method, mesh=mesh) for mesh in (None, mesh_of(4, 2)))
    return {
        "status": other.status.name,
        "scheme": other.stats["scheme"],
        "levels": [list(one.stats["levels"]), list(other.stats["levels"])],
        "apart": float(np.max(np.abs(one.value - other.value))),
        "error of the grid": [float(np.max(each.grid_error)) for each in (one, other)],
    }


@case
def implicit_march():
    problem = hjb.Problem(swing, effort, U, noise=0.3, terminal_cost=lambda x: jnp.abs(x[0]))
    options = {"scheme": hjb.Upwind(), "method": hjb.Implicit(tol=1e-9), "step": 0.05}
    one, other = (hjb.march(problem, ANGLE, 0.2, mesh=mesh, **options) for mesh in (None, mesh_of(4, 2)))
    return [other.status.name, one.steps, other.steps, float(np.max(np.abs(one.value - other.value)))]


@case
def open_ends():
    """Where no bound holds: within the tolerance of the residual, by steps in time that become longer."""
    problem = hjb.Problem(lambda x, u: u - x, lambda x, u: x @ x + u @ u, hjb.Box([-1.0] * 2, [1.0] * 2), discount=0.5)
    grid = dataclasses.replace(FLAT, edges="open")
    options = {"method": hjb.PolicyIteration(hjb.Krylov()), "scheme": hjb.Upwind(), "tol": 1e-8}
    one, other = (hjb.solve(problem, grid, mesh=mesh, **options) for mesh in (None, mesh_of(4, 2)))
    return [other.status.name, one.steps, other.steps, float(np.max(np.abs(one.value - other.value)))]


def batches(*meshes):
    """Eleven lanes that take from a few steps to many, and one that fails, on meshes beside those without one."""
    # discounts far apart, so that lanes are taken out on the way; the logarithm of −1 is no number
    weights = [-1.0 if lane == 5 else 1.0 + lane for lane in range(11)]
    lanes = [
        hjb.Problem(swing, Weighted(w).cost, hjb.Finite(TORQUES), discount=b)
        for w, b in zip(weights, np.geomspace(9.0, 0.05, 11), strict=True)
    ]
    options = {"scheme": hjb.Upwind(), "tol": 1e-6, "throw": False}
    alone, found = hjb.solve_batch(lanes, ROUGH, **options), []
    for mesh in meshes:
        spread = hjb.solve_batch(lanes, ROUGH, mesh=mesh, **options)
        found.append({
            "status": [each.status.name for each in spread],
            "steps": [[each.steps for each in answers] for answers in (alone, spread)],
            "ulp": max(
                float(np.max(np.abs(one.value - other.value)) / (np.finfo(float).eps * (1 + np.max(np.abs(one.value)))))
                for one, other in zip(alone, spread, strict=True)
            ),
            "residuals": all(len(each.residuals) == each.steps + 1 for each in spread),
        })  # fmt: skip
    return found


@case
def batch():
    return batches(mesh_of(4, 2))


@case
def checkpoints():
    """A run that is cut on eight devices and goes on on two, and on one."""
    one = hjb.solve(PLAIN, ANGLE, **STEPS)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for shape in ((2,), None):
            place = Path(folder) / f"{shape}.npz"
            hjb.solve(PLAIN, ANGLE, mesh=mesh_of(8), checkpoint=place, **{**STEPS, "max_steps": 15})
            mesh = None if shape is None else mesh_of(*shape)
            other = hjb.solve(PLAIN, ANGLE, mesh=mesh, checkpoint=place, resume=True, **STEPS)
            apart = np.max(np.abs(one.value - other.value)) / np.max(np.abs(one.value))
            found.append({"steps": other.steps, "apart": float(apart), "residuals": len(other.residuals)})
    return found


@case
def bytes_per_device():
    """Bytes of a device in each program that passes over the nodes before a solve: one device, then eight."""
    grid, found = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (96, 95)), []
    programs = [(node_checks, "_actions_pass"), (setup, "_prepare_jit"), (attainability, "_more_open_jumps")]

    def noted(function, name):
        def call(*arguments, **options):
            used = function.lower(*arguments, **options).compile().memory_analysis()
            parts = used.argument_size_in_bytes + used.output_size_in_bytes + used.temp_size_in_bytes
            found[-1][name] = max(parts, found[-1].get(name, 0))
            return function(*arguments, **options)

        return call

    with contextlib.ExitStack() as stack:
        for module, name in programs:
            stack.enter_context(mock.patch.object(module, name, noted(getattr(module, name), name)))
        for mesh in (None, mesh_of(8)):
            found.append({})
            hjb.solve(TARGET, grid, mesh=mesh, scheme=hjb.Upwind(), method=hjb.ValueIteration(), tol=1.0)
    return found


@case
def faults():
    """A value that grows beyond the largest number, in one part first."""
    problem = hjb.Problem(swing, lambda x, u: jnp.where(x[0] > 1.8, 5e307, 1e307), U, discount=1e-3)
    one, other = (hjb.solve(problem, FLAT, mesh=mesh, **{**STEPS, "max_steps": 5000}) for mesh in (None, mesh_of(4, 2)))
    return [one.status.name, other.status.name, one.steps, other.steps, bool(np.all(np.isfinite(other.value)))]


@case
def refusals():
    """What cannot be divided, by the message."""
    few, two = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (23, 31)), mesh_of(2)
    direct, chain = hjb.Direct(), {"scheme": hjb.Upwind()}
    calling = hjb.Problem(lambda x, u: jax.pure_callback(np.sin, x, x) + u, effort, U, discount=0.5)

    def discounted(b):
        return hjb.Problem(swing, effort, U, discount=b)

    ask = {
        "no mesh": lambda: hjb.solve(PLAIN, FLAT, mesh=8),
        "axes": lambda: hjb.solve(PLAIN, FLAT, mesh=mesh_of(2, 2, 2)),
        "few points": lambda: hjb.solve(PLAIN, few, mesh=mesh_of(8)),
        "paths": lambda: hjb.solve(PLAIN, FLAT, scheme=hjb.SemiLagrangian(), mesh=two),
        "direct": lambda: hjb.solve(PLAIN, FLAT, method=hjb.PolicyIteration(direct), mesh=two),
        "direct in time": lambda: hjb.march(PLAIN, FLAT, 1.0, method=hjb.Implicit(direct), mesh=two, **chain),
        "traced": lambda: jax.jit(lambda b: hjb.solve(discounted(b), FLAT, mesh=two).value)(0.5),
        "traced march": lambda: jax.jit(lambda b: hjb.march(discounted(b), FLAT, 1.0, step=0.01, mesh=two).value)(0.5),
        "host": lambda: hjb.solve(calling, FLAT, mesh=two),
        "jumps": lambda: hjb.solve(hjb.Problem(**STILL, jumps=[hjb.Jump(1.0, lambda x, u: -x)]), FLAT, mesh=two),
        "pushes": lambda: hjb.solve(hjb.Problem(**STILL, pushes=[hjb.Push([1.0, 0.0], 1.0)]), FLAT, mesh=two),
        "pushes in modes": lambda: hjb.solve(
            dataclasses.replace(SWITCHED, pushes=[hjb.Push([0.0, 1.0], 1.0)]), FLAT, mesh=mesh_of(2, 2)
        ),
        "no mesh of lanes": lambda: hjb.solve_batch([PLAIN], FLAT, mesh=8),
        "lanes to a file": lambda: hjb.solve_batch([PLAIN], FLAT, mesh=two, checkpoint="run.npz"),
        "lanes by the host": lambda: hjb.solve_batch([PLAIN, calling], FLAT, mesh=two),
        "direct lanes": lambda: hjb.solve_batch([PLAIN], FLAT, method=hjb.PolicyIteration(direct), mesh=two),
    }
    found = {}
    for name, question in ask.items():
        try:
            question()
        except (TypeError, ValueError) as error:
            found[name] = f"{type(error).__name__}: {error}"
    return found


def main(names):
    """Run these cases and print what they found."""
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", hjb.SolveWarning)  # of coarse grids and of ends that are left
    for name in names:
        try:
            FOUND[name] = RAN[name]()
        except Exception:
            FOUND[name] = {"failed": traceback.format_exc()}
    print(json.dumps(FOUND, indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
