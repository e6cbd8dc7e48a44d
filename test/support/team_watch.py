"""Watches robots explore, in a process of its own, and writes how it ends.

    team_watch FILE ROBOT ... --ros-args ...

When all robots have finished, FILE holds for each whether it has, the area that it knows, m2, and
its contacts, as JSON.
"""

import json
import sys
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from std_msgs.msg import UInt32

from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.files.safe import write_text
from thinmap_ros.ros import qos


class TeamWatch(Node):
    """Last status and number of contacts of each robot."""

    def __init__(self, names: list[str]) -> None:
        super().__init__('team_watch')
        self.statuses: dict[str, ExplorationStatus] = {}
        self.contacts = dict.fromkeys(names, 0)
        for name in names:
            self._watch(name)

    def _watch(self, name: str) -> None:
        def on_status(message: ExplorationStatus) -> None:
            self.statuses[name] = message

        def on_contacts(message: UInt32) -> None:
            self.contacts[name] = message.data

        self.create_subscription(
            ExplorationStatus, f'{name}/exploration_status', on_status, qos.LATCHED
        )
        self.create_subscription(UInt32, f'{name}/collisions', on_contacts, qos.LATCHED)

    @property
    def is_over(self) -> bool:
        over = [each.state == ExplorationStatus.FINISHED for each in self.statuses.values()]
        return len(over) == len(self.contacts) and all(over)

    def result(self) -> dict[str, dict[str, object]]:
        return {
            name: {
                'is_complete': status.reason_code == ExplorationStatus.ALL_RESOLVED,
                'reason': status.reason,
                'known_area_m2': status.known_area_m2,
                'contacts': self.contacts[name],
            }
            for name, status in self.statuses.items()
        }


def main() -> None:
    _, file, *names = remove_ros_args(sys.argv)
    rclpy.init()
    node = TeamWatch(names)
    while not node.is_over:
        rclpy.spin_once(node, timeout_sec=0.5)
    write_text(Path(file), json.dumps(node.result()))


if __name__ == '__main__':
    main()
