"""The census of end nodes, and the summary metrics of an exploration."""

import json

import numpy as np
import pytest

from thinmap_ros.closed_loop.loop import ExplorationOutcome
from thinmap_ros.core.exploration.belief import MissingArea
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID
from thinmap_ros.evaluation.exploration_metrics import (
    MIN_OBSERVATIONS,
    EndNodeCensus,
    TargetLog,
    exploration_report,
    hidden_places,
    missing_area_report,
)

AFAR = np.array([100.0, 100.0, 0.0])


def census_of(*decisions, pose=AFAR):
    census = EndNodeCensus()
    for nodes in decisions:
        census.add(nodes, pose)
    return census


def test_an_end_node_that_flickers_under_new_ids_is_one_place():
    decisions = [[(i, 1.0 + 0.1 * (i % 2), 1.0)] for i in range(1, 40)]
    assert census_of(*decisions).seen == 1


def test_an_end_node_that_wanders_down_a_corridor_is_one_place():
    assert census_of(*([(1, 0.2 * i, 0.0)] for i in range(60))).seen == 1


def test_two_at_once_are_two_places_however_near():
    assert census_of(*([[(1, 0.0, 0.0), (2, 0.4, 0.0)]] * 10)).seen == 2


def test_what_did_not_last_is_not_counted():
    blink = (1, 5.0, 5.0)
    stay = (2, 0.0, 0.0)
    decisions = [[blink, stay]] * (MIN_OBSERVATIONS - 1) + [[stay]]
    assert census_of(*decisions).seen == 1


def test_what_stands_in_for_a_border_is_no_end_node():
    assert census_of(*([[(FIRST_FRONTIER_ID, 0.0, 0.0), (1, 5.0, 5.0)]] * 10)).seen == 1


def test_a_visit_is_nearer_than_half_a_metre():
    census = census_of(*([[(1, 100.4, 100.0), (2, 100.6, 100.0)]] * 10))
    assert (census.seen, census.visited) == (2, 1)


def report_of(coverage, census=None):
    times = np.arange(0.0, 10.1, 0.5)
    poses = np.column_stack([0.5 * times, 0.0 * times, 0.1 * times])
    return exploration_report(
        ExplorationOutcome(True, 'done', 0),
        times,
        poses,
        poses + (0.0, 0.03, 0.0),
        np.array(coverage),
        census or EndNodeCensus(),
    )


def test_distance_time_and_error_are_those_of_the_path():
    report = report_of([(0.0, 0.1), (4.0, 0.93), (10.0, 0.985)])
    assert report['distance'] == pytest.approx(5.0)
    assert report['time'] == pytest.approx(10.0)
    assert report['pose_rmse'] == pytest.approx(0.03)
    assert report['turned_rad'] == pytest.approx(1.0)
    assert report['error_curve'] == [[0.0, 0.03], [4.0, 0.03], [10.0, 0.03]]
    # A shift of the whole path is an error of the start, not of its shape.
    assert report['pose_rmse_aligned'] == pytest.approx(0.0, abs=1e-5)


def test_milestones_are_when_a_coverage_was_first_measured_and_none_where_it_never_was():
    report = report_of([(0.0, 0.1), (4.0, 0.93), (6.0, 0.951), (8.0, 0.94), (10.0, 0.985)])
    assert report['time_at'] == {'0.90': 4.0, '0.95': 6.0, '0.98': 10.0, '0.99': None}
    assert report['distance_at'] == {'0.90': 2.0, '0.95': 3.0, '0.98': 5.0, '0.99': None}
    json.dumps(report)


@pytest.mark.parametrize(
    ('places', 'changes', 'reversals'),
    [
        ([0.0, 0.3, 0.6, None, 0.5], 0, 0),
        ([0.0, 5.0, 10.0], 2, 0),
        ([0.0, 5.0, 0.2, 5.1, 9.0], 4, 2),
    ],
)
def test_a_target_that_goes_back_to_the_one_before_is_a_reversal(places, changes, reversals):
    log = TargetLog()
    for place in places:
        log.add(None if place is None else np.array([place, 1.0, 0.0]))
    assert (log.changes, log.reversals) == (changes, reversals)


def test_what_is_probably_missing_is_told_where_it_is_worth_seeing():
    hidden = [(1.0, 2.0, 0.2), (3.0, 4.0, 2.0), (5.0, 6.0, 7.26)]
    report = {'missing_area': missing_area_report(MissingArea(9.46, 20.0), hidden)}
    assert report['missing_area']['expected_m2'] == 9.5
    assert report['missing_area']['bound_95_m2'] == 20.0
    assert hidden_places(report).tolist() == [[5.0, 6.0, 7.3], [3.0, 4.0, 2.0]]
    assert missing_area_report(None, hidden) is None
    assert hidden_places({'missing_area': None}).shape == (0, 3)
