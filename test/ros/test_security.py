"""A process that was asked to be secure starts no node without keys."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.ros.node_main import enforce_security

ON = {'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_KEYSTORE': 'keys'}


@pytest.mark.parametrize('strategy', [{}, {'ROS_SECURITY_STRATEGY': 'enforce'}])
def test_without_the_word_permissive_keys_are_needed(strategy: dict[str, str]) -> None:
    environment = ON | strategy
    enforce_security(environment)
    assert environment == ON | {'ROS_SECURITY_STRATEGY': 'Enforce'}


@pytest.mark.parametrize(
    'environment',
    [
        {},
        {'ROS_SECURITY_ENABLE': 'false'},
        {'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Permissive'},
    ],
)
def test_what_ros_does_otherwise_is_left_to_it(environment: dict[str, str]) -> None:
    before = dict(environment)
    enforce_security(environment)
    assert environment == before


def test_without_a_keystore_the_error_says_what_is_expected() -> None:
    with pytest.raises(InputError, match='ROS_SECURITY_KEYSTORE is not set: expected the folder'):
        enforce_security({'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_KEYSTORE': ''})


@pytest.mark.live
@pytest.mark.parametrize('folder', ['', 'enclaves', 'enclaves/robot'])
def test_a_node_that_cannot_be_secured_ends_with_a_line(
    folder: str, ros_domain: int, tmp_path: Path
) -> None:
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    on = {**os.environ, 'ROS_SECURITY_ENABLE': 'true'}
    if folder:
        on['ROS_SECURITY_KEYSTORE'] = str(tmp_path)
    command = [sys.executable, '-m', 'thinmap_ros.nodes.grid_mapper', '--ros-args']
    done = subprocess.run(
        [*command, '--enclave', '/robot'], env=on, capture_output=True, text=True, check=False
    )
    # ROS itself may log a line where it looks for keys.
    lines = [line for line in done.stderr.splitlines() if '[rcl' not in line]
    assert done.returncode == 2
    assert len(lines) == 1
    assert lines[0].startswith('error: ')
    assert not done.stdout
