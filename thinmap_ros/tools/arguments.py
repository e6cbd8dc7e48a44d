"""The parser of a program's command line, its completion, and arguments of several programs.

It loads no library but NumPy: help, and the next word at Tab, come at once.
"""

import argparse
import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

from thinmap_ros.core.errors import InputError, ThinmapError, did_you_mean

_ASKED = '_ARGCOMPLETE'
# What argcomplete is to take for the name of the program: the subcommand, the second word.
_SUBCOMMAND = '2'


def is_asked() -> bool:
    """Whether this process is to complete a command line (Tab) instead of running it."""
    return _ASKED in os.environ


def subcommand(names: Iterable[str]) -> str:
    """The subcommand in front of the word that is completed; ends if that is the subcommand."""
    before = os.environ['COMP_LINE'][: int(os.environ['COMP_POINT'])]
    words = f'{before}_'.split()
    if len(words) == 2:
        parser = argparse.ArgumentParser()
        parser.add_argument('subcommand', choices=list(names))
        complete(parser)
    os.environ[_ASKED] = _SUBCOMMAND
    return words[1]


def complete(parser: argparse.ArgumentParser) -> None:
    """Write what the parser expects next, and end."""
    try:
        import argcomplete
    except ImportError:
        sys.exit(1)
    argcomplete.autocomplete(parser)


BAD_INPUT = 2
_UNREAD = 141  # the exit code of a program that SIGPIPE has ended
_UNKNOWN = 'unrecognized arguments: '


@contextmanager
def while_read() -> Iterator[None]:
    """Print within it: once the reader of the output has ended (`| head`), the program ends."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # Python flushes at its end as well.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(_UNREAD)


class Parser(argparse.ArgumentParser):
    """Parses the command line of a program; what is wrong with it is one line.

    The program has the name by which the command `thinmap` calls it, if it does.
    """

    def __init__(self, program: str, description: str | None, **others: Any) -> None:
        is_called = sys.argv[0].startswith('thinmap ')
        name = sys.argv[0] if is_called else program
        super().__init__(prog=name, description=description, **others)
        # A list of numbers may begin with a minus sign, as in --laser-pose -0.1,0,0.
        self._negative_number_matcher = re.compile(r'-[\d.]')

    def error(self, message: str) -> NoReturn:
        """End with 2, after one line that names the option which was probably meant."""
        hint = self._meant(message) or f'; {self.prog} --help lists the arguments'
        self.exit(BAD_INPUT, f'{self.prog}: error: {" ".join(message.split())}{hint}\n')

    def parse_args(self, *given: Any, **others: Any) -> Any:
        """The arguments; an option that does not exist is reported before what is missing."""
        if is_asked():
            complete(self)
        words = sys.argv[1:] if not given or given[0] is None else given[0]
        for word in words:
            option = word.split('=')[0]
            if re.match(r'--\w', word) and not self._options_beginning_with(option):
                self.error(f'{_UNKNOWN}{option}')
        return super().parse_args(*given, **others)

    def _options_beginning_with(self, option: str) -> list[str]:
        return [known for known in self._option_string_actions if known.startswith(option)]

    def _meant(self, message: str) -> str:
        """The options that are most like those which do not exist."""
        if not message.startswith(_UNKNOWN):
            return ''
        words = message.removeprefix(_UNKNOWN).split()
        return ''.join(did_you_mean(word, self._option_string_actions) for word in words)


def add_out(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the option -o, --out, a folder; default: the text of the help, see `out_folder`."""
    parser.add_argument(
        '-o', '--out', type=Path, help=f'folder for the results (default {default})'
    )


def out_folder(given: Path | None, default: str) -> Path:
    """The folder for the results: the given one, or else this one below `out`; it need not exist.

    Raises InputError, before the work, where nothing can be written into it.
    """
    folder = given or Path('out') / default
    check_place(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f'{folder}: is a file: expected a folder for the results')
    return folder


def check_place(path: Path) -> None:
    """Check that a file or folder can be made at a path. Raises InputError where it cannot."""
    there = next(part for part in path.absolute().parents if part.exists())
    if not there.is_dir():
        raise InputError(f'{path}: {there} is a file: expected a folder')
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f'{path}: the folder {there} may not be written to')


def check_picture(path: Path | None) -> None:
    """Check that a PNG can be made at a path, if one is given. Raises InputError otherwise."""
    if path is not None:
        if path.suffix != '.png':
            raise InputError(f'{path}: expected a name that ends in .png')
        check_place(path)


_NEEDED = ('rclpy', 'thinmap_msgs')


def require_ros() -> None:
    """Do nothing where ROS 2 and thinmap's messages can be imported.

    Raises ThinmapError, naming what is missing, where they cannot.
    """
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        raise ThinmapError(
            f'needs ROS 2 Jazzy with thinmap_msgs, and Python finds no {" and no ".join(missing)}: '
            'source the setup file of the workspace in which thinmap_msgs is built'
        )
