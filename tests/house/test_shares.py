"""The shares of the long tests are together all of them."""

import pytest
import shares

FUNCTIONS = {f"tests/{letter}/test_{letter}.py::test_{name}" for letter in "ab" for name in ("one", "two", "three")}
PAGES = {f"tests/house/test_pages.py::test_page[{page}-x[0]]" for page in range(20)}
CASES = {f"tests/c/test_c.py::test_cases[{case}]" for case in ("first", "second")}
TESTS = FUNCTIONS | PAGES | CASES


@pytest.mark.parametrize("count", [1, 2, 3, 30])
def test_every_test_is_in_one_share(count):
    parts = [shares.select(TESTS, f"{k}/{count}") for k in range(1, count + 1)]
    assert sum(map(len, parts)) == len(TESTS)
    assert set().union(*parts) == TESTS
    assert sum(part >= CASES for part in parts) == 1
    for tests in (FUNCTIONS, PAGES) if count < 20 else ():
        sizes = [len(part & tests) for part in parts]
        assert max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize("share", ["0/3", "4/3", "2", "1/0", "a/b", ""])
def test_other_shares_are_refused(share):
    with pytest.raises(pytest.UsageError, match="--share"):
        shares.select(TESTS, share)
