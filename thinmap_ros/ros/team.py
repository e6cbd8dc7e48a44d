"""The other robots of a team: messages, poses and maps, in the map of this one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from geometry_msgs.msg import Point32, Pose
from rclpy.node import Node
from std_msgs.msg import Header

from thinmap_msgs.msg import JoinStatus, MapTiles, TeamClaim, TileRequest
from thinmap_msgs.msg import SettledPlace as SettledPlaceMsg
from thinmap_ros.core import errors, se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.exploration.team import (
    MAX_SETTLED,
    Claim,
    Heard,
    SettledPlace,
    SilenceConfig,
)
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import JoinedMaps, TileMessage
from thinmap_ros.core.planning.path_follower import HeardMotion, Motion
from thinmap_ros.core.se2 import Array, Place
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import WARN_PERIOD_S, subscribe_guarded


@dataclass(frozen=True)
class MembershipConfig(Config):
    """The robot's part in a team."""

    team: bool = parameter(
        False,
        'Work with the robots whose maps map_joiner has joined with that of this one. Set it for '
        'explorer, grid_mapper and navigator.',
    )
    team_name: str = parameter(
        '',
        'Name of the robot in its team, which decides ties: that of its map in join_status. '
        'Empty: the namespace.',
    )


def declare_membership(node: Node) -> MembershipConfig:
    """Declare team and team_name; the name is never empty."""
    config = parameters.declare_config(node, MembershipConfig)
    return MembershipConfig(config.team, config.team_name or node.get_namespace())


class JoinedPlaces:
    """Where the maps of the other robots lie in the map of this one, as map_joiner reports it.

    poses (3,): by the names of the robots that are joined with this one.
    """

    def __init__(self, node: ThinmapNode, name: str) -> None:
        """name: of this robot."""
        self.poses: dict[str, Array] = {}
        self._name = name
        subscribe_guarded(node, JoinStatus, '/join_status', self._on_status, qos.LATCHED)

    def _on_status(self, message: JoinStatus) -> None:
        world = {
            each.name: messages.pose_from_msg(each.pose) for each in message.maps if each.is_joined
        }
        own = world.pop(self._name, None)
        if own is None:
            self.poses = {}
            return
        self.poses = {name: se2.between(own, T) for name, T in world.items()}


_MAX_SPEED = 100.0  # m/s and rad/s
_MAX_COUNT = 255
_MAX_NAME = 200
_SOMEWHERE = (0.0, 0.0)


class RobotState(IntEnum):
    """What a robot of a team does, as in thinmap_msgs/TeamClaim."""

    IDLE = 0
    DRIVING = 1
    WAITING = 2
    FINISHED = 3


@dataclass(frozen=True, eq=False)
class RobotClaim:
    """A claim, the motion and the state of its robot; session: of its explorer.

    goal: where it drives, m, None without a target.
    """

    claim: Claim
    motion: Motion
    state: RobotState
    session: int
    goal: Place | None = None

    def in_map(self, T: Array) -> 'RobotClaim':
        """The same in another map, in which that of the robot has a place T (3,)."""
        claim = self.claim
        settled = [
            place._replace(x=x, y=y)
            for place, (x, y) in zip(
                claim.settled,
                _moved(T, [(place.x, place.y) for place in claim.settled]),
                strict=True,
            )
        ]
        pose = se2.compose(T, claim.pose)
        moved = replace(
            claim, pose=pose, place=_moved_place(T, claim.place), settled=tuple(settled)
        )
        motion = replace(self.motion, pose=pose)
        return replace(self, claim=moved, motion=motion, goal=_moved_place(T, self.goal))


def claim_msg(sent: RobotClaim, frame_id: str) -> TeamClaim:
    """Message of a claim; frame_id: of the map of the robot."""
    claim = sent.claim
    return TeamClaim(
        header=messages.header(frame_id, claim.stamp_ns),
        robot=claim.robot,
        session=sent.session,
        pose=messages.pose_msg(claim.pose),
        v=sent.motion.v,
        w=sent.motion.w,
        state=int(sent.state),
        goal=_point_msg(sent.goal),
        frontier=_point_msg(claim.place),
        remaining_s=claim.remaining_s,
        settled=[
            SettledPlaceMsg(
                x=place.x,
                y=place.y,
                visits=min(place.visits, _MAX_COUNT),
                failures=min(place.failures, _MAX_COUNT),
            )
            for place in claim.settled
        ],
    )


def claim_from_msg(message: TeamClaim) -> RobotClaim:
    """Claim of a message.

    Raises InputError where the name is empty, the state unknown, a number not finite, or settled
    places are too many.
    """
    name = _name(message.robot)
    if len(message.settled) > MAX_SETTLED:
        raise InputError(
            f'claim of robot {quoted(name)}: {len(message.settled)} settled places: expected '
            f'{MAX_SETTLED} at most'
        )
    places = [(place.x, place.y) for place in message.settled]
    points = [(message.goal.x, message.goal.y), (message.frontier.x, message.frontier.y)]
    numbers = np.ravel([*places, *points]).tolist()
    errors.require_bounded(f'claim of robot {quoted(name)}: place', numbers)
    errors.require_bounded(f'claim of robot {quoted(name)}: time', [message.remaining_s])
    speeds = [message.v, message.w]
    errors.require_bounded(f'claim of robot {quoted(name)}: speed', speeds, _MAX_SPEED)
    if message.state not in list(RobotState):
        raise InputError(
            f'claim of robot {quoted(name)}: state {message.state}: expected 0 to {max(RobotState)}'
        )
    state = RobotState(message.state)
    is_driving = state is RobotState.DRIVING
    T = _pose(name, message.pose)
    claim = Claim(
        name,
        messages.stamp_ns(message.header.stamp),
        T,
        points[1] if is_driving else None,
        max(float(message.remaining_s), 0.0),
        tuple(SettledPlace(p.x, p.y, p.visits, p.failures) for p in message.settled),
    )
    motion = Motion(name, T, float(message.v), float(message.w))
    return RobotClaim(claim, motion, state, message.session, points[0] if is_driving else None)


