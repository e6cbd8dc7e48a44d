"""Errors that nobody expects, in a step of each stage: reported, and the nodes continue."""

from itertools import pairwise

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Twist
from support.doctor import Doctor
from support.failing_steps import FAILING

from thinmap_msgs.msg import TopologicalMap
from thinmap_ros.ros import qos

pytestmark = pytest.mark.live
STEPS = {
    'localizer': 'scan at ',
    'grid_mapper': 'localized_scan at ',
    'topology_builder': 'local_grid at ',
    'explorer': 'local_grid at ',
    'navigator': 'a callback ',
}


@pytest.mark.cpu_budget(20.0, 'a robot drives until three steps of each node have failed')
def test_each_node_goes_on_after_steps_that_failed(graph):
    doctor = Doctor(graph)
    commands = graph.heard('cmd_vel', Twist)
    graphs = graph.heard('topology', TopologicalMap, qos.LATCHED)
    graph.start(
        'failing_steps',
        package='support',
        arguments=('sim', *STEPS),
        start='2.0,2.0,0.0',
        initial_x_m=2.0,
        initial_y_m=2.0,
        initial_yaw_rad=0.0,
        use_sim_time=True,
        autostart_exploration=True,
        real_time_factor=2.0,
    )
    failed = str(FAILING)
    graph.until(
        lambda: all(doctor.value(node, 'failed steps') == failed for node in STEPS), 'all failed'
    )
    known = len(graphs)
    for node, step in STEPS.items():
        texts = {
            status.message
            for array in doctor.heard
            for status in array.status
            if status.name.startswith(node) and status.level == DiagnosticStatus.ERROR
        }
        assert texts
        for text in texts:
            assert text.startswith(step) and text.endswith('ZeroDivisionError: planted')
    # The navigator brakes by no more than 0.04 m/s from one command to the next.
    speeds = [(each.linear.x, each.angular.z) for each in commands]
    assert any(before[0] > 0.06 and after == (0.0, 0.0) for before, after in pairwise(speeds)), (
        'a stop without a ramp'
    )
    graph.until(lambda: all(doctor.level(node) == DiagnosticStatus.OK for node in STEPS), 'well')
    graph.until(lambda: len(graphs) > known, 'the graph grows')
    assert graph.log('failing_steps').count('Traceback') == len(STEPS)
    assert graph.stop('failing_steps') == 0
