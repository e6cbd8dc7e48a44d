"""Local topological maps, one a scan, merged into the global one."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.atlas import Atlas, Box
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
_PAD = 10  # cells round what changed that are drawn anew with it


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
        self._merge(view, known, around.box)
        self._registry.refresh(self._atlas)
        return self._local(view, window, around.margin)

    def _merge(self, view: '_View', known: tuple[Cells, Cells], box: Box) -> None:
        """Put the skeleton of the window into the atlas where it differs from what was there."""
        low = (box.row, box.col)
        old = np.zeros((box.rows, box.cols), dtype=np.int64)
        rows, cols = (known[0] - low).T
        old[rows, cols] = known[1]
        fresh = view.fresh()
        if np.array_equal(fresh, np.where(view.redrawn, old, 0)):
            return
        seam = Seam(fresh > 0, old > 0, view.redrawn, view.free, view.robot)
        stitched = stitch(seam, lambda parts: self._atlas.joined_outside(box, parts))
        squared = np.where(view.redrawn, fresh, old)
        added = np.argwhere(stitched & (squared == 0))
        squared[added[:, 0], added[:, 1]] = view.measure(added)
        squared[~stitched] = 0
        changed = np.argwhere(squared != old)
        if len(changed):
            self._redraw(view, squared, changed, box)

    def _redraw(self, view: '_View', squared: Cells, changed: Cells, box: Box) -> None:
        """Draw the atlas anew round the cells (N, 2) of a box that changed, and clean up there.

        squared (H, W): the whole skeleton as it is to be: squared clearances, 0 elsewhere.
        """
        low = np.array([box.row, box.col])
        row, col = (changed[0] + low).tolist()
        part = self._atlas.calm(Box(row, col, 1, 1).around(changed + low, _PAD, box), box)
        corner = np.array([part.row, part.col])
        inner = tuple(slice(at, at + size) for at, size in zip(corner - low, (part.rows, part.cols), strict=True))
        there = np.ascontiguousarray(squared[inner])
        cut = self._atlas.cut_out(part)
        pinned = np.zeros(there.shape, dtype=np.bool_)
        anchors = np.array(list(cut.anchors), dtype=np.int64).reshape(-1, 2) - corner
        pinned[anchors[:, 0], anchors[:, 1]] = True
        web = web_of(there > 0, lambda cells: there[cells[:, 0], cells[:, 1]], pinned)
        touched = self._atlas.graft(web, part, cut.anchors) | cut.touched
        simplify(self._atlas, touched, lambda spot: view.is_promising(spot, box), view.limits)

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
        self._looks_out = looks_out(known, patch.occupied, rim_is_unknown=True)
        self.limits = Limits.of(config, patch.frame.resolution)
        web = web_of(skeleton_of(self.free, distance), self.measure)
        simplify(web, set(web.spots), self._looks_out, self.limits)
        self.skeleton = drawing_of(web, patch.shape)

    def fresh(self) -> Cells:
        """Squared clearances (H, W) of the new skeleton where it is to take the old one's place, 0 elsewhere."""
        squared = np.zeros(self.skeleton.shape, dtype=np.int64)
        cells = np.argwhere(self.skeleton & self.redrawn)
        squared[cells[:, 0], cells[:, 1]] = self.measure(cells)
        return squared

    def is_promising(self, spot: Spot, box: Box) -> bool:
        """Whether a spot on the lattice looks into the unknown; those outside the box may."""
        inside = bool(box.holds(np.array(spot.cell)))
        return not inside or self._looks_out(Spot((spot.cell[0] - box.row, spot.cell[1] - box.col), spot.squared))
