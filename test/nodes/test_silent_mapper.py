"""An explorer whose mapper has ended says so, and does not explore an old map by another name."""

import numpy as np
import pytest
import rclpy
from rclpy.time import Time
from support.localized import local_grid

from thinmap_ros.core.exploration.mission import MissionGoal
from thinmap_ros.core.exploration.strategy import FinishCode
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.nodes.explorer import ExplorerNode
from thinmap_ros.ros.diagnostics import WARN

pytestmark = pytest.mark.live
S = 1_000_000_000


@pytest.fixture
def explorer(ros_domain):
    words = ['--ros-args', '-p', 'use_sim_time:=true', '-p', 'laser_pose:=0,0,0']
    rclpy.init(args=words, domain_id=ros_domain)
    node = ExplorerNode()
    node.start()
    yield node
    node.close()
    node.destroy_node()
    rclpy.try_shutdown()


def pass_time(node, begin_s, end_s):
    """Let the clock run, without a jump."""
    clock = node.get_clock()
    for tenths in range(10 * begin_s, 10 * end_s + 1):
        now = Time(nanoseconds=tenths * S // 10, clock_type=clock.clock_type)
        clock.set_ros_time_override(now)


def diagnosis(node):
    status = node.diagnostics._status(0.0)
    return status.level, status.message


def test_a_mapper_that_has_ended_is_named_and_awaited(explorer):
    pass_time(explorer, 99, 100)
    explorer._start(MissionGoal())
    free = GridPatch(GridFrame(-2.0, -2.0, 0.1), np.zeros((40, 40), dtype=np.int8))
    explorer._source._on_local_grid(local_grid(free, np.zeros(3), 100 * S))
    silent = 'local_grid of grid_mapper silent for 3.0 s: nothing to explore with'
    assert silent not in diagnosis(explorer)
    pass_time(explorer, 100, 103)
    assert diagnosis(explorer) == (WARN, silent)
    explorer._source._grids._check._set(False)  # the graph has forgotten it
    assert not explorer._source._uses_foreign_map()
    pass_time(explorer, 103, 161)
    explorer._on_timer()
    end = explorer._mission.end
    assert end.code == FinishCode.SENSOR_TIMEOUT
    assert end.reason == 'no scan that shows anything on local_grid of grid_mapper for 60 s'
    explorer.reset('to use another map')
    assert explorer._source._uses_foreign_map()
