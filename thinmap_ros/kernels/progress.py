"""Says that kernels are being compiled: the first start of a program would be silent for long."""

import sys
import time
from typing import Any

from numba.core import event

from thinmap_ros.core import jit, kernel_cache

_COMPILATION = 'numba:compile'
_PAUSE_S = 5.0


class CompilationReport(event.Listener):
    """Tells on stderr how many of a program's kernels are there, while some are compiled."""

    def __init__(self) -> None:
        self._depth = 0
        self._seconds = 0.0
        self._began_at = 0.0
        self._told_at = -_PAUSE_S

    def on_start(self, event: Any) -> None:
        """Take note that a kernel is compiled now, perhaps for the sake of another."""
        now = time.monotonic()
        if self._depth == 0:
            self._began_at = now
        self._depth += 1
        if now - self._told_at >= _PAUSE_S:
            self._told_at = now
            # Of a kernel that is compiled for other types it is one that is there.
            there = sum(1 for kernel in jit.KERNELS if kernel.signatures)
            number = min(there + 1, len(jit.KERNELS))
            _tell(f'compiling kernels, once ({number} of {len(jit.KERNELS)})')

    def on_end(self, event: Any) -> None:
        """Take note that it is there."""
        self._depth -= 1
        if self._depth == 0:
            self._seconds += time.monotonic() - self._began_at

    def end(self) -> None:
        """Say how long it took, and where the kernels are kept, if any were compiled."""
        if self._seconds:
            kept = kernel_cache.folder()
            where = f'kept in {kept}' if kept else 'kept nowhere'
            _tell(f'kernels compiled in {self._seconds:.0f} s, {where}')
            self._seconds = 0.0


def report_compilation() -> CompilationReport:
    """Report on compilation from now on, until the process ends."""
    report = CompilationReport()
    event.register(_COMPILATION, report)
    return report


def _tell(what: str) -> None:
    print(f'thinmap: {what}', file=sys.stderr, flush=True)
