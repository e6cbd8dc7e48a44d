"""Parameters of the topological map."""

from dataclasses import dataclass

from thinmap_ros.core.config import Config, parameter, robot_radius


@dataclass(frozen=True)
class TopologyConfig(Config):
    """What counts as free, which branches of the skeleton count, and how local maps are merged."""

    robot_radius_m: float = robot_radius()
    gap_m: float = parameter(
        0.2, 'unknown gaps between free cells up to this wide count as free, m', low=0.0, high=2.0
    )
    seed_reach_m: float = parameter(
        1.5, 'how far from the robot its free space may begin, m', low=0.0, high=20.0
    )
    spur_m: float = parameter(
        0.6, 'a branch must bring the robot farther than this to count, m', low=0.0, high=10.0
    )
    spur_ratio: float = parameter(
        0.5,
        'a branch to a known wall must also bring it farther than this share of the free radius',
        low=0.0,
        high=5.0,
    )
    join_m: float = parameter(
        0.4, 'branch nodes closer than this along the skeleton are one, m', low=0.0, high=5.0
    )
    near_m: float = parameter(
        10.0,
        'edge of the square round the robot that is thinned at every scan, m',
        low=2.0,
        high=50.0,
    )
    context_m: float = parameter(
        6.0, 'width of what is thinned with it all round, m', low=0.0, high=50.0
    )
    memory_m: float = parameter(
        50.0, 'how far round a window past ones are remembered, m', low=0.0, high=200.0
    )
    margin_m: float = parameter(
        2.0,
        'how far from places known before, but out of sight, the old skeleton stays, m',
        low=0.0,
        high=50.0,
    )
    same_place_m: float = parameter(
        0.5, 'a node that moved up to this far keeps its id, m', low=0.0, high=10.0
    )
