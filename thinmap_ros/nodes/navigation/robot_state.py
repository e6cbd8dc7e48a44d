"""Pose and view of the robot, by the last scan, odometry and pose received."""

from thinmap_ros.core import se2
from thinmap_ros.core.odometry import MAX_ODOMETRY_GAP_NS, OdometryBuffer
from thinmap_ros.core.planning.navigator import SENSOR_DELAY_NS, SENSOR_TIMEOUT_NS
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.sensing.beams import LaserMonitor
from thinmap_ros.core.sensing.synchronizer import InputStream
from thinmap_ros.ros.time_jumps import ElapsedTime

# Without a new pose the last correction of the odometry holds for a while; without odometry, the
# robot does not know its pose meanwhile.
_POSE_TIMEOUT_NS = 3_000_000_000
_POSE_ONLY_TIMEOUT_NS = SECOND_NS


class RobotState:
    """Pose and view of the robot now, and whether they are recent.

    scan: the last one that is not blind; pose_fault: why the localizer does not trust its pose, ''
    where it does.
    """

    def __init__(self, time: ElapsedTime, has_odometry: bool) -> None:
        """has_odometry: False where the odometry says that the robot never moves."""
        self.scan: Scan | None = None
        self.pose_fault = ''
        self._time = time
        pose_timeout_ns = _POSE_TIMEOUT_NS if has_odometry else _POSE_ONLY_TIMEOUT_NS
        self._streams = {
            'laser': InputStream('laser', SENSOR_TIMEOUT_NS, SENSOR_DELAY_NS),
            'odometry': InputStream('odometry', SENSOR_TIMEOUT_NS, SENSOR_DELAY_NS),
            # A late pose corrects the odometry as well as a new one: they are as late as silent.
            'localizer': InputStream('localizer', pose_timeout_ns, pose_timeout_ns),
        }
        self._laser = LaserMonitor()
        self._blind_reason = ''
        self._scan_offset_ns = 0  # from the odometry, when the last scan was received
        self._pose_fault = ''  # why the last pose was not used
        self._odometry = OdometryBuffer(max_gap_ns=MAX_ODOMETRY_GAP_NS)
        self._T_map_odom: Array | None = None
        self._T_odom_base: Array | None = None

    def add_odometry(self, stamp_ns: int, T_odom_base: Array) -> None:
        """Add the odometry, T_odom_base (3,), at a stamp."""
        self._T_odom_base = T_odom_base
        self._record('odometry', stamp_ns)
        self._odometry.add(stamp_ns, T_odom_base)

    def add_pose(self, stamp_ns: int, T_map_base: Array) -> None:
        """Add the pose that the localizer found, T_map_base (3,), at the stamp of its scan."""
        T_odom_base = self._odometry.interpolate(stamp_ns)
        if T_odom_base is None:
            self._pose_fault = _offset_fault('pose', self._offset_ns(stamp_ns))
            return
        self._pose_fault = ''
        self._record('localizer', stamp_ns)
        self._T_map_odom = se2.compose(T_map_base, se2.invert(T_odom_base))

    def add_scan(self, scan: Scan) -> None:
        """Add a scan; a blind one is not kept, and is a reason to stop."""
        if self._T_odom_base is not None:
            scan = self._laser.checked(scan, self._T_odom_base)
        self._blind_reason = scan.blind_reason
        if not scan.is_blind:
            self.scan = scan
            self._scan_offset_ns = self._offset_ns(scan.stamp_ns)
            self._record('laser', scan.stamp_ns)

    @property
    def odometry_fault(self) -> str:
        """Why the odometry is not that of now; '' for no reason."""
        return self._streams['odometry'].fault(self._time.now_ns())

    def has_two_localizers(self) -> bool:
        """Whether poses come from two sources."""
        return self._streams['localizer'].is_mixed(self._time.now_ns())

    def pose(self) -> Array | None:
        """T_map_base (3,) now; None before a pose and odometry are received."""
        if self._T_map_odom is None or self._T_odom_base is None:
            return None
        return se2.compose(self._T_map_odom, self._T_odom_base)

    def stop_reason(self) -> str:
        """Why the robot must not drive on, the cause before its consequences; '' for no reason."""
        if self._blind_reason:
            return f'laser blind ({self._blind_reason})'
        return self._sensor_fault() or self.pose_fault or self._localizer_fault()

    def _sensor_fault(self) -> str:
        now_ns = self._time.now_ns()
        for source in ('laser', 'odometry'):
            if fault := self._streams[source].fault(now_ns):
                return fault
        if fault := _offset_fault('scan', self._scan_offset_ns):
            return fault
        # Also where the clock stands.
        silent_ns = 0 if self.scan is None else -self._offset_ns(self.scan.stamp_ns)
        return f'laser silent for {silent_ns / 1e9:.1f} s' if silent_ns > SENSOR_TIMEOUT_NS else ''

    def _localizer_fault(self) -> str:
        fault = self._streams['localizer'].fault(self._time.now_ns())
        is_waiting = fault or self._T_map_odom is None
        return (self._pose_fault if is_waiting else '') or fault

    def _offset_ns(self, stamp_ns: int) -> int:
        """Time by which a stamp is ahead of the last one of the odometry; 0 without odometry."""
        latest_ns = self._odometry.latest_stamp_ns
        return 0 if latest_ns is None else stamp_ns - latest_ns

    def _record(self, source: str, stamp_ns: int) -> None:
        time = self._time
        self._streams[source].add(stamp_ns, time.now_ns(), time.age_ns(stamp_ns))


def _offset_fault(source: str, offset_ns: int) -> str:
    """What is wrong with stamps that are ahead of those of the odometry; '' for nothing."""
    if abs(offset_ns) <= SENSOR_TIMEOUT_NS:
        return ''
    side = 'ahead of' if offset_ns > 0 else 'behind'
    return (
        f"{source} stamps are {abs(offset_ns) / SECOND_NS:.1f} s {side} odometry's: expected at "
        f'most {SENSOR_TIMEOUT_NS / SECOND_NS:.1f} s'
    )
