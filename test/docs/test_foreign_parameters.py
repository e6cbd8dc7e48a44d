"""Parameter files of other packages start thinmap's nodes; a page lists their names.

scripts/generate rewrites the tables of docs/reference/parameters_of_other_packages.md.
"""

import os
import re

import numpy as np
import pytest
import rclpy
import yaml
from support.node_list import ROOT, node_class

from thinmap_ros.core.errors import ConfigError
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.files.occupancy_maps import write_map
from thinmap_ros.ros.foreign import PACKAGES

PAGE = ROOT / 'docs' / 'reference' / 'parameters_of_other_packages.md'
MIGRATION = ROOT / 'docs' / 'migration'
ROWS = [(package, row) for package in PACKAGES for row in package.parameters]
TARGETS = sorted({target for _, row in ROWS for target in row.targets})
KNOWN = {row.name for _, row in ROWS if row.targets}
FILES = ROOT / 'test' / 'docs' / 'foreign'


def flat(values, prefix=''):
    """Parameters by their full names."""
    found = {}
    for key, value in values.items():
        name = f'{prefix}{key}'
        found |= flat(value, f'{name}.') if isinstance(value, dict) else {name: value}
    return found


@pytest.fixture
def start(ros_domain, tmp_path, monkeypatch):
    """Values of a node's parameters, and what it warned of, when started with some arguments."""
    monkeypatch.chdir(tmp_path)

    def started(name, *arguments):
        rclpy.init(args=['--ros-args', *arguments])
        warnings = []
        try:
            kind = node_class(name)
            logger = rclpy.logging.get_logger(name)
            monkeypatch.setattr(type(logger), 'warning', lambda _, text, **k: warnings.append(text))
            node = kind()
            values = {n: p.value for n, p in node._parameters.items()}
            node.close()
            node.destroy_node()
            return values, [text for text in warnings if 'ignored parameters' in text]
        finally:
            rclpy.shutdown()
            monkeypatch.undo()
            monkeypatch.chdir(tmp_path)

    return started


@pytest.mark.parametrize('node', sorted({owner for owner, _ in TARGETS}))
def test_every_target_is_a_parameter_of_its_node(start, node):
    declared, _ = start(node)
    named = {name for owner, name in TARGETS if owner == node}
    assert named <= declared.keys(), named - declared.keys()


def test_every_name_has_a_target_or_a_reason():
    for package, row in ROWS:
        assert row.targets or row.note, (package.name, row.name)
        assert {owner for owner, _ in row.targets} <= set(package.nodes), row.name


CASES = [
    ('slam_toolbox', 'localizer', {'transform_tolerance': 0.3, 'keyframes.distance_m': 0.4,
     'initial_x_m': 1.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.5, 'max_range_m': 20.0,
     'base_frame': 'base_footprint'}, 40),
    ('slam_toolbox', 'grid_mapper', {'resolution_m': 0.05, 'map_update_interval': 5.0}, 40),
    ('amcl', 'localizer', {'map_frame': 'map', 'publish_tf': True, 'transform_tolerance': 1.0,
     'base_frame': 'base_footprint'}, 25),
    ('amcl', 'global_localizer', {'samples': 3000, 'base_frame': 'base_footprint'}, 25),
    ('explore_lite', 'explorer', {'min_frontier_size': 0.75, 'progress_timeout': 30.0,
     'transform_tolerance': 0.3, 'costmap_topic': 'map'}, 5),
    ('nav2', 'navigator', {'controller.max_speed_m_s': 0.26, 'robot_radius_m': 0.22,
     'base_frame': 'base_footprint'}, 6),
]  # fmt: skip


@pytest.mark.parametrize(('file', 'node', 'expected', 'fewest'), CASES)
def test_a_file_of_another_package_starts_the_node(start, file, node, expected, fewest):
    path = FILES / f'{file}.yaml'
    values, warnings = start(node, '--params-file', str(path))
    assert {name: values[name] for name in expected} == expected
    (warning,) = warnings
    given = flat(yaml.safe_load(path.read_text())['/**']['ros__parameters'])
    listed = warning.split('does not have: ')[1].split('; strict_parameters')[0]
    named = {name for name in re.split(r', ', re.sub(r' \(did.*?\)', '', listed)) if name}
    assert named == {name for name in given if name not in values and name not in KNOWN}
    assert len(named) >= fewest
    with pytest.raises(ConfigError, match='has no parameter'):
        start(node, '--params-file', str(path), '-p', 'strict_parameters:=true')


def test_the_own_name_wins_over_that_of_another_package(start):
    arguments = ('-p', 'transform_timeout:=0.7', '-p', 'transform_tolerance:=0.1')
    assert start('localizer', *arguments)[0]['transform_tolerance'] == 0.1


@pytest.mark.parametrize(('given', 'seed'), [(-1, 0), (0, 0), (7, 7)])
def test_a_negative_random_seed_leaves_the_default(start, given, seed):
    values, warnings = start('global_localizer', '-p', f'random_seed:={given}')
    assert values['seed'] == seed
    assert warnings == []
    with pytest.raises(ConfigError, match='seed'):
        start('global_localizer', '-p', 'seed:=-1')


