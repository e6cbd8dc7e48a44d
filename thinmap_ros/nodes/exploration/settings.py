"""Parameters of the node explorer beside those of its strategy."""

from dataclasses import dataclass

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, quoted
from thinmap_ros.ros.laser_transform import LaserTransform

_BASE_FRAME = 'base_link'


@dataclass(frozen=True)
class ExplorationSettings(Config):
    """Where the map comes from and who drives; names as in explore_lite where it has them."""

    drive: bool = parameter(
        True,
        'Send the targets to navigate_to_pose. false: they are only published on '
        'exploration_target, for a program or a person that drives.',
    )
    navigate_to_pose_action: str = parameter(
        'navigate_to_pose',
        'Action (nav2_msgs/NavigateToPose) that drives to the targets, of navigator or Nav2.',
    )
    autostart_exploration: bool = parameter(
        False,
        'Explore as soon as there is a map, as explore_lite does, unless the robot is stopped. '
        'false: wait for a goal of the action explore.',
    )
    return_to_init: bool = parameter(
        False,
        'Return to the start after every exploration. false: only if the goal of the action '
        'explore asks for it.',
    )
    progress_timeout: float = parameter(
        30.0,
        'Time without progress after which a target is given up (s). Raise it for a slow robot, '
        'lower it to give up blocked targets earlier. 0: never.',
        low=0.0,
        high=1e5,
    )
    costmap_topic: str = parameter(
        'map',
        'Map to explore (nav_msgs/OccupancyGrid) where no node publishes grid. In a topic whose '
        'name ends in costmap, costs below 100 are free space.',
    )
    costmap_updates_topic: str = parameter(
        '',
        'Updates of parts of that map (map_msgs/OccupancyGridUpdate), where its publisher has any. '
        'Empty: costmap_topic with _updates.',
    )
    robot_base_frame: str = parameter(
        '', 'Frame of the robot: another name of base_frame. Empty: base_frame.'
    )
    transform_tolerance: float = parameter(
        0.3,
        'Age up to which the newest transform from the robot to the map is used (s). Raise it if '
        'transforms arrive late, lower it for a fast robot.',
        low=0.0,
        high=10.0,
    )
    view_range_m: float = parameter(
        5.0,
        'Range of view that is assumed where no scans are received (m). Set it to the range of the '
        'sensor that makes the map.',
        low=0.5,
        high=100.0,
    )

    @property
    def is_costmap(self) -> bool:
        """Whether the map consists of costs."""
        return self.costmap_topic.endswith('costmap')

    def apply_base_frame(self, laser_transform: LaserTransform) -> None:
        """Set the frame of the robot by its other name.

        Raises ConfigError where both names are given, with different frames.
        """
        frame = self.robot_base_frame
        if not frame:
            return
        if laser_transform.base_frame not in (_BASE_FRAME, frame):
            raise ConfigError(
                f'robot_base_frame = {quoted(frame)}: expected the same as '
                f'base_frame = {quoted(laser_transform.base_frame)}'
            )
        laser_transform.base_frame = frame
