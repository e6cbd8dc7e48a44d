"""Parameters of other packages: their files, names and values as those of thinmap.

Names and defaults are those of slam_toolbox (Jazzy), nav2_amcl, Nav2's map server, controller and
navigator, and m-explore-ros2's explore_lite and map_merge.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.files.safe import parse_yaml, read_mapping


@dataclass(frozen=True)
class ForeignParameter:
    """A parameter of another package.

    targets: (node, parameter) of thinmap; a list is split among several. note: what else to know,
    or why there is no target.
    """

    name: str
    default: str
    targets: tuple[tuple[str, str], ...] = ()
    note: str = ''


@dataclass(frozen=True)
class Package:
    """Another package, with the node names of ours that take its place.

    sections: names of its nodes, as of the sections of its parameter files.
    """

    name: str
    sections: tuple[str, ...]
    nodes: tuple[str, ...]
    parameters: tuple[ForeignParameter, ...]


def _row(name: str, default: str, *targets: str, note: str = '') -> ForeignParameter:
    """Row with targets as NODE/PARAMETER."""
    pairs = [target.split('/', 1) for target in targets]
    return ForeignParameter(name, default, tuple((a, b) for a, b in pairs), note)


_NO_CORRELATION = 'no: points are matched with walls, without a search grid'
_NO_RESPONSE = 'no: a match is judged by its inlier ratio'
_NO_SOLVER = 'no: the pose graph has a solver of its own'
_NO_BEAM_MODEL = 'no: poses are refined by scan matching, without a beam model'
_NO_FILTER = 'no: there is no particle filter; samples are drawn only while the robot is lost'
_NO_UTILITY = 'no: the nearest target is next, by path'
_REMAP = 'by remapping'

SLAM_TOOLBOX = Package(
    'slam_toolbox',
    ('slam_toolbox',),
    ('localizer', 'grid_mapper'),
    (
        _row('mode', 'mapping', 'localizer/mode', 'grid_mapper/mode'),
        _row('odom_frame', 'odom', 'localizer/odom_frame'),
        _row('map_frame', 'map', 'localizer/map_frame', 'grid_mapper/map_frame'),
        _row(
            'base_frame',
            'base_footprint',
            'localizer/base_frame',
            note='default base_link',
        ),
        _row('scan_topic', '/scan', 'localizer/scan_topic'),
        _row('laser_frame', '-', note='no: the frame of each scan is looked up in `/tf_static`'),
        _row(
            'map_file_name',
            '',
            'localizer/map_file_name',
            note='a map_server YAML file; a session is `session_path`; `.posegraph` is not read',
        ),
        _row(
            'map_start_pose',
            '[0, 0, 0]',
            'localizer/initial_x_m',
            'localizer/initial_y_m',
            'localizer/initial_yaw_rad',
            note='x, y, yaw',
        ),
        _row('map_start_at_dock', 'false', note='no: the last pose is tried at the start'),
        _row('use_map_saver', 'true', note='no: `save_map` always exists'),
        _row('debug_logging', 'false', note='no: `--log-level debug`'),
        _row('throttle_scans', '1', note='no: every scan is used'),
        _row('minimum_time_interval', '0.5', note='no: every scan is used'),
        _row('scan_queue_size', '1', note='no: sensor data QoS'),
        _row('transform_publish_period', '0.02', 'localizer/transform_publish_period'),
        _row('transform_timeout', '0.2', 'localizer/transform_tolerance'),
        _row('restamp_tf', 'false', note='no: transforms are always dated from the present time'),
        _row('tf_buffer_duration', '30.0', note='no: 10 s'),
        _row('map_update_interval', '5.0', 'grid_mapper/map_update_interval'),
        _row('resolution', '0.05', 'grid_mapper/resolution_m'),
        _row(
            'max_laser_range',
            '20.0',
            'localizer/max_range_m',
        ),
        _row('min_laser_range', '0.0', note='no: range_min of the scan'),
        _row('stack_size_to_use', '40000000', note='no'),
        _row('enable_interactive_mode', 'true', note='no'),
        _row('use_scan_matching', 'true', note='no: always'),
        _row('use_scan_barycenter', 'true', note='no'),
        _row('minimum_travel_distance', '0.5', 'localizer/keyframes.distance_m'),
        _row('minimum_travel_heading', '0.5', 'localizer/keyframes.angle_rad'),
        _row('check_min_dist_and_heading_precisely', 'false', note='no: always'),
        _row('scan_buffer_size', '10', note='no: the local map holds what was seen'),
        _row('scan_buffer_maximum_scan_distance', '10.0', note='no'),
        _row('link_match_minimum_response_fine', '0.1', note=_NO_RESPONSE),
        _row('link_scan_maximum_distance', '1.5', note='no'),
        _row('do_loop_closing', 'true', note='no: always'),
        _row('loop_search_maximum_distance', '3.0', 'localizer/loop_closure.search_radius_m'),
        _row(
            'loop_match_minimum_chain_size', '10', note='no: `loop_closure.min_consistent_matches`'
        ),
        _row('loop_match_maximum_variance_coarse', '3.0', note='no'),
        _row('loop_match_minimum_response_coarse', '0.35', note=_NO_RESPONSE),
        _row('loop_match_minimum_response_fine', '0.45', note=_NO_RESPONSE),
        _row('correlation_search_space_dimension', '0.5', note=_NO_CORRELATION),
        _row('correlation_search_space_resolution', '0.01', note=_NO_CORRELATION),
        _row('correlation_search_space_smear_deviation', '0.1', note=_NO_CORRELATION),
        _row('loop_search_space_dimension', '8.0', note=_NO_CORRELATION),
        _row('loop_search_space_resolution', '0.05', note=_NO_CORRELATION),
        _row('loop_search_space_smear_deviation', '0.03', note=_NO_CORRELATION),
        _row('distance_variance_penalty', '0.5', note='no: `odometry.noise_ratio`'),
        _row('angle_variance_penalty', '1.0', note='no: `odometry.noise_ratio`'),
        _row('fine_search_angle_offset', '0.00349', note=_NO_CORRELATION),
        _row('coarse_search_angle_offset', '0.349', note=_NO_CORRELATION),
        _row('coarse_angle_resolution', '0.0349', note=_NO_CORRELATION),
        _row('minimum_angle_penalty', '0.9', note='no'),
        _row('minimum_distance_penalty', '0.5', note='no'),
        _row('use_response_expansion', 'true', note='no'),
        _row('min_pass_through', '2', note='no: `p_miss`, `p_hit`'),
        _row('occupancy_threshold', '0.1', note='no: `occupied_thresh` is a probability'),
        _row('position_covariance_scale', '1.0', note='no: the covariance is calibrated'),
        _row('yaw_covariance_scale', '1.0', note='no: the covariance is calibrated'),
        _row('solver_plugin', 'solver_plugins::CeresSolver', note=_NO_SOLVER),
        _row('ceres_linear_solver', 'SPARSE_NORMAL_CHOLESKY', note=_NO_SOLVER),
        _row('ceres_preconditioner', 'SCHUR_JACOBI', note=_NO_SOLVER),
        _row('ceres_trust_strategy', 'LEVENBERG_MARQUARDT', note=_NO_SOLVER),
        _row('ceres_dogleg_type', 'TRADITIONAL_DOGLEG', note=_NO_SOLVER),
        _row('ceres_loss_function', 'None', note=_NO_SOLVER),
    ),
)

AMCL = Package(
    'nav2_amcl',
    ('amcl',),
    ('localizer', 'global_localizer'),
    (
        _row('alpha1', '0.2', note='no: `odometry.noise_ratio`; the noise is learned'),
        _row('alpha2', '0.2', note='no: see alpha1'),
        _row('alpha3', '0.2', note='no: see alpha1'),
        _row('alpha4', '0.2', note='no: see alpha1'),
        _row('alpha5', '0.2', note='no: see alpha1'),
        _row('always_reset_initial_pose', 'false', 'localizer/always_reset_initial_pose'),
        _row(
            'base_frame_id', 'base_footprint', 'localizer/base_frame', 'global_localizer/base_frame'
        ),
        _row('beam_skip_distance', '0.5', note=_NO_BEAM_MODEL),
        _row('beam_skip_error_threshold', '0.9', note=_NO_BEAM_MODEL),
        _row('beam_skip_threshold', '0.3', note=_NO_BEAM_MODEL),
        _row('do_beamskip', 'false', note=_NO_BEAM_MODEL),
        _row('first_map_only', 'false', 'localizer/first_map_only'),
        _row('freespace_downsampling', 'false', note=_NO_FILTER),
        _row('global_frame_id', 'map', 'localizer/map_frame', 'global_localizer/map_frame'),
        _row('initial_pose.x', '0.0', 'localizer/initial_pose.x'),
        _row('initial_pose.y', '0.0', 'localizer/initial_pose.y'),
        _row('initial_pose.z', '0.0', 'localizer/initial_pose.z', note='not used'),
        _row('initial_pose.yaw', '0.0', 'localizer/initial_pose.yaw'),
        _row('lambda_short', '0.1', note=_NO_BEAM_MODEL),
        _row('laser_likelihood_max_dist', '2.0', note='no: 0.5 m'),
        _row('laser_max_range', '100.0', 'localizer/max_range_m'),
        _row('laser_min_range', '-1.0', note='no: range_min of the scan'),
        _row('laser_model_type', 'likelihood_field', note=_NO_BEAM_MODEL),
        _row('map_topic', 'map', note=f'{_REMAP}: `-r map:=/other_map`'),
        _row('max_beams', '60', note='no: all beams'),
        _row('max_particles', '2000', 'global_localizer/samples', note='while the robot is lost'),
        _row('min_particles', '500', note=_NO_FILTER),
        _row('odom_frame_id', 'odom', 'localizer/odom_frame', 'global_localizer/odom_frame'),
        _row('pf_err', '0.05', note=_NO_FILTER),
        _row('pf_z', '0.99', note=_NO_FILTER),
        _row(
            'random_seed',
            '-1',
            'global_localizer/seed',
            note='negative (a seed from the clock): ignored',
        ),
        _row('recovery_alpha_fast', '0.0', note='no: global_localizer with `start_automatically`'),
        _row('recovery_alpha_slow', '0.0', note='no: global_localizer with `start_automatically`'),
        _row('resample_interval', '1', note=_NO_FILTER),
        _row('robot_model_type', 'nav2_amcl::DifferentialMotionModel', note='no: planar motion'),
        _row('save_pose_rate', '0.5', 'localizer/save_pose_rate'),
        _row('scan_topic', 'scan', 'localizer/scan_topic', 'global_localizer/scan_topic'),
        _row('set_initial_pose', 'false', 'localizer/set_initial_pose'),
        _row('sigma_hit', '0.2', note='no: `matching.noise_m`'),
        _row('tf_broadcast', 'true', 'localizer/publish_tf'),
        _row('transform_tolerance', '1.0', 'localizer/transform_tolerance'),
        _row('update_min_a', '0.2', note='no: every scan is used'),
        _row('update_min_d', '0.25', note='no: every scan is used'),
        _row('z_hit', '0.5', note=_NO_BEAM_MODEL),
        _row('z_max', '0.05', note=_NO_BEAM_MODEL),
        _row('z_rand', '0.5', note=_NO_BEAM_MODEL),
        _row('z_short', '0.05', note=_NO_BEAM_MODEL),
    ),
)

EXPLORE_LITE = Package(
    'explore_lite',
    ('explore_node', 'explore'),
    ('explorer',),
    (
        _row('robot_base_frame', 'base_link', 'explorer/robot_base_frame'),
        _row('costmap_topic', 'costmap', 'explorer/costmap_topic', note='default `map`'),
        _row('costmap_updates_topic', 'costmap_updates', 'explorer/costmap_updates_topic'),
        _row('visualize', 'false', note='no: `explore/frontiers` is always published'),
        _row('planner_frequency', '1.0', note='no: at every scan'),
        _row('progress_timeout', '30.0', 'explorer/progress_timeout'),
        _row('potential_scale', '0.001', note=_NO_UTILITY),
        _row('orientation_scale', '0.0', note=_NO_UTILITY),
        _row('gain_scale', '1.0', note=_NO_UTILITY),
        _row('transform_tolerance', '0.3', 'explorer/transform_tolerance'),
        _row('min_frontier_size', '0.5', 'explorer/min_frontier_size'),
        _row('return_to_init', 'false', 'explorer/return_to_init'),
    ),
)

MAP_MERGE = Package(
    'map_merge of m-explore',
    ('map_merge',),
    ('map_joiner',),
    (
        _row('robot_map_topic', 'map', 'map_joiner/robot_map_topic'),
        _row('robot_map_updates_topic', 'map_updates', 'map_joiner/robot_map_updates_topic'),
        _row('robot_namespace', '', 'map_joiner/robot_namespace'),
        _row('merged_map_topic', 'map', 'map_joiner/merged_map_topic', note='default `merged_map`'),
        _row('world_frame', 'world', 'map_joiner/world_frame'),
        _row('known_init_poses', 'true', 'map_joiner/known_init_poses', note='default false'),
        _row('merging_rate', '4.0', 'map_joiner/merging_rate', note='default 1.0'),
        _row('discovery_rate', '0.05', 'map_joiner/discovery_rate', note='default 0.5'),
        _row('estimation_rate', '0.5', 'map_joiner/estimation_rate'),
        _row('estimation_confidence', '1.0', note='no: `join_odds`, posterior odds of a place'),
    ),
)

NAV2 = Package(
    'Nav2 controller and bt_navigator',
    ('controller_server', 'bt_navigator', 'local_costmap', 'global_costmap'),
    ('navigator',),
    (
        _row('global_frame', 'map', 'navigator/map_frame'),
        _row('robot_base_frame', 'base_link', 'navigator/base_frame'),
        _row('odom_topic', 'odom', note=f'{_REMAP}: `-r odom:=/wheels/odom`'),
        _row('enable_stamped_cmd_vel', 'false', 'navigator/enable_stamped_cmd_vel'),
        _row('transform_tolerance', '0.1', 'navigator/transform_tolerance'),
        _row('robot_radius', '0.22', 'navigator/robot_radius_m'),
        _row('inflation_layer.inflation_radius', '0.7', 'navigator/planner.inflation_radius_m'),
        _row('controller_frequency', '20.0', note='no: 10 Hz'),
        _row('FollowPath.max_vel_x', '0.5', 'navigator/controller.max_speed_m_s'),
        _row('FollowPath.desired_linear_vel', '0.5', 'navigator/controller.max_speed_m_s'),
        _row('FollowPath.vx_max', '0.5', 'navigator/controller.max_speed_m_s'),
        _row('FollowPath.max_vel_theta', '1.0', 'navigator/controller.max_angular_speed_rad_s'),
        _row('FollowPath.acc_lim_x', '2.5', 'navigator/controller.max_acceleration_m_s2'),
        _row('FollowPath.lookahead_dist', '0.6', 'navigator/controller.lookahead_distance_m'),
    ),
)

MAP_SERVER = Package(
    'map_server and map_saver',
    ('map_server', 'map_saver'),
    ('localizer', 'grid_mapper'),
    (
        _row(
            'yaml_filename',
            '',
            'localizer/map_file_name',
            'grid_mapper/session_path',
            note='with `mode: localization`',
        ),
        _row('topic_name', 'map', note=f'{_REMAP}: `-r map:=/other_map`'),
        _row('frame_id', 'map', note='no: `map_frame`; drivers have a `frame_id`, too'),
        _row('save_map_timeout', '2.0', note='no: the map is saved at once'),
        _row('free_thresh_default', '0.25', 'grid_mapper/free_thresh', note='of `map`, too'),
        _row(
            'occupied_thresh_default', '0.65', 'grid_mapper/occupied_thresh', note='of `map`, too'
        ),
        _row('map_subscribe_transient_local', 'true', note='no: `map` is always latched'),
    ),
)

PACKAGES = (SLAM_TOOLBOX, AMCL, MAP_SERVER, EXPLORE_LITE, MAP_MERGE, NAV2)


EXPECTED = 'a parameter file: NODE: ros__parameters: NAME: VALUE'
WILDCARDS = ('**', '*')
_VALUES = 'ros__parameters'
_FILE = '--params-file'
_RULES = ('-p', '--param')
_ANY = '/**'


class Given(NamedTuple):
    """Value of a parameter on a command line, and the section of a file, or of a rule, it is in."""

    section: str
    name: str
    value: Any


def given_files(words: Sequence[str]) -> list[Path]:
    """The parameter files that a command line names after --ros-args."""
    return [Path(word) for flag, word in ros_arguments(words) if flag == _FILE]


def ros_arguments(words: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Each word after --ros-args, up to a --, with the word before it."""
    is_ros = False
    for before, word in pairwise(words):
        is_ros = before == '--ros-args' or (is_ros and before != '--')
        if is_ros:
            yield before, word


