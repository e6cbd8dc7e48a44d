"""How a process of one node or several starts, spins and ends."""

import ctypes
import gc
import mmap
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from time import monotonic
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from thinmap_ros.adapters import parameters
from thinmap_ros.core.errors import ThinmapError

_RELEASE_S = 3.0
_RELEASE_BYTES = 4e6
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def run(make_node: Callable[[], Node]) -> None:
    """Make a node and spin it until SIGINT or SIGTERM; the process ends with 0, or 2 on a refused start.

    A node may have a method `start()`, called once it is made, and a method `close()`: it is called last, whatever
    ended the node.
    """
    run_all([make_node])


def run_all(make_nodes: Sequence[Callable[[], Node]]) -> None:
    """Make several nodes and spin them in one process, each in a thread of its own; the first to end ends all.

    Parameters that are given to all of them need to be known to one of them.
    """
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    _on_signals(_leave)
    nodes: list[Node] = []
    try:
        with parameters.shared_by(len(make_nodes)):
            nodes.extend(make() for make in make_nodes)
        for node in nodes:
            getattr(node, 'start', lambda: None)()
        release_compiler_pages()
        _spin(nodes)
    except ExternalShutdownException:
        pass
    except ThinmapError as error:
        print(f'error: {error}', file=sys.stderr)
        sys.exit(2)
    finally:
        _on_signals(signal.SIG_IGN)  # ending is short: a second signal must not cut it off
        for node in reversed(nodes):
            getattr(node, 'close', lambda: None)()
            node.destroy_node()
        rclpy.try_shutdown()


def _spin(nodes: list[Node]) -> None:
    asked = threading.Event()
    # Only noted: an exception raised just anywhere comes out of compiled code as another error, or gets lost in it.
    _on_signals(lambda number, frame: asked.set())
    failures: list[BaseException] = []
    others = [threading.Thread(target=_spin_one, args=(node, asked, failures)) for node in nodes[1:]]
    for thread in others:
        thread.start()
    try:
        _spin_one(nodes[0], asked, failures, _give_back_pages())
    finally:
        asked.set()
        for thread in others:
            thread.join()
    if failures:
        raise failures[0]


def _spin_one(
    node: Node, asked: threading.Event, failures: list[BaseException], each_time: Callable[[], None] = lambda: None
) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while rclpy.ok() and not asked.is_set() and not getattr(node, 'finished', False):
            # A bounded wait: Python sees signals only between calls.
            executor.spin_once(timeout_sec=0.25)
            each_time()
    except Exception as error:  # kept for the main thread, which says what it was
        failures.append(error)
    finally:
        asked.set()


def _give_back_pages() -> Callable[[], None]:
    """Kernels that only a real message calls for bring the compiler back: what gives its pages back, now and then."""
    looked_at, least = monotonic(), _shared_bytes()

    def look() -> None:
        nonlocal looked_at, least
        if monotonic() - looked_at > _RELEASE_S:
            if _shared_bytes() > least + _RELEASE_BYTES:
                release_compiler_pages()
                least = _shared_bytes()
            looked_at = monotonic()

    return look


def _on_signals(handler: Any) -> None:
    for number in _SIGNALS:
        signal.signal(number, handler)


def _leave(number: int, frame: object) -> None:
    """End at once: a node that does not listen yet has nothing to finish."""
    os._exit(0)


def _shared_bytes() -> int:
    """Memory that the process has from files, as libraries are; 0 where there is no /proc."""
    statm = Path('/proc/self/statm')
    return int(statm.read_text().split()[2]) * mmap.PAGESIZE if statm.exists() else 0


def release_compiler_pages() -> None:
    """Give back the memory pages of the kernels' compiler: its library, some 100 MB, is idle once they are loaded.

    Only mappings without a page of the process's own are dropped: the system reads them again from the library's
    file whenever they are needed. Where there is no /proc, nothing happens.
    """
    gc.collect()
    smaps = Path('/proc/self/smaps')
    if not smaps.exists():
        return
    libc = ctypes.CDLL(None)
    if hasattr(libc, 'malloc_trim'):
        libc.malloc_trim(0)
    for first, last in _clean_mappings(smaps.read_text(), 'llvmlite'):
        libc.madvise(ctypes.c_void_p(first), ctypes.c_size_t(last - first), mmap.MADV_DONTNEED)


def _clean_mappings(smaps: str, name: str) -> Iterator[tuple[int, int]]:
    """Address ranges of the mappings of a file of which no page was changed."""
    header = ''
    for line in smaps.splitlines():
        key = line.split(maxsplit=1)[0]
        if not key.endswith(':'):
            header = line
        elif key == 'Anonymous:' and name in header and int(line.split()[1]) == 0:
            first, last = header.split(maxsplit=1)[0].split('-')
            yield int(first, 16), int(last, 16)
