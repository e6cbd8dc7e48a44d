"""The line features that are mapped from poses which scan matching has found."""

import numpy as np
from slam_room import ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.feature_map import FeatureConfig
from thinmap_ros.core.ekf_slam.line_map import LineMap
from thinmap_ros.core.ekf_slam.lines import LineConfig, extract_lines
from thinmap_ros.core.estimate import Correction


def test_after_a_loop_features_go_where_the_keyframes_have_gone(rng):
    lines = LineMap(FeatureConfig(), local_areas=True)
    keyframes = []
    for k, (truth, _) in enumerate(drive(300, rng, np.array([2.0, 2.0, 0.0]))):
        if k % 5 == 0:
            scan = scan_in(ROOM, truth, rng)
            lines.observe(scan, extract_lines(scan, LineConfig()), truth, 1e-6 * np.eye(3))
            keyframes.append(truth)
    before = {feature.id: feature for feature in lines.features}
    assert len(before) > 3
    T = se2.pose(3.0, -1.0, 0.8)
    lines.move(Correction(np.array(keyframes), np.array([se2.compose(T, k) for k in keyframes])))
    assert {feature.id for feature in lines.features} == set(before)
    for feature in lines.features:
        ends = np.array([before[feature.id].start, before[feature.id].end])
        np.testing.assert_allclose(
            [feature.start, feature.end], se2.transform_points(T, ends), atol=1e-9
        )
