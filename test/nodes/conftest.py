"""A live ROS graph for a test: node processes on a private domain, and a client beside them."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from thinmap_ros.adapters import qos

# Generous: a test waits for what it wants, and fails only where that never comes.
PATIENCE_S = 60.0
_DEPTH = 1000


class Graph:
    """Node processes, and a node of the test's own that listens and asks."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.folder, self.processes = folder, {}
        self._heard = 0
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
        **values: Any,
    ) -> subprocess.Popen[bytes]:
        """Start a node with arguments, ROS's remapping rules and its parameters.

        It is known by its label, or its name.
        """
        command = [sys.executable, '-m', f'thinmap_ros.nodes.{name}', *arguments, '--ros-args']
        name = label or name
        for rule in remap:
            command += ['-r', rule]
        for key, value in values.items():
            text = f"'{value}'" if isinstance(value, str) else str(value).lower()
            command += ['-p', f'{key}:={text}']
        log = (self.folder / f'{name}.log').open('wb')
        # Services save and load below the working directory.
        process = subprocess.Popen(
            command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True, cwd=self.folder
        )
        log.close()
        self.processes[name] = process
        return process

    def log(self, name: str) -> str:
        return (self.folder / f'{name}.log').read_text()

    def heard(self, topic: str, kind: type, profile: QoSProfile = qos.STREAM) -> list[Any]:
        """List that fills with all messages of a topic as the test spins, however rare that is."""
        messages: list[Any] = []
        deep = QoSProfile(
            depth=_DEPTH, reliability=profile.reliability, durability=profile.durability
        )

        def hear(message: Any) -> None:
            self._heard += 1
            messages.append(message)

        self.node.create_subscription(kind, topic, hear, deep)
        return messages

    def hear_out(self) -> None:
        """Hear what still waits, until it is quiet: those that have stopped send nothing later."""
        last_heard, quiet = self._heard, 0

        def is_quiet() -> bool:
            nonlocal last_heard, quiet
            quiet = quiet + 1 if self._heard == last_heard else 0
            last_heard = self._heard
            return quiet > 3

        self.until(is_quiet, 'quiet')

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

    def call(self, kind: type, name: str, request: Any) -> Any:
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready, f'service {name}')
        # A server that has just found its client may not be able to answer yet: asked again then.
        for _ in range(3):
            future, end = client.call_async(request), time.monotonic() + PATIENCE_S / 3.0
            self.until(
                lambda f=future, e=end: f.done() or time.monotonic() > e, f'answer of {name}'
            )
            if future.done():
                return future.result()
        pytest.fail(f'{name} answers nobody')

    def send_goal(self, client: ActionClient, goal: Any) -> Any:
        """Handle of a goal that was taken.

        A node that was killed passes for a server for a while: asked again then.
        """
        self.until(client.server_is_ready, 'action server')
        for _ in range(6):
            sent = self._ask(client, goal, 0.2 * PATIENCE_S)
            if sent.done():
                return sent.result()
        pytest.fail('goal taken by nobody')

    def _ask(self, client: ActionClient, goal: Any, seconds: float) -> Any:
        """Future of the handle of a goal, after it is done or the time is over."""
        sent, end = client.send_goal_async(goal), time.monotonic() + seconds
        self.until(lambda: sent.done() or time.monotonic() > end, 'goal taken')
        return sent

    def act(self, kind: type, name: str, goal: Any) -> Any:
        """Result of an action's goal, with status."""
        client = ActionClient(self.node, kind, name)
        ended = self.send_goal(client, goal).get_result_async()
        self.until(ended.done, f'{name} ends', 120.0)
        return ended.result()

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


@pytest.fixture
def graph(ros_domain: int, tmp_path: Path) -> Iterator[Graph]:
    live = Graph(ros_domain, tmp_path)
    yield live
    live.close()
