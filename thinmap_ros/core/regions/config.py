"""Parameters of the regions of a map."""

from dataclasses import dataclass

from thinmap_ros.core.config import Config, parameter


@dataclass(frozen=True)
class RegionConfig(Config):
    """What separates two regions, and which kind a region is.

    robot_radius_m: free space that the robot does not fit into belongs to no region.
    neck_ratio: a passage separates two places if it is narrower than this share of both.
    min_door_width_m: narrower passages are gaps along walls, and no doors.
    max_door_depth_m: on both sides of a door it gets wider within this distance; else it is the
    mouth of a narrow corridor.
    max_furniture_m: compact obstacles apart from walls up to this length are furniture.
    corridor_ratio: a corridor is at least so many times as long as wide.
    """

    robot_radius_m: float = 0.25
    neck_ratio: float = 0.75
    min_door_width_m: float = 0.5
    max_door_depth_m: float = 2.0
    max_furniture_m: float = 2.0
    corridor_ratio: float = 4.0
    max_door_width_m: float = parameter(
        2.6,
        'Widest passage that separates two regions (m). Raise it for gates, lower it if rooms are '
        'divided where cupboards stand.',
        low=0.5,
        high=10.0,
    )
    max_corridor_width_m: float = parameter(
        3.2,
        'Largest width of a corridor (m); a region that is wider in most of its area is a room or '
        'a hall. Raise it for hospitals and malls, lower it if long rooms count as corridors.',
        low=0.5,
        high=20.0,
    )
    min_hall_width_m: float = parameter(
        9.0,
        'Width from which a room is a hall (m). Raise it for a warehouse, lower it for a flat.',
        low=1.0,
        high=1000.0,
    )
