"""The tasks of high-order schemes, which can share a program with the task of their chain."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Scheme
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.fixed_point import Task
from hjbjax.solvers.setup import Assumptions

AHEAD = 2.0  # the time to cross the box, over the length of a corrective time step


def staged(task: Task, scheme: Scheme) -> Task:
    """The task of the chain, in the program of the scheme if both can share one: without noise, certified."""
    fits = task.problem.noise is None and min(task.grid.shape) >= scheme.points
    certified = task.certificate in (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE)
    if scheme.monotone or not (fits and certified):
        return task
    return at_order(dataclasses.replace(task, on=task.on.with_scheme(scheme)), first=True)


def at_order(task: Task, *, first: bool) -> Task:
    """The task of a high-order scheme, or of its chain (``first``) in the same program: only numbers differ."""
    return dataclasses.replace(sharpened(task, first=first), first_order=np.asarray(first))


def sharpened(task: Task, *, first: bool = False) -> Task:
    """The task with additions for the iteration with high-order slopes, which their chain (``first``) does not use.

    Without a discount these slopes have false solutions, because the artificial diffusion with which upwinding reaches
    rest nodes is missing. If the slopes overshoot, a policy circles a rest node at zero or negative cost: V + c with c
    < 0 then solves the equation at all nodes except the rest node and its neighbours. A floor prevents this: it is zero
    where costs are non-negative, and V is small next to a rest node. Corrections overshoot as well, since their error
    is carried along a whole path, so each is an implicit time step of length 1/κ, half the time to cross the box. With
    noise errors are not carried far, and whole corrections need fewer steps.
    """
    obstacles, shift = task.obstacles, None
    if task.floor is not None:
        floor = np.finfo(task.tol.dtype).min / 8 if first else task.floor
        obstacles = dataclasses.replace(obstacles, lower=jnp.asarray(np.asarray(floor, task.tol.dtype)))
    if task.crossing is not None and task.problem.noise is None and not task.problem.is_game:
        shift = np.asarray(0 if first else AHEAD / np.asarray(task.crossing), task.tol.dtype)
    return dataclasses.replace(task, obstacles=obstacles, shift=shift, weights=np.array([1, 0], task.tol.dtype))


def raised(task: Task, assumptions: Assumptions, scheme: Scheme) -> tuple[Task, Assumptions]:
    """The task and the assumptions of a high-order scheme, which has no certificate, from those of its chain."""
    # defect correction: the matrix of the chain, the residual of the better slopes
    on = task.on.with_scheme(scheme)
    task = dataclasses.replace(task, certificate=Certificate.RESIDUAL, on=on, first_order=None)
    return sharpened(task), dataclasses.replace(assumptions, certificate=Certificate.RESIDUAL)
