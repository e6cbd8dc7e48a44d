"""Messages between robots of a team, there and back, and what is refused."""

import math
import struct
import zlib
from functools import reduce

import numpy as np
import pytest

from thinmap_msgs.msg import MapTiles, TeamClaim
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.team import MAX_SETTLED, Claim, SettledPlace
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.shared import TileSender
from thinmap_ros.core.planning.path_follower import Motion
from thinmap_ros.ros import messages
from thinmap_ros.ros.team import (
    RobotClaim,
    RobotState,
    claim_from_msg,
    claim_msg,
    tiles_from_msg,
    tiles_msg,
)

POSE = se2.pose(1.0, 2.0, 0.5)


def claimed(state=RobotState.DRIVING, visits=1):
    place = (3.0, 4.0) if state is RobotState.DRIVING else None
    settled = (SettledPlace(5.0, 6.0, visits, 2),) * MAX_SETTLED
    claim = Claim('/a', 7, POSE, place, 2.5, settled)
    return RobotClaim(claim, Motion('/a', POSE, 0.5, -0.25), state, 9, place)


@pytest.mark.parametrize('state', RobotState)
def test_a_claim_arrives_as_it_was(state):
    sent = claimed(state)
    found = claim_from_msg(claim_msg(sent, 'map'))
    assert found.claim.pose == pytest.approx(POSE, abs=1e-12)
    for name in ('robot', 'stamp_ns', 'place', 'remaining_s', 'settled'):
        assert getattr(found.claim, name) == getattr(sent.claim, name), name
    assert (found.motion.v, found.motion.w) == (0.5, -0.25)
    assert (found.state, found.session, found.goal) == (state, 9, sent.goal)
    assert getattr(TeamClaim, state.name) == state


def test_counts_beyond_those_of_the_message_are_its_largest():
    found = claim_from_msg(claim_msg(claimed(visits=1000), 'map'))
    assert found.claim.settled[0].visits == 255


def test_a_claim_is_moved_with_the_map_of_its_robot():
    T = se2.pose(10.0, 0.0, math.pi / 2)
    moved = claimed().in_map(T)
    assert moved.claim.pose == pytest.approx(se2.compose(T, POSE))
    assert moved.motion.pose == pytest.approx(se2.compose(T, POSE))
    assert moved.claim.place == pytest.approx((6.0, 3.0))
    assert moved.goal == pytest.approx((6.0, 3.0))
    assert moved.claim.settled[0][:2] == pytest.approx((4.0, 5.0))
    assert moved.claim.settled[0][2:] == (1, 2)


def damaged(**values):
    message = claim_msg(claimed(), 'map')
    for name, value in values.items():
        *owners, field = name.split('__')
        setattr(reduce(getattr, owners, message), field, value)
    return message


@pytest.mark.parametrize(
    ('values', 'named'),
    [
        ({'robot': ''}, "robot ''"),
        ({'robot': 'x' * 201}, 'robot'),
        ({'state': 4}, 'state 4'),
        ({'pose__position__x': math.nan}, "robot '/a': "),
        ({'pose__orientation__z': math.inf}, "robot '/a': "),
        ({'pose__orientation__w': 0.0, 'pose__orientation__z': 0.0}, "robot '/a': "),
        ({'goal__y': math.nan}, 'place: nan'),
        ({'frontier__x': 1e30}, 'place: 1'),
        ({'v': math.inf}, 'speed: inf'),
        ({'w': math.nan}, 'speed: nan'),
        ({'remaining_s': math.nan}, 'time: nan'),
    ],
)
def test_a_claim_with_a_wrong_value_is_refused_in_one_line(values, named):
    with pytest.raises(InputError) as caught:
        claim_from_msg(damaged(**values))
    assert named in str(caught.value) and '\n' not in str(caught.value)
    assert 'expected' in str(caught.value)


def test_a_claim_with_a_settled_place_that_is_none_is_refused():
    message = claim_msg(claimed(), 'map')
    message.settled[3].y = math.nan
    with pytest.raises(InputError, match='place: nan'):
        claim_from_msg(message)


def test_a_claim_with_too_many_settled_places_is_refused():
    message = claim_msg(claimed(), 'map')
    message.settled = [*message.settled, message.settled[0]]
    with pytest.raises(InputError, match='9 settled places: expected 8 at most'):
        claim_from_msg(message)


def test_tiles_arrive_and_damaged_ones_are_refused():
    patch = GridPatch(GridFrame(0.5, 0.0, 0.1), np.zeros((20, 20), dtype=np.int8))
    sender = TileSender(patch.frame)
    sender.update(patch)
    message = tiles_msg(messages.header('map', 1), '/a', 3, sender.changes_after(0))
    assert (message.robot, message.session) == ('/a', 3)
    assert tiles_from_msg(message).tiles == sender.changes_after(0).tiles
    with pytest.raises(InputError, match='expected a name'):
        tiles_from_msg(MapTiles(layout=1, data=message.data))
    with pytest.raises(InputError, match='map tiles'):
        tiles_from_msg(MapTiles(robot='/a', layout=1, data=message.data[:-9]))
    with pytest.raises(InputError, match='map tiles'):
        tiles_from_msg(MapTiles(robot='/a', layout=1))
    with pytest.raises(InputError, match='MapTiles of layout 2: expected 1: is its robot of'):
        tiles_from_msg(MapTiles(robot='/a', layout=2, data=message.data))


def test_the_bytes_of_tiles_have_the_documented_layout():
    cells = np.full((20, 20), -1, dtype=np.int8)
    cells[1, 2:6] = (0, 100, 50, -1)
    patch = GridPatch(GridFrame(0.5, -1.0, 0.1), cells)
    sender = TileSender(patch.frame)
    sender.update(patch)
    message = tiles_msg(messages.header('map', 1), '/a', 3, sender.changes_after(0))
    assert message.layout == MapTiles.LAYOUT == 1
    plain = zlib.decompress(bytes(message.data))
    assert struct.unpack_from('<3I3d2i', plain) == (0, 1, 1, 0.5, -1.0, 0.1, 0, 0)
    packed = np.frombuffer(plain[44:], dtype=np.uint8)
    assert packed.size == 64
    bits = (packed[:, None] >> np.array([0, 2, 4, 6]) & 3).reshape(16, 16)
    assert bits[1, 2:6].tolist() == [1, 2, 3, 0]
    assert np.count_nonzero(bits) == 3
