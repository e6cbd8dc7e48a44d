"""ROS domains of tests: no two tests use the same one at a time."""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest
from support.timeouts import PATIENCE_S

from thinmap_ros.core.errors import ThinmapError
from thinmap_ros.evaluation import ros_domains

ANOTHER = """
from thinmap_ros.evaluation import ros_domains
with ros_domains.free_domain() as domain:
    print(domain, flush=True)
    input()
"""
PROGRAM = """
import os
from benchmarks.node_processes import use_own_domain
use_own_domain()
print(os.environ['ROS_DOMAIN_ID'], flush=True)
input()
"""
NODE = """
import rclpy
rclpy.init()
node = rclpy.create_node('a')
print('up', flush=True)
input()
"""


def test_no_domain_is_given_twice_and_all_can_be_had_again():
    for _ in range(2):
        with ExitStack() as stack:
            taken = {stack.enter_context(ros_domains.free_domain()) for _ in range(20)}
            assert len(taken) == 20 and taken <= set(ros_domains.DOMAINS)


@pytest.mark.programs
@pytest.mark.parametrize('code', [ANOTHER, PROGRAM], ids=['test', 'program'])
def test_a_domain_that_another_process_has_is_left_alone(monkeypatch, code):
    other = subprocess.Popen(
        [sys.executable, '-c', code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    domain = int(other.stdout.readline())
    monkeypatch.setattr(ros_domains, 'DOMAINS', range(domain, domain + 1))
    with pytest.raises(ThinmapError, match='none of the ROS domains'), ros_domains.free_domain():
        pass
    other.kill()
    other.communicate()
    assert domain in domains_until_free(domain)


def domains_until_free(domain: int) -> Iterator[int]:
    """The domain again, once tests beside this one, which may have it for a moment, let it go."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        with suppress(ThinmapError), ros_domains.free_domain() as again:
            yield again
            return
        time.sleep(0.05)


def port_files(domain: int) -> set[str]:
    """Names that nodes of a domain have in shared memory: its first port and its last one."""
    first = 7400 + 250 * domain
    return {
        f'fastrtps_port{first + 11}',
        f'fastrtps_port{first + 11}_el',
        f'sem.fastrtps_port{first + 249}_mutex',
    }


def test_ports_that_killed_nodes_left_behind_are_removed(monkeypatch, tmp_path):
    monkeypatch.setattr(ros_domains, 'SHARED_MEMORY', tmp_path)
    left = {name for domain in ros_domains.DOMAINS for name in port_files(domain)}
    left.add('fastrtps_0123456789abcdef')
    for name in left:
        (tmp_path / name).touch()
    with ros_domains.free_domain() as domain:
        assert {path.name for path in tmp_path.iterdir()} == left - port_files(domain)


def test_a_domain_on_which_a_node_listens_is_left_alone(monkeypatch):
    with ros_domains.free_domain() as domain:
        pass
    monkeypatch.setattr(ros_domains, 'DOMAINS', range(domain, domain + 1))
    # The third node of a domain, after the first two have gone.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as node:
        node.bind(('127.0.0.1', 7400 + 250 * domain + 10 + 2 * 2))
        with (
            pytest.raises(ThinmapError, match='none of the ROS domains'),
            ros_domains.free_domain(),
        ):
            pass


@pytest.mark.live
def test_nodes_are_seen_where_they_listen(ros_domain):
    """The ports are those of the middleware."""
    node = subprocess.Popen(
        [sys.executable, '-c', NODE], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert node.stdout.readline() == b'up\n'
    assert ros_domains._has_nodes(ros_domain)
    node.kill()
    node.communicate()
    assert not ros_domains._has_nodes(ros_domain)
