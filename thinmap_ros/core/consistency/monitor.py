"""Checks the geometry of the laser by the motion of the robot: angles, turns, and its mount."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from thinmap_ros.core import se2
from thinmap_ros.core.consistency.mount_error import MountError, MountErrorEstimator
from thinmap_ros.core.consistency.turn_comparison import TurnComparison
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stage import Estimate


@dataclass(frozen=True)
class MountLimits:
    """Errors of the laser's pose on the robot that are reported, and at which the robot stops."""

    warn_yaw_rad: float = math.radians(5.0)
    stop_yaw_rad: float = math.radians(20.0)
    warn_offset_m: float = 0.1


_LIMITS = MountLimits()


class ConsistencyMonitor:
    """Checks each scan with its estimate; warns of contradictions between laser and odometry.

    warnings: those that hold now, by kind; reported: the last text of each kind so far.
    """

    def __init__(self) -> None:
        self.warnings: dict[str, str] = {}
        self.reported: dict[str, str] = {}
        self._turns = TurnComparison()
        self._mount_errors = MountErrorEstimator()
        self._by_window: list[MountError] = []

    def checked(self, scan: Scan, T_odom_base: Array, estimate: Estimate) -> Estimate:
        """The estimate of a scan with odometry pose (3,), with `mount_fault` where there is one.

        A pose that no match has set, or that a loop closure has moved, says nothing of the mount,
        and neither does an odometry that has jumped.
        """
        if se2.is_finite(T_odom_base):
            self._turns.add(scan, T_odom_base)
            self._add_to_mount(scan, T_odom_base, estimate)
        self.warnings = dict(self._found(scan))
        self.reported |= self.warnings
        return replace(estimate, mount_fault=self._fault)

    def _add_to_mount(self, scan: Scan, T_odom_base: Array, estimate: Estimate) -> None:
        information = estimate.scan_information
        is_moved = estimate.correction is not None or estimate.odometry_discontinuity
        if information is None or is_moved:
            self._mount_errors.reset_span()
            return
        T_base_laser = scan.T_base_laser
        if self._mount_errors.add(estimate.T_map_base, information, T_odom_base, T_base_laser):
            self._by_window = self._mount_errors.estimates(T_base_laser)

    def _found(self, scan: Scan) -> Iterator[tuple[str, str]]:
        """Kind and text of each warning."""
        if scan.warning:
            yield 'angles', scan.warning
        if self._turns.are_opposed:
            turns = self._turns.turns
            yield (
                'turns',
                f'scans turn against the odometry: by {turns.scans:.1f} rad where the odometry '
                f'turned by {turns.odometry:.1f} rad: laser upside down or clockwise, or the yaw '
                'of the odometry inverted?',
            )
        turned = self._most_turned
        if turned is not None and turned.least_yaw_rad > _LIMITS.warn_yaw_rad:
            yield 'yaw', _yaw_text(turned)
        moved = max(self._by_window, key=lambda error: error.least_offset_m, default=None)
        if moved is not None and moved.least_offset_m > _LIMITS.warn_offset_m:
            x, y = moved.offset_m.tolist()
            yield (
                'offset',
                f'laser displaced by {x:.2f}, {y:.2f} m (sigma {moved.offset_sigma_m:.2f} m) from '
                'its given pose on the robot: by turns in scans and in odometry',
            )

    @property
    def _most_turned(self) -> MountError | None:
        """The estimate that is most certain of an error of the yaw."""
        return max(self._by_window, key=lambda error: error.least_yaw_rad, default=None)

    @property
    def _fault(self) -> str:
        """Why the robot must not drive with this laser; '' for no reason."""
        turned = self._most_turned
        is_wrong = turned is not None and turned.least_yaw_rad > _LIMITS.stop_yaw_rad
        return _yaw_text(turned) if turned is not None and is_wrong else ''


def _yaw_text(error: MountError) -> str:
    yaw = math.degrees(error.yaw_rad)
    sigma = math.degrees(error.yaw_sigma_rad)
    return (
        f'laser turned by {yaw:.0f} deg (sigma {sigma:.1f} deg) from its given pose on the robot: '
        'by the direction of motion in scans and in odometry'
    )
