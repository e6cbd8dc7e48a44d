"""Nodes at work, a simulated robot at 5 Hz in real time: processor, memory, delay, traffic.

In a shell of scripts/env.

One process with all nodes against a process for each. Delays are those that a listener sees, from
scan to answer.
"""

import math
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.node_processes import NODES, Processes, placed_at, processor_s, use_own_domain
from benchmarks.rows import Row, at_most

_START = np.array([5.0, 2.0, 0.0])
_SETTLE_S = 5.0


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for one process and for many, then the traffic by topic."""
    use_own_domain()
    seconds = 20.0 if quick else 120.0
    with tempfile.TemporaryDirectory() as folder:
        for what, names, limits in (
            ('one process', ('thinmap',), (40.0, 400.0)),
            ('one process per node', NODES, (None, None)),
        ):
            yield from _measured(what, names, seconds, Path(folder), limits)
        yield from _traffic(Path(folder) / 'bag')


def _measured(
    what: str,
    names: tuple[str, ...],
    seconds: float,
    folder: Path,
    limits: tuple[float | None, float | None],
) -> Iterator[Row]:
    processes = Processes(folder)
    for name in names:
        placed = placed_at(_START) if name in ('localizer', 'thinmap') else {}
        processes.start(name, {'use_sim_time': 'true', **placed})
    nodes = list(processes.running.values())
    place = ','.join(map(str, _START.tolist()))
    processes.start('sim', {'start': place, 'wait_for_subscribers': 4})
    if not (folder / 'bag').exists():
        processes.start('recorder', {'use_sim_time': 'true', 'bag': folder / 'bag'})
    delays = _Listener()
    try:
        while 'local_topology' not in delays.heard:
            delays.listen(0.5)
        delays.listen(_SETTLE_S)
        delays.heard.clear()
        before = processor_s(nodes)
        delays.listen(seconds)
        share = 100.0 * (processor_s(nodes) - before) / seconds
        memory = sum(node.memory_full_info().pss for node in nodes) / 1e6
    finally:
        delays.node.destroy_node()
        processes.close()
    yield Row(what, f'{len(delays.of("pose"))} scans')
    for name, value, limit, unit in (
        ('CPU load', share, limits[0], '%'),
        ('memory', memory, limits[1], 'MB'),
    ):
        if limit is None:
            yield Row(f'  {name}', f'{value:.3g} {unit}')
        else:
            yield at_most(f'  {name}', value, limit, unit)
    for topic, limit in (('pose', 20.0), ('local_topology', 50.0)):
        yield at_most(
            f'  latency from scan to {topic}, 99th percentile',
            float(np.percentile(delays.of(topic), 99.0)),
            limit,
            'ms',
        )


class _Listener:
    """Hears scans and what comes of them; drives the robot in a circle.

    heard: by topic and stamp (ns), when (monotonic, s).
    """

    def __init__(self) -> None:
        import rclpy
        from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
        from sensor_msgs.msg import LaserScan

        from thinmap_msgs.msg import TopologicalMap
        from thinmap_ros.ros import messages, qos

        if not rclpy.ok():
            rclpy.init()
        self._rclpy = rclpy
        self._command = messages.twist_msg(0.15, 0.15)
        self.node = rclpy.create_node('listener')
        self._cmd_vel = self.node.create_publisher(Twist, 'cmd_vel', qos.STREAM)
        self.heard: dict[str, dict[int, float]] = {}
        kinds = {
            'scan': LaserScan,
            'pose': PoseWithCovarianceStamped,
            'local_topology': TopologicalMap,
        }
        for topic, kind in kinds.items():
            self.node.create_subscription(
                kind, topic, self._hears(topic, messages.stamp_ns), qos.STREAM
            )

    def _hears(self, topic, stamp_ns):  # type: ignore[no-untyped-def]
        def hear(message) -> None:  # type: ignore[no-untyped-def]
            self.heard.setdefault(topic, {})[stamp_ns(message.header.stamp)] = time.monotonic()

        return hear

    def listen(self, seconds: float) -> None:
        """Listen for so long."""
        end = time.monotonic() + seconds
        commanded = 0.0
        while time.monotonic() < end:
            self._rclpy.spin_once(self.node, timeout_sec=0.02)
            if time.monotonic() - commanded > 0.1:
                commanded = time.monotonic()
                self._cmd_vel.publish(self._command)

    def of(self, topic: str) -> list[float]:
        """Milliseconds from each scan to the message of its stamp."""
        scans = self.heard.get('scan', {})
        answers = self.heard.get(topic, {})
        found = [1e3 * (answers[ns] - at) for ns, at in scans.items() if ns in answers]
        return found or [math.inf]


def _traffic(bag: Path) -> Iterator[Row]:
    from thinmap_ros.logs.readers.bag import Bag

    sizes: dict[str, list[int]] = {}
    first = None
    last = 0
    for message in Bag(bag).messages():
        sizes.setdefault(message.topic, []).append(len(message.data))
        first = message.log_ns if first is None else first
        last = message.log_ns
    seconds = max((last - (first or 0)) / 1e9, 1.0)
    yield Row('traffic', f'{seconds:.0f} s')
    for topic, found in sorted(sizes.items(), key=lambda item: -sum(item[1])):
        rate = len(found) / seconds
        size = sum(found) / len(found) / 1e3
        yield Row(f'  {topic}: {rate:.1f} Hz, {size:.2f} kB per message', f'{rate * size:.1f} kB/s')
