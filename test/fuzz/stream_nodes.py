"""Streams of messages through the nodes themselves and the core behind them, in this process."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from rclpy.clock import ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan

from fuzz.cases import Source, chosen, finite, nothing, tried
from fuzz.strange_messages import numbers
from fuzz.streams import START_NS, STEP_NS, Stream
from thinmap_ros import kernels
from thinmap_ros.core.odometry import OdometryIncrements
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.nodes.grid_mapper import GridMapperNode
from thinmap_ros.nodes.localizer import LocalizerNode
from thinmap_ros.nodes.navigator import NavigatorNode
from thinmap_ros.nodes.topology_builder import TopologyBuilderNode
from thinmap_ros.ros import messages

_DOMAIN = '101'
_GOAL_M = (6.0, 3.0)
_LAST_S = 4.0  # of the undisturbed part: answers to these messages are expected
_PARAMETERS = ('use_sim_time:=true', 'laser_pose:=0,0,0', 'strict_parameters:=false')


def _raise(step: str, error: Exception) -> None:
    raise error


class NodeInProcess:
    """A node whose callbacks are called as an executor would, without a middleware between.

    Its messages are kept with their topics; numbers in them must be finite.
    """

    def __init__(self, make: Callable[[], Any], parameters: tuple[str, ...] = ()) -> None:
        words = [word for text in (*_PARAMETERS, *parameters) for word in ('-p', text)]
        # Nobody else is on the graph.
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
        os.environ['ROS_DOMAIN_ID'] = _DOMAIN
        rclpy.init(
            args=['--ros-args', '--log-level', 'fatal', *words],
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node = make()
        self.node.step_failed = _raise  # a node reports what nobody expects, and continues
        self.node.start()
        self.published: list[tuple[str, int, Any]] = []
        self._numbers: dict[str, int] = {}
        self._subscriptions = {
            subscription.topic_name: subscription for subscription in self.node.subscriptions
        }
        for publisher in self.node.publishers:
            if publisher.topic_name not in ('/diagnostics', '/rosout', '/parameter_events'):
                self._listen(publisher)

    def _listen(self, publisher: Any) -> None:
        publish = publisher.publish
        topic = publisher.topic_name.lstrip('/')

        def checked(message: Any) -> None:
            if not isinstance(message, LaserScan):  # ranges may be infinite (REP 117)
                finite(list(numbers(message)))
            stamped = hasattr(message, 'header')
            ns = messages.stamp_ns(message.header.stamp) if stamped else -1
            self.published.append((topic, ns, message if topic == 'cmd_vel' else None))
            publish(message)

        publisher.publish = checked

    def send(self, topic: str, message: Any) -> None:
        """Let the node receive a message of a topic, if it subscribes to it."""
        subscription = self._subscriptions.get(topic if topic[0] == '/' else f'/{topic}')
        if subscription is None:
            return
        self._numbers[topic] = self._numbers.get(topic, 0) + 1
        if subscription._callback_type is Subscription.CallbackType.WithMessageInfo:
            number = self._numbers[topic]
            info = {'publication_sequence_number': number, 'received_timestamp': time.time_ns()}
            subscription.callback(message, info)
        else:
            subscription.callback(message)

    def set_time(self, ns: int) -> None:
        """Set the clock, and let the timers of this time act."""
        self.send('/clock', Clock(clock=messages.time_msg(ns)))
        for timer in self.node.timers:
            is_due = timer.clock.clock_type == ClockType.ROS_TIME
            if is_due and ns % timer.timer_period_ns < STEP_NS:
                timer.callback()

    def diagnose(self) -> None:
        """Let the timers of the machine's time act: diagnostics."""
        for timer in self.node.timers:
            if timer.clock.clock_type != ClockType.ROS_TIME:
                timer.callback()

    def close(self) -> None:
        """End the node."""
        self.node.close()
        self.node.destroy_node()
        rclpy.shutdown()


def _through(
    node: NodeInProcess,
    stream: Stream,
    rng: np.random.Generator,
    work: Callable[[], None] = lambda: None,
) -> list[int]:
    """Send a stream; returns the stamps of its last scans, which are good.

    work: is called every second.
    """
    good: list[int] = []
    shift_ns = 0
    for sent in stream.messages():
        if rng.random() < 0.005:
            # The clock of the machine is set.
            shift_ns = int(float(chosen(rng, (-20.0, -2.0, -0.5, 0.5, 5.0, 1e4))) * SECOND_NS)
        shift_ns = 0 if sent.is_good else shift_ns
        node.set_time(max(sent.time_ns + shift_ns, 0))
        node.send(sent.topic, sent.message)
        if sent.time_ns % SECOND_NS < STEP_NS and sent.topic == 'odom':
            node.diagnose()
            work()
        if sent.topic == 'scan' and sent.is_good:
            good.append(sent.time_ns)
    # The last scan may still wait for later odometry.
    return [ns for ns in good if ns > good[-1] - _LAST_S * SECOND_NS][:-1]


