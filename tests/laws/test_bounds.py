"""Random problems beside the dense oracle: what is certified holds, and nothing is said that is not so.

``python -m benchmarks bounds`` draws 2,000 of them and prints a table.
"""

import numpy as np
import pytest
from agreement import compare
from hypothesis import HealthCheck, Phase, given, settings
from random_problems import BY_NAME, FAMILIES, draw
from systems import SEEDS

OFTEN = ("line", "line, stop", "reach, line", "game, finite")
EACH, SOME = 16, 4  # problems drawn of one of these families, and of one of the others

# Shrinking the seed of a generator makes nothing simpler.
laws = settings(max_examples=EACH, phases=[Phase.explicit, Phase.reuse, Phase.generate],
                suppress_health_check=[HealthCheck.too_slow])  # fmt: skip


def holds(name, seed):
    rng = np.random.default_rng(seed)
    verdict = compare(draw(BY_NAME[name], rng), rng)
    assert not verdict.complaints, f"{name}: {'; '.join(verdict.complaints)}"


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name != "game, finite" else name for name in OFTEN]
)
@given(seed=SEEDS)
@laws
def test_what_is_certified_holds(name, seed):
    holds(name, seed)


@pytest.mark.slow
def test_what_is_certified_holds_on_a_ridge_along_which_the_oracle_is_slow():
    holds("game, line", 959)


@pytest.mark.slow
@pytest.mark.parametrize("name", [family.name for family in FAMILIES if family.name not in OFTEN])
@given(seed=SEEDS)
@settings(laws, max_examples=SOME)
def test_what_is_certified_holds_in_every_family(name, seed):
    holds(name, seed)
