"""Runs a robot: looks whether all is there, maps, drives, tells how it is, and saves at the end.

All nodes run in this process until Ctrl-C. What follows --ros-args goes to the nodes.
"""

import argparse
import sys
from datetime import datetime
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from thinmap_ros.core.errors import InputError
from thinmap_ros.files.package_data import presets
from thinmap_ros.logs.transforms import parse_pose
from thinmap_ros.nodes.thinmap import BY_DEFAULT, node_factories
from thinmap_ros.ros.foreign import WILDCARDS, bare, given_values, split_arguments
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, require_ros

if TYPE_CHECKING:
    from thinmap_ros.ros.robot_check import RobotNames

_AUTOSAVE_S = 300.0
_ODOMETRY = {'topic': 'odom', 'tf': '', 'none': ''}  # topic by odom_source


def _work(arguments: argparse.Namespace, words: list[str]) -> None:
    """words: those of the command line from --ros-args on."""
    require_ros()
    # Only now: the help needs no ROS.
    from thinmap_ros.nodes.parts.progress import ProgressNode
    from thinmap_ros.ros import node_main

    session: Path = arguments.save or arguments.map or Path('maps') / _now()
    values = _parameters(arguments, session)
    rules = [word for name, value in values.items() for word in ('-p', f'{name}:={value}')]
    preset = ['--params-file', str(presets()[arguments.preset])] if arguments.preset else []
    # What the user gives comes last, and counts.
    for_nodes = ['--ros-args', *preset, *rules, *words[1:]]
    if arguments.seconds > 0.0 and _is_simulated(for_nodes, arguments.seconds):
        for_nodes[1:1] = ['-p', 'use_sim_time:=true']
    sys.argv = [sys.argv[0], *for_nodes]
    if arguments.web and find_spec('tornado') is None:
        raise InputError('--web: tornado is not installed: pip install tornado')
    names = [*BY_DEFAULT, *(['web'] if arguments.web else [])]
    names += ['recorder'] if arguments.bag else []
    print(f'saved to {session} at the end (Ctrl-C) and every {_AUTOSAVE_S:.0f} s', file=sys.stderr)
    if arguments.web:
        print(f'page at http://127.0.0.1:{arguments.web_port}/', file=sys.stderr)
    node_main.run_all([*node_factories(names), ProgressNode])


def _now() -> str:
    return datetime.now().astimezone().strftime('%Y-%m-%d_%H-%M-%S')


def _parameters(arguments: argparse.Namespace, session: Path) -> dict[str, object]:
    """Parameters of the nodes by name. Raises InputError where the start is no pose."""
    values: dict[str, object] = {
        'save_on_exit': session.absolute(),
        'autosave_period_s': _AUTOSAVE_S,
    }
    if not session.absolute().is_relative_to(Path.cwd()):
        values['save_directory'] = session.absolute().parent
    if arguments.map:
        values['session_path'] = arguments.map.absolute()
    if arguments.start:
        if not arguments.map:
            raise InputError('--start: a pose in a map: expected --map')
        x, y, yaw = parse_pose(arguments.start).tolist()
        values |= {'initial_x_m': x, 'initial_y_m': y, 'initial_yaw_rad': yaw}
    if arguments.explore:
        values['autostart_exploration'] = 'true'
    if arguments.web:
        values['port'] = arguments.web_port
    if arguments.bag:
        values['bag'] = arguments.bag.absolute()
    return values


def _is_simulated(words: list[str], seconds: float) -> bool:
    """Look at the robot; returns whether it is in the time of /clock.

    Raises InputError, after what is wrong, where it lacks something.
    """
    from thinmap_ros.ros.robot_check import check_robot, table

    checkup = check_robot(_names(words), seconds, words)
    if checkup.wrong:
        print('\n'.join(table(checkup.wrong)), file=sys.stderr)
        raise InputError(
            f'{len(checkup.wrong)} of {len(checkup.findings)} checks of the robot are wrong: '
            'expected none, or --seconds 0 to start without them'
        )
    return checkup.is_simulated


def _names(words: list[str]) -> 'RobotNames':
    """Topics and frames as the localizer is given them."""
    from thinmap_ros.ros.robot_check import RobotNames

    given = {
        each.name: each.value
        for each in given_values(words)
        if bare(each.section) in (*WILDCARDS, 'localizer')
    }
    scan_topics = given.get('scan_topic', 'scan')
    names = ('base_frame', 'odom_frame', 'map_frame')
    frames = {name: str(given[name]) for name in names if name in given}
    return RobotNames(
        tuple(scan_topics) if isinstance(scan_topics, list) else (str(scan_topics),),
        _ODOMETRY.get(str(given.get('odom_source', 'topic')), 'odom'),
        is_mounted=bool(given.get('laser_pose')),
        **frames,
    )


def main() -> None:
    """Run the program."""
    own, words = split_arguments(sys.argv)
    sys.argv = [sys.argv[0], *own]
    parser = Parser('robot', __doc__)
    parser.add_argument('--preset', choices=presets(), help='parameters of a robot')
    parser.add_argument('--map', type=Path, metavar='SESSION', help='session to continue in')
    parser.add_argument(
        '--start', default='', metavar='X,Y,YAW', help='pose in it (m, m, rad), if it is known'
    )
    parser.add_argument('--explore', action='store_true', help='explore, from the first scan on')
    parser.add_argument('--web', action='store_true', help='with the page in the browser')
    parser.add_argument('--web-port', type=int, default=8480, help='of the page (default 8480)')
    parser.add_argument('--bag', type=Path, help='folder of a bag to record all topics in')
    parser.add_argument(
        '--save',
        type=Path,
        metavar='SESSION',
        help='session to save (default that of --map, or one below maps with the time as its name)',
    )
    parser.add_argument(
        '--seconds',
        type=float,
        default=5.0,
        help='how long it looks at the robot first; 0: not at all (default 5)',
    )
    cli.run(partial(_work, words=words), parser)


if __name__ == '__main__':
    main()
