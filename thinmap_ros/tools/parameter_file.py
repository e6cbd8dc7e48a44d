"""Parameter files of nodes (ros__parameters), for programs that run the same code without ROS."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thinmap_ros.core.config import AnyConfig, parameters_of, suggestion, with_values
from thinmap_ros.core.errors import ConfigError, InputError, quoted
from thinmap_ros.core.slam.localizer import default_config, parameters_elsewhere
from thinmap_ros.core.stage import StartConfig
from thinmap_ros.files.package_data import config_file
from thinmap_ros.ros.foreign import (
    EXPECTED,
    WILDCARDS,
    bare,
    is_foreign,
    is_known,
    sections,
    translated,
)

_LOCALIZER = 'localizer'
_STRICT = 'strict_parameters'


@dataclass(frozen=True)
class NodeParameters:
    """Parameters of nodes by node and full name, and notes on those that no node has."""

    of_node: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def config(self, node: str, base: AnyConfig) -> AnyConfig:
        """The config with the values that a node was given.

        Raises ConfigError where one is not allowed.
        """
        given = self.of_node.get(node, {})
        names = {name for name, _, _ in parameters_of(base)}
        return with_values(base, {name: given[name] for name in given.keys() & names})

    def value(self, node: str, name: str, default: Any) -> Any:
        """Value of a parameter. Raises ConfigError where it has another type than the default."""
        value = self.of_node.get(node, {}).get(name, default)
        if type(value) is not type(default):
            raise ConfigError(f'{name} = {quoted(value)}: expected a {type(default).__name__}')
        return value


def read_parameter_file(path: Path, nodes: tuple[str, ...], slam: str = '') -> NodeParameters:
    """Parameters of a file for some nodes, with those of other packages translated.

    Those for all nodes come before those for one. slam: value of that parameter of the localizer;
    empty: that of the file. Raises InputError with the file name if it has
    no parameters for them, and ConfigError, with `strict_parameters`, for those that no node has.
    """
    given: dict[str, dict[str, Any]] = {node: {} for node in nodes}
    found = sections(path)
    for section in sorted(found, key=lambda section: bare(section) not in WILDCARDS):
        for node in nodes:
            if bare(section) in (*WILDCARDS, node) or is_foreign(section, node):
                given[node].update(found[section])
    if not any(given.values()):
        raise InputError(f'{path}: no parameters of {", ".join(nodes)}: expected {EXPECTED}')
    own_values = {node: translated(node, values) for node, values in given.items()}
    if slam and _LOCALIZER in own_values:
        own_values[_LOCALIZER]['slam'] = slam
    return NodeParameters(own_values, _unknown(path, own_values))


def _unknown(path: Path, given: dict[str, dict[str, Any]]) -> list[str]:
    """Notes on the parameters that none of the nodes has: most of them are typing errors."""
    slam = given.get(_LOCALIZER, {}).get('slam', StartConfig.slam)
    elsewhere = parameters_elsewhere(slam)
    known = {name for node in given for name in _names_of(node, slam)}
    names = {name for values in given.values() for name in values}
    unknown = sorted(name for name in names - known if not is_known(name))
    if not unknown:
        return []
    nodes = ', '.join(given)
    is_one = len(given) == 1
    wrong = ', '.join(name + suggestion(name, known, elsewhere) for name in unknown)
    if any(values.get(_STRICT) is True for values in given.values()):
        has = f'node {nodes} has' if is_one else f'nodes {nodes} have'
        raise ConfigError(f'{path}: {has} no parameter {wrong}')
    lack = f'node {nodes} does not have' if is_one else f'nodes {nodes} do not have'
    return [f'{path}: ignored parameters that {lack}: {wrong}']


def _names_of(node: str, slam: str) -> set[str]:
    """Names of all parameters of a node; slam: as it is set."""
    file = config_file(node)
    names = set(sections(file)['/**'])
    if node != _LOCALIZER:
        return names
    own = {name for name, _, _ in parameters_of(default_config(slam))}
    return names - parameters_elsewhere(slam).keys() | own
