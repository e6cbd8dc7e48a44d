"""The last command of a navigator is zero: it is stopped, or its clock stands."""

import signal

import pytest
from geometry_msgs.msg import Twist
from rosgraph_msgs.msg import Clock
from support.peers.standing_robot import StandingRobot

from thinmap_ros.ros import qos

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


def test_a_robot_stands_while_the_clock_of_its_navigator_stands_and_goes_on_with_it(graph):
    graph.start('navigator', laser_pose='0,0,0', use_sim_time=True)
    robot = StandingRobot(graph)
    clock = graph.node.create_publisher(Clock, '/clock', qos.STREAM)

    def run():
        clock.publish(Clock(clock=graph.node.get_clock().now().to_msg()))
        robot.stand()

    goal = robot.drive_to(4.0)
    graph.until(lambda: run() or is_driven(robot), 'it is driven')
    graph.until(lambda: not is_driven(robot), 'it stands')
    graph.until(lambda: 'the simulation is paused' in graph.log('navigator'), 'a report')
    graph.until(lambda: run() or is_driven(robot), 'it is driven again')
    assert not goal.get_result_async().done()
    assert graph.stop('navigator') == 0
