"""Parameters of global localization."""

from dataclasses import dataclass

from thinmap_ros.core.config import Config, laser_range_noise, parameter, robot_radius

# A better laser meets walls that are rougher than it measures; the results were measured with this.
_MIN_BEAM_NOISE_M = 0.02


@dataclass(frozen=True)
class GlobalLocalizationConfig(Config):
    """How many samples, how often updated, what counts as explained, when the robot is sure."""

    samples: int = parameter(
        5000,
        'Number of samples of the pose. Raise it for large maps, lower it to save time.',
        low=100,
        high=100_000,
    )
    max_beams: int = parameter(
        60,
        'Number of beams of a scan that are compared with the map. Raise it for similar rooms, '
        'lower it to save time.',
        low=8,
        high=1000,
    )
    compared_range_m: float = 15.0  # longer ranges decide little and take time
    robot_radius_m: float = robot_radius()
    laser_range_noise_m: float = laser_range_noise()
    map_noise_m: float = parameter(
        0.05,
        'Standard deviation of the position of a correct hypothesis in the map (m). Raise it for '
        'a map with errors.',
        low=0.001,
        high=1.0,
    )
    accept_weight: float = parameter(
        0.99,
        'Smallest weight of the hypothesis that is accepted. Raise it against false localization, '
        'lower it to be localized sooner.',
        low=0.6,
        high=1.0,
    )
    accept_updates: int = parameter(
        3,
        'Consecutive updates with one hypothesis before it is accepted. Raise it against false '
        'localization, lower it to be localized sooner.',
        low=1,
        high=1000,
    )
    min_inlier_ratio: float = parameter(
        0.8,
        'Smallest inlier ratio of an accepted hypothesis, relative to the expected one. Lower it '
        'where furniture has moved, raise it against false localization.',
        low=0.3,
        high=1.0,
    )
    not_in_map_distance_m: float = parameter(
        2.0,
        'Travelled distance without a hypothesis after which NOT_IN_MAP is reported (m). Raise it '
        'for places that have changed much.',
        low=0.0,
        high=100.0,
    )

    @property
    def beam_noise_m(self) -> float:
        """Standard deviation of a range that is compared with the map (m)."""
        return max(self.laser_range_noise_m, _MIN_BEAM_NOISE_M)
