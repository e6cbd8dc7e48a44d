"""TUM trajectories: stamps to the nanosecond, poses to six digits."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.files.trajectories import read_tum, write_tum

POSE = st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-math.pi, math.pi))


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 2**62), POSE), max_size=20))
def test_round_trip(tmp_path: Path, samples: list[tuple[int, tuple[float, float, float]]]) -> None:
    stamps = [s for s, _ in samples]
    poses = [np.array(p) for _, p in samples]
    write_tum(tmp_path / 't.tum', stamps, poses)
    stamps_again, poses_again = read_tum(tmp_path / 't.tum')
    assert stamps_again == stamps
    assert poses_again.shape == (len(samples), 3)
    for pose, again in zip(poses, poses_again, strict=True):
        assert again[:2] == pytest.approx(pose[:2], abs=1e-6)
        assert abs(se2.wrap(float(again[2] - pose[2]))) < 1e-8


def test_the_text(tmp_path: Path) -> None:
    write_tum(tmp_path / 't.tum', [976052857_337530001], [np.array([1.0, -2.5, math.pi / 2])])
    line = (tmp_path / 't.tum').read_text()
    assert line == '976052857.337530001 1.000000 -2.500000 0 0 0 0.707106781 0.707106781\n'


def test_comments_and_short_fractions(tmp_path: Path) -> None:
    (tmp_path / 't.tum').write_text(
        '# t x y z qx qy qz qw\n\n1.5 0 0 0 0 0 0 1 # here\n2 1 0 0 0 0 1 0\n'
    )
    stamps, poses = read_tum(tmp_path / 't.tum')
    assert stamps == [1_500_000_000, 2_000_000_000]
    assert poses == pytest.approx(np.array([[0, 0, 0], [1, 0, math.pi]]))


@pytest.mark.parametrize(
    'line',
    ['1 2 3', 'a 0 0 0 0 0 0 1', '1 0 0 0 0 0 0 x', '1 nan 0 0 0 0 0 1', '1e9 0 0 0 0 0 0 1'],
)
def test_errors_are_reported(tmp_path: Path, line: str) -> None:
    (tmp_path / 't.tum').write_text('0 0 0 0 0 0 0 1\n' + line + '\n')
    with pytest.raises(InputError, match=r't\.tum:2: '):
        read_tum(tmp_path / 't.tum')


@settings(
    deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.binary(max_size=100))
def test_arbitrary_bytes(tmp_path: Path, content: bytes) -> None:
    (tmp_path / 't.tum').write_bytes(content)
    try:
        read_tum(tmp_path / 't.tum')
    except InputError as error:
        assert '\n' not in str(error)
