"""Claims of other robots, and when they end."""

import numpy as np

from thinmap_ros.core.exploration.team import Claim, Claims
from thinmap_ros.core.se2 import SECOND_NS


def claim(robot, second, remaining_s=5.0, place=(1.0, 2.0)):
    return Claim(robot, second * SECOND_NS, np.zeros(3), place, remaining_s)


def place_of(claims, robot, second):
    held = [c.place for c in claims.held(second * SECOND_NS) if c.robot == robot]
    return held[0] if held else None


def test_a_robot_that_is_silent_is_neither_bidder_nor_owner():
    claims = Claims()
    claims.add(claim('b', 0), 0)
    claims.add(claim('a', 0), 0)
    assert [c.robot for c in claims.present(15 * SECOND_NS)] == ['a', 'b']
    assert place_of(claims, 'a', 15) == (1.0, 2.0)
    assert claims.present(16 * SECOND_NS) == []
    assert place_of(claims, 'a', 16) is None


def test_a_claim_ends_without_progress():
    claims = Claims()
    for second in range(30):
        claims.add(claim('drives', second, 20.0 - 0.5 * second), second * SECOND_NS)
        claims.add(claim('stands', second, 20.0), second * SECOND_NS)
    assert len(claims.present(29 * SECOND_NS)) == 2
    assert place_of(claims, 'drives', 29) == (1.0, 2.0)
    assert place_of(claims, 'stands', 29) is None


def test_a_time_that_is_not_known_yet_is_no_least_one():
    claims = Claims()
    for second in range(30):
        claims.add(claim('drives', second, second and 20.0 - 0.5 * second), second * SECOND_NS)
        claims.add(claim('knows no time', second, 0.0), second * SECOND_NS)
    assert place_of(claims, 'drives', 29) == (1.0, 2.0)
    assert place_of(claims, 'knows no time', 29) is None


def test_another_place_is_a_new_claim():
    claims = Claims()
    for second in range(30):
        place = (1.0, 2.0) if second < 15 else (1.6, 2.0)
        claims.add(claim('a', second, 20.0, place), second * SECOND_NS)
    assert place_of(claims, 'a', 29) == (1.6, 2.0)
    claims.add(claim('a', 30, 0.0, None), 30 * SECOND_NS)
    assert place_of(claims, 'a', 30) is None


def test_an_older_claim_is_ignored_unless_the_robot_may_have_restarted():
    claims = Claims()
    claims.add(claim('a', 100, place=(9.0, 9.0)), 0)
    claims.add(claim('a', 99), SECOND_NS)
    assert place_of(claims, 'a', 1) == (9.0, 9.0)
    claims.add(claim('a', 0), 20 * SECOND_NS)
    assert place_of(claims, 'a', 20) == (1.0, 2.0)


def test_stamps_of_two_robots_are_never_compared():
    claims = Claims()
    claims.add(claim('a', 1000), 0)
    claims.add(claim('b', 10), 0)
    assert len(claims.present(0)) == 2