def split_arguments(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Words of a command line, without its program, that are not for ROS, and those that are."""
    own: list[str] = []
    for_ros: list[str] = []
    is_ros = False
    for word in words[1:]:
        is_ros = is_ros or word == '--ros-args'
        (for_ros if is_ros else own).append(word)
        is_ros = is_ros and word != '--'
    return own, for_ros


def given_values(words: Sequence[str]) -> Iterator[Given]:
    """What a command line gives after --ros-args, by files and rules, in its order.

    Raises InputError where a parameter file is none.
    """
    for flag, word in ros_arguments(words):
        if flag == _FILE:
            for section, values in sections(Path(word)).items():
                yield from (Given(section, name, value) for name, value in values.items())
        elif flag in _RULES:
            yield _given_by_rule(flag, word)


def _given_by_rule(flag: str, word: str) -> Given:
    names, _, text = word.partition(':=')
    node, _, name = names.rpartition(':')
    try:
        return Given(node or _ANY, name, parse_yaml(text))
    except InputError as error:
        raise InputError(f'{flag} {quoted(word)}: {error}') from error


def is_for(section: str, node: str) -> bool:
    """Whether a section is for a node by its full name, as ROS matches them."""
    pattern = re.escape('/' + section.lstrip('/'))
    pattern = pattern.replace(r'/\*\*', '(/[^/]+)*').replace(r'/\*', '/[^/]+')
    return re.fullmatch(pattern, node) is not None


def overruled_values(words: Sequence[str], node: str) -> dict[str, Any]:
    """Values that are given last for a node, by its full name, and that ROS does not take.

    ROS puts sections in the order in which they are first named: the value of a rule, which is in
    that for all nodes, stands below that of the node's own section of an earlier file.

    Raises InputError where a parameter file is none.
    """
    given = [each for each in given_values(words) if is_for(each.section, node)]
    order = list(dict.fromkeys(each.section for each in given))
    taken = {each.name: each for each in sorted(given, key=lambda each: order.index(each.section))}
    last = {each.name: each for each in given}
    return {name: each.value for name, each in last.items() if each is not taken[name]}


def sections(path: Path) -> dict[str, dict[str, Any]]:
    """Values by full name of each section of a file, by the name of its node with namespace.

    Raises InputError, with the name of the file, where it is no parameter file.
    """
    content = read_mapping(path, EXPECTED)
    return {key: dict(_leaves(tree, '')) for key, tree in _nodes(path, '', content)}


def bare(section: str) -> str:
    """Name of the node of a section, without its namespace."""
    return section.split('/')[-1]


def is_foreign(section: str, node: str) -> bool:
    """Whether a section is for a node of another package that one of ours replaces."""
    name = bare(section)
    return any(name in package.sections and node in package.nodes for package in PACKAGES)


def foreign_values(path: Path, node: str, namespace: str) -> dict[str, Any]:
    """Values of a file for the nodes of other packages that a node in a namespace replaces.

    Raises InputError, with the name of the file, where it is no parameter file.
    """
    values: dict[str, Any] = {}
    for section, own in sections(path).items():
        place = section.removesuffix(bare(section)).strip('/')
        is_here = place in ('', *WILDCARDS, namespace.strip('/'))
        if is_here and is_foreign(section, node):
            values |= own
    return values


def no_section(path: Path, nodes: Mapping[str, str]) -> str:
    """One line on a file that has no section for any of these nodes; '' where it has one.

    nodes: name of each before remapping, by its name.
    """
    found = sections(path)
    for section in found:
        if bare(section) in (*WILDCARDS, *nodes):
            return ''
        if any(is_foreign(section, program) for program in nodes.values()):
            return ''
    has = ', '.join(sorted(map(quoted, found))) or 'none'
    names = ', '.join(nodes)
    return f'{path}: no section for {names}: expected {next(iter(nodes))}: or /**:, found {has}'


def _nodes(path: Path, prefix: str, tree: Mapping[Any, Any]) -> Iterator[tuple[str, Any]]:
    """Each section by its name with namespaces, which files also write as mappings."""
    for key, value in tree.items():
        name = f'{prefix}{key}'
        values = value.get(_VALUES) if isinstance(value, dict) else None
        if isinstance(values, dict):
            yield name, values
        elif value and isinstance(value, dict) and _VALUES not in value:
            yield from _nodes(path, f'{name}/', value)
        else:
            node = prefix.strip('/') or name
            raise InputError(f'{path}: {quoted(node)}: expected {EXPECTED}')


def _leaves(values: Mapping[Any, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


_SEED = 'random_seed'  # negative: AMCL takes one from the clock


def translated(program: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Values by the names of a node's own parameters, for those of other packages.

    program: name of the node before remapping. A parameter that is given by its own name, too,
    keeps that value. A list of values is split among the parameters that it stands for.
    """
    own_values = dict(given)
    for foreign in _understood(program):
        if foreign.name not in given:
            continue
        own = [name for owner, name in foreign.targets if owner == program]
        value = given[foreign.name]
        values = list(value) if isinstance(value, list | tuple) else len(own) * [value]
        if foreign.name not in own:
            del own_values[foreign.name]
        if foreign.name == _SEED and isinstance(value, int) and value < 0:
            continue
        for name, single in zip(own, values, strict=False):
            own_values.setdefault(name, single)
    return own_values


def is_known(name: str) -> bool:
    """Whether a node of thinmap, if not this one, takes this parameter of another package."""
    return any(
        foreign.name == name and foreign.targets
        for package in PACKAGES
        for foreign in package.parameters
    )


def _understood(program: str) -> list[ForeignParameter]:
    return [
        foreign
        for package in PACKAGES
        if program in package.nodes
        for foreign in package.parameters
        if any(owner == program for owner, _ in foreign.targets)
    ]
