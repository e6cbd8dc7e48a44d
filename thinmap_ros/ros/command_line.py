"""The command line of nodes: its help, and what ROS would report in its own words."""

import inspect
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from thinmap_ros.core.errors import InputError, one_line, quoted
from thinmap_ros.files.package_data import config_file
from thinmap_ros.ros.foreign import (
    given_files,
    given_values,
    is_for,
    no_section,
    ros_arguments,
    split_arguments,
)
from thinmap_ros.ros.private_rclpy import RCLError, UnknownROSArgsError

_RULES = {
    '-p': 'NAME:=VALUE',
    '--param': 'NAME:=VALUE',
    '-r': 'FROM:=TO',
    '--remap': 'FROM:=TO',
}
_SET = ':='


def init_ros(words: Sequence[str]) -> None:
    """Initialize ROS with the arguments after --ros-args.

    Raises InputError with the argument that is wrong, and what was expected.
    """
    _check_arguments(words)
    # Of the others ROS would take name:=value for a remapping.
    _, arguments = split_arguments(words)
    # Its own line on wrong arguments would come before ours.
    set_logger_level('rcl', LoggingSeverity.FATAL)
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (RCLError, UnknownROSArgsError) as error:
        is_unknown = isinstance(error, UnknownROSArgsError)
        reason = re.sub(r'^failed to initialize rcl: |, at /\S+:\d+', '', str(error))
        text = f'{"unknown: " if is_unknown else ""}{one_line(reason)}'
        raise InputError(f'arguments after --ros-args: {text}') from error
    finally:
        set_logger_level('rcl', LoggingSeverity.UNSET)


def _check_arguments(words: Sequence[str]) -> None:
    """Check rules and parameter files after --ros-args, before ROS parses them."""
    for flag, word in ros_arguments(words):
        if flag in _RULES and _SET not in word:
            meant = f' (did you mean {word.replace("=", _SET, 1)}?)' if '=' in word else ''
            raise InputError(f'{flag} {quoted(word)}{meant}: expected {_RULES[flag]}')
        if flag in _RULES and word.endswith(_SET):
            raise InputError(f'{flag} {quoted(word)}: no value: expected {_RULES[flag]}')
    for file in given_files(words):
        if not file.is_file():
            raise InputError(f'--params-file {quoted(str(file))}: no such file')
    for _ in given_values(words):
        pass  # raises for a file or a value that cannot be read


def refusal(word: str) -> str:
    """What is wrong with a word that is for no node, and not for ROS either."""
    rules = ' or '.join(f'--ros-args {flag} {word}' for flag in ('-p', '-r'))
    return f'{quoted(word)}: expected {rules if _SET in word else "arguments after --ros-args"}'


def warn_of_unused(nodes: Sequence[Node], words: Sequence[str]) -> None:
    """Warn of parameter files, and of rules for one node, that are for none of these nodes."""
    programs = {node.get_name(): getattr(node, 'program', node.get_name()) for node in nodes}
    logger = nodes[0].get_logger()
    for file in given_files(words):
        if warning := no_section(file, programs):
            logger.warning(warning)
    names = [node.get_fully_qualified_name() for node in nodes]
    for flag, word in ros_arguments(words):
        section, _, name = word.partition(_SET)[0].rpartition(':')
        if flag in ('-p', '--param') and section and not any(is_for(section, n) for n in names):
            logger.warning(f'{flag} {word}: not taken: no node {section}: expected -p {name}:=...')


def show_help(node: Any) -> bool:
    """Whether the command line asks for help, which is printed then.

    node: class of the node; its parameters are in a file that is named.
    """
    if not {'-h', '--help'} & set(split_arguments(sys.argv)[0]):
        return False
    name = Path(inspect.getfile(node)).stem
    print(f'usage: ros2 run thinmap_ros {name} [--ros-args -p NAME:=VALUE -r FROM:=TO ...]\n')
    print(inspect.getdoc(node))
    print(f'\nParameters, with their defaults and what they do: {config_file(name)}')
    return True
