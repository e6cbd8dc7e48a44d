"""Rooms, corridors, halls and doors of the map, published while it grows."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from time import monotonic

import numpy as np

from thinmap_msgs.msg import RegionArray
from thinmap_ros.core.config import Config, parameter, part
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.core.topology.regions import RegionMap, membership_of
from thinmap_ros.core.topology.segmentation import RegionConfig, RegionTracker
from thinmap_ros.kernels import release_free_pages
from thinmap_ros.nodes.mapping.region_messages import region_array_msg
from thinmap_ros.ros import parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.time_jumps import STEADY

_POLL_S = 0.1
# Of a core, that is used for regions at most: on a map of 100 x 100 m they take more than a second.
_MAX_CPU_SHARE = 0.1


@dataclass(frozen=True)
class RegionUpdatesConfig(Config):
    """When the regions are computed, and what counts as one."""

    region_update_period_s: float = parameter(
        5.0,
        'Least time between two updates of the topic regions (s). Where computing takes more than '
        'a tenth of it, updates are rarer. Raise it for a slow computer, lower it for names of '
        'rooms as soon as they are seen. 0: no regions.',
        low=0.0,
        high=3600.0,
    )
    regions: RegionConfig = part(RegionConfig)


class _RegionJob:
    """Computes regions in a thread of its own, where the map has changed since the last time."""

    def __init__(self, tracker: RegionTracker) -> None:
        self.tracker = tracker
        self._worker = ThreadPoolExecutor(1, thread_name_prefix='regions')
        self._last: GridPatch | None = None
        self._rests_until_s = 0.0

    @property
    def is_resting(self) -> bool:
        """Whether the last regions took so long that the next ones have to wait."""
        return monotonic() < self._rests_until_s

    def submit(self, patch: GridPatch) -> Future[RegionMap]:
        """Begin to compute the regions of a grid; those of before, if no cell shows another."""
        return self._worker.submit(self._regions_of, patch)

    def _regions_of(self, patch: GridPatch) -> RegionMap:
        before = self._last
        self._last = patch
        known = self.tracker.regions
        if known is not None and before is not None and _shows_the_same(patch, before):
            return known
        began_s = monotonic()
        regions = self.tracker.update(patch)
        # On a large map this takes, and frees, a hundred bytes a cell.
        release_free_pages()
        ended_s = monotonic()
        self._rests_until_s = ended_s + (ended_s - began_s) / _MAX_CPU_SHARE
        return regions


def _shows_the_same(patch: GridPatch, before: GridPatch) -> bool:
    """Whether the same cells are free, and the same ones occupied, as in a patch of before."""
    is_same_rectangle = patch.frame == before.frame and patch.shape == before.shape
    return is_same_rectangle and np.array_equal(patch.trinary(), before.trinary())


class RegionUpdates:
    """/regions out: all regions of the newest grid, with nodes and edges in them.

    Regions are computed in a thread of their own, so that no scan waits for them.
    """

    def __init__(
        self,
        node: ThinmapNode,
        frame_id: str,
        robot_radius_m: float,
        topology: Callable[[], TopologicalMap],
    ) -> None:
        """Declare the parameters; topology: returns the present graph, in the frame frame_id."""
        self._node = node
        self._frame_id = frame_id
        self._topology = topology
        config = parameters.declare_config(node, RegionUpdatesConfig)
        self._config = replace(config.regions, robot_radius_m=robot_radius_m)
        self._published: RegionMap | None = None
        self._is_graph_newer = False
        self.reset()
        if config.region_update_period_s > 0.0:
            self._publisher = node.create_publisher(RegionArray, 'regions', qos.LATCHED)
            node.create_active_timer(config.region_update_period_s, self._begin, clock=STEADY)
            # Only while regions are computed.
            self._poll = node.create_active_timer(_POLL_S, self._publish_computed, clock=STEADY)
            self._poll.cancel()

    @property
    def config(self) -> RegionConfig:
        """What counts as a region."""
        return self._config

    @property
    def tracker(self) -> RegionTracker:
        """The regions and their ids."""
        return self._job.tracker

    def reset(self, tracker: RegionTracker | None = None) -> None:
        """Forget the grid, and continue with the ids of a tracker; None: of none."""
        self._job = _RegionJob(tracker or RegionTracker(self._config))
        self._pending: Future[RegionMap] | None = None
        self._pending_ns = 0
        self._newest: tuple[int, GridPatch] | None = None

    def add_grid(self, stamp_ns: int, patch: GridPatch) -> None:
        """The newest grid, whose regions are to be published."""
        self._newest = (stamp_ns, patch)

    def graph_changed(self) -> None:
        """The graph has other nodes or edges, which are to be published with their regions."""
        self._is_graph_newer = True

    def publish_again(self) -> None:
        """Publish the regions, if there are any: their names are others."""
        if self.tracker.regions is not None:
            self._publish(self.tracker.regions)

    def _begin(self) -> None:
        """Begin to compute the regions of the newest grid; of the same grid with a new graph."""
        if self._pending is not None:
            return
        if self._newest is not None and not self._job.is_resting:
            self._pending_ns, patch = self._newest
            self._newest = None
            self._pending = self._job.submit(patch)
            self._poll.reset()
        elif self._is_graph_newer and self.tracker.regions is not None:
            self._publish(self.tracker.regions)

    def _publish_computed(self) -> None:
        """Publish the regions that were computed, if they or the graph are new."""
        if self._pending is not None and not self._pending.done():
            return
        self._poll.cancel()
        if self._pending is None:
            return
        pending = self._pending
        self._pending = None
        regions = pending.result()
        if regions is not self._published or self._is_graph_newer:
            self._publish(regions)

    def _publish(self, regions: RegionMap) -> None:
        """Publish regions with their names, and the nodes and edges of the present graph."""
        self._is_graph_newer = False
        self._published = regions
        with self._node.diagnostics.time_step('regions published'):
            membership = membership_of(self._topology(), self.tracker.names.named(regions))
            message = region_array_msg(membership, self._frame_id, self._pending_ns)
        self._publisher.publish(message)
