"""Ctrl-C for programs that spin a node.

An exception raised in a callback of rclpy or in compiled code is replaced by another one, or lost.
"""

import signal


class Interruption:
    """Records SIGINT until `check` is called; the second one raises KeyboardInterrupt at once."""

    def __init__(self) -> None:
        self._is_requested = False
        signal.signal(signal.SIGINT, self._request)

    def check(self) -> None:
        """Raise KeyboardInterrupt if SIGINT was received."""
        if self._is_requested:
            raise KeyboardInterrupt

    def _request(self, number: int, frame: object) -> None:
        if self._is_requested:
            raise KeyboardInterrupt
        self._is_requested = True
