"""Parameters of every localizer: which one it is, where it starts, and whether it maps."""

from dataclasses import dataclass
from typing import Any, ClassVar

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, quoted

# Values of the parameter `slam`.
SCAN_MATCHING = 'scan_matching'
EKF_TI = 'ekf_ti'
EKF_FULL = 'ekf_full'
# Values of the parameter `mode`, as in slam_toolbox.
MAPPING = 'mapping'
LOCALIZATION = 'localization'


def slam_parameter(default: str) -> Any:
    """Declare the field `slam`, which has another default in the configuration of each localizer.

    It lists all values: `StartConfig` checks which of them belong to a configuration.
    """
    return parameter(
        default,
        'scan_matching: scan matching with a pose graph; ekf_ti: EKF-SLAM/TI on odometry and line '
        'features alone; ekf_full: the same with all features in the state.',
        choices=(SCAN_MATCHING, EKF_TI, EKF_FULL),
    )


@dataclass(frozen=True)
class StartConfig(Config):
    """Parameters that all localizers have.

    of_slam: the values of `slam` that a configuration is for. Raises ConfigError for another one.
    """

    of_slam: ClassVar[tuple[str, ...]] = (SCAN_MATCHING, EKF_TI, EKF_FULL)

    slam: str = slam_parameter(SCAN_MATCHING)
    initial_x_m: float = parameter(
        0.0,
        'Initial x position in the map (m). A start at 0, 0, 0 in a loaded map is taken as '
        'unknown: scan matching maps once scans fit there along 6 m of path.',
        low=-se2.MAX_COORDINATE_M,
        high=se2.MAX_COORDINATE_M,
    )
    initial_y_m: float = parameter(
        0.0,
        'Initial y position in the map (m).',
        low=-se2.MAX_COORDINATE_M,
        high=se2.MAX_COORDINATE_M,
    )
    initial_yaw_rad: float = parameter(0.0, 'Initial heading in the map (rad).')
    mode: str = parameter(
        MAPPING,
        'mapping: scans extend and change the map. localization: the map is given (a session, '
        'map_file_name or topic map) and does not change.',
        choices=(MAPPING, LOCALIZATION),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.slam not in self.of_slam:
            raise ConfigError(
                f'slam = {quoted(self.slam)}: {type(self).__name__} expected '
                f'{" or ".join(self.of_slam)}'
            )

    @property
    def is_start_given(self) -> bool:
        """Whether a start pose is given: one that is not that of a new map."""
        return (self.initial_x_m, self.initial_y_m, self.initial_yaw_rad) != (0.0, 0.0, 0.0)

    @property
    def is_mapping(self) -> bool:
        """Whether scans change the map."""
        return self.mode == MAPPING
