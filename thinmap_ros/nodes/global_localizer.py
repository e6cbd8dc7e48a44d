"""Where is a robot switched on anywhere? Asked by service or by itself, until one place is left."""

from pathlib import Path

from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped, Twist
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import LocalizationStatus, SlamStatus, TopologicalMap
from thinmap_msgs.srv import LocalizeGlobally
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.active_localization import ActiveSearch
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import ScanOdometrySynchronizer
from thinmap_ros.core.places.global_localizer import (
    GlobalLocalization,
    GlobalLocalizationConfig,
    Result,
    State,
)
from thinmap_ros.core.planning.navigator import NavigatorConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.builder import TopologyConfig, build
from thinmap_ros.core.topology.graph import TopologicalMap as Topology
from thinmap_ros.files import occupancy_maps
from thinmap_ros.kernels import warm_up
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.laser_transform import LaserMount
from thinmap_ros.ros.lifecycle_node import LiveNode
from thinmap_ros.ros.subscription import listen

_WARN_PERIOD_S = 5.0
_CONTROL_PERIOD_S = 0.1
_SILENCE_NS = 400_000_000
_SHOWN_NS = 1_000_000_000
# Wider than the robot: where it plans to go, and what stops it
_PLANNED_M = 0.05
_BODY_M = 0.04
_STATES = {
    State.WAITING: LocalizationStatus.WAITING,
    State.SEARCHING: LocalizationStatus.SEARCHING,
    State.AMBIGUOUS: LocalizationStatus.AMBIGUOUS,
    State.LOCALIZED: LocalizationStatus.LOCALIZED,
    State.NOT_IN_MAP: LocalizationStatus.NOT_IN_MAP,
}


