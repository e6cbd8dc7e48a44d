"""Messages between robots that explore together: claims, and tiles of their maps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from geometry_msgs.msg import Point32, Pose
from std_msgs.msg import Header

from thinmap_msgs.msg import MapTiles, TeamClaim, TileRequest
from thinmap_msgs.msg import SettledPlace as SettledPlaceMsg
from thinmap_ros.core import errors, se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.exploration.team import MAX_SETTLED, Claim, Place, SettledPlace
from thinmap_ros.core.grid.shared import TileMessage
from thinmap_ros.core.planning.path_follower import Motion
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import messages

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
        remaining_m=claim.remaining_m,
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
    errors.require_bounded(f'claim of robot {quoted(name)}: path', [message.remaining_m])
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
        max(float(message.remaining_m), 0.0),
        tuple(SettledPlace(p.x, p.y, p.visits, p.failures) for p in message.settled),
        state in (RobotState.DRIVING, RobotState.WAITING),
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


def request_msg(header: Header, robot: str, session: int, after: int) -> TileRequest:
    """Message that asks a robot for the tiles after a version."""
    return TileRequest(header=header, robot=robot, session=session, after=after)


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
