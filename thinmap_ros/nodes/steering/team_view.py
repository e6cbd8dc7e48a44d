"""The other robots of a team on the page."""

from thinmap_ros.core.planning.give_way import MESSAGE_PERIOD_S, moved_on
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.team.heard_robots import HeardRobots, declare_silence
from thinmap_ros.ros.team.membership import JoinedPlaces, declare_membership
from thinmap_ros.web.picture import Picture


class TeamView:
    """Shows the robots whose maps are joined with that of this one; without a team, none."""

    def __init__(self, node: ThinmapNode, picture: Picture) -> None:
        """Declare the parameters."""
        membership = declare_membership(node)
        silence_s = declare_silence(node)
        self._picture = picture
        self._heard: HeardRobots | None = None
        if membership.team:
            places = JoinedPlaces(node, membership.team_name)
            self._heard = HeardRobots(node, places, membership.team_name, silence_s)

    def tick(self) -> None:
        """Show where the robots are now, moved on since their last messages."""
        if self._heard is not None:
            self._picture.robots(
                [
                    moved_on(motion, min(age_s, MESSAGE_PERIOD_S))
                    for motion, age_s in self._heard.motions()
                ]
            )
