"""All nodes in one process: less memory and less work than a process for each."""

import pkgutil
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING

from thinmap_ros import nodes
from thinmap_ros.core.errors import did_you_mean, quoted

if TYPE_CHECKING:
    from rclpy.node import Node

BY_DEFAULT = ('localizer', 'grid_mapper', 'topology_builder', 'navigator', 'explorer')
_NO_CHOICE = ('demo_monitor', 'thinmap')
_OTHERS = [
    module.name
    for module in pkgutil.iter_modules(nodes.__path__)
    if not module.ispkg and module.name not in (*BY_DEFAULT, *_NO_CHOICE)
]
NODES = (*BY_DEFAULT, *_OTHERS)
_WITH_PAGE = 'web:=true'
_WITHOUT_PAGE = 'web:=false'
_USAGE = f"""usage: {{program}} [NODE ...] [{_WITH_PAGE}] [--ros-args ...]

Runs nodes in one process. Without names: {', '.join(BY_DEFAULT)}.
{_WITH_PAGE}: with web, the page in the browser, beside them; {_WITHOUT_PAGE}: without.
There are also: {', '.join(_OTHERS)}.
A parameter goes to every node that has it; -p localizer:slam:=ekf_ti sets that of one."""


def node_factories(names: list[str]) -> list['Callable[[], Node]']:
    """Functions that create the nodes of these modules, one each."""

    def make(name: str) -> 'Node':
        # Imported here: a node that is not chosen costs nothing. All are imported before the first
        # is created, so that the kernels of all are counted.
        modules = {each: import_module(f'thinmap_ros.nodes.{each}') for each in names}
        return getattr(modules[name], f'{name.title().replace("_", "")}Node')()

    return [partial(make, name) for name in names]


def chosen_nodes(words: list[str]) -> list[str]:
    """Names of the nodes that the words of a command line choose."""
    names = [word for word in words if word not in (_WITH_PAGE, _WITHOUT_PAGE)] or list(BY_DEFAULT)
    return [*names, 'web'] if _WITH_PAGE in words else names


def _refused(unknown: list[str]) -> str:
    """What is wrong with names that cannot be run together."""
    if not unknown:
        return 'a name twice: expected each node once'
    meant = did_you_mean(unknown[0], NODES)
    return f'{quoted(unknown[0])}: no such node{meant}: expected one of {", ".join(NODES)}'


def main() -> None:
    """Run the nodes that the command line names."""
    program = sys.argv[0]
    usage = _USAGE.format(program=program if program.startswith('thinmap ') else 'thinmap')
    if {'-h', '--help'} & set(sys.argv):
        print(usage)
        return
    # Only now: the help needs no ROS.
    from thinmap_ros.ros import node_main
    from thinmap_ros.ros.foreign import split_arguments
    from thinmap_ros.ros.node_main import refusal

    names = chosen_nodes(split_arguments(sys.argv)[0])
    unknown = [name for name in names if name not in NODES]
    if unknown and ':=' in unknown[0]:
        expected = f"'{unknown[0]}': expected {_WITH_PAGE} or {_WITHOUT_PAGE}"
        is_page = unknown[0].startswith('web:=')
        print(f'error: {expected if is_page else refusal(unknown[0])}', file=sys.stderr)
        sys.exit(2)
    if unknown or len(set(names)) < len(names):
        print(f'error: {_refused(unknown)}', file=sys.stderr)
        sys.exit(2)
    node_main.run_all(node_factories(names))


if __name__ == '__main__':
    main()
