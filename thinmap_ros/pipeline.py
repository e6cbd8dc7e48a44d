"""The nodes' wiring without ROS: scan and odometry in, pose, grid and topology out."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter

from thinmap_ros.core.estimate import Estimate
from thinmap_ros.core.grid.history import GridHistory
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid, WindowConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizers import localizer_class
from thinmap_ros.core.slam.scan_localizer import ScanLocalizerConfig
from thinmap_ros.core.topology.update import TopologyBuilder, TopologyConfig


@dataclass(frozen=True)
class PipelineConfig:
    """Parameters of all stages.

    scans_per_graph: the graph is brought up to date with every so many scans.
    """

    localizer: ScanLocalizerConfig = field(default_factory=ScanLocalizerConfig)
    grid: OccupancyConfig = field(default_factory=OccupancyConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    topology: TopologyConfig = field(default_factory=TopologyConfig)
    scans_per_graph: int = 1


@dataclass(frozen=True, eq=False)
class Step:
    """What came of one scan: the pose, and the window of the map as it was thinned last."""

    estimate: Estimate
    window: GridPatch


class Pipeline:
    """Localizer, grid and topology, one after the other, for every scan.

    What the live graph does in three nodes.

    `pose_source` takes the place of the localizer where poses are known from elsewhere (a
    simulator's truth).
    """

    def __init__(
        self,
        config: PipelineConfig | None = None,
        pose_source: Callable[[Scan, Array], Estimate] | None = None,
    ) -> None:
        self.config = config or PipelineConfig()
        self.localizer = localizer_class(self.config.localizer)(self.config.localizer)
        self.grid = OccupancyGrid(self.config.grid)
        self.topology = TopologyBuilder(self.config.topology)
        self.stage_seconds: dict[str, list[float]] = {}
        self._scans = 0
        self._window: GridPatch | None = None
        self._locate = pose_source or self.localizer.step
        # Poses that are known from elsewhere are never corrected.
        self._history = None if pose_source else GridHistory()

    def step(self, scan: Scan, T_odom_base: Array) -> Step:
        """Take in one scan with the odometry pose (3,) at its stamp."""
        with self._timed('localizer'):
            estimate = self._locate(scan, T_odom_base)
        if self._history is not None and estimate.correction is not None:
            self._rebuild(self._history, scan.stamp_ns)
        with self._timed('grid'):
            self._draw(scan, estimate)
        if self._window is None or self._scans % self.config.scans_per_graph == 0:
            self._window = self._thin(estimate.T_map_base)
        self._scans += 1
        return Step(estimate, self._window)

    def _draw(self, scan: Scan, estimate: Estimate) -> None:
        """Into the map with it, unless nobody knows where it was made."""
        if estimate.lost:
            return
        self.grid.update(scan, estimate.T_map_base)
        if self._history is not None:
            self._history.add(scan, estimate.T_map_base)

    def _thin(self, T_map_base: Array) -> GridPatch:
        with self._timed('topology'):
            window = self.grid.window(T_map_base[0], T_map_base[1], self.config.window.window_m)
            if self.topology.update(window, T_map_base):
                self.localizer.set_topology(self.topology.map)
        return window

    def _rebuild(self, history: GridHistory, since_ns: int) -> None:
        """A loop was closed.

        Grid and topology are made anew from what was seen at the poses as they are known now.
        """
        before = history.past.poses()
        with self._timed('rebuild'):
            history.past.correct(*self.localizer.past(), since_ns)
            self.grid = history.draw(self.grid)
            size = self.config.window.window_m
            self.topology.rebuild(
                lambda x, y: self.grid.window(x, y, size), before, history.past.poses()
            )
            self.localizer.set_topology(self.topology.map)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        started = perf_counter()
        yield
        self.stage_seconds.setdefault(stage, []).append(perf_counter() - started)
