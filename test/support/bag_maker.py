"""Bags of a short drive, with messages of any content."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.logs.bag_writer import BagWriter

SCAN = 'sensor_msgs/msg/LaserScan'
ODOMETRY = 'nav_msgs/msg/Odometry'
TF = 'tf2_msgs/msg/TFMessage'
Quaternion = tuple[float, float, float, float]
UPRIGHT: Quaternion = (0.0, 0.0, 0.0, 1.0)


class Maker:
    """Message objects of a writer's typestore."""

    def __init__(self, writer: BagWriter) -> None:
        self.types = writer.typestore.types

    def __call__(self, name: str, /, **fields: Any) -> Any:
        return self.types[name](**fields)

    def header(self, frame: str, ns: int) -> Any:
        stamp = self('builtin_interfaces/msg/Time', sec=ns // 10**9, nanosec=ns % 10**9)
        return self('std_msgs/msg/Header', stamp=stamp, frame_id=frame)

    def transform(
        self,
        parent: str,
        child: str,
        moved: tuple[float, ...],
        turned: Quaternion = UPRIGHT,
        ns: int = 0,
    ) -> Any:
        x, y, z, w = turned
        transform = self(
            'geometry_msgs/msg/Transform',
            translation=self('geometry_msgs/msg/Vector3', x=moved[0], y=moved[1], z=moved[2]),
            rotation=self('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w),
        )
        stamped = self(
            'geometry_msgs/msg/TransformStamped',
            header=self.header(parent, ns),
            child_frame_id=child,
            transform=transform,
        )
        return self(TF, transforms=[stamped])

    def scan(self, ns: int, ranges: list[float], frame: str = 'laser') -> Any:
        return self(
            SCAN,
            header=self.header(frame, ns),
            angle_min=-0.5,
            angle_max=0.5,
            angle_increment=0.25,
            time_increment=0.0,
            scan_time=0.0,
            range_min=0.05,
            range_max=8.0,
            ranges=np.array(ranges, dtype=np.float32),
            intensities=np.zeros(0, dtype=np.float32),
        )

    def odometry(
        self,
        ns: int,
        x: float,
        turned: Quaternion = UPRIGHT,
        frames: tuple[str, str] = ('odom', 'base_link'),
    ) -> Any:
        zero = self('geometry_msgs/msg/Vector3', x=0.0, y=0.0, z=0.0)
        pose = self(
            'geometry_msgs/msg/Pose',
            position=self('geometry_msgs/msg/Point', x=x, y=1.0, z=0.0),
            orientation=self(
                'geometry_msgs/msg/Quaternion', **dict(zip('xyzw', turned, strict=True))
            ),
        )
        twist = self('geometry_msgs/msg/Twist', linear=zero, angular=zero)
        return self(
            ODOMETRY,
            header=self.header(frames[0], ns),
            child_frame_id=frames[1],
            pose=self('geometry_msgs/msg/PoseWithCovariance', pose=pose, covariance=np.zeros(36)),
            twist=self(
                'geometry_msgs/msg/TwistWithCovariance', twist=twist, covariance=np.zeros(36)
            ),
        )


def write(path: Path, fill: Callable[[BagWriter, Maker], None]) -> Path:
    with BagWriter(path) as writer:
        fill(writer, Maker(writer))
    return path


RANGES = [1.0, 2.0, math.inf, math.nan, 3.0]


def drive(writer: BagWriter, make: Maker, count: int = 3, mount: bool = True) -> None:
    if mount:
        writer.write(
            '/tf_static', TF, 1, make.transform('base_link', 'laser', (0.2, -0.1, 0.3), UPRIGHT)
        )
    for i in range(count):
        ns = 10**9 + i * 2 * 10**8
        writer.write('/odom', ODOMETRY, ns, make.odometry(ns, 0.1 * i))
        writer.write('/scan', SCAN, ns + 1, make.scan(ns, RANGES))
