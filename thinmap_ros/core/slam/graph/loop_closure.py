"""Loop closure: matches keyframes with earlier visits and optimizes the pose graph.

A new keyframe is matched with submaps of earlier visits within its covariance along the graph.
Several mutually consistent matches close a loop. Then the pose graph is optimized.
"""

import math
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.places.place_odds import JOIN_ODDS
from thinmap_ros.core.se2 import (
    BOUND_SIGMAS,
    Array,
    carried,
    inverse,
    propagated_covariance,
    rotated_covariance,
    rotation,
)
from thinmap_ros.core.slam.graph.keyframes import (
    Anchor,
    Keyframe,
    KeyframeConfig,
    Keyframes,
    SavedKeyframes,
    Step,
    view_difference_m,
)
from thinmap_ros.core.slam.graph.pose_graph import Edge, EdgeArrays, last, rounds
from thinmap_ros.core.slam.graph.reckoned import CONTRARY_RATIO, RETURNS, Reckoned, Search
from thinmap_ros.core.slam.graph.tables import EdgeTable
from thinmap_ros.core.slam.matching.local_map import LocalMap, LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import Matcher, MatchingConfig
from thinmap_ros.core.slam.matching.visibility import is_seen_through
from thinmap_ros.core.slam.odometry import CHI2, OdometryCalibration
from thinmap_ros.core.stage import Correction, are_two_storeys

AGAIN_M = 8.0  # smallest path length between two visits of a place


_AROUND = 4  # keyframes to either side of the centre of a submap
_STRIDE = 4  # keyframes that share a submap: building it takes longer than a match
_CACHED = 3  # submaps
# Keyframes to either side in a submap for a scan that looks back: as far as a laser sees well.
# Those beside it saw nothing of the walls ahead of it; along a smooth wall it would slide by metres
# to where more is known, and its neighbours would do alike and agree.
_AROUND_BACK = 12


