"""ROS domains for tests and programs: one of them at a time uses a domain on this machine.

Nodes of two of them on one domain would communicate, also if different users run them.
"""

import errno
import itertools
import os
import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from thinmap_ros.core.errors import ThinmapError

# Above it, the ports of a domain are in the range of ephemeral ports.
DOMAINS = range(1, 102)
# Numbering of DDS ports: discovery port of each participant of a domain.
_FIRST_PORT = 7410
_PORTS_A_DOMAIN = 250
_PORTS_A_PARTICIPANT = 2
_PARTICIPANTS = 32
SHARED_MEMORY = Path('/dev/shm')
# Each test uses another domain, and processes start at different ones.
_turns = itertools.count(os.getpid())
_of_this_process = ExitStack()


def use_free_domain() -> None:
    """Set ROS_DOMAIN_ID of this process and its children; the domain is theirs until it ends.

    Raises ThinmapError if no domain is free.
    """
    os.environ['ROS_DOMAIN_ID'] = str(_of_this_process.enter_context(free_domain()))


@contextmanager
def free_domain() -> Iterator[int]:
    """A domain that no other test or program uses, and without nodes on this machine.

    Raises ThinmapError if there is none.
    """
    for _ in DOMAINS:
        domain = DOMAINS[next(_turns) % len(DOMAINS)]
        lock = _lock(domain)
        if lock is None:
            continue
        with lock:
            if not _has_nodes(domain):
                _remove_stale_ports(domain)
                yield domain
                return
    raise ThinmapError(f'none of the ROS domains {DOMAINS[0]} to {DOMAINS[-1]} is free')


def _lock(domain: int) -> socket.socket | None:
    """Lock of a domain; None if another process has it.

    An abstract socket, not a file: it vanishes with its process, and has the same network namespace
    as the ports of the domain.
    """
    lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        lock.bind(f'\0thinmap-test-domain-{domain}')
    except OSError as error:
        lock.close()
        if error.errno != errno.EADDRINUSE:
            raise
        return None
    return lock


def _has_nodes(domain: int) -> bool:
    first = _FIRST_PORT + _PORTS_A_DOMAIN * domain
    ports = range(first, first + _PORTS_A_PARTICIPANT * _PARTICIPANTS, _PORTS_A_PARTICIPANT)
    return any(_is_bound(port) for port in ports)


def _remove_stale_ports(domain: int) -> None:
    """Remove shared memory of nodes of this domain that were killed.

    A node that is killed while it holds the lock of a port leaves it locked: the next node with
    this port would wait for ever.
    """
    first = _FIRST_PORT - _FIRST_PORT % 100 + _PORTS_A_DOMAIN * domain
    for path in SHARED_MEMORY.glob('*fastrtps_port*'):
        number = re.search(r'port(\d+)', path.name)
        if number and first <= int(number[1]) < first + _PORTS_A_DOMAIN:
            path.unlink(missing_ok=True)


def _is_bound(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            return True
    return False
