"""The command `thinmap`: all programs of the package, each as a subcommand."""

import sys
from importlib import import_module
from typing import NamedTuple

import thinmap_ros.startup  # isort: skip  # noqa: F401  before all other modules
from thinmap_ros import __version__
from thinmap_ros.core.errors import ThinmapError
from thinmap_ros.tools.cli import BAD_INPUT
from thinmap_ros.tools.ros_check import require_ros


class _Program(NamedTuple):
    """A module of this package that has a `main`, in one line, and whether it needs ROS 2."""

    module: str
    summary: str
    needs_ros: bool = False


PROGRAMS = {
    'replay': _Program('tools.replay', 'logs or bags into trajectory, map, graph and report'),
    'explore_world': _Program('tools.explore_world', 'an exploration in the simulator'),
    'compare_exploration': _Program(
        'tools.compare_exploration', 'exploration strategies on worlds and starts, in one table'
    ),
    'map_to_graph': _Program('tools.map_to_graph', 'map_server maps into route graphs'),
    'evaluate': _Program('tools.evaluate', 'errors of a trajectory against a reference'),
    'merge_sessions': _Program('tools.merge_sessions', 'maps of one place into one session'),
    'carmen_to_bag': _Program('tools.carmen_to_bag', 'a CARMEN log into a bag'),
    'bag_repair': _Program('tools.bag_repair', 'a damaged bag (MCAP) into a whole one'),
    'experiment': _Program('tools.experiment', "the papers' figures and tables"),
    'record_bags': _Program('tools.record_bags', 'the drives of the experiments as bags'),
    'warm_up': _Program('tools.warm_up', 'compile all kernels, once, so that programs start fast'),
    'demo': _Program('tools.demo', 'a simulated robot explores a room on a live ROS 2 graph', True),
    'nodes': _Program('nodes.thinmap', 'ROS 2 nodes in one process', True),
}

_SHORT = {'merge': 'merge_sessions'}


def _usage() -> str:
    width = max(map(len, PROGRAMS))
    lines = [
        f'  {name:{width}}  {program.summary}{" (needs ROS 2)" if program.needs_ros else ""}'
        for name, program in PROGRAMS.items()
    ]
    return '\n'.join(
        [
            'usage: thinmap SUBCOMMAND [ARGUMENT ...]',
            '       thinmap --help | --version',
            '',
            *lines,
            '',
            'thinmap SUBCOMMAND --help lists the arguments of a subcommand.',
            *(f'thinmap {short} is short for {name}.' for short, name in _SHORT.items()),
        ]
    )


def _fail(message: str) -> None:
    print(f'thinmap: error: {message}', file=sys.stderr)
    sys.exit(BAD_INPUT)


def _run(name: str, arguments: list[str]) -> None:
    program = PROGRAMS[name]
    if program.needs_ros:
        try:
            require_ros()
        except ThinmapError as error:
            _fail(f'{name} {error}')
    sys.argv = [f'thinmap {name}', *arguments]
    import_module(f'thinmap_ros.{program.module}').main()


def main() -> None:
    """Run the subcommand that the command line names.

    Ends with 2, after one line on what is wrong, where there is no such subcommand.
    """
    arguments = sys.argv[1:]
    if not arguments:
        _fail('expected a subcommand: thinmap --help lists them')
    name = _SHORT.get(arguments[0], arguments[0])
    if name in ('-h', '--help'):
        print(_usage())
    elif name == '--version':
        print(f'thinmap {__version__}')
    elif name in PROGRAMS:
        _run(name, arguments[1:])
    else:
        _fail(f'{name!r}: no such subcommand: expected one of {", ".join(PROGRAMS)}')


if __name__ == '__main__':
    main()
