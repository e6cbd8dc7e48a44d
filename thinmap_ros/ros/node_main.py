"""The process of one node or several: command line, start, spin and end."""

import gc
import inspect
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, MutableMapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NoReturn

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.timer import Timer

from thinmap_ros.core.errors import InputError, ThinmapError, one_line, one_line_reason, quoted
from thinmap_ros.files.package_data import config_file
from thinmap_ros.kernels import compiler_memory_releaser, release_compiler_pages, report_compilation
from thinmap_ros.ros import parameters
from thinmap_ros.ros.executor import NodeExecutor
from thinmap_ros.ros.foreign import (
    given_files,
    given_values,
    is_for,
    no_section,
    ros_arguments,
    split_arguments,
)
from thinmap_ros.ros.private_rclpy import RCLError, UnknownROSArgsError
from thinmap_ros.ros.time_jumps import shared_clocks

_RULES = {
    '-p': 'NAME:=VALUE',
    '--param': 'NAME:=VALUE',
    '-r': 'FROM:=TO',
    '--remap': 'FROM:=TO',
}
_SET = ':='


def init_ros(words: Sequence[str]) -> None:
    """Initialize ROS with the arguments after --ros-args.

    Raises InputError with the argument that is wrong, and what was expected.
    """
    _check_arguments(words)
    # Of the others ROS would take name:=value for a remapping.
    _, arguments = split_arguments(words)
    # Its own line on wrong arguments would come before ours.
    set_logger_level('rcl', LoggingSeverity.FATAL)
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (RCLError, UnknownROSArgsError) as error:
        is_unknown = isinstance(error, UnknownROSArgsError)
        reason = re.sub(r'^failed to initialize rcl: |, at /\S+:\d+', '', str(error))
        text = f'{"unknown: " if is_unknown else ""}{one_line(reason)}'
        raise InputError(f'arguments after --ros-args: {text}') from error
    finally:
        set_logger_level('rcl', LoggingSeverity.UNSET)


def _check_arguments(words: Sequence[str]) -> None:
    """Check rules and parameter files after --ros-args, before ROS parses them."""
    for flag, word in ros_arguments(words):
        if flag in _RULES and _SET not in word:
            meant = f' (did you mean {word.replace("=", _SET, 1)}?)' if '=' in word else ''
            raise InputError(f'{flag} {quoted(word)}{meant}: expected {_RULES[flag]}')
        if flag in _RULES and word.endswith(_SET):
            raise InputError(f'{flag} {quoted(word)}: no value: expected {_RULES[flag]}')
    for file in given_files(words):
        if not file.is_file():
            raise InputError(f'--params-file {quoted(str(file))}: no such file')
    for _ in given_values(words):
        pass  # raises for a file or a value that cannot be read


def refusal(word: str) -> str:
    """What is wrong with a word that is for no node, and not for ROS either."""
    rules = ' or '.join(f'--ros-args {flag} {word}' for flag in ('-p', '-r'))
    return f'{quoted(word)}: expected {rules if _SET in word else "arguments after --ros-args"}'


def warn_of_unused(nodes: Sequence[Node], words: Sequence[str]) -> None:
    """Warn of parameter files, and of rules for one node, that are for none of these nodes."""
    programs = {node.get_name(): getattr(node, 'program', node.get_name()) for node in nodes}
    logger = nodes[0].get_logger()
    for file in given_files(words):
        if warning := no_section(file, programs):
            logger.warning(warning)
    names = [node.get_fully_qualified_name() for node in nodes]
    for flag, word in ros_arguments(words):
        section, _, name = word.partition(_SET)[0].rpartition(':')
        if flag in ('-p', '--param') and section and not any(is_for(section, n) for n in names):
            logger.warning(f'{flag} {word}: not taken: no node {section}: expected -p {name}:=...')


