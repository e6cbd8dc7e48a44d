"""What opens or leaves before the robot does not put it into another place."""

import numpy as np
import pytest
from support.slam_room import scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.localizer import Localizer

PERIOD_NS = 200_000_000
ROOMS = np.array(
    [
        [-6.0, -3.0, 2.0, -3.0],
        [-6.0, 3.0, 2.0, 3.0],
        [-6.0, -3.0, -6.0, 3.0],
        [2.0, -3.0, 2.0, -1.1],
        [2.0, 1.1, 2.0, 3.0],
        # behind the door
        [2.0, -4.0, 9.0, -4.0],
        [2.0, 4.0, 9.0, 4.0],
        [9.0, -4.0, 9.0, 4.0],
        [2.0, -4.0, 2.0, -3.0],
        [2.0, 3.0, 2.0, 4.0],
    ]
)
DOOR = np.array([[2.0, -1.1, 2.0, 1.1]])
CART = np.array([[1.2, -1.3, 1.2, 1.3], [1.2, -1.3, 2.0, -1.3], [1.2, 1.3, 2.0, 1.3]])
CROWD = np.array([[1.5, y, 1.5, y + 0.4] for y in (-1.2, -0.5, 0.2, 0.9)])
# Motions between scans: the robot looks around as it comes to the door, and drives through it.
COMES = [se2.pose(0.1, 0.0, 0.25 if k % 4 in (0, 3) else -0.25) for k in range(44)]
DRIVES = [se2.pose(0.05, 0.0, 0.0) for _ in range(100)]


@pytest.mark.parametrize('way', [DOOR, CART, CROWD], ids=['door', 'cart', 'crowd'])
def test_a_robot_that_drives_through_where_it_was_stays_in_its_map(way):
    rng = np.random.default_rng(1)
    localizer = Localizer()
    odom = np.zeros(3)
    start = se2.pose(-4.0, 0.0, 0.0)
    closed = np.vstack([ROOMS, way])
    for k, motion in enumerate([np.zeros(3), *COMES, *DRIVES]):
        odom = se2.compose(odom, motion)
        truth = se2.compose(start, odom)
        scan = scan_in(closed if k <= len(COMES) else ROOMS, truth, rng, k * PERIOD_NS)
        estimate = localizer.step(scan, odom)
        assert not estimate.is_lost, k
    off = se2.between(odom, estimate.T_map_base)
    assert np.hypot(off[0], off[1]) < 0.1
