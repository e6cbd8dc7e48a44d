"""Logs in other formats: a program that does not read one names it, and how to convert it."""

import shlex
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from support.forks import forked
from support.ros1_bag import ros1_bag

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.readers.bag import Bag

PROGRAMS = {'carmen_to_bag': ['out'], 'bag_repair': ['-o', 'out']}


def sqlite_file(path: Path) -> None:
    with sqlite3.connect(path) as database:
        database.execute('CREATE TABLE messages(id INTEGER PRIMARY KEY)')
    database.close()


def run(folder: Path, program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return forked.run(f'thinmap_ros.tools.{program}', *arguments, folder=folder)


@pytest.mark.programs
@pytest.mark.parametrize('program', PROGRAMS)
@pytest.mark.parametrize('name', ['old.bag', 'old.mcap', 'old.log'])
def test_a_ros1_bag_is_named_with_the_command_that_converts_it(
    tmp_path: Path, program: str, name: str
) -> None:
    ros1_bag(tmp_path / 'old.bag')
    (tmp_path / 'old.bag').rename(tmp_path / name)
    done = run(tmp_path, program, name, *PROGRAMS[program])
    assert done.returncode == 2
    line = done.stderr.splitlines()[-1]
    assert f'{name}: a ROS 1 bag' in line and f'rosbags-convert --src {name} --dst old ' in line
    assert not (tmp_path / 'out').exists()


@pytest.mark.programs
def test_the_command_makes_a_bag_that_is_read(tmp_path: Path) -> None:
    ros1_bag(tmp_path / 'old.bag')
    refused = run(tmp_path, 'bag_repair', 'old.bag').stderr
    command = shlex.split(refused.split('`')[1])
    command[0] = str(Path(sys.executable).parent / command[0])
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    bag = Bag(tmp_path / 'old')
    (message,) = bag.messages()
    assert bag.decode(message).ranges.tolist() == [2.0] * 5


@pytest.mark.programs
@pytest.mark.parametrize('program', PROGRAMS)
@pytest.mark.parametrize('name', ['bag_0.db3', 'bag_0.mcap'])
def test_an_sqlite_file_is_named(tmp_path: Path, program: str, name: str) -> None:
    sqlite_file(tmp_path / name)
    done = run(tmp_path, program, name, *PROGRAMS[program])
    assert done.returncode == 2
    line = done.stderr.splitlines()[-1]
    assert f'{name}: an SQLite file' in line and 'rosbags-convert --src' in line


@pytest.mark.programs
@pytest.mark.parametrize('name', ['bag_0.db3', 'bag_0.mcap'])
def test_an_sqlite_file_without_messages_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    sqlite_file(tmp_path / name)
    done = run(tmp_path, 'replay', name, '-o', 'out')
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f'replay: error: {name}: ')


@pytest.mark.programs
def test_a_folder_of_sqlite_files_is_not_repaired(tmp_path: Path) -> None:
    (tmp_path / 'bag').mkdir()
    sqlite_file(tmp_path / 'bag' / 'bag_0.db3')
    with pytest.raises(InputError, match=r'bag_0\.db3: .*missing tables'):
        Bag(tmp_path / 'bag')
    done = run(tmp_path, 'bag_repair', 'bag')
    assert done.returncode == 2 and 'MCAP' in done.stderr


@pytest.mark.programs
def test_an_mcap_file_is_no_carmen_log_and_read_under_any_name(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'a.mcap') as writer:
        writer.write('/said', 'std_msgs/msg/String', 5, b'\0\1\0\0\1\0\0\0\0')
    (tmp_path / 'a.mcap').rename(tmp_path / 'a.active')
    assert len(list(Bag(tmp_path / 'a.active').messages())) == 1
    done = run(tmp_path, 'carmen_to_bag', 'a.active', 'out')
    assert done.returncode == 2 and 'an MCAP file, which is a bag' in done.stderr
    done = run(tmp_path, 'replay', 'a.active', '-o', 'out')
    assert done.returncode == 2 and 'no laser scans' in done.stderr
