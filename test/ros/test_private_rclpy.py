"""Private names of rclpy: in one module, and there in the installed version."""

import ast
from pathlib import Path
from xml.etree import ElementTree

import pytest
import rclpy
from ament_index_python.packages import get_package_share_directory
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.lifecycle import LifecycleNode

import thinmap_ros
from thinmap_ros.ros.private_rclpy import RCLError, declared_names, given_parameters

PACKAGE = Path(thinmap_ros.__file__).parent
TRIED = '7.1.'
# Names of rclpy, in any module but one, and the module that it hides them in.
NAMES = (
    '_parameter_overrides',
    '_parameters',
    '_goal_handles',
    '_result_futures',
    '_update_state',
    '_time_source',
    '_wake_executor',
)
HIDDEN = ('rclpy.impl', 'rclpy._rclpy_pybind11')


def test_the_installed_version_was_tried():
    """With another one, run all live tests, and add it here."""
    description = Path(get_package_share_directory('rclpy')) / 'package.xml'
    version = ElementTree.parse(description).findtext('version')
    assert version is not None and version.startswith(TRIED)


@pytest.fixture
def node(ros_domain):
    rclpy.init(args=['--ros-args', '-p', 'one:=1'])
    made = LifecycleNode('some')
    yield made
    made.destroy_node()
    rclpy.shutdown()


def test_what_a_node_was_given_and_declares_is_found(node):
    assert {name: each.value for name, each in given_parameters(node).items()} == {'one': 1}
    assert 'one' not in declared_names(node)
    assert 'use_sim_time' in declared_names(node)
    given_parameters(node).clear()
    assert node.declare_parameter('one', 2).value == 2


def test_the_parts_of_an_action_server_have_their_names(node):
    server = ActionServer(node, NavigateToPose, 'navigate', lambda handle: None)
    assert server._goal_handles == server._result_futures == {}
    assert callable(ServerGoalHandle._update_state)
    server.destroy()


def test_errors_of_rcl_have_their_class(node):
    with pytest.raises(RCLError):
        node.trigger_activate()  # without a configuration


def test_no_other_module_uses_private_names():
    found = []
    for path in PACKAGE.rglob('*.py'):
        if path.name == 'private_rclpy.py' or 'rclpy' not in path.read_text():
            continue
        for each in ast.walk(ast.parse(path.read_text())):
            is_private = isinstance(each, ast.Attribute) and each.attr in NAMES
            is_hidden = isinstance(each, ast.ImportFrom) and str(each.module).startswith(HIDDEN)
            if is_private or is_hidden:
                found.append(f'{path.name}:{each.lineno}')
    assert not found
