"""The other robots of a team by what they send, in the map of this one."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from thinmap_msgs.msg import TeamClaim
from thinmap_ros.core.exploration.team import SilenceConfig
from thinmap_ros.core.planning.path_follower import Motion
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros import parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import subscribe_guarded
from thinmap_ros.ros.team.membership import JoinedPlaces, declare_membership
from thinmap_ros.ros.team.team_messages import RobotClaim, claim_from_msg

CLAIMS = '/team/claims'


class HeardMotion(NamedTuple):
    """Motion of a robot, and how long ago it was received, s."""

    motion: Motion
    age_s: float


@dataclass(frozen=True, eq=False)
class _Heard:
    claim: RobotClaim
    received_ns: int


class HeardRobots:
    """Newest claim of each other robot; those of robots that are not joined are only kept.

    name: of this robot; places: where the maps of the others lie.
    """

    def __init__(
        self,
        node: ThinmapNode,
        places: JoinedPlaces,
        name: str,
        max_age_s: float,
        heard: Callable[[RobotClaim], bool] = lambda claim: True,
    ) -> None:
        """heard: is called with each claim, and says whether to keep it.

        max_age_s: a robot that was silent for longer is an obstacle as any other.
        """
        self._node = node
        self.places = places
        self.name = name
        self._max_age_s = max_age_s
        self._accepts = heard
        self._heard: dict[str, _Heard] = {}
        subscribe_guarded(node, TeamClaim, CLAIMS, self._on_claim, qos.SENSOR)

    def motions(self) -> list[HeardMotion]:
        """Motions of the robots that are joined and were heard lately, in this robot's map."""
        now_ns = self._node.elapsed_time.now_ns()
        found = []
        for name, heard in self._heard.items():
            T = self.places.poses.get(name)
            age_s = (now_ns - heard.received_ns) / SECOND_NS
            if T is not None and 0.0 <= age_s <= self._max_age_s:
                found.append(HeardMotion(heard.claim.in_map(T).motion, age_s))
        return found

    def _on_claim(self, message: TeamClaim) -> None:
        claim = claim_from_msg(message)
        name = claim.claim.robot
        if self._accepts(claim) and name != self.name:
            self._heard[name] = _Heard(claim, self._node.elapsed_time.now_ns())


def heard_robots(node: ThinmapNode) -> HeardRobots | None:
    """The other robots of the node's team, None without a team; declares the parameters."""
    membership = declare_membership(node)
    silence_s = parameters.declare_config(node, SilenceConfig).claim_timeout_s
    if not membership.team:
        return None
    name = membership.team_name
    return HeardRobots(node, JoinedPlaces(node, name), name, silence_s)
