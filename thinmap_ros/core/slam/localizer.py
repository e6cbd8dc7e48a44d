"""The localizer: one step for each scan, live and offline.

Calibrated odometry predicts the pose, and scan-to-map matching corrects it. The scan is added to
the local map when the robot has moved far enough. Keyframes and loop closure keep the map globally
consistent. If scans contradict the local map, a new one is started. A dead-reckoned edge with the
accumulated covariance connects the two.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.ekf_slam.features import LineFeature, odometry_variances
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, rotated_covariance
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.graph.saved_keyframes import SavedKeyframes
from thinmap_ros.core.slam.localizer_map import LocalizerMap
from thinmap_ros.core.slam.matching import local_map
from thinmap_ros.core.slam.matching.occupancy_surfaces import free_cells, occupied_surface_points
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.track import LocalizerConfig, Tracked, Tracker
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.graph import TopologicalMap


class Localizer:
    """Scan matching with a local map, keyframes and loop closure.

    Input that is not finite is counted in `rejected`; a rejected odometry pose means no motion.
    """

    def __init__(self, config: LocalizerConfig | None = None) -> None:
        self.config = config or LocalizerConfig()
        self._rejected = 0
        self.reset()

    def reset(self) -> None:
        """Discard map, path and pose; the next scan starts at the configured initial pose."""
        self._tracker = Tracker(self.config)
        self._map = LocalizerMap(self.config, self._tracker)

    def adjust(self, config: LocalizerConfig) -> None:
        """Continue with other values of `LIVE_PARAMETERS`; map, path and pose stay."""
        self.config = replace(
            self.config,
            lost_threshold=config.lost_threshold,
            matching=config.matching,
            loop_closure=config.loop_closure,
        )
        self._tracker.adjust(self.config)
        self._map.loops.adjust(config.loop_closure, config.matching)

    @property
    def rejected(self) -> int:
        """Number of odometry poses and `set_pose` calls with invalid values.

        And of scans that lie too far from the others for one map.
        """
        return self._rejected + self._tracker.prediction.rejected + self._map.local.refused

    @property
    def pose(self) -> Array:
        """Current pose T_map_base (3,), a copy."""
        return self._map.pose

    @property
    def keyframes(self) -> list[Keyframe]:
        """The keyframes, at their optimized poses."""
        return self._map.loops.keyframes.frames

    @property
    def edges(self) -> list[Edge]:
        """Edges of the pose graph between the keyframes: their steps, and those of loops."""
        return [*self._map.loops.keyframes.steps, *self._map.loops.graph.edges]

    @property
    def published_graph(self) -> LoopClosure | None:
        """The keyframes and their graph; None where the map is made of other cells, too."""
        return self._map.loops if self._map.local.is_of_keyframes else None

    @property
    def calibration(self) -> Array:
        """Calibration of the odometry (5, 4): its parameters, and their covariance (4, 4)."""
        found = self._tracker.prediction.calibration
        return np.vstack([found.parameters, found.covariance])

    @property
    def features(self) -> list[LineFeature]:
        """Line features of the map: none, as it is made of scan points."""
        return []

    def set_topology(self, topology: TopologicalMap) -> None:
        """Ignore the topological map, with which only a filter selects its local area."""

    def set_pose(self, T_map_base: Array, covariance: Array) -> None:
        """Set the pose (3,) with covariance (3, 3) in the current map.

        The map is not updated until scans confirm the pose. In a map that does not change, the
        robot is lost until then. A piece of map that is apart is left: the pose is in the published
        map.
        """
        if not (se2.is_bounded_pose(T_map_base) and np.isfinite(covariance).all()):
            self._rejected += 1
            return
        T_map_base = se2.pose(*T_map_base.tolist())
        self._map.place(T_map_base, covariance)
        self._tracker.track.evidence.place(is_map_given=not self.config.is_mapping)
        self._map.local.rerender(self.keyframes, T_map_base)

    def state(self) -> State:
        """The published local map as arrays by name, for `from_state`; without the pose."""
        return self._map.local.published(self.keyframes).state()

    def saved_keyframes(self, since_ns: int = 0) -> SavedKeyframes | None:
        """The keyframes of the published map, for `from_state`, from the one of a stamp on.

        None without any, and if the map began with cells that are not made of keyframes.
        """
        return self._map.loops.saved(since_ns) if self._map.local.is_of_keyframes else None

    @staticmethod
    def from_state(
        state: State,
        config: LocalizerConfig | None = None,
        keyframes: SavedKeyframes | None = None,
    ) -> 'Localizer':
        """Localizer in the local map of a saved `state`, at the configured initial pose.

        keyframes: those of that map, with which it is corrected like a map that has never been
        saved. It is delocalized until scans fit. Raises InputError if the state is invalid.
        """
        checked = snapshot.validate(state, local_map.FIELDS, 'local map')
        possible = bool((checked['hits'] <= checked['seen']).all())
        snapshot.require(
            possible, 'local map: hits: more than observations', 'no more hits than observations'
        )
        localizer = Localizer(config)
        localizer._map.local.map.restore(checked)
        localizer._start_delocalized(checked, keyframes)
        return localizer

    @staticmethod
    def in_occupancy_map(
        patch: GridPatch, config: LocalizerConfig | None = None, is_guess: bool = False
    ) -> 'Localizer':
        """Localizer in an occupancy map, at the configured initial pose.

        It is delocalized until scans fit. is_guess: the robot may be anywhere else, and is lost
        until scans on its way confirm the pose.
        """
        localizer = Localizer(config)
        local = localizer._map.local.map
        local.add_free_cells(*free_cells(patch, local.config.resolution_m))
        for faces in occupied_surface_points(patch):
            local.add_walls(faces.points, faces.normal)
        localizer._start_delocalized(local.state(), is_guess=is_guess)
        return localizer

    @staticmethod
    def from_keyframes(
        keyframes: SavedKeyframes, calibration: Array, config: LocalizerConfig | None = None
    ) -> 'Localizer':
        """Localizer of the same robot in the map of saved keyframes, at the initial pose.

        calibration (5, 4): of its odometry. It is delocalized until scans fit.
        """
        localizer = Localizer(config)
        localizer._tracker.prediction.calibration.begin_with(calibration[0], calibration[1:])
        localizer._start_delocalized(None, keyframes)
        return localizer

    def resume(self, last: OdometryAnchor, T_odom_base: Array) -> None:
        """Continue in the map after the odometry motion since `last`, to T_odom_base (3,).

        The standard deviation of the pose is the odometry noise since `last` plus one cell of the
        map (in rad, too, for the heading).
        """
        moved = se2.between(last.T_odom_base, T_odom_base)
        turn = float(last.T_map_odom[2] + last.T_odom_base[2])
        variances = odometry_variances(moved, self.config.odometry)
        cell = np.full(3, self.config.local_map.resolution_m)
        self.set_pose(
            se2.compose(last.T_map_odom, T_odom_base),
            rotated_covariance(np.diag(variances), turn) + np.diag(np.square(cell)),
        )

    def step(self, scan: Scan, T_odom_base: Array) -> Estimate:
        """Estimate the pose of a scan, given the odometry pose (3,) at its stamp; update the map.

        One step: predict, match, update the pose, update the map, close loops.
        """
        points = surface_points(scan)
        tracked = self._tracker.step(scan, points, T_odom_base, self._map.surroundings)
        evidence = self._tracker.track.evidence
        if not self.config.is_mapping:
            self._detect_loss()
        elif not evidence.is_delocalized:
            self._map.add(scan, points)
        elif evidence.needs_submap:
            self._map.start_submap()  # the robot is not where it was placed
        correction = self._map.close_loops()
        self._map.record_pose(scan.stamp_ns)
        return replace(self._estimate(tracked), correction=correction)

    def optimized_trajectory(self) -> Array:
        """Poses (N, 3) of all steps since the start, after all corrections.

        Pending matches are done, and the pose is corrected by them.
        """
        return self._map.trajectory()

    def keyframe_trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (N,) in ns and optimized poses (N, 3) of the keyframe scans along the path.

        Each other scan keeps its pose relative to the keyframe before it.
        """
        return self._map.loops.keyframes.path()

    def known_places(self) -> Array:
        """Places (N, 2) that enclose the published map: cells, and keyframes, m."""
        return self._map.known_places()

    def apart_points(self) -> Array:
        """Scan points (N, 2) of the pieces that are apart, where dead reckoning puts them, m."""
        return self._map.apart_points()

    def _start_delocalized(
        self,
        given: State | None,
        keyframes: SavedKeyframes | None = None,
        is_guess: bool = False,
    ) -> None:
        """Start in a loaded map: delocalized until scans fit."""
        start = self.pose
        self._map.load(given, keyframes)
        self._map.place(start, self._tracker.slip_covariance())
        is_believed = self.config.is_start_given or not self.config.is_mapping
        self._tracker.track.evidence.start_delocalized(is_believed, is_guess=is_guess)

    def _detect_loss(self) -> None:
        """In a map that does not change, the robot is delocalized if scans contradict it.

        Dead reckoning continues from the last scan that agreed.
        """
        track = self._tracker.track
        if track.evidence.is_delocalized or not track.evidence.needs_submap:
            return
        covariance = self._tracker.fall_back()
        track.uncertainty.place(track.T_anchor_base, covariance)
        track.evidence.lose()

    def _estimate(self, tracked: Tracked) -> Estimate:
        evidence = self._tracker.track.evidence
        anchor = self._map.loops.anchor
        T_map_base = self.pose
        apart = self._map.atlas.apart
        is_lost = apart is not None or evidence.is_lost
        match = tracked.match
        return Estimate(
            T_map_base,
            self._tracker.covariance(anchor),
            se2.compose(T_map_base, se2.invert(self._tracker.prediction.T_odom_base)),
            inlier_ratio=0.0 if match is None else match.inlier_ratio,
            is_lost=is_lost,
            apart=apart,
            is_contradicted=self.config.is_mapping and not evidence.permits_mapping,
            blind_reason=tracked.blind_reason,
            odometry_discontinuity=tracked.discontinuity,
            scan_information=match.scan_information if match and tracked.fits else None,
        )
