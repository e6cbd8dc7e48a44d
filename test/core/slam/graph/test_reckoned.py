"""The odds that a piece that is apart lies where dead reckoning has it."""

import numpy as np
import pytest

from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.graph.reckoned import RETURNS, Reckoned, Search, look_log_ratio

SEARCH = Search(2.0, 0.5)
EXACT = np.diag([0.05**2, 0.05**2, 0.02**2])


def edge(number):
    return Edge(0, number, np.zeros(3), np.eye(3), True)


def begun(log_odds=0.0):
    return Reckoned(log_odds, np.zeros(3), np.diag([0.1**2, 0.1**2, 0.02**2]), 0.0)


def at(x_m):
    return np.array([x_m, 0.0])


def test_a_match_where_dead_reckoning_has_it_speaks_for_it_and_another_against_it():
    on = look_log_ratio(np.zeros(3), EXACT, SEARCH)
    off = look_log_ratio(np.array([1.0, 0.0, 0.0]), EXACT, SEARCH)
    assert on == pytest.approx(6.0) and off < 0.0


def test_a_wider_search_makes_a_match_at_the_place_more_telling_and_drift_less():
    covariance = 100.0 * EXACT
    near = look_log_ratio(np.zeros(3), covariance, SEARCH)
    assert look_log_ratio(np.zeros(3), covariance, Search(4.0, 0.5)) > near
    assert look_log_ratio(np.zeros(3), 2.0 * covariance, SEARCH) < near


def test_looks_from_one_place_count_once_and_the_piece_returns_by_those_of_two():
    reckoned = begun(-4.0)
    for number in range(5):
        reckoned.add(at(0.1 * number), edge(number), np.zeros(3), EXACT, SEARCH)
    assert reckoned.log_odds < RETURNS
    assert reckoned.has_looked_from(at(1.0)) and not reckoned.has_looked_from(at(2.0))
    reckoned.add(at(2.0), edge(5), np.zeros(3), EXACT, SEARCH)
    assert reckoned.log_odds >= RETURNS
    assert [each.b for each in reckoned.edges] == [4, 5]


def test_looks_that_find_nothing_speak_against_it_and_leave_no_edge():
    reckoned = begun()
    for k in range(4):
        reckoned.add_contrary(at(1.5 * k))
    assert reckoned.log_odds == pytest.approx(4.0 * np.log(0.2 / 0.5))
    reckoned.add(at(9.0), edge(1), np.array([1.5, 0.0, 0.4]), EXACT, SEARCH)
    assert reckoned.edges == []


def test_the_longer_the_way_the_less_a_match_at_the_place_tells():
    ratios = []
    for path_m in (1.0, 100.0):
        reckoned = begun()
        reckoned.add(at(path_m), edge(1), np.array([0.3, 0.0, 0.0]), EXACT, SEARCH)
        ratios.append(reckoned.log_odds)
    assert ratios[0] > ratios[1]


def test_a_piece_within_a_piece_is_there_only_if_both_are():
    outer = begun(-1.0)
    inner = Reckoned(-2.0, np.array([3.0, 0.0, 0.0]), EXACT, 3.0).within(outer)
    assert inner.log_odds == pytest.approx(-np.logaddexp(1.0, 2.0))


def test_a_piece_that_begins_is_not_sure_of_its_place():
    assert begun(9.0).log_odds == 0.0


@pytest.mark.parametrize(
    ('path_m', 'begin_m', 'is_told'),
    [(1.0, 4.0, True), (3.0, 4.0, False), (91.0, 100.0, True), (93.0, 100.0, False)],
)
def test_keyframes_just_before_the_beginning_tell_nothing(path_m, begin_m, is_told):
    assert Reckoned(0.0, np.zeros(3), EXACT, begin_m).is_told_by(path_m) == is_told


def test_looks_at_one_place_are_kept_once():
    reckoned = begun()
    for k in range(1000):
        reckoned.add_contrary(at(0.01 * k))
    assert len(reckoned._looks) <= 11
