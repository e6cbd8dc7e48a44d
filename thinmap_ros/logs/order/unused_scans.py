"""Why scans of a log have no odometry at their stamps, with counts and times."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.odometry import MAX_ODOMETRY_GAP_NS
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.logs.log import Event, OdometryEvent

_UNITS = (('s', 1.0), ('h', 3600.0), ('days', 86400.0), ('years', 365.25 * 86400.0))


class UnusedScans:
    """The scans of a log that were not paired with odometry."""

    def __init__(self) -> None:
        self._odometry: list[int] = []
        self._unused: Counter[int] = Counter()

    def add(self, event: Event) -> None:
        """Add an event of the log."""
        if isinstance(event, OdometryEvent):
            self._odometry.append(event.stamp_ns)
        else:
            self._unused[event.scan.stamp_ns] += 1

    def pair(self, stamp_ns: int) -> None:
        """A scan with this stamp was paired."""
        self._unused[stamp_ns] -= 1

    def reasons(self) -> dict[str, int]:
        """Number of unused scans by reason."""
        scans = np.array(sorted(self._unused.elements()), dtype=np.int64)
        odometry = np.array(sorted(self._odometry), dtype=np.int64)
        if not (scans.size and odometry.size):
            return {'without any odometry': scans.size} if scans.size else {}
        early_ns = odometry[0] - scans
        late_ns = scans - odometry[-1]
        gap_ns = _gaps(odometry, scans)
        limit = f'at most {MAX_ODOMETRY_GAP_NS / SECOND_NS:g} s'
        parts = (
            (early_ns, early_ns > 0, 'before the first odometry, by up to {}'),
            (late_ns, late_ns > 0, 'after the last odometry, by up to {}'),
            (
                gap_ns,
                gap_ns > MAX_ODOMETRY_GAP_NS,
                f'in gaps of the odometry of up to {{}}: expected {limit}',
            ),
        )
        found = {
            text.format(_duration(int(values[chosen].max()))): int(np.count_nonzero(chosen))
            for values, chosen, text in parts
            if chosen.any()
        }
        rest = scans.size - sum(found.values())
        return found | ({'too late, or with a stamp ahead of later ones': rest} if rest else {})


def _gaps(odometry: NDArray[np.int64], scans: NDArray[np.int64]) -> NDArray[np.int64]:
    """Time between the samples around each scan, ns; 0 before the first and after the last."""
    after = np.searchsorted(odometry, scans)
    inside = (after > 0) & (after < odometry.size)
    after = np.clip(after, 1, max(odometry.size - 1, 1))
    ends = odometry[np.minimum(after, odometry.size - 1)]
    return np.where(inside, ends - odometry[after - 1], 0)


def _duration(ns: int) -> str:
    """A time in the unit that suits it."""
    seconds = ns / SECOND_NS
    name, size = next(((n, s) for n, s in reversed(_UNITS) if seconds >= 2.0 * s), _UNITS[0])
    return f'{seconds / size:.3g} {name}'
