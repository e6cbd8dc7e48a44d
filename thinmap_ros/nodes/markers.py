"""Graph, end nodes and line features as markers, for RViz and Foxglove.

These do not know thinmap's messages.
"""

from collections.abc import Callable
from typing import Any

from visualization_msgs.msg import MarkerArray

from thinmap_msgs.msg import EndNodeArray, LineFeatureArray, TopologicalMap
from thinmap_ros.nodes import merge_markers as markers
from thinmap_ros.ros import node_main as runtime
from thinmap_ros.ros import parameters, qos
from thinmap_ros.ros.lifecycle_node import LiveNode
from thinmap_ros.ros.subscription import listen


class MarkersNode(LiveNode):
    """/topology, /end_nodes, /line_features in; as markers on /topology_markers, ... out."""

    def __init__(self) -> None:
        super().__init__('markers')
        parameters.check_unknown(self)
        self._show(TopologicalMap, 'topology', markers.topology)
        self._show(EndNodeArray, 'end_nodes', markers.end_nodes)
        self._show(LineFeatureArray, 'line_features', markers.line_features)

    def _show(self, kind: type, topic: str, drawn: Callable[[Any], MarkerArray]) -> None:
        publisher = self.create_publisher(MarkerArray, f'{topic}_markers', qos.LATCHED)
        listen(self, kind, topic, lambda message: publisher.publish(drawn(message)), qos.LATCHED)


def main() -> None:
    """Run the node."""
    runtime.run(MarkersNode)


if __name__ == '__main__':
    main()
