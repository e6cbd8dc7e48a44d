"""A verb, its arguments and its errors."""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NoReturn

SPIN_TIME_S = 5.0


class ShimError(Exception):
    """Error of one line; ends the program with exit code 1."""


class Parser(ArgumentParser):
    """Argument parser with errors of one line."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f'{self.prog}: error: {message} (help: {self.prog} -h)\n')


@dataclass(frozen=True)
class Argument:
    """An argument as add_argument of argparse takes it."""

    name: str
    options: dict[str, Any]


@dataclass(frozen=True)
class Verb:
    """Help text of one line, the function that runs the verb, and its arguments."""

    help: str
    main: Callable[[Namespace], None]
    arguments: tuple[Argument, ...]

    def run(self, program: str, words: list[str]) -> None:
        """Run the verb with the words behind its name."""
        parser = Parser(prog=program, description=self.help, allow_abbrev=False)
        for argument in self.arguments:
            parser.add_argument(*argument.name.split(), **argument.options)
        self.main(parser.parse_args(words))


def argument(name: str, **options: Any) -> Argument:
    """An argument; of an option all names, as in `-f --feedback`."""
    return Argument(name, options)


def flag(name: str, text: str) -> Argument:
    """An option without a value, with its help text."""
    return Argument(name, {'action': 'store_true', 'help': text})


def positive_float(text: str) -> float:
    """Parse a positive number."""
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise ValueError(text)
    return value


SPIN_TIME = argument(
    '--spin-time',
    type=positive_float,
    default=SPIN_TIME_S,
    metavar='SECONDS',
    help='time limit of discovery (default: %(default)s)',
)


def say(text: str = '', end: str = '\n') -> None:
    """Print and flush: the reader of a pipe must not wait for a full buffer."""
    print(text, end=end, flush=True)
