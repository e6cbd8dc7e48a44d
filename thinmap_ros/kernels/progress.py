"""Reports the compilation of kernels, which delays the first start of a program."""

import sys
import time
from functools import cache as cache_of_results
from typing import Any

from numba.core import event

from thinmap_ros import jit
from thinmap_ros.jit import cache

_COMPILATION = 'numba:compile'


class CompilationReport(event.Listener):
    """Reports on stderr how many kernels are compiled."""

    def __init__(self, period_s: float = 5.0) -> None:
        self._period_s = period_s
        self._depth = 0
        self._seconds = 0.0
        self._began_at = 0.0
        self._told_at = -period_s

    def on_start(self, event: Any) -> None:
        """Handle the start of a compilation, possibly nested in another one."""
        now = time.monotonic()
        if self._depth == 0:
            self._began_at = now
        self._depth += 1
        if now - self._told_at >= self._period_s:
            self._told_at = now
            # Kernels that are compiled for further types count once.
            there = sum(1 for kernel in jit.KERNELS if kernel.signatures)
            number = min(there + 1, len(jit.KERNELS))
            _tell(f'compiling kernels, once ({number} of {len(jit.KERNELS)})')

    def on_end(self, event: Any) -> None:
        """Handle the end of a compilation."""
        self._depth -= 1
        if self._depth == 0:
            self._seconds += time.monotonic() - self._began_at

    def end(self) -> None:
        """Report duration and cache folder, if any kernels were compiled."""
        if self._seconds:
            kept = cache.folder()
            where = f'cached in {kept}' if kept else 'not cached'
            _tell(f'kernels compiled in {self._seconds:.0f} s, {where}')
            self._seconds = 0.0


@cache_of_results
def report_compilation() -> CompilationReport:
    """Report compilation until the process ends; called again, it is the same report."""
    report = CompilationReport()
    event.register(_COMPILATION, report)
    return report


def _tell(what: str) -> None:
    print(f'thinmap: {what}', file=sys.stderr, flush=True)
