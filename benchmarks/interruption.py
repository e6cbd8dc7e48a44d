"""Ctrl-C and SIGTERM for programs that spin a node.

An exception raised in a callback of rclpy or in compiled code is replaced by another one, or lost.
"""

import signal


class Interruption:
    """Records SIGINT and SIGTERM until `check` is called.

    The second one raises KeyboardInterrupt at once.
    """

    def __init__(self) -> None:
        self._is_requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal was received."""
        if self._is_requested:
            raise KeyboardInterrupt

    def _request(self, number: int, frame: object) -> None:
        if self._is_requested:
            raise KeyboardInterrupt
        self._is_requested = True
