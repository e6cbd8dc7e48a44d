"""Driving beside other robots of a team: over the ground that they know, and with right of way."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.navigator import Command, Navigator
from thinmap_ros.core.planning.path_follower import Motion, as_heard, must_stop
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import parameters
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.team import TileReceiver, heard_robots


@dataclass(frozen=True)
class GiveWayConfig(Config):
    """How near another robot may come."""

    give_way_m: float = parameter(
        0.61,
        'The robot does not drive nearer to another robot of the team than this, from centre to '
        'centre (m). Set it to the sum of the radii of both and 0.11.',
        low=0.0,
        high=10.0,
    )


class TeamDriving:
    """What a navigator knows of the other robots; without a team, nothing."""

    def __init__(self, node: ThinmapNode) -> None:
        """Declare the parameters."""
        self._heard = heard_robots(node)
        self._distance_m = parameters.declare_config(node, GiveWayConfig).give_way_m
        self._tiles: TileReceiver | None = None
        if self._heard is not None:
            self._tiles = TileReceiver(node, self._heard.places, self._heard.name)

    def completed(self, own: GridPatch) -> GridPatch:
        """The map of this robot, and what others know where it is undecided."""
        return own if self._tiles is None else self._tiles.completed(own)

    def allowed(
        self, navigator: Navigator, T_map_base: Array, command: Command, dt_s: float
    ) -> Command:
        """The command, or one that gives way where the robot would come too near to another one.

        T_map_base (3,): pose of the robot; dt_s: time between two commands.
        """
        if self._heard is None or command.v <= 0.0:
            return command
        own = Motion(self._heard.name, T_map_base, command.v, command.w)
        others = [each for heard in self._heard.motions() for each in as_heard(*heard)]
        controller = navigator.config.controller
        brakes_s = controller.max_speed_m_s / controller.max_acceleration_m_s2
        if not must_stop(own, others, self._distance_m, brakes_s):
            return command
        places = np.array([other.pose[:2] for other in others])
        return navigator.give_way(command, dt_s, places, self._distance_m)