class GlobalLocalizerNode(LiveNode):
    """/scan, /odom, /map and /topology in.

    /initialpose, /localization_samples and /localization_status out. Service localize_globally.
    The map is taken as it is when the search begins; once the robot is sure, its pose is said once,
    and the node rests until it is asked again. Where it is `active`, it drives meanwhile: /cmd_vel
    out.
    """

    def __init__(self) -> None:
        super().__init__('global_localizer')
        self._config = parameters.declare(self, GlobalLocalizationConfig)
        self._seed = int(
            parameters.declare_value(self, 'seed', 0, 'decides where samples are drawn')
        )
        self._map_frame = parameters.declare_value(self, 'map_frame', 'map', 'frame of the map')
        automatic = parameters.declare_value(
            self,
            'automatic',
            False,
            'begin at once, and again when the localizer has been lost for lost_s',
        )
        lost_s = parameters.declare_value(
            self, 'lost_s', 3.0, 'how long the localizer must have been lost, s'
        )
        self._active = bool(
            parameters.declare_value(
                self,
                'active',
                False,
                'drive, while it looks, to where the places in question differ most',
            )
        )
        speed = parameters.declare_value(
            self, 'active_speed_m_s', 0.3, 'how fast it then drives, m/s'
        )
        path = str(
            parameters.declare_value(
                self, 'map', '', 'map_server YAML file; empty: from the topics'
            )
        )
        self._mount = LaserMount(self)
        parameters.check_unknown(self)
        self._automatic = bool(automatic)
        self._lost_ns = round(1e9 * float(lost_s))
        self._patch: GridPatch | None = occupancy_maps.read_map(Path(path)) if path else None
        self._topology: Topology | None = (
            build(self._patch, None, TopologyConfig()) if self._patch else None
        )
        radius = self._config.robot_radius_m
        self._driving = NavigatorConfig(
            max_speed_m_s=float(speed),
            robot_radius_m=radius + _PLANNED_M,
            body_radius_m=radius + _BODY_M,
        )
        warm_up.global_localizer()
        self.begin_anew()
        self._pose = self.create_publisher(PoseWithCovarianceStamped, 'initialpose', qos.STREAM)
        self._samples = self.create_publisher(PoseArray, 'localization_samples', qos.LATCHED)
        self._status = self.create_publisher(LocalizationStatus, 'localization_status', qos.LATCHED)
        if not path:
            listen(self, OccupancyGrid, 'map', self._on_map, qos.LATCHED)
            listen(self, TopologicalMap, 'topology', self._on_topology, qos.LATCHED)
        listen(self, SlamStatus, 'slam_status', self._on_slam_status, qos.STREAM)
        listen(self, Odometry, 'odom', self._on_odometry, qos.STREAM)
        listen(self, LaserScan, 'scan', self._on_scan, qos.SENSOR)
        self.create_service(LocalizeGlobally, 'localize_globally', self._on_request)
        self.every(1.0, self._say_what_is_missing)
        if self._active:
            self._cmd_vel = self.create_publisher(Twist, 'cmd_vel', qos.STREAM)
            self.every(_CONTROL_PERIOD_S, self._drive)

    def begin_anew(self) -> None:
        """Forget where the robot may be."""
        self._finder: GlobalLocalization | None = None
        self._wanted = self._automatic
        self._lost_since_ns: int | None = None
        self._found_ns = -1  # what the localizer said before it heard the pose says nothing
        self._pairing = ScanOdometrySynchronizer()
        self._heard: set[str] = set()
        self._search: ActiveSearch | None = None
        self._T_odom_base: Array | None = None
        self._scan: Scan | None = None
        self._odometry_ns = 0
        self._drives = False
        self._shown_ns = -_SHOWN_NS

    def stand_still(self) -> None:
        """Stop the robot, if it is this node that drives it."""
        if self._drives:
            self._cmd_vel.publish(messages.twist_msg(0.0, 0.0))
        self._drives = False

    def close(self) -> None:
        """Stop the robot: the last thing the node does."""
        self.stand_still()
        super().close()

    def _on_map(self, message: OccupancyGrid) -> None:
        self._patch = messages.patch_from(message)

    def _on_topology(self, message: TopologicalMap) -> None:
        self._topology = messages.topology_from(message)

    def _on_slam_status(self, message: SlamStatus) -> None:
        """A robot that was carried off: the localizer finds nothing where it thinks that it is."""
        stamp_ns = messages.stamp_ns(message.header.stamp)
        if message.state != SlamStatus.LOST or self._wanted or stamp_ns <= self._found_ns:
            self._lost_since_ns = None
        elif self._lost_since_ns is None:
            self._lost_since_ns = stamp_ns
        elif self._automatic and stamp_ns - self._lost_since_ns >= self._lost_ns:
            self.get_logger().info('the localizer is lost: looking all over the map')
            self._begin(clear=True)

    def _on_request(
        self, request: LocalizeGlobally.Request, response: LocalizeGlobally.Response
    ) -> LocalizeGlobally.Response:
        self._begin(request.clear)
        missing = self._missing()
        response.accepted = True
        response.message = f'waits for {missing}' if missing else 'looking all over the map'
        return response

    def _begin(self, clear: bool) -> None:
        self._wanted = True
        self._lost_since_ns = None
        if clear:
            self._finder = self._search = None

    def _on_odometry(self, message: Odometry) -> None:
        self._heard.add('odom')
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self._T_odom_base = messages.pose_from(message.pose.pose)
        self._odometry_ns = stamp_ns
        self._take(self._pairing.add_odometry(stamp_ns, self._T_odom_base))

    def _on_scan(self, message: LaserScan) -> None:
        scan = self._mount.scan(message)
        self._heard.add('scan')
        # Where the laser is blind, nobody sees where the robot drives.
        self._scan = None if scan.is_blind else scan
        self._take(self._pairing.add_scan(scan))

    def _take(self, ready: list[tuple[Scan, Array]]) -> None:
        for scan, T_odom_base in ready:
            if self._wanted and self._make_finder():
                assert self._finder is not None
                with self.health.timed('global localization'):
                    result = self._finder.step(scan, T_odom_base)
                if self._search is not None:
                    self._search.take(result, T_odom_base)
                self._publish(scan.stamp_ns, result)

    def _drive(self) -> None:
        """Drive on while the robot is looked for and what it sees and has driven is heard of."""
        scan = self._scan
        T_odom_base = self._T_odom_base
        heard = scan is not None and abs(self._odometry_ns - scan.stamp_ns) <= _SILENCE_NS
        heard = heard and self.get_clock().now().nanoseconds - self._odometry_ns <= _SILENCE_NS
        if (
            not self._wanted
            or self._search is None
            or scan is None
            or T_odom_base is None
            or not heard
        ):
            self.stand_still()
            return
        command = self._search.step(T_odom_base, scan, _CONTROL_PERIOD_S)
        if command.state == 'idle':
            self.stand_still()
            return
        self._drives = True
        self._cmd_vel.publish(messages.twist_msg(command.v, command.w))

    def _make_finder(self) -> bool:
        """Whether there is all that a search needs; a map that cannot be used is said in words."""
        if self._finder is None and self._patch is not None and self._topology is not None:
            try:
                self._finder = GlobalLocalization(
                    self._patch, self._topology, self._config, self._seed
                )
                if self._active:
                    self._search = ActiveSearch(self._finder.places, self._config, self._driving)
            except InputError as error:
                self._say(LocalizationStatus.WAITING, str(error))
        return self._finder is not None

    def _missing(self) -> str:
        """What is not there yet, in words; empty where nothing is missing."""
        missing = [
            name
            for name, value in (('map', self._patch), ('topology', self._topology))
            if value is None
        ]
        missing += [name for name in ('odom', 'scan') if name not in self._heard]
        return ', '.join(missing)

    def _say_what_is_missing(self) -> None:
        missing = self._missing()
        if not self._wanted:
            self._say(LocalizationStatus.IDLE, 'not asked')
        elif missing:
            self._say(LocalizationStatus.WAITING, f'waits for {missing}')

    def _say(self, state: int, reason: str) -> None:
        header = messages.header(self._map_frame, self.get_clock().now().nanoseconds)
        self._status.publish(LocalizationStatus(header=header, state=state, reason=reason))
        if state == LocalizationStatus.WAITING:
            self.get_logger().warning(reason, throttle_duration_sec=_WARN_PERIOD_S)

    def _publish(self, ns: int, result: Result) -> None:
        header = messages.header(self._map_frame, ns)
        self._show_samples(ns)
        self._status.publish(
            LocalizationStatus(
                header=header,
                state=_STATES[result.state],
                reason=result.reason,
                hypotheses=[messages.pose_msg(found.T_map_base) for found in result.hypotheses],
                weights=[found.weight for found in result.hypotheses],
                explained=[found.explained for found in result.hypotheses],
            )
        )
        if result.state == State.WAITING:
            self.get_logger().warning(result.reason, throttle_duration_sec=_WARN_PERIOD_S)
        if result.pose is not None:
            found = result.pose
            self._pose.publish(
                messages.pose_with_covariance_msg(
                    found.T_map_base, found.covariance, self._map_frame, ns
                )
            )
            self.get_logger().info(f'localized: {result.reason}')
            self._wanted = False
            self._finder = None
            self._search = None
            self._found_ns = ns
            self.stand_still()

    def _show_samples(self, ns: int) -> None:
        """Publish the samples, now and then.

        They are thousands of small objects, which take longer than a step.
        """
        if self._finder is not None and not 0 <= ns - self._shown_ns < _SHOWN_NS:
            self._shown_ns = ns
            poses = [messages.pose_msg(T) for T in self._finder.samples]
            self._samples.publish(
                PoseArray(header=messages.header(self._map_frame, ns), poses=poses)
            )


def main() -> None:
    """Run the node."""
    node_main.run(GlobalLocalizerNode)


if __name__ == '__main__':
    main()
