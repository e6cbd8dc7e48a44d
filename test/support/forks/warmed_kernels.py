"""The kernels of a node's fork: those of the warm-ups that it calls, as in a process of a user."""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from numba.core.dispatcher import Dispatcher

from thinmap_ros import jit, kernels
from thinmap_ros.kernels import CompilationReport

# Begins the line on a kernel that a node compiles or loads in operation: its warm-up lacks it.
LATE = 'late kernel: '
_NODES = 'thinmap_ros.nodes.'

# A kernel, and its code for the types of some arguments.
_Loaded = list[tuple[Dispatcher, Any]]
_add_overload = Dispatcher.add_overload
_end = CompilationReport.end


class WarmedKernels:
    """The kernels of each warm-up; a process that begins has all."""

    def __init__(self) -> None:
        self._loaded = {rehearse.__name__: _loaded_by(rehearse) for rehearse in kernels.ALL}
        for loaded in self._loaded.values():
            _add(loaded)

    def forget(self, module: str) -> None:
        """Forget all in the process of a node, whose warm-ups load their own without rehearsal.

        Other programs keep them.
        """
        if module.startswith(_NODES):
            _forget_all()
            for name, loaded in self._loaded.items():
                setattr(kernels, name, partial(_add, loaded))
            _report_late_kernels()


def _loaded_by(rehearse: Callable[[], None]) -> _Loaded:
    """What a warm-up loads or compiles if it is the first."""
    _forget_all()
    for other in kernels.ALL:
        other.cache_clear()
    loaded: _Loaded = []

    def add(kernel: Dispatcher, compiled: Any) -> None:
        loaded.append((kernel, compiled))
        _add_overload(kernel, compiled)

    Dispatcher.add_overload = add
    try:
        rehearse()
    finally:
        Dispatcher.add_overload = _add_overload
    return loaded


def _forget_all() -> None:
    for kernel in jit.KERNELS:
        kernel._reset_overloads()


def _add(loaded: _Loaded) -> None:
    for kernel, compiled in loaded:
        if tuple(compiled.signature.args) not in kernel.overloads:
            _add_overload(kernel, compiled)


def _report_late_kernels() -> None:
    """Write a line on each kernel that comes after the start of the nodes."""

    def add(kernel: Dispatcher, compiled: Any) -> None:
        if kernel in jit.KERNELS:
            types = ', '.join(map(str, compiled.signature.args))
            print(f'{LATE}{kernel.__module__}.{kernel.__qualname__}({types})', file=sys.stderr)
        _add_overload(kernel, compiled)

    def end(report: CompilationReport) -> None:
        _end(report)
        Dispatcher.add_overload = add

    CompilationReport.end = end
