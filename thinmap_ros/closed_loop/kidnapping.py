"""A robot in the simulator that is carried elsewhere once, and has to find its place again."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from thinmap_ros.closed_loop.robot import CONTROL_PERIOD_S, Options, SimulatedRobot
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.places.active_search import ActiveSearch
from thinmap_ros.core.places.global_localizer import GlobalLocalization
from thinmap_ros.core.planning.path_follower import HeardMotion
from thinmap_ros.core.scan import Scan, with_newest
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.stage import Estimate
from thinmap_ros.sim.simulation import Simulation

_FAR_M = 3.0  # the robot is put so far from its place, or farther
_WALL_MARGIN_M = 0.1
# Largest errors of a right pose.
_RIGHT_M = 0.5
_RIGHT_RAD = math.radians(10.0)


@dataclass(eq=False)
class _Search:
    """Global localization of a lost robot, and the drives that tell the places in question apart.

    scans: the newest of each laser.
    """

    finder: GlobalLocalization
    driver: ActiveSearch
    scans: tuple[Scan, ...] = ()


class KidnappedRobot(SimulatedRobot):
    """A robot that is teleported once to a random place of its map.

    When its localizer is lost, global localization starts, and drives the robot, as the node
    global_localizer does, to where the places in question differ.
    """

    def __init__(self, simulation: Simulation, options: Options, name: str = 'robot1') -> None:
        assert options.kidnap_at_s is not None
        super().__init__(simulation, options, name)
        self._at_s = options.kidnap_at_s
        self._seed = options.seed
        self._carried_s: float | None = None
        self._detected_s: float | None = None
        self._found_s: float | None = None
        self._off: Array | None = None
        self._travelled_m = 0.0
        self._search: _Search | None = None

    def report(self) -> dict[str, Any]:
        """Results for the report: times in s, None for events that did not happen."""

        def after(since: float | None, until: float | None) -> float | None:
            return None if since is None or until is None else round(until - since, 3)

        off = self._off
        right: bool | None = None
        if off is not None:
            right = bool(math.hypot(off[0], off[1]) <= _RIGHT_M and abs(off[2]) <= _RIGHT_RAD)
        return {
            'kidnapped_at_s': self._carried_s,
            'detected_after_s': after(self._carried_s, self._detected_s),
            'found_after_s': after(self._detected_s, self._found_s),
            'found_after_m': None if self._found_s is None else round(self._travelled_m, 3),
            'found_error_m': None if off is None else round(math.hypot(off[0], off[1]), 3),
            'found_right': right,
        }

    @property
    def is_finished(self) -> bool:
        """As SimulatedRobot.is_finished; not as long as the robot is lost."""
        return super().is_finished and self._search is None

    def sense(self) -> None:
        """As SimulatedRobot.sense; what it sees just before it is carried is lost."""
        super().sense()
        seconds = self.moment.stamp_ns / SECOND_NS
        if self._carried_s is None and self.moment.scans and seconds >= self._at_s:
            self._kidnap()
            self._carried_s = seconds
            self.moment = replace(self.moment, scans=())

    def map_scan(self, scan: Scan) -> Estimate | None:
        """As SimulatedRobot.map_scan; nothing is decided while the robot is lost."""
        if self._search is not None:
            self._look(self._search, scan)
            return None
        estimate = super().map_scan(scan)
        return estimate if self._search is None else None

    def log_poses(self, scan: Scan, estimate: Estimate) -> None:
        """As SimulatedRobot.log_poses; global localization starts when the robot is lost."""
        super().log_poses(scan, estimate)
        is_known = self._carried_s is None or self._found_s is not None
        if is_known or self._search is not None or not estimate.is_lost:
            return
        self._detected_s = scan.stamp_ns / SECOND_NS
        patch = self.pipeline.grid.known_area()
        finder = GlobalLocalization(patch, self.pipeline.topology.map, seed=self._seed)
        driver = ActiveSearch(finder.places, finder.config, self.navigator.config)
        self._search = _Search(finder, driver)
        self.decide_anew()

    def control(self, others: Iterable[HeardMotion]) -> None:
        """As SimulatedRobot.control; a lost robot drives to where it learns its place."""
        if self._search is None:
            super().control(others)
            return
        if self._search.scans:
            T_odom_base = self.moment.T_odom_base
            command = self._search.driver.step(T_odom_base, self._search.scans, CONTROL_PERIOD_S)
            self.command = (command.v, command.w)

    def _kidnap(self) -> None:
        """Teleport the robot to a random mapped place far from its position."""
        world = self.simulation.world
        patch = self.pipeline.grid.known_area()
        at = patch.frame.centres_of(np.argwhere(patch.free))
        at = at[np.hypot(*(at - self.simulation.robot.T_world_base[:2]).T) >= _FAR_M]
        fits = [world.is_clear(x, y, self.radius_m + _WALL_MARGIN_M) for x, y in at.tolist()]
        if not any(fits) or not self.pipeline.topology.map.nodes:
            raise InputError(
                f'--kidnap-at-s={self._at_s:g}: no mapped place with a graph is {_FAR_M:g} m away: '
                'expected a later time'
            )
        rng = np.random.default_rng(self._seed)
        x, y = rng.choice(at[fits])
        yaw = float(rng.uniform(-math.pi, math.pi))
        self.simulation.teleport(se2.pose(float(x), float(y), yaw))

    def _look(self, search: _Search, scan: Scan) -> None:
        """Process a scan of a lost robot, with both of its localizers."""
        localizer = self.pipeline.localizer
        T_odom_base = self.moment.T_odom_base
        T_world_base = self.simulation.robot.T_world_base
        estimate = self.pipeline.step(scan, T_odom_base).estimate
        self._travelled_m += float(np.hypot(*(T_world_base - self.log.true_poses[-1])[:2]))
        self.log_poses(scan, estimate)
        result = search.finder.step(scan, T_odom_base)
        search.driver.take(result, T_odom_base)
        search.scans = with_newest(search.scans, scan)
        found = result.pose
        if found is not None:
            localizer.set_pose(found.T_map_base, found.covariance)
        if found is not None or not estimate.is_lost:
            self._found_s = scan.stamp_ns / SECOND_NS
            self._off = se2.between(T_world_base, localizer.pose)
            self._search = None
            self.decide_anew()
