"""Derivatives of a march: both modes against central differences, and memory like the square root of the steps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

GRID = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (15, 16))
METHODS = {
    "chain": (hjb.Upwind(split=True), None),
    "limited": (hjb.Limited(split=True), None),
    "implicit": (hjb.Upwind(split=True), hjb.Implicit(tol=1e-12)),
}


def value(numbers, name="chain", count=20):
    """V at a state, of a mass, a bound on the force, and a weight of what is paid at the end."""
    mass, bound, weight = numbers
    problem = hjb.Problem(
        lambda x, u: jnp.stack([x[1], u[0] / mass - jnp.sin(x[0])]), lambda x, u: x @ x + 0.3 * u @ u,
        hjb.Box(-bound[None], bound[None]), discount=0.2, terminal_cost=lambda x: weight * x @ x,
    )  # fmt: skip
    scheme, method = METHODS[name]
    marched = hjb.march(problem, GRID, 1.0, step=1 / count, scheme=scheme, method=method)
    return marched.value_at(0.0, jnp.array([1.1, 0.7]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["chain", *(pytest.param(n, marks=pytest.mark.slow) for n in ("limited", "implicit"))])
def test_both_modes_match_central_differences(name):
    run = functools.partial(value, name=name)
    with jax.enable_x64(True):
        at, step = jnp.array([1.2, 0.9, 1.5]), 1e-5
        plain, found = jax.jit(run), jax.jit(jax.grad(run))(at)
        wanted = jnp.stack([(plain(at + e) - plain(at - e)) / (2 * step) for e in step * jnp.eye(3)])
        assert jnp.min(jnp.abs(wanted)) > 1e-3
        np.testing.assert_allclose(found, wanted, rtol=1e-6)
        ahead = jax.jit(lambda at: jax.jvp(run, (at,), (jnp.ones(3),))[1])(at)
        assert float(ahead) == pytest.approx(float(jnp.sum(found)), rel=1e-9)


@pytest.mark.slow
def test_memory_grows_like_the_square_root_of_the_steps():
    """Sixteen times the steps take less than four times the memory, and 64 times less than eight times."""

    def bytes_of(count):
        compiled = jax.jit(jax.grad(functools.partial(value, count=count))).lower(jnp.array([1.2, 0.9, 1.5])).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    least = bytes_of(100)
    assert bytes_of(1600) < 4 * least
    assert bytes_of(6400) < 8 * least


def searched(weight):
    """The control at a node, and at a marched time, of a cost whose optimum has no formula."""
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: x @ x + jnp.cosh(u[0]), hjb.Box([-3.0], [3.0]),
        terminal_cost=lambda x: weight * x @ x,
    )  # fmt: skip
    marched = hjb.march(problem, hjb.Grid([-1.0], [1.0], (9,)), 0.2, scheme=hjb.Upwind(), step=0.02, times=(0.0, 0.1))
    return marched.policy[:, 6, 0]


@pytest.mark.slow
def test_a_searched_control_has_the_derivative_of_the_value():
    with jax.enable_x64(True):
        run = jax.jit(searched)
        found = jax.jit(jax.jacrev(searched))(1.0)
        wanted = (run(1.0 + 1e-4) - run(1.0 - 1e-4)) / 2e-4
    assert np.min(np.abs(wanted)) > 0.1
    np.testing.assert_allclose(found, wanted, rtol=1e-3)


def kept_at(times, weight):
    """A march with these kept times, of functions of time."""
    problem = hjb.Problem(
        lambda t, x, u: u + t, lambda t, x, u: x @ x + u @ u, hjb.Box([-3.0], [3.0]), time_dependent=True,
        stopping_cost=lambda t, x: 0.2 + t, terminal_cost=lambda t, x: weight * x @ x,
    )  # fmt: skip
    grid = hjb.Grid([-1.0], [1.0], (9,))
    return hjb.march(problem, grid, 1.0, step=0.02, scheme=hjb.Upwind(split=True), times=times)


def test_slices_at_uneven_times_equal_those_of_the_host():
    """One loop covers the intervals of equal steps: here of 5, 5, 3, 3 and 0 steps, and of 34 steps to the horizon."""
    with jax.enable_x64(True):
        for times in ([0.0, 0.1, 0.2, 0.26, 0.32], [0.0, 0.1, 0.9, 1.0]):
            host = kept_at(times, 2.0)
            traced = jax.jit(functools.partial(kept_at, times))(2.0)
            assert int(traced.steps) == int(host.steps)
            for name in ("times", "value", "policy", "stopping"):
                np.testing.assert_allclose(getattr(traced, name), getattr(host, name), atol=1e-12, err_msg=name)


def test_more_kept_times_do_not_make_a_longer_program():
    """A program per interval took 40 s of one core to compile for 41 kept times, which fit_trajectories uses."""

    def length(count):
        slope = jax.grad(lambda weight: jnp.sum(kept_at(np.linspace(0, 1, count), weight).policy))
        return len(str(jax.make_jaxpr(slope)(2.0)).splitlines())

    with jax.enable_x64(True):
        assert length(41) == length(6)
