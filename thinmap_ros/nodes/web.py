"""A page in the browser: shows map and robot, and steers it."""

import sys
from dataclasses import dataclass
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMsg
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import (
    EndNodeArray,
    ExplorationStatus,
    KeepOut,
    LocalizedScan,
    RegionArray,
    SlamStatus,
    TopologicalMap,
)
from thinmap_ros import kernels
from thinmap_ros.core.config import SAFE_LOWER, Config, parameter
from thinmap_ros.core.errors import counted
from thinmap_ros.core.planning.path_follower import MESSAGE_PERIOD_S, moved_on
from thinmap_ros.core.topology.graph import topology_from_msg
from thinmap_ros.nodes.parts.page import Steering, TopSpeeds
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.diagnostics import OK
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.maps import subscribe_to_map
from thinmap_ros.ros.subscription import subscribe_all
from thinmap_ros.ros.team import heard_robots
from thinmap_ros.ros.time_jumps import STEADY
from thinmap_ros.web import access, server
from thinmap_ros.web.pages import Board, Pages
from thinmap_ros.web.picture import Picture

_PERIOD_S = 0.1
_TICKS = 10  # between two tables of diagnostics


@dataclass(frozen=True)
class WebConfig(Config):
    """Parameters of the page."""

    host: str = parameter(
        '127.0.0.1',
        'IP address at which the page is. Any but a loopback address needs web_token_file.',
    )
    port: int = parameter(8480, 'Port of the page. 0: any that is free.', low=0, high=65535)
    web_token_file: str = parameter(
        '',
        'File with the tokens of the two links to the page, to steer and to watch, of mode 0600; '
        'made where there is none. Empty: no token, for this machine alone.',
    )
    max_drive_speed_m_s: float = parameter(
        0.3,
        'Speed of a joystick that is pushed to its end (m/s).',
        low=0.0,
        high=3.0,
        safe=SAFE_LOWER,
    )
    max_drive_turn_rad_s: float = parameter(
        0.8,
        'Turn rate of a joystick that is pushed to its end (rad/s).',
        low=0.0,
        high=6.0,
        safe=SAFE_LOWER,
    )


class WebNode(ThinmapNode):
    """/map, /pose, /scan, /topology, /keep_out, ... in; a page at 127.0.0.1:8480.

    Clicks become goals of navigate_to_pose and explore, /initialpose, explore/resume, calls of
    save_map, load_map, name_region, add_keep_out, remove_keep_out and erase_area, and, as long as a
    joystick is held, /cmd_vel. Two sessions of save_directory are merged on trial. With a team, its
    other robots are shown. A stop is /stop: navigator stands while it is true, and all goals of
    everybody are cancelled.
    """

    def __init__(self) -> None:
        super().__init__('web')
        config = parameters.declare_config(self, WebConfig)
        map_frame = parameters.declare_map_frame(self)
        self._laser = LaserTransform(self)
        self._address = server.Address(config.host, config.port)
        self._tokens = _tokens(config)
        self._picture = Picture(Board())
        top = TopSpeeds(config.max_drive_speed_m_s, config.max_drive_turn_rad_s)
        self._steering = Steering(self, self._picture, (map_frame, self._laser.base_frame), top)
        self._team = heard_robots(self)
        parameters.reject_unknown(self)
        kernels.topology_builder()  # a merged session is read and saved in this process
        self._pages = Pages(self._picture.board, access.Gate(self._tokens), self._steering)
        self._server: server.Server | None = None
        self._subscribe()
        self._ticks = 0
        self.create_timer(_PERIOD_S, self._tick, clock=STEADY)

    def start(self) -> None:
        """Open the page. Raises InputError where its address cannot be used."""
        super().start()
        self._server = server.Server(self._address, self._pages)
        self._announce(self._server)

    def close(self) -> None:
        """Close the pages, and stop a robot that one of them drives."""
        if self._server is not None:
            self._server.close()
        self._steering.close()
        super().close()

    def _subscribe(self) -> None:
        picture = self._picture
        subscribe_to_map(self, 'map', picture.grid)
        self._laser.subscribe(self, self._on_scan)
        subscribe_all(
            self,
            (PoseWithCovarianceStamped, 'pose', self._on_pose, qos.STREAM),
            (PathMsg, 'trajectory', self._on_trajectory, qos.LATCHED),
            (PathMsg, 'plan', picture.plan, qos.LATCHED),
            (TopologicalMap, 'topology', self._on_topology, qos.LATCHED),
            (RegionArray, 'regions', picture.regions, qos.LATCHED),
            (KeepOut, 'keep_out', picture.keep_out, qos.LATCHED),
            (EndNodeArray, 'end_nodes', picture.end_nodes, qos.LATCHED),
            (SlamStatus, 'slam_status', picture.slam, qos.STREAM),
            (ExplorationStatus, 'exploration_status', picture.exploration, qos.LATCHED),
            (LocalizedScan, 'localized_scan', picture.localized_scan, qos.STREAM),
            (DiagnosticArray, '/diagnostics', picture.diagnostics, qos.STREAM),
        )

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        T_map_base = messages.pose_from_msg(message.pose.pose)
        covariance = messages.covariance_from_msg(message)
        self._picture.pose(messages.stamp_ns(message.header.stamp), T_map_base, covariance)

    def _on_scan(self, topic: str, message: LaserScan) -> None:
        if self._pages.open:
            self._picture.scan(self._laser.to_scan(topic, message))

    def _on_trajectory(self, message: PathMsg) -> None:
        self._picture.path.correct(*messages.trajectory_from_msg(message))

    def _on_topology(self, message: TopologicalMap) -> None:
        self._picture.topology(topology_from_msg(message))

    def _tick(self) -> None:
        self._steering.tick()
        if self._team is not None:
            motions = self._team.motions()
            self._picture.robots(moved_on(each, min(s, MESSAGE_PERIOD_S)) for each, s in motions)
        self._ticks = (self._ticks + 1) % _TICKS
        if not self._ticks:
            self._picture.tick()
            if self._pages.open:
                self._steering.show_refusals()
            self.diagnostics.set_state(OK, f'{counted(len(self._pages.open), "page")} open')

    def _announce(self, opened: server.Server) -> None:
        self.get_logger().info(f'page at {opened.url}')
        if self._tokens is None or not self._tokens.is_new:
            return
        host = self._address.host
        url = server.Address(access.reached_host(host), opened.port).url
        for role, link in access.links(url, self._tokens).items():
            code = '' if access.is_loopback(host) else access.qr_code(link, sys.stderr.isatty())
            self.get_logger().info(f'to {role}: {link}\n{code}'.rstrip('\n'))


def _tokens(config: WebConfig) -> access.Tokens | None:
    """Tokens of the links; None where there are none. Raises InputError."""
    access.require_safe_host(config.host, has_tokens=bool(config.web_token_file))
    return access.read_tokens(Path(config.web_token_file)) if config.web_token_file else None


main = node_main.program(WebNode)

if __name__ == '__main__':
    main()
