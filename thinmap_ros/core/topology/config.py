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
    branch_merge_distance_m: float = parameter(
        0.4,
        'Branch nodes closer than this along the skeleton are merged (m). Raise it for fewer '
        'nodes at wide junctions.',
        low=0.0,
        high=5.0,
    )
    update_window_m: float = parameter(
        10.0,
        'Side length of the window that is thinned at every scan (m). Raise it for a long-range '
        'laser, lower it to save time.',
        low=2.0,
        high=50.0,
    )
    update_context_m: float = parameter(
        6.0,
        'Width of the margin that is thinned with the window (m). Raise it if the graph differs '
        'from that of the whole map, lower it to save time.',
        low=0.0,
        high=50.0,
    )
    window_memory_m: float = parameter(
        50.0,
        'Distance up to which earlier windows are remembered (m). Raise it for large halls, lower '
        'it to save memory.',
        low=0.0,
        high=200.0,
    )
    skeleton_keep_margin_m: float = parameter(
        2.0,
        'Distance outside the visible area up to which the previous skeleton is kept (m). Raise '
        'it if nodes at the edge of the view flicker.',
        low=0.0,
        high=50.0,
    )
    node_match_radius_m: float = parameter(
        0.5,
        'A node that moved less than this keeps its id (m). Raise it if ids change while the map '
        'grows.',
        low=0.0,
        high=10.0,
    )
