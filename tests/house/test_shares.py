"""The shares of the long tests are together all of them."""

from pathlib import Path

import pytest
import shares

FILES = {Path(f"tests/{letter}/test_{number}.py") for letter in "abc" for number in range(7)}


@pytest.mark.parametrize("count", [1, 2, 3, 30])
def test_every_file_is_in_one_share(count):
    parts = [shares.select(FILES, f"{k}/{count}") for k in range(1, count + 1)]
    assert sum(map(len, parts)) == len(FILES)
    assert set().union(*parts) == FILES
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("share", ["0/3", "4/3", "2", "1/0", "a/b", ""])
def test_other_shares_are_refused(share):
    with pytest.raises(pytest.UsageError, match="--share"):
        shares.select(FILES, share)
