"""Common parts of command line programs: arguments, errors in one line, exit codes."""

import argparse
import shlex
import signal
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from thinmap_ros.core.config import AnyConfig, Config, is_parameter
from thinmap_ros.core.errors import ThinmapError
from thinmap_ros.core.scan import LaserConfig
from thinmap_ros.kernels import report_compilation
from thinmap_ros.logs import reading
from thinmap_ros.logs.frames import SOURCES
from thinmap_ros.logs.log import LaserOptions, Log
from thinmap_ros.logs.transforms import parse_pose
from thinmap_ros.startup import print_warnings
from thinmap_ros.tools.arguments import BAD_INPUT, while_read
from thinmap_ros.tools.parameter_file import NodeParameters

_INTERRUPTED = 130
_TOPICS = '--scan-topic'
_NO_PARAMETERS = NodeParameters()
# argparse's base class of parsers and groups of options.
Options = argparse._ActionsContainer


def run(work: Callable[[argparse.Namespace], None], parser: argparse.ArgumentParser) -> None:
    """Parse the arguments, run the work, and exit.

    0, 2 after one line on what is wrong, 130 on Ctrl-C, or 141 once nobody reads what it prints.
    """
    with while_read():
        _run(work, parser)


def _run(work: Callable[[argparse.Namespace], None], parser: argparse.ArgumentParser) -> None:
    words = sys.argv[1:]
    arguments = parser.parse_args(_files_first(words) if _takes_files(parser) else words)
    print_warnings(parser.prog)
    compilation = report_compilation()
    try:
        _catch_interrupts()
        work(arguments)
    except BrokenPipeError:
        raise
    except (ThinmapError, OSError) as error:
        print(f'{parser.prog}: error: {" ".join(str(error).split())}', file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        print(f'{parser.prog}: interrupted', file=sys.stderr)
        sys.exit(_INTERRUPTED)
    finally:
        compilation.end()


def _takes_files(parser: argparse.ArgumentParser) -> bool:
    return any(not action.option_strings for action in parser._actions)


def _files_first(words: list[str]) -> list[str]:
    """The words of a command line, where files behind a scan topic come before the options."""
    if _TOPICS not in words:
        return words
    begin = words.index(_TOPICS) + 2
    end = next((k for k in range(begin, len(words)) if words[k].startswith('-')), len(words))
    # No topic has a dot in its name.
    files = [word for word in words[begin:end] if '.' in word or Path(word).exists()]
    topics = [word for word in words[begin:end] if word not in files]
    return [*files, *words[:begin], *topics, *words[end:]]


def command_line() -> str:
    """The command that runs this program again, for a shell."""
    return command_of(Path(sys.argv[0].split()[-1]).stem, *sys.argv[1:])


def command_of(program: str, *words: str) -> str:
    """The command that runs a program of this package, for a shell."""
    return shlex.join(['thinmap', program, *words])


def is_module() -> bool:
    """Whether this program was run as a module of the source tree."""
    return sys.argv[0].endswith('.py')


def _catch_interrupts() -> None:
    """Have Ctrl-C raise KeyboardInterrupt, which ended the process while it imported modules."""
    if callable(signal.getsignal(signal.SIGINT)):
        signal.signal(signal.SIGINT, signal.default_int_handler)


def add_config(parser: Options, config: type[Config], names: list[str] | None = None) -> None:
    """Add an option for each field of a config (or the named ones), with its description.

    Options that are not given are not among the arguments: `config_from` uses the defaults.
    """
    for field in filter(is_parameter, fields(config)):
        if names is None or field.name in names:
            option = '--' + field.name.replace('_', '-')
            default = '' if field.default == '' else f' (default {field.default})'
            help_text = field.metadata['description'] + default
            kind = type(field.default)
            choices = field.metadata.get('choices')
            if kind is bool:
                parser.add_argument(
                    option, action='store_true', default=argparse.SUPPRESS, help=help_text
                )
                continue
            parser.add_argument(
                option, type=kind, default=argparse.SUPPRESS, choices=choices, help=help_text
            )


def config_from(
    arguments: argparse.Namespace, config: type[AnyConfig], base: AnyConfig | None = None
) -> AnyConfig:
    """Config from the command line; base: values of what is not given there; None: the defaults.

    Raises ConfigError if a value is out of range.
    """
    names = [field.name for field in fields(config)]
    given = {name: getattr(arguments, name) for name in names if hasattr(arguments, name)}
    return config(**given) if base is None else replace(base, **given)


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Add options for the laser pose, topics and frames of a log."""
    carmen = parser.add_argument_group('laser of a CARMEN log', 'Only --offset-m applies to bags.')
    add_config(carmen, LaserOptions)
    parser.add_argument(
        '--laser-pose',
        default='',
        metavar='X,Y,YAW',
        help='pose of the laser on the robot (m, m, rad), instead of that of the log',
    )
    add_config(parser, LaserConfig)
    parser.add_argument(
        '--scan-topic',
        default='',
        nargs='+',
        metavar='TOPIC',
        help='bag: topic of the scans, if there are several; those of several lasers',
    )
    parser.add_argument(
        '--odom-topic', default='', help='bag: topic of the odometry, if there are several'
    )
    parser.add_argument(
        '--odom-source',
        default='',
        choices=SOURCES,
        help='bag: odometry from its topic, from the transform of --odom-frame to --base-frame, or '
        'none: by scan matching alone (default: topic, or tf without one)',
    )
    parser.add_argument(
        '--base-frame',
        default='',
        help="bag: the robot's frame (default base_link, or that of the odometry where nothing "
        'names base_link)',
    )
    parser.add_argument(
        '--odom-frame', default='', help='bag: frame of the odometry (default that of the bag)'
    )


def open_log(
    path: Path, arguments: argparse.Namespace, parameters: NodeParameters = _NO_PARAMETERS
) -> Log:
    """Return a log, with the options of `add_log_options`.

    A laser pose that is given comes before that of the log. parameters: of the node localizer, for
    what is not among the arguments.
    """

    def text(name: str) -> str:
        return str(parameters.value('localizer', name, ''))

    given = arguments.laser_pose
    if not given and not hasattr(arguments, 'offset_m'):
        given = text('laser_pose')
    offset = getattr(arguments, 'offset_m', None)
    T_base_laser = None if offset is None else np.array([offset, 0.0, 0.0])
    return reading.open_log(
        path,
        config_from(arguments, LaserOptions),
        arguments.scan_topic,
        arguments.odom_topic,
        parse_pose(given) if given else T_base_laser,
        arguments.base_frame or text('base_frame'),
        odometry_source=arguments.odom_source or text('odom_source'),
        odom_frame=arguments.odom_frame or text('odom_frame'),
        laser_config=config_from(
            arguments, LaserConfig, parameters.config('localizer', LaserConfig())
        ),
    )