class Submaps:
    """Cache of submaps around keyframes, with which the scans of later visits are matched.

    Consecutive keyframes often match the same submap.
    """

    def __init__(self, config: LocalMapConfig) -> None:
        self._config = config
        self._kept: OrderedDict[tuple[int, int, bool], tuple[Array, LocalMap]] = OrderedDict()

    def clear(self) -> None:
        """Drop all submaps, after keyframes have moved."""
        self._kept.clear()

    def around(
        self, frames: Sequence[Keyframe], j: int, path_m: float, looks_back: bool = False
    ) -> tuple[Array, LocalMap]:
        """Pose (3,) of a submap around keyframe j, and the map in the frame of this pose.

        path_m: length of the path now; keyframes after j that belong to the current visit are not
        part of the submap; looks_back: whether it is for a scan that faces the other way.
        """
        centre = min(j - j % _STRIDE + _STRIDE // 2, len(frames) - 1)
        key = (centre, frames[j].submap, looks_back)
        if key not in self._kept:
            around = _AROUND_BACK if looks_back else _AROUND
            near = range(max(0, centre - around), min(centre + around + 1, len(frames)))
            earlier = [i for i in near if i <= j or path_m - frames[i].path_m > AGAIN_M]
            self._kept[key] = self._built(frames, centre, j, earlier)
            if len(self._kept) > _CACHED:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def before(self, frames: Sequence[Keyframe], j: int) -> tuple[Array, LocalMap]:
        """Pose (3,) of a submap of keyframe j and of those before it, and the map in its frame."""
        return self._built(frames, j, j, range(max(0, j - _AROUND), j + 1))

    def _built(
        self, frames: Sequence[Keyframe], centre: int, j: int, numbers: Iterable[int]
    ) -> tuple[Array, LocalMap]:
        """The submap of those of the numbers that are of the local map of keyframe j."""
        base = frames[centre].T_map_base
        submap = LocalMap(self._config)
        for frame in (frames[i] for i in numbers):
            if frame.submap == frames[j].submap:
                T = se2.between(base, frame.T_map_base)
                with suppress(InputError):  # kilometres away: nothing to match there
                    submap.add_scan(frame.points, frame.scan.T_base_laser, T)
        return base, submap


def largest_consistent(candidates: Iterable[Edge], frames: Sequence[Keyframe]) -> list[Edge]:
    """Largest set of candidates that agree on the same correction (greedy).

    Of keyframes that are in the graph; none if two of the set are of the same keyframe.
    Source: Mangelson et al., "Pairwise consistent measurement set maximization for robust
    multi-robot map merging", 2018.
    """
    edges = [edge for edge in candidates if edge.b < len(frames)]
    if not edges:
        return []
    n = len(edges)
    agree = np.eye(n, dtype=np.bool_)
    for i in range(n):
        for j in range(i):
            agree[i, j] = agree[j, i] = _are_consistent(edges[i], edges[j], frames)
    best: list[int] = []
    for i in range(n):
        chosen = [i]
        for j in np.argsort(-agree.sum(axis=0)):
            if j != i and all(agree[j, k] for k in chosen):
                chosen.append(int(j))
        best = max(best, chosen, key=len)
    return [edges[i] for i in best] if len({edges[i].b for i in best}) == len(best) else []


def _are_consistent(one: Edge, other: Edge, frames: Sequence[Keyframe]) -> bool:
    """Whether the loop over two matches and the path between them closes within the gate."""
    if one.b == other.b:
        return False
    T_a_a = se2.between(frames[one.a].T_map_base, frames[other.a].T_map_base)
    T_b_b = se2.between(frames[one.b].T_map_base, frames[other.b].T_map_base)
    there = se2.compose(one.T_a_b, T_b_b)
    back = se2.compose(T_a_a, other.T_a_b)
    off = se2.pose_difference(there, back)
    covariance = inverse(one.information) + inverse(other.information)
    covariance[2, 2] += 1e-6
    return float(off @ np.linalg.solve(covariance, off)) < CHI2


_PUBLISHED = 0

# Distance between two views of which each says something new. Of eight kidnapped robots that drove
# for 440 s, one joined its piece at a wrong place where those 3 m of path apart were counted, and
# none with this.
_VIEW_M = 3.0

_RECENT_SUBMAPS = 24  # matches among which consistent ones are searched


class Pieces:
    """The submaps by number, each in a piece; one of the pieces is the published map.

    A piece holds submaps whose places relative to each other are known.
    A submap that begins because scans contradict the map is a piece of its own. It returns where
    dead reckoning has it once the odds of that place are high enough (`Reckoned`).
    A piece may have the tag of its storey; those of two storeys are never joined.
    """

    def __init__(self) -> None:
        self._piece_of = [_PUBLISHED]  # by the number of the submap
        self._tags: dict[int, str] = {}  # by the number of the piece
        self._reckoned: dict[int, Reckoned] = {}  # of pieces that are apart
        self._matches: deque[Edge] = deque(maxlen=_RECENT_SUBMAPS)

    @property
    def current(self) -> int:
        """Number of the submap that the robot is in."""
        return len(self._piece_of) - 1

    @property
    def piece(self) -> int:
        """Number of the piece that the robot is in."""
        return self._piece_of[-1]

    @property
    def is_apart(self) -> bool:
        """Whether the place of the robot in the published map is unknown."""
        return self._piece_of[-1] != _PUBLISHED

    @property
    def tag(self) -> str:
        """Tag of the piece that the robot is in; '' where its storey is not known."""
        return self._tags.get(self.piece, '')

    @tag.setter
    def tag(self, tag: str) -> None:
        self._tags[self.piece] = tag

    @property
    def published_tag(self) -> str:
        """Tag of the published map."""
        return self._tags.get(_PUBLISHED, '')

    def is_other_storey(self, submap: int = 0) -> bool:
        """Whether a submap, by default of the published map, is of another storey than here."""
        return are_two_storeys(self.tag, self._tags.get(self._piece_of[submap], ''))

    def load(self, submaps: int) -> None:
        """Begin a submap of the published map, after a number of others of it."""
        self._piece_of = [_PUBLISHED] * (submaps + 1)

    def begin(self, reckoned: Reckoned) -> None:
        """Begin a submap, apart from all others; of the storey that the robot was on.

        reckoned: whether it lies where dead reckoning has it in the piece where the robot was.
        """
        tag = self.tag
        outer = self._reckoned.get(self.piece)
        self._piece_of.append(len(self._piece_of))
        self._reckoned[self.piece] = reckoned if outer is None else reckoned.within(outer)
        self.tag = tag

    def return_to_published(self) -> None:
        """The pose in the published map was given: leave a piece that is apart."""
        if self.is_apart:
            self._piece_of.append(_PUBLISHED)

    def is_here(self, submap: int) -> bool:
        """Whether a submap is part of the piece that the robot is in."""
        return self._piece_of[submap] == self._piece_of[-1]

    def is_published(self, submap: int) -> bool:
        """Whether a submap is part of the published map."""
        return self._piece_of[submap] == _PUBLISHED

    def join(self, frames: Sequence[Keyframe], edges: Sequence[Edge]) -> None:
        """Make one piece of those that loop edges connect."""
        for edge in edges:
            ends = (frames[edge.a].submap, frames[edge.b].submap)
            kept, gone = sorted(self._piece_of[submap] for submap in ends)
            self._tags[kept] = self._tags.get(kept) or self._tags.get(gone, '')
            if kept != gone:
                self._reckoned.pop(gone, None)
            self._piece_of = [kept if piece == gone else piece for piece in self._piece_of]

    def are_one(self, a: int, b: int) -> bool:
        """Whether two submaps are of one piece."""
        return self._piece_of[a] == self._piece_of[b]

    def reckoned_between(self, a: int, b: int) -> Reckoned | None:
        """Of the piece that is apart, where one of two submaps is of it and one published."""
        pieces = {self._piece_of[a], self._piece_of[b]}
        if len(pieces) == 1 or _PUBLISHED not in pieces:
            return None
        return self._reckoned.get(max(pieces))

    def take_returning(self) -> list[Edge]:
        """Edges of a piece that returns to where dead reckoning has it; none where none does."""
        for piece, reckoned in self._reckoned.items():
            if reckoned.edges and reckoned.log_odds >= RETURNS:
                del self._reckoned[piece]
                return reckoned.edges
        return []

    def add_match(self, edge: Edge) -> None:
        """Add a match that is ambiguous."""
        self._matches.append(edge)

    def take_edges(self, frames: Sequence[Keyframe], fewest: int) -> list[Edge]:
        """Loop edges of ambiguous matches; none while too few agree.

        fewest: matches, each of another view, that close a loop.
        """
        own = [edge for edge in self._matches if self.is_here(frames[edge.b].submap)]
        agreeing = largest_consistent(own, frames)
        along_path = sorted(edge.b for edge in agreeing)
        if _count_views([frames[b].T_map_base for b in along_path]) < fewest:
            return []
        self._matches.clear()
        return agreeing


def _count_views(poses: list[Array]) -> int:
    """Number of poses (3,) that are a view apart from each other (greedy)."""
    views: list[Array] = []
    for T in poses:
        if all(math.dist(T[:2], view[:2]) >= _VIEW_M for view in views):
            views.append(T)
    return len(views)


_MIN_MOVE_M = 0.1  # smallest move of a keyframe for which the map follows the calibration


class KeyframeGraph:
    """Moves the keyframes as the edges between them and the calibration of the odometry have it.

    A slice of an iteration of the optimization per step.
    edges: those between visits; the keyframes hold their steps and headings.
    """

    def __init__(self, keyframes: Keyframes, calibration: OdometryCalibration) -> None:
        """calibration: of the odometry, as another part estimates it."""
        self._keyframes = keyframes
        self._calibration = calibration
        self.edges = EdgeTable()
        # The optimization in progress: None after each slice, and the correction at its end.
        self._slices: Iterator[Correction | None] | None = None

    @property
    def is_moving(self) -> bool:
        """Whether an optimization is in progress."""
        return self._slices is not None

    def optimize(self, start: Array | None = None) -> None:
        """Begin an optimization, at poses (N, 3); None: at the present ones."""
        self._calibrate(self._calibration.smoothed())
        poses = self._keyframes.poses() if start is None else start
        self._slices = self._moved(rounds(poses, self._all_edges()), poses)

    def optimized(self) -> Array:
        """Poses (N, 3) of the keyframes after a whole optimization, which does not move them."""
        self._calibrate(self._calibration.smoothed())
        return last(rounds(self._keyframes.poses(), self._all_edges()))

    def step(self) -> Correction | None:
        """Do one slice; returns the correction of the keyframes after the last one."""
        if self._slices is None:
            return None
        try:
            correction = next(self._slices)
        except StopIteration:
            correction = None
            self._slices = None
        if correction is not None:
            self._slices = None
        return correction

    def follow_calibration(self) -> None:
        """Begin to move the poses by what is newly known of the calibration, and by nothing else.

        The maps of loops that were accepted without an optimization agree within their noise. What
        remains of their errors is no news: it stays until a loop closes.
        """
        if self._is_calibration_new():
            self._slices = self._followed(self._calibration.smoothed())
            self.step()

    def _moved(self, moving: Iterator[Array], poses: Array) -> Iterator[Correction | None]:
        """Slices of an optimization, from poses (N, 3)."""
        for after in moving:
            poses = after
            yield None
        # Keyframes that were added during the optimization move with their anchors.
        for added in self._keyframes.steps[len(poses) - 1 :]:
            poses = np.vstack([poses, se2.compose(poses[added.a], added.T_a_b)])
        before = self._keyframes.poses()
        for _ in self._keyframes.move(poses, self.edges):
            yield None
            before = self._keyframes.poses()
        yield Correction(before, self._keyframes.poses())

    def _followed(self, parameters: Array) -> Iterator[Correction | None]:
        """Slices of a move by parameters (N, 4); none after the first iteration if it is small."""
        poses = self._keyframes.poses()
        anchor = self._keyframes.anchor  # others may be added between the slices
        now = self._all_edges()
        settled = now.settled(poses)
        change = self._all_edges(parameters).T_a_b - now.T_a_b
        moving = rounds(poses, replace(settled, T_a_b=settled.T_a_b + change))
        moved = poses
        for moved in moving:
            if not np.array_equal(moved, poses):
                break  # the first iteration is complete
            yield None
        self._calibration.applied = parameters[-1]
        if math.dist(moved[anchor, :2], poses[anchor, :2]) > _MIN_MOVE_M:
            self._calibrate(self._calibration.smoothed())
            yield None
            yield from self._moved(moving, moved)

    def _is_calibration_new(self) -> bool:
        """Whether the calibration may move the last keyframe by more than it is uncertain itself.

        The parameters have a random walk: what they are now is not what they were.
        """
        if len(self._keyframes) < 2:
            return False
        by = self._keyframes.frames[self._keyframes.anchor].systematic[:2]
        off = by @ (self._calibration.parameters - self._calibration.applied)
        variance = float(np.trace(self._calibration.covariance_of(by)))
        return float(off @ off) > max(_MIN_MOVE_M**2, variance)

    def _calibrate(self, parameters: Array) -> None:
        """Correct the edges by parameters (N, 4) of the calibration."""
        self._keyframes.calibrate(parameters)
        self.edges.calibrate(parameters)
        self._calibration.applied = parameters[-1]

    def _all_edges(self, parameters: Array | None = None) -> EdgeArrays:
        """All edges, as they are or would be with parameters (N, 4) of the calibration."""
        keyframes = self._keyframes
        return EdgeArrays.joined(
            [
                keyframes.steps.arrays(parameters),
                self.edges.arrays(parameters),
                keyframes.headings(parameters),
            ]
        )


_RECENT = 8  # recent candidates among which consistent ones are searched

# Covariance (3, 3) that an edge between two visits has beside that of its match: of 5 cm and
# 0.02 rad. More, and the path is changed less.
EDGE_NOISE = np.diag(np.square([0.05, 0.05, 0.02]))

# Scans within which a keyframe is matched. With three matches for each of the scans of a sparse
# log, and one done at a time, a loop was closed up to 344 scans after its keyframes.
_LATEST = 20

# Of a scan that is searched for within all of the largest reach: as many again take twice as long.
_FAR_POINTS = 45

_MAX_VISITS = 3  # earlier ones with which a keyframe is matched
_MAX_UNCERTAINTY_M = 8.0  # of a keyframe, beyond which place recognition is needed


@dataclass(frozen=True)
class LoopClosureConfig(Config):
    """Parameters of loop closure."""

    search_radius_m: float = parameter(
        2.0,
        'Radius around the pose, in addition to its uncertainty, within which keyframes of earlier '
        'visits are matched (m). Raise it if loops are missed, lower it to save time.',
        low=0.1,
        high=20.0,
    )
    min_inlier_ratio: float = parameter(
        0.75,
        'Smallest ratio of points on the walls of an earlier visit for a loop-closure candidate. '
        'Raise it against false loops, lower it where furniture moves.',
        low=0.0,
        high=1.0,
    )
    min_consistent_matches: int = parameter(
        5,
        'Number of consistent candidates that close a loop, if they have no more inliers than '
        '`min_inlier_ratio`: it is fewer if they have more. Raise it against false loops, lower it '
        'to close loops earlier.',
        low=1,
        high=_RECENT,
    )
    join_odds: float = parameter(
        JOIN_ODDS,
        'Odds of its place with which a piece of map that is apart is joined with the published '
        'map. Raise it where parts of the building look alike; joins then come later.',
        low=10.0,
        high=1e12,
    )

    def reach_m(self, sigma: float) -> float:
        """Radius (m) in which keyframes are matched, for a position of uncertainty sigma, m."""
        return self.search_radius_m + min(BOUND_SIGMAS * sigma, _MAX_UNCERTAINTY_M)


@dataclass(frozen=True, eq=False)
class _Job:
    """Match keyframe k with keyframe j; covariance (3, 3) of k relative to j, map frame."""

    j: int
    k: int
    covariance: Array


@dataclass(frozen=True, eq=False)
class _Pending:
    """A keyframe scan that may yet reuse a keyframe, with its step; T_anchor_frame (3,)."""

    frame: Keyframe
    step: Step
    T_anchor_frame: Array


class LoopClosure:
    """The search for edges of the pose graph between keyframes of different visits."""

    def __init__(
        self,
        config: LoopClosureConfig,
        keyframes: KeyframeConfig,
        matching: MatchingConfig,
        local_map: LocalMapConfig,
        calibration: OdometryCalibration,
    ) -> None:
        """calibration: of the odometry, as another part estimates it."""
        self.calibration = calibration
        self.keyframes = Keyframes(keyframes)
        self.graph = KeyframeGraph(self.keyframes, calibration)
        self.pieces = Pieces()
        self.adjust(config, matching)
        self._jobs: deque[list[_Job]] = deque([[]], maxlen=_LATEST)  # by the scan that began them
        self._pending: _Pending | None = None
        self._requested: deque[Edge] = deque(maxlen=_RECENT)
        self._submaps = Submaps(local_map)

    def adjust(self, config: LoopClosureConfig, matching: MatchingConfig) -> None:
        """Search with other parameters from now on; keyframes and edges stay."""
        self._config = config
        # No wheel slip here: the covariance along the graph contains it.
        own = replace(matching, wheel_slip=(0.001, 0.001, 0.001))
        self._matcher = Matcher(own)
        reach_m = config.reach_m(math.inf)
        far = (reach_m, reach_m, own.max_search[2])
        self._far_matcher = Matcher(replace(own, max_search=far, search_points=_FAR_POINTS))

    @property
    def anchor(self) -> Anchor:
        """The last keyframe scan, added or not; the origin of the map before the first."""
        keyframes = self.keyframes
        if self._pending is not None:
            return Anchor(self._frame(len(keyframes)))
        if not keyframes.frames:
            return Anchor()
        return Anchor(keyframes.frames[keyframes.anchor], keyframes.T_anchor_last)

    def load(self, saved: SavedKeyframes) -> None:
        """Begin with the saved keyframes of a map."""
        self.keyframes.load(saved.frames, saved.steps)
        self.graph.edges.extend(saved.edges)
        self.pieces.load(1 + max(frame.submap for frame in saved.frames))

    def saved(self, since_ns: int = 0) -> SavedKeyframes | None:
        """The keyframes of the published map, without a pending one; None if there are none.

        since_ns: stamp of the first.
        """
        frames = self.keyframes.frames
        is_saved = [self.pieces.is_published(frame.submap) for frame in frames]
        if since_ns:
            stamps_ns = [frame.scan.stamp_ns for frame in frames]
            first = stamps_ns.index(since_ns) if since_ns in stamps_ns else len(frames)
            is_saved[:first] = [False] * first
        if not any(is_saved):
            return None
        steps = self.keyframes.steps
        return SavedKeyframes.of(frames, steps, self.graph.edges, is_saved, self.calibration)

    def return_to(self, T_map_base: Array) -> None:
        """Make the keyframe of the published map nearest to a given pose (3,) the anchor.

        The robot has come there by no known motion.
        """
        self._add_pending()
        frames = self.keyframes.frames
        published = [k for k, frame in enumerate(frames) if self.pieces.is_published(frame.submap)]
        if published:
            self.keyframes.return_to(
                min(published, key=lambda k: view_difference_m(frames[k].T_map_base, T_map_base))
            )

    def needs_keyframe(self, T_anchor_base: Array) -> bool:
        """Whether a scan at a pose (3,) relative to the anchor becomes the next keyframe."""
        is_first = self._pending is None and not self.keyframes.frames
        return is_first or self.keyframes.differ(np.zeros(3), T_anchor_base)

    def add(self, frame: Keyframe, step: Step, jump: Array) -> None:
        """Add a keyframe, with the step from the last keyframe scan.

        jump (3, 3): additional covariance if scans and motion contradicted each other on the step.
        The step is then measured again, by a match with the submap of the keyframes before it.
        """
        self._add_pending()
        step = replace(step, covariance=step.covariance + jump)
        step = step.turned(float(self.keyframes.T_anchor_last[2]))
        T_anchor_frame = se2.between(self.keyframes.T_map_anchor, frame.T_map_base)
        self._pending = _Pending(frame, step, T_anchor_frame)
        jumped = bool(jump.any()) and len(self.keyframes) > 0
        recent = None if jumped else self._recent_alike(frame)
        if recent is not None:
            self._reuse_keyframe(recent)
            return
        anchor = self.keyframes.anchor
        jobs = self._earlier_visits(frame)
        self._jobs[-1] += jobs
        if jumped or not jobs:
            self._add_pending()
        if jumped:
            theta = float(self.keyframes.frames[anchor].T_map_base[2])
            covariance = rotated_covariance(step.covariance, theta)
            self._match(_Job(anchor, self.keyframes.anchor, covariance))

    def _recent_alike(self, frame: Keyframe) -> int | None:
        """Keyframe of the current visit with nearly the same view, or None."""
        j = self.keyframes.most_similar(frame.T_map_base)
        if j is None or self.keyframes.frames[j].submap != frame.submap:
            return None
        return j if frame.path_m - self.keyframes.frames[j].path_m < AGAIN_M else None

    def _earlier_visits(self, here: Keyframe) -> list[_Job]:
        """Jobs for the most similar keyframe of each earlier visit, the most similar first."""
        frames = self.keyframes.frames
        covariance = here.covariance + self.calibration.covariance_of(here.systematic)
        reach_m = self._config.reach_m(se2.sigma_m(covariance))
        near = self.keyframes.near(here.T_map_base, reach_m)
        near = [j for j in near if self._is_earlier(j, here)]
        if not near:
            return []
        covariances = self._as_seen_from(near, here)
        ranked = []
        for i, (j, covariance) in enumerate(zip(near, covariances, strict=True)):
            away_m = math.dist(frames[j].T_map_base[:2], here.T_map_base[:2])
            if away_m <= self._config.reach_m(se2.sigma_m(covariance)):
                ranked.append((view_difference_m(frames[j].T_map_base, here.T_map_base), i))
        ranked.sort()
        found: list[_Job] = []
        for _, i in ranked:
            path_m = frames[near[i]].path_m
            if all(abs(path_m - frames[job.j].path_m) > AGAIN_M for job in found):
                found.append(_Job(near[i], len(frames), covariances[i]))
        return found[:_MAX_VISITS]

    def _is_earlier(self, j: int, here: Keyframe) -> bool:
        if j == self.keyframes.anchor:  # of another submap: the step is measured again
            return False
        frame = self.keyframes.frames[j]
        if frame.submap == here.submap:
            return frame.path_m <= here.path_m - AGAIN_M
        return self.pieces.are_one(frame.submap, here.submap) or (
            self._reckoned(frame, here) is not None
        )

    def _reckoned(self, frame: Keyframe, here: Keyframe) -> Reckoned | None:
        """Odds to which a match of two keyframes is a look; None where it tells nothing of them."""
        reckoned = self.pieces.reckoned_between(frame.submap, here.submap)
        if reckoned is None or not self.pieces.is_published(frame.submap):
            return reckoned
        return reckoned if reckoned.is_told_by(frame.path_m) else None

    def _as_seen_from(self, near: list[int], here: Keyframe) -> list[Array]:
        """Covariance (3, 3), map frame, of the pending keyframe relative to each keyframe."""
        assert self._pending is not None
        keyframes = self.keyframes
        poses = keyframes.poses()
        anchor = keyframes.anchor
        covariances, derivatives = keyframes.covariances_from(anchor, poses, self.graph.edges, near)
        step = self._pending.step
        yaw = float(poses[anchor, 2])
        moved = rotation(yaw) @ step.systematic.derivative
        from_anchor = here.T_map_base[:2] - poses[anchor, :2]
        found = []
        for j in near:
            to_anchor = poses[anchor, :2] - poses[j, :2]
            covariance = propagated_covariance(covariances[j], to_anchor + from_anchor)
            by = moved - carried(derivatives[j], to_anchor + from_anchor)
            covariance = covariance + rotated_covariance(step.covariance, yaw)
            found.append(covariance + self.calibration.covariance_of(by))
        return found

    @property
    def is_busy(self) -> bool:
        """Whether there are pending matches, or an optimization is in progress."""
        return any(self._jobs) or self.graph.is_moving

    def step(self) -> Correction | None:
        """Do one pending match, or one iteration of the optimization; called once per scan.

        The newest keyframe is matched first. Returns the correction of the keyframes when an
        optimization has finished.
        """
        correction = None
        if self.graph.is_moving:
            correction = self._move()
        elif any(self._jobs):
            self._match(next(jobs for jobs in reversed(self._jobs) if jobs).pop(0))
            self._close()
        else:
            self.graph.follow_calibration()
        self._jobs.append([])
        return correction

    def _move(self) -> Correction | None:
        correction = self.graph.step()
        if correction is not None:
            self._submaps.clear()
            if self.pieces.current:  # there is more than one submap
                self.pieces.join(self.keyframes.frames, self.graph.edges)
        return correction

    def _close(self) -> None:
        """Begin an optimization if enough matches agree on a loop."""
        if not self._is_pending_matched():
            self._add_pending()
        if edges := self._closing_edges():
            self._add_pending()
            self._requested.clear()
            self.graph.edges.extend(edges)
            self.graph.optimize()

    def join(self, T: Array, edges: Sequence[Edge]) -> None:
        """Begin to join the robot's piece with another one, by edges between both.

        T (3,): where the map frame of the robot's piece lies in that of the other.
        """
        self._add_pending()
        self._requested.clear()
        frames = self.keyframes.frames
        here = [k for k, frame in enumerate(frames) if self.pieces.is_here(frame.submap)]
        poses = self.keyframes.poses()
        poses[here] = [se2.compose(T, own) for own in poses[here]]
        self.keyframes.detach(set(here))
        self.graph.edges.extend(edges)
        self.graph.optimize(poses)

    @property
    def min_consistent_matches(self) -> int:
        """Number of matches that agree on a loop."""
        return self._config.min_consistent_matches

    def _closing_edges(self) -> list[Edge]:
        """Loop edges that enough matches agree on, within a piece or between two."""
        fewest = self._config.min_consistent_matches
        consistent = largest_consistent(self._requested, self.keyframes.frames)
        evidence = sum(edge.inlier_ratio for edge in consistent)
        if consistent and evidence >= fewest * self._config.min_inlier_ratio:
            return consistent
        returning = self.pieces.take_returning()
        return returning or self.pieces.take_edges(self.keyframes.frames, fewest)

    def _match(self, job: _Job) -> None:
        """Match keyframe k, or the pending one, with the submap around j; add the edge."""
        j = job.j
        if self.pieces.is_other_storey(self.keyframes.frames[j].submap):
            return
        k = job.k
        here = self._frame(k)
        frames = self.keyframes.frames
        is_step = self.keyframes.is_step(j, k)
        is_ambiguous = not is_step and self._is_ambiguous(job.covariance)
        reckoned = self._reckoned(frames[j], here)
        if is_ambiguous and reckoned and reckoned.has_looked_from(here.T_map_base[:2]):
            return
        if is_step:
            base, submap = self._submaps.before(frames, j)
        else:
            turn = float(se2.between(frames[j].T_map_base, here.T_map_base)[2])
            looks_back = abs(turn) > 0.75 * math.pi  # within 45 degrees of the opposite heading
            base, submap = self._submaps.around(frames, j, here.path_m, looks_back)
        config = self._config
        prior = se2.between(base, here.T_map_base)
        relative = rotated_covariance(job.covariance, -float(base[2])) + 4.0 * EDGE_NOISE
        matcher = self._far_matcher if is_ambiguous else self._matcher
        match = matcher.match(here.points, here.scan.T_base_laser, submap, prior, relative)
        if match.inlier_ratio < config.min_inlier_ratio:
            if reckoned is not None and match.contradiction_ratio > CONTRARY_RATIO:
                reckoned.add_contrary(here.T_map_base[:2])
            return
        if not is_step and is_seen_through(here.scan, submap, match.pose):
            return
        covariance = inverse(match.scan_information + 1e-3 * np.eye(3)) + EDGE_NOISE
        off = se2.pose_difference(match.pose, prior)
        is_far = float(off @ np.linalg.solve(relative + covariance, off)) > CHI2
        T_j_base = se2.between(frames[j].T_map_base, base)
        covariance = rotated_covariance(covariance, float(T_j_base[2]))
        T_j_k = se2.compose(T_j_base, match.pose)
        edge = Edge(j, k, T_j_k, inverse(covariance), True, inlier_ratio=match.inlier_ratio)
        if not self.pieces.are_one(frames[j].submap, here.submap):
            self._add_pending()
            if reckoned is not None:
                self._look_at(reckoned, edge, matcher.searched(relative))
        elif is_far:
            return
        elif is_ambiguous:
            self._add_pending()
            self.pieces.add_match(edge)
        elif is_step:
            self.graph.edges.append(edge)  # the next loop corrects poses that contradict it
        elif self._mahalanobis(edge) < CHI2:
            self._confirm(edge)
        else:
            self._requested.append(edge)

    def _look_at(self, reckoned: Reckoned, edge: Edge, reach: Array) -> None:
        """Add a match between two pieces to the odds; reach (3,): of its search, m, m, rad."""
        T_map_a = self.keyframes.frames[edge.a].T_map_base
        T_map_b = self._frame(edge.b).T_map_base
        off = se2.pose_difference(se2.compose(T_map_a, edge.T_a_b), T_map_b)
        own = rotated_covariance(inverse(edge.information), float(T_map_a[2]))
        search = Search(float(reach[:2].max()), float(reach[2]))
        reckoned.add(T_map_b[:2], edge, off, own, search)

    def _is_ambiguous(self, covariance: Array) -> bool:
        """Whether several places that look alike may be within a covariance (3, 3), map frame.

        A match then counts like one with another piece of map. Scans fit at many places of a
        smooth hall, and those beside them do, too: in a ring of 670 m with a hall of which the
        laser saw no wall, four such matches closed the loop 5 m beside its place.
        """
        return BOUND_SIGMAS * se2.sigma_m(covariance) > _MAX_UNCERTAINTY_M

    def _confirm(self, edge: Edge) -> None:
        """Record that the maps of both visits agree here: reuse the keyframe, or add the edge."""
        here = self._frame(edge.b)
        self._requested.clear()
        pending = self._pending
        if (
            pending is not None
            and edge.b == len(self.keyframes)
            and not self.keyframes.differ(self.keyframes.frames[edge.a].T_map_base, here.T_map_base)
        ):
            anchor = self.keyframes.anchor
            if anchor != edge.a:
                T_a_here = se2.between(self.keyframes.frames[anchor].T_map_base, here.T_map_base)
                T_a_j = se2.compose(T_a_here, se2.invert(edge.T_a_b))
                covariance = rotated_covariance(inverse(edge.information), float(T_a_j[2]))
                lever = T_a_j[:2] - T_a_here[:2]
                step = pending.step
                covariance = propagated_covariance(covariance + step.covariance, lever)
                share = step.systematic
                share = replace(share, derivative=carried(share.derivative, lever))
                self.graph.edges.append(
                    Edge(anchor, edge.a, T_a_j, inverse(covariance), True, share)
                )
            self._reuse_keyframe(edge.a)
            return
        self._add_pending()
        self.graph.edges.append(edge)

    def _mahalanobis(self, edge: Edge) -> float:
        """Squared Mahalanobis distance of an edge from the current poses, by its information."""
        T = se2.between(self.keyframes.frames[edge.a].T_map_base, self._frame(edge.b).T_map_base)
        off = edge.T_a_b - T
        off[2] = se2.wrap(float(off[2]))
        return float(off @ edge.information @ off)

    def _frame(self, k: int) -> Keyframe:
        pending = self._pending
        if k < len(self.keyframes) or pending is None:
            return self.keyframes.frames[k]
        T_map_base = se2.compose(self.keyframes.T_map_anchor, pending.T_anchor_frame)
        return replace(pending.frame, T_map_base=T_map_base)

    def _is_pending_matched(self) -> bool:
        """Whether there are pending matches of the pending keyframe."""
        number = len(self.keyframes)
        return any(job.k == number for jobs in self._jobs for job in jobs)

    def _add_pending(self) -> None:
        """Add the pending keyframe to the graph, if there is one."""
        if self._pending is not None:
            frame = self._frame(len(self.keyframes))
            step = self._pending.step
            self._pending = None
            self.keyframes.add(frame, step)

    def _reuse_keyframe(self, j: int) -> None:
        """Reuse an earlier keyframe instead of the pending one."""
        assert self._pending is not None
        number = len(self.keyframes)
        frame = self._frame(number)
        self._pending = None
        for jobs in self._jobs:
            jobs[:] = [job for job in jobs if job.k != number]
        self.keyframes.reuse(j, frame)

    def finish(self) -> Array:
        """Do all pending work; returns the optimized poses (N, 3) of the keyframes."""
        while self.is_busy:
            self.step()
        self._add_pending()
        return self.graph.optimized()
