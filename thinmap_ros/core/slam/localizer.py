"""The localizer: one step for each scan, live and offline.

Calibrated odometry predicts the pose, and scan-to-map matching corrects it. The scan is added to
the local map when the robot has moved far enough. Keyframes and loop closure keep the map globally
consistent. If scans contradict the local map, a new one is started. A dead-reckoned edge with the
accumulated covariance connects the two.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import parameters_of, with_values
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig, EkfLocalizer
from thinmap_ros.core.ekf_slam.features import (
    LineConfig,
    LineFeature,
    extract_lines,
    odometry_variances,
)
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.places.place_odds import SURE
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, rotated_covariance
from thinmap_ros.core.slam.graph.keyframes import (
    Keyframe,
    SavedKeyframes,
    Step,
    heading_errors,
    with_heading,
)
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure
from thinmap_ros.core.slam.graph.pose_graph import Edge, Systematic
from thinmap_ros.core.slam.graph.reckoned import Reckoned
from thinmap_ros.core.slam.graph.tables import KeyframeTrajectory, heading_row
from thinmap_ros.core.slam.joining.join import Atlas
from thinmap_ros.core.slam.matching import local_map
from thinmap_ros.core.slam.matching.local_map import LocalMap, LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import MIN_POINTS
from thinmap_ros.core.slam.matching.surface import (
    free_cells,
    occupied_surface_points,
    surface_points,
)
from thinmap_ros.core.slam.odometry import OdometryCalibration, PoseUncertainty
from thinmap_ros.core.slam.track import LocalizerConfig, Surroundings, Tracked, Tracker
from thinmap_ros.core.slam.wall_compass import Heading, Reference, WallCompass
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.stage import Correction, Estimate, StartConfig, are_two_storeys, checked_tag
from thinmap_ros.core.topology.graph import TopologicalMap

_RENDER_FIRST = 20  # keyframes that are rendered at once after a correction
_MIN_SIGMA_RAD = 5e-4  # of the heading of a scan, at the least
_NEW_RATIO = 0.2  # of a match's error, that is independent of the previous map update
# A scan is added to the local map after so much motion: nearer ones show the same walls again.
_UPDATE_M = 0.2
_UPDATE_RAD = 0.2

TAG = 'map_tag'  # in a saved state

_VIEW_M = 1.0  # path length after which the errors of two matches are independent


class ActiveMap:
    """The local map of a piece, its loaded cells, and the keyframes that are not yet rendered.

    Loaded cells belong to the published map. After a loop closure the map is re-rendered from the
    keyframes, some in each step.
    """

    def __init__(self, config: LocalMapConfig, loops: LoopClosure) -> None:
        """loops: the keyframes and the pieces that they are in."""
        self._config = config
        self._loops = loops
        self.map = LocalMap(config)
        self.refused = 0  # scans that lie too far from the others for one map
        self._loaded: Mapping[str, NDArray[Any]] | None = None
        self._loaded_keyframes = 0  # whose scans are in the loaded cells
        self._pending: list[int] = []
        self._revision = 0

    def load(self, given: Mapping[str, NDArray[Any]] | None, keyframes: int) -> None:
        """Set the cells of a `LocalMap.state` with which every re-rendered map starts; None: none.

        keyframes: number of the first keyframes that these cells are made of, 0 if they are not
        known. Otherwise a corrected map is rendered from the keyframes alone.
        """
        self._loaded = given
        self._loaded_keyframes = keyframes

    @property
    def is_of_keyframes(self) -> bool:
        """Whether all of the published map can be rendered from keyframes."""
        return self._loaded is None or self._loaded_keyframes > 0

    def add_scan(self, points: Array, T_base_laser: Array, T_map_base: Array) -> bool:
        """Add surface points (N, 5), robot frame, of a scan at a pose (3,).

        Returns False, and counts the scan in `refused`, if the map would become too large.
        """
        try:
            self.map.add_scan(points, T_base_laser, T_map_base)
        except InputError:
            self.refused += 1
            return False
        return True

    def start_submap(self) -> None:
        """Continue in an empty map."""
        self.map = LocalMap(self._config)
        self._pending = []

    def rerender(self, T_map_base: Array) -> None:
        """Re-render the map from the keyframes of the piece, those nearest to a pose (3,) first."""
        pieces = self._loops.pieces
        frames = self._loops.keyframes.frames
        self.map = self._begun(is_published=not pieces.is_apart)
        places = np.array([frame.T_map_base for frame in frames]).reshape(-1, 3)[:, :2]
        order = np.argsort(-np.hypot(*(places - T_map_base[:2]).T)).tolist()
        first = self._loaded_keyframes
        self._pending = [k for k in order if k >= first and pieces.is_here(frames[k].submap)]
        self._render(_RENDER_FIRST)

    def follow(self, T_anchor_base: Array) -> None:
        """Render the keyframes as they were corrected last, some in each step.

        T_anchor_base (3,): pose of the robot.
        """
        revision = self._loops.keyframes.revision
        if revision != self._revision:
            self._revision = revision
            if self._loaded_keyframes > 0:  # the loaded cells show these where they were
                self.load(None, 0)
            self.rerender(self._loops.anchor.pose(T_anchor_base))
        self._render()

    def published(self) -> LocalMap:
        """The local map of the published piece: rendered again while the robot is in another."""
        pieces = self._loops.pieces
        if not pieces.is_apart:
            return self.map
        rendered = self._begun(is_published=True)
        for frame in self._loops.keyframes.frames[self._loaded_keyframes :]:
            if pieces.is_published(frame.submap):
                with suppress(InputError):  # counted when it was added
                    rendered.add_scan(frame.points, frame.scan.T_base_laser, frame.T_map_base)
        return rendered

    def complete(self) -> None:
        """Render all keyframes that are pending."""
        self._render(len(self._pending))

    def _render(self, count: int = 2) -> None:
        """Render up to `count` of the pending keyframes."""
        for _ in range(min(count, len(self._pending))):
            frame = self._loops.keyframes.frames[self._pending.pop()]
            self.add_scan(frame.points, frame.scan.T_base_laser, frame.T_map_base)

    def _begun(self, is_published: bool) -> LocalMap:
        """An empty map, or one with the loaded cells."""
        begun = LocalMap(self._config)
        if is_published and self._loaded is not None:
            begun.restore(self._loaded)
        return begun


class HeadingCorrection:
    """Corrects the heading of scans by the wall compass before they are added to the map."""

    def __init__(self, config: LineConfig, calibration: OdometryCalibration) -> None:
        self._calibration = calibration
        self._revision = 0
        self._config = config
        self._compass = WallCompass()
        self._variance = _MIN_SIGMA_RAD**2  # of the heading since its last measurement
        self.measured: Heading | None = None  # measured heading of the last scan

    def correct(
        self,
        scan: Scan,
        T_map_base: Array,
        pose: PoseUncertainty,
        path_m: float,
        fits: bool,
        own: Reference,
        revision: int,
    ) -> Array:
        """Pose (3,) with the heading corrected by the wall directions, if they give one.

        path_m: length of the path so far (m); walls near the start of the path weigh most.
        fits: whether scans agree with the map; otherwise the pose is unchanged; own: error of the
        heading, relative to where the map began; revision: number of corrections of the map, with
        which the main direction turns as the calibration of the odometry has it.
        """
        if revision != self._revision:
            self._revision = revision
            self._compass.calibrate(self._calibration.smoothed())
        # The gate is narrower than the variance of the pose: a larger heading error is also in the
        # local map, and a scan that is corrected alone would no longer fit this map.
        self._variance += float(pose.motion_part[2, 2] + _NEW_RATIO * pose.scan_part[2, 2])
        self.measured = None
        if not fits:
            return T_map_base
        lines = extract_lines(scan, self._config)
        x, y, heading = T_map_base.tolist()
        self.measured = self._compass.read(lines, heading, self._variance)
        if self.measured is not None:
            gain = self._variance / (self._variance + self.measured.variance)
            heading = float(se2.wrap(heading + gain * (self.measured.yaw - heading)))
            self._variance *= 1.0 - gain
        self._compass.add_lines(lines, heading, path_m, own)
        return se2.pose(x, y, heading)


class Localizer:
    """Scan matching with a local map, keyframes and loop closure.

    Input that is not finite is counted in `rejected`; a rejected odometry pose means no motion.
    """

    follows_topology: ClassVar[bool] = False

    def __init__(self, config: LocalizerConfig | None = None) -> None:
        self.config = config or LocalizerConfig()
        self._rejected = 0
        self.reset()

    def reset(self) -> None:
        """Discard map, path and pose; the next scan starts at the configured initial pose."""
        config = self.config
        self._tracker = Tracker(config)
        calibration = self._tracker.prediction.calibration
        self._heading = HeadingCorrection(config.lines, calibration)
        self._loops = LoopClosure(
            config.loop_closure, config.keyframes, config.matching, config.local_map, calibration
        )
        self._loops.pieces.tag = checked_tag('map_tag', config.map_tag)
        self._atlas = Atlas(self._loops)
        self._local = ActiveMap(config.local_map, self._loops)
        self._path = KeyframeTrajectory()

    def adjust(self, config: LocalizerConfig) -> None:
        """Continue with other values of `LIVE_PARAMETERS`; map, path and pose stay."""
        self.config = replace(
            self.config,
            lost_threshold=config.lost_threshold,
            matching=config.matching,
            loop_closure=config.loop_closure,
        )
        self._tracker.adjust(self.config)
        self._loops.adjust(config.loop_closure, config.matching)

    @property
    def rejected(self) -> int:
        """Number of odometry poses and `set_pose` calls with invalid values.

        And of scans that lie too far from the others for one map.
        """
        return self._rejected + self._tracker.prediction.rejected + self._local.refused

    @property
    def pose(self) -> Array:
        """Current pose T_map_base (3,), a copy."""
        return self._loops.anchor.pose(self._tracker.T_anchor_base)

    @property
    def keyframes(self) -> list[Keyframe]:
        """The keyframes, at their optimized poses."""
        return self._loops.keyframes.frames

    @property
    def edges(self) -> list[Edge]:
        """Edges of the pose graph between the keyframes: their steps, and those of loops."""
        return [*self._loops.keyframes.steps, *self._loops.graph.edges]

    @property
    def map_tag(self) -> str:
        """Tag of the storey that the published map shows; '' where it is not known."""
        return self._loops.pieces.published_tag

    @property
    def published_graph(self) -> LoopClosure | None:
        """The keyframes and their graph; None where the map is made of other cells, too."""
        return self._loops if self._local.is_of_keyframes else None

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

        A map that is not empty is not updated until scans confirm the pose: looks on the way may
        speak against it.
        In a map that does not change, the robot is lost until then. A piece of map that is apart is
        left: the pose is in the published map.
        """
        if not (se2.is_bounded_pose(T_map_base) and np.isfinite(covariance).all()):
            self._rejected += 1
            return
        T_map_base = se2.pose(*T_map_base.tolist())
        self._place(T_map_base, covariance)
        if self._local.map.is_empty and not self.keyframes:
            self._tracker.belief.start_submap()  # there is nothing that could confirm the pose
        else:
            self._tracker.belief.place(is_map_given=not self.config.is_mapping)
        self._local.rerender(T_map_base)

    def complete_map(self) -> None:
        """Render what a correction has left to be rendered: a map that is saved lacks nothing."""
        self._local.complete()

    def state(self) -> State:
        """The published local map as arrays by name, for `from_state`; without the pose."""
        return {**self._local.published().state(), **self.tag_state()}

    def tag_state(self) -> State:
        """The tag of the published map as an array by name; nothing where it has none."""
        return {TAG: snapshot.text_array(self.map_tag)} if self.map_tag else {}

    def tag_map(self, tag: str) -> None:
        """Take the tag of the map that it was loaded from; '' is none.

        Raises InputError where it is in a map of another storey than the configured one.
        """
        checked_tag('map_tag of the map', tag)
        if are_two_storeys(self.map_tag, tag):
            raise InputError(
                f'map_tag = {quoted(self.map_tag)}: the map is of {quoted(tag)}: expected a map of '
                'the same storey'
            )
        self._loops.pieces.tag = self.map_tag or tag

    def enter_storey(self, tag: str) -> None:
        """Continue on a storey: in the map, which gets the tag if it has none, or in a piece apart.

        A piece begins where the robot was on another storey, and joins the map where both have one
        tag. Raises InputError where the tag is none, or the map of another storey stays as it is.
        """
        if not checked_tag('map_tag', tag):
            raise InputError(f'map_tag = {quoted(tag)}: expected the name of a storey')
        pieces = self._loops.pieces
        if are_two_storeys(pieces.tag, tag) and not self._local.map.is_empty:
            if not self.config.is_mapping:
                raise InputError(
                    f'map_tag = {quoted(tag)}: the map is of {quoted(pieces.tag)}, and mode: '
                    f'{self.config.mode}: expected that a map of that storey is loaded'
                )
            self._start_submap()
        pieces.tag = tag
        self.config = replace(self.config, map_tag=tag)

    def saved_keyframes(self, since_ns: int = 0) -> SavedKeyframes | None:
        """The keyframes of the published map, for `from_state`, from the one of a stamp on.

        None without any, and if the map began with cells that are not made of keyframes.
        """
        return self._loops.saved(since_ns) if self._local.is_of_keyframes else None

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
        tag, cells = snapshot.split_text(state, TAG)
        checked = snapshot.validate(cells, local_map.FIELDS, 'local map')
        possible = bool((checked['hits'] <= checked['seen']).all())
        snapshot.require(
            possible, 'local map: hits: more than observations', 'no more hits than observations'
        )
        localizer = Localizer(config)
        localizer.tag_map(tag)
        localizer._local.map.restore(checked)
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
        local = localizer._local.map
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
        covariance = rotated_covariance(np.diag(variances), turn) + np.diag(np.square(cell))
        T_map_base = se2.compose(last.T_map_odom, T_odom_base)
        self._place(T_map_base, covariance)
        self._tracker.belief.place(not self.config.is_mapping, is_tried=False)
        self._local.rerender(T_map_base)

    def step(self, scan: Scan, T_odom_base: Array) -> Estimate:
        """Estimate the pose of a scan, given the odometry pose (3,) at its stamp; update the map.

        One step: predict, match, update the pose, update the map, close loops.
        """
        points = surface_points(scan)
        tracked = self._tracker.step(scan, points, T_odom_base, self._surroundings)
        belief = self._tracker.belief
        if not self.config.is_mapping:
            self._detect_loss()
        elif not belief.is_delocalized:
            self._add_scan(scan, points)
        elif belief.needs_submap:
            self._start_submap()  # the robot is not where it was placed
        estimate = self._estimate(tracked, self._close_loops())
        self._record_pose(scan.stamp_ns, estimate.T_map_base)
        return estimate

    def optimized_trajectory(self) -> Array:
        """Poses (N, 3) of all steps since the start, after all corrections.

        Pending matches are done, and the pose is corrected by them.
        """
        while self._loops.is_busy:
            self._close_loops()
        return self._path.poses(self._loops.finish())

    def corrected_trajectory(self) -> Array:
        """Poses (N, 3) of all steps since the start, after the corrections so far."""
        return self._path.poses(self._loops.keyframes.poses())

    def keyframe_trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (N,) in ns and optimized poses (N, 3) of the keyframe scans along the path.

        Each other scan keeps its pose relative to the keyframe before it.
        """
        return self._loops.keyframes.path()

    def known_places(self) -> Array:
        """Places (N, 2) that enclose the published map: cells, and keyframes, m."""
        is_published = self._loops.pieces.is_published
        keyframes = [each.T_map_base[:2] for each in self.keyframes if is_published(each.submap)]
        cells = self._local.published().corners()
        return np.vstack([cells, np.array(keyframes).reshape(-1, 2)])

    def apart_points(self) -> Array:
        """Scan points (N, 2) of the pieces that are apart, where dead reckoning puts them, m."""
        is_published = self._loops.pieces.is_published
        points = [
            se2.transform_points(frame.T_map_base, frame.scan.points_base())
            for frame in self.keyframes
            if not is_published(frame.submap)
        ]
        return np.vstack([np.zeros((0, 2)), *points])

    def _start_delocalized(
        self,
        given: State | None,
        keyframes: SavedKeyframes | None = None,
        is_guess: bool = False,
    ) -> None:
        """Start in the cells of a `LocalMap.state` and the keyframes that they are made of.

        Without cells, these are rendered from the keyframes. Delocalized until scans fit.
        """
        start = self.pose
        if keyframes is not None:
            self._loops.load(keyframes)
        if given is None:
            self._local.rerender(self.pose)
        else:
            self._local.load(given, len(self.keyframes))
        self._place(start, self._tracker.slip_covariance())
        is_given = self.config.is_start_given
        self._tracker.belief.start_delocalized(
            is_given or not self.config.is_mapping, is_guess, is_tried=is_given and not is_guess
        )

    def _detect_loss(self) -> None:
        """In a map that does not change, the robot is delocalized if scans contradict it.

        Dead reckoning continues from the last scan that agreed.
        """
        track = self._tracker
        if track.belief.is_delocalized or not track.belief.needs_submap:
            return
        covariance = track.fall_back()
        track.uncertainty.place(track.T_anchor_base, covariance)
        track.belief.lose()

    def _estimate(self, tracked: Tracked, correction: Correction | None) -> Estimate:
        belief = self._tracker.belief
        anchor = self._loops.anchor
        T_map_base = anchor.pose(self._tracker.T_anchor_base)
        apart = self._atlas.apart
        is_lost = apart is not None or belief.is_lost
        match = tracked.match
        return Estimate(
            T_map_base,
            self._tracker.covariance(anchor),
            se2.compose(T_map_base, se2.invert(self._tracker.prediction.T_odom_base)),
            inlier_ratio=0.0 if match is None else match.inlier_ratio,
            correction=correction,
            is_lost=is_lost,
            apart=apart,
            is_contradicted=self.config.is_mapping and not belief.permits_mapping,
            blind_reason=tracked.blind_reason,
            odometry_discontinuity=tracked.discontinuity,
            scan_information=match.scan_information if match and tracked.fits else None,
        )

    @property
    def _surroundings(self) -> Surroundings:
        """What the next scan is matched with."""
        keyframes = self._loops.keyframes
        return Surroundings(
            self._local.map,
            self._loops.anchor,
            keyframes.revision,
            has_keyframes=len(keyframes) > 0,
            is_apart=self._loops.pieces.is_apart,
        )

    def _place(self, T_map_base: Array, covariance: Array) -> None:
        """Place the robot at a given pose (3,) with covariance (3, 3) in the published map."""
        self._loops.pieces.return_to_published()
        self._loops.return_to(T_map_base)
        anchor = self._loops.anchor
        self._tracker.place(anchor.relative(T_map_base), anchor.turned(covariance))

    def _add_scan(self, scan: Scan, points: Array) -> None:
        """Add a scan with surface points (N, 5) if the robot has moved far enough since the last.

        In a submap of its own if scans contradict the map. The pose stays, whatever of it an error
        ends.
        """
        T_map_base = self.pose
        try:
            self._update_map(scan, points)
        except Exception:
            # What it is relative to may be another keyframe.
            self._tracker.T_anchor_base = self._loops.anchor.relative(T_map_base)
            raise

    def _update_map(self, scan: Scan, points: Array) -> None:
        track = self._tracker
        moved = track.since_update
        path_m = 0.0 if moved is None else math.hypot(moved[0], moved[1])
        turn = 0.0 if moved is None else abs(float(moved[2]))
        is_near = path_m < _UPDATE_M and turn < _UPDATE_RAD
        if moved is not None and is_near:
            return
        if track.belief.needs_submap:
            self._start_submap()
        elif track.belief.forbids_mapping:
            return
        self._correct_heading(scan)
        if not self._local.add_scan(points, scan.T_base_laser, self.pose):
            # No building is that large: the pose is wrong, or was.
            self._start_submap()
            self._local.add_scan(points, scan.T_base_laser, self.pose)
        track.T_anchor_update = track.T_anchor_base
        # Motion errors are independent in each step. The error of a match is correlated with that
        # of the previous match as long as the same walls are observed.
        track.uncertainty.map_updated(min(1.0, path_m / _VIEW_M + turn))
        if len(points) >= MIN_POINTS and self._loops.needs_keyframe(track.T_anchor_base):
            self._add_keyframe(scan, points)

    def _start_submap(self) -> None:
        """Start a new local map at the dead-reckoned pose."""
        track = self._tracker
        covariance = track.fall_back()
        track.uncertainty.start_submap(track.T_anchor_base, covariance)
        own = rotated_covariance(track.reckoned.covariance, float(self._loops.anchor.T_map[2]))
        log_odds = -SURE if track.belief.is_delocalized else track.belief.log_odds
        path_m = self._loops.anchor.path_m_at(track.T_anchor_base)
        self._loops.pieces.begin(Reckoned(log_odds, self.pose, own, path_m))
        track.belief.start_submap()
        self._local.start_submap()

    def _close_loops(self) -> Correction | None:
        """Do one step of loop closure; the local map follows its correction."""
        self._atlas.step(self.config.loop_closure.join_odds)
        correction = self._loops.step()
        if correction is not None:
            correction = replace(correction, join=self._atlas.take_join())
        self._local.follow(self._tracker.T_anchor_base)
        return correction

    def _record_pose(self, stamp_ns: int, T_map_base: Array) -> None:
        """Store the pose (3,) of this step relative to its keyframe."""
        keyframes = self._loops.keyframes
        T_keyframe = keyframes.T_map_anchor
        self._path.add(stamp_ns, keyframes.anchor, se2.between(T_keyframe, T_map_base))

    def _correct_heading(self, scan: Scan) -> None:
        """Correct the heading by the wall directions if scans agree with the map."""
        anchor = self._loops.anchor
        track = self._tracker
        derivative = np.vstack([np.zeros((2, 4)), track.systematic(anchor)[2]])
        variance = float(track.random_covariance(anchor)[2, 2])
        corrected = self._heading.correct(
            scan,
            anchor.pose(track.T_anchor_base),
            track.uncertainty,
            anchor.path_m_at(track.T_anchor_base),
            track.belief.agrees,
            Reference(variance, self._share(derivative)),
            self._loops.keyframes.revision,
        )
        track.turn(anchor.relative(corrected))

    def _add_keyframe(self, scan: Scan, points: Array) -> None:
        """Make the scan a keyframe, to which the pose is relative from now on."""
        loops = self._loops
        tracker = self._tracker
        anchor = loops.anchor
        T_map_base = self.pose
        uncertainty = tracker.uncertainty
        covariance, jump = uncertainty.step()
        step = Step(covariance, self._share(uncertainty.systematic))
        # In a new submap the heading is unknown, also by multiples of 90 degrees.
        is_lost = loops.pieces.is_apart or tracker.belief.is_lost
        heading = None if is_lost else self._heading.measured
        (error,) = heading_errors(np.array([heading_row(heading)]), T_map_base[None])
        covariance, systematic = with_heading(
            tracker.random_covariance(anchor), tracker.systematic(anchor), error
        )
        submap = loops.pieces.current
        path_m = anchor.path_m_at(tracker.T_anchor_base)
        frame = Keyframe(scan, points, T_map_base, path_m, covariance, submap, heading, systematic)
        loops.add(frame, step, jump)
        tracker.begin_step()

    def _share(self, derivative: Array) -> Systematic:
        """Share of the odometry in a relative pose of this step, by its derivative (3, 4)."""
        calibration = self._tracker.prediction.calibration
        return Systematic(derivative, calibration.parameters, calibration.spans)


AnyLocalizer = Localizer | EkfLocalizer


def tag_of(state: State) -> str:
    """The tag of the storey in a `Localizer.state`; '' for none. Raises InputError."""
    return snapshot.split_text(state, TAG)[0]


class LocalizerClass(Protocol):
    """What makes localizers; config: of the class that belongs to them."""

    def __call__(self, config: Any) -> AnyLocalizer:
        """With an empty map, at the configured initial pose."""

    def from_state(self, state: State, config: Any) -> AnyLocalizer:
        """In the map of a saved state, at the configured initial pose."""


_LOCALIZERS: dict[type[StartConfig], LocalizerClass] = {
    LocalizerConfig: Localizer,
    EkfConfig: EkfLocalizer,
}

_CONFIGS = {slam: config for config in _LOCALIZERS for slam in config.of_slam}


def config_class(slam: str) -> type[StartConfig]:
    """Class of the configuration of the localizer that `slam` selects.

    Raises ConfigError for another value.
    """
    return _CONFIGS[StartConfig(slam=slam).slam]


def localizer_class(config: StartConfig) -> LocalizerClass:
    """Class of the localizer that a configuration is for."""
    return _LOCALIZERS[type(config)]


def default_config(slam: str) -> StartConfig:
    """Defaults of the localizer that `slam` selects. Raises ConfigError for another value."""
    return config_class(slam)(slam=slam)


def config_with(values: Mapping[str, Any]) -> StartConfig:
    """Configuration of the localizer that `slam` among the values selects, with these values.

    values: by the full names of the parameters. Raises ConfigError for a parameter that this
    localizer does not have, or a value that is not allowed.
    """
    config = default_config(values.get('slam', StartConfig.slam))
    return with_values(config, values)


def parameters_elsewhere(slam: str) -> dict[str, str]:
    """Names of the parameters that only other localizers have, with the `slam` of these in words.

    Raises ConfigError for another value.
    """
    own = _names(config_class(slam))
    return {
        name: f'slam: {" or ".join(config.of_slam)}'
        for config in _LOCALIZERS
        for name in _names(config)
        if name not in own
    }


def adjust(localizer: AnyLocalizer, config: StartConfig) -> None:
    """Continue with other values of `LIVE_PARAMETERS`, which are all of scan matching."""
    if isinstance(localizer, Localizer) and isinstance(config, LocalizerConfig):
        localizer.adjust(config)


def _names(config: type[StartConfig]) -> list[str]:
    return [name for name, _, _ in parameters_of(config())]
