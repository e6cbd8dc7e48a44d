"""The map of points drawn anew.

Where the robot is there is a map, however much else is still to be drawn.
"""

import numpy as np

from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.loops import Keyframe
from thinmap_ros.core.slam.redrawn_map import RedrawnMap
from thinmap_ros.core.slam.scan_matching import MatchConfig

SCAN = Scan(0, np.ones(3), 0.0, 0.1, 0.1, 8.0, np.zeros(3))
POST = np.stack(
    [0.3 * np.cos(np.linspace(0.0, 6.0, 60)), 0.3 * np.sin(np.linspace(0.0, 6.0, 60))], axis=1
)


def seen_at(x, y):
    return Keyframe(SCAN, POST, np.array([x, y, 0.0]), 0.0)


def test_the_map_is_drawn_where_the_robot_drives():
    """1,600 keyframes on 80 x 80 m.

    It drives from the middle to the border while every step draws one of them.
    """
    keyframes = [
        seen_at(x, y) for x in np.arange(-40.0, 40.0, 2.0) for y in np.arange(-40.0, 40.0, 2.0)
    ]
    redrawn = RedrawnMap(MatchConfig())
    redrawn.begin_anew(keyframes, keyframes[820].T_map_base)
    for step in range(150):
        if step % 4 == 0:
            keyframes.append(seen_at(0.25 * step, 0.5))
        redrawn.go_on(keyframes, keyframes[-1].T_map_base)
    assert redrawn.matcher.known(POST, np.zeros(2), np.array([36.0, 0.0, 0.0])) > 0.9
    assert redrawn.matcher.known(POST, np.zeros(2), np.array([-36.0, 0.0, 0.0])) < 0.1


def test_in_the_end_all_is_drawn():
    keyframes = [
        seen_at(x, y) for x in np.arange(0.0, 20.0, 2.0) for y in np.arange(0.0, 20.0, 2.0)
    ]
    redrawn = RedrawnMap(MatchConfig())
    redrawn.begin_anew(keyframes, np.zeros(3))
    for _ in range(len(keyframes)):
        redrawn.go_on(keyframes, keyframes[-1].T_map_base)
    known = [redrawn.matcher.known(POST, np.zeros(2), frame.T_map_base) for frame in keyframes]
    assert min(known) > 0.9
