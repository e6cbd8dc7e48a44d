"""config/*.yaml contain every parameter that the nodes declare, its default and its description.

scripts/generate rewrites the files from the declarations.
"""

import json
import os
import re
import shutil
import textwrap

import pytest
import rclpy
import yaml
from support.node_list import (
    NEEDED,
    NODES,
    OF_EVERY_NODE,
    OWN_WORDS,
    ROOT,
    VARIANTS,
    default_of,
    node_class,
    variant_text,
)

from thinmap_ros.core.errors import ConfigError
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.ros import parameters


@pytest.fixture
def declared(ros_domain, tmp_path, monkeypatch):
    """Value and descriptor of a node's parameters by name, when started with some arguments."""
    monkeypatch.chdir(tmp_path)
    BagWriter(tmp_path / 'some_bag', live=True).close()

    def start(name, *arguments):
        shutil.rmtree('bag', ignore_errors=True)  # of a recorder before
        rclpy.init(args=['--ros-args', *arguments])
        try:
            node = node_class(name)()
            names = [
                n
                for n in node._parameters
                if n not in OF_EVERY_NODE and not n.startswith('qos_overrides')
            ]
            found = {n: (node.get_parameter(n).value, node.describe_parameter(n)) for n in names}
            getattr(node, 'close', lambda: None)()
            node.destroy_node()
            return found
        finally:
            rclpy.shutdown()

    return start


def described(name, value, descriptor, indent):
    text = OWN_WORDS.get(name, descriptor.description)
    limits = [*descriptor.floating_point_range, *descriptor.integer_range]
    if limits:
        text += f' Range: {limits[0].from_value:g} to {limits[0].to_value:g}.'
    if descriptor.additional_constraints:
        text += f' {descriptor.additional_constraints.capitalize()}.'
    assert text, f'{name} has no description'
    if not (descriptor.read_only or name in OWN_WORDS or 'run time' in text):
        text += ' Can be changed at run time.'
    comment = f'{indent}# '
    lines = textwrap.wrap(text, 112, initial_indent=comment, subsequent_indent=comment)
    return [*lines, indent + yaml.safe_dump({name.split('.')[-1]: value}).strip()]


def flat(values, prefix=''):
    """Parameters by their full names."""
    found = {}
    for key, value in values.items():
        if isinstance(value, dict):
            found |= flat(value, f'{prefix}{key}.')
        else:
            found[prefix + key] = value
    return found


def file_text(name, parameters, others):
    lines = [f'# Parameters of the node {name}, with their defaults:', '#   ros2 run thinmap_ros']
    lines[1] += f' {name} --ros-args --params-file config/{name}.yaml'
    lines += ['/**:', '  ros__parameters:', *parameter_lines(parameters)]
    if others:
        comment = '    # '
        text = variant_text(parameters, others)
        lines += textwrap.wrap(text, 112, initial_indent=comment, subsequent_indent=comment)
        own = {key: found for key, found in others.items() if key not in parameters}
        lines += [comment + line[4:] for line in parameter_lines(own)]
    return '\n'.join(lines) + '\n'


def parameter_lines(parameters):
    lines = []
    group = []
    for parameter, (value, descriptor) in parameters.items():
        *parts, _ = parameter.split('.')
        for depth, part in enumerate(parts):
            if parts[: depth + 1] != group[: depth + 1]:
                lines.append('  ' * (depth + 2) + f'{part}:')
        group = parts
        lines += described(parameter, value, descriptor, '  ' * (len(parts) + 2))
    return lines


def needed_arguments(name):
    needed = NEEDED.get(name, {})
    return [w for key, value in needed.items() for w in ('-p', f'{key}:={json.dumps(value)}')]


def variant_arguments(name):
    return [w for key, value in VARIANTS.get(name, {}).items() for w in ('-p', f'{key}:={value}')]