def tiles_msg(header: Header, robot: str, session: int, tiles: TileMessage) -> MapTiles:
    """Message of tiles of a robot's map."""
    message = MapTiles(header=header, robot=robot, session=session, layout=MapTiles.LAYOUT)
    message.data.frombytes(tiles.encode())
    return message


def tiles_from_msg(message: MapTiles) -> TileMessage:
    """Tiles of a message. Raises InputError where it is invalid."""
    _name(message.robot)
    messages.require_layout(message)
    return TileMessage.decode(message.data.tobytes())


def _name(name: str) -> str:
    """Name of a robot. Raises InputError where it is empty or too long."""
    if not 0 < len(name) <= _MAX_NAME:
        raise InputError(f'robot {quoted(name)}: expected a name of 1 to {_MAX_NAME} characters')
    return name


def _pose(name: str, message: Pose) -> Array:
    """Pose (3,) of a robot. Raises InputError where it is none."""
    try:
        return messages.pose_from_msg(message)
    except InputError as error:
        raise InputError(f'claim of robot {quoted(name)}: {error}') from error


def _point_msg(place: Place | None) -> Point32:
    x, y = place or _SOMEWHERE
    return Point32(x=float(x), y=float(y))


def _moved(T: Array, places: Sequence[Place]) -> list[Place]:
    points = se2.transform_points(T, np.array(places).reshape(-1, 2))
    return [(float(x), float(y)) for x, y in points]


def _moved_place(T: Array, place: Place | None) -> Place | None:
    return None if place is None else _moved(T, [place])[0]


CLAIMS = '/team/claims'


class HeardRobots:
    """Newest claim of each other robot; those of robots that are not joined are only kept.

    name: of this robot; places: where the maps of the others lie.
    """

    def __init__(
        self,
        node: ThinmapNode,
        places: JoinedPlaces,
        name: str,
        silence: SilenceConfig,
        heard: Callable[[RobotClaim], bool] = lambda claim: True,
    ) -> None:
        """heard: is called with each claim, and says whether to keep it."""
        self._node = node
        self.places = places
        self.name = name
        self._accepts = heard
        self._heard: Heard[RobotClaim] = Heard(silence)
        subscribe_guarded(node, TeamClaim, CLAIMS, self._on_claim, qos.SENSOR)

    def motions(self) -> list[HeardMotion]:
        """Motions of the robots that are joined and were heard lately, in this robot's map."""
        return [
            HeardMotion(heard.in_map(self.places.poses[heard.claim.robot]).motion, age_s)
            for heard, age_s in self._lately()
            if heard.claim.robot in self.places.poses
        ]

    def own_motions(self) -> list[HeardMotion]:
        """Motions of all robots that were heard lately, joined or not, each in its own map."""
        return [HeardMotion(heard.motion, age_s) for heard, age_s in self._lately()]

    def _lately(self) -> list[tuple[RobotClaim, float]]:
        return self._heard.lately(self._node.elapsed_time.now_ns())

    def _on_claim(self, message: TeamClaim) -> None:
        claim = claim_from_msg(message)
        name = claim.claim.robot
        if self._accepts(claim) and name != self.name:
            self._heard.add(name, claim, self._node.elapsed_time.now_ns())


def heard_robots(node: ThinmapNode) -> HeardRobots | None:
    """The other robots of the node's team, None without a team; declares the parameters."""
    membership = declare_membership(node)
    silence = parameters.declare_config(node, SilenceConfig)
    if not membership.team:
        return None
    name = membership.team_name
    return HeardRobots(node, JoinedPlaces(node, name), name, silence)


TILES = '/team/tiles'
REQUESTS = '/team/tile_requests'


class TileReceiver:
    """Receives the tiles of the other robots, and asks for those that were missed."""

    def __init__(self, node: ThinmapNode, places: JoinedPlaces, name: str) -> None:
        """name: of this robot."""
        self._node = node
        self._places = places
        self._name = name
        self._maps = JoinedMaps()
        self._requests = node.create_publisher(TileRequest, REQUESTS, qos.STREAM)
        subscribe_guarded(node, MapTiles, TILES, self._on_tiles, qos.TILES)

    def completed(self, own: GridPatch) -> GridPatch:
        """The map of this robot, and what others know where it is undecided.

        The map itself where it would be too large, with a warning.
        """
        self._maps.place(self._places.poses)
        try:
            return self._maps.completed(own)
        except InputError as error:
            self._node.get_logger().warning(
                f'maps of other robots are not used: {error}', throttle_duration_sec=WARN_PERIOD_S
            )
            return own

    def take_changes(self) -> list[Array]:
        """Parts (2, 2), m, of the map that others have changed since the last call."""
        return self._maps.take_changes()

    def take_moved(self) -> bool:
        """Whether all of the completed map may have changed since the last call."""
        is_moved = self._maps.is_moved
        self._maps.is_moved = False
        return is_moved

    def _on_tiles(self, message: MapTiles) -> None:
        if message.robot == self._name:
            return
        tiles = tiles_from_msg(message)
        after = self._maps.add(message.robot, message.session, tiles)
        if after is not None:
            header = messages.header('', self._node.now_ns)
            self._requests.publish(
                TileRequest(
                    header=header, robot=message.robot, session=message.session, after=after
                )
            )
