"""Global localization: localized, ambiguous, or in another building.

And reports of missing inputs.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.small_floor import CELL_M, OFFICE, START, WAY, drive, floor, map_of

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.global_localizer import GlobalLocalization, SearchState
from thinmap_ros.core.topology.graph import TopologicalMap


@pytest.fixture(scope='module')
def finder():
    return GlobalLocalization(*map_of(OFFICE), seed=1)


def run(finder, looks):
    finder.restart()
    return [(finder.step(scan, odometry), T) for scan, odometry, T in looks]


def is_right(hypothesis, T):
    off = se2.between(T, hypothesis.T_map_base)
    return np.hypot(off[0], off[1]) < 0.3 and abs(off[2]) < np.radians(10.0)


@pytest.mark.parametrize('start', [START, (3.2, 6.7, -2.0), (6.2, 7.0, -0.5)])
def test_a_robot_switched_on_anywhere_is_found_and_never_wrongly_sure(finder, start):
    results = run(finder, drive(OFFICE, start, WAY if start == START else [(0.1, 0.05)] * 25))
    sure = [(result.pose, T) for result, T in results if result.state == SearchState.LOCALIZED]
    assert sure, results[-1][0].reason
    assert all(is_right(pose, T) for pose, T in sure)
    for pose, _ in sure:
        assert np.linalg.eigvalsh(pose.covariance).min() > 0.0
        assert np.sqrt(pose.covariance[:2, :2].trace()) < 0.3


def test_scans_may_have_different_numbers_of_beams(finder):
    """As those of an interlaced laser."""
    looks = []
    for k, (scan, odometry, T) in enumerate(drive(OFFICE, START, WAY)):
        first = scan.angle_min_rad + (k % 4) * scan.angle_increment_rad
        fewer = replace(scan, ranges_m=scan.ranges_m[k % 4 :], angle_min_rad=first)
        looks.append((fewer, odometry, T))
    results = run(finder, looks)
    sure = [(result.pose, T) for result, T in results if result.state == SearchState.LOCALIZED]
    assert sure and all(is_right(pose, T) for pose, T in sure)


def test_the_same_seed_gives_the_same_answers():
    first, second = (
        run(GlobalLocalization(*map_of(OFFICE), seed=5), drive(OFFICE, START, WAY[:6]))
        for _ in range(2)
    )
    for (one, _), (other, _) in zip(first, second, strict=True):
        assert [h.weight for h in one.hypotheses] == [h.weight for h in other.hypotheses]
        poses = [[h.T_map_base.tolist() for h in result.hypotheses] for result in (one, other)]
        assert poses[0] == poses[1]


def test_once_a_laser_proves_to_drop_out_the_search_starts_again(finder):
    """What its beams without return have said before does not delay it."""
    rng = np.random.default_rng(4)
    looks = []
    for k, (scan, odometry, T) in enumerate(drive(OFFICE, START, WAY)):
        lost = np.repeat(rng.random(-(-scan.ranges_m.size // 6)) < 0.6, 6)[: scan.ranges_m.size]
        ranges = np.where(lost, np.inf, scan.ranges_m)
        looks.append((replace(scan, ranges_m=ranges, drops_out=k > 3), odometry, T))
    late = run(finder, looks)
    known = run(finder, [(replace(scan, drops_out=True), *rest) for scan, *rest in looks[4:]])
    sure = [[r.state == SearchState.LOCALIZED for r, _ in results] for results in (late, known)]
    assert all(is_right(r.pose, T) for r, T in late if r.state == SearchState.LOCALIZED)
    assert sure[0].index(True) <= sure[1].index(True) + 4 + 2


def test_a_robot_that_stands_still_is_not_sure(finder):
    looks = list(drive(OFFICE, START, [(0.0, 0.0)] * 15))
    assert SearchState.LOCALIZED not in [result.state for result, _ in run(finder, looks)]


def test_twin_rooms_stay_equally_likely():
    room = floor((20, 15, 26, 22), (44, 30, 60, 33), rows=60, cols=45)
    cells = np.concatenate([room, np.full((60, 3), 100, dtype=np.int8), room], axis=1)
    results = run(GlobalLocalization(*map_of(cells)), drive(cells, (1.45, 3.0, 1.5), WAY))
    for result, T in results:
        assert result.state == SearchState.AMBIGUOUS
        first, second = result.hypotheses[:2]
        assert abs(first.weight - second.weight) < 0.1
        assert is_right(first, T) or is_right(second, T)


def test_a_floor_that_looks_the_same_when_turned_by_180_degrees_stays_ambiguous():
    half = floor((0, 30, 35, 32), (40, 10, 45, 18), (8, 70, 12, 76))
    turned = np.maximum(half, half[::-1, ::-1])
    for result, T in run(GlobalLocalization(*map_of(turned)), drive(turned, START, WAY[:20])):
        assert result.state == SearchState.AMBIGUOUS
        first, second = result.hypotheses[:2]
        assert abs(first.weight - second.weight) < 0.1
        assert is_right(first, T) or is_right(second, T)
        middle = (7.0, 10.0, np.pi)  # twice the centre of the floor
        assert is_right(second, np.array(middle) + first.T_map_base * (-1.0, -1.0, 1.0))


def test_a_robot_in_another_building_is_told_so():
    other = floor((15, 0, 18, 50), (30, 30, 33, 90), (42, 0, 45, 60), rows=60, cols=90)
    way = [(0.15, 0.0)] * 20 + [(0.0, 0.4)] * 4 + [(0.15, 0.0)] * 15
    results = run(GlobalLocalization(*map_of(OFFICE)), drive(other, (-0.2, 2.7, 0.0), way))
    states = [result.state for result, _ in results]
    assert SearchState.NOT_IN_MAP in states
    assert SearchState.LOCALIZED not in states


def test_a_robot_that_would_have_left_half_a_map_is_told_that_it_is_not_in_it():
    """Places that have moved to where nothing is mapped, and late ones, do not count."""
    half = OFFICE.copy()
    half[:, 45:] = -1
    other = floor((15, 0, 18, 50), (30, 30, 33, 90), (42, 0, 45, 60), rows=60, cols=90)
    ahead = [(0.15, 0.0)]
    turn = [(0.0, 0.4)] * 4
    way = [*ahead * 30, *turn, *ahead * 15, *turn, *ahead * 30]
    results = run(GlobalLocalization(*map_of(half), seed=1), drive(other, (-0.2, 2.7, 0.0), way))
    states = [result.state for result, _ in results]
    assert states[-1] == SearchState.NOT_IN_MAP
    assert SearchState.LOCALIZED not in states


def test_a_pose_found_is_followed_and_a_robot_carried_off_is_found_again(finder):
    before = list(drive(OFFICE, START, WAY))
    after = [
        (scan, se2.compose(before[-1][1], se2.between(se2.pose(5.0, -3.0, 0.7), odometry)), T)
        for scan, odometry, T in drive(OFFICE, (6.2, 7.0, -0.5), [(0.15, 0.05)] * 30)
    ]
    results = run(finder, before + after)
    assert results[len(before) - 1][0].state == SearchState.LOCALIZED
    wrong = [
        T for result, T in results[len(before) :] if result.pose and not is_right(result.pose, T)
    ]
    assert len(wrong) <= 3  # until the first observations there
    assert results[-1][0].state != SearchState.LOCALIZED or is_right(
        results[-1][0].pose, results[-1][1]
    )


def test_what_is_wrong_with_a_scan_or_the_odometry_is_said_and_waited_for(finder):
    (scan, odometry, _), *rest = list(drive(OFFICE, START, WAY))
    finder.restart()
    result = finder.step(scan, np.array([0.0, np.nan, 0.0]))
    assert result.state == SearchState.WAITING
    assert 'odometry' in result.reason
    blind = replace(scan, ranges_m=np.full(scan.ranges_m.size, np.nan))
    result = finder.step(blind, odometry)
    assert result.state == SearchState.WAITING
    assert 'beam' in result.reason
    finder.step(scan, odometry)
    result = finder.step(rest[0][0], odometry + (40.0, 0.0, 0.0))
    assert result.state == SearchState.WAITING
    assert 'jumped' in result.reason
    jumped = [finder.step(s, o + (40.0, 0.0, 0.0)) for s, o, _ in rest[1:]]
    numbers = [
        [*h.T_map_base, *h.covariance.ravel(), h.weight] for r in jumped for h in r.hypotheses
    ]
    assert np.isfinite(numbers).all()


def test_a_scan_that_meets_nothing_leaves_all_open(finder):
    scans = list(drive(OFFICE, START, WAY[:5]))
    open_field = [
        (replace(s, ranges_m=np.full(s.ranges_m.size, np.inf)), o, T) for s, o, T in scans
    ]
    results = run(finder, open_field)
    assert {result.state for result, _ in results} == {SearchState.SEARCHING}
    assert len(finder.samples) == finder.config.samples


def test_a_map_that_is_of_no_use_is_refused_in_words():
    patch, topology = map_of(OFFICE)
    with pytest.raises(InputError, match='topology without nodes'):
        GlobalLocalization(patch, TopologicalMap())
    with pytest.raises(InputError, match='expected walls'):
        GlobalLocalization(GridPatch(patch.frame, np.zeros((20, 20), dtype=np.int8)), topology)
    with pytest.raises(InputError, match='no free place'):
        GlobalLocalization(GridPatch(patch.frame, np.full((20, 20), 100, dtype=np.int8)), topology)


def test_the_map_takes_little_memory(finder):
    assert finder.places.memory_bytes() < 40 * OFFICE.size
    assert finder.places.frame.resolution == CELL_M
