"""ROS domains for tests: each is taken by one test at a time on this machine.

Nodes of two tests on one domain would hear each other, whoever runs these tests.
"""

import errno
import itertools
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

# Above, the ports of a domain are such as the system gives to programs that ask for any.
DOMAINS = range(1, 102)
# How DDS numbers its ports: of each participant of a domain, where others ask for it.
_FIRST_PORT = 7410
_PORTS_A_DOMAIN = 250
_PORTS_A_PARTICIPANT = 2
_PARTICIPANTS = 32
# So that each test takes another, and processes begin at different ones.
_turns = itertools.count(os.getpid())


@contextmanager
def free_domain() -> Iterator[int]:
    """A domain that no other test has now, and on which no node of this machine listens."""
    for _ in DOMAINS:
        domain = DOMAINS[next(_turns) % len(DOMAINS)]
        lock = _lock(domain)
        if lock is None:
            continue
        with lock:
            if not _has_nodes(domain):
                yield domain
                return
    raise RuntimeError(f'none of the ROS domains {DOMAINS[0]} to {DOMAINS[-1]} is free')


def _lock(domain: int) -> socket.socket | None:
    """Lock of a domain, None where another process has it.

    A name of the kernel's, and no file: whoever ends in whatever way leaves none, and it reaches as
    far as the ports of the domain do.
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


def _is_bound(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            return True
    return False
