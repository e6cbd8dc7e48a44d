"""The file of the last pose: where it cannot be used, one line says why, and nothing is lost."""

import numpy as np
import pytest

from thinmap_ros.nodes.parts.given_map import LastPose

pytestmark = pytest.mark.live
POSE = np.array([1.25, -2.5, 0.75])
GIVEN = 'map: office.yaml\nx: 1.25\ny: -2.5\nyaw: 0.75\n'


def last_pose(graph, path, map_name='office.yaml', rate=0.5):
    return LastPose(graph.node, str(path), rate, map_name)


def lines(capfd):
    return capfd.readouterr().err.splitlines()


def test_a_pose_is_saved_into_a_folder_that_does_not_exist_and_loaded_again(graph, tmp_path, capfd):
    path = tmp_path / 'state' / 'robot' / 'pose.yaml'
    assert last_pose(graph, path).load() is None
    last_pose(graph, path).save(POSE)
    np.testing.assert_array_equal(last_pose(graph, path).load(), POSE)
    assert [p.name for p in path.parent.iterdir()] == ['pose.yaml']
    assert lines(capfd) == []


def test_the_pose_that_came_last_is_saved_at_the_end(graph, tmp_path):
    pose = last_pose(graph, tmp_path / 'pose.yaml', rate=1e-3)
    pose.save(POSE)
    pose.save(2.0 * POSE)
    np.testing.assert_array_equal(pose.load(), POSE)
    pose.save_latest()
    np.testing.assert_array_equal(pose.load(), 2.0 * POSE)


def test_the_default_file_is_below_the_state_folder_of_the_user(graph, tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_STATE_HOME', str(tmp_path))
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    last_pose(graph, '').save(POSE)
    assert (tmp_path / 'thinmap' / '7.test_client.pose.yaml').exists()


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
    graph, tmp_path, capfd, content, reason
):
    path = tmp_path / 'pose.yaml'
    path.write_text(content)
    assert last_pose(graph, path).load() is None
    (line,) = lines(capfd)
    assert str(path) in line
    assert reason in line
    assert 'starting without a last pose' in line
    assert path.read_text() == content


def test_a_path_that_cannot_be_written_is_named_in_one_line(graph, tmp_path, capfd):
    file = tmp_path / 'file'
    file.write_text('mine')
    last = last_pose(graph, file / 'pose.yaml')
    last.save(POSE)
    (line,) = lines(capfd)
    assert str(file) in line
    assert 'pose_file' in line
    assert 'last pose not saved: expected a file that can be written' in line
    assert file.read_text() == 'mine'


def test_poses_are_saved_at_the_rate_and_never_at_rate_0(graph, tmp_path):
    path = tmp_path / 'pose.yaml'
    seldom = last_pose(graph, path, rate=1e-6)
    seldom.save(POSE)
    seldom.save(POSE + 1.0)
    np.testing.assert_array_equal(seldom.load(), POSE)
    never = last_pose(graph, path, rate=0.0)
    never.save(POSE + 1.0)
    assert never.load() is None
    np.testing.assert_array_equal(seldom.load(), POSE)
