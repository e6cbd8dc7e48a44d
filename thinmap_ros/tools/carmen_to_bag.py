"""A CARMEN log becomes a bag: scan, odom, tf and tf_static."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.adapters.bag_writer import BagWriter
from thinmap_ros.adapters.carmen import CarmenLog, LaserOptions
from thinmap_ros.adapters.events import Event, OdometryEvent
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.tools import cli

_SECOND_NS = 1_000_000_000


class _Messages:
    """Message objects for a bag, made without ROS."""

    def __init__(self, types: dict[str, Any]) -> None:
        self._types = types

    def _make(self, name: str, **fields: Any) -> Any:
        return self._types[name](**fields)

    def header(self, frame_id: str, ns: int) -> Any:
        stamp = self._make('builtin_interfaces/msg/Time', sec=ns // _SECOND_NS, nanosec=ns % _SECOND_NS)
        return self._make('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)

    def _rotation(self, yaw: float) -> Any:
        half = yaw / 2.0
        return self._make('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=float(np.sin(half)), w=float(np.cos(half)))

    def _vector(self, kind: str, x: float = 0.0, y: float = 0.0) -> Any:
        return self._make(f'geometry_msgs/msg/{kind}', x=float(x), y=float(y), z=0.0)

    def odometry(self, ns: int, T: Array) -> Any:
        pose = self._make(
            'geometry_msgs/msg/Pose', position=self._vector('Point', T[0], T[1]), orientation=self._rotation(T[2])
        )
        twist = self._make(
            'geometry_msgs/msg/Twist', linear=self._vector('Vector3'), angular=self._vector('Vector3')
        )
        none = np.zeros(36)
        return self._make(
            'nav_msgs/msg/Odometry',
            header=self.header('odom', ns),
            child_frame_id='base_link',
            pose=self._make('geometry_msgs/msg/PoseWithCovariance', pose=pose, covariance=none),
            twist=self._make('geometry_msgs/msg/TwistWithCovariance', twist=twist, covariance=none),
        )

    def transform(self, ns: int, frames: tuple[str, str], T: Array) -> Any:
        transform = self._make(
            'geometry_msgs/msg/Transform',
            translation=self._vector('Vector3', T[0], T[1]),
            rotation=self._rotation(T[2]),
        )
        stamped = self._make(
            'geometry_msgs/msg/TransformStamped',
            header=self.header(frames[0], ns),
            child_frame_id=frames[1],
            transform=transform,
        )
        return self._make('tf2_msgs/msg/TFMessage', transforms=[stamped])

    def scan(self, scan: Scan) -> Any:
        return self._make(
            'sensor_msgs/msg/LaserScan',
            header=self.header('laser', scan.stamp_ns),
            angle_min=scan.angle_min_rad,
            angle_max=scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1),
            angle_increment=scan.angle_increment_rad,
            time_increment=0.0,
            scan_time=0.0,
            range_min=scan.range_min_m,
            range_max=scan.range_max_m,
            ranges=scan.ranges_m.astype(np.float32),
            intensities=np.zeros(0, dtype=np.float32),
        )


def convert(log: CarmenLog, bag: Path) -> int:
    """Write a bag of a log; returns the number of scans.

    Header stamps are the log's own, also where they step back. The bag's log time never does: it follows the largest
    stamp so far, a nanosecond a message, so that playing it keeps the order of the file.
    """
    scans = 0
    with BagWriter(bag) as writer:
        messages = _Messages(writer.typestore.types)
        log_ns = 0
        for event in log.events():
            stamp_ns = event.stamp_ns if isinstance(event, OdometryEvent) else event.scan.stamp_ns
            log_ns = max(stamp_ns, log_ns + 1)
            if scans == 0 and not isinstance(event, OdometryEvent):
                mount = messages.transform(stamp_ns, ('base_link', 'laser'), event.scan.T_base_laser)
                writer.write('/tf_static', 'tf2_msgs/msg/TFMessage', log_ns, mount)
                log_ns += 1
            log_ns = _write(writer, messages, event, log_ns)
            scans += not isinstance(event, OdometryEvent)
    return scans


def _write(writer: BagWriter, messages: _Messages, event: Event, log_ns: int) -> int:
    """Write an event; returns the log time of its last message."""
    if not isinstance(event, OdometryEvent):
        writer.write('/scan', 'sensor_msgs/msg/LaserScan', log_ns, messages.scan(event.scan))
        return log_ns
    odometry = messages.odometry(event.stamp_ns, event.T_odom_base)
    writer.write('/odom', 'nav_msgs/msg/Odometry', log_ns, odometry)
    transform = messages.transform(event.stamp_ns, ('odom', 'base_link'), event.T_odom_base)
    writer.write('/tf', 'tf2_msgs/msg/TFMessage', log_ns + 1, transform)
    return log_ns + 1


def _work(arguments: argparse.Namespace) -> None:
    log = CarmenLog(arguments.log, cli.config_from(arguments, LaserOptions))
    scans = convert(log, arguments.bag)
    skipped = f', {log.skipped.count} lines skipped (first: {log.skipped.first})' if log.skipped.count else ''
    print(f'{arguments.bag}: {scans} scans{skipped}')


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(prog='carmen_to_bag', description=__doc__)
    parser.add_argument('log', type=Path, help='CARMEN log, plain or gzip')
    parser.add_argument('bag', type=Path, help='rosbag2 folder to write, or a file that ends in .mcap')
    cli.add_config(parser, LaserOptions)
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
