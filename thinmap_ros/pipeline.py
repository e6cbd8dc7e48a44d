"""Pipeline without ROS: from scan and odometry to pose, grid and topology."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter

from thinmap_ros.core.consistency.monitor import ConsistencyMonitor
from thinmap_ros.core.estimate import Estimate
from thinmap_ros.core.grid.correctable import CorrectableGrid
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid, WindowConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.scan_history import CorrectedPoses
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer_config import LocalizerConfig
from thinmap_ros.core.slam.localizers import localizer_class
from thinmap_ros.core.start import StartConfig
from thinmap_ros.core.topology.builder import TopologyBuilder, TopologyConfig


@dataclass(frozen=True)
class PipelineConfig:
    """Parameters of all stages.

    scans_per_graph: number of scans between updates of the graph.
    """

    localizer: StartConfig = field(default_factory=LocalizerConfig)
    grid: OccupancyConfig = field(default_factory=OccupancyConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    topology: TopologyConfig = field(default_factory=TopologyConfig)
    scans_per_graph: int = 1


@dataclass(frozen=True, eq=False)
class PipelineResult:
    """Result of one scan: the estimate, and the window of the map that was thinned last."""

    estimate: Estimate
    window: GridPatch


class Pipeline:
    """Localizer, grid and topology, for every scan, as in three live nodes.

    `pose_source` replaces the localizer if poses are known (true poses of a simulator).
    """

    def __init__(
        self,
        config: PipelineConfig | None = None,
        pose_source: Callable[[Scan, Array], Estimate] | None = None,
    ) -> None:
        self.config = config or PipelineConfig()
        self.localizer = localizer_class(self.config.localizer)(self.config.localizer)
        # Known poses are never corrected.
        self._grid = CorrectableGrid(OccupancyGrid(self.config.grid), not pose_source)
        self.corrections = 0
        self.refusals: list[str] = []  # why scans are not on the map, a reason for each
        self.topology = TopologyBuilder(self.config.topology)
        self.stage_seconds: dict[str, list[float]] = {}
        self._scans = 0
        self._window: GridPatch | None = None
        self._locate = pose_source or self.localizer.step
        self._consistency = ConsistencyMonitor()

    @property
    def grid(self) -> OccupancyGrid:
        """The published map; another object after a correction."""
        return self._grid.shown

    @property
    def warnings(self) -> list[str]:
        """What the scans so far contradict: their own angles, the odometry, or their mount."""
        return list(self._consistency.reported.values())

    def step(self, scan: Scan, T_odom_base: Array) -> PipelineResult:
        """Localize and map one scan with the odometry pose (3,) at its stamp."""
        with self._timed('localizer'):
            estimate = self._locate(scan, T_odom_base)
            estimate = self._consistency.checked(scan, T_odom_base, estimate)
        with self._timed('grid'):
            if estimate.correction is not None:
                self.corrections += self._grid.apply_correction(
                    *self.localizer.keyframe_trajectory(), scan.stamp_ns
                )
            moved = self._grid.update(scan, estimate.T_map_base, estimate.placement)
            self.refusals += self._grid.take_refusals()
        if moved is not None:
            self._rebuild(moved)
        if self._window is None or self._scans % self.config.scans_per_graph == 0:
            self._window = self._thin(estimate.T_map_base)
        self._scans += 1
        return PipelineResult(estimate, self._window)

    def finish(self) -> None:
        """Complete a pending correction after the last scan."""
        moved = self._grid.finish()
        self.refusals += self._grid.take_refusals()
        if moved is not None:
            self._rebuild(moved)

    def _thin(self, T_map_base: Array) -> GridPatch:
        """Update the graph, unless the map is only partly corrected."""
        with self._timed('topology'):
            changes = None if self._grid.is_rerendering else self.grid.take_changes()
            if changes is not None and self.topology.update(changes, T_map_base):
                self.localizer.set_topology(self.topology.map)
        return self.grid.window(T_map_base[0], T_map_base[1], self.config.window.local_map_size_m)

    def _rebuild(self, moved: CorrectedPoses) -> None:
        """Rebuild the graph after a correction of the grid."""
        with self._timed('rebuild'):
            self.grid.take_changes()
            self.topology = self.topology.rebuilt(self.grid.known_area(), *moved)
            self.localizer.set_topology(self.topology.map)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        started = perf_counter()
        yield
        self.stage_seconds.setdefault(stage, []).append(perf_counter() - started)
