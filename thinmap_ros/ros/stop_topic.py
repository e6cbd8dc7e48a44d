"""The stop of a robot: it stands while any publisher of a latched std_msgs/Bool says true."""

import math
from collections.abc import Callable, Collection, Mapping

import numpy as np
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool, String

from thinmap_msgs.srv import ReleaseStop
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.snapshot import Field, State, require, validate
from thinmap_ros.ros import qos
from thinmap_ros.ros.checkpoint import Checkpoint
from thinmap_ros.ros.diagnostics import WARN, full_name
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.private_rclpy import GID_SIZE, subscribe_with_gid
from thinmap_ros.ros.services import offer

TOPIC = 'stop'
_RELEASE = 'stop/release'
_UNKNOWN = 'a node'  # that is not discovered yet
# A reader keeps so many messages of all publishers together: with 1, the last one replaces all.
_DEPTH = 100
_SUBSCRIPTIONS = (
    QoSProfile(
        depth=_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    ),
    # Also of those that do not latch what they say.
    QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT),
)
_FIELDS = {'gids': Field(np.uint8, ('n', GID_SIZE)), 'names': Field(np.uint8, ('size',))}


class StopSources:
    """Publishers that say that the robot has to stand: their full node names by their GIDs.

    A publisher that is gone without having said false remains until it is released.
    """

    def __init__(self) -> None:
        self.names: dict[bytes, str] = {}
        # Number and stamp of the last message of each publisher.
        self._sent: dict[bytes, tuple[int, int]] = {}

    def add(self, gid: bytes, sent: tuple[int, int], is_stopped: bool, name: str) -> bool:
        """Add what a publisher says in a message; returns whether that is news.

        sent: number and stamp (ns) of the message by the publisher. One from before the last one,
        which comes late by another subscription, does not count.
        """
        last = self._sent.get(gid, sent)
        if sent[0] < last[0] and sent[1] <= last[1]:
            return False
        self._sent[gid] = sent
        if is_stopped == (gid in self.names):
            return False
        if is_stopped:
            self.names[gid] = name
        else:
            del self.names[gid]
        return True

    def follow(self, alive: Mapping[bytes, str]) -> None:
        """Forget the last messages of publishers that are gone, and name others: all by their GIDs.

        A node may be discovered after its publisher.
        """
        self._sent = {gid: last for gid, last in self._sent.items() if gid in alive}
        self.names = {gid: alive.get(gid, name) for gid, name in self.names.items()}

    def release(self, name: str, alive: Collection[bytes]) -> list[str]:
        """Remove the sources of a node that are not alive; '': of all. Returns their names."""
        gone = [g for g, own in self.names.items() if g not in alive and name in ('', own)]
        return [self.names.pop(gid) for gid in gone]

    def end(self, gids: Collection[bytes]) -> bool:
        """Remove sources; returns whether there were any."""
        ended = [gid for gid in gids if self.names.pop(gid, None) is not None]
        return bool(ended)

    def state(self) -> State:
        """The sources, to be restored."""
        gids = np.frombuffer(b''.join(self.names), np.uint8).reshape(-1, GID_SIZE)
        return {'gids': gids, 'names': np.frombuffer('\n'.join(self.names.values()).encode(), 'u1')}

    def restore(self, state: State) -> None:
        """Set the sources of a state. Raises InputError."""
        arrays = validate(state, _FIELDS, 'stop')
        names = arrays['names'].tobytes().decode(errors='replace').split('\n')
        gids = [row.tobytes() for row in arrays['gids']]
        require(len(names) == len(gids), f'stop: {len(names)} names', f'{len(gids)}')
        self.names = dict(zip(gids, names, strict=True))


