"""What the pipeline puts on the map."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.stage import Estimate
from thinmap_ros.pipeline import Pipeline

HERE = se2.pose(2.0, 2.0, 0.0)


@pytest.mark.parametrize(
    ('state', 'is_mapped'),
    [({}, True), ({'is_lost': True}, False), ({'blind_reason': 'no returns'}, False)],
)
def test_scans_of_a_lost_robot_or_a_blind_laser_change_no_cell(state, is_mapped):
    known = Estimate(HERE, np.zeros((3, 3)), HERE)
    estimates = [known, replace(known, **state)]
    pipeline = Pipeline(pose_source=lambda scan, T_odom_base: estimates.pop(0))
    wall = scan_in(ROOM, HERE)
    pipeline.step(wall, HERE)
    before = pipeline.grid.known_area()
    pipeline.step(replace(wall, ranges_m=np.full_like(wall.ranges_m, np.inf)), HERE)
    after = pipeline.grid.known_area()
    is_same = before.shape == after.shape and bool((before.cells == after.cells).all())
    assert is_same != is_mapped
