"""The minimum of a quadratic polynomial over an interval of controls is within its bounds, which are narrow."""

import numpy as np
import pytest

from hjbjax.enclosure import minimum
from hjbjax.tracing.intervals import Interval, point, quietly
from hjbjax.tracing.taylor_forms import Form

COUNT = 400


def exact(b, c, lo, hi):
    """The least of b u + c u² at the ends and at the vertex."""
    tried = [end for end in (lo, hi) if np.isfinite(end)] + [np.clip(-b / (2 * np.where(c == 0, 1e-300, c)), lo, hi)]
    return np.min([b * u + c * u**2 for u in tried], axis=0)


@pytest.mark.parametrize(("lo", "hi"), [(-1.0, 2.0), (0.5, 0.5), (-1.0, np.inf), (-np.inf, np.inf)])
@pytest.mark.parametrize("least", [0.1, 0.0, -1.0])
def test_the_minimum_of_a_quadratic_polynomial_is_within_its_bounds(lo, hi, least):
    if least <= 0 and not np.isfinite(hi - lo):
        pytest.skip("no minimum")
    draw = np.random.default_rng(4)
    b, c = draw.normal(scale=2, size=COUNT), draw.uniform(least, 2, COUNT)
    c[::5] = least
    width = 0.1 * draw.uniform(size=COUNT)

    def form(middle):
        return Form(Interval(middle - width, middle + width), point(middle), (point(1.0),), (point(1.0),))

    found, actions, near = quietly(minimum.least_quadratic)(form(b), Form(point(c), point(c)), lo, hi)
    value = exact(b, c, lo, hi)
    assert np.all((found.centre.lo <= value) & (value <= found.centre.hi))
    # where c may be negative the bounds at the centre are those of the ends
    narrow = c >= 0
    assert np.all((found.centre.hi - found.centre.lo)[narrow] < 1e-12 * (1 + np.abs(value[narrow])))
    assert np.all((near >= lo) & (near <= hi))
    for share in (-1.0, -0.3, 0.0, 0.7, 1.0):
        moved = exact(b + share * width, c, lo, hi)
        assert np.all((found.range.lo <= moved + 1e-14) & (moved - 1e-14 <= found.range.hi))
        vertex = np.clip(-(b + share * width) / (2 * np.where(c > 0, c, 1.0)), lo, hi)
        assert np.all(((actions.lo - 1e-14 <= vertex) & (vertex <= actions.hi + 1e-14))[c > 0])
