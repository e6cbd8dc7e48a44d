"""Loops: coming back by another way, noticed, verified, and what it means for the whole path.

Along the path a scan is kept now and then. Where the path has been near before, it is matched with the scans kept
there: now and then with those of one visit where that agrees with the map, always and with more where it does not. A
match counts that fits well; of matches that tell the place sharply, several along the way that ask for one and the
same correction make a loop. What the localizer says of neighbours on the path, and the matches of the others, make a
graph of poses that is relaxed; should the matches that asked for it not be content then, nothing is corrected.
A keyframe costs its scan, its pose and a few measurements in memory, and a few matches in time, one a step.
Source: Lu and Milios, "Globally consistent range scan alignment for environment mapping", 1997; for the graph see
pose_graph.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.grid.buckets import Buckets
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.pose_graph import Measured, relax
from thinmap_ros.core.slam.scan_matching import Match, MatchConfig, ScanMatcher

_AROUND = 4  # keyframes to either side that make a submap
_AGAIN_M = 8.0  # so much way lies between leaving a place and coming back to it
_VISITS = 3  # earlier visits to a place with which a scan is matched, at most
_TURN_M_RAD = 1.0  # a radian of turn makes two scans as different as so many metres
# Bounds of the error of a step from one keyframe to the next, in m and in rad.
_STEP_M, _STEP_RAD = (0.002, 0.02), (0.0002, 0.02)
_LEAP_SIGMAS = (0.1, 0.1, 0.05)  # the same where wheels and walls contradicted each other
_MATCH_SIGMAS = (0.04, 0.04, 0.02)  # matches err together, by more than each says of itself
_PRIOR_SIGMAS = (0.3, 0.3, 0.15)
_LEAST_OVERLAP, _LEAST_FIT = 0.5, 0.85
_DRIFT = 0.01  # of the way since the earlier visit, by which the place may be off, beyond the first metres
_FARTHEST_M = 2.5  # and no more than this
_SEARCHED_M = 0.3  # from this on a good match near by is not taken without looking around
_SEARCH_DEG = 12.0
_SHARP_M = 0.1  # a match that leaves more than this open (1 sigma), as along a corridor, proves no loop
_WITNESSES = 3  # matches of different keyframes that have to ask for the same correction
_LATELY = 8  # keyframes back to which they count
_ALIKE_M, _ALIKE_RAD = 0.2, 0.06  # by how much they may differ
_WORTH_M, _WORTH_RAD = 0.12, 0.04  # smaller corrections are left to the end
_BUCKET_M = 4.0  # keyframes are listed by squares of this size
_FRESH_M = 1.0  # so much way after a match that agrees, no other one is asked for
_HOLDS_M = 3.0  # so much way after it, the old map is still trusted


@dataclass(frozen=True)
class LoopConfig(Config):
    """Parameters of keyframes and loops."""

    keyframe_m: float = parameter(0.7, 'a scan is kept after so much way, m', low=0.1, high=10.0)
    keyframe_rad: float = parameter(0.7, 'or after such a turn, rad', low=0.1, high=3.2)
    loop_reach_m: float = parameter(2.0, 'places nearer than this are matched, m', low=0.1, high=20.0)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A scan that was kept, its points (N, 2) in the robot frame, its pose (3,), and the way up to there."""

    scan: Scan
    points_base: Array
    T_map_base: Array
    way_m: float


@dataclass(frozen=True, eq=False)
class Correction:
    """Poses (N, 3) of the keyframes before and after a loop was closed."""

    before: Array
    after: Array

    def moved(self, k: int, T: Array) -> Array:
        """Where a pose (3,) that was found from keyframe k is now."""
        return se2.compose(self.after[k], se2.between(self.before[k], T))


