"""The map of a mapper that has outlived the localizer: its successor finds it."""

from collections.abc import Callable

from rclpy.node import Node

from thinmap_msgs.msg import ProbabilityGrid
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.maps import UNKNOWN


class LivingMap:
    """Subscribes to grid until there is a map of a known id, and calls `found` with both."""

    def __init__(self, node: Node, found: Callable[[int, GridPatch], None]) -> None:
        self._node = node
        self._found = found
        self._grid = node.create_subscription(ProbabilityGrid, 'grid', self._on_grid, qos.LATCHED)

    def _on_grid(self, message: ProbabilityGrid) -> None:
        if message.map_id == UNKNOWN:
            return
        try:
            patch = messages.grid_from_msg(message)
        except InputError as error:
            self._node.get_logger().warning(f'grid: {error}')
            return
        self._node.destroy_subscription(self._grid)
        self._found(message.map_id, patch)
