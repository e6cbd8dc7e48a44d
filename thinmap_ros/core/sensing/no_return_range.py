"""Recognizes a finite range that a driver publishes for beams without return."""

from dataclasses import replace

import numpy as np

from thinmap_ros.core.scan import Scan

# No surface gives exactly the same range to so many beams: ranges are noisy, and walls are oblique.
_MIN_SHARE = 0.2
# Real ranges may lie between that value and range_max.
_MAX_BEYOND = 0.05


class NoReturnRange:
    """Largest range of a laser whose driver publishes a value below range_max for no return.

    Drivers publish 2.99 m for a laser of 3 m, or the true range of a laser with a wrong range_max.
    REP 117 takes such a value for a hit, and a wall appears all around the robot. At least a fifth
    of the beams share it in a scan, and hardly any range is larger.
    """

    def __init__(self) -> None:
        self._range_m: float | None = None

    @property
    def warning(self) -> str:
        """Description of such a value; '' where a driver publishes none."""
        if self._range_m is None:
            return ''
        return f'many beams of a scan share the range {self._range_m:.3f} m: taken as no return'

    def applied(self, scan: Scan) -> Scan:
        """The scan, in which the beams with that value have no return."""
        if self._range_m is None or not self._is_largest(scan, self._range_m):
            self._range_m = self._shared(scan)
        return scan if self._range_m is None else replace(scan, range_max_m=self._range_m)

    def _shared(self, scan: Scan) -> float | None:
        """The shared range; None without one, and where all beams share it: that says nothing."""
        ranges = scan.ranges_m[scan.returned]
        if ranges.size < _MIN_SHARE * scan.ranges_m.size:
            return None
        values, counts = np.unique(ranges, return_counts=True)
        most = int(np.argmax(counts))
        shared_m = float(values[most])
        is_shared = _MIN_SHARE * scan.ranges_m.size <= counts[most] < ranges.size
        return shared_m if is_shared and self._is_largest(scan, shared_m) else None

    def _is_largest(self, scan: Scan, range_m: float) -> bool:
        beyond = np.count_nonzero(scan.ranges_m[scan.returned] > range_m)
        return bool(beyond <= _MAX_BEYOND * scan.ranges_m.size)
