"""Pose and view of the robot, by the last scan, odometry and pose received."""

from rclpy.clock import Clock

from thinmap_ros.core import se2
from thinmap_ros.core.odometry import MAX_ODOMETRY_GAP_NS, OdometryBuffer
from thinmap_ros.core.planning.navigator import SENSOR_TIMEOUT_NS
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.sensing.laser_monitor import LaserMonitor
from thinmap_ros.core.stamps import SECOND_NS

# Without a new pose the last correction of the odometry holds for a while; without odometry, the
# robot does not know its pose meanwhile.
_POSE_TIMEOUT_NS = 3_000_000_000
_POSE_ONLY_TIMEOUT_NS = SECOND_NS


class RobotState:
    """Pose and view of the robot now, and whether they are recent.

    scan: the last one that is not blind; pose_fault: why the localizer does not trust its pose, ''
    where it does.
    """

    def __init__(self, clock: Clock, has_odometry: bool) -> None:
        """has_odometry: False where the odometry says that the robot never moves."""
        self.scan: Scan | None = None
        self.pose_fault = ''
        self._clock = clock
        self._timeouts_ns = {
            'laser': SENSOR_TIMEOUT_NS,
            'odometry': SENSOR_TIMEOUT_NS,
            'localizer': _POSE_TIMEOUT_NS if has_odometry else _POSE_ONLY_TIMEOUT_NS,
        }
        self._laser = LaserMonitor()
        self._blind_reason = ''
        self._stamp_offset_ns = 0  # of the odometry when the last scan was received
        self._odometry = OdometryBuffer(max_gap_ns=MAX_ODOMETRY_GAP_NS)
        self._T_map_odom: Array | None = None
        self._T_odom_base: Array | None = None
        self._received_ns: dict[str, int] = {}

    def add_odometry(self, stamp_ns: int, T_odom_base: Array) -> None:
        """Add the odometry, T_odom_base (3,), at a stamp."""
        self._T_odom_base = T_odom_base
        self._record_time('odometry')
        self._odometry.add(stamp_ns, T_odom_base)

    def add_pose(self, stamp_ns: int, T_map_base: Array) -> None:
        """Add the pose that the localizer found, T_map_base (3,), at the stamp of its scan."""
        T_odom_base = self._odometry.interpolate(stamp_ns)
        if T_odom_base is not None:
            self._record_time('localizer')
            self._T_map_odom = se2.compose(T_map_base, se2.invert(T_odom_base))

    def add_scan(self, scan: Scan) -> None:
        """Add a scan; a blind one is not kept, and is a reason to stop."""
        if self._T_odom_base is not None:
            scan = self._laser.checked(scan, self._T_odom_base)
        self._blind_reason = scan.blind_reason
        if not scan.is_blind:
            self.scan = scan
            self._stamp_offset_ns = self._scan_age_ns()
            self._record_time('laser')

    def pose(self) -> Array | None:
        """T_map_base (3,) now; None before a pose and odometry are received."""
        if self._T_map_odom is None or self._T_odom_base is None:
            return None
        return se2.compose(self._T_map_odom, self._T_odom_base)

    def stop_reason(self) -> str:
        """Why the robot must not drive on; '' for no reason."""
        if self._blind_reason:
            return f'laser blind ({self._blind_reason})'
        if self.pose_fault:
            return self.pose_fault
        now_ns = self._clock.now().nanoseconds
        for source, limit_ns in self._timeouts_ns.items():
            if now_ns - self._received_ns.get(source, now_ns) > limit_ns:
                return f'{source} silent'
        if abs(self._stamp_offset_ns) > SENSOR_TIMEOUT_NS:
            return f'stamps of laser and odometry {abs(self._stamp_offset_ns) / 1e9:.1f} s apart'
        if self._scan_age_ns() > SENSOR_TIMEOUT_NS:
            return 'laser silent'
        return ''

    def _scan_age_ns(self) -> int:
        """Time from the last scan to the last odometry, by their stamps; 0 without both."""
        latest_ns = self._odometry.latest_stamp_ns
        return 0 if self.scan is None or latest_ns is None else latest_ns - self.scan.stamp_ns

    def _record_time(self, source: str) -> None:
        self._received_ns[source] = self._clock.now().nanoseconds