class Loops:
    """The kept scans and the graph of their poses."""

    def __init__(self, config: LoopConfig, matching: MatchConfig) -> None:
        self.keyframes: list[Keyframe] = []
        self.matched: list[Measured] = []
        self._steps: list[Array] = []  # from each keyframe to the next, as the localizer saw it
        self._leaps: set[int] = set()  # of these, those where wheels and walls contradict each other
        self._config, self._matching = config, matching
        self._jobs: deque[tuple[int, int]] = deque()
        self._leapt = False
        self._witnesses: deque[Measured] = deque(maxlen=_WITNESSES)
        self._agreed_at_m = -math.inf
        self._places = Buckets(_BUCKET_M)  # of the keyframes

    def follow(self, scan: Scan, points_base: Array, T_map_base: Array, leapt: bool) -> None:
        """Take in a scan that fits the map at a pose (3,), with its points (N, 2).

        leapt: whether the pose is not where the wheels said, so that one of them is wrong.
        """
        self._leapt |= leapt
        if not self._is_apart(T_map_base):
            return
        way = self.way_m(T_map_base)
        k = len(self.keyframes)
        self.keyframes.append(Keyframe(scan, points_base, T_map_base, way))
        self._places.put(k, float(T_map_base[0]), float(T_map_base[1]))
        if k > 0:
            self._steps.append(se2.between(self.keyframes[k - 1].T_map_base, T_map_base))
            if self._leapt:
                self._leaps.add(k - 1)
                self._jobs.append((k - 1, k))
            if way - self._agreed_at_m > _FRESH_M:
                self._jobs.extend((j, k) for j in self._earlier_visits(k))
        self._leapt = False

    def work_off(self) -> None:
        """Do one of the matches that are due; to be called once a step."""
        if self._jobs:
            j, k = self._jobs.popleft()
            match = self._match(j, k)
            if match.overlap >= _LEAST_OVERLAP and match.fit >= _LEAST_FIT:
                covariance = match.covariance + np.diag(np.square(_MATCH_SIGMAS))
                self.matched.append(Measured(j, k, match.T_map_base, np.linalg.inv(covariance), True))
                if k - j > 1 and math.sqrt(match.covariance[:2, :2].trace()) < _SHARP_M:
                    self._hear(self.matched[-1])
            while k - j > 1 and self.agreed and self._jobs and self._jobs[0][1] == k:
                self._jobs.popleft()  # where nothing disagrees, one visit says what the others would

    @property
    def agreed(self) -> bool:
        """Whether, where the robot is now, what it maps agrees with what it mapped on earlier visits."""
        return bool(self.keyframes) and self.keyframes[-1].way_m - self._agreed_at_m <= _HOLDS_M

    def close(self) -> Correction | None:
        """The correction that a verified loop asks for, which the keyframes have then undergone; mostly None."""
        if not self._is_loop():
            return None
        witnesses, self._witnesses = list(self._witnesses), deque(maxlen=_WITNESSES)
        before = np.array([k.T_map_base for k in self.keyframes])
        after = self._relax(before)
        asked, left = (max(_size(_off(poses[m.a], poses[m.b], m)) for m in witnesses) for poses in (before, after))
        if left > 0.5 * asked:
            # The graph does not bend so far: either these are wrong, or much else is. They do not count.
            self.matched = [m for m in self.matched if m not in witnesses]
            return None
        self.keyframes = [replace(f, T_map_base=T) for f, T in zip(self.keyframes, after, strict=True)]
        for k, (x, y, _) in enumerate(after.tolist()):
            self._places.put(k, x, y)
        self._agreed_at_m = self.keyframes[-1].way_m
        return Correction(before, after)

    def _hear(self, measured: Measured) -> None:
        """Take a sharp match of the latest keyframes as a witness, for the map as it is or for a loop."""
        off = _off(self.keyframes[measured.a].T_map_base, self.keyframes[measured.b].T_map_base, measured)
        if math.hypot(off[0], off[1]) < _WORTH_M and abs(off[2]) < _WORTH_RAD:
            self._agreed_at_m = max(self._agreed_at_m, self.keyframes[measured.b].way_m)
            self._witnesses.clear()
        elif not self._witnesses or self._witnesses[-1].b != measured.b:
            self._witnesses.append(measured)

    def _is_loop(self) -> bool:
        """Whether enough matches of late ask for the same correction of the place where the robot is."""
        if len(self._witnesses) < _WITNESSES or self._witnesses[0].b < len(self.keyframes) - _LATELY:
            return False
        frames = self.keyframes
        asked = np.array(
            [se2.compose(frames[m.a].T_map_base, m.T_a_b) - frames[m.b].T_map_base for m in self._witnesses]
        )
        asked[:, 2] = se2.wrap(asked[:, 2])
        return bool(np.ptp(asked[:, :2], axis=0).max() < _ALIKE_M and np.ptp(asked[:, 2]) < _ALIKE_RAD)

    def relaxed(self) -> Array:
        """Poses (N, 3) of the keyframes that agree best with all measurements."""
        while self._jobs:
            self.work_off()
        return self._relax(np.array([k.T_map_base for k in self.keyframes]).reshape(-1, 3))

    def _relax(self, poses: Array) -> Array:
        usual, leap = (np.diag(1.0 / np.square(sigmas)) for sigmas in (self._step_sigmas(poses), _LEAP_SIGMAS))
        steps = [
            Measured(k, k + 1, step, leap if k in self._leaps else usual, False) for k, step in enumerate(self._steps)
        ]
        return relax(poses, steps + self.matched)

    def _step_sigmas(self, poses: Array) -> Array:
        """How much a step adds to the drift, (3,), as told by what loops find after many steps.

        A localizer that holds on to its map adds next to nothing. To believe in more would let small errors of the
        matches bend a path that is straight.
        """
        found = [(_off(poses[m.a], poses[m.b], m), m.b - m.a) for m in self.matched if m.b - m.a > 1]
        squared = np.array([np.square(off) / number for off, number in found]).reshape(-1, 3)
        if len(squared) == 0:
            return np.array([_STEP_M[0], _STEP_M[0], _STEP_RAD[0]])
        along = float(np.clip(math.sqrt(0.5 * np.median(squared[:, 0] + squared[:, 1])), *_STEP_M))
        return np.array([along, along, np.clip(math.sqrt(np.median(squared[:, 2])), *_STEP_RAD)])

    def way_m(self, T_map_base: Array) -> float:
        """Length of the path up to a pose (3,), m, in straight lines from keyframe to keyframe."""
        if not self.keyframes:
            return 0.0
        return self.keyframes[-1].way_m + math.dist(self.keyframes[-1].T_map_base[:2], T_map_base[:2])

    def _is_apart(self, T_map_base: Array) -> bool:
        """Whether a pose is far enough from the last keyframe to be one."""
        if not self.keyframes:
            return True
        moved = se2.between(self.keyframes[-1].T_map_base, T_map_base)
        turned = abs(float(moved[2])) >= self._config.keyframe_rad
        return turned or math.hypot(moved[0], moved[1]) >= self._config.keyframe_m

    def _earlier_visits(self, k: int) -> list[int]:
        """The keyframe most like this one of each of the earlier visits to the place, the likest first."""
        here = self.keyframes[k]
        farthest = self._config.loop_reach_m + _FARTHEST_M
        near = self._places.near(float(here.T_map_base[0]), float(here.T_map_base[1]), farthest)
        frames = [self.keyframes[i] for i in near]
        poses, ways = np.array([f.T_map_base for f in frames]), np.array([f.way_m for f in frames])
        distances = np.hypot(*(poses[:, :2] - here.T_map_base[:2]).T)
        unlike = distances + _TURN_M_RAD * np.abs(se2.wrap(poses[:, 2] - here.T_map_base[2]))
        unlike[(distances > self._reach(here.way_m - ways)) | (ways > here.way_m - _AGAIN_M)] = np.inf
        found: list[int] = []
        while len(found) < _VISITS and np.isfinite(unlike).any():
            likest = int(unlike.argmin())
            found.append(near[likest])
            unlike[np.abs(ways - ways[likest]) < _AGAIN_M] = np.inf
        return found

    def _reach(self, way_m: Array) -> Array:
        """How far from a place that was left so much way ago, (N,), the robot may seem to be when it is back, m."""
        return np.asarray(self._config.loop_reach_m + np.minimum(_DRIFT * way_m, _FARTHEST_M))

    def _match(self, j: int, k: int) -> Match:
        """Keyframe k matched with j and those around it, in the frame of j."""
        base, here = self.keyframes[j].T_map_base, self.keyframes[k]
        drift = min(_DRIFT * (here.way_m - self.keyframes[j].way_m), _FARTHEST_M)
        matcher = ScanMatcher(replace(self._matching, search_m=self._matching.search_m + drift, search_deg=_SEARCH_DEG))
        for frame in self.keyframes[max(0, j - _AROUND) : min(j + _AROUND + 1, k)]:
            T = se2.between(base, frame.T_map_base)
            laser = se2.transform_points(T, frame.scan.T_base_laser[None, :2])[0]
            matcher.add(se2.transform_points(T, frame.points_base), laser)
        prior = se2.between(base, here.T_map_base)
        return matcher.match(
            here.points_base,
            np.ascontiguousarray(here.scan.T_base_laser[:2]),
            prior,
            np.diag(np.square(_PRIOR_SIGMAS) + [drift**2, drift**2, 0.0]),
            search=drift > _SEARCHED_M and not self.agreed,
            lost=True,  # drift is not what wheels do from scan to scan
        )


def _size(off: Array) -> float:
    """Length of an error (3,), m; a radian counts as a metre."""
    return math.hypot(*off)


def _off(T_a: Array, T_b: Array, measured: Measured) -> Array:
    """What a match says of two poses (3,) less what they say themselves, (3,)."""
    off = measured.T_a_b - se2.between(T_a, T_b)
    return np.array([off[0], off[1], se2.wrap(float(off[2]))])
