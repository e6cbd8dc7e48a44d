"""A lost robot that drives where the places in question differ most, to find itself sooner."""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.merge_viewpoints import Viewpoint, best_viewpoint
from thinmap_ros.core.places.config import GlobalLocalizationConfig
from thinmap_ros.core.places.global_localizer import Result
from thinmap_ros.core.places.place_database import Places
from thinmap_ros.core.planning.navigator import Command, Navigator, NavigatorConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_LIKELY = 0.05  # of the weight of the best
# A goal stands so long, or until it is reached, or the number of places in question changes.
_THOUGHT_OVER_S = 4.0
_CHANGED_S = 1.0  # but for so long at least
# A look from elsewhere
_LOOK_M = 0.4
_LOOK_RAD = 0.4


class ActiveSearch:
    """From what is known of a lost robot to velocities, in the odometry's frame.

    No place in the map is needed.
    The goal is where the views from the places in question differ most for the way; the path leads
    over what the map says is free for all of them, and the navigator stops in front of what the
    laser sees. Where one place only is in question, any way confirms it; where nothing in reach
    tells the places apart, the robot goes on to what it has not looked at yet, and stands only
    where there is no such thing.
    """

    def __init__(
        self, places: Places, config: GlobalLocalizationConfig, driving: NavigatorConfig
    ) -> None:
        self._places = places
        self._range_m = config.usable_range_m
        self._driving = driving
        self._navigator = Navigator(driving)
        self._view: Viewpoint | None = None
        self._starts = np.empty((0, 3))
        self._weights = np.empty(0)
        self._looked = np.empty((0, 3))
        self._chosen_of = 0
        self._age_s = math.inf

    def take(self, result: Result, T_odom_base: Array) -> None:
        """Hear what a look at an odometry pose (3,) has brought."""
        self._look(T_odom_base)
        most = max((h.weight for h in result.hypotheses), default=0.0)
        likely = [h for h in result.hypotheses if h.weight >= _LIKELY * most]
        T_base_odom = se2.invert(T_odom_base)
        starts = np.array([se2.compose(h.T_map_base, T_base_odom) for h in likely])
        self._starts = starts.reshape(-1, 3)
        self._weights = np.array([h.weight for h in likely])

    def _look(self, T_odom_base: Array) -> None:
        """Remember where the robot has looked from."""
        away = self._looked - T_odom_base
        near = np.hypot(away[:, 0], away[:, 1]) < _LOOK_M
        if not (near & (np.abs(se2.wrap(away[:, 2])) < _LOOK_RAD)).any():
            self._looked = np.concatenate([self._looked, T_odom_base[None]])

    def step(self, T_odom_base: Array, scan: Scan, dt_s: float) -> Command:
        """Command for the next dt_s of a robot at an odometry pose (3,).

        Idle where there is nothing to drive to.
        """
        self._age_s += dt_s
        changed = len(self._starts) != self._chosen_of and self._age_s > _CHANGED_S
        if changed or self._age_s > _THOUGHT_OVER_S:
            self._choose(T_odom_base)
        if self._view is None:
            reason = 'nothing in reach tells the places apart, and all was looked at'
            return Command(0.0, 0.0, 'idle', reason)
        command = self._navigator.step(T_odom_base, self._view.patch, scan, dt_s)
        if command.state in ('reached', 'failed', 'idle'):
            self._age_s = math.inf
        return command

    def _choose(self, T_odom_base: Array) -> None:
        self._age_s = 0.0
        self._chosen_of = len(self._starts)
        self._view = None
        if len(self._starts):
            self._view = best_viewpoint(
                self._places,
                T_odom_base,
                self._starts,
                self._weights,
                self._range_m,
                self._driving,
                self._looked,
            )
        if self._view is None:
            self._navigator.cancel()
        else:
            self._navigator.set_goal(*self._view.T_odom_view.tolist())
