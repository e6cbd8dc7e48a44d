"""Scans without the other robots of a team, which are no part of the map."""

from dataclasses import dataclass

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.sensing.beams import without_robots
from thinmap_ros.ros import parameters
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.team import heard_robots


@dataclass(frozen=True)
class RobotCutConfig(Config):
    """How much is cut out of scans around another robot."""

    robot_cut_radius_m: float = parameter(
        0.38,
        'Scan points within this distance of another robot of the team are not mapped (m). Set it '
        'to the radius of the largest robot and 0.13. The way since its last message is added.',
        low=0.0,
        high=10.0,
    )


class TeamInScans:
    """Cuts the other robots out of scans; without a team, nothing."""

    def __init__(self, node: ThinmapNode) -> None:
        """Declare the parameters."""
        self._heard = heard_robots(node)
        self._cut_m = parameters.declare_config(node, RobotCutConfig).robot_cut_radius_m

    def without(self, scan: Scan, T_map_base: Array) -> Scan:
        """A scan made at a pose (3,) without the beams that end at another robot."""
        if self._heard is None:
            return scan
        for motion, age_s in self._heard.motions():
            radius_m = self._cut_m + abs(motion.v) * age_s
            scan = without_robots(scan, T_map_base, motion.pose[None, :2], radius_m)
        return scan
