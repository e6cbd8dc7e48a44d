"""A weak link between two network namespaces: Ethernet frames are delayed, and some are lost.

    weak_link.py PID DEVICE DEVICE LOSS DELAY_S SEED

Makes a TAP device here and one in the namespace of a process, carries frames between them until
SIGTERM, and then prints the numbers of carried and lost frames as JSON.
"""

import contextlib
import ctypes
import fcntl
import heapq
import json
import os
import random
import select
import signal
import struct
import sys
import time

_CLONE_NEWNET = 0x40000000
_TUNSETIFF = 0x400454CA
_IFF_TAP = 0x0002
_IFF_NO_PI = 0x1000
_MAX_FRAME = 65_536


def tap(name: str) -> int:
    """Return the descriptor of a new TAP device in the current network namespace."""
    descriptor = os.open('/dev/net/tun', os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(
        descriptor, _TUNSETIFF, struct.pack('16sH22x', name.encode(), _IFF_TAP | _IFF_NO_PI)
    )
    return descriptor


def enter_network_of(pid: int) -> None:
    """Enter the network namespace of a process.

    Open devices stay in the namespace in which they were created.
    """
    namespace = os.open(f'/proc/{pid}/ns/net', os.O_RDONLY)
    if ctypes.CDLL(None, use_errno=True).setns(namespace, _CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), f'setns to the network of process {pid}')
    os.close(namespace)


class Link:
    """Frames in transit between two devices."""

    def __init__(self, ends: tuple[int, int], loss: float, delay_s: float, seed: int) -> None:
        self._other = {ends[0]: ends[1], ends[1]: ends[0]}
        self._loss = loss
        self._delay_s = delay_s
        self._chance = random.Random(seed)
        self._under_way: list[tuple[float, int, int, bytes]] = []
        self.carried = self.lost = 0
        self.ended = False

    def run(self) -> None:
        """Carry frames until it is ended."""
        while not self.ended:
            wait_s = (
                min(max(self._under_way[0][0] - time.monotonic(), 0.0), 0.2)
                if self._under_way
                else 0.2
            )
            for end in select.select(list(self._other), [], [], wait_s)[0]:
                self._take(end)
            while self._under_way and self._under_way[0][0] <= time.monotonic():
                self._hand_over(*heapq.heappop(self._under_way)[2:])

    def _take(self, end: int) -> None:
        try:
            frame = os.read(end, _MAX_FRAME)
        except OSError:  # unplugged
            return
        if self._chance.random() < self._loss:
            self.lost += 1
            return
        self.carried += 1
        heapq.heappush(
            self._under_way,
            (time.monotonic() + self._delay_s, self.carried, self._other[end], frame),
        )

    def _hand_over(self, end: int, frame: bytes) -> None:
        with contextlib.suppress(OSError):  # unplugged
            os.write(end, frame)


def main() -> None:
    """Run the link."""
    pid, near, far, loss, delay_s, seed = sys.argv[1:]
    first = tap(near)
    enter_network_of(int(pid))
    link = Link((first, tap(far)), float(loss), float(delay_s), int(seed))
    signal.signal(signal.SIGTERM, lambda number, frame: setattr(link, 'ended', True))
    print('plugged in', flush=True)
    link.run()
    print(json.dumps({'carried': link.carried, 'lost': link.lost}), flush=True)


if __name__ == '__main__':
    main()
