"""The parser of a program's command line, and kinds of arguments that several programs have."""

import argparse
import os
import re
import sys
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn

from thinmap_ros.core.errors import InputError
from thinmap_ros.tools import completion

BAD_INPUT = 2
_UNKNOWN = 'unrecognized arguments: '


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
        if completion.is_asked():
            completion.complete(self)
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
        known = sorted(self._option_string_actions)
        unknown = message.removeprefix(_UNKNOWN).split()
        likely = [match for word in unknown for match in get_close_matches(word, known, n=1)]
        return f' (did you mean {", ".join(likely)}?)' if likely else ''


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
