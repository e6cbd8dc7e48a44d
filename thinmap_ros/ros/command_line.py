"""The command line of nodes: its help, and what ROS would report in its own words."""

import inspect
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rclpy.node import Node

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.files.package_data import config_file
from thinmap_ros.ros.foreign.sections import given_files, no_section, ros_arguments, sections

_RULES = {
    '-p': 'NAME:=VALUE',
    '--param': 'NAME:=VALUE',
    '-r': 'FROM:=TO',
    '--remap': 'FROM:=TO',
}
_SET = ':='


def check_arguments(words: Sequence[str]) -> None:
    """Check rules and parameter files after --ros-args, before ROS parses them.

    Raises InputError with the argument and what was expected.
    """
    for flag, word in ros_arguments(words):
        if flag in _RULES and _SET not in word:
            meant = f' (did you mean {word.replace("=", _SET, 1)}?)' if '=' in word else ''
            raise InputError(f'{flag} {quoted(word)}{meant}: expected {_RULES[flag]}')
    for file in given_files(words):
        if not file.is_file():
            raise InputError(f'--params-file {quoted(str(file))}: no such file')
        sections(file)


def warn_of_files(nodes: Sequence[Node], words: Sequence[str]) -> None:
    """Warn of each parameter file that has no section for any of these nodes."""
    programs = {node.get_name(): getattr(node, 'program', node.get_name()) for node in nodes}
    for file in given_files(words):
        if warning := no_section(file, programs):
            nodes[0].get_logger().warning(warning)


def show_help(node: Any) -> bool:
    """Whether the command line asks for help, which is printed then.

    node: class of the node; its parameters are in a file that is named.
    """
    words = sys.argv[1:]
    own = words[: words.index('--ros-args')] if '--ros-args' in words else words
    if not {'-h', '--help'} & set(own):
        return False
    name = Path(inspect.getfile(node)).stem
    print(f'usage: ros2 run thinmap_ros {name} [--ros-args -p NAME:=VALUE -r FROM:=TO ...]\n')
    print(inspect.getdoc(node))
    print(f'\nParameters, with their defaults and what they do: {config_file(name)}')
    return True
