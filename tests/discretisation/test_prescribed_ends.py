"""Prescribed ends: values, slopes and growth rates at the ends of the box, against exact solutions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb


def order(errors):
    """The fitted order of convergence of errors on grids whose spacing halves."""
    return float(np.mean(np.diff(-np.log2(errors))))


def exponential(drift=-0.1, noise=0.4, discount=0.06):
    """dx = drift dt + noise dw with cost exp(x): V = exp(x)/(discount − drift − noise²/2), whatever the box."""
    scale = 1 / (discount - drift - noise**2 / 2)
    problem = hjb.Problem(lambda x, u: 0 * x + drift, lambda x, u: jnp.exp(x[0]), noise=noise, discount=discount)
    return problem, lambda x: scale * np.exp(x), scale


def ends(kind, scale, at):
    """The prescribed end at x = ``at`` that V = scale · exp(x) satisfies."""
    value = scale * np.exp(at)
    return {"dirichlet": hjb.Dirichlet(value), "neumann": hjb.Neumann(value), "robin": hjb.Robin(1.0)}[kind]


@pytest.mark.parametrize(
    "kind",
    [pytest.param("dirichlet", marks=pytest.mark.slow), pytest.param("neumann", marks=pytest.mark.slow), "robin"],
)
@pytest.mark.parametrize("drift", [-0.1, 0.1])
def test_exponential_value_with_noise(kind, drift):
    """The exact solution is met with second order, on both sides, by the default scheme."""
    problem, exact, scale = exponential(drift, discount=0.4)
    errors = []
    for count in (26, 51, 101):
        pair = (ends(kind, scale, -1.0), ends(kind, scale, 1.5))
        solution = hjb.solve(problem, hjb.Grid([-1.0], [1.5], (count,), edges=(pair,)), tol=1e-8)
        errors.append(np.max(np.abs(solution.value - exact(np.asarray(solution.grid.axis(0))))))
        assert solution.box_error is None
        assert (solution.bounds is None) == (kind == "robin")
    assert order(errors) > 1.8
    assert errors[-1] < 2e-3 * scale


@pytest.mark.parametrize(
    "kind",
    ["dirichlet", pytest.param("neumann", marks=pytest.mark.slow), pytest.param("robin", marks=pytest.mark.slow)],
)
def test_transport_out_of_the_box(kind):
    """Without noise the drift carries the state out at the upper end; what is prescribed there decides V."""
    problem, exact, scale = exponential(0.3, 0.0, 0.5)
    problem = hjb.Problem(problem.drift, problem.cost, discount=0.5)
    errors = []
    for count in (41, 81, 161):
        solution = hjb.solve(problem, hjb.Grid([0.0], [1.0], (count,), edges=(("projected", ends(kind, scale, 1.0)),)))
        errors.append(np.max(np.abs(solution.value - exact(np.asarray(solution.grid.axis(0))))))
    assert order(errors) > 0.9
    assert errors[-1] < 0.02 * scale


def test_stretched_axes():
    """Slopes on gaps of different lengths."""
    problem, exact, scale = exponential()
    pair = (ends("neumann", scale, -1.0), ends("robin", scale, 1.5))
    grid = hjb.Grid([-1.0], [1.5], (81,), edges=(pair,), stretch=(hjb.Sinh(2.0, 0.3),))
    np.testing.assert_allclose(hjb.solve(problem, grid).value, exact(np.asarray(grid.axis(0))), rtol=2e-3)


@pytest.mark.slow
def test_functions_of_the_state_in_the_plane():
    """V = sin(x) exp(y) + y² for a controlled problem whose cost is made from it; functions prescribe its slopes."""
    beta, noise = 0.7, 0.5

    def value(x):
        return jnp.sin(x[0]) * jnp.exp(x[1]) + x[1] ** 2

    def cost(x, u):
        gradient = jax.grad(value)(x)
        laplacian = jnp.trace(jax.hessian(value)(x))
        # min_u {u²/2 + u p₂} = −p₂²/2 at u = −p₂
        rest = beta * value(x) - 0.2 * gradient[0] + 0.5 * gradient[1] ** 2 - 0.5 * noise**2 * laplacian
        return 0.5 * u[0] ** 2 + rest

    problem = hjb.Problem(
        lambda x, u: jnp.stack([0.2 + 0 * x[0], u[0]]), cost, hjb.Box([-9.0], [9.0]), noise=noise, discount=beta
    )
    slopes = (
        (hjb.Neumann(lambda x: jax.grad(value)(x)[0]), hjb.Dirichlet(value)),
        (
            hjb.Neumann(lambda x: jax.grad(value)(x)[1]),
            hjb.Robin(0.5, lambda x: jax.grad(value)(x)[1] - 0.5 * value(x)),
        ),
    )
    errors = []
    for count in (17, 33, 65):
        grid = hjb.Grid([-0.5, 0.0], [1.0, 1.0], (count, count), edges=slopes)
        solution = hjb.solve(problem, grid, tol=1e-6)
        exact = np.asarray(jax.vmap(value)(jnp.asarray(grid.nodes().reshape(-1, 2)))).reshape(grid.shape)
        errors.append(np.max(np.abs(solution.value - exact)))
    assert order(errors) > 1.6
    assert errors[-1] < 2e-3


@pytest.mark.parametrize(
    "scheme",
    [
        hjb.Upwind(),
        pytest.param(hjb.Limited(), marks=pytest.mark.slow),
        pytest.param(hjb.Eno2(), marks=pytest.mark.slow),
        hjb.Weno5(),
    ],
)
def test_marches(scheme):
    """V(t, x) = exp(x + c (T − t)) solves the heat equation with drift; every scheme keeps it at every kind of end."""
    drift, noise, horizon = 0.1, 0.5, 0.5
    rate = drift + noise**2 / 2
    problem = hjb.Problem(lambda x, u: 0 * x + drift, None, noise=noise, terminal_cost=lambda x: jnp.exp(x[0]))
    grid = hjb.Grid([-1.0], [1.0], (81,), edges=hjb.Robin(1.0))
    solution = hjb.march(problem, grid, horizon, scheme=scheme)
    np.testing.assert_allclose(solution.value[0], np.exp(grid.axis(0) + rate * horizon), rtol=8e-3)


def test_a_reflecting_wall():
    """Brownian motion with a control is reflected at 1 and stopped at 0: the exact time is known."""
    noise = 0.5
    lam = 2 / noise**2
    problem = hjb.Problem(lambda x, u: u, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), noise=noise)
    grid = hjb.Grid([0.0], [1.0], (101,), edges=((hjb.Dirichlet(0.0), hjb.Neumann(0.0)),))
    solution = hjb.solve(problem, grid)
    x = np.asarray(grid.axis(0))
    np.testing.assert_allclose(solution.value, x - (np.exp(-lam * (1 - x)) - np.exp(-lam)) / lam, atol=3e-4)
    assert solution.box_error is None


@pytest.mark.slow
def test_derivatives_batches_and_files(tmp_path):
    """Prescribed numbers are leaves: a batch and a gradient see them, and a file keeps the kinds."""
    problem, _, scale = exponential()

    def value(slope, level):
        grid = hjb.Grid([-1.0], [1.5], (41,), edges=((hjb.Dirichlet(level), hjb.Neumann(slope)),))
        return hjb.solve(problem, grid, tol=1e-9).value_at(jnp.array([0.5]))

    with jax.enable_x64(True):
        found = jax.grad(value, (0, 1))(scale * 3.0, scale * 0.4)
    step = 1e-3 * scale
    for i, derivative in enumerate(found):
        shifted = [[scale * 3.0 + sign * step * (i == 0), scale * 0.4 + sign * step * (i == 1)] for sign in (1, -1)]
        difference = (value(*shifted[0]) - value(*shifted[1])) / (2 * step)
        assert float(derivative) == pytest.approx(float(difference), rel=1e-5)
    grid = hjb.Grid([-1.0], [1.5], (41,), edges=((hjb.Dirichlet(1.0), hjb.Neumann(2.0)),))
    solution = hjb.solve(problem, grid)
    solution.save(tmp_path / "s.npz")
    loaded = hjb.load(tmp_path / "s.npz").grid
    assert loaded.edges == (("dirichlet", "neumann"),)
    with pytest.raises(ValueError, match="the lower end of x1 is prescribed, but its numbers are unknown"):
        hjb.solve(problem, loaded)


def test_refusals():
    """What has no meaning is refused in the name of the function that was called."""
    problem, _, _ = exponential()
    grid = hjb.Grid([-1.0], [1.0], (41,), edges=((hjb.Dirichlet(0.0), hjb.Neumann(1.0)),))
    with pytest.raises(ValueError, match="chain: got a grid with Dirichlet and Neumann ends"):
        hjb.chain.matrix(problem, grid, np.zeros((41, 0)))
    with pytest.raises(ValueError, match="not finite"):
        hjb.Grid([0.0], [1.0], (11,), edges=hjb.Dirichlet(np.nan))
    with pytest.raises(ValueError, match=r"returned shape \(1,\) for one state"):
        hjb.Grid([0.0], [1.0], (11,), edges=hjb.Neumann(lambda x: x))
    with pytest.raises(TypeError, match="number or a function"):
        hjb.Grid([0.0], [1.0], (11,), edges=hjb.Neumann("steep"))