class StopTopic:
    """Follows the topic `stop` whatever the node does, and says true or false on it itself.

    The sources are saved at each change, in one file for all nodes of a robot on this machine, and
    restored at the start. The service ~/release_stop releases those that are gone, for all nodes.
    """

    def __init__(self, node: ThinmapNode, on_change: Callable[['StopTopic'], None]) -> None:
        """on_change: called when the reason changes; also here, where a stop was kept."""
        self._node = node
        self._on_change = on_change
        self._name = node.get_fully_qualified_name()
        self._topic = node.resolve_topic_name(TOPIC)
        self._sources = StopSources()
        self.reason = ''  # why the robot has to stand; '': it need not
        self._file = Checkpoint(node, math.inf, ending='.stop', owner=self._topic)
        self._publisher: Publisher | None = None
        self._is_protective = False
        self._releases = node.create_publisher(String, _RELEASE, qos.STREAM)
        node.create_subscription(String, _RELEASE, self._on_release, qos.STREAM)
        offer(node.create_service, ReleaseStop, '~/release_stop', self._on_request)
        node.diagnostics.expect_topic(TOPIC)
        node.diagnostics.add_update_callback(self._refresh)
        node.diagnostics.add_check(WARN, lambda: self.reason if '(gone' in self.reason else '')
        self._restore()
        for profile in _SUBSCRIPTIONS:
            subscribe_with_gid(node, TOPIC, self._on_message, profile)

    @property
    def others(self) -> str:
        """Names of the sources but this node as it runs; '' for none."""
        alive = self._alive()
        names = {name for gid, name in self._sources.names.items() if alive.get(gid) != self._name}
        return ', '.join(sorted(names))

    def prepare(self) -> None:
        """Create the publisher: nodes have discovered it before it says anything."""
        if self._publisher is None:
            self._publisher = self._node.create_publisher(Bool, TOPIC, qos.LATCHED)

    def publish(self, is_stopped: bool) -> None:
        """Be a source of the stop, or no longer; from any thread after `prepare`."""
        self.prepare()
        assert self._publisher is not None
        self._publisher.publish(Bool(data=is_stopped))

    def hold(self) -> None:
        """Begin a protective stop: ~/release_stop ends it."""
        self._is_protective = True
        self.publish(True)

    def release(self, name: str) -> list[str]:
        """Release the sources of a node that are gone, '' of all; returns their names."""
        released = self._sources.release(name, self._alive())
        self._releases.publish(String(data=name))
        if released:
            self._changed()
        return released

    def _on_message(self, is_stopped: bool, gid: bytes, sent: tuple[int, int]) -> None:
        self._node.diagnostics.message_received(TOPIC)
        name = self._alive().get(gid, _UNKNOWN)
        if self._sources.add(gid, sent, is_stopped, name):
            self._changed()

    def _on_release(self, message: String) -> None:
        if self._sources.release(message.data, self._alive()):
            self._changed()

    def _on_request(self, request: ReleaseStop.Request) -> str:
        name = request.source
        released = self.release(name)
        if self._is_protective and name in ('', self._name):
            self._is_protective = False
            self.publish(False)
            self._end_own()
            released.append(self._name)
        still = f'still stopped by {self.others}' if self.others else ''
        if not released:
            raise InputError(
                f'source {quoted(name)}: expected one that set {self._topic} to true and is gone'
                + (f': {still}' if still else '')
            )
        return f'released: {", ".join(released)}' + (f'; {still}' if still else '')

    def _end_own(self) -> None:
        """End the stop of this node at once: a goal may come before its own message does."""
        alive = self._alive()
        if self._sources.end({gid for gid, name in alive.items() if name == self._name}):
            self._changed()

    def _restore(self) -> None:
        saved = self._file.load()
        if saved is None:
            return
        try:
            self._sources.restore(saved)
        except InputError as error:
            self._node.get_logger().warning(f'{error}: starting without a kept stop')
            return
        self.reason = self._text()
        self._node.get_logger().warning(self.reason)
        self._on_change(self)

    def _changed(self) -> None:
        if self._sources.names:
            self._file.save(self._sources.state())
        else:
            self._file.delete()
        self.reason = self._text()
        self._on_change(self)

    def _refresh(self) -> None:
        """Say which sources are gone: once a second."""
        self._sources.follow(self._alive())
        if self._text() != self.reason:
            self._changed()

    def _alive(self) -> dict[bytes, str]:
        """Full node names of the publishers by their GIDs."""
        infos = self._node.get_publishers_info_by_topic(self._topic)
        return {bytes(info.endpoint_gid): full_name(info) for info in infos}

    def _text(self) -> str:
        """Why the robot has to stand; '' if it need not."""
        if not self._sources.names:
            return ''
        alive = self._alive()
        names = [
            name if gid in alive else f'{name} (gone: see ~/release_stop)'
            for gid, name in self._sources.names.items()
        ]
        return f'the robot is stopped: {self._topic}: {", ".join(sorted(names))}'
