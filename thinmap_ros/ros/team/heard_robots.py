"""The other robots of a team by what they send, in the map of this one."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from thinmap_msgs.msg import TeamClaim
from thinmap_ros.core.exploration.team.claims import SilenceConfig
from thinmap_ros.core.planning.give_way import Motion
from thinmap_ros.core.stamps import SECOND_NS
from thinmap_ros.ros import parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import subscribe_guarded
from thinmap_ros.ros.team.membership import JoinedPlaces
from thinmap_ros.ros.team.team_messages import RobotClaim, claim_from_msg

CLAIMS = '/team/claims'


def declare_silence(node: ThinmapNode) -> float:
    """Declare how long a robot may be silent, s."""
    return parameters.declare_config(node, SilenceConfig).claim_timeout_s


class HeardMotion(NamedTuple):
    """Motion of a robot, and how long ago it was received, s."""

    motion: Motion
    age_s: float


@dataclass(frozen=True, eq=False)
class _Heard:
    claim: RobotClaim
    received_ns: int


class HeardRobots:
    """Newest claim of each other robot; those of robots that are not joined are only kept."""

    def __init__(
        self,
        node: ThinmapNode,
        places: JoinedPlaces,
        name: str,
        max_age_s: float,
        heard: Callable[[RobotClaim], bool] = lambda claim: True,
    ) -> None:
        """name: of this robot; heard: is called with each claim, and says whether to keep it.

        max_age_s: a robot that was silent for longer is an obstacle as any other.
        """
        self._node = node
        self._places = places
        self._name = name
        self._max_age_s = max_age_s
        self._accepts = heard
        self._heard: dict[str, _Heard] = {}
        subscribe_guarded(node, TeamClaim, CLAIMS, self._on_claim, qos.SENSOR)

    def motions(self) -> list[HeardMotion]:
        """Motions of the robots that are joined and were heard lately, in this robot's map."""
        now_ns = self._node.elapsed_time.now_ns()
        found = []
        for name, heard in self._heard.items():
            T = self._places.poses.get(name)
            age_s = (now_ns - heard.received_ns) / SECOND_NS
            if T is not None and 0.0 <= age_s <= self._max_age_s:
                found.append(HeardMotion(heard.claim.in_map(T).motion, age_s))
        return found

    def _on_claim(self, message: TeamClaim) -> None:
        claim = claim_from_msg(message)
        name = claim.claim.robot
        if self._accepts(claim) and name != self._name:
            self._heard[name] = _Heard(claim, self._node.elapsed_time.now_ns())
