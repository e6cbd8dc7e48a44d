"""Parameters of the topological map."""

from dataclasses import dataclass

from thinmap_ros.core.config import Config, parameter, robot_radius


@dataclass(frozen=True)
class TopologyConfig(Config):
    """What counts as free, which branches of the skeleton count, and how local maps are merged."""

    robot_radius_m: float = robot_radius()
    max_unknown_gap_m: float = parameter(
        0.2,
        'Unknown gaps between free cells up to this width count as free (m). Raise it for a laser '
        'with few beams, lower it to keep small unknown regions.',
        low=0.0,
        high=2.0,
    )
    seed_search_radius_m: float = parameter(
        1.5,
        'Largest distance from the robot to the free space that is thinned (m). Raise it if the '
        'graph stays empty where the robot starts beside obstacles.',
        low=0.0,
        high=20.0,
    )
    min_branch_length_m: float = parameter(
        0.6,
        'Shorter branches of the skeleton are pruned (m). Raise it for fewer end nodes, lower it '
        'to keep niches.',
        low=0.0,
        high=10.0,
    )
    min_branch_ratio: float = parameter(
        0.5,
        'Smallest length of a branch towards a known wall, relative to the clearance at its base. '
        'Raise it for fewer end nodes in corners.',
        low=0.0,
        high=5.0,
    )