@pytest.mark.parametrize('name', NODES)
def test_config_file_says_what_the_node_declares(declared, name):
    path = ROOT / 'config' / f'{name}.yaml'
    found = declared(name, *needed_arguments(name))
    for key in NEEDED.get(name, {}):
        found[key] = (default_of(name, key), found[key][1])
    variant = variant_arguments(name)
    text = file_text(name, found, declared(name, *variant) if variant else {})
    if 'THINMAP_WRITE_CONFIG' in os.environ:
        path.write_text(text)
    assert path.read_text() == text, (
        f'{path.name}: see the top of {__file__} for how to regenerate it'
    )


@pytest.mark.parametrize('name', NODES)
def test_node_takes_its_config_file(declared, tmp_path, name):
    content = yaml.safe_load((ROOT / 'config' / f'{name}.yaml').read_text())
    values = content['/**']['ros__parameters']
    # A value that is not the default proves that the file is read.
    values['use_sim_time'] = True
    values |= NEEDED.get(name, {})
    (tmp_path / 'given.yaml').write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}))
    found = declared(name, '--params-file', str(tmp_path / 'given.yaml'))
    assert {n: value for n, (value, _) in found.items()} == flat(values)


@pytest.mark.parametrize('slam', ['scan_matching', 'ekf_ti', 'ekf_full'])
def test_the_localizer_takes_what_its_file_shows_for_its_kind(declared, tmp_path, slam):
    """The comments at the end of the file are the parameters of the filters."""
    text = (ROOT / 'config' / 'localizer.yaml').read_text()
    usual, filters = re.split(r'^ +# With slam: .+\n(?: +# .+\n)*? +# .+but:\n', text, flags=re.M)
    values = yaml.safe_load(usual)['/**']['ros__parameters']
    if slam != 'scan_matching':
        head = text[len(usual) : len(text) - len(filters)].replace('\n    #', '')
        missing = re.search(r'there are no (.+), but:', head)[1].replace(' and ', ', ').split(', ')
        shown = flat(values)
        assert all(any(f'{n}.'.startswith(f'{m}.') for n in shown) for m in missing)
        values = {
            n: v
            for n, v in shown.items()
            if not f'{n}.'.startswith(tuple(f'{m}.' for m in missing))
        }
        assert f'slam: {slam}' in head or f'or {slam}' in head
        values |= flat(yaml.safe_load(filters.replace('    # ', '')))
        values['slam'] = slam
    given = tmp_path / 'given.yaml'
    values['strict_parameters'] = True
    given.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}))
    found = declared('localizer', '--params-file', str(given))
    assert {n: value for n, (value, _) in found.items()} == flat(values)


def test_unknown_key_of_a_file_is_an_error(declared, tmp_path):
    (tmp_path / 'given.yaml').write_text(
        yaml.safe_dump({'/**': {'ros__parameters': {'windwo_m': 3.0}}})
    )
    arguments = ('--params-file', str(tmp_path / 'given.yaml'), '-p', 'strict_parameters:=true')
    with pytest.raises(ConfigError, match=r'no parameter windwo_m; it has: .*local_map_size_m'):
        declared('grid_mapper', *arguments)
    with pytest.raises(ConfigError, match='no parameter windwo_m'):
        declared('sim', *arguments[:2])  # nobody gives it the file of another package


@pytest.mark.parametrize(
    ('name', 'meant'),
    [
        ('max_speed_m_s', 'controller.max_speed_m_s'),
        ('planner.unknown_costs', 'planner.unknown_cost'),
    ],
)
def test_an_unknown_parameter_comes_with_what_was_probably_meant(declared, name, meant):
    with pytest.raises(
        ConfigError, match=rf'no parameter {name} \(did you mean {meant}\?\); it has'
    ):
        declared('navigator', '-p', f'{name}:=0.5', '-p', 'strict_parameters:=true')


@pytest.mark.parametrize(
    ('node', 'name'),
    [('localizer', 'lines.range_noise_m'), ('global_localizer', 'range_noise_m')],
)
def test_the_noise_of_the_laser_by_an_earlier_name_comes_with_its_name_now(declared, node, name):
    meant = rf'no parameter {name} \(did you mean laser_range_noise_m\?\); it has'
    with pytest.raises(ConfigError, match=meant):
        declared(node, '-p', f'{name}:=0.02', '-p', 'strict_parameters:=true')


