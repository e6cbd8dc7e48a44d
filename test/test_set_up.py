"""scripts/env on machines for which there are no ROS wheels, and beside another distribution."""

import shutil
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.programs
ROOT = Path(__file__).resolve().parents[1]
TOOLS = ('cat', 'cut', 'dirname', 'find', 'flock', 'mkdir', 'sha256sum', 'sort', 'xargs')
SOURCED = {'ROS_DISTRO': 'jazzy', 'AMENT_PREFIX_PATH': '/opt/ros/jazzy'}


@pytest.fixture
def set_up(tmp_path):
    """Sources scripts/env of an empty project on a machine that has no compiler."""
    (tmp_path / 'scripts').mkdir()
    shutil.copy(ROOT / 'scripts' / 'env', tmp_path / 'scripts')
    tools = tmp_path / 'bin'
    tools.mkdir()
    for name in TOOLS:
        (tools / name).symlink_to(shutil.which(name))

    def source(machine, **variables):
        (tools / 'uname').write_text(f'#!/bin/sh\necho {machine}\n')
        (tools / 'uname').chmod(0o755)
        return subprocess.run(
            [shutil.which('bash'), '-ec', '. scripts/env; echo done'],
            cwd=tmp_path,
            env={'PATH': str(tools), 'HOME': str(tmp_path), **variables},
            capture_output=True,
            text=True,
            check=False,
        )

    return source


@pytest.mark.parametrize(
    'variables', [{}, {'ROS_DISTRO': 'humble', 'AMENT_PREFIX_PATH': '/opt/ros/humble'}]
)
def test_a_machine_without_ros_wheels_needs_a_sourced_jazzy(set_up, tmp_path, variables):
    done = set_up('aarch64', **variables)
    assert done.returncode == 1 and done.stdout == ''
    (line,) = done.stderr.splitlines()
    assert 'no ROS wheels for aarch64: source a ROS 2 Jazzy first' in line
    assert not (tmp_path / '.setup').exists()


@pytest.mark.parametrize(
    ('machine', 'variables'),
    [
        ('x86_64', {}),
        ('aarch64', SOURCED),
        ('aarch64', {**SOURCED, 'THINMAP_ENV': '/somewhere', 'THINMAP_SYSTEM_ROS': '1'}),
    ],
    ids=['wheels', 'sourced', 'sourced earlier'],
)
def test_other_machines_are_set_up(set_up, tmp_path, machine, variables):
    done = set_up(machine, **variables)
    assert 'ROS wheels' not in done.stderr
    assert 'cmake not found: install the package cmake' in done.stderr
    assert (tmp_path / '.setup').exists()


@pytest.mark.parametrize(
    ('variables', 'named'),
    [
        ({'ROS_DISTRO': 'humble', 'AMENT_PREFIX_PATH': '/opt/ros/humble'}, 'humble'),
        ({'ROS_DISTRO': 'noetic'}, 'noetic'),
        ({'AMENT_PREFIX_PATH': '/home/me/ws/install:/opt/ros/iron'}, 'iron'),
        ({**SOURCED, 'AMENT_PREFIX_PATH': '/opt/ros/jazzy:/opt/ros/humble'}, 'humble'),
        ({**SOURCED, 'THINMAP_ENV': '/somewhere', 'ROS_DISTRO': 'humble'}, 'humble'),
    ],
    ids=['humble', 'ROS 1', 'by its path', 'mixed', 'sourced later'],
)
def test_another_distribution_is_named(set_up, tmp_path, variables, named):
    done = set_up('x86_64', **variables)
    assert done.returncode == 1 and done.stdout == ''
    (line,) = done.stderr.splitlines()
    assert line.startswith(f'thinmap: ROS {named} is sourced in this shell: expected ROS 2 Jazzy')
    assert not (tmp_path / '.setup').exists()
