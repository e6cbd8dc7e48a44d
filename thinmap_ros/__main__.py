"""The command `thinmap`: all programs of the package, each as a subcommand."""

import sys
from importlib import import_module
from typing import NamedTuple

import thinmap_ros.startup  # isort: skip  # noqa: F401  before all other modules
from thinmap_ros import __version__
from thinmap_ros.core.errors import ThinmapError, did_you_mean
from thinmap_ros.nodes.thinmap import NODES
from thinmap_ros.tools.arguments import BAD_INPUT, is_asked, require_ros, subcommand, while_read


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
    'fetch_logs': _Program(
        'tools.fetch_logs', 'check published logs in a folder, convert them for the benchmarks'
    ),
    'record_bags': _Program('tools.record_bags', 'the drives of the experiments as bags'),
    'warm_up': _Program('tools.warm_up', 'compile all kernels, once, so that programs start fast'),
    'doctor': _Program('tools.doctor', 'what a running robot lacks, in one table', True),
    'robot': _Program('tools.robot', 'a robot checked, mapped, driven and saved', True),
    'demo': _Program('tools.demo', 'a simulated robot explores a room on a live ROS 2 graph', True),
    'nodes': _Program('nodes.thinmap', 'ROS 2 nodes in one process', True),
}

_SHORT = {'merge': 'merge_sessions'}
_HELP = {'-h', '--help'}


def _usage() -> str:
    width = max(map(len, PROGRAMS))
    lines = [
        f'  {name:{width}}  {program.summary}{" (needs ROS 2)" if program.needs_ros else ""}'
        for name, program in PROGRAMS.items()
    ]
    return '\n'.join(
        [
            'usage: thinmap SUBCOMMAND [ARGUMENT ...]',
            '       thinmap help [SUBCOMMAND] | --version',
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
    if program.needs_ros and not _HELP & set(arguments):
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
    with while_read():
        _main()


def _main() -> None:
    if is_asked():
        _complete()
    arguments = sys.argv[1:]
    if not arguments:
        arguments = ['--help']
    if arguments[0] == 'help':
        arguments = [*arguments[1:2], '--help']
    name = _full(arguments[0])
    if name in _HELP:
        print(_usage())
    elif name == '--version':
        print(f'thinmap {__version__}')
    elif name in PROGRAMS:
        _run(name, arguments[1:])
    elif name in NODES:
        _fail(f'{name!r}: no such subcommand, but a node: expected thinmap nodes {name}')
    else:
        likely = did_you_mean(name, [*PROGRAMS, *_SHORT])
        _fail(f'{name!r}: no such subcommand{likely}: expected one of {", ".join(PROGRAMS)}')


def _full(name: str) -> str:
    """Name of a subcommand that may be short, or have hyphens."""
    underscored = name if name.startswith('-') else name.replace('-', '_')
    return _SHORT.get(underscored, underscored)


def _complete() -> None:
    """Complete the command line with Tab, and end."""
    name = _full(subcommand([*PROGRAMS, 'help']))
    # The nodes have no parser: running their module would start them.
    if name in PROGRAMS and name != 'nodes':
        _run(name, ['--help'])  # which needs no ROS
    sys.exit()


if __name__ == '__main__':
    main()
