"""Loops: coming back by another way, noticed, verified, and what it means for the whole path.

Along the path a scan is kept now and then. Where the path has been near before, it is matched with
the scans kept there: now and then with those of one visit where that agrees with the map, always
and with more where it does not. A match counts that fits well; of matches that tell the place
sharply, several along the way that ask for one and the same correction make a loop. What the
localizer says of neighbours on the path, and the matches of the others, make a graph of poses that
is relaxed; should the matches that asked for it not be content then, nothing is corrected.
A keyframe costs its scan, its pose and a few measurements in memory, and a few matches in time, one
a step. Where nothing was in sight for a while, the step between two of them is as doubtful as the
wheels are, and that is looked for farther off.
Source: Lu and Milios, "Globally consistent range scan alignment for environment mapping", 1997; for
the graph see pose_graph.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.ekf_slam.models import rotation
from thinmap_ros.core.estimate import Correction
from thinmap_ros.core.grid.buckets import Buckets
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.anchors import AnchoredPoses
from thinmap_ros.core.slam.point_map import PointMap
from thinmap_ros.core.slam.pose_graph import Measured, relax
from thinmap_ros.core.slam.scan_matching import Match, MatchConfig, ScanMatcher

_AROUND = 4  # keyframes to either side that make a submap
_TOGETHER = 3  # keyframes in a row that share one
_AGAIN_M = 8.0  # so much way lies between leaving a place and coming back to it
_VISITS = 3  # earlier visits to a place with which a scan is matched, at most
_TURN_M_RAD = 1.0  # a radian of turn makes two scans as different as so many metres
# Bounds of the error of a step from one keyframe to the next, in m and in rad.
_STEP_M, _STEP_RAD = (0.002, 0.02), (0.0002, 0.02)
LEAP_SIGMAS = (0.1, 0.1, 0.05)  # of one where wheels and walls contradicted each other
_MATCH_SIGMAS = (0.04, 0.04, 0.02)  # matches err together, by more than each says of itself
_PRIOR_SIGMAS = (0.3, 0.3, 0.15)
_LEAST_OVERLAP, _LEAST_FIT = 0.5, 0.85
# Of the way since the earlier visit, by which the place may be off, beyond the first metres.
_DRIFT = 0.01
_LEVER_M = 10.0  # at which a doubtful turn makes a place doubtful
_FARTHEST_M = 3.0  # and no more than this in all: what is alike is seldom nearer
_SEARCHED_M = 0.3  # from this on a good match near by is not taken without looking around
_SEARCH_DEG, _WIDEST_SEARCH_DEG = 12.0, 35.0
# A match that leaves more than this open (1 sigma), as along a corridor, proves no loop.
_SHARP_M = 0.1
_WITNESSES = 3  # matches of different keyframes that have to ask for the same correction
_LATELY = 8  # keyframes back to which they count
_ALIKE_M, _ALIKE_RAD = 0.2, 0.06  # by how much they may differ
_WORTH_M, _WORTH_RAD = 0.12, 0.04  # smaller corrections are left to the end
# What a single match may ask for: so many times what the witnesses do, and this.
_ASKED = 2.0
_UNASKED_M = 0.5
_BUCKET_M = 4.0  # keyframes are listed by squares of this size
_ENOUGH = 2  # keyframes that see about the same: from then on one of them stands for a new one
_FRESH_M = 1.0  # so much way after a match that agrees, no other one is asked for
_HOLDS_M = 3.0  # so much way after it, the old map is still trusted


@dataclass(frozen=True)
class LoopConfig(Config):
    """Parameters of keyframes and loops."""

    keyframe_m: float = parameter(0.7, 'a scan is kept after so much way, m', low=0.1, high=10.0)
    keyframe_rad: float = parameter(0.7, 'or after such a turn, rad', low=0.1, high=3.2)
    loop_reach_m: float = parameter(
        2.0, 'places nearer than this are matched, m', low=0.1, high=20.0
    )


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A scan that was kept, its points (N, 2), robot frame, its pose (3,), and the way so far."""

    scan: Scan
    points_base: Array
    T_map_base: Array
    way_m: float


