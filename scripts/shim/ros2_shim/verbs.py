"""Verbs, their arguments and their errors."""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn

SPIN_TIME_S = 5.0


class ShimError(Exception):
    """Error of one line; ends the program with exit code 1."""


class Parser(ArgumentParser):
    """Argument parser with errors of one line."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f'{self.prog}: error: {message} (help: {self.prog} -h)\n')


@dataclass(frozen=True)
class Verb:
    """Help text of one line, arguments, and the function that runs the verb."""

    help: str
    arguments: Callable[[ArgumentParser], None]
    main: Callable[[Namespace], None]


def say(text: str = '', end: str = '\n') -> None:
    """Print and flush: the reader of a pipe must not wait for a full buffer."""
    print(text, end=end, flush=True)


def add_graph_arguments(parser: ArgumentParser) -> None:
    """Add the options of verbs that query the graph."""
    parser.add_argument(
        '--spin-time',
        type=positive_float,
        default=SPIN_TIME_S,
        metavar='SECONDS',
        help='time limit of discovery (default: %(default)s)',
    )
    parser.add_argument(
        '--no-daemon', action='store_true', help='no effect: accepted for compatibility'
    )


def positive_float(text: str) -> float:
    """Parse a positive number."""
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise ValueError(text)
    return value


def positive_int(text: str) -> int:
    """Parse a positive integer."""
    value = int(text)
    if value <= 0:
        raise ValueError(text)
    return value
