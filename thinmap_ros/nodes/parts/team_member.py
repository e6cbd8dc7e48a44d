"""An explorer's part in a team: what it tells the others, and what it has from them."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from thinmap_msgs.msg import MapTiles, TeamClaim, TileRequest
from thinmap_ros.core import se2
from thinmap_ros.core.errors import ConfigError, InputError, quoted
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.exploration.mission import Mission, MissionState
from thinmap_ros.core.exploration.strategy import Observation, Strategy
from thinmap_ros.core.exploration.team import Claim, Team, TeamConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import TILE_PERIOD_S, TileSender
from thinmap_ros.core.planning.path_follower import MESSAGE_PERIOD_S, NEAR_ROBOT_M, Motion, moved_on
from thinmap_ros.core.se2 import SECOND_NS, Array, Place
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.maps import new_map_id
from thinmap_ros.ros.subscription import WARN_PERIOD_S, subscribe_guarded
from thinmap_ros.ros.team import (
    CLAIMS,
    REQUESTS,
    TILES,
    HeardRobots,
    JoinedPlaces,
    MembershipConfig,
    RobotClaim,
    RobotState,
    TileReceiver,
    claim_msg,
    declare_membership,
    tiles_msg,
)


class TileOutput:
    """Publishes the tiles that have changed since the last message, or since what is asked for."""

    def __init__(self, node: ThinmapNode, name: str, frame_id: str) -> None:
        """name: of the robot; frame_id: of its map."""
        self._node = node
        self._name = name
        self._frame_id = frame_id
        self._publisher = node.create_publisher(MapTiles, TILES, qos.LATCHED)
        self.reset()
        subscribe_guarded(node, TileRequest, REQUESTS, self._on_request, qos.STREAM)

    def reset(self) -> None:
        """Begin again with another map."""
        self._session = new_map_id()
        self._sender: TileSender | None = None

    def send(self, patch: GridPatch) -> None:
        """Publish what has changed in the map, if anything has."""
        sender = self._sender_of(patch)
        sender.update(patch)
        tiles = sender.next_message()
        if tiles.version > tiles.after:
            header = messages.header(self._frame_id, self._node.now_ns)
            self._publisher.publish(tiles_msg(header, self._name, self._session, tiles))

    def _sender_of(self, patch: GridPatch) -> TileSender:
        """The sender of the lattice of a map: another lattice is another map."""
        sender = self._sender
        if sender is not None:
            if GridPatch(sender.frame, patch.cells[:0, :0]).is_aligned_with(patch):
                return sender
            self.reset()
        self._sender = TileSender(patch.frame)
        return self._sender

    def _on_request(self, message: TileRequest) -> None:
        is_asked = message.robot == self._name and message.session == self._session
        if is_asked and self._sender is not None:
            self._sender.repeat_after(message.after)


_NEAR_PERIOD_S = 0.1
_NEAR_STEP_M = 0.05  # near to another robot the pose is sent after each cell, not at standstill


class Progress(NamedTuple):
    """The part of an exploration that a robot reports.

    located: stamp and pose (3,), None where it does not know its place; goal (3,): where it drives,
    None where that is unknown.
    """

    mission: Mission
    located: tuple[int, Array] | None
    goal: Array | None


# Progress after the newest observation.
GetProgress = Callable[[Observation | None], Progress]


class Alone:
    """An explorer without a team."""

    def attach(self, strategy: Strategy) -> None:
        """Have a strategy share its candidates with the others."""

    def observed(self, observation: Observation) -> None:
        """Process an observation in the robot's own map, whether it explores or not."""

    def completed(self, observation: Observation) -> Observation:
        """An observation in the map of all robots, from which a strategy then decides."""
        return observation

    def reset(self) -> None:
        """Begin again with another map."""


def declare_team(node: ThinmapNode, frame_id: str, is_able: bool, progress: GetProgress) -> Alone:
    """Declare the parameters of a team, and join it where `team` is true.

    frame_id: of the map; is_able: whether the strategy can share its candidates.
    Raises ConfigError where it cannot, but has to.
    """
    membership = declare_membership(node)
    config = parameters.declare_config(node, TeamConfig)
    if not membership.team:
        return Alone()
    if not is_able:
        raise ConfigError('team = true: expected strategy = position_probability')
    return TeamMember(node, membership, config, frame_id, progress)


