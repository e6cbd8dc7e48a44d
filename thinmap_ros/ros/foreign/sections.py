"""Sections of parameter files: which nodes they are for, also those of other packages' files."""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.files.safe import parse_yaml, read_mapping
from thinmap_ros.ros.foreign.tables import PACKAGES

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
