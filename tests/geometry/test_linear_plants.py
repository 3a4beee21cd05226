"""All verdicts on random linear plants against the exact theory of linear systems, and against one another.

The oracle works on rationals with SymPy: the pencil (sI − A, b) of Popov, Belevitch and Hautus has maximal minors
whose greatest common divisor has the degree of what is out of reach, and the determinant of the system matrix
(sI − A, b; −c, 0) has as many zeros as the plant: its relative degree is n less their number.
"""

from fractions import Fraction

import numpy as np
import pytest
import sympy
from linear_plants import Linear

from hjbjax import geometry
from hjbjax.geometry import stability

pytestmark = pytest.mark.usefixtures("float64")
S = sympy.Symbol("s")
N = 3


def dense(random):
    """A plant of integers in coordinates that hide which states are out of reach."""
    reached = random.integers(1, N + 1)
    a, b, c = random.integers(-3, 4, (N, N)), random.integers(-2, 3, N), random.integers(-2, 3, N)
    a[reached:, :reached], b[reached:] = 0, 0
    for _ in range(2 * N):
        i, j = random.choice(N, 2, replace=False)
        sign = random.integers(-1, 2)
        a[i] += sign * a[j]
        a[:, j] -= sign * a[:, i]
        b[i] += sign * b[j]
    return a.astype(float), b.astype(float), c.astype(float)


def stiff(random):
    """A sparse plant whose states move at rates from 1e-6 to 1e6: powers of two, which round nothing."""
    rates = 2.0 ** random.integers(-20, 21, N)
    a = rates[:, None] * random.integers(-3, 4, (N, N)) * (random.uniform(size=(N, N)) < 0.6)
    kept = random.uniform(size=(2, N)) < 0.6
    return a, rates * random.integers(-2, 3, N) * kept[0], random.integers(-2, 3, N) * kept[1].astype(float)


def exact(matrix):
    rows = np.atleast_2d(matrix).tolist()
    return sympy.Matrix([[sympy.Rational(Fraction(entry)) for entry in row] for row in rows])


def out_of_reach(a, b):
    """The degree of the greatest common divisor of the maximal minors of (sI − A, b)."""
    pencil = (S * sympy.eye(N) - a).row_join(b)
    minors = [pencil.extract(list(range(N)), [j for j in range(N + 1) if j != left]).det() for left in range(N + 1)]
    return sympy.degree(sympy.gcd_list([sympy.expand(minor) for minor in minors]), S)


def is_clear(a, b):
    """Whether b, Ab, A²b lie apart by more than 1e-6 in units that make rows and columns of their matrix alike."""
    a, b = exact(a), exact(b).T
    krylov = np.array(sympy.Matrix.hstack(*[a**k * b for k in range(N)]), float)
    for _ in range(200):
        for axis in (0, 1):
            size = np.linalg.norm(krylov, axis=axis, keepdims=True)
            krylov = krylov / np.where(size > 0, size, 1)
    values = np.linalg.svd(krylov, compute_uv=False)
    return not np.any((values > 1e-15) & (values < 1e-6 * values[0]))


def theory(a, b, c):
    """Ranks of reachability and observability, relative degree or None, and whether (A, b) has full rank."""
    a, b, c = exact(a), exact(b).T, exact(c)
    matrix = (S * sympy.eye(N) - a).row_join(b).col_join((-c).row_join(sympy.zeros(1, 1)))
    zeros = sympy.expand(matrix.det())
    degree = None if zeros == 0 else N - sympy.degree(zeros, S)
    return N - out_of_reach(a, b), N - out_of_reach(a.T, c.T), degree, a.row_join(b).rank() == N


def verdicts(plant):
    origin = np.zeros(N)
    degree = geometry.relative_degree(plant.drift, plant.push, plant.output, origin)
    return (
        geometry.reachability_distribution(plant.drift, plant.push, origin, N - 1).rank,
        geometry.observability_codistribution(plant.drift, [], plant.output, origin, N - 1).rank,
        degree.degree,
        stability.brockett_check(plant.drift, plant.push, origin).satisfied is True,
        geometry.is_feedback_linearisable(plant.drift, plant.push, origin).linearisable,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "spread"), [(dense, 6), (stiff, 1.5)], ids=["dense", "stiff"])
def test_verdicts_on_linear_plants_are_those_of_the_theory_in_any_units(kind, spread):
    """100 plants; every state, the time and the input in units up to 1e12 apart.

    Stiff ones have them 1e3 apart: with rates 1e12 apart as well an entry may look like the rounding of another.
    """
    met, unclear = set(), 0
    for seed in range(100):
        random = np.random.default_rng(seed)
        a, b, c = kind(random)
        reached, seen, degree, onto = theory(a, b, c)
        units, time, size = 10 ** random.uniform(-spread, spread, N), *10 ** random.uniform(-spread, spread, 2)
        found = verdicts(Linear(time * units[:, None] * a / units, size * units * b, c / units))
        # past the tolerance a rank may be missed; none is invented, and verdicts by other ways stay as they are
        clear = is_clear(a, b), is_clear(a.T, c)
        unclear += not all(clear)
        wanted = (reached if clear[0] else min(found[0], reached), seen if clear[1] else min(found[1], seen))
        wanted += (degree, onto, wanted[0] == N)
        assert found == wanted, (seed, a, b, c, found)
        met |= {("reached", reached), ("seen", seen), ("degree", degree), ("onto", onto)}
        # an output of full degree proves reach, sight and linearisability
        assert degree != N or (reached == seen == N and onto)
    assert unclear <= 15
    assert len(met) >= 11  # of reach and sight 0 to 3, degrees None to 3, onto or not: nearly every case
