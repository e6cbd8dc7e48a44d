"""Parameter files of nodes, read without ROS: the values that the nodes would have."""

from pathlib import Path

import pytest

from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.scan import LaserConfig
from thinmap_ros.core.slam.localizer import default_config
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.tools.parameter_file import NodeParameters, read_parameter_file

ROOT = Path(__file__).resolve().parents[2]
NODES = ('localizer', 'grid_mapper', 'topology_builder')
PRESETS = sorted(
    [*(ROOT / 'config' / 'robots').iterdir(), *(ROOT / 'config' / 'sensors').iterdir()]
)


def read(tmp_path: Path, text: str) -> NodeParameters:
    path = tmp_path / 'some.yaml'
    path.write_text(text)
    return read_parameter_file(path, NODES)


@pytest.mark.parametrize('preset', PRESETS, ids=lambda path: path.stem)
def test_a_preset_has_parameters_of_the_nodes_and_no_others(preset: Path) -> None:
    parameters = read_parameter_file(preset, NODES)
    assert parameters.notes == []
    own = parameters.of_node['localizer']
    localizer = parameters.config('localizer', LocalizerConfig())
    assert localizer.lines.laser_range_noise_m == own['laser_range_noise_m']
    for node in NODES:
        laser = parameters.config(node, LaserConfig())
        assert laser.max_range_m == own['max_range_m']


@pytest.mark.parametrize('node', NODES)
def test_the_file_of_a_node_is_that_of_its_defaults(node: str) -> None:
    parameters = read_parameter_file(ROOT / 'config' / f'{node}.yaml', NODES)
    assert parameters.notes == []
    assert parameters.config('localizer', LocalizerConfig()) == LocalizerConfig()
    assert parameters.config('topology_builder', TopologyConfig()) == TopologyConfig()


def test_the_robot_is_described_for_all_nodes(tmp_path: Path) -> None:
    parameters = read(
        tmp_path,
        '/**:\n  ros__parameters:\n'
        '    {base_frame: base, robot_radius_m: 0.3, zero_is_no_return: true}\n'
        '/robot1/localizer:\n  ros__parameters: {base_frame: own}\n',
    )
    assert parameters.value('localizer', 'base_frame', '') == 'own'
    assert parameters.value('grid_mapper', 'base_frame', '') == 'base'
    assert parameters.value('localizer', 'zero_is_no_return', False) is True
    assert parameters.value('localizer', 'odom_frame', '') == ''
    assert parameters.config('topology_builder', TopologyConfig()).robot_radius_m == 0.3


def test_those_of_one_node_come_before_those_of_all_whatever_the_order(tmp_path: Path) -> None:
    parameters = read(
        tmp_path,
        'grid_mapper:\n  ros__parameters: {resolution_m: 0.02}\n'
        '/**:\n  ros__parameters: {resolution_m: 0.2}\n',
    )
    assert parameters.config('grid_mapper', OccupancyConfig()).resolution_m == 0.02


@pytest.mark.parametrize('key', ['slam_toolbox', '/**'])
def test_a_file_of_slam_toolbox_is_translated(tmp_path: Path, key: str) -> None:
    parameters = read(
        tmp_path,
        f'{key}:\n  ros__parameters:\n    resolution: 0.07\n    max_laser_range: 9.0\n'
        '    loop_search_maximum_distance: 4.0\n    base_frame: base_footprint\n'
        '    use_scan_matching: true\n',
    )
    grid = parameters.config('grid_mapper', OccupancyConfig())
    localizer = parameters.config('localizer', LocalizerConfig())
    assert grid.resolution_m == 0.07
    assert parameters.config('localizer', LaserConfig()).max_range_m == 9.0
    assert localizer.loop_closure.search_radius_m == 4.0
    assert parameters.value('localizer', 'base_frame', '') == 'base_footprint'
    (note,) = parameters.notes
    assert note.endswith('do not have: use_scan_matching')


def test_a_typing_error_is_noted_with_what_was_meant(tmp_path: Path) -> None:
    text = 'localizer:\n  ros__parameters:\n    matchng: {noise_m: 0.1}\n'
    (note,) = read(tmp_path, text).notes
    assert 'matchng.noise_m (did you mean ' in note and 'matching.noise_m' in note
    with pytest.raises(ConfigError, match=r'matchng\.noise_m'):
        read(tmp_path, text + '    strict_parameters: true\n')


@pytest.mark.parametrize(
    ('slam_of_file', 'option', 'unknown'),
    [
        ('', '', 'association.gate (only with slam: ekf_ti or ekf_full)'),
        ('ekf_ti', '', 'keyframes.angle_rad (only with slam: scan_matching)'),
        ('ekf_ti', 'scan_matching', 'association.gate (only with slam: ekf_ti or ekf_full)'),
        ('', 'ekf_full', 'keyframes.angle_rad (only with slam: scan_matching)'),
    ],
)
def test_the_localizer_that_is_chosen_decides_which_parameters_it_has(
    tmp_path: Path, slam_of_file: str, option: str, unknown: str
) -> None:
    path = tmp_path / 'some.yaml'
    slam = f'slam: {slam_of_file}, ' if slam_of_file else ''
    values = f'{{{slam}association.gate: 4.0, keyframes.angle_rad: 0.5}}'
    path.write_text(f'localizer:\n  ros__parameters: {values}\n')
    parameters = read_parameter_file(path, NODES, option)
    chosen = option or slam_of_file or 'scan_matching'
    (note,) = parameters.notes
    assert note.endswith(f'do not have: {unknown}')
    config = parameters.config('localizer', default_config(chosen))
    assert config.slam == chosen
    own = config.keyframes.angle_rad if chosen == 'scan_matching' else config.association.gate
    assert own in (0.5, 4.0)


def test_the_noise_of_the_laser_by_its_earlier_name_comes_with_its_name_now(tmp_path: Path) -> None:
    (note,) = read(tmp_path, 'localizer:\n  ros__parameters: {lines.range_noise_m: 0.03}\n').notes
    assert note.endswith('lines.range_noise_m (did you mean laser_range_noise_m?)')


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('localizer: 5\n', "'localizer': expected a parameter file"),
        ('localizer: {parameters: {}}\n', "'localizer': expected a parameter file"),
        ('navigator: {ros__parameters: {a: 1}}\n', 'no parameters of localizer, grid_mapper'),
        ('[1, 2]\n', 'expected a parameter file'),
        ('localizer: [\n', 'expected a parameter file'),
    ],
)
def test_what_is_no_parameter_file_is_refused_in_one_line(
    tmp_path: Path, text: str, said: str
) -> None:
    with pytest.raises(InputError, match=said) as error:
        read(tmp_path, text)
    assert 'some.yaml' in str(error.value) and '\n' not in str(error.value)


def test_a_value_that_is_not_allowed_names_its_parameter(tmp_path: Path) -> None:
    parameters = read(tmp_path, '/**:\n  ros__parameters: {resolution_m: fine, base_frame: 5}\n')
    with pytest.raises(ConfigError, match="resolution_m = 'fine'"):
        parameters.config('grid_mapper', OccupancyConfig())
    with pytest.raises(ConfigError, match='base_frame = 5: expected a str'):
        parameters.value('localizer', 'base_frame', '')
