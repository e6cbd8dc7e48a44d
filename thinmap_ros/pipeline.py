"""Pipeline without ROS: from scan and odometry to pose, grid and topology."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import numpy as np

from thinmap_ros.core.config import Config, config_or_default, parameter, part
from thinmap_ros.core.errors import InputError, pose_of, require_type, with_known_keywords
from thinmap_ros.core.grid.mapper import Mapper
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.sensing.consistency import ConsistencyMonitor
from thinmap_ros.core.sensing.odometry_scale import OdometryScale
from thinmap_ros.core.slam.localizer import Localizer, localizer_class
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import (
    Destination,
    Estimate,
    LocalizedScan,
    StartConfig,
    Trajectory,
)
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.segmentation import RegionConfig, RegionTracker
from thinmap_ros.core.topology.topology import Topology, TopologyBuilder, build
from thinmap_ros.files import sessions
from thinmap_ros.files.occupancy_maps import warn
from thinmap_ros.files.safe import path_of
from thinmap_ros.files.sessions import REGIONS, TOPOLOGY, SessionMap
from thinmap_ros.files.trajectories import ScanTrajectory, StampedPoses


@dataclass(frozen=True)
class PipelineConfig(Config):
    """Parameters of all stages."""

    localizer: StartConfig = part(LocalizerConfig, kind=StartConfig)
    grid: OccupancyConfig = part(OccupancyConfig)
    topology: TopologyConfig = part(TopologyConfig)
    scans_per_graph: int = parameter(
        1,
        'Scans from one update of the graph to the next, made when the graph is asked for (with '
        'slam: ekf_ti or ekf_full, which need it, at once). Higher: less computing time, and a '
        'graph that follows the map later.',
        low=1,
        high=1_000_000,
    )


@dataclass(frozen=True, eq=False)
class PipelineResult:
    """Result of one scan."""

    estimate: Estimate


class Pipeline:
    """Localizer and grid for every scan, and the graph of the map, as in three live nodes.

    The graph is made when it is asked for: `topology`, `save_session`.
    `stage_seconds`: CPU time of each stage, s, a number for each time that it ran.
    `pose_source` replaces the localizer if poses are known (true poses of a simulator).
    `resolution_m` (m a cell) is short for that of `config.grid`. `max_range_m` is the usable range
    of the laser (m), instead of that of the scans. Raises ConfigError for a value out of range, or
    a name that is none of these.
    """

    @with_known_keywords
    def __init__(
        self,
        config: PipelineConfig | None = None,
        pose_source: Callable[[Scan, Array], Estimate] | None = None,
        *,
        resolution_m: float | None = None,
        max_range_m: float | None = None,
    ) -> None:
        self.config = config_or_default(config, PipelineConfig)
        if resolution_m is not None:
            grid = replace(self.config.grid, resolution_m=resolution_m)
            self.config = replace(self.config, grid=grid)
        self._laser = None if max_range_m is None else LaserConfig(max_range_m=max_range_m)
        self.localizer = localizer_class(self.config.localizer)(self.config.localizer)
        # Known poses are never corrected.
        self._mapper = Mapper(
            self.config.grid, not pose_source, scans_per_update=self.config.scans_per_graph
        )
        self._topology = Topology(self.config.topology)
        self.corrections = 0
        self.refusals: list[str] = []  # why scans are not on the map, a reason for each
        self.stage_seconds: dict[str, list[float]] = {}
        self._pose_source = pose_source
        self._regions = self._new_regions()
        self._consistency = ConsistencyMonitor()
        self._stamps_ns: list[int] = []
        self._live: list[Array] = []
        self._is_finished = False

    def __repr__(self) -> str:
        scans = len(self.stage_seconds.get('localizer', ()))
        return f'Pipeline({scans} scans, {self.grid.known_area()!r}, {self.topology.map!r})'

    def _repr_png_(self) -> bytes:
        """Picture of map and graph, for notebooks."""
        from thinmap_ros.view.summary import plot  # matplotlib takes its time

        return plot(self).png()

    @property
    def grid(self) -> OccupancyGrid:
        """The published map; another object after a correction."""
        return self._mapper.grid.shown

    @property
    def topology(self) -> TopologyBuilder:
        """The graph of the map, updated now; another object after a correction.

        What has changed since it was last asked for is added. A correction of the map in progress
        is completed first where the graph lacks scans from before it.
        """
        if self._mapper.has_changed:
            self._update_topology()
        return self._topology.builder

    @property
    def trajectory(self) -> ScanTrajectory:
        """The pose of each scan, live and final, by the stamps of the scans, in their order.

        final: after all corrections so far. After `finish`, the loops that are still looked for are
        closed for it first, as `replay` does; the map stays as it is.
        """
        stamps_ns = np.array(self._stamps_ns, dtype=np.int64)
        live = np.array(self._live).reshape(-1, 3)
        if self._pose_source:
            final = live
        elif self._is_finished:
            final = self.localizer.optimized_trajectory()
        else:
            final = self.localizer.corrected_trajectory()
        return ScanTrajectory(
            StampedPoses(stamps_ns, live), StampedPoses(stamps_ns, final[: len(live)])
        )

    @property
    def warnings(self) -> list[str]:
        """What the scans so far contradict: their own angles, the odometry, or their mount."""
        scale = self.odometry_scale.warning
        return [*self._consistency.reported.values(), *([scale] if scale else [])]

    @property
    def odometry_scale(self) -> OdometryScale:
        """Turns and distances of the odometry, compared with those of the scans."""
        return self._consistency.odometry_scale

    def step(self, scan: Scan, T_odom_base: Array) -> PipelineResult:
        """Localize and map one scan with the odometry pose (3,) at its stamp.

        Raises InputError where it is no scan, or no pose of finite numbers. Any other error has the
        stamp of the scan as a note; that scan is left out, and others may follow.
        """
        require_type('scan', scan, Scan)
        T_odom_base = pose_of('T_odom_base', T_odom_base)
        if self._laser is not None:
            scan = replace(scan, max_range_m=self._laser.max_range_m)
        try:
            return self._step(scan, T_odom_base)
        except Exception as error:
            error.add_note(f'scan at {scan.stamp_ns} ns')
            raise

    def _step(self, scan: Scan, T_odom_base: Array) -> PipelineResult:
        with self._timed('localizer'):
            locate = self._pose_source or self.localizer.step
            estimate = locate(scan, T_odom_base)
            estimate = self._consistency.checked(scan, T_odom_base, estimate)
        self._is_finished = False
        self._stamps_ns.append(scan.stamp_ns)
        self._live.append(estimate.T_map_base)
        with self._timed('grid'):
            is_due = self._mapper.add(self._localized(scan, estimate))
        self.refusals += self._mapper.refusals
        if is_due and self.localizer.follows_topology:
            self._update_topology()
        return PipelineResult(estimate)

    def finish(self) -> None:
        """Complete a pending correction after the last scan."""
        self._complete()
        self._is_finished = True

    def _complete(self) -> None:
        self._mapper.complete()
        self.refusals += self._mapper.refusals

    def _update_topology(self) -> None:
        if self._mapper.grid.is_rerendering:
            self._complete()
        update = self._mapper.update()
        if update.whole is not None:
            self._regions.follow(update.whole)
        with self._timed('rebuild' if update.whole else 'topology'):
            topology = self._topology.step(update)
        if topology is not None:
            self.localizer.set_topology(topology)

    def load_session(self, path: str | Path) -> None:
        """Continue in a session, or a map_server map (YAML file), as live nodes do.

        The localizer begins at its initial pose in that map, and is lost until scans fit. The map
        has the cells of the file; in mode localization it stays as it is. Raises InputError where
        a file is missing or broken, or the session has no map of this localizer.
        """
        path = str(path_of(path))
        localizer = sessions.load_localizer(path, self.config.localizer)
        if localizer is None:
            raise InputError(
                f'{sessions.LOCALIZER.file(path)}: no such file: expected the line features of a '
                f'session of slam: {self.config.localizer.slam}'
            )
        is_corrected = self.config.localizer.is_mapping and not self._pose_source
        if is_corrected and isinstance(localizer, Localizer) and localizer.published_graph is None:
            warn(f'{path}: no keyframes: the map is extended, and not corrected when a loop closes')
        grid, keep_out = sessions.load_map(path, self.config.grid, is_corrected)
        builder = _graph_of(path, grid.shown.known_area(), self.config.topology)
        regions = REGIONS.load_optional(path, self._regions.config)
        self.localizer = localizer
        self._stamps_ns = []
        self._live = []
        self._mapper.replace(grid, keep_out)
        self._topology.replace(builder)
        self.localizer.set_topology(builder.map)
        self._regions = regions or self._new_regions()
        self._regions.follow(self._mapper.whole_map())

    def save_session(self, path: str | Path) -> list[str]:
        """Save map, graph, and what a localizer continues with; returns what was written.

        All files or none, as `sessions.save_session`. Raises InputError, and OSError.
        """
        self._complete()
        self._regions.update(self.grid.known_area())
        known = SessionMap(
            self.grid, self.topology, self._regions, self._mapper.edits, self.localizer
        )
        return sessions.save_session(str(path_of(path)), known)

    def _new_regions(self) -> RegionTracker:
        return RegionTracker(RegionConfig(robot_radius_m=self.config.topology.robot_radius_m))

    def _localized(self, scan: Scan, estimate: Estimate) -> LocalizedScan:
        trajectory = None
        if estimate.correction is not None:
            self.corrections += 1
            trajectory = Trajectory(*self.localizer.keyframe_trajectory(), scan.stamp_ns)
        is_mapping = self.config.localizer.is_mapping
        destination = estimate.destination if is_mapping else Destination.NOWHERE
        return LocalizedScan(scan, estimate.T_map_base, destination, trajectory=trajectory)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        started = process_time()
        yield
        self.stage_seconds.setdefault(stage, []).append(process_time() - started)


def _graph_of(path: str, patch: GridPatch, config: TopologyConfig) -> TopologyBuilder:
    """The graph of a session; that of its map where it has none."""
    if TOPOLOGY.exists(path):
        return sessions.load_topology(path, config)
    graph = build(patch, None, config)
    next_id = 1 + max([*graph.nodes, *graph.edges], default=0)
    return TopologyBuilder.continued(patch, graph, next_id, config)
