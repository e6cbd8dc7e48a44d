"""A kidnapped robot maps a piece apart, and joins it where it recognizes the place."""

import math
from itertools import islice

import numpy as np
import pytest
from support.carried_robot import carried

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.places.place_odds import JOIN_ODDS
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import LOCALIZATION, Destination, config_at


def localized(moments):
    """Each moment's estimate with the error of its position, m."""
    localizer = Localizer()
    T_world_map = None
    found = []
    for moment in moments:
        if T_world_map is None:
            T_world_map = moment.T_world_base
        estimate = localizer.step(moment.scan, moment.T_odom_base)
        T_world_base = se2.compose(T_world_map, estimate.T_map_base)
        off_m = float(np.hypot(*(T_world_base - moment.T_world_base)[:2]))
        found.append((moment.drive, estimate, off_m))
    return found


def is_mapped(estimate):
    return not (estimate.is_lost or estimate.is_contradicted)


def test_a_robot_that_was_carried_off_joins_its_map_where_it_is():
    found = localized(carried((9, 0, 60.0), (9, 1, 70.0)))
    later = [(estimate, off_m) for drive, estimate, off_m in found if drive == 1]
    assert any(estimate.is_mapping_apart for estimate, _ in later)
    assert all(off_m < 0.5 for estimate, off_m in later if is_mapped(estimate))
    last, off_m = later[-1]
    assert is_mapped(last) and off_m < 0.1
    joins = [e.correction.join for e, _ in later if e.correction is not None]
    assert len(joins) == 1
    assert joins[0].log_odds > math.log(JOIN_ODDS) and joins[0].links > 10
    assert 15.0 < joins[0].path_m < 70.0


def test_a_robot_that_was_carried_into_another_building_stays_apart():
    found = localized(carried((3, 0, 60.0), (4, 1, 60.0)))
    _, last, _ = found[-1]
    assert last.apart is not None
    assert last.apart.path_m > 40.0 and last.apart.log_odds < math.log(JOIN_ODDS)
    assert all(estimate.correction is None for drive, estimate, _ in found if drive == 1)


def test_a_session_is_not_changed_from_an_unknown_start_until_the_robot_recognizes_its_place():
    """Where it is, scans fit at the start pose by chance for the first metres."""
    localizer = Localizer()
    session = list(carried((9, 0, 70.0)))
    for moment in session:
        localizer.step(moment.scan, moment.T_odom_base)
    T_world_map = session[0].T_world_base
    state = localizer.state()
    continued = Localizer.from_state(state, keyframes=localizer.saved_keyframes())
    before = [frame.T_map_base for frame in continued.keyframes]
    waiting = []
    later = []
    for moment in carried((9, 1, 60.0)):
        estimate = continued.step(moment.scan, moment.T_odom_base)
        T_world_base = se2.compose(T_world_map, estimate.T_map_base)
        off_m = float(np.hypot(*(T_world_base - moment.T_world_base)[:2]))
        if is_mapped(estimate) or later:
            later.append((estimate, off_m))
            continue
        waiting.append(estimate)
        poses = [frame.T_map_base for frame in continued.keyframes[: len(before)]]
        np.testing.assert_array_equal(poses, before)
        if len(waiting) == 200:
            for name, array in continued.state().items():
                np.testing.assert_array_equal(array, state[name])
    assert len(waiting) > 200
    assert Destination.OPEN in [estimate.destination for estimate in waiting[:100]]
    assert waiting[-1].is_mapping_apart
    assert all(off_m < 0.5 for estimate, off_m in later if is_mapped(estimate))
    last, off_m = later[-1]
    assert is_mapped(last) and off_m < 0.1


@pytest.fixture(scope='module')
def session():
    """State and keyframes of a map, and the pose (3,) of its frame in the world."""
    localizer = Localizer()
    moments = list(carried((2, 0, 70.0)))
    for moment in moments:
        localizer.step(moment.scan, moment.T_odom_base)
    return localizer.state(), localizer.saved_keyframes(), moments[0].T_world_base


