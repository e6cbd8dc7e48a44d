"""Messages of a robot that stands at the origin of a hall, whatever it is commanded."""

from array import array

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import LaserScan
from support.halls import empty_hall
from tf2_msgs.msg import TFMessage

from thinmap_ros.ros import messages, qos

T_MAP_ODOM = np.array([1.0, 2.0, 0.0])
PERIOD_S = 0.1


class StillRobot:
    """Publishes map, pose, odometry, transforms and scans ten times a second.

    Its pose in the map is the origin; `odom` is at T_MAP_ODOM. timer: which publishes; stamp_ns: of
    what was published last.
    """

    def __init__(self, graph, base_frame='base_link', hall=None):
        node = graph.node
        self._base_frame = base_frame
        self._now = node.get_clock().now
        self._scan = node.create_publisher(LaserScan, 'scan', qos.STREAM)
        self._odometry = node.create_publisher(Odometry, 'odom', qos.STREAM)
        self._pose = node.create_publisher(PoseWithCovarianceStamped, 'pose', qos.STREAM)
        self._tf = node.create_publisher(TFMessage, '/tf', qos.TRANSFORMS)
        self._map = node.create_publisher(OccupancyGrid, 'map', qos.LATCHED)
        self._map.publish(empty_hall() if hall is None else hall)
        self.stamp_ns = 0
        self.timer = node.create_timer(PERIOD_S, self.publish)

    def publish(self):
        ns = self._now().nanoseconds
        self.stamp_ns = ns
        T_odom_base = -T_MAP_ODOM
        transforms = [
            messages.transform_msg(T_MAP_ODOM, 'map', 'odom', ns),
            messages.transform_msg(T_odom_base, 'odom', self._base_frame, ns),
        ]
        self._tf.publish(TFMessage(transforms=transforms))
        self._odometry.publish(
            messages.odometry_msg(T_odom_base, (0.0, 0.0), ('odom', self._base_frame), ns)
        )
        scan = LaserScan(angle_min=-1.5, angle_increment=0.05, range_min=0.05, range_max=8.0)
        scan.header = messages.header('laser', ns)
        scan.ranges = array('f', np.full(61, np.inf, dtype=np.float32))
        self._scan.publish(scan)
        self._pose.publish(messages.pose_with_covariance_msg(np.zeros(3), np.eye(3), 'map', ns))
