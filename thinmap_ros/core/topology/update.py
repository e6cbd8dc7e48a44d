"""Local topological maps, one a scan, merged into the global one."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.atlas import Atlas
from thinmap_ros.core.topology.config import TopologyConfig
from thinmap_ros.core.topology.free_space import (
    column_distance,
    known_free,
    nearest_cell,
    reachable,
    select_free_space,
    squared_clearance,
    standing_room,
)
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.core.topology.identity import Registry
from thinmap_ros.core.topology.skeleton import Measure, drawing_of, extract, looks_out, map_of, skeleton_of, web_of
from thinmap_ros.core.topology.stitching import Seam, stitch
from thinmap_ros.core.topology.surroundings import Surroundings
from thinmap_ros.core.topology.web import Limits, Spot, simplify

__all__ = ['TopologyBuilder', 'TopologyConfig', 'build']

Cells = NDArray[np.int64]


def build(patch: GridPatch, seed_xy: tuple[float, float] | None, config: TopologyConfig) -> TopologicalMap:
    """Topological map of a whole grid: the part that a robot can reach from seed_xy (m, map frame), or all parts."""
    return extract(select_free_space(patch, seed_xy, config), patch, config)


class TopologyBuilder:
    """The global topological map, kept up to date by looking only at the surroundings of the robot.

    At each scan the window is thinned, together with what is remembered round it, and its part of the global map is
    drawn anew from that: all that lay in the window is cut out, the new skeleton put in its place and joined to the
    chains that go on outside, and nodes and edges are found again there as in a map of its own. So a node at a
    window's rim is gone as soon as the window has moved on, and no grid of the whole is needed.
    Source: topological map paper section 2.2, Fig. 5 and 8.
    """

    def __init__(self, config: TopologyConfig | None = None) -> None:
        self.config = config or TopologyConfig()
        self._atlas = Atlas()
        self._surroundings: Surroundings | None = None
        self._registry: Registry | None = None
        self._empty = TopologicalMap()

    @property
    def map(self) -> TopologicalMap:
        """The global map. It is changed in place by `update`; take a copy to keep a state."""
        return self._empty if self._registry is None else self._registry.map

    def update(self, window: GridPatch, T_map_base: Array) -> TopologicalMap:
        """Take in the window round the robot at pose T_map_base (3,); returns the window's own map, ids from 1.

        Windows must lie on the cells of one lattice. Raises InputError where they do not, or the pose is not finite.
        """
        if self._surroundings is None or self._registry is None:
            self._surroundings = Surroundings(window, self.config)
            self._registry = Registry(self.config, window.frame)
        around = self._surroundings
        around.take(window)
        known = self._atlas.within(around.box)
        view = _View(around, known, (float(T_map_base[0]), float(T_map_base[1])), self.config)
        self._merge(view, known, around)
        self._registry.refresh(self._atlas)
        return self._local(view, window, around.margin)

    def _merge(self, view: '_View', known: tuple[Cells, Cells], around: Surroundings) -> None:
        """Put the skeleton of the window into the atlas, in the place of what was there, and clean up at the seam."""
        box = around.box
        cut = self._atlas.cut_out(box)
        spots = list(cut.anchors.values())
        anchors = np.array(list(cut.anchors), dtype=np.int64).reshape(-1, 2) - (box.row, box.col)
        rows, cols = (known[0] - (box.row, box.col)).T
        old = np.zeros((box.rows, box.cols), dtype=np.int64)
        old[rows, cols] = np.maximum(known[1], 1)
        window, pinned = view.redrawn, np.zeros(old.shape, dtype=np.bool_)
        pinned[anchors[:, 0], anchors[:, 1]] = True
        seam = Seam(view.skeleton, old > 0, window, view.free, view.robot, anchors)
        stitched = stitch(seam, lambda: self._atlas.joined(spots))

        def measure(cells: Cells) -> Cells:
            # Near the rim of what is remembered, clearance looks smaller than it was seen to be.
            seen_before = np.where(window[cells[:, 0], cells[:, 1]], 0, old[cells[:, 0], cells[:, 1]])
            return np.maximum(view.measure(cells), seen_before)

        def promising(spot: Spot) -> bool:
            inside = bool(box.holds(np.array(spot.cell)))
            return not inside or view.promising(Spot((spot.cell[0] - box.row, spot.cell[1] - box.col), spot.squared))

        touched = self._atlas.graft(web_of(stitched, measure, pinned), box, cut.anchors) | cut.touched
        simplify(self._atlas, touched, promising, view.limits)

    def _local(self, view: '_View', window: GridPatch, margin: int) -> TopologicalMap:
        """The window's own part of the new skeleton as a map."""
        inner = slice(margin, margin + window.shape[0]), slice(margin, margin + window.shape[1])
        shown = web_of(view.skeleton[inner], lambda cells: view.measure(cells + margin))
        for spot in list(shown.spots):
            shown.dissolve(spot)
        return map_of(shown, window.frame, self.config)


class _View:
    """The surroundings thinned: free space, pruned skeleton and clearances, on the cells of their box."""

    def __init__(
        self,
        around: Surroundings,
        known_skeleton: tuple[Cells, Cells],
        robot_xy: tuple[float, float],
        config: TopologyConfig,
    ) -> None:
        patch, painted = around.patch(*known_skeleton)
        self.redrawn = around.redrawn(painted)
        known = known_free(patch, config)
        distance = column_distance(known)
        room = standing_room(distance, config.robot_radius_m / patch.frame.resolution)
        seeds = known_skeleton[0] - (around.box.row, around.box.col)
        seed = nearest_cell(room, patch, robot_xy, config.seed_reach_m)
        self.robot: Cells = np.empty((0, 2), dtype=np.int64) if seed is None else seed[None]
        self.free = reachable(room, np.concatenate((seeds, self.robot)))
        self.measure: Measure = lambda cells: squared_clearance(distance, cells)
        self.promising = looks_out(known, patch.occupied, rim_is_unknown=True)
        self.limits = Limits.of(config, patch.frame.resolution)
        web = web_of(skeleton_of(self.free, distance), self.measure)
        simplify(web, set(web.spots), self.promising, self.limits)
        self.skeleton = drawing_of(web, patch.shape)
