"""The map that the navigator plans on, and whether the pose is in it."""

import numpy as np
import pytest
from rclpy.clock import ROSClock
from rclpy.time import Time
from support.localized import local_grid

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.nodes.parts.driving import MapInput, MapTimeoutConfig
from thinmap_ros.ros import messages
from thinmap_ros.ros.time_jumps import ElapsedTime

S = 1_000_000_000
SCAN_NS = S // 5


class Mapped:
    """The map of a navigator at a simulated time, and what grid_mapper publishes of each scan."""

    def __init__(self, timeout_s=MapTimeoutConfig.map_timeout_s):
        self.clock = ROSClock()
        self.clock._set_ros_time_is_active(True)
        self.ns = 100 * S
        self.input = MapInput(ElapsedTime(self.clock), timeout_s)

    def pass_time(self, seconds, publishers=1, late_ns=0):
        """Time in which so many mappers publish local_grid for each scan."""
        for _ in range(round(seconds * S / SCAN_NS)):
            self.ns += SCAN_NS
            now = Time(nanoseconds=self.ns, clock_type=self.clock.clock_type)
            self.clock.set_ros_time_override(now)
            for _ in range(publishers):
                message = local_grid(patch(10), np.zeros(3), self.ns - late_ns)
                self.input._on_local_grid(message)


def patch(side):
    return GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((side, side), dtype=np.int8))


def grid(side, map_id):
    return messages.probability_grid_msg(patch(side), 'map', 0, map_id=map_id)


@pytest.mark.parametrize(
    ('grid_id', 'pose_id', 'stops'), [(0, 0, False), (7, 7, False), (0, 7, False), (7, 8, True)]
)
def test_a_pose_in_another_map_is_a_reason_to_stop(grid_id, pose_id, stops):
    map_input = Mapped().input
    map_input._on_grid(grid(20, grid_id))
    map_input.pose_map_id = pose_id
    assert bool(map_input.fault) == stops
    map_input.reset()
    assert not map_input.fault


@pytest.mark.parametrize(('map_id', 'side'), [(7, 20), (0, 20), (8, 10)])
def test_a_window_of_another_map_is_not_pasted_into_the_old_one(map_id, side):
    map_input = Mapped().input
    map_input._on_grid(grid(20, 7))
    map_input._on_local_grid(local_grid(patch(10), np.zeros(3), 0, map_id=map_id))
    assert map_input.patch.shape == (side, side)


def test_a_mapper_that_is_silent_is_reported_then_a_reason_to_stop():
    mapped = Mapped()
    mapped.pass_time(3.0)
    assert not mapped.input.warning and not mapped.input.fault
    mapped.pass_time(2.4, publishers=0)
    assert mapped.input.warning.startswith('grid_mapper silent for 2.')
    assert not mapped.input.fault
    mapped.pass_time(3.0, publishers=0)
    assert mapped.input.fault.startswith('grid_mapper silent for 5.')
    mapped.pass_time(0.2)
    assert not mapped.input.warning and not mapped.input.fault


def test_a_mapper_that_lags_behind_is_as_a_silent_one():
    mapped = Mapped()
    mapped.pass_time(3.0)
    mapped.pass_time(3.0, publishers=0)
    mapped.pass_time(1.0, late_ns=3 * S)
    assert 's late: expected at most 2.0 s' in mapped.input.warning and not mapped.input.fault
    mapped.pass_time(3.0, publishers=0)
    mapped.pass_time(1.0, late_ns=6 * S)
    assert 's late: expected at most 5.0 s' in mapped.input.fault


def test_the_time_out_of_the_map_can_be_longer_or_none():
    for timeout_s in (0.0, 30.0):
        mapped = Mapped(timeout_s)
        mapped.pass_time(3.0)
        mapped.pass_time(20.0, publishers=0)
        assert mapped.input.warning and not mapped.input.fault
    mapped.pass_time(20.0, publishers=0)
    assert mapped.input.fault


def test_a_map_of_another_node_has_no_time_out():
    mapped = Mapped()
    mapped.input._on_map(patch(20))
    mapped.pass_time(1000.0, publishers=0)
    assert not mapped.input.warning and not mapped.input.fault


def test_two_mappers_are_told_from_one_that_repeats_itself_once():
    mapped = Mapped()
    mapped.pass_time(3.0)
    mapped.pass_time(0.2, publishers=2)
    assert not mapped.input.has_two_mappers()
    mapped.pass_time(0.4, publishers=2)
    assert mapped.input.has_two_mappers()
    mapped.pass_time(3.0)
    assert not mapped.input.has_two_mappers()
