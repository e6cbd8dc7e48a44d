"""Navigator: plans a path to a goal, follows it, replans, and stops in front of obstacles."""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import SAFE_HIGHER, SAFE_LOWER, Config, parameter, part
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.grid_search import path_collides
from thinmap_ros.core.planning.obstacles import (
    ObstaclePoints,
    RecentPath,
    StuckDetector,
    StuckPlaces,
)
from thinmap_ros.core.planning.path_follower import (
    HeardMotion,
    Motion,
    PathFollower,
    PathFollowerConfig,
    as_heard,
    length_from,
    must_stop,
    nearest_point,
)
from thinmap_ros.core.planning.paths import LONG_PATH_M, Band, plan_short_path, route_band
from thinmap_ros.core.planning.wavefront import Obstacles, WavefrontConfig, find_path
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap

# Of the nodes that drive the robot: a stop within half a second after the last scan or odometry.
CONTROL_PERIOD_S = 0.1
SENSOR_TIMEOUT_NS = 400_000_000
# Later data are of another place: 0.25 m away at the usual 0.5 m/s.
SENSOR_DELAY_NS = 500_000_000
_ROUNDING_M_S = 1e-9
# A waypoint counts as passed on this last part of the path to it at most.
_MAX_WAYPOINT_PASS_M = 0.7
# Reasons that begin so name a goal to which the map has no path, whatever stands there now.
NO_PATH = 'no path'
_OBSTACLE = 'an obstacle blocks the path'
_HIDDEN = 'the laser does not see the path: sector of invalid beams'
_REPLAN_PERIOD_S = 5.0  # while nothing is in the way
_REPLAN_S = 0.5  # after a stop for an obstacle
# Points around another robot, so far apart that no path leads between them.
_RING = np.array([[math.cos(a), math.sin(a)] for a in np.linspace(0.0, 2.0 * math.pi, 13)[:-1]])
_RING_MARGIN_M = 0.1  # paths run along cells
_OTHER_ROBOT = 'another robot is in the way'
_STUCK = (
    'the robot does not move as commanded: wheels blocked or off, or an obstacle that the laser '
    'does not see'
)


@dataclass(frozen=True)
class NavigatorConfig(Config):
    """Parameters of planning and following, and when a goal is reached or aborted."""

    planner: WavefrontConfig = part(WavefrontConfig)
    controller: PathFollowerConfig = part(PathFollowerConfig)
    stop_radius_m: float = parameter(
        0.24,
        'The robot stops before a scan point comes closer than this to its centre (m). At most '
        'robot_radius_m.',
        low=0.0,
        high=5.0,
        safe=SAFE_HIGHER,
    )
    reaction_time_s: float = parameter(
        0.3,
        'Time from a measurement until the robot brakes (s). Raise it for slow drivers or '
        'networks.',
        low=0.0,
        high=5.0,
        safe=SAFE_HIGHER,
    )
    xy_goal_tolerance_m: float = parameter(
        0.15,
        'Distance at which a goal is reached (m). Raise it if the robot searches for its goal.',
        low=0.01,
        high=5.0,
    )
    yaw_goal_tolerance_rad: float = parameter(
        0.15,
        'Heading error at which a goal is reached (rad). Raise it if the robot oscillates at its '
        'goal.',
        low=0.01,
        high=3.2,
    )
    blocked_timeout_s: float = parameter(
        8.0,
        'Time at standstill after which the goal is aborted (s). Raise it where people step aside.',
        low=0.1,
        high=1000.0,
    )
    resume_after_stop: bool = parameter(
        True,
        'Whether the robot drives on to its goal when the cause of a protective stop is over: a '
        'silent sensor, a lost pose, a failed map. false: the goal is aborted, and the robot is '
        'stopped until ~/release_stop. A stop for an obstacle is none: the path is planned again.',
        safe=SAFE_LOWER,
    )
    check_ahead_m: float = 4.0  # of the path, for obstacles in a new map
    scan_obstacle_range_m: float = 2.5  # nearer scan points are obstacles, beside those of the map
    clearance_ahead_m: float = 0.6  # of the path, whose narrowest place limits the speed
    creep_speed_m_s: float = 0.02  # the robot stops rather than drive slower
    # In a passage hardly wider than the robot, obstacles may come closer than stop_radius_m by this
    # distance, at most at this speed.
    narrow_margin_m: float = 0.01
    narrow_speed_m_s: float = 0.1
    aim_tolerance_rad: float = 0.1  # heading error at which a blocked robot faces its path
    # A goal is aborted after too many standstills without this much progress.
    progress_m: float = 0.5
    max_standstills: int = 5


