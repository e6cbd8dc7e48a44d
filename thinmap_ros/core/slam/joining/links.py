"""Edges between the keyframes of two pieces: matches of scans of one with submaps of the other."""

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.places.piece import DRIFT
from thinmap_ros.core.places.recognition import PieceHypothesis
from thinmap_ros.core.places.views import View
from thinmap_ros.core.se2 import Array, inverse, rotated_covariance
from thinmap_ros.core.slam.graph.keyframes import Keyframe, view_difference_m
from thinmap_ros.core.slam.graph.loop_closure import EDGE_NOISE, LoopClosureConfig, Submaps
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import MIN_POINTS, Matcher, MatchingConfig

_CONFIG = LoopClosureConfig()
# How far the place of a view is off at its other keyframes.
_PRIOR = np.diag(np.square([DRIFT.match_m, DRIFT.match_m, DRIFT.match_rad]))
# Less than of a loop: the place is known. With 0.75, errors between real halves were a fifth more.
_MIN_INLIER_RATIO = 0.7
Prior = tuple[int, Array]
"""A keyframe by its number, and its predicted pose (3,) in the known piece."""


def placed_keyframes(
    query: Sequence[Keyframe], views: Sequence[View], hypothesis: PieceHypothesis
) -> Iterator[Prior]:
    """Keyframes of the views that a hypothesis places; views: all of the piece, by number."""
    placed = [views[number] for number in sorted(hypothesis.poses)]
    for k, frame in enumerate(query):
        around = [view for view in placed if view.frames[0] <= k <= view.frames[2]]
        if around:
            view = min(around, key=lambda each: abs(each.frames[1] - k))
            yield k, _pose_by(view, hypothesis, frame)


def match_keyframes(
    known: Sequence[Keyframe], query: Sequence[Keyframe], priors: Iterable[Prior]
) -> Iterator[Edge | None]:
    """Match keyframes of a piece with submaps of the known one, where they are near to it.

    Yields an edge from a keyframe of the known piece to one of the query, each by its own number,
    for each match, or None for one that failed: a caller may do one at a time.
    """
    matcher = Matcher(MatchingConfig())
    submaps = Submaps(LocalMapConfig())
    poses = np.array([frame.T_map_base for frame in known]).reshape(-1, 3)
    for k, prior in priors:
        frame = query[k]
        j = _nearest(poses, prior)
        if j is None or len(frame.points) < MIN_POINTS:
            continue
        base, submap = submaps.around(known, j, math.inf)
        match = matcher.match(
            frame.points, frame.scan.T_base_laser, submap, se2.between(base, prior), _PRIOR
        )
        if match.inlier_ratio < _MIN_INLIER_RATIO:
            yield None
            continue
        covariance = inverse(match.scan_information + 1e-3 * np.eye(3)) + EDGE_NOISE
        T_j_base = se2.between(poses[j], base)
        information = inverse(rotated_covariance(covariance, float(T_j_base[2])))
        yield Edge(j, k, se2.compose(T_j_base, match.pose), information, robust=True)


def _pose_by(view: View, hypothesis: PieceHypothesis, frame: Keyframe) -> Array:
    T_view_frame = se2.between(view.T_piece_view, frame.T_map_base)
    return se2.compose(hypothesis.poses[view.number], T_view_frame)


def _nearest(poses: Array, T: Array) -> int | None:
    """The pose (N, 3) with the most similar view; None if all are too far away."""
    away = np.hypot(*(poses[:, :2] - T[:2]).T)
    near = np.flatnonzero(away < _CONFIG.search_radius_m)
    if not len(near):
        return None
    return int(min(near, key=lambda j: view_difference_m(poses[j], T)))