def test_the_map_of_map_server_is_that_of_localizer_and_grid_mapper(start, tmp_path):
    cells = np.full((40, 40), 0, dtype=np.int8)
    cells[[0, -1]] = 100
    path = write_map(tmp_path / 'hall', GridPatch(GridFrame(0.0, 0.0, 0.05), cells))
    given = (f'yaml_filename:={path}', 'free_thresh_default:=0.2', 'occupied_thresh_default:=0.7')
    arguments = [word for rule in (*given, 'mode:=localization') for word in ('-p', rule)]
    values, warnings = start('localizer', *arguments)
    assert (values['map_file_name'], warnings) == (str(path), [])
    values, warnings = start('grid_mapper', *arguments)
    assert (values['session_path'], warnings) == (str(path), [])
    assert (values['free_thresh'], values['occupied_thresh']) == (0.2, 0.7)


def test_a_misspelt_name_is_warned_of_with_what_was_probably_meant(start):
    arguments = ('-p', 'map_update_intervall:=5.0', '-p', 'occupied_tresh:=0.7')
    values, (warning,) = start('grid_mapper', *arguments)
    assert 'map_update_intervall (did you mean map_update_interval?)' in warning
    assert 'occupied_tresh (did you mean occupied_thresh?)' in warning
    assert (values['map_update_interval'], values['occupied_thresh']) == (1.0, 0.65)


def test_only_names_that_no_node_takes_are_warned_of(start):
    """One warning in all for those; none for what is meant for explorer or navigator."""
    arguments = ('-p', 'min_frontier_size:=0.7', '-p', 'FollowPath.max_vel_x:=0.3')
    assert start('localizer', *arguments)[1] == []
    unknown = ('-p', 'potential_scale:=0.1', '-p', 'gain_scale:=2.0')
    _, (warning,) = start('localizer', *arguments, *unknown)
    assert warning.count('potential_scale') == warning.count('gain_scale') == 1
    assert 'min_frontier_size' not in warning and 'max_vel_x' not in warning


def test_an_integer_is_accepted_for_a_float(start):
    values, _ = start('grid_mapper', '-p', 'map_update_interval:=5', '-p', 'resolution:=1')
    assert (values['map_update_interval'], values['resolution_m']) == (5.0, 1.0)


def test_quality_of_service_can_be_overridden(start):
    assert start('grid_mapper', '-p', 'qos_overrides./map.publisher.depth:=3')[1] == []


def test_a_value_that_does_not_fit_is_an_error_with_our_name(start):
    with pytest.raises(ConfigError, match='resolution_m'):
        start('grid_mapper', '-p', 'resolution:=-1.0')


def table(package):
    lines = ['| parameter | default | thinmap | |', '|---|---|---|---|']
    for row in package.parameters:
        targets = ', '.join(f'`{owner}` `{name}`' for owner, name in row.targets)
        lines.append(f'| `{row.name}` | {row.default or "(empty)"} | {targets} | {row.note} |')
    return '\n'.join(lines)


def test_the_page_lists_what_is_translated():
    text = PAGE.read_text()
    for package in PACKAGES:
        start = f'<!-- parameters of {package.name} -->\n'
        end = f'<!-- end of {package.name} -->'
        assert start in text and end in text, package.name
        before, rest = text.split(start)
        _, after = rest.split(end)
        text = before + start + table(package) + '\n' + end + after
    if 'THINMAP_WRITE_CONFIG' in os.environ:
        PAGE.write_text(text)
    assert PAGE.read_text() == text, f'{PAGE.name}: see the top of {__file__}'


@pytest.mark.parametrize(
    ('page', 'packages'),
    [
        ('from_slam_toolbox', ('slam_toolbox',)),
        ('from_explore_lite', ('explore_lite',)),
        ('from_amcl', ('nav2_amcl', 'map_server and map_saver')),
        ('from_nav2', ('Nav2 controller and bt_navigator',)),
    ],
)
def test_migration_pages_name_the_targets_of_the_tables(page, packages):
    """A row names all targets of its parameters, and none where there is none."""
    rows = {row.name: row for package, row in ROWS if package.name in packages}
    owners = {node for package in PACKAGES for node in package.nodes}
    count = 0
    for line in (MIGRATION / f'{page}.md').read_text().splitlines():
        theirs, _, ours = line.strip('| ').partition(' | ')
        named = [rows[name] for name in re.findall(r'`([^`]+)`', theirs) if name in rows]
        pairs = re.findall(r'`(\w+)` `([\w.]+)`', ours)
        targets = {(owner, name) for owner, name in pairs if owner in owners}
        if not line.startswith('|') or not named or not (targets or ours.startswith('no')):
            continue
        assert targets == {target for row in named for target in row.targets}, line
        count += 1
    assert count >= 8
