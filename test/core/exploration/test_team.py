"""A robot's share of the candidates, what it tells the others, and what it hears from them."""

import math
from functools import cache

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.belief import Evidence
from thinmap_ros.core.exploration.candidates import Candidate
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID
from thinmap_ros.core.exploration.team import Claim, SettledPlace, Team, TeamConfig
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.navigator import NO_PATH
from thinmap_ros.core.planning.path_follower import SpeedConfig
from thinmap_ros.core.planning.travel_times import TravelTimes
from thinmap_ros.core.planning.wavefront import WavefrontConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.core.topology.topology import TopologyBuilder

MARGIN_S = 2.0


def candidate(x, y=0.0):
    evidence = Evidence(FIRST_FRONTIER_ID, (x, y))
    cells = np.zeros((1, 2), dtype=np.int64)
    return Candidate(evidence, cells, (x, y), goal=se2.pose(x, y, 0.0))


@cache
def travel():
    """A hall of 60 x 10 m, in which a metre takes a second."""
    frame = GridFrame(-30.0, -5.0, 0.1)
    free = np.ones((100, 600), dtype=np.bool_)
    times = TravelTimes(WavefrontConfig(), SpeedConfig(max_speed_m_s=1.0))
    times.update(free, free, frame, np.zeros(3))
    return times


def claim(robot, x, place=(99.0, 99.0), remaining_s=0.0, stamp_ns=0, settled=()):
    """A claim of a place that no candidate is near to, unless one is given."""
    return Claim(robot, stamp_ns, se2.pose(x, 0.0, 0.0), place, remaining_s, settled)


def shares(candidates, claims, **config):
    """Places that each robot may choose from, when each has heard all others."""
    found = []
    for own in claims:
        team = Team(own.robot, TeamConfig(**config))
        team.sent = own
        for other in claims:
            if other is not own:
                team.add_claim(other, 0)
        found.append([c.middle[0] for c in team.share(candidates, own, travel(), MARGIN_S)])
    return found


def test_a_robot_alone_has_everything_in_its_order():
    candidates = [candidate(3.0), candidate(1.0)]
    assert Team('a').share(candidates, claim('a', 0.0), travel(), MARGIN_S) is candidates


def test_a_robot_that_does_not_explore_takes_nothing():
    candidates = [candidate(1.0), candidate(-8.0)]
    idle = Claim('a', 0, se2.pose(0.0, 0.0, 0.0))
    team = Team('b')
    team.add_claim(idle, 0)
    assert team.share(candidates, claim('b', 0.5), travel(), MARGIN_S) is candidates


def test_two_robots_agree_who_goes_where():
    candidates = [candidate(1.0), candidate(-8.0)]
    assert shares(candidates, [claim('a', 0.0), claim('b', 0.5)]) == [[-8.0], [1.0]]
    assert shares(candidates, [claim('a', 0.5), claim('b', 0.0)]) == [[1.0], [-8.0]]


def test_a_tie_goes_to_the_smaller_name():
    claims = [claim('b', 0.0), claim('a', 0.0)]
    assert shares([candidate(8.0)], claims, follow_m=0.0) == [[], [8.0]]


@pytest.mark.parametrize(('away', 'owner'), [(0.5, 'b'), (2.5, 'a')])
def test_a_claimed_place_belongs_to_its_robot_within_a_margin(away, owner):
    held = claim('b', 0.0, (8.0, 1.0))
    nearer = claim('a', away)
    found = dict(zip('ba', shares([candidate(8.0)], [held, nearer], follow_m=0.0), strict=True))
    assert found[owner] == [8.0]
    assert sum(map(len, found.values())) == 1


def test_two_robots_side_by_side_do_not_drive_to_one_place():
    """Each second they hear where the other was; each sees itself ahead of it."""
    candidates = [candidate(10.0), candidate(-14.0)]
    teams = {name: Team(name, TeamConfig(follow_m=0.0)) for name in 'ab'}
    x = dict.fromkeys(teams, 0.0)
    targets = dict.fromkeys(teams, candidates[0])
    for second in range(8):
        now_ns = second * SECOND_NS
        for name, team in teams.items():
            target = targets[name]
            remaining_s = abs(target.middle[0] - x[name])
            team.sent = claim(name, x[name], target.middle, remaining_s, now_ns + 1)
        for name, team in teams.items():
            team.add_claim(teams['ba'['ab'.index(name)]].sent, now_ns)
        for name, team in teams.items():
            x[name] += math.copysign(0.5, targets[name].middle[0])
            own = claim(name, x[name], targets[name].middle, stamp_ns=now_ns)
            targets[name] = team.share(candidates, own, travel(), MARGIN_S)[0]
    assert [target.middle[0] for target in targets.values()] == [10.0, -14.0]


