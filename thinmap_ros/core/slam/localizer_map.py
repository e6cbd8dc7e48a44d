"""The map of the localizer: its local map, keyframes, pose graph and trajectory."""

import math
from dataclasses import replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.active_map import ActiveMap
from thinmap_ros.core.slam.atlas import Atlas
from thinmap_ros.core.slam.graph.heading_table import heading_row
from thinmap_ros.core.slam.graph.keyframes import Keyframe, Step, heading_errors, with_heading
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure
from thinmap_ros.core.slam.graph.pose_graph import Systematic
from thinmap_ros.core.slam.graph.saved_keyframes import SavedKeyframes
from thinmap_ros.core.slam.graph.trajectory import KeyframeTrajectory
from thinmap_ros.core.slam.heading import HeadingCorrection
from thinmap_ros.core.slam.matching.scan_matcher import MIN_POINTS
from thinmap_ros.core.slam.track import LocalizerConfig, Surroundings, Tracker
from thinmap_ros.core.slam.wall_compass import Reference
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.stage import Correction

# A scan is added to the local map after so much motion: nearer ones show the same walls again.
_UPDATE_M = 0.2
_UPDATE_RAD = 0.2
_VIEW_M = 1.0  # path length after which the errors of two matches are independent


class LocalizerMap:
    """Adds the scans of a tracker to the local map and to the keyframes, and closes loops."""

    def __init__(self, config: LocalizerConfig, tracker: Tracker) -> None:
        self._config = config
        self._tracker = tracker
        calibration = tracker.prediction.calibration
        self._heading = HeadingCorrection(config.lines, calibration)
        self.loops = LoopClosure(
            config.loop_closure, config.keyframes, config.matching, config.local_map, calibration
        )
        self.atlas = Atlas(self.loops)
        self.local = ActiveMap(config.local_map, self.loops.pieces)
        self._path = KeyframeTrajectory()

    @property
    def surroundings(self) -> Surroundings:
        """What the next scan is matched with."""
        keyframes = self.loops.keyframes
        return Surroundings(
            self.local.map,
            self.loops.anchor,
            keyframes.revision,
            has_keyframes=len(keyframes) > 0,
            is_apart=self.loops.pieces.is_apart,
        )

    @property
    def pose(self) -> Array:
        """Current pose T_map_base (3,)."""
        return self.loops.anchor.pose(self._tracker.track.T_anchor_base)

    def load(self, given: State | None, keyframes: SavedKeyframes | None) -> None:
        """Begin with the cells of a `LocalMap.state`, and the keyframes that they are made of.

        Without cells, these are rendered from the keyframes.
        """
        if keyframes is not None:
            self.loops.load(keyframes)
        if given is None:
            self.local.rerender(self.loops.keyframes.frames, self.pose)
        else:
            self.local.load(given, len(self.loops.keyframes))

    def place(self, T_map_base: Array, covariance: Array) -> None:
        """Place the robot at a given pose (3,) with covariance (3, 3) in the published map."""
        self.loops.pieces.return_to_published()
        self.loops.return_to(T_map_base)
        anchor = self.loops.anchor
        self._tracker.place(anchor.relative(T_map_base), anchor.turned(covariance))

    def add(self, scan: Scan, points: Array) -> None:
        """Add a scan with surface points (N, 5) if the robot has moved far enough since the last.

        In a submap of its own if scans contradict the map. The pose stays, whatever of it an error
        ends.
        """
        T_map_base = self.pose
        try:
            self._add(scan, points)
        except Exception:
            # What it is relative to may be another keyframe.
            self._tracker.track.T_anchor_base = self.loops.anchor.relative(T_map_base)
            raise

    def _add(self, scan: Scan, points: Array) -> None:
        track = self._tracker.track
        moved = track.since_update
        path_m = 0.0 if moved is None else math.hypot(moved[0], moved[1])
        turn = 0.0 if moved is None else abs(float(moved[2]))
        is_near = path_m < _UPDATE_M and turn < _UPDATE_RAD
        if moved is not None and is_near:
            return
        if track.evidence.needs_submap:
            self.start_submap()
        elif track.evidence.forbids_mapping:
            return
        self._correct_heading(scan)
        if not self.local.add_scan(points, scan.T_base_laser, self.pose):
            # No building is that large: the pose is wrong, or was.
            self.start_submap()
            self.local.add_scan(points, scan.T_base_laser, self.pose)
        track.T_anchor_update = track.T_anchor_base
        # Motion errors are independent in each step. The error of a match is correlated with that
        # of the previous match as long as the same walls are observed.
        track.uncertainty.map_updated(min(1.0, path_m / _VIEW_M + turn))
        if len(points) >= MIN_POINTS and self.loops.needs_keyframe(track.T_anchor_base):
            self._add_keyframe(scan, points)

    def start_submap(self) -> None:
        """Start a new local map at the dead-reckoned pose."""
        covariance = self._tracker.fall_back()
        track = self._tracker.track
        track.uncertainty.start_submap(track.T_anchor_base, covariance)
        track.evidence.start_submap()
        self.loops.pieces.begin()
        self.local.start_submap()

    def close_loops(self) -> Correction | None:
        """Do one step of loop closure; the local map follows its correction."""
        self.atlas.step(self._config.loop_closure.join_odds)
        correction = self.loops.step()
        if correction is not None:
            correction = replace(correction, join=self.atlas.take_join())
        self.local.follow(self.loops.keyframes, self.pose)
        return correction

    def record_pose(self, stamp_ns: int) -> None:
        """Store the pose of this step relative to its keyframe."""
        keyframes = self.loops.keyframes
        number = keyframes.anchor
        T_keyframe = np.zeros(3) if number < 0 else keyframes.frames[number].T_map_base
        self._path.add(stamp_ns, number, se2.between(T_keyframe, self.pose))

    def trajectory(self) -> Array:
        """Poses (N, 3) of all steps, after all corrections; pending matches are done."""
        while self.loops.is_busy:
            self.close_loops()
        return self._path.poses(self.loops.finish())

    def known_places(self) -> Array:
        """Places (N, 2) that enclose the published map: cells, and keyframes, m."""
        frames = self.loops.keyframes.frames
        is_published = self.loops.pieces.is_published
        keyframes = [frame.T_map_base[:2] for frame in frames if is_published(frame.submap)]
        cells = self.local.published(frames).corners()
        return np.vstack([cells, np.array(keyframes).reshape(-1, 2)])

    def apart_points(self) -> Array:
        """Scan points (N, 2) of the keyframes that are not in the published map, m."""
        is_published = self.loops.pieces.is_published
        points = [
            se2.transform_points(frame.T_map_base, frame.scan.points_base())
            for frame in self.loops.keyframes.frames
            if not is_published(frame.submap)
        ]
        return np.vstack([np.zeros((0, 2)), *points])

    def _correct_heading(self, scan: Scan) -> None:
        """Correct the heading by the wall directions if scans agree with the map."""
        anchor = self.loops.anchor
        track = self._tracker.track
        derivative = np.vstack([np.zeros((2, 4)), self._tracker.systematic(anchor)[2]])
        variance = float(self._tracker.random_covariance(anchor)[2, 2])
        corrected = self._heading.correct(
            scan,
            anchor.pose(track.T_anchor_base),
            track.uncertainty,
            anchor.path_m_at(track.T_anchor_base),
            track.evidence.agrees,
            Reference(variance, self._share(derivative)),
            self.loops.keyframes.revision,
        )
        track.turn(anchor.relative(corrected))

    def _add_keyframe(self, scan: Scan, points: Array) -> None:
        """Make the scan a keyframe, to which the pose is relative from now on."""
        loops = self.loops
        tracker = self._tracker
        anchor = loops.anchor
        T_map_base = self.pose
        uncertainty = tracker.track.uncertainty
        covariance, jump = uncertainty.step()
        step = Step(covariance, self._share(uncertainty.systematic))
        # In a new submap the heading is unknown, also by multiples of 90 degrees.
        is_lost = loops.pieces.is_apart or tracker.track.evidence.is_lost
        heading = None if is_lost else self._heading.measured
        (error,) = heading_errors(np.array([heading_row(heading)]), T_map_base[None])
        covariance, systematic = with_heading(
            tracker.random_covariance(anchor), tracker.systematic(anchor), error
        )
        submap = loops.pieces.current
        path_m = anchor.path_m_at(tracker.track.T_anchor_base)
        frame = Keyframe(scan, points, T_map_base, path_m, covariance, submap, heading, systematic)
        loops.add(frame, step, jump)
        tracker.track.begin_step()

    def _share(self, derivative: Array) -> Systematic:
        """Share of the odometry in a relative pose of this step, by its derivative (3, 4)."""
        calibration = self._tracker.prediction.calibration
        return Systematic(derivative, calibration.parameters, calibration.spans)
