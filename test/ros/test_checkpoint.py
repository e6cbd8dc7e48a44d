"""Checkpoints of killed nodes: found again, but only in places that no other user can write."""

import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thinmap_ros.files.safe import atomic_write, partial_files
from thinmap_ros.ros.checkpoint import Checkpoint, checkpoint_directory

STATE = {'a': np.arange(3), 'b': np.array(2.5)}


class FakeNode:
    """The name and the logger of a node."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def get_fully_qualified_name(self) -> str:
        return '/robot/mapper'

    def get_logger(self) -> 'FakeNode':
        return self

    def warning(self, text: str, **_: Any) -> None:
        self.said.append(text)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv('THINMAP_STATE_DIR', str(tmp_path / 'state'))
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    return tmp_path / 'state'


def test_a_state_is_found_again(folder: Path) -> None:
    node = FakeNode()
    Checkpoint(node, 30.0).save(STATE)
    assert folder.stat().st_mode & 0o777 == 0o700
    left = Checkpoint(node, 30.0).load()
    assert left is not None and np.array_equal(left['a'], STATE['a']) and left['b'] == 2.5
    Checkpoint(node, 30.0).delete()
    assert Checkpoint(node, 30.0).load() is None and not node.said and not list(folder.iterdir())
    off = Checkpoint(node, 0.0)
    off.save(STATE)
    assert off.load() is None and not list(folder.iterdir())


def test_an_old_state_is_left_alone(folder: Path) -> None:
    node = FakeNode()
    Checkpoint(node, 30.0).save(STATE)
    os.utime(folder / '7.robot.mapper.npz', (time.time() - 60.0, time.time() - 60.0))
    assert Checkpoint(node, 30.0).load() is None and not node.said


def test_links_are_not_followed(folder: Path, tmp_path: Path) -> None:
    node = FakeNode()
    Checkpoint(node, 30.0).save(STATE)
    file = folder / '7.robot.mapper.npz'
    file.rename(tmp_path / 'elsewhere.npz')
    file.symlink_to(tmp_path / 'elsewhere.npz')
    before = (tmp_path / 'elsewhere.npz').read_bytes()
    assert Checkpoint(node, 30.0).load() is None
    assert 'symbolic link' in node.said[-1]
    Checkpoint(node, 30.0).save({'a': np.zeros(1000)})
    assert not file.is_symlink() and (tmp_path / 'elsewhere.npz').read_bytes() == before


@pytest.mark.parametrize('wrong', ['link', 'open', 'file'])
def test_folders_that_are_not_of_this_user_alone(folder: Path, tmp_path: Path, wrong: str) -> None:
    if wrong == 'file':
        folder.write_text('')
    else:
        (tmp_path / 'other').mkdir(mode=0o700)
        folder.symlink_to(tmp_path / 'other') if wrong == 'link' else folder.mkdir()
    if wrong == 'open':
        folder.chmod(0o770)
    with pytest.raises(OSError, match='state: '):
        checkpoint_directory()
    node = FakeNode()
    checkpoint = Checkpoint(node, 30.0)
    checkpoint.save(STATE)
    assert checkpoint.load() is None
    checkpoint.delete()
    assert 'expected' in node.said[0] and not list((tmp_path / 'other').glob('*'))


@pytest.mark.parametrize('bit', [0o040, 0o020, 0o010, 0o004, 0o002, 0o001])
def test_a_folder_that_is_open_in_any_way(folder: Path, bit: int) -> None:
    folder.mkdir()
    folder.chmod(0o700 | bit)
    with pytest.raises(OSError, match=f'mode {0o700 | bit:o}: expected 700, closed to other'):
        checkpoint_directory()
    folder.chmod(0o700)
    assert checkpoint_directory() == folder


def test_a_new_folder_is_closed_whatever_new_files_are_else(folder: Path) -> None:
    before = os.umask(0)
    try:
        assert checkpoint_directory() == folder
    finally:
        os.umask(before)
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_link_to_nowhere_is_no_folder(folder: Path, tmp_path: Path) -> None:
    folder.symlink_to(tmp_path / 'nowhere')
    with pytest.raises(OSError, match='state: '):
        checkpoint_directory()
    assert not (tmp_path / 'nowhere').exists()


@pytest.mark.parametrize('chosen', [None, ''])
@pytest.mark.parametrize('runtime', ['there', 'missing', '', None])
def test_where_nothing_is_chosen_states_lie_where_a_restart_removes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chosen: str | None, runtime: str | None
) -> None:
    (tmp_path / 'there').mkdir()
    (tmp_path / 'temporary').mkdir()
    places = {
        'THINMAP_STATE_DIR': chosen,
        'XDG_RUNTIME_DIR': runtime and str(tmp_path / runtime),
    }
    for name, value in places.items():
        monkeypatch.delenv(name, raising=False)
        if value is not None:
            monkeypatch.setenv(name, value)
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path / 'temporary'))
    base = tmp_path / ('there' if runtime == 'there' else 'temporary')
    assert checkpoint_directory() == base / f'thinmap-{os.getuid()}'
    assert checkpoint_directory().stat().st_mode & 0o777 == 0o700
    # Files of another user are not used, and the node reports it.
    checkpoint_directory().chmod(0o755)
    node = FakeNode()
    Checkpoint(node, 30.0).save(STATE)
    assert 'mode 755' in node.said[0] and not list(base.glob('*/*'))


def test_a_file_of_another_user_is_left_alone(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = FakeNode()
    checkpoint = Checkpoint(node, 30.0)
    checkpoint.save(STATE)
    monkeypatch.setattr(os, 'getuid', lambda: folder.stat().st_uid + 1)
    assert checkpoint.load() is None
    assert 'expected a file of this user' in node.said[-1]


def test_a_folder_of_another_user(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.mkdir(mode=0o700)
    monkeypatch.setattr(os, 'getuid', lambda: folder.stat().st_uid + 1)
    with pytest.raises(OSError, match=r'owned by user .*: expected a folder of this user'):
        checkpoint_directory()


def test_broken_states_and_unfinished_files(folder: Path) -> None:
    node = FakeNode()
    Checkpoint(node, 30.0).save(STATE)
    (folder / '7.robot.mapper.npz').write_bytes(b'no archive')
    unfinished = folder / '.7.robot.mapper.npz.0123456789abcdef.part'
    unfinished.write_bytes(b'half')
    assert Checkpoint(node, 30.0).load() is None
    assert 'starting without a checkpoint' in node.said[-1] and not unfinished.exists()


def test_a_file_beside_has_a_name_that_cannot_be_guessed(tmp_path: Path) -> None:
    path = tmp_path / 'a.[b]'
    names = set()
    for _ in range(3):
        with atomic_write(path) as aside:
            names.add(aside.name)
            aside.write_text('whole')
            assert partial_files(path) == [aside]
    assert len(names) == 3 and all(str(os.getpid()) not in name.split('.') for name in names)
    assert path.read_text() == 'whole' and list(tmp_path.iterdir()) == [path]


def test_a_state_that_stays_is_not_saved_again_and_is_that_of_now(folder: Path) -> None:
    file = folder / '7.robot.mapper.npz'
    states = [STATE, None]
    periodic = Checkpoint(FakeNode(), 30.0, lambda: states[0], interval=0.0)
    assert periodic.is_outdated and periodic.save_if_due() and not periodic.is_outdated
    saved = file.read_bytes()
    os.utime(file, (0, 0))
    periodic.renew()
    assert time.time() - file.stat().st_mtime < 10.0 and file.read_bytes() == saved
    states.reverse()
    assert periodic.save_if_due() and periodic.is_outdated
    os.utime(file, (0, 0))
    periodic.renew()
    assert file.stat().st_mtime == 0.0  # nobody knows what is in it
    periodic.delete()
    periodic.renew()
    assert not list(folder.iterdir())
