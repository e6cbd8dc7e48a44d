"""The end of a fork: all that a program does at its end, but not the release of each module.

The interpreter would take apart some thousand modules that the fork only shares, which takes half a
second, and most programs of the tests take less.

Imported first: what is registered for the end later is called earlier.
"""

import atexit
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_codes: list[int] = []


@contextmanager
def of_this_process() -> Iterator[None]:
    """Run the program of this process; what fails otherwise than by an exit code is not changed."""
    try:
        yield
    except SystemExit as end:
        if not isinstance(end.code, int | None):
            raise
        _codes.append(end.code or 0)
    else:
        _codes.append(0)


@atexit.register
def _leave() -> None:
    """End the process, once its threads have ended and all else has been called."""
    if _codes:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_codes[0])