def _node_case(
    make: Callable[[], Any],
    topics: tuple[str, ...],
    answers: str,
    parameters: tuple[str, ...] = (),
) -> Callable[[Any, np.random.Generator, Path], None]:
    """After the fault, the messages of a topic answer each scan by its stamp."""

    def run(shared: None, rng: np.random.Generator, folder: Path) -> None:
        stream = Stream(rng, ('scan', *topics))
        (folder / 'stream.txt').write_text(stream.description)
        os.environ['THINMAP_STATE_DIR'] = str(folder / 'state')
        node = NodeInProcess(make, parameters)
        try:
            expected = _through(node, stream, rng)
            given = {ns for topic, ns, _ in node.published if topic == answers}
            missing = [ns for ns in expected if ns not in given]
            what = f'no {answers} for {len(missing)} of {len(expected)} scans after the fault'
            assert not missing, what
        finally:
            node.close()

    return run


class _Goals:
    """A client that sends the same goal whenever there is none."""

    def __init__(self, node: Any) -> None:
        self._client = ActionClient(node, NavigateToPose, 'navigate_to_pose')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._ended: Any = None

    def step(self) -> None:
        """Send the goal if the last one has ended."""
        for _ in range(5):
            self._executor.spin_once(timeout_sec=0.0)
        if self._ended is None or self._ended.done():
            self._send()

    def _send(self) -> None:
        goal = NavigateToPose.Goal()
        goal.pose = messages.pose_stamped_msg(np.array([*_GOAL_M, 0.0]), 'map', 0)
        self._until(self._client.server_is_ready)
        sent = self._client.send_goal_async(goal)
        self._until(sent.done)
        self._ended = sent.result().get_result_async()

    def _until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            self._executor.spin_once(timeout_sec=0.01)

    def close(self) -> None:
        self._executor.shutdown()


def drive_to_a_goal(shared: None, rng: np.random.Generator, folder: Path) -> None:
    """The navigator has a goal; after the fault it drives."""
    stream = Stream(rng)
    (folder / 'stream.txt').write_text(stream.description)
    node = NodeInProcess(NavigatorNode)
    goals = _Goals(node.node)
    try:
        node.set_time(START_NS)
        goals.step()
        expected = _through(node, stream, rng, goals.step)
        commands = [c for topic, _, c in node.published if topic == 'cmd_vel']
        last = commands[-2 * len(expected) :]
        assert any(command.linear.x or command.angular.z for command in last), 'it does not drive'
    finally:
        goals.close()
        node.close()


def pair_by_stamp(shared: None, rng: np.random.Generator, folder: Path) -> None:
    """Scans and odometry by their stamps: each scan is used, waits or is counted."""
    stream = Stream(rng, ('scan', 'odom'))
    (folder / 'stream.txt').write_text(stream.description)
    pairs = ScanOdometrySynchronizer()
    increments = OdometryIncrements()
    scans = 0
    used: list[int] = []
    good: list[int] = []
    for sent in stream.messages():
        ready = tried(lambda s=sent: _paired(pairs, s.topic, s.message))
        if ready is None:
            continue
        scans += sent.topic == 'scan'
        if sent.topic == 'scan' and sent.is_good:
            good.append(sent.time_ns)
        for scan, T_odom_base in ready:
            finite(T_odom_base)
            used.append(scan.stamp_ns)
            step = increments.add(scan, T_odom_base)
            finite(step.T_before_base, step.seconds, step.discontinuity_m)
        assert scans == len(used) + pairs.dropped + pairs.waiting
    last = [ns for ns in good if ns > good[-1] - _LAST_S * SECOND_NS][:-1]
    assert set(last) <= set(used), 'good scans are not used after the fault'


def _paired(pairs: ScanOdometrySynchronizer, topic: str, message: Any) -> list[Any]:
    stamp_ns = messages.stamp_ns(message.header.stamp)
    if topic == 'odom':
        return pairs.add_odometry(stamp_ns, messages.pose_from_msg(message.pose.pose))
    return pairs.add_scan(messages.scan_from_msg(message, np.zeros(3)))


def _loaded(*warm: Callable[[], None]) -> Callable[[Path], None]:
    """Loads the compiled kernels once, before the processes of the cases are forked."""

    def prepare(folder: Path) -> None:
        for each in warm:
            each()

    return prepare


_LOCALIZER = ('initial_x_m:=2.0', 'initial_y_m:=2.0', 'initial_yaw_rad:=0.3')

_localize = _node_case(LocalizerNode, ('odom',), 'pose', _LOCALIZER)
_map = _node_case(GridMapperNode, ('localized_scan',), 'local_grid')
_thin = _node_case(TopologyBuilderNode, ('local_grid',), 'local_topology')

SOURCES = (
    Source('stream_odometry', nothing, pair_by_stamp),
    Source('stream_localizer', _loaded(kernels.localizer), _localize),
    Source('stream_mapper', _loaded(kernels.grid_mapper), _map),
    Source('stream_topology', _loaded(kernels.topology_builder), _thin),
    Source('stream_navigator', _loaded(kernels.navigator), drive_to_a_goal),
)
