"""Each NAME:=VALUE of README, the pages and the helps is one that a node takes.

What whole commands do with them test_documented_commands.py runs.
"""

import re

import pytest
import yaml
from support.launch_file import constants
from support.node_list import ROOT

from thinmap_ros.files.safe import parse_yaml
from thinmap_ros.nodes import thinmap
from thinmap_ros.ros.foreign import is_known

PAGES = [ROOT / 'README.md', *sorted((ROOT / 'docs').rglob('*.md'))]
SOURCES = [*sorted((ROOT / 'thinmap_ros').rglob('*.py')), *sorted((ROOT / 'config').rglob('*.*'))]
# A value may be in quotes for the shell, or a variable of it.
_GIVEN = re.compile(
    r"""(?<![\w/.:])(?:\w+:)?([A-Za-z_/][\w./]*):=(?:"([^"`\n]+)"|["']?([^\s`'"|)\]]+))"""
)
_REMAPPING = re.compile(r'(-r|--remap) \S+:=\S+')
_LAUNCH = re.compile(r'ros2 launch thinmap_ros thinmap\.launch\.py((?: \w+:=[^`\s]+)*)')
_COMMAND = re.compile(r'ros2 run thinmap_ros ([a-z_]+)((?:[^`\n]|\\\n)*)')
TOPICS = {'scan', 'odom', 'tf', 'tf_static', 'cmd_vel', 'map', 'robot', 'stop'}
ARGUMENTS = {'web:=true', 'web:=false'}
# Placeholders, and what the programs of others take.
OTHERS = {'NAME', 'FROM', 'name', 'robot_base_frame', 'publish_tf'}


def leaves(values, prefix=''):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, f'{prefix}{name}.')
        else:
            yield prefix + name, value


def defaults(file):
    return dict(leaves(yaml.safe_load(file.read_text())['/**']['ros__parameters']))


NODES = {file.stem: defaults(file) for file in (ROOT / 'config').glob('*.yaml')}
NODES['thinmap'] = {name: value for node in NODES.values() for name, value in node.items()}


def is_remapping(name):
    """Whether a rule maps a topic, or the name or namespace of a node, to another."""
    return name.startswith('__') or name.lstrip('/').split('/')[0] in TOPICS


def wrong_values(text, node='thinmap'):
    """What is no parameter of a node, or of another type, in a text."""
    wrong = []
    text = _LAUNCH.sub('', text)
    for name, quoted, plain in _GIVEN.findall(_REMAPPING.sub('', text)):
        given = quoted or plain.rstrip(':.,')
        rule = f'{name}:={given}'
        if name in OTHERS or rule in ARGUMENTS or is_remapping(name) or is_known(name):
            continue
        default = NODES[node].get(name)
        kinds = (int, float) if isinstance(default, float) else (type(default),)
        if default is None or not isinstance(parse_yaml(given), kinds):
            wrong.append(rule)
    return wrong


@pytest.mark.parametrize('page', PAGES, ids=lambda path: path.stem)
def test_documented_values_are_taken(page):
    assert wrong_values(page.read_text()) == []
    for words in _LAUNCH.findall(page.read_text()):
        assert {word.split(':=')[0] for word in words.split()} <= constants()['ARGUMENTS'].keys()
    for node, words in _COMMAND.findall(page.read_text()):
        assert node in NODES
        assert wrong_values(words, node) == [], node


def test_values_in_helps_and_parameter_files_are_taken():
    found = {rule for file in SOURCES for rule in wrong_values(file.read_text(errors='replace'))}
    assert found == set()
    assert wrong_values(thinmap._USAGE) == []


def test_a_wrong_value_is_found():
    text = '`-p robot_width:=0.2`, `localizer:slam:=7`, `stop_radius_m:=wide`, `-r scan:=x/scan`'
    assert wrong_values(text) == ['robot_width:=0.2', 'slam:=7', 'stop_radius_m:=wide']
    assert wrong_values('-p stop_radius_m:=0.2', 'localizer') == ['stop_radius_m:=0.2']