def show_help(node: Any) -> bool:
    """Whether the command line asks for help, which is printed then.

    node: class of the node; its parameters are in a file that is named.
    """
    if not {'-h', '--help'} & set(split_arguments(sys.argv)[0]):
        return False
    name = Path(inspect.getfile(node)).stem
    print(f'usage: ros2 run thinmap_ros {name} [--ros-args -p NAME:=VALUE -r FROM:=TO ...]\n')
    print(inspect.getdoc(node))
    print(f'\nParameters, with their defaults and what they do: {config_file(name)}')
    return True


_SECURITY = 'ROS_SECURITY_ENABLE'
_KEYSTORE = 'ROS_SECURITY_KEYSTORE'
_STRATEGY = 'ROS_SECURITY_STRATEGY'
_PERMISSIVE = 'Permissive'
_LOOK_PERIOD_S = 1.0  # between two looks at what no event tells
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(eq=False)
class _Running:
    """Nodes of a process, and what has ended them.

    failures: errors in the order in which they occurred.
    """

    nodes: list[Node]
    is_stopped: bool = False
    failures: list[BaseException] = field(default_factory=list)
    _closed: list[Node] = field(default_factory=list)
    # A signal may interrupt a thread that puts or gets: events and conditions would block then.
    _stops: SimpleQueue[None] = field(default_factory=SimpleQueue)

    def stop(self) -> None:
        """End all nodes; from any thread, or on a signal."""
        self.is_stopped = True
        self._stops.put(None)

    def wait(self, seconds: float) -> None:
        """Wait until the nodes are to end, at most for some seconds."""
        with suppress(Empty):
            self._stops.get(timeout=seconds)

    def close(self, node: Node) -> None:
        """Call `end()` and `close()` of a node, once; others are closed whatever error this has."""
        if node in self._closed:
            return
        self._closed.append(node)
        try:
            getattr(node, 'end', lambda: None)()
            getattr(node, 'close', lambda: None)()
        except Exception as error:
            node.get_logger().error(f'error at the end: {one_line_reason(error)}')
            self.failures.append(error)


def run(make_node: Callable[[], Node]) -> None:
    """Create a node and spin it until SIGINT or SIGTERM.

    The process ends with 0, or with 2 where the start fails with a ThinmapError.

    A node may have a method `start()`, called after its creation, and methods `end()` and
    `close()`, called once, last, whatever ended the node.
    """
    if show_help(make_node):
        return
    for word in split_arguments(sys.argv)[0]:
        _fail(refusal(word))
    run_all([make_node])


def program(make_node: Callable[[], Node]) -> Callable[[], None]:
    """The program that runs a node."""
    return partial(run, make_node)


def run_all(make_nodes: Sequence[Callable[[], Node]]) -> None:
    """Create several nodes and spin them in one process, each in a thread of its own.

    The first that ends, ends all. A parameter that is given to all needs to be known to one.
    """
    _init()
    _on_signals(_leave)
    compilation = report_compilation()
    nodes: list[Node] = []
    running = _Running(nodes)
    try:
        with parameters.shared_process(len(make_nodes)):
            nodes.extend(_made(make) for make in make_nodes)
        warn_of_unused(nodes, sys.argv)
        for node in nodes:
            parameters.freeze_clock(node)
            getattr(node, 'start', lambda: None)()
        compilation.end()
        release_compiler_pages()
        # Objects of the start stay. With them, a full collection takes longer than a scan.
        gc.freeze()
        _spin(running)
    except ExternalShutdownException:
        pass
    except ThinmapError as error:
        _fail(str(error))
    finally:
        _on_signals(signal.SIG_IGN)  # a second signal must not interrupt the end, which is short
        for node in reversed(nodes):
            running.close(node)
            node.destroy_node()
        rclpy.try_shutdown()


def _init() -> None:
    """Parse the arguments after --ros-args; ends with 2 and an error line where they are wrong."""
    try:
        enforce_security(os.environ)
        init_ros(sys.argv)
    except InputError as error:
        _fail(str(error))


