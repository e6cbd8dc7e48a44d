"""A live ROS graph for a test: node processes on a private domain, and a client node."""

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from support.forks import forked
from support.forks.warmed_kernels import LATE
from support.timeouts import PATIENCE_S

from thinmap_msgs.msg import TopologicalMap
from thinmap_ros.ros import qos

_DEPTH = 1000
_ON_ITS_WAY_S = 0.2  # of a message that is published, but not received
# Time after which a response is taken to be lost.
_ASK_AGAIN_S = 20.0


class Graph:
    """Node processes, and the test's own node, with subscriptions and clients.

    forks: whether nodes share the memory of a server that has imported what they need.
    """

    def __init__(self, domain: int, folder: Path) -> None:
        self.folder = folder
        self.forks = True
        self.processes: dict[str, forked.Started] = {}
        self._clients: dict[str, Client] = {}
        self._pacemaker: Publisher | None = None
        self._published_ns = math.inf  # when what was heard last was published
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node('test_client', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def start(
        self,
        name: str,
        remap: tuple[str, ...] = (),
        arguments: tuple[str, ...] = (),
        label: str = '',
        package: str = 'thinmap_ros.nodes',
        **values: Any,
    ) -> forked.Started:
        """Start a node with arguments, ROS's remapping rules and its parameters.

        Its key is its label, or its name. package: of its module.
        """
        words = [*arguments, '--ros-args']
        for rule in remap:
            words += ['-r', rule]
        for parameter, value in values.items():
            text = f"'{value}'" if isinstance(value, str) else str(value).lower()
            words += ['-p', f'{parameter}:={text}']
        key = label or name
        with (self.folder / f'{key}.log').open('wb') as log:
            # Services save and load below the working directory only.
            module = f'{package}.{name}'
            fresh = not self.forks
            process = forked.start(module, words, self.folder, (log, log), fresh=fresh)
        self.processes[key] = process
        return process

    def log(self, name: str) -> str:
        return (self.folder / f'{name}.log').read_text()

    def heard(self, topic: str, kind: type, profile: QoSProfile = qos.STREAM) -> list[Any]:
        """List of all messages of a topic, filled while the test spins, even if it spins rarely."""
        messages: list[Any] = []
        deep = QoSProfile(
            depth=_DEPTH, reliability=profile.reliability, durability=profile.durability
        )

        def hear(message: Any, info: dict[str, int]) -> None:
            self._published_ns = info['source_timestamp']
            messages.append(message)

        self.node.create_subscription(kind, topic, hear, deep)
        return messages

    def paced(self, topic: str = 'local_topology', kind: type = TopologicalMap) -> tuple[str, ...]:
        """Remapping so that a simulation in lockstep with a topic waits for the test, too.

        Otherwise a test that receives poses late could drive the robot into a wall.
        """
        if self._pacemaker is None:
            heard_too = self.node.create_publisher(kind, 'heard_too', qos.STREAM)
            self.node.create_subscription(kind, topic, heard_too.publish, qos.STREAM)
            self._pacemaker = heard_too
        # With the topic pose, lockstep goes on with the status of a scan as well.
        own = ('slam_status:=unheard',) if topic == 'pose' else ()
        return (f'{topic}:=heard_too', *own)

    def drain(self) -> None:
        """Receive what has been published before: a stopped node publishes nothing later.

        Others may publish all the time.
        """
        began_ns = time.time_ns()
        rounds = 0  # since a message of before was heard
        end_s = 0.0

        def has_heard_all() -> bool:
            nonlocal rounds, end_s
            rounds += 1
            if self._published_ns <= began_ns or not end_s:
                rounds = 0
                end_s = time.monotonic() + _ON_ITS_WAY_S
            self._published_ns = math.inf
            # Each subscription with a message in its queue has its turn.
            turns = len(list(self.node.subscriptions))
            return rounds > turns and time.monotonic() > end_s

        self.until(has_heard_all, 'all that was published before')

    def until(self, condition: Callable[[], Any], what: str, seconds: float = PATIENCE_S) -> None:
        end = time.monotonic() + seconds
        while not condition():
            self.executor.spin_once(timeout_sec=0.05)
            for name, process in self.processes.items():
                if process.poll() not in (None, 0):
                    pytest.fail(f'{name} ended with {process.returncode}: {self.log(name)}')
            if time.monotonic() > end:
                logs = '\n'.join(f'{name}: {self.log(name)[-2000:]}' for name in self.processes)
                pytest.fail(f'never came: {what}\n{logs}')

    def client(self, kind: type, name: str) -> Client:
        """Client of a service, created once, because discovery takes a while.

        If it is created before the server, it is discovered when the server is ready.
        """
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        return self._clients[name]

    def call(self, kind: type, name: str, request: Any) -> Any:
        client = self.client(kind, name)
        self.until(client.service_is_ready, f'service {name}')
        # A server that has just discovered its client may not respond yet: ask again.
        return self._first(lambda: client.call_async(request), f'an answer of {name}')

    def send_goal(
        self, client: ActionClient, goal: Any, on_feedback: Callable[[Any], None] | None = None
    ) -> Any:
        """Handle of a goal, accepted or rejected.

        Sends it again if there is no answer: a killed node still counts as a server for a while,
        and a server that has just discovered its client may not respond yet.
        """
        self.until(client.server_is_ready, 'action server')
        return self._first(lambda: client.send_goal_async(goal, on_feedback), 'goal taken')

    def _first(self, ask: Callable[[], Any], what: str, again_s: float = _ASK_AGAIN_S) -> Any:
        """First response; asks again if there is none for a while."""
        asked: list[Any] = []
        asked_at = -math.inf

        def is_answered() -> bool:
            nonlocal asked_at
            if time.monotonic() - asked_at > again_s:
                asked_at = time.monotonic()
                asked.append(ask())
            return any(future.done() for future in asked)

        self.until(is_answered, what)
        return next(future for future in asked if future.done()).result()

    def act(self, kind: type, name: str, goal: Any) -> Any:
        """Result of an action's goal, with status."""
        client = ActionClient(self.node, kind, name)
        return self.result(self.send_goal(client, goal), name)

    def result(self, handle: Any, what: str, again_s: float = _ASK_AGAIN_S) -> Any:
        """Result of an accepted goal, with status; asks again, as a response may be lost."""
        return self._first(handle.get_result_async, f'{what} ends', again_s)

    def cancel(self, handle: Any, again_s: float = _ASK_AGAIN_S) -> Any:
        """Answer to a cancel of an accepted goal; asks again, as it may be lost."""
        return self._first(handle.cancel_goal_async, 'an answer to the cancel', again_s)

    def ended(self, process: forked.Started) -> int:
        """Exit code of a node that ends by itself."""
        return process.wait(timeout=PATIENCE_S)

    def stop(self, name: str, number: int = signal.SIGINT) -> int:
        """Exit code of a node after a signal."""
        process = self.processes.pop(name)
        process.send_signal(number)
        return process.wait(timeout=PATIENCE_S)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
        for process in self.processes.values():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def late_kernels(self) -> list[str]:
        """Kernels that nodes compiled or loaded after their start: their warm-ups lack them."""
        logs = [file.read_text(errors='replace') for file in self.folder.glob('*.log')]
        return sorted({line for log in logs for line in log.splitlines() if LATE in line})


@pytest.fixture
def graph(ros_domain: int, tmp_path: Path) -> Iterator[Graph]:
    live = Graph(ros_domain, tmp_path)
    yield live
    live.close()
    late = live.late_kernels()
    assert not late, '\n'.join(['extend the warm-ups of the nodes by:', *late])
