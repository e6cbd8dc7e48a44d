"""Bags as logs: rosbag2 folders, MCAP and SQLite files, and ROS 1 bags."""

from pathlib import Path

from thinmap_ros.logs.bag import EXPECTED, BagLog
from thinmap_ros.logs.log import Log, LogFormat, LogOptions
from thinmap_ros.logs.storage import is_bag


def _log(path: Path, options: LogOptions) -> Log:
    return BagLog(
        path,
        options.scan_topic,
        options.odometry_topic,
        options.T_base_laser,
        options.base_frame,
        options.odometry_source,
        options.odom_frame,
        options.laser,
    )


FORMAT = LogFormat(EXPECTED, is_bag, _log)
