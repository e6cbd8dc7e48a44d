"""Damaged MCAP files.

Whatever happened to a bag, what is whole is read, and no program ends in a traceback.
"""

from pathlib import Path

import pytest
from fuzz.damaged_bags import CASES, run_cases, whole_bags


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return whole_bags(tmp_path_factory.mktemp('whole'))


def test_no_damage_ends_in_a_traceback(whole: dict[str, bytes], tmp_path: Path) -> None:
    ends = run_cases(whole, tmp_path, seed=0, count=CASES)
    assert ends['repaired'] > ends.total() / 2
