"""Minima over inputs that share components, against an oracle in NumPy and SciPy: cell by cell, and a dense scan."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from scipy.optimize import minimize
from torus import SHAPE, SPACING, found

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.hamiltonian.quadratic_program import is_convex

pytestmark = pytest.mark.usefixtures("float64")


def drift(p, x, u):
    return p["b"] + p["G"] @ u


def cost(p, x, u):
    return p["l"] @ u + u @ p["Q"] @ u


def drawn(seed, m, *, products=True):
    """Numbers of a problem with m inputs, a convex cost and two shared components, and a value at the nodes."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(m, m)) * rng.choice([0.0, 1.0], (m, 1), p=[0.3, 0.7])
    square = root.T @ root if products else np.diag(rng.uniform(0, 1, m) * rng.choice([0.0, 1.0], m, p=[0.3, 0.7]))
    numbers = {"b": 0.5 * rng.normal(size=2), "G": rng.normal(size=(2, m)), "l": rng.normal(size=m), "Q": square}
    return numbers, rng.normal(size=SHAPE), rng.uniform(0.1, 0.6, 2)


def admissible_set(kind, m):
    return hjb.Box(-np.linspace(0.5, 1.2, m), np.linspace(1.0, 0.7, m)) if kind == "box" else hjb.Ball(0.9, m)


def problem_of(numbers, admissible, sigma=None):
    return hjb.Problem(Partial(drift, numbers), Partial(cost, numbers), admissible, noise=sigma, discount=1.0)


class Node:
    """H at one node, in NumPy, and its minimum: on each cell between kinks it is one convex quadratic."""

    def __init__(self, numbers, value, sigma, index):
        self.numbers = numbers
        here = value[index]
        around = [[value[tuple((np.array(index) + s * e) % SHAPE)] for e in np.eye(2, dtype=int)] for s in (1, -1)]
        self.up, self.down = (around[0] - here) / SPACING, (here - around[1]) / SPACING
        self.a = np.zeros(2) if sigma is None else sigma**2

    def __call__(self, u):
        f = self.numbers["b"] + u @ self.numbers["G"].T
        e = np.maximum(self.a, SPACING * np.abs(f))
        gain = ((e + SPACING * f) * self.up - (e - SPACING * f) * self.down) / (2 * SPACING)
        return np.sum(gain, -1) + u @ self.numbers["l"] + np.sum((u @ self.numbers["Q"]) * u, -1)

    def minimum(self, admissible):
        pieces = []
        for s, up, down in zip(self.a / SPACING, self.up, self.down, strict=True):
            ends, slopes = (
                ((-np.inf, -s, s, np.inf), (down, (up + down) / 2, up)) if s else ((-np.inf, 0, np.inf), (down, up))
            )
            pieces.append([(pair, slope) for pair, slope in zip(itertools.pairwise(ends), slopes, strict=True)])
        return min(self._in_cell(cell, admissible) for cell in itertools.product(*pieces))

    def _in_cell(self, cell, admissible):
        g, b, m = self.numbers["G"], self.numbers["b"], admissible.dim
        linear, square = (
            self.numbers["l"] + sum(slope * row for row, (_, slope) in zip(g, cell, strict=True)),
            self.numbers["Q"],
        )
        limits = [
            {"type": "ineq", "fun": lambda u, r=sign * row, c=sign * (offset - end): r @ u + c,
             "jac": lambda u, r=sign * row: r}
            for row, offset, (pair, _) in zip(g, b, cell, strict=True)
            for sign, end in zip((1, -1), pair, strict=True) if np.isfinite(end)
        ]  # fmt: skip
        more = {}
        if isinstance(admissible, hjb.Ball):
            limits.append({"type": "ineq", "fun": lambda u: admissible.radius**2 - u @ u, "jac": lambda u: -2 * u})
        else:
            more = {"bounds": list(zip(admissible.lo, admissible.hi, strict=True))}
        answer = minimize(lambda u: linear @ u + u @ square @ u, np.zeros(m), jac=lambda u: linear + 2 * square @ u,
                          constraints=limits, method="SLSQP", options={"ftol": 1e-13}, **more)  # fmt: skip
        return self(nearest(answer.x, admissible))


def nearest(u, admissible):
    if isinstance(admissible, hjb.Box):
        return np.clip(u, admissible.lo, admissible.hi)
    return u * np.minimum(1, admissible.radius / np.maximum(np.linalg.norm(u, axis=-1, keepdims=True), 1e-12))


