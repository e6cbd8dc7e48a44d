"""Sections of parameter files: which nodes they are for, also those of other packages' files."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.files.yaml import read_mapping
from thinmap_ros.ros.foreign.tables import PACKAGES

EXPECTED = 'a parameter file: NODE: ros__parameters: NAME: VALUE'
WILDCARDS = ('**', '*')
_VALUES = 'ros__parameters'


def given_files(words: Sequence[str]) -> list[Path]:
    """The parameter files that a command line names after --ros-args."""
    flags = ('--params-file',)
    return [Path(word) for flag, word in ros_arguments(words) if flag in flags]


def ros_arguments(words: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Each word after --ros-args, up to a --, with the word before it."""
    is_ros = False
    for before, word in pairwise(words):
        is_ros = before == '--ros-args' or (is_ros and before != '--')
        if is_ros:
            yield before, word


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