def test_there_is_a_file_for_each_node_and_no_other():
    files = sorted(path.stem for path in (ROOT / 'config').glob('*.yaml'))
    assert files == sorted([*NODES, 'thinmap'])


def test_robot_file_is_accepted_by_every_node_and_has_its_defaults(declared):
    """One file describes the robot for all nodes."""
    path = ROOT / 'config' / 'thinmap.yaml'
    values = yaml.safe_load(path.read_text())['/**']['ros__parameters']
    assert sorted(values) == sorted(parameters.ROBOT)
    seen = set()
    for name in NODES:
        found = declared(name, '--params-file', str(path), *needed_arguments(name))
        own = {key: found[key][0] for key in values if key in found}
        assert own == {key: values[key] for key in own}
        seen |= set(own)
    assert seen == set(values)


PRESETS = sorted((ROOT / 'config').glob('*s/*.yaml'))


@pytest.mark.parametrize('name', NODES)
def test_presets_are_known_to_every_node(declared, name):
    for preset in PRESETS:
        content = yaml.safe_load(preset.read_text())
        # These hold in any namespace, as the next test shows.
        assert content.keys() <= {'/**', *(f'/**/{node}' for node in NODES)}
        own = content.get(f'/**/{name}', {}).get('ros__parameters', {})
        of_all = content.get('/**', {}).get('ros__parameters', {})
        assert set(of_all) <= set(parameters.ROBOT)
        found = declared(name, '--params-file', str(preset), *needed_arguments(name))
        assert {key: found[key][0] for key in flat(own)} == flat(own), preset.stem
        shared = of_all.keys() & found.keys()
        assert {key: found[key][0] for key in shared} == {key: of_all[key] for key in shared}


@pytest.mark.parametrize('name', ['grid_mapper', 'localizer', 'sim'])
def test_presets_hold_in_a_namespace(declared, name):
    sections = yaml.safe_load(PRESETS[0].read_text())
    own = flat(sections[f'/**/{name}']['ros__parameters'])
    found = declared(name, '--params-file', str(PRESETS[0]), '-r', '__ns:=/robot1')
    assert {key: found[key][0] for key in own} == own


def test_preset_of_a_laser_that_publishes_zero_holds_for_every_node_with_a_laser(declared):
    preset = ROOT / 'config' / 'robots' / 'turtlebot3.yaml'
    files = (ROOT / 'config').glob('*.yaml')
    declaring = {path.stem for path in files if 'zero_is_no_return' in path.read_text()}
    for name in sorted(declaring - {'thinmap'}):
        found = declared(name, '--params-file', str(preset), *needed_arguments(name))
        assert found['zero_is_no_return'][0]


def test_presets_fit_together():
    assert len(PRESETS) == 8
    for preset in PRESETS:
        content = yaml.safe_load(preset.read_text())
        sim, grid, localizer = (
            flat(content[f'/**/{name}']['ros__parameters'])
            for name in ('sim', 'grid_mapper', 'localizer')
        )
        laser = content['/**']['ros__parameters']
        max_range_m = laser['max_range_m']
        assert localizer.get('lines.max_range_m', 0.0) <= max_range_m <= sim['range_max_m']
        reach_m = max(grid['no_return_clear_range_m'], min(max_range_m, 4.0))
        assert grid['local_map_size_m'] >= 2.0 * reach_m
        assert sim['range_noise_m'] <= laser['laser_range_noise_m']


def test_range_and_noise_of_a_laser_stand_once_in_a_preset():
    for preset in PRESETS:
        sections = yaml.safe_load(preset.read_text())
        laser = sections['/**']['ros__parameters']
        assert {'max_range_m', 'laser_range_noise_m'} <= laser.keys()
        of_nodes = {
            name: value
            for section in sections.keys() - {'/**', '/**/sim'}
            for name, value in flat(sections[section]['ros__parameters']).items()
        }
        assert not [name for name in of_nodes if 'range_noise' in name]
        assert of_nodes.get('lines.max_range_m') != laser['max_range_m']
