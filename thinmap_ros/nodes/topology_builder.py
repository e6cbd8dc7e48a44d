"""The topological map: the window around the robot thinned at every scan and merged into the global graph."""

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node

from thinmap_msgs.msg import TopologicalMap
from thinmap_ros import warm_up
from thinmap_ros.adapters import messages, parameters, qos, runtime
from thinmap_ros.adapters.listening import listen
from thinmap_ros.adapters.stamps import StampMatcher
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.update import TopologyBuilder, TopologyConfig


class TopologyBuilderNode(Node):
    """/local_map and /pose in; /local_topology and /topology out."""

    def __init__(self) -> None:
        super().__init__('topology_builder')
        self._builder = TopologyBuilder(parameters.declare(self, TopologyConfig))
        self._map_frame = parameters.declare_value(self, 'map_frame', 'map', 'frame of the map')
        parameters.check_unknown(self)
        warm_up.topology_builder()
        self._matcher: StampMatcher[GridPatch, Array] = StampMatcher()
        self._local = self.create_publisher(TopologicalMap, 'local_topology', qos.LATCHED)
        self._global = self.create_publisher(TopologicalMap, 'topology', qos.LATCHED)
        listen(self, OccupancyGrid, 'local_map', self._on_window, qos.STREAM)
        listen(self, PoseWithCovarianceStamped, 'pose', self._on_pose, qos.STREAM)

    def _on_window(self, message: OccupancyGrid) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        pair = self._matcher.left(stamp_ns, messages.patch_from(message))
        self._take(stamp_ns, pair)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        pair = self._matcher.right(stamp_ns, messages.pose_from(message.pose.pose))
        self._take(stamp_ns, pair)

    def _take(self, stamp_ns: int, pair: tuple[GridPatch, Array] | None) -> None:
        if pair is None:
            return
        if self._builder.update(*pair):
            self._global.publish(messages.topology_msg(self._builder.map, self._map_frame, stamp_ns))
        # The local map comes last: who hears it knows that all of this scan is said.
        self._local.publish(messages.topology_msg(self._builder.local_map(), self._map_frame, stamp_ns))


def main() -> None:
    """Run the node."""
    runtime.run(TopologyBuilderNode)


if __name__ == '__main__':
    main()