class TeamMember(Alone):
    """An explorer that sends its claims and tiles, and hears those of the others.

    A claim is sent each second, when the claimed place changes, and often near others. A robot that
    does not know its place is silent: others would cut their walls out at its pose.
    """

    def __init__(
        self,
        node: ThinmapNode,
        membership: MembershipConfig,
        config: TeamConfig,
        frame_id: str,
        progress: GetProgress,
    ) -> None:
        name = membership.team_name
        self._node = node
        self._config = config
        self._frame_id = frame_id
        self._progress = progress
        self._session = new_map_id()  # that others know this explorer by
        self._places = JoinedPlaces(node, name)
        self._heard = HeardRobots(node, self._places, name, config, self._accepts)
        self._received = TileReceiver(node, self._places, name)
        self._tiles = TileOutput(node, name, frame_id)
        self._publisher = node.create_publisher(TeamClaim, CLAIMS, qos.SENSOR)
        self._team = Team(name, config)
        self._last: Observation | None = None
        self._is_located = False  # whether it knew its place lately
        self._told_s = -math.inf
        self._told_place: Place | None = None
        self._told_xy = np.zeros(2)
        self._track = _Track()
        node.create_active_timer(_NEAR_PERIOD_S, self._tell)
        node.create_active_timer(TILE_PERIOD_S, self._send_tiles)

    def attach(self, strategy: Strategy) -> None:
        """As Alone.attach; one that is continued keeps what it has told."""
        assert isinstance(strategy, Explorer)
        if strategy.team is self._team:
            return
        present = self._team.claims.present(self._now_ns)
        self._team = Team(self._team.name, self._config)
        for claim in present:
            self._team.add_claim(claim, self._now_ns)
        strategy.team = self._team

    def observed(self, observation: Observation) -> None:
        """As Alone.observed."""
        self._last = observation

    def completed(self, observation: Observation) -> Observation:
        """As Alone.completed."""
        own = observation.patch
        patch = self._received.completed(own)
        for box in self._received.take_changes():
            self._team.add_changes(box)
        if self._received.take_moved():
            patch = replace(patch, is_replaced=True)
        return observation._replace(patch=patch)

    def reset(self) -> None:
        """As Alone.reset."""
        self._last = None
        self._tiles.reset()

    @property
    def _now_ns(self) -> int:
        """Time by the stamps that the strategy knows."""
        return 0 if self._last is None else self._last.scan.stamp_ns

    def _accepts(self, heard: RobotClaim) -> bool:
        """Take a claim into the decisions; returns whether it is of another robot.

        Raises InputError where that has the name of this one.
        """
        if heard.session == self._session:
            return False
        name = heard.claim.robot
        if name == self._team.name:
            raise InputError(
                f'another robot is called {quoted(name)}, too: expected another team_name'
            )
        T = self._places.poses.get(name)
        if T is not None:
            self._team.add_claim(heard.in_map(T).claim, self._now_ns)
        return True

    def _send_tiles(self) -> None:
        if self._last is None or not self._is_located:
            return
        try:
            self._tiles.send(self._last.patch)
        except InputError as error:
            self._node.get_logger().warning(
                f'tiles are not sent: {error}', throttle_duration_sec=WARN_PERIOD_S
            )

    def _tell(self) -> None:
        """Publish a claim if one is due."""
        progress = self._progress(self._last)
        self._is_located = progress.located is not None
        if progress.located is None:
            return
        now_s = self._node.elapsed_time.now_s()
        self._track.add(*progress.located, now_s)
        T_map_base = self._track.pose_at(now_s)
        told = self._claim(progress, T_map_base)
        others = self._heard.motions()
        is_near = any(
            math.dist(T_map_base[:2], other.motion.pose[:2]) < NEAR_ROBOT_M for other in others
        )
        has_moved = math.dist(T_map_base[:2], self._told_xy) > _NEAR_STEP_M
        is_due = not 0.0 <= now_s - self._told_s < MESSAGE_PERIOD_S
        place = told.claim.place
        if is_due or (is_near and has_moved) or place != self._told_place:
            self._told_s = now_s
            self._told_xy = T_map_base[:2]
            self._told_place = place
            self._publisher.publish(claim_msg(told, self._frame_id))
            self._team.sent = told.claim

    def _claim(self, progress: Progress, T_map_base: Array) -> RobotClaim:
        mission = progress.mission
        explores = mission.state == MissionState.EXPLORING and not mission.is_paused
        strategy = mission.strategy
        assert isinstance(strategy, Explorer)
        goal = progress.goal
        claim = strategy.claim(self._node.now_ns, T_map_base)
        if not explores:
            claim = replace(claim, robot=self._team.name, place=None, remaining_s=0.0)
        state = _state_of(mission, explores, claim)
        motion = Motion(self._team.name, T_map_base, *self._track.speeds)
        place = None if goal is None else (float(goal[0]), float(goal[1]))
        return RobotClaim(claim, motion, state, self._session, place)


def _state_of(mission: Mission, explores: bool, claim: Claim) -> RobotState:
    if explores:
        return RobotState.WAITING if claim.place is None else RobotState.DRIVING
    return RobotState.FINISHED if mission.state > MissionState.EXPLORING else RobotState.IDLE


class _Track:
    """Speed, m/s, and turn rate, rad/s, of a robot by its last two poses; where it is since."""

    def __init__(self) -> None:
        self.speeds = (0.0, 0.0)
        self._last: tuple[int, Array] | None = None
        self._added_s = 0.0

    def add(self, stamp_ns: int, T_map_base: Array, now_s: float) -> None:
        """Add the pose (3,) at a stamp, received at a time; the last one may be given again."""
        last = self._last
        if last is not None and stamp_ns == last[0]:
            return
        self._last = (stamp_ns, T_map_base)
        self._added_s = now_s
        self.speeds = (0.0, 0.0)
        if last is None:
            return
        seconds = (stamp_ns - last[0]) / SECOND_NS
        if 0.0 < seconds <= MESSAGE_PERIOD_S:
            x, _, turn = se2.between(last[1], T_map_base).tolist()
            self.speeds = (x / seconds, turn / seconds)

    def pose_at(self, now_s: float) -> Array:
        """The last pose (3,), moved on at its speeds: the robot has driven since that scan."""
        assert self._last is not None
        age_s = min(max(now_s - self._added_s, 0.0), MESSAGE_PERIOD_S)
        return moved_on(Motion('', self._last[1], *self.speeds), age_s).pose
