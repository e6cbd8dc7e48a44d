"""Shows map and robot in rerun, and writes them to an .rrd file."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as PathMsg
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import (
    EndNodeArray,
    ExplorationStatus,
    LineFeatureArray,
    LocalizedScan,
    RegionArray,
    SlamStatus,
    TopologicalMap,
)
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError
from thinmap_ros.ros import node_main, parameters, qos
from thinmap_ros.ros.diagnostics import NodeDiagnostics
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.maps import updates_topic
from thinmap_ros.ros.subscription import WARN_PERIOD_S
from thinmap_ros.view.interface import NullView
from thinmap_ros.view.message_view import MessageView
from thinmap_ros.view.rerun_view import View

_TOPICS = {
    'map': (OccupancyGrid, qos.LATCHED),
    'map_updates': (OccupancyGridUpdate, qos.STREAM),
    'scan': (LaserScan, qos.SENSOR),
    'pose': (PoseWithCovarianceStamped, qos.STREAM),
    'odom': (Odometry, qos.STREAM),
    'ground_truth': (PoseStamped, qos.STREAM),
    'topology': (TopologicalMap, qos.LATCHED),
    'regions': (RegionArray, qos.LATCHED),
    'end_nodes': (EndNodeArray, qos.LATCHED),
    'line_features': (LineFeatureArray, qos.LATCHED),
    'plan': (PathMsg, qos.LATCHED),
    'exploration_status': (ExplorationStatus, qos.LATCHED),
    'slam_status': (SlamStatus, qos.STREAM),
    'localized_scan': (LocalizedScan, qos.STREAM),
    'localization_samples': (PoseArray, qos.LATCHED),
    'diagnostics': (DiagnosticArray, qos.STREAM),
}


@dataclass(frozen=True)
class RerunViewerConfig(Config):
    """Parameters of the viewer."""

    recording: str = parameter('', 'Recording to write (.rrd). Empty: none.')
    spawn: bool = parameter(True, 'Open the viewer.')


class RerunViewerNode(Node):
    """/map, /scan, /pose, /odom, /ground_truth, /topology, ... in; a picture out."""

    def __init__(self) -> None:
        super().__init__('rerun_viewer')
        config = parameters.declare_config(self, RerunViewerConfig)
        mount = LaserTransform(self)
        parameters.reject_unknown(self)
        self._view = self._open(config)
        self._feed = MessageView(self._view, mount.pose, self.get_namespace())
        self._diagnostics = NodeDiagnostics(self)
        names = {
            'diagnostics': '/diagnostics',  # all robots share it
            'map_updates': updates_topic(self, 'map'),
        }
        for topic, (kind, profile) in _TOPICS.items():
            of_kind = mount.scan_topics if topic == 'scan' else (names.get(topic, topic),)
            for name in of_kind:
                self.create_subscription(kind, name, self._callback(topic), profile)

    def close(self) -> None:
        """Finish the recording."""
        self._view.close()

    def _open(self, config: RerunViewerConfig) -> NullView:
        if config.recording or config.spawn:
            return View(Path(config.recording) if config.recording else None, config.spawn)
        self.get_logger().warning('neither recording nor spawn is set: nothing is shown')
        return NullView()

    def _callback(self, topic: str) -> Callable[[Any], None]:
        def process(message: Any) -> None:
            self._diagnostics.message_received(topic)
            try:
                self._feed.show(topic, message)
            except InputError as error:
                self._diagnostics.message_rejected(topic, str(error))
                self.get_logger().warning(f'{topic}: {error}', throttle_duration_sec=WARN_PERIOD_S)

        return process


main = node_main.program(RerunViewerNode)

if __name__ == '__main__':
    main()
