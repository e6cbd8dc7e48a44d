"""Parameters of global localization."""

from dataclasses import dataclass

from thinmap_ros.core.config import Config, parameter, robot_radius


@dataclass(frozen=True)
class GlobalLocalizationConfig(Config):
    """How many samples, how often looked at, what counts as explained, when the robot is sure."""

    samples: int = parameter(5000, 'samples of the pose', low=100, high=100_000)
    beams: int = parameter(60, 'beams of a scan that are compared with the map', low=8, high=1000)
    usable_range_m: float = parameter(
        15.0, 'what lies farther is not compared with the map, m', low=1.0, high=100.0
    )
    robot_radius_m: float = robot_radius()
    active_window_m: float = parameter(
        10.0,
        'edge of the square round the robot in which nodes are compared, m',
        low=2.0,
        high=50.0,
    )
    range_noise_m: float = parameter(
        0.02, 'range noise of the laser, 1 sigma, m', low=0.001, high=1.0
    )
    pose_noise_m: float = parameter(
        0.05,
        'what map and pose of a hypothesis are off where all is well, 1 sigma, m',
        low=0.001,
        high=1.0,
    )
    heading_noise_rad: float = parameter(
        0.01,
        'what the heading of a hypothesis is off where all is well, 1 sigma, rad',
        low=0.0,
        high=0.2,
    )
    odometry_noise: float = parameter(
        0.05, 'odometry error a metre, and a radian, of motion', low=0.0, high=1.0
    )
    look_m: float = parameter(0.1, 'the robot looks again after so much way, m', low=0.01, high=5.0)
    look_rad: float = parameter(0.1, 'or after so much turning, rad', low=0.01, high=3.0)
    odometry_jump_m: float = parameter(
        1.5,
        'odometry that moves more than this between two scans has jumped, m',
        low=0.1,
        high=100.0,
    )
    sure_share: float = parameter(
        0.99, 'weight of the one hypothesis of a robot that is sure', low=0.6, high=1.0
    )
    sure_looks: int = parameter(
        3,
        'looks in a row at which all must speak for one place before it is sure',
        low=1,
        high=1000,
    )
    least_explained: float = parameter(
        0.8,
        'a place that explains less than this share of what a right one would '
        'is not taken for the right one',
        low=0.3,
        high=1.0,
    )
    sure_sigma_m: float = parameter(
        0.15, 'its place must be known to this, 1 sigma, m', low=0.01, high=5.0
    )
    sure_sigma_rad: float = parameter(
        0.07, 'its heading must be known to this, 1 sigma, rad', low=0.005, high=1.0
    )
    foreign_way_m: float = parameter(
        2.0,
        'so much way must have been looked at to say that a map is of another place, m',
        low=0.0,
        high=100.0,
    )