@pytest.mark.parametrize(
    ('off', 'is_right'),
    [((0.0, 0.0, 0.0), True), ((0.0, 0.0, np.pi), False), ((5.0, 3.0, 1.0), False)],
)
def test_a_start_that_was_given_wrong_is_not_drawn(session, off, is_right):
    """Turned by half a turn, or in another room; one that is right is mapped at once."""
    state, keyframes, T_world_map = session
    moments = list(islice(carried((2, 1, 30.0)), 150))
    start = se2.between(T_world_map, moments[0].T_world_base) + np.array(off)
    localizer = Localizer.from_state(
        state, config_at(LocalizerConfig(), start), keyframes=keyframes
    )
    estimates = [localizer.step(moment.scan, moment.T_odom_base) for moment in moments]
    drawn = [is_mapped(estimate) for estimate in estimates]
    assert any(drawn) == is_right
    if is_right:
        assert all(drawn[5:])


@pytest.mark.parametrize('is_given', [False, True])
def test_a_start_at_the_origin_that_is_given_is_mapped_at_once(session, is_given):
    """One that is not given waits until scans fit along the path of a view."""
    state, keyframes, _ = session
    config = config_at(LocalizerConfig(), np.zeros(3)) if is_given else LocalizerConfig()
    localizer = Localizer.from_state(state, config, keyframes=keyframes)
    moments = islice(carried((2, 0, 30.0)), 40)
    estimates = [localizer.step(moment.scan, moment.T_odom_base) for moment in moments]
    assert any(is_mapped(estimate) for estimate in estimates) == is_given


_GIVEN = np.diag([0.25, 0.25, 0.07])


@pytest.mark.parametrize(('turn', 'is_right'), [(0.0, True), (np.pi, False)])
def test_a_pose_that_is_set_wrong_by_half_a_turn_is_not_drawn(session, turn, is_right):
    """While mapping, the robot is in the map, or in a piece of its own."""
    state, keyframes, T_world_map = session
    moments = list(islice(carried((2, 1, 30.0)), 150))
    localizer = Localizer.from_state(state, keyframes=keyframes)
    start = se2.between(T_world_map, moments[0].T_world_base)
    localizer.set_pose(start + [0.0, 0.0, turn], _GIVEN)
    estimates = [localizer.step(moment.scan, moment.T_odom_base) for moment in moments]
    assert any(is_mapped(estimate) for estimate in estimates) == is_right
    assert estimates[-1].is_mapping_apart != is_right


@pytest.mark.parametrize(('turn', 'is_right'), [(0.0, True), (np.pi, False)])
@pytest.mark.parametrize('is_set', [False, True])
def test_in_a_given_map_a_robot_whose_pose_is_given_wrong_by_half_a_turn_is_lost(
    session, turn, is_right, is_set
):
    """At its start, or by a service, as AMCL has it."""
    state, _, T_world_map = session
    moments = list(islice(carried((2, 1, 30.0)), 150))
    start = se2.between(T_world_map, moments[0].T_world_base) + [0.0, 0.0, turn]
    config = LocalizerConfig(mode=LOCALIZATION)
    localizer = Localizer.from_state(state, config if is_set else config_at(config, start))
    if is_set:
        localizer.set_pose(start, _GIVEN)
    lost = [localizer.step(moment.scan, moment.T_odom_base).is_lost for moment in moments]
    assert lost[-1] != is_right
    assert any(lost[5:]) != is_right


@pytest.mark.parametrize('drives', [((3, 0, 30.0), (4, 1, 5.0)), ((2, 0, 25.0), (5, 1, 5.0))])
def test_scans_of_another_place_do_not_change_the_map_until_it_agrees_with_them(drives):
    """Neither those that contradict it, nor, once there is much evidence, those that fit badly."""
    found = localized(carried(*drives))
    later = [estimate for drive, estimate, _ in found if drive == 1]
    assert later[-1].is_mapping_apart


