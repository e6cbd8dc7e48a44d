"""Odometry in other frames, which static transforms connect to those of the robot."""

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.logs.transforms import OdometryFrames
from thinmap_ros.ros import messages

T_ODOM_BASE = se2.pose(3.0, -1.0, 0.7)
T_BASE_WHEELS = se2.pose(0.3, 0.1, 0.4)
T_ODOM_WORLD = se2.pose(-5.0, 2.0, 1.1)


class Frames:
    """Frames of a robot, with what they ask for and note."""

    def __init__(self, odom_frame='odom', base_frame='base_link'):
        self.subscribed = 0
        self.notes = []
        self.read = OdometryFrames(odom_frame, base_frame, self._subscribe, self.notes.append)

    def _subscribe(self):
        self.subscribed += 1

    def add(self, parent, child, T):
        self.read.add_static(messages.transform_msg(np.array(T), parent, child, 0))

    def pose(self, T, frame='odom', child='base_link'):
        return self.read.pose(messages.odometry_msg(T, (0.0, 0.0), (frame, child), 0))


@pytest.mark.parametrize('slash', ['', '/'])
def test_the_frames_of_the_parameters_need_no_transforms(slash):
    frames = Frames(f'{slash}odom', f'{slash}base_link')
    for frame, child in (('odom', 'base_link'), ('/odom', '/base_link')):
        np.testing.assert_array_equal(frames.pose(T_ODOM_BASE, frame, child), T_ODOM_BASE)
    assert frames.subscribed == 0
    assert frames.notes == []


def test_empty_frames_are_those_of_the_parameters_with_one_note_each():
    frames = Frames()
    for _ in range(3):
        np.testing.assert_array_equal(frames.pose(T_ODOM_BASE, '', ''), T_ODOM_BASE)
    assert frames.notes == [
        "frame_id is empty: it is held to be 'odom'",
        "child_frame_id is empty: it is held to be 'base_link'",
    ]


def test_frames_that_nothing_connects_are_refused_by_name():
    frames = Frames()
    frames.add('map', 'camera', (0.0, 0.0, 0.0))
    for frame, child, text in (
        ('world', 'base_link', r"frame_id 'world': expected 'odom' \(odom_frame\)"),
        ('odom', 'camera', r"child_frame_id 'camera': expected 'base_link' \(base_frame\)"),
    ):
        for _ in range(2):
            with pytest.raises(InputError, match=f'^{text}, or a frame that static transforms'):
                frames.pose(T_ODOM_BASE, frame, child)
    assert frames.subscribed == 1


@pytest.mark.parametrize('is_child_of_base', [True, False])
def test_connected_frames_are_transformed(is_child_of_base):
    frames = Frames()
    frames.add('odom', 'world', T_ODOM_WORLD)
    if is_child_of_base:
        frames.add('base_link', 'wheels', T_BASE_WHEELS)
    else:
        frames.add('wheels', 'base_link', se2.invert(T_BASE_WHEELS))
    T_world_base = se2.between(T_ODOM_WORLD, T_ODOM_BASE)
    T_world_wheels = se2.compose(T_world_base, T_BASE_WHEELS)
    found = frames.pose(T_world_wheels, 'world', 'wheels')
    np.testing.assert_allclose(found, T_ODOM_BASE, atol=1e-12)


def test_the_first_transform_of_a_frame_is_kept():
    frames = Frames()
    frames.add('wheels', 'base_link', (0.0, 0.0, 0.0))
    frames.pose(T_ODOM_BASE, child='wheels')
    frames.add('wheels', 'base_link', (4.0, 0.0, 0.0))
    np.testing.assert_allclose(frames.pose(T_ODOM_BASE, child='wheels'), T_ODOM_BASE, atol=1e-12)