def enforce_security(environment: MutableMapping[str, str]) -> None:
    """Set the strategy of SROS 2 to Enforce where it is on, unless it is Permissive by that word.

    ROS takes any other word, or none, for Permissive, and then starts nodes without keys, without a
    message: who misspells it would believe the graph to be protected.

    Raises InputError where no keystore is named.
    """
    if environment.get(_SECURITY) != 'true' or environment.get(_STRATEGY) == _PERMISSIVE:
        return
    if not environment.get(_KEYSTORE):
        raise InputError(
            f'{_SECURITY}=true, and {_KEYSTORE} is not set: expected the folder of the keys '
            f'(ros2 security create_keystore), or {_STRATEGY}={_PERMISSIVE} to start unprotected'
        )
    environment[_STRATEGY] = 'Enforce'


def _security_advice(reason: str) -> str:
    """What to do about an RMW without security, after its error; '' for any other."""
    if 'security libraries' not in reason:
        return ''
    return f': the Python wheels of ROS have no SROS 2: source a ROS 2 Jazzy, or unset {_SECURITY}'


def _fail(text: str) -> NoReturn:
    print(f'error: {text}', file=sys.stderr)
    sys.exit(2)


def _made(make_node: Callable[[], Node]) -> Node:
    """A node. Raises InputError where ROS creates none, as without security for its keys."""
    try:
        with warnings.catch_warnings():
            # Of a node that was not created: it says no more than the error.
            warnings.filterwarnings('ignore', message='Failed to fini', category=RuntimeWarning)
            return make_node()
    except RCLError as error:
        reason = one_line_reason(error)
        raise InputError(f'{reason}{_security_advice(reason)}') from error


def _spin(running: _Running) -> None:
    """Spin each node in a thread; this one, the main thread, waits, as it handles the signals."""
    # Only recorded: an exception raised in compiled code is replaced by another one, or lost.
    _on_signals(lambda number, frame: running.stop())
    spun = [*running.nodes, *shared_clocks(running.nodes)]
    executors = [NodeExecutor(each) for each in spun]
    threads = [
        threading.Thread(target=_spin_one, args=(each, executor, running))
        for each, executor in zip(spun, executors, strict=True)
    ]
    for thread in threads:
        thread.start()
    release = compiler_memory_releaser()
    try:
        while not running.is_stopped:
            running.wait(_LOOK_PERIOD_S)
            release()
    finally:
        running.stop()
        for executor in executors:
            executor.wake()
        for thread in threads:
            thread.join()
        # The garbage collector may end its parts first; then it ends with a traceback.
        for executor in executors:
            executor.shutdown()
    if running.failures:
        raise running.failures[0]


def _spin_one(node: Node, executor: NodeExecutor, running: _Running) -> None:
    try:
        while rclpy.ok() and not running.is_stopped and not getattr(node, 'finished', False):
            _spin_once(executor, node)
    except Exception as error:  # raised by the main thread
        running.failures.append(error)
    finally:
        running.stop()
        running.close(node)  # now: a robot that drives does not wait for the other nodes


def _spin_once(executor: NodeExecutor, node: Node) -> None:
    """Run a callback. What it raises ends the node, unless it has a `step_failed` to report it."""
    # A bounded wait: a node may be finished by another thread.
    ready = executor.next_callback(_LOOK_PERIOD_S)
    if ready is None:
        return
    try:
        ready.call()
    except Exception as error:
        report = getattr(node, 'step_failed', None)
        if report is None or not rclpy.ok():
            raise
        names = (getattr(ready.entity, name, '') for name in ('topic_name', 'srv_name'))
        report(next(filter(None, names), 'a callback'), error)
    finally:
        if not isinstance(ready.entity, Timer):
            getattr(node, 'touch', lambda: None)()


def _on_signals(handler: Any) -> None:
    for number in _SIGNALS:
        signal.signal(number, handler)


def _leave(number: int, frame: object) -> None:
    """End at once: a node that does not spin yet has nothing to finish."""
    os._exit(0)
