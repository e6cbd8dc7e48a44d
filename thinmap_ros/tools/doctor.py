"""Looks at a running robot: topics, types, rates, frames and clocks, and what to do about them.

Ends with 1 if something is wrong.
"""

import argparse
import sys

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, require_ros

_QUESTION = (
    'The robot turns in place, by up to 2 rad, also without a stop by this program. '
    'Is there room all around it, and a hand at its emergency stop? yes: '
)


def _work(arguments: argparse.Namespace) -> None:
    if not arguments.seconds > 0.0:
        raise InputError(f'--seconds {arguments.seconds:g}: expected more than 0')
    if arguments.try_watchdog:
        _confirm(arguments.yes)
    require_ros()
    # Only now: the help needs no ROS.
    from thinmap_ros.ros.robot_check import RobotNames, check_robot, table, try_watchdog

    names = RobotNames(
        tuple(arguments.scan_topic),
        arguments.odom_topic,
        arguments.base_frame,
        arguments.odom_frame,
        arguments.map_frame,
    )
    if arguments.try_watchdog:
        findings = [try_watchdog(names.odom_topic, names.base_frame)]
    else:
        findings = check_robot(names, arguments.seconds).findings
    print('\n'.join(table(findings)))
    wrong = sum(not finding.is_good for finding in findings)
    print(f'{wrong} of {len(findings)} are wrong' if wrong else 'all is there')
    sys.exit(1 if wrong else 0)


def _confirm(is_confirmed: bool) -> None:
    """Ask whether the robot may move. Raises InputError unless the answer is yes."""
    if is_confirmed:
        return
    if not sys.stdin.isatty():
        raise InputError('--try-watchdog moves the robot: expected --yes, or a terminal to ask at')
    print(_QUESTION, end='', flush=True)
    answer = sys.stdin.readline().strip()
    if answer != 'yes':
        raise InputError(f'answer {quoted(answer)}: expected yes: the robot is not moved')


def main() -> None:
    """Run the program."""
    parser = Parser('doctor', __doc__)
    parser.add_argument(
        '--seconds', type=float, default=5.0, help='how long it listens (default 5)'
    )
    parser.add_argument(
        '--try-watchdog',
        action='store_true',
        help='instead, turn the robot slowly, end the commands without a stop, and look whether it '
        'stands within 2 s; asks first',
    )
    parser.add_argument('--yes', action='store_true', help='do not ask')
    parser.add_argument(
        '--scan-topic', nargs='+', default=['scan'], help='of each laser (default scan)'
    )
    for name, default in (
        ('odom-topic', 'odom'),
        ('base-frame', 'base_link'),
        ('odom-frame', 'odom'),
        ('map-frame', 'map'),
    ):
        parser.add_argument(f'--{name}', default=default, help=f'(default {default})')
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
