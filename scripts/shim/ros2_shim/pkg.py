"""`ros2 run` and `ros2 pkg`: programs and folders of packages, as in the real command."""

import os
from argparse import REMAINDER, Namespace
from pathlib import Path

from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)

from ros2_shim.verb import ShimError, Verb, argument, flag, say


def _prefix(package: str) -> Path:
    try:
        return Path(get_package_prefix(package))
    except (PackageNotFoundError, ValueError):
        raise ShimError(f"Package '{package}' not found") from None


def _programs(package: str) -> dict[str, Path]:
    """Executable files in PREFIX/lib/PACKAGE by their names."""
    folder = _prefix(package) / 'lib' / package
    files = sorted(path for path in folder.glob('*') if path.is_file())
    return {path.name: path for path in files if os.access(path, os.X_OK)}


def _run(args: Namespace) -> None:
    """Replace this process by the program."""
    programs = _programs(args.package)
    path = programs.get(args.program)
    if path is None:
        names = ', '.join(programs) or 'none'
        missing = f'{args.package} has no {args.program}; it has {names}'
        raise ShimError(f'No executable found: {missing}')
    os.execv(path, [str(path), *args.arguments])


def _show_prefix(args: Namespace) -> None:
    folder = _prefix(args.package_name)
    say(get_package_share_directory(args.package_name) if args.share else str(folder))


RUN = Verb(
    'Run a program of a package.',
    _run,
    (
        argument('package'),
        argument('program'),
        argument('arguments', nargs=REMAINDER, help='passed to the program unchanged'),
    ),
)
VERBS = {
    'prefix': Verb(
        'Install prefix of a package.',
        _show_prefix,
        (argument('package_name'), flag('--share', 'its share folder instead')),
    ),
}
