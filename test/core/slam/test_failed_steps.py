"""An error that nobody expects, in any part of a step: the scan is left out, and no more."""

from itertools import islice

import numpy as np
import pytest
from support.slam_room import drive_round_the_block

from thinmap_ros.core.slam.graph.keyframes import Keyframes
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure
from thinmap_ros.core.slam.localizer import ActiveMap, HeadingCorrection, Localizer
from thinmap_ros.core.slam.matching.local_map import LocalMap
from thinmap_ros.core.slam.matching.scan_matcher import Matcher
from thinmap_ros.core.slam.odometry import OdometryCalibration
from thinmap_ros.core.slam.place_belief import PlaceBelief
from thinmap_ros.core.slam.track import LocalizerConfig, Tracker

FAILING = 4  # calls in a row


@pytest.mark.parametrize('is_done', [False, True])
@pytest.mark.parametrize(
    ('part', 'name'),
    [
        (Matcher, 'match'),
        (PlaceBelief, 'update'),
        (OdometryCalibration, 'update'),
        (Tracker, '_record_agreement'),
        (HeadingCorrection, 'correct'),
        (LocalMap, 'add_scan'),
        (LoopClosure, 'add'),
        (Keyframes, 'add'),
        (LoopClosure, 'step'),
        (ActiveMap, 'follow'),
    ],
)
def test_the_pose_is_right_after_steps_that_failed(part, name, is_done, monkeypatch):
    """is_done: the part fails after its work and not before it."""
    localizer = Localizer(LocalizerConfig(initial_x_m=3.0, initial_y_m=1.2))
    work = getattr(part, name)
    errors = []
    calls = 0

    def failing(*arguments, **named):
        nonlocal calls
        calls += is_begun
        if is_done or not 0 < calls <= FAILING:
            result = work(*arguments, **named)
        if 0 < calls <= FAILING:
            raise ZeroDivisionError('planted')
        return result

    is_begun = False
    failed = 0
    monkeypatch.setattr(part, name, failing)
    for i, (scan, odometry, truth) in enumerate(islice(drive_round_the_block(), 130)):
        is_begun = i >= 60  # no end of the corridor is in sight
        try:
            estimate = localizer.step(scan, odometry)
        except ZeroDivisionError:
            failed += 1
            continue
        errors.append(np.hypot(*(estimate.T_map_base - truth)[:2]))
    assert failed == FAILING
    assert max(errors) < 0.2, np.round(errors[15:], 2)
    assert not estimate.is_lost
