"""Refusal of a cost that nothing ends."""

import pytest
from small_problems import GRID, U, drift, in_disc

from hjbjax import Problem
from hjbjax.well_posedness import endless_costs


def test_an_endless_cost_is_refused_with_what_would_end_it():
    with pytest.raises(ValueError, match="no finite solution: discount = 0") as caught:
        endless_costs.ill_posed(Problem(drift, controls=U), has_rest=False, grid=GRID)
    message = str(caught.value)
    assert "discount > 0" in message
    assert "target" in message
    assert "rest point" in message
    assert len(message.splitlines()) <= 6


@pytest.mark.parametrize(
    ("ingredients", "has_rest"),
    [
        *(({"discount": 0.1}, False), ({"target": in_disc}, False), ({"stopping_cost": 1.0}, False)),
        *(({"running_max": in_disc}, False), ({}, True)),
    ],
)
def test_what_ends_an_endless_cost(ingredients, has_rest):
    endless_costs.ill_posed(Problem(drift, controls=U, **ingredients), has_rest=has_rest, grid=GRID)
