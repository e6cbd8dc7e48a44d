"""The map that the navigator plans on, and whether the pose is in it."""

import numpy as np
import pytest
from support.localized import local_grid

from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.nodes.navigation.map_input import MapInput
from thinmap_ros.ros import messages


def patch(side):
    return GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((side, side), dtype=np.int8))


def grid(side, map_id):
    return messages.probability_grid_msg(patch(side), 'map', 0, map_id=map_id)


@pytest.mark.parametrize(
    ('grid_id', 'pose_id', 'stops'), [(0, 0, False), (7, 7, False), (0, 7, False), (7, 8, True)]
)
def test_a_pose_in_another_map_is_a_reason_to_stop(grid_id, pose_id, stops):
    map_input = MapInput()
    map_input._on_grid(grid(20, grid_id))
    map_input.pose_map_id = pose_id
    assert bool(map_input.fault) == stops
    map_input.reset()
    assert not map_input.fault


@pytest.mark.parametrize(('map_id', 'side'), [(7, 20), (0, 20), (8, 10)])
def test_a_window_of_another_map_is_not_pasted_into_the_old_one(map_id, side):
    map_input = MapInput()
    map_input._on_grid(grid(20, 7))
    map_input._on_local_grid(local_grid(patch(10), np.zeros(3), 0, map_id=map_id))
    assert map_input.patch.shape == (side, side)