def test_a_robot_on_another_storey_stays_apart_whatever_it_recognizes():
    """It drives on where it was, in what is to be the storey above: all looks alike."""
    localizer = Localizer(LocalizerConfig(map_tag='first'))
    apart = []
    for moment in carried((1, 0, 70.0)):
        estimate = localizer.step(moment.scan, moment.T_odom_base)
        if apart:
            apart.append(estimate)
        elif len(localizer.keyframes) > 40:
            before = [frame.T_map_base for frame in localizer.keyframes]
            localizer.enter_storey('second')
            apart.append(estimate)
    assert all(estimate.is_mapping_apart for estimate in apart[1:])
    assert apart[-1].apart.path_m > 20.0
    assert localizer.map_tag == 'first'
    saved = localizer.saved_keyframes().frames
    np.testing.assert_array_equal([frame.T_map_base for frame in saved], before)


def test_a_robot_that_is_back_on_its_storey_joins_its_map():
    localizer = Localizer(LocalizerConfig(map_tag='first'))
    drive = 0
    found = []
    for moment in carried((9, 0, 60.0), (3, 1, 15.0), (9, 1, 70.0)):
        if moment.drive != drive:
            drive = moment.drive
            localizer.enter_storey(['first', 'second', 'first'][drive])
        estimate = localizer.step(moment.scan, moment.T_odom_base)
        found.append((drive, estimate, moment.T_world_base))
    assert all(estimate.is_mapping_apart for drive, estimate, _ in found if drive == 1)
    _, last, T_world_base = found[-1]
    off = se2.between(se2.compose(found[0][2], last.T_map_base), T_world_base)
    assert is_mapped(last)
    assert np.hypot(off[0], off[1]) < 0.1
    assert len(localizer.apart_points()), 'what it has seen of the second storey stays apart'


def test_a_map_gets_the_first_tag_that_is_known():
    localizer = Localizer()
    moments = list(carried((1, 0, 4.0)))
    localizer.enter_storey('hall')
    localizer.enter_storey('first')  # nothing is mapped yet
    for moment in moments:
        localizer.step(moment.scan, moment.T_odom_base)
    unnamed = Localizer.from_state({k: v for k, v in localizer.state().items() if k != 'map_tag'})
    unnamed.enter_storey('second')
    assert (localizer.map_tag, unnamed.map_tag) == ('first', 'second')
    assert not unnamed.step(moments[0].scan, moments[0].T_odom_base).is_mapping_apart


def test_a_storey_without_a_name_or_that_the_given_map_does_not_show_is_refused():
    localizer = Localizer(LocalizerConfig(map_tag='first'))
    for moment in carried((1, 0, 2.0)):
        localizer.step(moment.scan, moment.T_odom_base)
    given = Localizer.from_state(localizer.state(), LocalizerConfig(mode=LOCALIZATION))
    with pytest.raises(InputError, match="map_tag = '': expected the name of a storey"):
        given.enter_storey('')
    with pytest.raises(
        InputError, match="map_tag = 'second': the map is of 'first', and mode: loc"
    ):
        given.enter_storey('second')
    given.enter_storey('first')
    assert given.map_tag == 'first'


@pytest.mark.parametrize(('building', 'path_m'), [(3, 3.0), (10, 6.0)])
def test_a_killed_localizer_continues_where_its_saved_map_ends(building, path_m):
    """Its pose is known to the last scan, its map was saved two metres before."""
    localizer = Localizer(LocalizerConfig())
    first = last = saved = None
    is_killed = False
    driven_m = 0.0
    for moment in carried((building, 1, path_m + 8.0)):
        first = moment.T_world_base if first is None else first
        if last is not None:
            driven_m += math.dist(last.T_odom_base[:2], moment.T_odom_base[:2])
        if saved is None and driven_m > path_m:
            saved = localizer.state()
        if not is_killed and driven_m > path_m + 2.0:
            is_killed = True
            localizer = Localizer.from_state(saved, LocalizerConfig())
            localizer.resume(last, moment.T_odom_base)
        estimate = localizer.step(moment.scan, moment.T_odom_base)
        stamp_ns = moment.scan.stamp_ns
        last = OdometryAnchor(stamp_ns, estimate.T_map_odom, moment.T_odom_base)
        if is_killed:
            assert not estimate.is_lost and estimate.apart is None
            here = se2.between(first, moment.T_world_base)
            assert math.dist(estimate.T_map_base[:2], here[:2]) < 0.3
