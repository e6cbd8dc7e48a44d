"""Bags of ROS 1."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from thinmap_ros.logs.readers.bag import Bag

_TF = 'geometry_msgs/TransformStamped[] transforms\n'
NEW_TF = 'tf2_msgs/msg/TFMessage'
OLD_TF = 'tf/msg/tfMessage'  # until Hydro


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


def converted(
    source: Path,
    target: Path,
    compression: str = '',
    tf_type: str = NEW_TF,
    chunk_bytes: int = 1 << 20,
) -> Path:
    """A bag of ROS 2 as one of ROS 1; compression: bz2 or lz4; tf_type: that of transforms.

    chunk_bytes: size from which on a chunk ends.
    """
    typestore = get_typestore(Stores.ROS1_NOETIC)
    for name in (NEW_TF, OLD_TF):
        typestore.register(get_types_from_msg(_TF, name))
    new = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(target)
    writer.chunk_threshold = chunk_bytes
    if compression:
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    connections = {}
    with writer:
        for message in Bag(source).messages():
            name = tf_type if message.type_name == NEW_TF else message.type_name
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, name, typestore=typestore
                )
            data = bytes(new.cdr_to_ros1(message.data, message.type_name))
            writer.write(connections[message.topic], message.log_ns, data)
    return target
