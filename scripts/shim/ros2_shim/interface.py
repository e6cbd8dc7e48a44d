"""`ros2 interface show`: the fields of a type, those of the types in it indented."""

import re
from argparse import ArgumentParser, Namespace
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

from ros2_shim.verbs import ShimError, Verb, say

_FIELD = re.compile(r'\s*(?P<type>[A-Za-z][\w/]*)(?:\[[^\]]*\])?\s+\w+')
_BASIC = re.compile(r'(bool|byte|char|float(32|64)|u?int(8|16|32|64)|w?string)$')


def _definition(name: str) -> list[str]:
    """Lines of the definition of a type."""
    parts = name.split('/')
    if len(parts) == 3 and all(parts) and '..' not in parts:
        try:
            share = Path(get_package_share_directory(parts[0]))
            return (share / parts[1] / f'{parts[2]}.{parts[1]}').read_text().splitlines()
        except (PackageNotFoundError, ValueError, OSError):
            pass
    raise ShimError(
        f"Unknown interface: '{name}', expected PACKAGE/msg/NAME, PACKAGE/srv/NAME or "
        'PACKAGE/action/NAME of an installed package'
    )


def lines(name: str, depth: int = 0) -> list[str]:
    """Lines of a type, and below each field of another type the indented lines of that type."""
    package = name.split('/')[0]
    shown = []
    for line in _definition(name):
        bare = line.split('#')[0].rstrip()
        if depth and not bare:
            continue
        shown.append('\t' * depth + (bare if depth else line))
        match = _FIELD.match(bare)
        if match and not _BASIC.match(match['type']):
            parts = match['type'].split('/')
            full = [package, 'msg', *parts] if len(parts) == 1 else [parts[0], 'msg', parts[-1]]
            shown += lines('/'.join(full), depth + 1)
    return shown


def _show_arguments(parser: ArgumentParser) -> None:
    parser.add_argument('type', help='as in sensor_msgs/msg/LaserScan')


def _show(args: Namespace) -> None:
    say('\n'.join(lines(args.type)))


VERBS = {'show': Verb('Fields of a message, service or action.', _show_arguments, _show)}
