"""The auction: one candidate for each robot, the shortest time first; claims and ties."""

import itertools

import numpy as np
import pytest

from thinmap_ros.core.exploration.team import NOTHING, auction

MARGIN_S = 2.0


def won(seconds, claimed=None, told=None):
    """Candidate of each robot; told: remaining times as told, those of the seconds by itself."""
    seconds = np.array(seconds, dtype=np.float64)
    claimed = np.array([NOTHING] * len(seconds) if claimed is None else claimed)
    told = seconds[range(len(seconds)), claimed] if told is None else np.array(told)
    return auction(seconds, claimed, told, MARGIN_S).tolist()


def test_the_second_robot_gets_the_second_candidate():
    assert won([[1.0, 2.0], [1.5, 9.0]]) == [0, 1]
    assert won([[1.5, 9.0], [1.0, 2.0]]) == [1, 0]


def test_each_robot_has_one_candidate_as_long_as_there_are_any():
    rng = np.random.default_rng(3)
    for robots, count in itertools.product((1, 2, 5), (1, 3, 5, 8)):
        found = [i for i in won(rng.uniform(1.0, 30.0, (robots, count))) if i != NOTHING]
        assert len(found) == len(set(found)) == min(robots, count)


@pytest.mark.parametrize(('sooner_s', 'owner'), [(1.0, 0), (3.0, 1)])
def test_a_claim_holds_unless_another_robot_is_clearly_sooner_there(sooner_s, owner):
    found = won([[10.0], [10.0 - sooner_s]], [0, NOTHING])
    assert found[owner] == 0


def test_equal_times_have_one_winner():
    assert won([[5.0], [5.08]]) == [0, NOTHING]
    assert won([[5.08], [5.0]]) == [0, NOTHING]
    assert won([[5.0], [4.8]]) == [NOTHING, 0]


def test_of_two_that_claim_one_place_the_one_that_is_clearly_sooner_there_keeps_its_claim():
    # Without claims both the far candidate and the near one would go to the first robot's rival.
    assert won([[8.0, 9.0], [5.0, 4.9]], [0, 0]) == [1, 0]
    assert won([[5.0, 4.9], [6.0, 7.0]], [0, 0]) == [0, 1]


def test_which_of_two_is_sooner_there_is_decided_by_what_both_have_told():
    # Each knows its own pose earlier than that of the other, and sees itself ahead. What they have
    # told is some seconds old: a small difference is none.
    seen_by_first = [[5.5, 9.0], [6.0, 9.0]]
    seen_by_second = [[6.0, 9.0], [5.5, 9.0]]
    for told, expected in (([6.0, 8.1], [0, 1]), ([8.1, 6.0], [1, 0]), ([6.5, 6.0], [0, 1])):
        assert won(seen_by_first, [0, 0], told) == expected
        assert won(seen_by_second, [0, 0], told) == expected
