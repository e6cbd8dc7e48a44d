"""A localizer that is killed continues in its own map, and its keyframes are corrected."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, drive_round_the_block, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig, EkfLocalizer
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.nodes.parts.localization import Recovery, restored

CONFIG = LocalizerConfig(initial_x_m=3.0, initial_y_m=1.2)
KILLED_AT = 520
SAVED_AT = 490


def step(localizer, scan, odom, recovery):
    estimate = localizer.step(scan, odom)
    recovery.last = OdometryAnchor(scan.stamp_ns, estimate.T_map_odom, odom)


def after_a_kill(localizer, recovery, saved_map, config=CONFIG):
    state = {**saved_map, **recovery.pose_state(localizer)}
    return restored(state, config)


@pytest.fixture(scope='module')
def killed():
    """The localizer after most of a lap, its checkpoint, and the rest of the lap."""
    steps = list(drive_round_the_block())
    localizer = Localizer(CONFIG)
    recovery = Recovery()
    for k, (scan, odom, _) in enumerate(steps[:KILLED_AT]):
        step(localizer, scan, odom, recovery)
        if k == SAVED_AT:
            saved_map = recovery.map_state(localizer)
    return localizer, recovery, saved_map, steps[KILLED_AT:]


def test_it_continues_at_its_pose_in_a_map_that_is_older(killed):
    localizer, recovery, saved_map, rest = killed
    resumed, last = after_a_kill(localizer, recovery, saved_map)
    scan, odom, _ = rest[0]
    resumed.resume(last, odom)
    expected = se2.compose(recovery.last.T_map_odom, odom)
    np.testing.assert_allclose(resumed.pose, expected, atol=1e-4)
    estimate = resumed.step(scan, odom)
    assert not estimate.is_lost and estimate.inlier_ratio > 0.9


def test_a_loop_closes_over_the_kill_and_corrects_the_keyframes_of_before(killed):
    localizer, recovery, saved_map, rest = killed
    resumed, last = after_a_kill(localizer, recovery, saved_map)
    resumed.resume(last, rest[0][1])
    truths = {scan.stamp_ns: truth for scan, _, truth in drive_round_the_block()}
    before = [frame.scan.stamp_ns for frame in localizer.keyframes]
    drifted = [
        np.hypot(*(frame.T_map_base - truths[ns])[:2])
        for frame, ns in zip(localizer.keyframes, before, strict=True)
    ]
    corrections = [resumed.step(scan, odom).correction for scan, odom, _ in rest]
    assert any(correction is not None for correction in corrections)
    stamps_ns, poses = resumed.keyframe_trajectory()
    assert np.isin(stamps_ns, before).sum() > 0.8 * len(before), 'as the mapper has them'
    errors = [
        np.hypot(*(T - truths[ns])[:2])
        for ns, T in zip(stamps_ns.tolist(), poses, strict=True)
        if ns in before
    ]
    assert max(errors) < 0.9 * max(drifted)
    assert np.hypot(*(resumed.pose - rest[-1][2])[:2]) < 0.15, 'at the start of the lap'


def test_a_map_that_is_saved_between_pose_and_kill_has_the_pose_in_it(killed):
    localizer, recovery, _, _ = killed
    pose = recovery.pose_state(localizer)
    newer = {**Recovery().map_state(localizer), **pose}
    _, last = restored(newer, CONFIG)
    np.testing.assert_allclose(last.T_map_odom, recovery.last.T_map_odom, atol=1e-6)


def test_keyframes_since_the_map_was_saved_move_with_its_last_one(killed):
    localizer, _, _, _ = killed
    saved = localizer.saved_keyframes()
    first_ns = saved.stamps_ns[40]
    tail = localizer.saved_keyframes(first_ns)
    is_before = [ns <= first_ns for ns in saved.stamps_ns]
    by = se2.pose(1.0, 2.0, 0.3)
    frames = [
        replace(frame, T_map_base=se2.compose(by, frame.T_map_base)) for frame in saved.frames[:41]
    ]
    begun = replace(saved, frames=frames, steps=saved.steps[:40], stamps_ns=saved.stamps_ns[:41])
    whole = begun.extended(tail)
    assert sum(is_before) == 41 and whole.stamps_ns == list(saved.stamps_ns)
    for frame, as_saved in zip(whole.frames, saved.frames, strict=True):
        expected = se2.compose(by, as_saved.T_map_base)
        np.testing.assert_allclose(frame.T_map_base, expected, atol=1e-9)
    assert [(step.a, step.b) for step in whole.steps] == [(s.a, s.b) for s in saved.steps]


def test_a_filter_continues_with_its_features():
    config = EkfConfig(slam='ekf_ti', initial_x_m=2.0, initial_y_m=2.0)
    localizer = EkfLocalizer(config)
    recovery = Recovery()
    for k in range(30):
        odom = se2.pose(0.05 * k, 0.0, 0.0)
        here = se2.pose(2.0 + 0.05 * k, 2.0, 0.0)
        step(localizer, scan_in(ROOM, here, None, 100_000_000 * (k + 1)), odom, recovery)
    resumed, last = after_a_kill(localizer, recovery, recovery.map_state(localizer), config)
    resumed.resume(last, odom)
    assert len(resumed.features) == len(localizer.features) > 2
    np.testing.assert_allclose(resumed.pose, localizer.pose, atol=1e-6)


def test_a_checkpoint_that_is_none_is_refused_in_words(killed):
    localizer, recovery, saved_map, _ = killed
    state = {**saved_map, **recovery.pose_state(localizer)}
    wrong = {
        'keyframe_stamps_ns': np.array([1]),
        'newer_keyframe_stamps_ns': np.array([1.5]),
        'newer_poses': np.zeros((1, 2)),
        'T_map_odom': np.zeros(4),
    }
    for name, array in wrong.items():
        with pytest.raises(InputError, match=name.removeprefix('newer_')):
            restored({**state, name: array}, CONFIG)
    with pytest.raises(InputError, match='stamp_ns'):
        restored({}, CONFIG)
    with pytest.raises(InputError, match='local map'):
        restored(recovery.last.state(), CONFIG)


def test_the_tag_of_the_map_is_that_of_before_the_kill(killed):
    localizer, recovery, _, _ = killed
    localizer.enter_storey('second')
    state = {**Recovery().map_state(localizer), **recovery.pose_state(localizer)}
    for saved in (state, {**localizer.state(), **recovery.last.state()}):
        resumed, _ = restored(saved, replace(CONFIG, map_tag='first'))
        assert resumed.map_tag == 'second'
    resumed, _ = restored({k: v for k, v in state.items() if k != 'map_tag'}, CONFIG)
    assert resumed.map_tag == ''
