"""`ros2 run` and `ros2 pkg`: programs and folders of packages, as in the real command."""

import os
from argparse import ArgumentParser, Namespace
from pathlib import Path

from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
    get_packages_with_prefixes,
)

from ros2_shim.verbs import Parser, ShimError, Verb, say


def prefix(package: str) -> Path:
    """Install prefix of a package."""
    try:
        return Path(get_package_prefix(package))
    except (PackageNotFoundError, ValueError):
        raise ShimError(f"Package '{package}' not found: ros2 pkg list names all") from None


def programs(package: str) -> list[Path]:
    """Executable files in PREFIX/lib/PACKAGE."""
    folder = prefix(package) / 'lib' / package
    return sorted(p for p in folder.glob('*') if p.is_file() and os.access(p, os.X_OK))


def run(words: list[str]) -> None:
    """Replace this process by the program; returns only after showing help."""
    if not words or words[0].startswith('-') or len(words) < 2:
        parser = Parser(prog='ros2 run', description='Run a program of a package.')
        parser.add_argument('package')
        parser.add_argument('program')
        parser.add_argument(
            'arguments', nargs='*', default=[], help='passed to the program unchanged'
        )
        parser.parse_args(words)
    package = words[0]
    program = words[1]
    for path in programs(package):
        if path.name == program:
            os.execv(path, [str(path), *words[2:]])
    names = ', '.join(path.name for path in programs(package))
    raise ShimError(f'No executable found: {package} has no {program}; it has {names or "none"}')


def _executables_arguments(parser: ArgumentParser) -> None:
    parser.add_argument('package_name', nargs='?')
    parser.add_argument('--full-path', action='store_true', help='show full paths')


def _executables(args: Namespace) -> None:
    names = [args.package_name] if args.package_name else sorted(get_packages_with_prefixes())
    for package in names:
        for path in programs(package):
            say(str(path) if args.full_path else f'{package} {path.name}')


def _prefix_arguments(parser: ArgumentParser) -> None:
    parser.add_argument('package_name')
    parser.add_argument('--share', action='store_true', help='its share folder instead')


def _prefix(args: Namespace) -> None:
    folder = prefix(args.package_name)
    say(get_package_share_directory(args.package_name) if args.share else str(folder))


def _nothing(parser: ArgumentParser) -> None:
    pass


def _list(args: Namespace) -> None:
    for package in sorted(get_packages_with_prefixes()):
        say(package)


VERBS = {
    'executables': Verb('Programs of a package, or of all.', _executables_arguments, _executables),
    'list': Verb('Names of all packages.', _nothing, _list),
    'prefix': Verb('Install prefix of a package.', _prefix_arguments, _prefix),
}
