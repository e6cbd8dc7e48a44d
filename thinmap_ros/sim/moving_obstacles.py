"""Moving obstacles of a world: pedestrians and doors."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array, Mask


@dataclass(frozen=True, eq=False)
class Pedestrians:
    """Pedestrians; each walks in a loop along its points and pauses at each of them.

    points (N, K, 2), m, world frame; speeds (N,), m/s; pauses (N, K), s.
    """

    points: Array
    speeds: Array
    pauses: Array
    radius_m: float = 0.2
    personal_space_m: float = 0.7  # they avoid the robot

    @cached_property
    def _times(self) -> Array:
        """Times at which each arrives at and leaves each of its points, (N, 2 K + 1), s."""
        legs = np.hypot(*np.moveaxis(np.roll(self.points, -1, axis=1) - self.points, 2, 0))
        spans = np.stack([self.pauses, legs / self.speeds[:, None]], axis=2)
        ends = np.cumsum(spans.reshape(len(self.points), 2 * self.points.shape[1]), axis=1)
        return np.concatenate([np.zeros((len(self.points), 1)), ends], axis=1)

    @cached_property
    def _stations(self) -> Array:
        """Positions at these times, (N, 2 K + 1, 2)."""
        twice = np.repeat(self.points, 2, axis=1)
        return np.concatenate([twice, self.points[:, :1]], axis=1)

    def places(self, seconds: float) -> Array:
        """Positions (N, 2) at a time."""
        now = seconds % self._times[:, -1]
        who = np.arange(len(now))
        span = (self._times[:, 1:-1] <= now[:, None]).sum(axis=1)
        begun = self._times[who, span]
        ended = self._times[who, span + 1]
        share = (now - begun) / (ended - begun)
        start = self._stations[who, span]
        goal = self._stations[who, span + 1]
        return np.asarray(start + share[:, None] * (goal - start))


@dataclass(frozen=True, eq=False)
class Doors:
    """Door leaves: hinges (N, 2), m; ends (N, 2) of the closed leaf, m.

    Each changes its angle after every period_s (N,) (inf: never). In the k-th of K periods, which
    repeat, it is open by open_rad (N, K), or closed where is_shut (N, K).
    """

    hinges: Array
    ends: Array
    period_s: Array
    open_rad: Array
    is_shut: Mask
    held_open_m: float = 3.0  # for a robot that is nearer

    def segments(self, seconds: float, robot: Array, reach_m: float) -> Array:
        """Leaves (M, 4) near a robot (x, y): from the hinge to the present end, m."""
        away = np.hypot(*(self.hinges - robot).T)
        near = np.flatnonzero(away < reach_m)
        return self._leaves(near, self._angles(near, seconds, away[near] < self.held_open_m))

    def standing(self) -> Array:
        """Leaves (M, 4) that never move: open, with no period; as `segments`."""
        never = np.flatnonzero(np.isinf(self.period_s) & ~self.is_shut[:, 0])
        return self._leaves(never, self.open_rad[never, 0])

    def _leaves(self, doors: NDArray[np.int64], angles: Array) -> Array:
        """Leaves (M, 4) of some doors at opening angles, rad: from the hinge to the end, m."""
        shut = self.ends[doors] - self.hinges[doors]
        c = np.cos(angles)
        s = np.sin(angles)
        ends = np.column_stack([c * shut[:, 0] - s * shut[:, 1], s * shut[:, 0] + c * shut[:, 1]])
        return np.column_stack([self.hinges[doors], self.hinges[doors] + ends])

    def _angles(self, doors: NDArray[np.int64], seconds: float, held: Mask) -> Array:
        """Opening angles of some doors, rad; doors held open do not close."""
        period = (seconds // self.period_s[doors]).astype(np.int64) % self.open_rad.shape[1]
        shut = self.is_shut[doors, period] & ~held
        return np.where(shut, 0.0, self.open_rad[doors, period])


@dataclass(frozen=True, eq=False)
class MovingObstacles:
    """All moving obstacles of a world."""

    pedestrians: Pedestrians
    doors: Doors

    def ranges(self, seconds: float, T_world_laser: Array, angles: Array, reach_m: float) -> Array:
        """Distance, m, at which beams (N,) at world angles hit one of them; inf: none."""
        laser = T_world_laser[:2]
        people = self.pedestrians
        places = people.places(seconds)
        away = np.hypot(*(places - laser).T)
        places = places[(away > people.personal_space_m) & (away < reach_m + people.radius_m)]
        beams = np.column_stack([np.cos(angles), np.sin(angles)])
        nearest = np.full(len(angles), np.inf)
        for place in places:
            np.minimum(nearest, range_to_disc(place - laser, people.radius_m, beams), out=nearest)
        for leaf in self.doors.segments(seconds, laser, reach_m + 3.0):
            np.minimum(nearest, _to_segment(leaf[:2] - laser, leaf[2:] - laser, beams), out=nearest)
        return nearest


def range_to_disc(centre: Array, radius_m: float, beams: Array) -> Array:
    """Distance along unit vectors (N, 2) to a disc; inf if they miss it."""
    along = beams @ centre
    across = beams[:, 0] * centre[1] - beams[:, 1] * centre[0]
    hits = (along > 0.0) & (np.abs(across) < radius_m)
    half = np.sqrt(np.maximum(radius_m**2 - across**2, 0.0))
    return np.where(hits, along - half, np.inf)


def _to_segment(a: Array, b: Array, beams: Array) -> Array:
    """Distance along unit vectors (N, 2) to a segment from a to b; inf if they miss it."""
    side = b - a
    turned = beams[:, 0] * side[1] - beams[:, 1] * side[0]
    safe = np.where(turned == 0.0, 1.0, turned)
    distance = (a[0] * side[1] - a[1] * side[0]) / safe
    share = (a[0] * beams[:, 1] - a[1] * beams[:, 0]) / safe
    hits = (turned != 0.0) & (distance > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.where(hits, distance, np.inf)