def scanned(node, admissible, count=3000):
    rng = np.random.default_rng(1)
    return np.min(node(nearest(rng.uniform(-1.3, 1.3, (count, admissible.dim)), admissible)))


CASES = [(3, "box")]
SLOW = [(2, "box"), (4, "box"), (2, "ball"), (3, "ball"), (4, "ball")]
CASES += [pytest.param(*case, marks=pytest.mark.slow) for case in SLOW]


@pytest.mark.parametrize(("m", "kind"), CASES)
@pytest.mark.parametrize("noisy", [pytest.param(False, marks=pytest.mark.slow), True])
def test_shared_inputs_are_optimal(m, kind, noisy):
    admissible = admissible_set(kind, m)
    for seed in range(2):
        numbers, value, sigma = drawn(seed, m)
        sigma = sigma if noisy else None
        best, u, missed = map(np.asarray, found(problem_of(numbers, admissible, sigma), value))
        np.testing.assert_allclose(nearest(u, admissible), u, atol=1e-12)
        assert np.max(missed) < 1e-12 * np.max(np.abs(value)) / np.min(SPACING)
        for index in np.ndindex(SHAPE):
            node = Node(numbers, value, sigma, index)
            assert best[index] == pytest.approx(node(u[index]), abs=1e-11)  # H where it was found
            assert best[index] <= min(node.minimum(admissible), scanned(node, admissible)) + 1e-11
            assert best[index] >= node.minimum(admissible) - 1e-5  # what SLSQP leaves


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param("box", marks=pytest.mark.slow), "ball"])
def test_single_precision_is_as_good_as_its_rounding(kind):
    numbers, value, sigma = drawn(0, 3)
    problem = problem_of(numbers, admissible_set(kind, 3), sigma)
    double = found(problem, value)[0]
    single = found(problem, value, np.float32)[0]
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, double, atol=1e-5 * np.max(np.abs(double)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["box", "ball"])
def test_derivatives_of_the_optimum(kind):
    """Of H by every number of the problem, and of the action by one: against differences."""
    numbers, value, sigma = drawn(2, 3)
    numbers["Q"] = numbers["Q"] + 0.2 * np.eye(3)  # convex also a step further

    def best(numbers):
        return jnp.sum(found(problem_of(numbers, admissible_set(kind, 3), sigma), value)[0])

    def action(shift):
        moved = {**numbers, "l": numbers["l"] + shift * np.array([0.3, -0.2, 0.5])}
        return found(problem_of(moved, admissible_set(kind, 3), sigma), value)[1]

    slopes, h = jax.jit(jax.grad(best))(numbers), 1e-5
    for name, place in (("l", (0,)), ("b", (1,)), ("G", (1, 2)), ("Q", (0, 0)), ("Q", (1, 2))):
        ahead, behind = ({**numbers, name: numbers[name].copy()} for _ in range(2))
        ahead[name][place] += h
        behind[name][place] -= h
        assert float(slopes[name][place]) == pytest.approx(float(best(ahead) - best(behind)) / (2 * h), abs=1e-5)
    moves = jax.jvp(action, (0.0,), (1.0,))[1]
    differences = (action(h) - action(-h)) / (2 * h)
    assert np.mean(np.abs(differences) > 1e-3) > 0.2  # most are not held at an end or a kink
    np.testing.assert_allclose(moves, differences, atol=1e-4)


def test_a_cost_that_is_not_convex_is_known():
    rng, known = np.random.default_rng(0), jax.jit(is_convex)
    root = rng.normal(size=(4, 3, 200))
    convex = np.einsum("kin,kjn->ijn", root, root)
    assert np.all(known(jnp.asarray(convex)))
    assert np.all(known(jnp.asarray(root[0][:, None] * root[0][None])))  # of rank one
    assert not np.any(known(jnp.asarray(convex - 1.01 * np.linalg.eigvalsh(convex.T).T[0] * np.eye(3)[..., None])))
    assert not np.any(known(jnp.asarray(np.array([[0.0, 1.0], [1.0, 0.0]])[..., None])))


