"""What the explorer publishes of its mission."""

from collections.abc import Callable

from thinmap_msgs.msg import EndNodeArray, ExplorationStatus
from thinmap_ros.core.exploration.mission import Mission
from thinmap_ros.core.se2 import Array
from thinmap_ros.nodes.exploration.driver import TargetPublisher
from thinmap_ros.nodes.exploration.explore_lite import ExploreLiteTopics
from thinmap_ros.nodes.exploration.mission_messages import end_nodes_msg, status_msg
from thinmap_ros.ros import qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode


class MissionPublishers:
    """Publishes end nodes, target and status, the status also as explore_lite does."""

    def __init__(self, node: ThinmapNode, frame_id: str, on_resume: Callable[[bool], None]) -> None:
        """on_resume: receives what explore/resume asks for, continue or pause."""
        self._clock = node.get_clock()
        self._frame_id = frame_id
        self._end_nodes = node.create_publisher(EndNodeArray, 'end_nodes', qos.LATCHED)
        self._status = node.create_publisher(ExplorationStatus, 'exploration_status', qos.LATCHED)
        self._target = TargetPublisher(node, frame_id)
        self._lite = ExploreLiteTopics(node, frame_id, on_resume)

    def target(self, goal: Array) -> None:
        """Publish a target (3,), unless it is the last one."""
        self._target.publish(goal)

    def clear_target(self) -> None:
        """Publish the next target in any case: the robot does not drive to the last one now."""
        self._target.clear()

    def end_nodes(self, mission: Mission, stamp_ns: int) -> None:
        """Publish the end nodes of a decision about a scan."""
        self._end_nodes.publish(end_nodes_msg(mission, self._frame_id, stamp_ns))

    def end_nodes_now(self, mission: Mission) -> EndNodeArray:
        """Message of the end nodes of the last decision."""
        return end_nodes_msg(mission, self._frame_id, self._now_ns())

    def status(self, mission: Mission) -> ExplorationStatus:
        """Publish the status; returns the message."""
        message = self.status_now(mission)
        self._status.publish(message)
        return message

    def status_now(self, mission: Mission) -> ExplorationStatus:
        """Message of the present status."""
        return status_msg(mission, self._frame_id, self._now_ns())

    def progress(self, mission: Mission, is_yielding: bool) -> None:
        """Publish the word for the progress where it has changed."""
        self._lite.publish_status(mission, is_yielding)

    def frontiers(self, mission: Mission) -> None:
        """Publish the frontiers."""
        self._lite.publish_frontiers(mission)

    def _now_ns(self) -> int:
        return int(self._clock.now().nanoseconds)
