"""What a verb is, how its arguments are read, and how it fails."""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn

SPIN_TIME_S = 5.0


class ShimError(Exception):
    """What went wrong, in one line; ends the program with exit code 1."""


class Parser(ArgumentParser):
    """Reader of arguments that says in one line what is wrong with them."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f'{self.prog}: error: {message} (help: {self.prog} -h)\n')


@dataclass(frozen=True)
class Verb:
    """One line of help, the arguments, and what is done with them."""

    help: str
    arguments: Callable[[ArgumentParser], None]
    main: Callable[[Namespace], None]


def say(text: str = '', end: str = '\n') -> None:
    """Print at once: who reads a pipe must not wait for a full buffer."""
    print(text, end=end, flush=True)


def add_graph_arguments(parser: ArgumentParser) -> None:
    """Options of every verb that looks at the graph."""
    parser.add_argument(
        '--spin-time',
        type=positive_float,
        default=SPIN_TIME_S,
        metavar='SECONDS',
        help='how long to look for what is named (default: %(default)s)',
    )
    parser.add_argument(
        '--no-daemon', action='store_true', help='there is none: for commands of the real ros2'
    )


def positive_float(text: str) -> float:
    """Read a number above zero."""
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise ValueError(text)
    return value


def positive_int(text: str) -> int:
    """Read a whole number above zero."""
    value = int(text)
    if value <= 0:
        raise ValueError(text)
    return value
