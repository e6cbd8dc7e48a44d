"""A navigator that is stopped: its last command is zero, and arrives before the node is gone."""

import signal

import pytest
from geometry_msgs.msg import Twist
from support.peers.standing_robot import StandingRobot

pytestmark = pytest.mark.live


def start_robots(graph, count):
    """Robots in namespaces of their own, by name: some have to turn first."""
    robots = {}
    for k in range(count):
        name = f'robot_{k}'
        # The last one is beside other nodes, in one process.
        program = 'navigator' if k < count - 1 else 'thinmap'
        nodes = () if program == 'navigator' else ('explorer', 'navigator')
        remap = (f'__ns:=/{name}',)
        graph.start(program, label=name, remap=remap, arguments=nodes, laser_pose='0,0,0')
        robots[name] = StandingRobot(graph, name)
        robots[name].drive_to(4.0 if k % 2 else -4.0)
    return robots


def is_driven(robot):
    last = robot.commands[-1] if robot.commands else Twist()
    return abs(last.linear.x) + abs(last.angular.z) > 0.0


@pytest.mark.parametrize(
    'number', [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_the_last_command_of_a_navigator_is_zero(graph, number):
    robots = start_robots(graph, 4)
    for name, robot in robots.items():
        graph.until(lambda r=robot: r.stand() or is_driven(r), f'{name} is driven')
        assert graph.stop(name, number) == 0
        graph.until(lambda r=robot: not is_driven(r), f'{name} stands', seconds=20.0)
