"""Parameters for localization in a given map: the map, and the pose at the start."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter, part
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array

# Of a pose that a user gives: standard deviations of 0.5 m and 15 degrees, as in RViz.
GIVEN_COVARIANCE = np.diag([0.25, 0.25, 0.0685])


@dataclass(frozen=True)
class InitialPoseConfig(Config):
    """A pose in the map; z is there for parameter files of AMCL and is not used."""

    x: float = parameter(0.0, 'Position in the map (m).', low=-MAX_COORDINATE_M)
    y: float = parameter(0.0, 'Position in the map (m).', low=-MAX_COORDINATE_M)
    z: float = parameter(0.0, 'Height (m). Not used: the map is planar.')
    yaw: float = parameter(0.0, 'Heading in the map (rad).')

    @property
    def pose(self) -> Array:
        """The pose T_map_base (3,)."""
        return se2.pose(self.x, self.y, self.yaw)


@dataclass(frozen=True)
class LocalizationConfig(Config):
    """Parameters of the mode localization."""

    map_file_name: str = parameter(
        '',
        'map_server YAML file of the map, for mode localization. Empty: the map of session_path; '
        'without one, the map is that of topic map.',
    )
    set_initial_pose: bool = parameter(
        False,
        'In mode localization, start at initial_pose instead of the last pose of the previous '
        'run. Set it where the robot always starts at the same place.',
    )
    always_reset_initial_pose: bool = parameter(
        False,
        'In mode localization, return to initial_pose with each new map instead of keeping the '
        'pose. Only with set_initial_pose.',
    )
    first_map_only: bool = parameter(
        False,
        'In mode localization, ignore all but the first message of topic map. Set it where another '
        'node draws into the map that the robot was placed in.',
    )
    save_pose_rate: float = parameter(
        0.5,
        'Rate at which the last pose is saved for the next start in mode localization (1/s), and '
        'at the end. 0 or less: it is not saved. Raise it where the robot is switched off while it '
        'drives.',
        low=-1.0,
        high=10.0,
    )
    pose_file: str = parameter(
        '',
        'File for the last pose. Empty: below $XDG_STATE_HOME/thinmap (~/.local/state/thinmap), '
        'named after ROS domain and node.',
    )
    initial_pose: InitialPoseConfig = part(InitialPoseConfig)
