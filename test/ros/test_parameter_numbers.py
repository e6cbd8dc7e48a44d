"""Numbers that no parameter of a node can have."""

import math

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from thinmap_ros.core.errors import ConfigError
from thinmap_ros.nodes.global_localizer import GlobalLocalizerConfig
from thinmap_ros.ros.parameters import declare_config, declare_parameter, declare_recovery

pytestmark = pytest.mark.live
NONSENSE = (math.nan, math.inf, -math.inf, 1e300)


@pytest.fixture
def node_with(ros_domain):
    """Makes a node that was started with a value of a parameter."""
    context = Context()
    rclpy.init(context=context, domain_id=ros_domain)
    nodes = []

    def make(name, value):
        override = Parameter(name, value=value)
        nodes.append(Node('tested', context=context, parameter_overrides=[override]))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.mark.parametrize('value', [*NONSENSE, -1e9])
def test_the_time_for_which_a_robot_is_lost(node_with, value):
    with pytest.raises(ConfigError, match='lost_timeout_s = '):
        declare_config(node_with('lost_timeout_s', value), GlobalLocalizerConfig)


@pytest.mark.parametrize('value', [*NONSENSE, -1.0])
def test_the_age_of_a_checkpoint(node_with, value):
    with pytest.raises(ConfigError, match='recovery_timeout_s = '):
        declare_recovery(node_with('recovery_timeout_s', value))


@pytest.mark.parametrize('value', NONSENSE)
def test_a_number_without_a_range(node_with, value):
    with pytest.raises(ConfigError, match=r'any_s = .*: expected'):
        declare_parameter(node_with('any_s', value), 'any_s', 1.0, 'Any time (s).')


def test_a_number_within_its_range(node_with):
    node = node_with('any_s', 2.0)
    assert declare_parameter(node, 'any_s', 1.0, 'Any time (s).', low=0.0, high=2.0) == 2.0
    with pytest.raises(ConfigError, match=r'other_s = 1.0: expected at most 0.5'):
        declare_parameter(node, 'other_s', 1.0, 'Another time (s).', high=0.5)
