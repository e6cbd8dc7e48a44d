"""Nodes as processes on a ROS graph of their own, and what a subscriber receives of them."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter

import psutil

from thinmap_ros.evaluation.ros_domains import use_free_domain

_STOP_S = 10.0
_DRIVE_PERIOD_S = 0.1


def use_own_domain() -> None:
    """Let nobody else be on the graph."""
    use_free_domain()
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


def start(words: list[str], parameters: str) -> psutil.Popen:
    """Start a node, its parameters given as name:=value and separated by spaces."""
    arguments = [word for parameter in parameters.split() for word in ('-p', parameter)]
    command = [
        sys.executable,
        '-m',
        f'thinmap_ros.nodes.{words[0]}',
        *words[1:],
        '--ros-args',
        *arguments,
    ]
    return psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def stop(*processes: psutil.Popen) -> None:
    """Stop nodes; those that do not end are killed."""
    for process in processes:
        process.send_signal(signal.SIGTERM)
    for process in psutil.wait_procs(processes, timeout=_STOP_S)[1]:
        process.kill()


def processor_s(process: psutil.Process) -> float:
    """CPU time of a process, s."""
    times = process.cpu_times()
    return float(times.user + times.system)


class TrafficListener:
    """Counts the bytes of each topic that follows from a map; drives the robot in a circle.

    bytes: received of each topic since `forget`.
    """

    def __init__(self, command: tuple[float, float] | None) -> None:
        """command: speeds of the robot, m/s and rad/s; None: it is not driven."""
        import rclpy
        from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
        from map_msgs.msg import OccupancyGridUpdate
        from nav_msgs.msg import OccupancyGrid

        from thinmap_msgs.msg import LocalGrid, ProbabilityGrid, RegionArray, TopologicalMap
        from thinmap_ros.ros import messages, qos

        if not rclpy.ok():
            rclpy.init()
        self._rclpy = rclpy
        self._node = rclpy.create_node('listener')
        self._command = None if command is None else messages.twist_msg(*command)
        self._cmd_vel = self._node.create_publisher(Twist, 'cmd_vel', qos.STREAM)
        self.bytes: Counter[str] = Counter()
        kinds = {
            'map': (OccupancyGrid, qos.LATCHED),
            'map_updates': (OccupancyGridUpdate, qos.STREAM),
            'grid': (ProbabilityGrid, qos.LATCHED),
            'local_grid': (LocalGrid, qos.LATCHED),
            'topology': (TopologicalMap, qos.LATCHED),
            'local_topology': (TopologicalMap, qos.LATCHED),
            'regions': (RegionArray, qos.LATCHED),
            'pose': (PoseWithCovarianceStamped, qos.STREAM),
        }
        for topic, (kind, quality) in kinds.items():
            self._node.create_subscription(kind, topic, self._counts(topic), quality, raw=True)

    def _counts(self, topic):  # type: ignore[no-untyped-def]
        def count(message: bytes) -> None:
            self.bytes[topic] += len(message)

        return count

    def listen(self, seconds: float) -> None:
        """Listen for a time."""
        end = time.monotonic() + seconds
        commanded = 0.0
        while time.monotonic() < end:
            self._rclpy.spin_once(self._node, timeout_sec=0.02)
            is_due = time.monotonic() - commanded > _DRIVE_PERIOD_S
            if is_due and self._command is not None:
                commanded = time.monotonic()
                self._cmd_vel.publish(self._command)

    def listen_until(self, topic: str) -> None:
        """Listen until a topic has a message."""
        while topic not in self.bytes:
            self.listen(0.5)

    def forget(self) -> None:
        """Forget what was received so far."""
        self.bytes.clear()

    def close(self) -> None:
        """Listen no more."""
        self._node.destroy_node()
