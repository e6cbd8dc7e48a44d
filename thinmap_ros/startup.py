"""What a program needs before its modules are imported; importing this module does it."""

import os
import signal
import sys
import warnings
from typing import TextIO

_PACKAGE = __name__.partition('.')[0]


def _program() -> str:
    """Name of the program of this package that this process runs; empty for any other process."""
    words = sys.orig_argv
    module = words[words.index('-m') + 1] if '-m' in words[:-1] else ''
    if module == _PACKAGE or module.startswith(f'{_PACKAGE}.'):
        return 'thinmap' if module == _PACKAGE else module.rpartition('.')[2]
    folder, name = os.path.split(sys.argv[0] if sys.argv else '')
    return name if name == 'thinmap' or os.path.basename(folder) == _PACKAGE else ''  # noqa: PTH119


def _end_on_interrupt(program: str) -> None:
    """End with 130 and one line on Ctrl-C while a program imports its modules.

    Programs and nodes set their own handlers when they begin to work.
    """

    def end(number: int, frame: object) -> None:
        os.write(2, f'{program}: interrupted\n'.encode())
        os._exit(130)

    # Where the shell has chosen to ignore it, as for jobs in the background, it stays ignored.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)


def print_warnings(program: str) -> None:
    """Have warnings for the user printed as one line each, without the place in the code."""
    show = warnings.showwarning

    def show_line(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if category is UserWarning:
            print(f'{program}: warning: {message}', file=sys.stderr)
        else:
            show(message, category, filename, lineno, file, line)

    warnings.showwarning = show_line


# Matrices here are small: sharing one among threads costs more than it saves, ten times in the
# filter, and sums in another order on every number of cores, so that the same log gives other last
# digits. It counts if NumPy comes later.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
if _program():
    _end_on_interrupt(_program())
    print_warnings(_program())
