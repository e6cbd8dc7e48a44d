"""Properties of a laser that a CARMEN log does not contain."""

from dataclasses import dataclass

from thinmap_ros.core.config import Config, parameter


@dataclass(frozen=True)
class LaserOptions(Config):
    """Properties of the laser that FLASER lines do not contain.

    ROBOTLASER1 lines contain them; an offset given here takes precedence.
    """

    start_angle_deg: float = parameter(
        -90.0, 'bearing of the first beam, degrees', low=-360.0, high=360.0
    )
    step_deg: float = parameter(
        0.0,
        'angle between beams, degrees; 0: 1 for 180 beams, else 180 over the intervals',
        low=-10.0,
        high=10.0,
    )
    offset_m: float = parameter(0.0, 'laser ahead of the robot centre, m', low=-5.0, high=5.0)
    range_min_m: float = parameter(0.02, 'nearest valid range, m', low=0.0, high=10.0)
    range_max_m: float = parameter(
        80.0, 'ranges from here on are "no return", m', low=0.1, high=1000.0
    )