@dataclass(frozen=True)
class Command:
    """Command until the next step: speed v (m/s), turn rate w (rad/s), and state of the goal.

    state: 'idle', 'driving', 'blocked', 'reached' or 'failed'; reason: text, if blocked or failed;
    is_timeout: failed because the robot stood still for blocked_timeout_s.
    """

    v: float
    w: float
    state: str
    reason: str = ''
    is_timeout: bool = False


@dataclass(eq=False)
class _Progress:
    """Progress towards a goal: age of the path, time at standstill, remaining path length.

    standstills: number of them without progress; recoveries: all of them, up to the last waypoint
    too; nearest_m: smallest remaining length; is_near: whether the target has been near; yielded_s:
    time at standstill for other robots since the last progress; robots: points around these.
    """

    path_age_s: float = 0.0
    blocked_s: float = 0.0
    remaining_m: float = 0.0
    standstills: int = 0
    recoveries: int = 0
    nearest_m: float = math.inf
    is_near: bool = False
    yielded_s: float = 0.0
    robots: Array = field(default_factory=lambda: np.empty((0, 2)))


class Navigator:
    """Drives to one goal at a time; a new goal replaces the old one without a stop."""

    def __init__(self, config: NavigatorConfig | None = None) -> None:
        self.config = config or NavigatorConfig()
        self.path: Array | None = None
        # Of the map: long paths are planned on it. None: all paths by wavefront alone.
        self.topology: TopologicalMap | None = None
        self._follower = PathFollower(self.config.controller)
        self._obstacles = ObstaclePoints()
        self._goal: tuple[float, float] | None = None
        self._waypoints: list[tuple[float, float]] = []
        self._heading_rad: float | None = None
        self._progress = _Progress()
        self._patch: GridPatch | None = None
        self._recent_path = RecentPath()
        self._stuck_detector = StuckDetector()
        self._stuck_places = StuckPlaces(self.config.planner.robot_radius_m)

    @property
    def distance_remaining_m(self) -> float:
        """Remaining length of the path, m; 0 without a path.

        Beyond the next waypoint, that of straight lines.
        """
        if self._goal is None or self._progress.remaining_m <= 0.0:
            return self._progress.remaining_m
        targets = [*self._waypoints, self._goal]
        later_m = sum(math.dist(a, b) for a, b in itertools.pairwise(targets))
        return self._progress.remaining_m + later_m

    @property
    def waypoints_remaining(self) -> int:
        """Number of waypoints before the goal that are not passed yet."""
        return len(self._waypoints)

    @property
    def recoveries(self) -> int:
        """How often the robot had to stop in front of an obstacle since the goal was set."""
        return self._progress.recoveries

    def set_goal(
        self,
        x: float,
        y: float,
        theta: float | None = None,
        *,
        waypoints: Sequence[tuple[float, float]] = (),
    ) -> None:
        """Set a goal in the map frame, m, with an optional heading, rad.

        waypoints: places that are passed on the way, without a stop.
        """
        self._goal = (x, y)
        self._waypoints = list(waypoints)
        self._heading_rad = theta
        self.path = None
        self._progress = _Progress()
        self._stuck_places.goal_set()

    def reset_velocity(self) -> None:
        """Reset the commanded velocity: the robot was stopped from outside."""
        self._follower.override_speed(0.0, 0.0)

    def cancel(self) -> None:
        """Cancel the goal; the next steps bring the robot to rest."""
        self._goal = None
        self._waypoints = []
        self.path = None
        self._progress.remaining_m = 0.0

    def step(
        self, T_map_base: Array, patch: GridPatch, scan: Scan | Sequence[Scan] | None, dt_s: float
    ) -> Command:
        """Command for the next dt_s from the pose (3,), the current map and the newest scan.

        scan: of several lasers the newest of each. The same may be given again while the robot
        moves.
        """
        for each in [scan] if scan is None or isinstance(scan, Scan) else scan:
            self._obstacles.add_scan(T_map_base, each)
        self._recent_path.add_pose(T_map_base)
        self._stuck_places.add_pose(T_map_base)
        is_stuck = self._stuck_detector.add(T_map_base, self._follower.v, self._follower.w, dt_s)
        if self._goal is None:
            return Command(*self._follower.stop(dt_s), 'idle')
        if is_stuck:
            return self._stop_stuck(T_map_base, dt_s)
        while self._waypoints and self._passes_waypoint(T_map_base):
            self._waypoints.pop(0)
            self.path = None
            self._progress = _Progress(recoveries=self._progress.recoveries)
        if not self._waypoints and self._has_arrived(T_map_base):
            return self._finish_goal(T_map_base, dt_s)
        if self._needs_plan(T_map_base, patch, dt_s):
            reason = self._plan(T_map_base, patch)
            if reason:
                return self._wait(reason, dt_s)
        return self._drive(T_map_base, dt_s)

    def allowed(
        self,
        own: Motion,
        command: Command,
        others: Iterable[HeardMotion],
        distance_m: float,
        dt_s: float,
    ) -> Command:
        """The command, or one that gives way where the robot would come too near to another one.

        own: the motion that the command makes; others: those of the other robots; distance_m: from
        centre to centre; dt_s: time between two commands.
        """
        places = [each for heard in others for each in as_heard(*heard)]
        controller = self.config.controller
        brakes_s = controller.max_speed_m_s / controller.max_acceleration_m_s2
        if command.v <= 0.0 or not must_stop(own, places, distance_m, brakes_s):
            return command
        if command.state == 'reached':
            self._follower.override_speed(0.0, command.w)
            return replace(command, v=0.0)
        robots = np.array([each.pose[:2] for each in places])
        return self.give_way(command, dt_s, robots, distance_m)

    def give_way(self, command: Command, dt_s: float, robots: Array, distance_m: float) -> Command:
        """Command in place of one with which another robot would be touched: turn, or stand.

        robots (M, 2), m: where others are; a path around them, at least distance_m away, is planned
        soon. The goal is aborted after blocked_timeout_s without progress.
        """
        ring_m = distance_m + _RING_MARGIN_M - self.config.stop_radius_m
        self._progress.robots = (robots[:, None] + ring_m * _RING).reshape(-1, 2)
        self._progress.path_age_s = max(self._progress.path_age_s, _REPLAN_PERIOD_S - _REPLAN_S)
        self._progress.yielded_s += dt_s
        if self._progress.yielded_s > self.config.blocked_timeout_s:
            self.cancel()
            still = self._follower.override_speed(0.0, 0.0)
            return Command(*still, 'failed', _OTHER_ROBOT, is_timeout=True)
        turn = self._follower.override_speed(0.0, command.w)
        return Command(*turn, 'blocked', _OTHER_ROBOT)

    @property
    def _target(self) -> tuple[float, float]:
        """The next waypoint, or the goal."""
        assert self._goal is not None
        return self._waypoints[0] if self._waypoints else self._goal

    def _passes_waypoint(self, T_map_base: Array) -> bool:
        """Whether the robot is at the next waypoint, or so close that it would brake for it."""
        if self._has_arrived(T_map_base):
            return True
        if self.path is None:
            return False
        braking_m = self._follower.v**2 / (2.0 * self.config.controller.max_acceleration_m_s2)
        nearest = nearest_point(self.path, float(T_map_base[0]), float(T_map_base[1]))
        return length_from(self.path, nearest) <= min(braking_m, _MAX_WAYPOINT_PASS_M)

    def _has_arrived(self, T_map_base: Array) -> bool:
        """Whether the robot is at its target, or at the end of its path."""
        ends = [self._target] if self.path is None else [self._target, self.path[-1]]
        away_m = min(math.dist(end, T_map_base[:2]) for end in ends)
        return away_m <= self.config.xy_goal_tolerance_m

    def _finish_goal(self, T_map_base: Array, dt_s: float) -> Command:
        self._progress.remaining_m = 0.0
        if self._heading_rad is not None:
            error = se2.wrap(self._heading_rad - float(T_map_base[2]))
            if abs(error) > self.config.yaw_goal_tolerance_rad:
                v, w = self._follower.turn_to(T_map_base, self._heading_rad, dt_s)
                return Command(v, w, 'driving')
        self.cancel()
        return Command(*self._follower.stop(dt_s), 'reached')

    def _needs_plan(self, T_map_base: Array, patch: GridPatch, dt_s: float) -> bool:
        changed = patch is not self._patch
        self._patch = patch
        self._progress.path_age_s += dt_s
        if self.path is None or self._progress.path_age_s >= _REPLAN_PERIOD_S:
            return True
        x = float(T_map_base[0])
        y = float(T_map_base[1])
        nearest = nearest_point(self.path, x, y)
        strayed = (
            math.dist(self.path[nearest], (x, y))
            > 2.0 * self.config.controller.lookahead_distance_m
        )
        return bool(strayed or (changed and self._is_blocked(nearest, patch)))

    def _is_blocked(self, first: int, patch: GridPatch) -> bool:
        """Whether an obstacle is closer to the next metres of the path than the robot radius."""
        assert self.path is not None
        steps = int(2.0 * self.config.check_ahead_m / patch.frame.resolution)
        ahead = self.path[first : first + max(1, steps)]
        return path_collides(patch, ahead, self.config.planner.robot_radius_m)

    def _plan(self, T_map_base: Array, patch: GridPatch) -> str:
        """Replan; returns why there is no path, or an empty text.

        While the robot is blocked, scan points count as obstacles, too.
        """
        path = self._find_path(T_map_base, patch)
        first = self.path is None
        self._progress.path_age_s = 0.0
        if path is None:
            self.path = None
            where = f'({self._target[0]:.2f}, {self._target[1]:.2f})'
            never = first and self._progress.blocked_s == 0.0
            return f'{NO_PATH} to {where}' if never else f'the path to {where} is blocked'
        self.path = path
        return ''

    def _find_path(self, T_map_base: Array, patch: GridPatch) -> Array | None:
        """Path to the target, along a route on the graph if it is far; None: no path."""
        start = float(T_map_base[0]), float(T_map_base[1])
        obstacles = self._extra_obstacles(T_map_base)
        # Not along a route again after the target was near: two paths could alternate.
        self._progress.is_near |= math.dist(start, self._target) < LONG_PATH_M
        if self.topology is not None and not self._progress.is_near:
            config = self.config.planner
            band = route_band(self.topology, patch, start, self._target, config, obstacles)
            path = None if band is None else self._plan_in_band(start, band, obstacles)
            if path is not None:
                return path
        trail = self._recent_path.cells(patch.frame, patch.shape)
        return plan_short_path(patch, start, self._target, self.config.planner, obstacles, trail)

    def _extra_obstacles(self, T_map_base: Array) -> Obstacles | None:
        """What the map need not contain: places where the robot was stuck, and points of scans.

        These while it is blocked. None for nothing.
        """
        points = np.concatenate([self._stuck_places.points(), self._progress.robots])
        if self._progress.blocked_s > 0.0:
            reach_m = self.config.scan_obstacle_range_m
            points = np.concatenate([points, self._obstacles.query_radius(T_map_base, reach_m)])
        elif not len(points):
            return None
        return Obstacles(points, self.config.stop_radius_m)

    def _plan_in_band(
        self, start: tuple[float, float], band: Band, obstacles: Obstacles | None
    ) -> Array | None:
        """Path to the target by wavefront, over the cells of a band only."""
        trail = self._recent_path.cells(band.patch.frame, band.patch.shape)
        config = self.config.planner
        found = find_path(band.patch, start, self._target, config, obstacles, trail, band.cells)
        return None if found is None else found.points

    def _wait(self, reason: str, dt_s: float) -> Command:
        """Stop; abort the goal if there was never a path, or after blocked_timeout_s."""
        never = reason.startswith(NO_PATH)
        self._progress.blocked_s += dt_s
        self._progress.remaining_m = 0.0
        if never or self._progress.blocked_s > self.config.blocked_timeout_s:
            self.cancel()
            return Command(*self._follower.stop(dt_s), 'failed', reason, is_timeout=not never)
        return Command(*self._follower.stop(dt_s), 'blocked', reason)

    def _drive(self, T_map_base: Array, dt_s: float) -> Command:
        assert self.path is not None
        nearest = nearest_point(self.path, float(T_map_base[0]), float(T_map_base[1]))
        self._progress.remaining_m = length_from(self.path, nearest)
        if self._progress.remaining_m < self._progress.nearest_m - self.config.progress_m:
            self._progress.standstills = 0
            self._progress.yielded_s = 0.0
            self._progress.robots = np.empty((0, 2))
            self._progress.nearest_m = self._progress.remaining_m
        before = (self._follower.v, self._follower.w)
        room = self._obstacles.clearance_along(self.path, nearest, self.config.clearance_ahead_m)
        v, w = self._follower.command(T_map_base, self.path, dt_s, room - self.config.stop_radius_m)
        if v <= 0.0:
            return Command(v, w, 'driving')
        allowed = self._safe_speed(T_map_base, v, w, self.config.stop_radius_m)
        if allowed >= v - _ROUNDING_M_S:
            self._progress.blocked_s = 0.0
            return Command(v, w, 'driving')
        slowest = before[0] - self.config.controller.max_acceleration_m_s2 * dt_s
        if allowed > max(self.config.creep_speed_m_s, slowest):
            # Drive slower on the same arc.
            return Command(*self._follower.override_speed(allowed, w * allowed / v), 'driving')
        squeezed = self._narrow_passage_speed(
            T_map_base, min(v, self.config.narrow_speed_m_s), w / v
        )
        if squeezed > self.config.creep_speed_m_s and slowest <= squeezed:
            return Command(*self._follower.override_speed(squeezed, w * squeezed / v), 'driving')
        self._follower.override_speed(*before)
        brakes = slowest > 0.0
        return self._brake(T_map_base, dt_s) if brakes else self._face_obstacle(T_map_base, dt_s)

    def _brake(self, T_map_base: Array, dt_s: float) -> Command:
        """Brake on the present arc; stop at once if an obstacle has come into it."""
        before = self._follower.v
        v, w = self._follower.stop(dt_s)
        if self._safe_speed(T_map_base, before, w * before / v, self.config.stop_radius_m) < v:
            v, w = self._follower.override_speed(0.0, 0.0)
        return Command(v, w, 'driving')

    def _stop_stuck(self, T_map_base: Array, dt_s: float) -> Command:
        """Stop a robot that does not move, and plan around the place; again: abort."""
        is_turning = self._stuck_detector.is_turning
        is_repeated = self._stuck_places.add_stuck(T_map_base, is_turning)
        still = self._follower.override_speed(0.0, 0.0)
        self.path = None
        self._progress.standstills += 1
        self._progress.recoveries += 1
        self._progress.blocked_s += dt_s
        if is_repeated or self._progress.standstills > self.config.max_standstills:
            self.cancel()
            return Command(*still, 'failed', _STUCK)
        return Command(*still, 'blocked', _STUCK)

    def _face_obstacle(self, T_map_base: Array, dt_s: float) -> Command:
        """Act in front of an obstacle: rotate towards the path, else replan, else abort."""
        assert self.path is not None
        reason = _HIDDEN if self._obstacles.is_hidden else _OBSTACLE
        if self._progress.blocked_s == 0.0:
            self._progress.standstills += 1
            self._progress.recoveries += 1
        self._progress.blocked_s += dt_s
        is_timeout = self._progress.blocked_s > self.config.blocked_timeout_s
        if is_timeout or self._progress.standstills > self.config.max_standstills:
            self.cancel()
            still = self._follower.override_speed(0.0, 0.0)
            return Command(*still, 'failed', reason, is_timeout)
        heading = self._heading_of_path(T_map_base)
        if abs(se2.wrap(heading - float(T_map_base[2]))) > self.config.aim_tolerance_rad:
            return Command(*self._follower.turn_to(T_map_base, heading, dt_s), 'driving')
        self._progress.path_age_s = max(self._progress.path_age_s, _REPLAN_PERIOD_S - _REPLAN_S)
        return Command(*self._follower.override_speed(0.0, 0.0), 'blocked', reason)

    def _heading_of_path(self, T_map_base: Array) -> float:
        assert self.path is not None
        nearest = nearest_point(self.path, float(T_map_base[0]), float(T_map_base[1]))
        ahead = self.path[min(nearest + 3, len(self.path) - 1)]
        return se2.bearing(T_map_base, ahead)

    def _narrow_passage_speed(self, T_map_base: Array, v: float, curvature: float) -> float:
        """Highest speed up to v through a passage hardly wider than the robot.

        There the noise of the ranges exceeds the margin.
        """
        radius_m = max(self.config.stop_radius_m - self.config.narrow_margin_m, 0.0)
        return self._safe_speed(T_map_base, v, v * curvature, radius_m)

    def _safe_speed(self, T_map_base: Array, v: float, w: float, radius_m: float) -> float:
        """Highest speed up to v at which the robot stops before a point comes within radius_m.

        What moves is taken to be as fast as this robot may be.
        """
        braking = self.config.controller.max_acceleration_m_s2
        needed = v * self.config.reaction_time_s + v * v / (2.0 * braking)
        late = self.config.reaction_time_s
        moved_m = self.config.controller.max_speed_m_s * late
        free_m = self._obstacles.free_arc_length_m(T_map_base, w / v, needed, radius_m, moved_m)
        return min(v, braking * (math.sqrt(late * late + 2.0 * free_m / braking) - late))
