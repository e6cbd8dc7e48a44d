"""Each preset lets a page stop and drive the robot, whichever type its base subscribes to."""

from pathlib import Path

import pytest
import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.executors import SingleThreadedExecutor
from support.live_graph import graph as graph

from thinmap_ros.nodes.navigator import NavigatorNode
from thinmap_ros.nodes.web import WebNode
from thinmap_ros.ros import messages
from thinmap_ros.web.requests import Request

pytestmark = pytest.mark.live
PRESETS = sorted((Path(__file__).parents[2] / 'config' / 'robots').glob('*.yaml'))
PAGE = 1


def twist_of(message):
    return message.twist if isinstance(message, TwistStamped) else message


@pytest.fixture(params=PRESETS, ids=lambda path: path.stem)
def spin(request, ros_domain):
    """Navigator and page in one process."""
    values = ['-p', 'web:port:=0', '--params-file', str(request.param)]
    rclpy.init(args=['--ros-args', *values], domain_id=ros_domain)
    nodes = [NavigatorNode(), WebNode()]
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
        node.start()
    yield nodes[1]._steering, lambda: executor.spin_once(timeout_sec=0.0)
    for node in nodes:
        node.close()
        node.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.parametrize('kind', [Twist, TwistStamped])
def test_a_page_stops_and_drives_the_robot(spin, graph, kind):
    steering, spin_nodes = spin
    steering.stop()  # before anybody subscribes
    spin_nodes()
    heard = graph.heard('cmd_vel', kind)

    def is_heard(velocity):
        spin_nodes()
        return bool(heard) and twist_of(heard[-1]) == velocity

    graph.until(lambda: is_heard(Twist()), 'the base is stopped')
    steering.requested(PAGE, Request('release', {'stop': steering._held.number}))
    graph.until(lambda: spin_nodes() or not steering._held.is_on, 'released')

    def drives():
        steering.requested(PAGE, Request('drive', {'ahead': 0.5, 'left': 0.0}))
        return is_heard(messages.twist_msg(0.15, 0.0))

    graph.until(drives, 'the joystick moves the robot')
