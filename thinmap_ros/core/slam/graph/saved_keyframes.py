"""Keyframes of a published map with the edges between them, as they are saved with a session."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, inverse
from thinmap_ros.core.slam.graph import tables
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.pose_graph import NO_SHARE, Edge
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.odometry import UNKNOWN, OdometryCalibration
from thinmap_ros.core.slam.wall_compass import Heading, Reference
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, Field, Fields, State

MAX_KEYFRAMES = 1 << 16  # 45 km of new ground
MAX_EDGES = 1 << 18
_WHAT = 'keyframes'
_MAX_YAW_RAD = 4.0
_MAX_VALUE = 1e12  # of covariances, information and lengths
_MIN_VARIANCE = 1e-12
_ROUNDING = 1e-5  # relative error of a covariance in 32 bit
_UPPER = np.triu_indices(3)
_LOW_POSE = (-2.0 * MAX_COORDINATE_M, -2.0 * MAX_COORDINATE_M, -_MAX_YAW_RAD)
_HIGH_POSE = (2.0 * MAX_COORDINATE_M, 2.0 * MAX_COORDINATE_M, _MAX_YAW_RAD)
_LOW_HEADING = (-_MAX_YAW_RAD, _MIN_VARIANCE, 0.0)
_HIGH_HEADING = (_MAX_YAW_RAD, _MAX_VALUE, _MAX_VALUE)
# n keyframes with s = n - 1 steps, and m edges between visits. Symmetric matrices: upper triangle.
FIELDS: Fields = {
    **tables.FIELDS,
    'poses': Field(
        np.float64,
        ('n', 3),
        (-MAX_COORDINATE_M, -MAX_COORDINATE_M, -_MAX_YAW_RAD),
        (MAX_COORDINATE_M, MAX_COORDINATE_M, _MAX_YAW_RAD),
    ),
    'path_m': Field(np.float32, ('n',), 0.0, _MAX_VALUE),
    'covariances': Field(np.float32, ('n', 6), -_MAX_VALUE, _MAX_VALUE),
    'submaps': Field(np.int32, ('n',), 0, MAX_KEYFRAMES),
    'headings': Field(np.float32, ('n', 3), _LOW_HEADING, _HIGH_HEADING, nan=True),
    'step_from': Field(np.int32, ('s',), 0, MAX_KEYFRAMES),
    'step_poses': Field(np.float32, ('s', 3), _LOW_POSE, _HIGH_POSE),
    'step_information': Field(np.float64, ('s', 6), -_MAX_VALUE, _MAX_VALUE),
    'edges': Field(np.int32, ('m', 2), 0, MAX_KEYFRAMES),
    'edge_poses': Field(np.float32, ('m', 3), _LOW_POSE, _HIGH_POSE),
    'edge_information': Field(np.float64, ('m', 6), -_MAX_VALUE, _MAX_VALUE),
    'edge_inliers': Field(np.float32, ('m',), 0.0, 1.0),
}


@dataclass(frozen=True, eq=False)
class SavedKeyframes:
    """Keyframes (n >= 1), the step from its anchor to each but the first, and edges between visits.

    Nothing refers to a calibration of the odometry: its uncertainty when they were saved is part of
    the covariances, in each step by itself. Scans have the stamps 1, 2, 3, ... ns in their order,
    so that they are told from each other and from all scans of a robot. stamps_ns: those that the
    scans had; unknown of a session.
    """

    frames: list[Keyframe]
    steps: list[Edge]
    edges: list[Edge]
    stamps_ns: Sequence[int] = ()

    @staticmethod
    def of(
        frames: Sequence[Keyframe],
        steps: Sequence[Edge],
        edges: Sequence[Edge],
        is_saved: Sequence[bool],
        calibration: OdometryCalibration,
    ) -> 'SavedKeyframes':
        """Those of some keyframes that are saved, with the edges between these.

        steps: from its anchor to each keyframe but the first; calibration: of the odometry.
        """
        numbers = np.cumsum(is_saved) - 1  # new number of each keyframe that is saved
        kept = np.flatnonzero(is_saved).tolist()
        own_steps = [_step(steps[k - 1], frames, before, is_saved) for before, k in pairwise(kept)]
        own_edges = [edge for edge in edges if is_saved[edge.a] and is_saved[edge.b]]

        def renumbered(edge: Edge) -> Edge:
            settled = with_calibration(edge, calibration)
            return replace(settled, a=int(numbers[edge.a]), b=int(numbers[edge.b]))

        return SavedKeyframes(
            [
                _frame_with_calibration(frames[k], number + 1, calibration)
                for number, k in enumerate(kept)
            ],
            [renumbered(edge) for edge in own_steps],
            [renumbered(edge) for edge in own_edges],
            [frames[k].scan.stamp_ns for k in kept],
        )

    def extended(self, tail: 'SavedKeyframes') -> 'SavedKeyframes':
        """With the keyframes that came next; the first of these is the last one here.

        It may have been corrected in between: the others move along.
        """
        last = self.frames[-1]
        T = se2.compose(last.T_map_base, se2.invert(tail.frames[0].T_map_base))
        by = len(self.frames) - 1
        frames = [
            replace(frame, T_map_base=se2.compose(T, frame.T_map_base), submap=last.submap)
            for frame in tail.frames[1:]
        ]
        steps, edges = (
            [replace(edge, a=edge.a + by, b=edge.b + by) for edge in own]
            for own in (tail.steps, tail.edges)
        )
        return SavedKeyframes(
            self.frames + frames,
            self.steps + steps,
            self.edges + edges,
            [*self.stamps_ns, *tail.stamps_ns[1:]],
        )

    def with_stamps(self, stamps_ns: Sequence[int]) -> 'SavedKeyframes':
        """The keyframes with the stamps that their scans had: the same robot continues."""
        pairs = zip(self.frames, stamps_ns, strict=True)
        frames = [replace(f, scan=replace(f.scan, stamp_ns=stamp_ns)) for f, stamp_ns in pairs]
        return replace(self, frames=frames, stamps_ns=stamps_ns)

    @property
    def scans(self) -> list[tuple[Scan, Array]]:
        """The scans with their poses T_map_base (3,)."""
        return [(frame.scan, frame.T_map_base) for frame in self.frames]

    def state(self) -> State:
        """The keyframes as arrays by name, for `from_state`; ranges are rounded to 1 mm."""
        frames = self.frames
        submaps = np.unique([frame.submap for frame in frames], return_inverse=True)[1]
        return {
            **tables.packed_scans([frame.scan for frame in frames]),
            'poses': np.array([frame.T_map_base for frame in frames]),
            'path_m': np.array([frame.path_m for frame in frames], dtype=np.float32),
            'covariances': _triangles([f.covariance for f in frames]).astype(np.float32),
            'submaps': submaps.reshape(-1).astype(np.int32),
            'headings': np.array([_heading_row(f.heading) for f in frames], dtype=np.float32),
            'step_from': np.array([step.a for step in self.steps], dtype=np.int32),
            'step_poses': _relative_poses(self.steps),
            'step_information': _triangles([step.information for step in self.steps]),
            'edges': np.array([(e.a, e.b) for e in self.edges], np.int32).reshape(-1, 2),
            'edge_poses': _relative_poses(self.edges),
            'edge_information': _triangles([edge.information for edge in self.edges]),
            'edge_inliers': np.array([edge.inlier_ratio for edge in self.edges], np.float32),
        }

    @staticmethod
    def from_state(state: State, config: None = None) -> 'SavedKeyframes':
        """Restore a saved `state`. Raises InputError if it is invalid."""
        checked = snapshot.validate(state, FIELDS, _WHAT)
        _check_sizes(checked)
        _check_edges(checked)
        scans = tables.unpacked_scans(checked, _WHAT)
        covariances = _matrices(checked['covariances'].astype(np.float64))
        _require_definite(covariances, 'covariances', -_ROUNDING)
        submaps = np.unique(checked['submaps'], return_inverse=True)[1].reshape(-1).tolist()
        frames = [
            Keyframe(
                scan,
                surface_points(scan),
                checked['poses'][k],
                float(checked['path_m'][k]),
                covariances[k],
                submaps[k],
                _heading_of(checked['headings'][k].astype(np.float64)),
            )
            for k, scan in enumerate(scans)
        ]
        ends = np.column_stack([checked['step_from'], np.arange(1, len(frames))])
        return SavedKeyframes(
            frames,
            _edges_of(checked, 'step', ends, np.zeros(len(ends)), is_robust=False),
            _edges_of(checked, 'edge', checked['edges'], checked['edge_inliers'], is_robust=True),
        )


def _step(step: Edge, frames: Sequence[Keyframe], before: int, is_saved: Sequence[bool]) -> Edge:
    """The step to a keyframe, or one from the keyframe before if its anchor is not saved."""
    if is_saved[step.a]:
        return step
    T = se2.between(frames[before].T_map_base, frames[step.b].T_map_base)
    return Edge(before, step.b, T, inverse(UNKNOWN), False)


def with_calibration(edge: Edge, calibration: OdometryCalibration) -> Edge:
    """The edge with the uncertainty of the calibration among its own."""
    systematic = calibration.covariance_of(edge.systematic.derivative)
    if not systematic.any():
        return replace(edge, systematic=NO_SHARE)
    information = inverse(inverse(edge.information) + systematic)
    return replace(edge, information=information, systematic=NO_SHARE)


def _frame_with_calibration(
    frame: Keyframe, stamp_ns: int, calibration: OdometryCalibration
) -> Keyframe:
    heading = frame.heading
    if heading is not None:
        by = heading.reference.systematic.derivative
        variance = heading.reference.variance + float(calibration.covariance_of(by)[2, 2])
        heading = Heading(heading.yaw, heading.variance, Reference(variance, NO_SHARE))
    return replace(
        frame,
        scan=replace(frame.scan, stamp_ns=stamp_ns),
        covariance=frame.covariance + calibration.covariance_of(frame.systematic),
        systematic=np.zeros((3, 4)),
        heading=heading,
    )


def _check_sizes(checked: State) -> None:
    count = len(checked['poses'])
    edges = len(checked['edges'])
    snapshot.require(
        1 <= count <= MAX_KEYFRAMES, f'{_WHAT}: {count}', f'1 to {MAX_KEYFRAMES} keyframes'
    )
    steps = len(checked['step_from'])
    snapshot.require(steps == count - 1, f'{_WHAT}: {steps} steps', f'{count - 1}')
    snapshot.require(edges <= MAX_EDGES, f'{_WHAT}: {edges} edges', f'at most {MAX_EDGES}')


def _check_edges(checked: State) -> None:
    count = len(checked['poses'])
    is_before = checked['step_from'] < np.arange(1, count)
    snapshot.require(bool(is_before.all()), f'{_WHAT}: step_from', 'an earlier keyframe each')
    edges = checked['edges']
    are_two = (edges < count).all() and (edges[:, 0] != edges[:, 1]).all()
    snapshot.require(bool(are_two), f'{_WHAT}: edges', f'two of the {count} keyframes each')


def _require_definite(matrices: Array, name: str, least: float) -> None:
    """Raise InputError unless the eigenvalues of (N, 3, 3) are above a share of the greatest."""
    values = np.linalg.eigvalsh(matrices)
    greatest = np.abs(values).max(axis=-1, initial=0.0)
    are_so = (values[:, 0] >= least * greatest) & (greatest > 0.0 if least > 0.0 else True)
    snapshot.require(bool(np.all(are_so)), f'{_WHAT}: {name}', 'positive definite matrices')


def _edges_of(
    checked: State, name: str, ends: NDArray[Any], inliers: NDArray[Any], is_robust: bool
) -> list[Edge]:
    information = _matrices(checked[f'{name}_information'])
    _require_definite(information, f'{name}_information', _MIN_VARIANCE)
    poses = checked[f'{name}_poses'].astype(np.float64)
    rows = zip(ends.tolist(), poses, information, inliers.tolist(), strict=True)
    return [
        Edge(a, b, T_a_b, own, is_robust, inlier_ratio=ratio) for (a, b), T_a_b, own, ratio in rows
    ]


def _heading_row(heading: Heading | None) -> tuple[float, ...]:
    """Yaw, its variance and that of the main direction; NaN without a heading."""
    if heading is None:
        return (np.nan, np.nan, np.nan)
    return (float(se2.wrap(heading.yaw)), heading.variance, heading.reference.variance)


def _heading_of(row: Array) -> Heading | None:
    yaw, variance, of_reference = row.tolist()
    if np.isnan(row).any():
        return None
    return Heading(yaw, variance, Reference(of_reference, NO_SHARE))


def _relative_poses(edges: Sequence[Edge]) -> NDArray[np.float32]:
    poses = np.array([edge.T_a_b for edge in edges], dtype=np.float64).reshape(-1, 3)
    poses[:, 2] = se2.wrap(poses[:, 2])
    return poses.astype(np.float32)


def _triangles(matrices: Sequence[Array]) -> Array:
    """Upper triangles (N, 6) of symmetric matrices (N, 3, 3)."""
    whole = np.array(matrices, dtype=np.float64).reshape(-1, 3, 3)
    return np.asarray(0.5 * (whole + whole.transpose(0, 2, 1)))[:, _UPPER[0], _UPPER[1]]


def _matrices(triangles: Array) -> Array:
    """Symmetric matrices (N, 3, 3) of their upper triangles (N, 6)."""
    whole = np.zeros((len(triangles), 3, 3))
    whole[:, _UPPER[0], _UPPER[1]] = triangles
    whole[:, _UPPER[1], _UPPER[0]] = triangles
    return whole
