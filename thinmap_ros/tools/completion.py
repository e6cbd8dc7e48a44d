"""Completion of command lines with Tab, in a shell in which argcomplete is registered."""

import argparse
import os
import sys
from collections.abc import Iterable

_ASKED = '_ARGCOMPLETE'
# What argcomplete is to take for the name of the program: the subcommand, the second word.
_SUBCOMMAND = '2'


def is_asked() -> bool:
    """Whether this process is to complete a command line instead of running it."""
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
