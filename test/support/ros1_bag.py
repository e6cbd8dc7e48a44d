"""A bag with ROS 1 headers."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore


def ros1_bag(path: Path) -> None:
    """A bag of one scan, with a ROS 1 header."""
    typestore = get_typestore(Stores.ROS1_NOETIC)
    types = typestore.types
    time = types['builtin_interfaces/msg/Time'](sec=1, nanosec=0)
    header = types['std_msgs/msg/Header'](seq=7, stamp=time, frame_id='laser')
    scan = types['sensor_msgs/msg/LaserScan'](
        header=header,
        angle_min=-1.0,
        angle_max=1.0,
        angle_increment=0.5,
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.1,
        range_max=8.0,
        ranges=np.full(5, 2.0, dtype=np.float32),
        intensities=np.zeros(0, dtype=np.float32),
    )
    with Writer(path) as writer:
        connection = writer.add_connection('/scan', scan.__msgtype__, typestore=typestore)
        writer.write(connection, 10**9, typestore.serialize_ros1(scan, scan.__msgtype__))