@pytest.mark.parametrize("m", [4, pytest.param(5, marks=pytest.mark.slow), pytest.param(6, marks=pytest.mark.slow)])
def test_singular_convex_costs_are_convex(m):
    """Rounding in the elimination grew with the number of inputs, and took 2 % of such costs for concave."""
    rng = np.random.default_rng(m)
    root = rng.normal(size=(m + 1, m + 1, 2000)) * rng.choice([0.0, 1.0], (m + 1, 1, 2000), p=[0.3, 0.7])
    whole = np.einsum("kin,kjn->ijn", root, root)
    reduced = whole[:m, :m] - whole[:m, m:] - whole[m:, :m] + whole[m:, m:]
    assert np.all(is_convex(jnp.asarray(reduced)))
    least = np.linalg.eigvalsh(reduced.T).T[0]
    assert not np.any(is_convex(jnp.asarray(reduced - (np.maximum(least, 0) + 1e-3) * np.eye(m)[..., None])))


def test_ends_that_only_the_boundary_of_the_set_respects():
    """u[0] = u[1] = u[2] = 0 is the only action at the corner; it was not found, so the problem was refused."""
    gain = -np.array([[3.0, 1, 0], [0, 1, 2]])
    bent = np.array([[1.0, 0.5, 0], [0.5, 1, 0.5], [0, 0.5, 1]])
    numbers = {"b": np.zeros(2), "G": gain, "l": np.array([-3.0, 0, -2]), "Q": bent}
    problem = problem_of(numbers, hjb.Box([0.0] * 3, [1.0] * 3))
    grid = hjb.Grid([0.0, 0.0], [1.0, 1.0], SHAPE, edges="constrained")

    @jax.jit
    def best(problem):
        on = Discretisation(problem, grid, hjb.Upwind(), np.dtype(np.float64))
        least, u, _ = optimum.optimise(discrete.around(on, jnp.zeros(SHAPE)))
        return least, jnp.stack(u, -1)

    least, u = best(problem)
    assert u[0, 0].tolist() == [0.0, 0.0, 0.0]
    wanted = np.full(SHAPE, -3.0)
    wanted[0], wanted[:, 0], wanted[0, 0] = -1, -2, 0
    np.testing.assert_allclose(least, wanted, atol=1e-12)


def test_where_it_is_not_convex_the_bound_holds():
    """An indefinite cost: the answer is hardly ever a local minimum only, and not further off than the bound says."""
    admissible, off = admissible_set("box", 3), []
    for seed in range(5):
        numbers, value, _ = drawn(seed, 3)
        numbers["Q"] = numbers["Q"] - 0.8 * np.eye(3)
        best, _, missed = map(np.asarray, found(problem_of(numbers, admissible), value))
        for index in np.ndindex(SHAPE):
            node = Node(numbers, value, None, index)
            least = scanned(node, admissible)
            assert best[index] - missed[index] <= least + 1e-9
            off.append(best[index] - least)
    assert np.mean(np.array(off) > 1e-3) < 0.1


# --- solves ---

B, K = np.array([[0, 1.4, 1.2], [-0.5, -0.3, -0.5]]), np.array([0.7, -1.8, 1.6])


def three_inputs(numbers):
    return hjb.Problem(
        Partial(drift, numbers), lambda x, u: x @ x + u @ u + K @ u, hjb.Box([-1.0] * 3, [1.0] * 3), discount=0.3
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the box decides V")
@pytest.mark.parametrize("scheme", [hjb.Upwind(), hjb.Limited()])
def test_three_inputs_on_two_components(scheme):
    """V exceeded that of 21 values per input by 0.0044 with ``Upwind`` and by 0.042 with ``Limited``."""
    problem = three_inputs({"b": np.array([0.3, -0.05]), "G": B})
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (11, 13))
    solution = hjb.solve(problem, grid, scheme=scheme, progress=False)
    assert (solution.bounds is not None) == scheme.monotone
    if not scheme.monotone:
        return
    # no action of 21 values per input is better than the value says, at the nodes away from the ends
    actions = problem.controls.grid(21).points
    value, speed = np.asarray(solution.value), actions @ B.T + np.array([0.3, -0.05])
    inner, spacing = value[1:-1, 1:-1, None], (2 / 10, 2 / 12)
    rate = np.sum(grid.nodes()[1:-1, 1:-1] ** 2, -1)[..., None] + np.sum(actions**2, -1) + actions @ K - 0.3 * inner
    for axis, (h, f) in enumerate(zip(spacing, speed.T, strict=True)):
        up, down = (np.roll(value, -step, axis)[1:-1, 1:-1, None] for step in (1, -1))
        rate = rate + np.maximum(f, 0) * (up - inner) / h + np.minimum(f, 0) * (inner - down) / h
    assert np.min(rate) > -0.3 * solution.error - 1e-9
