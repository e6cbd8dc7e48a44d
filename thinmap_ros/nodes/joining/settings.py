"""Parameters of the node map_joiner; names as in m-explore's map_merge where it has them."""

import math
import re
from dataclasses import dataclass

from rclpy.node import Node

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.places.recognition import JOIN_ODDS
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import parameters
from thinmap_ros.ros.private_rclpy import given_parameters

# As map_merge names them: /robot1/map_merge/init_pose_x.
_INITIAL_POSE = re.compile(r'(/\S*)/map_merge/init_pose_(x|y|z|yaw)')
_CONFIDENCE = 'estimation_confidence'


@dataclass(frozen=True)
class MapJoinerConfig(Config):
    """Which maps are joined, when, and under which names the joint map is published."""

    robot_map_topic: str = parameter(
        'map', 'Name of the maps of the robots (nav_msgs/OccupancyGrid), without their namespaces.'
    )
    robot_map_updates_topic: str = parameter(
        '',
        'Name of the updates of these maps (map_msgs/OccupancyGridUpdate). Empty: robot_map_topic '
        'with _updates.',
    )
    robot_namespace: str = parameter(
        '', 'Join only maps with this in the name of their topic. Empty: all maps.'
    )
    merged_map_topic: str = parameter('merged_map', 'Name of the joint map that is published.')
    world_frame: str = parameter('world', 'Frame of the joint map.')
    known_init_poses: bool = parameter(
        False,
        'Begin with the poses of /ROBOT/map_merge/init_pose_x, _y and _yaw, which scans refine. '
        'false: the place of each map is searched for.',
    )
    merging_rate: float = parameter(
        1.0,
        'Greatest rate of the joint map (Hz). Lower it to save CPU with many large maps.',
        low=0.001,
        high=100.0,
    )
    discovery_rate: float = parameter(
        0.5, 'Rate at which new robots are looked for (Hz).', low=0.001, high=100.0
    )
    estimation_rate: float = parameter(
        0.5,
        'Greatest rate of searches for the place of a map in another one (Hz). Lower it to save '
        'CPU; maps are then joined later.',
        low=0.001,
        high=100.0,
    )
    join_odds: float = parameter(
        JOIN_ODDS,
        'Odds of its place with which a map is joined. Raise it where parts of the building look '
        'alike; joins then come later.',
        low=10.0,
        high=1e12,
    )


def declare_initial_poses(node: Node) -> dict[str, Array]:
    """Declare the initial poses that the node was given, by the namespace of the robot, (3,)."""
    found = [_INITIAL_POSE.fullmatch(name) for name in given_parameters(node)]
    poses: dict[str, dict[str, float]] = {}
    for match in found:
        if match is not None:
            value = parameters.declare_parameter(
                node, match[0], 0.0, 'Initial pose of the robot in the world (m, rad).'
            )
            poses.setdefault(match[1], {})[match[2]] = float(value)
    return {
        name: se2.pose(*(given.get(axis, 0.0) for axis in ('x', 'y', 'yaw')))
        for name, given in poses.items()
    }


def warn_of_confidence(node: Node) -> None:
    """Name the parameter that takes the place of map_merge's confidence."""
    if given_parameters(node).pop(_CONFIDENCE, None) is not None:
        node.get_logger().warning(
            f'{_CONFIDENCE} is not used: join_odds decides which maps are joined (default '
            f'{JOIN_ODDS:g}, at most one wrong join in so many)'
        )


def odds_text(log_odds: float) -> str:
    """Odds as people say them."""
    if math.isinf(log_odds):
        return 'given' if log_odds > 0.0 else 'none'
    return f'log odds {log_odds:.1f}'
