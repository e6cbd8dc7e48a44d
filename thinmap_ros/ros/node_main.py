"""How a process of one node or several starts, spins and ends."""

import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from thinmap_ros.core.errors import ThinmapError, one_line_reason
from thinmap_ros.kernels.memory import release_compiler_memory, release_compiler_pages
from thinmap_ros.kernels.progress import report_compilation
from thinmap_ros.ros import parameters

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def run(make_node: Callable[[], Node]) -> None:
    """Make a node and spin it until SIGINT or SIGTERM.

    The process ends with 0, or 2 on a refused start.

    A node may have a method `start()`, called once it is made, and a method `close()`: it is called
    last, whatever ended the node.
    """
    run_all([make_node])


def run_all(make_nodes: Sequence[Callable[[], Node]]) -> None:
    """Make several nodes and spin them in one process, each in a thread of its own.

    The first to end ends all.

    Parameters that are given to all of them need to be known to one of them.
    """
    _init()
    _on_signals(_leave)
    compilation = report_compilation()
    nodes: list[Node] = []
    try:
        with parameters.shared_by(len(make_nodes)):
            nodes.extend(make() for make in make_nodes)
        for node in nodes:
            getattr(node, 'start', lambda: None)()
        compilation.end()
        release_compiler_pages()
        # What the start has made stays. With it, a full collection takes longer than any scan.
        gc.freeze()
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


def _init() -> None:
    """Take the arguments after --ros-args; ends with 2 and a line where they are wrong."""
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except rclpy_implementation.RCLError as error:
        print(f'error: arguments after --ros-args: {one_line_reason(error)}', file=sys.stderr)
        sys.exit(2)


def _spin(nodes: list[Node]) -> None:
    asked = threading.Event()
    # Only noted: an exception raised just anywhere comes out of compiled code as another error, or
    # gets lost in it.
    _on_signals(lambda number, frame: asked.set())
    failures: list[BaseException] = []
    others = [
        threading.Thread(target=_spin_one, args=(node, asked, failures)) for node in nodes[1:]
    ]
    for thread in others:
        thread.start()
    try:
        _spin_one(nodes[0], asked, failures, release_compiler_memory())
    finally:
        asked.set()
        for thread in others:
            thread.join()
    if failures:
        raise failures[0]


def _spin_one(
    node: Node,
    asked: threading.Event,
    failures: list[BaseException],
    each_time: Callable[[], None] = lambda: None,
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


def _on_signals(handler: Any) -> None:
    for number in _SIGNALS:
        signal.signal(number, handler)


def _leave(number: int, frame: object) -> None:
    """End at once: a node that does not listen yet has nothing to finish."""
    os._exit(0)
