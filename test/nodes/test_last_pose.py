"""The file of the last pose: where it cannot be used, one line says why, and nothing is lost."""

import numpy as np
import pytest

from thinmap_ros.nodes.parts.localization import LastPose

POSE = np.array([1.25, -2.5, 0.75])
GIVEN = 'map: office.yaml\nx: 1.25\ny: -2.5\nyaw: 0.75\n'


class Localizer:
    """A node that has a name, and keeps what it logs."""

    def __init__(self):
        self.lines = []

    def get_fully_qualified_name(self):
        return '/robot1/localizer'

    def get_logger(self):
        return self

    def info(self, line):
        self.lines += line.splitlines()

    def warning(self, line, throttle_duration_sec=0.0):
        self.lines += line.splitlines()


@pytest.fixture
def node():
    return Localizer()


def last_pose(node, path, map_name='office.yaml', rate=0.5):
    return LastPose(node, str(path), rate, map_name)


def test_a_pose_is_saved_into_a_folder_that_does_not_exist_and_loaded_again(node, tmp_path):
    path = tmp_path / 'state' / 'robot' / 'pose.yaml'
    assert last_pose(node, path).load() is None
    last_pose(node, path).save(POSE)
    np.testing.assert_array_equal(last_pose(node, path).load(), POSE)
    assert [p.name for p in path.parent.iterdir()] == ['pose.yaml']
    assert node.lines == []


def test_the_pose_that_came_last_is_saved_at_the_end(node, tmp_path):
    pose = last_pose(node, tmp_path / 'pose.yaml', rate=1e-3)
    pose.save(POSE)
    pose.save(2.0 * POSE)
    np.testing.assert_array_equal(pose.load(), POSE)
    pose.save_latest()
    np.testing.assert_array_equal(pose.load(), 2.0 * POSE)


def test_the_default_file_is_below_the_state_folder_of_the_user(node, tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_STATE_HOME', str(tmp_path))
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    last_pose(node, '').save(POSE)
    assert (tmp_path / 'thinmap' / '7.robot1.localizer.pose.yaml').exists()


@pytest.mark.parametrize(
    ('content', 'reason'),
    [
        ('', 'the last pose of a localizer'),
        ('map: [', 'the last pose of a localizer'),
        ('- 1.0\n', 'the last pose of a localizer'),
        ('\0', 'pose.yaml'),
        (GIVEN.replace('x: 1.25', 'x: left'), 'expected x, y (m) and yaw (rad)'),
        (GIVEN.replace('x: 1.25', 'x: .nan'), 'expected x, y (m) and yaw (rad)'),
        (GIVEN.replace('x: 1.25', 'x: 1e300'), 'expected x, y (m) and yaw (rad)'),
        (GIVEN.replace('yaw: 0.75', ''), 'expected x, y (m) and yaw (rad)'),
        (GIVEN.replace('office', 'home'), "pose in map 'home.yaml', not in 'office.yaml'"),
    ],
)
def test_a_file_that_is_broken_or_of_another_map_is_named_in_one_line_and_kept(
    node, tmp_path, content, reason
):
    path = tmp_path / 'pose.yaml'
    path.write_text(content)
    assert last_pose(node, path).load() is None
    (line,) = node.lines
    assert str(path) in line
    assert reason in line
    assert 'starting without a last pose' in line
    assert path.read_text() == content


def test_a_path_that_cannot_be_written_is_named_in_one_line(node, tmp_path):
    file = tmp_path / 'file'
    file.write_text('mine')
    last = last_pose(node, file / 'pose.yaml')
    last.save(POSE)
    (line,) = node.lines
    assert str(file) in line
    assert 'pose_file' in line
    assert 'last pose not saved: expected a file that can be written' in line
    assert file.read_text() == 'mine'


def test_poses_are_saved_at_the_rate_and_never_at_rate_0(node, tmp_path):
    path = tmp_path / 'pose.yaml'
    seldom = last_pose(node, path, rate=1e-6)
    seldom.save(POSE)
    seldom.save(POSE + 1.0)
    np.testing.assert_array_equal(seldom.load(), POSE)
    never = last_pose(node, path, rate=0.0)
    never.save(POSE + 1.0)
    assert never.load() is None
    np.testing.assert_array_equal(seldom.load(), POSE)
