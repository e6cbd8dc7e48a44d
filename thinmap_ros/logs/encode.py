"""Conversion of core values to message objects for a bag, without ROS."""

from typing import Any

import numpy as np

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.topology.graph import TopologicalMap, flat_topology


class BagObjects:
    """Makes message objects of the types of a typestore."""

    def __init__(self, types: dict[str, Any]) -> None:
        self._types = types

    def _make(self, name: str, **fields: Any) -> Any:
        return self._types[name](**fields)

    def header(self, frame_id: str, ns: int) -> Any:
        """std_msgs/Header."""
        stamp = self._make(
            'builtin_interfaces/msg/Time', sec=ns // SECOND_NS, nanosec=ns % SECOND_NS
        )
        return self._make('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)

    def _rotation(self, yaw: float) -> Any:
        half = yaw / 2.0
        return self._make(
            'geometry_msgs/msg/Quaternion',
            x=0.0,
            y=0.0,
            z=float(np.sin(half)),
            w=float(np.cos(half)),
        )

    def _vector(self, kind: str, x: float = 0.0, y: float = 0.0) -> Any:
        return self._make(f'geometry_msgs/msg/{kind}', x=float(x), y=float(y), z=0.0)

    def _pose(self, T: Array) -> Any:
        position = self._vector('Point', T[0], T[1])
        return self._make(
            'geometry_msgs/msg/Pose', position=position, orientation=self._rotation(T[2])
        )

    def _pose_with_covariance(self, T: Array, covariance: Array) -> Any:
        full = np.zeros((6, 6))
        full[np.ix_((0, 1, 5), (0, 1, 5))] = covariance
        return self._make(
            'geometry_msgs/msg/PoseWithCovariance', pose=self._pose(T), covariance=full.ravel()
        )

    def odometry(self, ns: int, T: Array) -> Any:
        """nav_msgs/Odometry of a pose T_odom_base (3,)."""
        twist = self._make(
            'geometry_msgs/msg/Twist',
            linear=self._vector('Vector3'),
            angular=self._vector('Vector3'),
        )
        return self._make(
            'nav_msgs/msg/Odometry',
            header=self.header('odom', ns),
            child_frame_id='base_link',
            pose=self._pose_with_covariance(T, np.zeros((3, 3))),
            twist=self._make(
                'geometry_msgs/msg/TwistWithCovariance', twist=twist, covariance=np.zeros(36)
            ),
        )

    def pose(self, ns: int, frame_id: str, T: Array) -> Any:
        """geometry_msgs/PoseStamped."""
        return self._make(
            'geometry_msgs/msg/PoseStamped', header=self.header(frame_id, ns), pose=self._pose(T)
        )

    def estimate(self, ns: int, T_map_base: Array, covariance: Array) -> Any:
        """geometry_msgs/PoseWithCovarianceStamped of a pose with covariance (3, 3) in the map."""
        pose = self._pose_with_covariance(T_map_base, covariance)
        name = 'geometry_msgs/msg/PoseWithCovarianceStamped'
        return self._make(name, header=self.header('map', ns), pose=pose)

    def transform(self, ns: int, frames: tuple[str, str], T: Array) -> Any:
        """tf2_msgs/TFMessage of one transform, from the first frame to the second."""
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
        """sensor_msgs/LaserScan."""
        return self._make(
            'sensor_msgs/msg/LaserScan',
            header=self.header('laser', scan.stamp_ns),
            angle_min=scan.angle_min_rad,
            angle_max=scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1),
            angle_increment=scan.angle_increment_rad,
            time_increment=scan.beam_period_s,
            scan_time=scan.scan_time_s,
            range_min=scan.range_min_m,
            range_max=scan.range_max_m,
            ranges=scan.ranges_m.astype(np.float32),
            intensities=np.zeros(0, dtype=np.float32),
        )

    def grid(self, ns: int, patch: GridPatch) -> Any:
        """nav_msgs/OccupancyGrid in the map."""
        rows, cols = patch.shape
        frame = patch.frame
        header = self.header('map', ns)
        info = self._make(
            'nav_msgs/msg/MapMetaData',
            map_load_time=header.stamp,
            resolution=frame.resolution,
            width=cols,
            height=rows,
            origin=self._pose(np.array([frame.origin_x, frame.origin_y, 0.0])),
        )
        return self._make(
            'nav_msgs/msg/OccupancyGrid', header=header, info=info, data=patch.cells.ravel()
        )

    def topology(self, ns: int, graph: TopologicalMap) -> Any:
        """thinmap_msgs/TopologicalMap in the map."""
        return self._make(
            'thinmap_msgs/msg/TopologicalMap',
            header=self.header('map', ns),
            map_id=0,
            **flat_topology(graph),
        )
