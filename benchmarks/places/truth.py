"""Errors of joined pieces against the true poses of their keyframes."""

import numpy as np

from benchmarks.places.recorded import RecordedPiece
from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array

_NEAR_M = 2.0  # of a keyframe of one piece from the nearest one of the other


def relative_errors(
    known: RecordedPiece, query: RecordedPiece, known_poses: Array, query_poses: Array
) -> Array:
    """Errors (N,), m, of the poses of keyframes of the query relative to the nearest known ones.

    known_poses (K, 3), query_poses (Q, 3): of all keyframes, in one frame. Of keyframes that
    are near each other by the truth.
    """
    return overlap_errors(known.truth, query.truth, known_poses, query_poses)


def overlap_errors(
    known_truth: Array, query_truth: Array, known_poses: Array, query_poses: Array
) -> Array:
    """Errors (N,), m, as `relative_errors`, by the true poses (K, 3) and (Q, 3) of both."""
    errors = []
    for k, T_true in enumerate(query_truth):
        away = np.hypot(*(known_truth[:, :2] - T_true[:2]).T)
        if np.isnan(away).all():
            continue
        j = int(np.nanargmin(away))
        if away[j] > _NEAR_M:
            continue
        want = se2.between(known_truth[j], T_true)
        off = se2.between(want, se2.between(known_poses[j], query_poses[k]))
        errors.append(float(np.hypot(off[0], off[1])))
    return np.array(errors)


def rigid_errors(known: RecordedPiece, query: RecordedPiece, T_known_query: Array) -> Array:
    """Errors (N,), m, as `relative_errors`, with the query at a pose (3,)."""
    moved = np.array([se2.compose(T_known_query, T) for T in query.poses])
    return relative_errors(known, query, known.poses, moved)


def true_pose(known: RecordedPiece, T_true: Array) -> tuple[Array, float]:
    """A true pose (3,) in the frame of a piece, by its nearest keyframe, and the distance, m."""
    away = np.hypot(*(known.truth[:, :2] - T_true[:2]).T)
    j = int(np.nanargmin(away))
    return se2.compose(known.poses[j], se2.between(known.truth[j], T_true)), float(away[j])
