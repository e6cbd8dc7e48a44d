"""Localized scans, each after the trajectory that its pose follows."""

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

from nav_msgs.msg import Path

from thinmap_ros.core.stage import Trajectory
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.localized_scan import ReceivedScan


class ScanQueue:
    """Localized scans, which wait for a trajectory that their pose follows and that comes later.

    dropped: number of scans whose trajectory did not come.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._scans: deque[ReceivedScan] = deque()
        self._trajectory: Trajectory | None = None
        self._trajectory_ns = 0
        self._corrected_ns = 0

    def add_scan(self, localized: ReceivedScan) -> None:
        """Add a scan."""
        self._scans.append(localized)
        if len(self._scans) > qos.STREAM.depth:
            self._scans.popleft()
            self.dropped += 1

    def add_trajectory(self, message: Path) -> None:
        """Add a corrected trajectory. Raises InputError where a stamp or a pose is invalid."""
        trajectory = messages.trajectory_from_msg(message)
        self._trajectory = Trajectory(*trajectory, messages.stamp_ns(message.header.stamp))
        self._trajectory_ns = self._trajectory.since_ns

    def ready(self) -> Iterator[ReceivedScan]:
        """The scans that need not wait, each with the trajectory that must be followed before it.

        A trajectory that a newer one has replaced is left out: the newer one corrects the scans of
        both.
        """
        while self._scans and self._scans[0].corrected_ns <= max(
            self._corrected_ns, self._trajectory_ns
        ):
            localized = self._scans.popleft()
            is_new = localized.corrected_ns > self._corrected_ns
            is_here = localized.corrected_ns == self._trajectory_ns
            yield replace(localized, trajectory=self._trajectory if is_new and is_here else None)
            # Not before: if following it fails, the next scan has the trajectory, too.
            self._corrected_ns = localized.corrected_ns
