"""A node that queries the ROS graph.

There is no daemon with a known graph: named entities are waited for, and lists are complete when
discovery has found nothing new for a while.
"""

import os
import time
from argparse import Namespace
from collections.abc import Callable
from typing import Any, Self

import rclpy
from rcl_interfaces.srv import GetParameters
from rclpy.exceptions import NameValidationException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.validate_full_topic_name import validate_full_topic_name

from ros2_shim.verb import SPIN_TIME_S, ShimError

# A spin is short, as Python handles Ctrl-C only after it.
_SPIN_S = 0.05
_LOOK_S = 1.0
# If no other node has been found yet.
_LOOK_LONGER_S = 2.5
_QUIET_S = 0.6
# Time for an unknown server to discover its client.
_MEET_S = 0.2


class Session:
    """A hidden node, as a context manager."""

    def __init__(self, args: Namespace) -> None:
        self._patience_s: float = getattr(args, 'spin_time', SPIN_TIME_S)
        self._name = f'_ros2cli_{os.getpid()}'
        self._begun = time.monotonic()
        self.node: Node

    def __enter__(self) -> Self:
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node(self._name, use_global_arguments=False, start_parameter_services=False)
        return self

    def __exit__(self, *_: object) -> None:
        self.node.destroy_node()
        rclpy.shutdown()

    def _spin(self) -> None:
        """Process one callback, or wait."""
        rclpy.spin_once(self.node, timeout_sec=_SPIN_S)

    def until(self, condition: Callable[[], Any], seconds: float | None = None) -> bool:
        """Spin until a condition holds, at most for some seconds; returns whether it holds."""
        end = None if seconds is None else time.monotonic() + seconds
        while not condition():
            if end is not None and time.monotonic() > end:
                return False
            self._spin()
        return True

    def found(self, condition: Callable[[], Any]) -> bool:
        """Wait until a condition holds, up to the time in the options; returns whether it holds."""
        return self.until(condition, self._patience_s)

    def settle(self) -> None:
        """Wait until nothing new has been found for a while."""
        known = self._snapshot()
        quiet_since = time.monotonic()
        while time.monotonic() < self._begun + self._patience_s:
            self._spin()
            now = time.monotonic()
            seen = self._snapshot()
            if seen != known:
                known = seen
                quiet_since = now
            look_s = _LOOK_S if self._nodes() else _LOOK_LONGER_S
            if now > self._begun + look_s and now > quiet_since + _QUIET_S:
                return

    def _snapshot(self) -> Any:
        node = self.node
        names = sorted(node.get_node_names_and_namespaces())
        topics = node.get_topic_names_and_types()
        ends = [(node.count_publishers(n), node.count_subscribers(n)) for n, _ in topics]
        return names, topics, ends, node.get_service_names_and_types()

    def full_name(self, name: str, kind: str = 'topic') -> str:
        """Name with its namespace; raises ShimError if it is invalid."""
        try:
            full = expand_topic_name(name, self.node.get_name(), self.node.get_namespace())
            validate_full_topic_name(full, is_service=kind == 'service')
        except (NameValidationException, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise ShimError(f"'{name}' is no name of a {kind}: {reason}") from None
        return str(full)

    def _nodes(self) -> dict[str, tuple[str, str]]:
        """Name and namespace of all nodes except this one, by full name."""
        pairs = self.node.get_node_names_and_namespaces()
        nodes = {f'{pair[1].rstrip("/")}/{pair[0]}': pair for pair in pairs}
        nodes.pop(f'/{self._name}', None)
        return nodes

    def find_node(self, name: str) -> str:
        """Full name of an existing node; raises ShimError if it is not found."""
        full = f'/{name.removeprefix("/")}'
        if not self.found(lambda: full in self._nodes()):
            raise ShimError(f"Node not found: '{full}'")
        return full

    def server_of(self, service: str) -> str | None:
        """Name of the node that offers a service."""
        for node, pair in self._nodes().items():
            try:
                pairs = self.node.get_service_names_and_types_by_node(*pair)
            except NodeNameNonExistentError:
                continue
            if service in dict(pairs):
                return node
        return None

    def introduce(self, node: str | None) -> None:
        """Wait until a node has discovered the clients created so far.

        A server that has not discovered its client yet processes the request, but its response is
        lost. Endpoints are discovered in the order of their creation: a node that responds to a
        later client has discovered the earlier ones. The request here may be repeated safely.
        """
        client = self.node.create_client(GetParameters, f'{node or ""}/get_parameters')
        if node is None or not self.until(client.service_is_ready, _LOOK_S):
            self.until(lambda: False, _MEET_S)
            return
        end = time.monotonic() + self._patience_s
        while time.monotonic() < end:
            answer = client.call_async(GetParameters.Request())
            if self.until(answer.done, _LOOK_S):
                return

    def ask(self, kind: Any, name: str, request: Any) -> Any:
        """Response of a service of an existing node."""
        client = self.node.create_client(kind, name)
        if not self.until(client.service_is_ready, self._patience_s):
            raise ShimError(f"Wait for service timed out: '{name}'")
        self.introduce(name.rpartition('/')[0])
        future = client.call_async(request)
        if not self.until(future.done, 2.0 * self._patience_s):
            raise ShimError(f"No answer from service '{name}'")
        return self.result(future)

    def result(self, future: Future) -> Any:
        """Wait for a future and return its result; an exception becomes a ShimError."""
        self.until(future.done)
        error = future.exception()
        if error is not None:
            raise ShimError(f'{type(error).__name__}: {error}')
        return future.result()
