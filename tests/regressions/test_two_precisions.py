"""One process in 32 and in 64 bits, compiled and not, in both orders: JAX 0.10 confuses programs of NumPy's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

F = hjb.filtering
PLANT = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Ball(1.0, 1), noise=0.5)
GRID = hjb.Grid([-2.0], [2.0], (21,))
X = GRID.axis(0)


def asked():
    """Functions of one state of an observer or of the plant, made anew: what is remembered belongs to the objects."""
    known = hjb.Solution(GRID, 0.25 * X**2, -0.5 * X[:, None])
    law = F.GridFilter(PLANT, lambda x: 2 * x, GRID, lambda x: jnp.exp(-((x - 0.4) @ (x - 0.4))))
    robust = F.RobustGridFilter(PLANT, lambda x: 2 * x, GRID, lambda x: -((x - 0.4) @ (x - 0.4)), 2.0)
    worst = F.minimum_stress(robust, known)
    greedy = hjb.greedy_feedback(PLANT, known)
    return {
        "value_at": (known.value_at, lambda: jnp.array([0.3])),
        "control_at": (known.control_at, lambda: jnp.array([0.3])),
        "greedy": (greedy.control_at, lambda: jnp.array([0.3])),
        "averaged": (F.averaged_hamiltonian(PLANT, known, law), law.initial),
        "certainty": (F.certainty_equivalence(law, known), law.initial),
        "greedy at the estimate": (F.certainty_equivalence(law, greedy), law.initial),
        "minimum stress": (worst, robust.initial),
        "stress": (worst.stress, robust.initial),
        "worst case": (worst.worst_case, robust.initial),
        "filter": (lambda state: law.update(state, jnp.zeros(1), jnp.full(1, 0.1), 0.1).density, law.initial),
        "robust": (lambda p: robust.update(p, jnp.zeros(1), jnp.full(1, 0.1), 0.1), robust.initial),
    }


@pytest.mark.slow
@pytest.mark.parametrize("wide", [True, False])
@pytest.mark.parametrize("name", asked())
def test_a_function_is_asked_in_both_by_turns(name, wide):
    function, start = asked()[name]
    with jax.enable_x64(True):
        wanted = np.asarray(function(start()))
    for bits in (wide, not wide, wide):
        with jax.enable_x64(bits):
            compiled, plain = jax.jit(function)(start()), function(start())
            assert compiled.dtype == (np.float64 if bits else np.float32)
            np.testing.assert_allclose(compiled, wanted, rtol=1e-12 if bits else 2e-4)
            np.testing.assert_allclose(plain, wanted, rtol=1e-12 if bits else 2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("transformed", [jax.jit, jax.grad], ids=["jit", "grad"])
def test_numbers_of_64_bits_in_a_closure_may_be_traced_in_a_solve_of_32(transformed):
    """They are no leaves of the problem that could be cast: this left from the loop as a TypeError of JAX."""

    def cost_of(weight, dtype):
        problem = hjb.Problem(lambda x, u: weight * u, lambda x, u: x @ x + u @ u, hjb.Box([-1.0], [1.0]), discount=1.0)
        return hjb.solve(problem, hjb.Grid([-1.0], [1.0], (21,)), scheme=hjb.Upwind(), dtype=dtype).value_at([0.5])

    with jax.enable_x64(True):
        short, long = (
            float(transformed(lambda w, d=d: cost_of(w, d))(jnp.asarray(0.9))) for d in ("float32", "float64")
        )
    assert short == pytest.approx(long, rel=1e-4)


@pytest.mark.slow
def test_a_program_of_32_bits_returns_the_grid_that_it_solves_on():
    """JAX passed its float32 copy of the grid's corners, a part of the solution, to float64 programs of the host."""
    grid = hjb.Grid([0.0], [1.0], (21,), edges=(("projected", hjb.Dirichlet(3.0)),))
    problem = hjb.Problem(lambda x, u: 0.05 * x, lambda x, u: 1.0, noise=lambda x, u: 0.3 + x, discount=0.05)
    wanted = hjb.solve(problem, grid).value
    solution = jax.jit(lambda problem: hjb.solve(problem, grid))(problem)
    np.testing.assert_allclose(solution.value, wanted, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1.0, 1e8])
def test_second_order_slopes_in_float32_know_no_unit(unit):
    """Products of three second differences left the range of float32: first order for 1e8, NaN for 1e-6."""
    problem = hjb.Problem(
        lambda x, u: unit * u, lambda x, u: (x @ x) / unit**2, hjb.Box([-1.0], [1.0]),
        target=lambda x: jnp.abs(x[0]) - 0.23 * unit,
    )  # fmt: skip
    grid = hjb.Grid([-1.5 * unit], [1.5 * unit], (61,))
    found = hjb.march(problem, grid, 1.5, scheme=hjb.Limited(split=True), dtype="float32").value[0]
    x = np.abs(np.linspace(-1.5, 1.5, 61))
    # the fastest way inwards: the integral of y² from 0.23 to |x|
    np.testing.assert_allclose(found, np.where(x > 0.23, (x**3 - 0.23**3) / 3, 0), atol=0.003)