class Loops:
    """The kept scans and the graph of their poses.

    Where old and new agree and a scan shows nothing new, an earlier one stands for it: the graph
    grows with what was seen, not with time. Source: Johannsson, Kaess, Fallon and Leonard,
    "Temporally scalable visual SLAM using a reduced pose graph", 2013.
    """

    def __init__(self, config: LoopConfig, matching: MatchConfig) -> None:
        self.keyframes: list[Keyframe] = []
        self.matched: list[Measured] = []
        # To each keyframe but the first, from the one that was the anchor before it,
        # as the localizer saw it.
        self._steps: list[tuple[int, Array]] = []
        self._tied: set[tuple[int, int]] = set()
        # Sigmas (3,) of those of which less is known than of others,
        self._leaps: dict[int, Array] = {}
        # and of these, those over which no loop was closed since.
        self._unsettled: dict[int, Array] = {}
        self._config, self._matching = config, matching
        self._jobs: deque[tuple[int, int]] = deque()
        # The next keyframe, unless an earlier one can stand for it.
        self._candidate: Keyframe | None = None
        self._path = AnchoredPoses()  # what was a keyframe, and what an earlier one stands for
        # Where the last of them was, and how long the way up to there is;
        # doubt and news since then.
        self._here, self._way_m = np.zeros(3), 0.0
        self._open, self._news = np.zeros(3), False
        self._witnesses: deque[Measured] = deque(maxlen=_WITNESSES)
        self._agreed_at_m = -math.inf
        self._places = Buckets(_BUCKET_M)  # of the keyframes
        # The last submap: its middle, of which keyframes.
        self._drawn: tuple[int, range, PointMap] | None = None

    def follow(
        self, scan: Scan, points_base: Array, T_map_base: Array, doubt: Array, news: bool
    ) -> None:
        """Take in a scan that fits the map at a pose (3,), with its points (N, 2).

        doubt (3,): what else than usual may be wrong with the way here since the last scan, m, m
        and rad, 1 sigma: where the pose is not where the wheels said, one of them is wrong; where
        nothing was in sight, the wheels may be. news: whether the scan shows something that is not
        in the map.
        """
        self._open, self._news = np.maximum(self._open, doubt), self._news or news
        if not self._is_apart(T_map_base):
            return
        self._keep()
        self._way_m, self._here = self.way_m(T_map_base), T_map_base
        self._candidate = here = Keyframe(scan, points_base, T_map_base, self._way_m)
        k, sure = len(self.keyframes), not (self._news or self._open.any())
        if self._open.any() and k > 0:
            self._leaps[k] = self._unsettled[k] = self._open
            self._jobs.append((self._path.last, k))
        if self._way_m - self._agreed_at_m > _FRESH_M:
            self._jobs.extend((j, k) for j in self._earlier_visits(here))
        self._open, self._news = np.zeros(3), False
        if not (sure and self._is_candidate_due()):
            self._settle(self._alike_of_late(here) if sure else None)

    def work_off(self) -> None:
        """Do one of the matches that are due; to be called once a step."""
        if not self._jobs:
            return
        j, k = self._jobs.popleft()
        match = self._match(j, k)
        if match.overlap >= _LEAST_OVERLAP and match.fit >= _LEAST_FIT:
            covariance = match.covariance + np.diag(np.square(_MATCH_SIGMAS))
            measured = Measured(j, k, match.T_map_base, np.linalg.inv(covariance), True)
            agrees = self._agrees(measured)
            if (
                not self._is_step(measured)
                and math.sqrt(match.covariance[:2, :2].trace()) < _SHARP_M
            ):
                self._hear(measured, agrees)
            if k == len(self.keyframes):
                if agrees and self.agreed and j in self._alike(self._frame(k)):
                    self._tie(measured)
                    self._settle(j)
                else:
                    self._keep()
            if k < len(self.keyframes):
                self.matched.append(measured)
            while (
                self.agreed and self._jobs and self._jobs[0][1] == k and not self._is_step(measured)
            ):
                # Where nothing disagrees, one visit says what the others would.
                self._jobs.popleft()
        if not self._is_candidate_due():
            self._keep()

    @property
    def agreed(self) -> bool:
        """Whether what the robot maps here agrees with what it mapped on earlier visits."""
        return self._way_m - self._agreed_at_m <= _HOLDS_M

    def close(self) -> Correction | None:
        """The correction by a verified loop, which the keyframes have then undergone, or None."""
        if not self._is_loop():
            return None
        self._keep()
        witnesses, self._witnesses = list(self._witnesses), deque(maxlen=_WITNESSES)
        before = self._poses()
        asked = _most_off(before, witnesses)
        after = self._relax(before, asked)
        left = _most_off(after, witnesses)
        if left > 0.5 * asked:
            # The graph does not bend so far: either these are wrong, or much else is.
            # They do not count.
            self.matched = [m for m in self.matched if m not in witnesses]
            return None
        self.keyframes = [
            replace(f, T_map_base=T) for f, T in zip(self.keyframes, after, strict=True)
        ]
        for k, (x, y, _) in enumerate(after.tolist()):
            self._places.put(k, x, y)
        self._here, self._drawn = self._path.poses(after)[-1], None
        for measured in witnesses:
            self._know(measured)
        self._agreed_at_m = self._way_m
        return Correction(before, after)

    def _hear(self, measured: Measured, agrees: bool) -> None:
        """Take a sharp match of the latest keyframes as a witness, for the map as is or a loop."""
        if agrees:
            self._agreed_at_m = max(self._agreed_at_m, self._frame(measured.b).way_m)
            self._witnesses.clear()
            self._know(measured)
        elif not self._witnesses or self._witnesses[-1].b != measured.b:
            self._witnesses.append(measured)

    def _know(self, measured: Measured) -> None:
        """By a loop, what lies between two keyframes is known, even if the robot came blindly."""
        self._unsettled = {
            k: leap for k, leap in self._unsettled.items() if not measured.a < k <= measured.b
        }

    def _agrees(self, measured: Measured) -> bool:
        """Whether a match finds two keyframes where they are taken to be."""
        off = _off(
            self.keyframes[measured.a].T_map_base, self._frame(measured.b).T_map_base, measured
        )
        return math.hypot(off[0], off[1]) < _WORTH_M and abs(float(off[2])) < _WORTH_RAD

    def _is_step(self, measured: Measured) -> bool:
        """Whether a match is of a keyframe and the one from which the robot came there."""
        b = measured.b
        return 0 < b <= len(self._steps) and self._steps[b - 1][0] == measured.a

    def _is_candidate_due(self) -> bool:
        """Whether matches of the candidate are due; they are the last ones."""
        return bool(self._jobs) and self._jobs[-1][1] == len(self.keyframes)

    def _frame(self, k: int) -> Keyframe:
        """A keyframe, or the candidate that is to be the next."""
        if k < len(self.keyframes) or self._candidate is None:
            return self.keyframes[k]
        return self._candidate

    def _tie(self, measured: Measured) -> None:
        """Keep what a match says of the keyframe that stands for the candidate.

        It is seen from the one before it. Once for each two of them. If only matches that disagree
        were kept, they would pull the path to their side.
        """
        a, j = self._path.last, measured.a
        if a == j or (a, j) in self._tied:
            return
        self._tied.add((a, j))
        T_a_here = se2.between(self.keyframes[a].T_map_base, self._frame(measured.b).T_map_base)
        T_a_j = se2.compose(T_a_here, se2.invert(measured.T_a_b))
        turn = rotation(float(T_a_j[2]))
        self.matched.append(Measured(a, j, T_a_j, turn @ measured.information @ turn.T, True))

    def _settle(self, j: int | None) -> None:
        """Have an earlier keyframe stand for the candidate, or keep it."""
        here, k = self._candidate, len(self.keyframes)
        if j is None or here is None:
            self._keep()
            return
        self._candidate, self._jobs = None, deque(job for job in self._jobs if job[1] < k)
        earlier = self.keyframes[j]
        self.keyframes[j] = replace(earlier, way_m=here.way_m)
        self._path.add(here.scan.stamp_ns, j, se2.between(earlier.T_map_base, here.T_map_base))

    def _keep(self) -> None:
        """Make the candidate a keyframe, if there is one."""
        here, k = self._candidate, len(self.keyframes)
        if here is None:
            return
        self._candidate = None
        if k > 0:
            anchor = self._path.last
            self._steps.append(
                (anchor, se2.between(self.keyframes[anchor].T_map_base, here.T_map_base))
            )
        self.keyframes.append(here)
        self._places.put(k, float(here.T_map_base[0]), float(here.T_map_base[1]))
        self._path.add(here.scan.stamp_ns, k, np.zeros(3))

    def _is_loop(self) -> bool:
        """Whether enough matches of late ask for the same correction of the robot's place."""
        if (
            len(self._witnesses) < _WITNESSES
            or self._witnesses[0].b < len(self.keyframes) - _LATELY
        ):
            return False
        frames = self.keyframes
        asked = np.array(
            [
                se2.compose(frames[m.a].T_map_base, m.T_a_b) - frames[m.b].T_map_base
                for m in self._witnesses
            ]
        )
        asked[:, 2] = se2.wrap(asked[:, 2])
        return bool(
            np.ptp(asked[:, :2], axis=0).max() < _ALIKE_M and np.ptp(asked[:, 2]) < _ALIKE_RAD
        )

    def relaxed(self) -> Array:
        """Poses (N, 3) of the keyframes that agree best with all measurements."""
        while self._jobs:
            self.work_off()
        self._keep()
        return self._relax(self._poses(), 0.0)

    def _relax(self, poses: Array, asked: float) -> Array:
        """Poses (N, 3) relaxed, where witnesses have asked for a correction of this size.

        Of what bends easily, as where the robot came blindly, a single match that is wrong would
        make a loop. None counts that asks for much more than the witnesses did.
        """
        most = _ASKED * asked + _UNASKED_M
        matched = [m for m in self.matched if _size(_off(poses[m.a], poses[m.b], m)) <= most]
        usual, none = np.square(self._step_sigmas(poses)), np.zeros(3)
        steps = [
            Measured(
                a, b, step, np.diag(1.0 / (usual + np.square(self._leaps.get(b, none)))), False
            )
            for b, (a, step) in enumerate(self._steps, start=1)
        ]
        return relax(poses, steps + matched)

    def _step_sigmas(self, poses: Array) -> Array:
        """How much a step adds to the drift, (3,), as told by what loops find after many steps.

        A localizer that holds on to its map adds next to nothing. To believe in more would let
        small errors of the matches bend a path that is straight.
        """
        found = [
            (_off(poses[m.a], poses[m.b], m), abs(m.b - m.a))
            for m in self.matched
            if not self._is_step(m)
        ]
        squared = np.array([np.square(off) / number for off, number in found]).reshape(-1, 3)
        if len(squared) == 0:
            return np.array([_STEP_M[0], _STEP_M[0], _STEP_RAD[0]])
        along = float(np.clip(math.sqrt(0.5 * np.median(squared[:, 0] + squared[:, 1])), *_STEP_M))
        return np.array([along, along, np.clip(math.sqrt(np.median(squared[:, 2])), *_STEP_RAD)])

    def way_m(self, T_map_base: Array) -> float:
        """Length of the path up to a pose (3,), m, in straight lines from keyframe to keyframe."""
        return self._way_m + math.dist(self._here[:2], T_map_base[:2]) if self._is_begun else 0.0

    @property
    def anchor(self) -> int:
        """Number of the keyframe from which the robot came to where it is; -1 before the first."""
        return self._path.last

    def past(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (N,) and poses (N, 3) of the scans that are keyframes, as they came.

        Also of those for which a keyframe stands.
        """
        return self._path.stamps_ns, self._path.poses(self._poses())

    def _poses(self) -> Array:
        return np.array([frame.T_map_base for frame in self.keyframes]).reshape(-1, 3)

    @property
    def _is_begun(self) -> bool:
        return bool(self.keyframes) or self._candidate is not None

    def _is_apart(self, T_map_base: Array) -> bool:
        """Whether a pose is far enough from the last place on the path to be the next."""
        return not (self._is_begun and self._are_near(self._here, T_map_base))

    def _are_near(self, T_a: Array, T_b: Array) -> bool:
        """Whether two poses (3,) see about the same."""
        moved = se2.between(T_a, T_b)
        turned = abs(float(moved[2])) >= self._config.keyframe_rad
        return not turned and math.hypot(moved[0], moved[1]) < self._config.keyframe_m

    def _alike(self, here: Keyframe) -> list[int]:
        """Keyframes that see about the same as another one.

        None where there are not enough to stand for it.
        """
        x, y, _ = here.T_map_base.tolist()
        near = self._places.near(x, y, self._config.keyframe_m)
        alike = [k for k in near if self._are_near(self.keyframes[k].T_map_base, here.T_map_base)]
        return alike if len(alike) >= _ENOUGH else []

    def _alike_of_late(self, here: Keyframe) -> int | None:
        """The keyframe most like another one, if old and new agree or it is of the same visit."""
        frames = [(k, self.keyframes[k]) for k in self._alike(here)]
        of_late = [(k, f) for k, f in frames if self.agreed or here.way_m - f.way_m <= _AGAIN_M]
        if not of_late:
            return None
        offs = np.abs([se2.off(f.T_map_base, here.T_map_base) for _, f in of_late])
        unlike = np.hypot(offs[:, 0], offs[:, 1]) + _TURN_M_RAD * offs[:, 2]
        return of_late[int(unlike.argmin())][0]

    def _earlier_visits(self, here: Keyframe) -> list[int]:
        """The keyframe most like this one of each earlier visit to the place, likest first."""
        farthest = self._config.loop_reach_m + _FARTHEST_M
        near = self._places.near(float(here.T_map_base[0]), float(here.T_map_base[1]), farthest)
        frames = [self.keyframes[i] for i in near]
        if not frames:
            return []
        poses, ways = np.array([f.T_map_base for f in frames]), np.array([f.way_m for f in frames])
        distances = np.hypot(*(poses[:, :2] - here.T_map_base[:2]).T)
        unlike = distances + _TURN_M_RAD * np.abs(se2.wrap(poses[:, 2] - here.T_map_base[2]))
        reach = self._config.loop_reach_m + self._drift(near, here)[0]
        unlike[(distances > reach) | (ways > here.way_m - _AGAIN_M)] = np.inf
        found: list[int] = []
        while len(found) < _VISITS and np.isfinite(unlike).any():
            likest = int(unlike.argmin())
            found.append(near[likest])
            unlike[np.abs(ways - ways[likest]) < _AGAIN_M] = np.inf
        return found

    def _drift(self, numbers: list[int], here: Keyframe) -> tuple[Array, Array]:
        """How far (N,), m, and turned (N,), rad, the robot may be off, seen from keyframes (N,).

        Leaps err each for itself, so that their variances add up.
        """
        since_m = here.way_m - np.array([self.keyframes[j].way_m for j in numbers])
        leaps = np.square(list(self._unsettled.values())).reshape(-1, 3)
        sigmas = np.sqrt((np.array(numbers)[:, None] < np.array(list(self._unsettled))) @ leaps)
        blind_m = sigmas[:, 0] + sigmas[:, 2] * np.minimum(since_m, _LEVER_M)
        return np.minimum(_DRIFT * since_m + blind_m, _FARTHEST_M), sigmas[:, 2]

    def _match(self, j: int, k: int) -> Match:
        """Keyframe k matched with j and those around it, in the frame of j."""
        here, (middle, points) = self._frame(k), self._submap(j, k)
        base = self.keyframes[middle].T_map_base
        drift, turn = (float(each[0]) for each in self._drift([j], here))
        search_m = self._matching.search_m + drift
        search_deg = min(_SEARCH_DEG + math.degrees(turn), _WIDEST_SEARCH_DEG)
        matcher = ScanMatcher(
            replace(self._matching, search_m=search_m, search_deg=search_deg), points
        )
        match = matcher.match(
            here.points_base,
            np.ascontiguousarray(here.scan.T_base_laser[:2]),
            se2.between(base, here.T_map_base),
            np.diag(np.square(_PRIOR_SIGMAS) + [drift**2, drift**2, turn**2]),
            search=drift > _SEARCHED_M and not self.agreed,
            lost=True,  # drift is not what wheels do from scan to scan
        )
        T_j_middle = se2.between(self.keyframes[j].T_map_base, base)
        R = rotation(float(T_j_middle[2]))
        found = se2.compose(T_j_middle, match.T_map_base)
        return replace(match, T_map_base=found, covariance=R @ match.covariance @ R.T)

    def _submap(self, j: int, k: int) -> tuple[int, PointMap]:
        """The middle one of the keyframes around j and before k, and what they saw, in its frame.

        The last one is kept: to draw it takes most of a match, and the next one is mostly of the
        same.
        """
        middle = min(j - j % _TOGETHER + _TOGETHER // 2, len(self.keyframes) - 1)
        numbers = range(max(0, middle - _AROUND), min(middle + _AROUND + 1, k))
        if self._drawn is None or self._drawn[:2] != (middle, numbers):
            matcher, base = ScanMatcher(self._matching), self.keyframes[middle].T_map_base
            for frame in (self.keyframes[i] for i in numbers):
                T = se2.between(base, frame.T_map_base)
                laser = se2.transform_points(T, frame.scan.T_base_laser[None, :2])[0]
                matcher.add(se2.transform_points(T, frame.points_base), laser)
            self._drawn = (middle, numbers, matcher.map)
        return middle, self._drawn[2]


def _most_off(poses: Array, matches: list[Measured]) -> float:
    """By how much the match that poses (N, 3) suit least is off, m."""
    return max(_size(_off(poses[m.a], poses[m.b], m)) for m in matches)


def _size(off: Array) -> float:
    """Length of an error (3,), m; a radian counts as a metre."""
    return math.hypot(*off)


def _off(T_a: Array, T_b: Array, measured: Measured) -> Array:
    """What a match says of two poses (3,) less what they say themselves, (3,)."""
    off = measured.T_a_b - se2.between(T_a, T_b)
    return np.array([off[0], off[1], se2.wrap(float(off[2]))])
