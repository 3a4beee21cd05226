"""Shares of the test files, for runs that together run all tests."""

import re
from collections.abc import Set
from pathlib import Path

import pytest


def select(files: Set[Path], share: str) -> set[Path]:
    """The files of one share, such as "2/3", in which neighbours in alphabetical order are in different shares.

    Raises:
      pytest.UsageError: the share is not K/N with 1 ≤ K ≤ N.
    """
    found = re.fullmatch(r"([1-9]\d*)/([1-9]\d*)", share)
    if found is None or int(found[1]) > int(found[2]):
        raise pytest.UsageError(f"--share={share}: wanted K/N with 1 <= K <= N, such as 2/3")
    return set(sorted(files)[int(found[1]) - 1 :: int(found[2])])
