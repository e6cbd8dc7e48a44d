"""Invalid messages: their conversions give valid values, or an error of one line."""

import math
from collections import Counter

import numpy as np
import pytest
from fuzz.strange_messages import CHECKS, is_plain, is_rejected, made
from nav_msgs.msg import OccupancyGrid, Odometry

from thinmap_ros.ros import messages


@pytest.mark.parametrize('kind', CHECKS)
def test_conversions_give_sound_values_or_refuse_in_one_line(kind):
    rejected = Counter(is_rejected(message) for message in made(kind, 800))
    # Both occur often.
    assert rejected[True] > 80 and rejected[False] > 80


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_a_map_with_a_yaw_in_its_origin_is_resampled(sign):
    good = next(m for m in made(OccupancyGrid, 40) if not is_rejected(m) and is_plain(m))
    good.info.origin.orientation = messages.quaternion_msg(sign * math.pi / 2)
    patch = messages.grid_from_msg(good)
    cells = np.array(good.data, dtype=np.int8).reshape(40, 40)
    assert np.array_equal(patch.cells, np.rot90(cells[::-1], int(sign))[::-1])


@pytest.mark.parametrize(
    ('sec', 'nanosec', 'rejected'),
    [(0, 0, False), (-1, 0, True), (1, 10**9 - 1, False), (1, 10**9, True), (1, 2**32 - 1, True)],
)
def test_stamps(sec, nanosec, rejected):
    good = next(message for message in made(Odometry, 40) if not is_rejected(message))
    good.header.stamp.sec = sec
    good.header.stamp.nanosec = nanosec
    assert is_rejected(good) == rejected