def test_no_robot_waits_far_from_what_is_left():
    claims = [claim('a', 0.0), claim('b', -1.0)]
    assert shares([candidate(20.0)], claims) == [[20.0], [20.0]]
    assert shares([candidate(20.0)], claims, follow_m=0.0) == [[20.0], []]
    # It stays behind the robot that has the candidate.
    assert shares([candidate(3.0)], claims) == [[3.0], []]


def test_robots_that_stand_or_claim_nothing_do_not_bid():
    team = Team('a')
    for second in range(30):
        now_ns = second * SECOND_NS
        team.add_claim(claim('b', 9.0, (8.0, 0.0), 5.0, now_ns), now_ns)
        team.add_claim(claim('c', 7.9, None, 0.0, now_ns), now_ns)
    own = claim('a', 3.0, None, stamp_ns=29 * SECOND_NS)
    assert team.share([candidate(8.0)], own, travel(), MARGIN_S)
    now_ns = 29 * SECOND_NS
    team.add_claim(claim('c', 7.9, (8.0, 0.0), 0.0, now_ns + 1), now_ns)
    assert not Team('a', TeamConfig(follow_m=0.0)).claims.held(now_ns)
    assert [held.robot for held in team.claims.held(now_ns)] == ['c']


def test_what_one_robot_has_settled_is_settled_for_the_others():
    team = Team('a')
    settled = (SettledPlace(1.0, 0.0, 2, 0), SettledPlace(5.0, 0.0, 0, 3))
    team.add_claim(claim('b', 0.0, settled=settled), 0)
    items = [Evidence(1, (1.2, 0.0)), Evidence(2, (5.0, 0.1))]
    visited = Evidence(3, (5.0, 0.0), visits=1)
    team.apply_settled(items, 0.5, 7)
    assert (items[0].visits, items[0].failures) == (2, 0)
    assert (items[1].visits, items[1].failures, items[1].failed_ns) == (0, 3, 7)
    team.apply_settled([visited], 0.5, 7)
    assert visited.failures == 0


def test_only_the_newest_settled_places_are_told_each_once():
    team = Team('a')
    for number in range(12):
        place = (float(number), 0.0)
        item = Evidence(number, place, visits=1)
        team.add_settled(item)
        item.visits = 2
        team.add_settled(item)
    assert [place.x for place in team.settled] == [4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0]
    assert {place.visits for place in team.settled} == {2}


@pytest.mark.parametrize(
    ('reason', 'is_told'), [(f'{NO_PATH} to (1, 2)', True), ('an obstacle blocks the path', False)]
)
def test_no_path_is_told_and_a_blocked_robot_is_not(reason, is_told):
    explorer = Explorer(team=Team('a'))
    explorer._target.candidate = candidate(4.0)
    assert explorer.claim(0, np.zeros(3)).place == (4.0, 0.0)
    explorer.target_failed(reason)
    told = explorer.claim(0, np.zeros(3)).settled
    assert told == ((SettledPlace(4.0, 0.0, 0, 1),) if is_told else ())


def test_two_robots_of_one_name_are_refused():
    with pytest.raises(InputError, match="claim of robot 'a': expected another name"):
        Team('a').add_claim(claim('a', 0.0), 0)


def test_a_frontier_to_which_another_robot_found_no_path_is_given_up():
    cells = np.full((30, 60), -1, dtype=np.int8)
    cells[:, :30] = 0
    cells[[0, -1], :30] = 100
    cells[:, 0] = 100
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), cells)
    pose = se2.pose(1.0, 1.5, 0.0)
    builder = TopologyBuilder()
    builder.update(patch, pose)
    explorer = Explorer(team=Team('a'))

    def step(second):
        scan = Scan.create(second * SECOND_NS, np.full(181, 2.0), -1.57, 0.0175, 0.05, 8.0)
        return explorer.step(builder.map, patch, scan, pose)

    step(0)
    claimed = explorer.claim(0, pose)
    assert claimed.place is not None
    assert claimed.remaining_s > 0.0
    places = (SettledPlace(c.middle[0], c.middle[1], 0, 3) for c in explorer.candidates)
    explorer.team.add_claim(claim('b', 9.0, settled=tuple(places)), 0)
    step(2)
    assert explorer.claim(0, pose).place is None
