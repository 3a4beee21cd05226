"""Shares of the tests, for runs that together run all tests."""

import re
from collections import Counter
from collections.abc import Collection

import pytest


def select(tests: Collection[str], share: str) -> set[str]:
    """The tests of one share, such as "2/3", in which neighbours in alphabetical order are in different shares.

    The cases of a test function stay together, because they often share compiled programs, unless the function has more
    cases than there are shares.

    Raises:
      pytest.UsageError: the share is not K/N with 1 ≤ K ≤ N.
    """
    found = re.fullmatch(r"([1-9]\d*)/([1-9]\d*)", share)
    if found is None or int(found[1]) > int(found[2]):
        raise pytest.UsageError(f"--share={share}: wanted K/N with 1 <= K <= N, such as 2/3")
    number, count = int(found[1]), int(found[2])
    cases = Counter(map(_function, tests))
    units = {test: test if cases[_function(test)] > count else _function(test) for test in tests}
    chosen = set(sorted(set(units.values()))[number - 1 :: count])
    return {test for test in tests if units[test] in chosen}


def _function(test: str) -> str:
    return test.partition("[")[0]
