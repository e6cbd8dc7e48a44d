"""Local topological maps, one a scan, merged into the global one."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.grid.components import label, reachable
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.se2 import Array, invert, transform_points
from thinmap_ros.core.snapshot import MAX_COUNT, Field
from thinmap_ros.core.topology import atlas, identity, surroundings
from thinmap_ros.core.topology.atlas import Atlas, Box
from thinmap_ros.core.topology.config import TopologyConfig
from thinmap_ros.core.topology.free_space import (
    column_distance,
    known_free,
    nearest_cell,
    select_free_space,
    squared_clearance,
    standing_room,
    true_cells,
)
from thinmap_ros.core.topology.graph import Node, TopologicalMap
from thinmap_ros.core.topology.identity import Registry
from thinmap_ros.core.topology.merging import Seam, stitch
from thinmap_ros.core.topology.net import dissolve_all, draw, web_of_net
from thinmap_ros.core.topology.pruning import Limits, Outlook
from thinmap_ros.core.topology.simplify import simplify
from thinmap_ros.core.topology.skeleton import (
    Measure,
    extract,
    map_of,
    net_along,
    simplified,
    skeleton_of,
)
from thinmap_ros.core.topology.surroundings import Surroundings

__all__ = ['TopologyBuilder', 'TopologyConfig', 'build']

Cells = NDArray[np.int64]
_WIDE_EVERY = 5  # scans: what lies farther from the robot changes more slowly
_STRIDE_M = 1.0  # between poses at which the map is built anew
_PAD = 6  # cells round what changed that are drawn anew with it
_APART = 16  # cells between changes that are drawn anew each for itself
FIELDS = {
    'taken': Field(np.int64, (), 0, MAX_COUNT),
    **surroundings.FIELDS,
    **atlas.FIELDS,
    **identity.FIELDS,
}


def build(
    patch: GridPatch, seed_xy: tuple[float, float] | None, config: TopologyConfig
) -> TopologicalMap:
    """Topological map of a whole grid: what can be reached from seed_xy (m, map frame), or all."""
    return extract(select_free_space(patch, seed_xy, config), patch, config)


class TopologyBuilder:
    """The global topological map, kept up to date by looking only at the surroundings of the robot.

    At each scan the near part of the window is thinned, together with what is remembered round it,
    and every few scans all of the window, so that what only the far ends of the beams change is
    drawn in too. Its part of the global map is drawn anew from that: all that lay there is cut out,
    the new skeleton put in its place and joined to the chains that go on outside, and nodes and
    edges are found again there as in a map of its own. So a node at a window's rim is gone as soon
    as the window has moved on, and no grid of the whole is needed.
    Source: topological map paper section 2.2, Fig. 5 and 8.
    """

    def __init__(self, config: TopologyConfig | None = None) -> None:
        self.config = config or TopologyConfig()
        self._atlas = Atlas()
        self._surroundings: Surroundings | None = None
        self._registry: Registry | None = None
        self._empty = TopologicalMap()
        self._view: _View | None = None
        self._taken = 0

    @property
    def map(self) -> TopologicalMap:
        """The global map. It is changed in place by `update`; take a copy to keep a state."""
        return self._empty if self._registry is None else self._registry.map

    @property
    def resolution_m(self) -> float | None:
        """Edge of a cell of the windows, m; None before the first one."""
        return None if self._surroundings is None else self._surroundings.lattice.resolution

    def update(self, window: GridPatch, T_map_base: Array) -> bool:
        """Take in the window round the robot at T_map_base (3,); returns whether the map changed.

        Windows must lie on the cells of one lattice. Raises InputError where they do not, or the
        pose is not finite.
        """
        self._view = self._take(window, T_map_base, wide=self._taken % _WIDE_EVERY == 0)
        self._taken += 1
        self._registry = self._registry or Registry(self.config, window.frame)
        return self._registry.refresh(self._atlas)

    def local_map(self) -> TopologicalMap:
        """Map of the newest window near the robot, update_window_m wide, not merged; ids from 1."""
        view = self._view
        around = self._surroundings
        if view is None or around is None:
            return TopologicalMap()
        low = np.array([around.near.row - around.box.row, around.near.col - around.box.col])
        shown = net_along(
            view.skeleton[around.near.within(around.box)], lambda cells: view.measure(cells + low)
        )
        dissolve_all(shown, np.ones(len(shown.spots), dtype=np.bool_))
        return map_of(
            web_of_net(shown),
            around.lattice.with_origin_at(around.near.row, around.near.col),
            self.config,
        )

    def rebuild(
        self, window_at: Callable[[float, float], GridPatch], before: Array, after: Array
    ) -> None:
        """Build the map anew after past poses (N, 3) were corrected, nodes carried along.

        before, after: the same poses as they were known and as they are known now; window_at: the
        window round a point (x, y, m) of the grid as it has been drawn anew. A node keeps its id
        where the new map has a node at the place to which the pose nearest to it took it. Edges
        between the same two nodes keep theirs.
        """
        old = self._registry
        self._atlas = Atlas()
        self._surroundings = None
        self._registry = None
        for T in _thinned_out(after):
            self._take(window_at(float(T[0]), float(T[1])), T, wide=True)
        if self._surroundings is None:
            return
        self._registry = Registry(self.config, self._surroundings.lattice)
        if old is not None:
            self._registry.inherit(old, _carried_along(list(old.map.nodes.values()), before, after))
        self._registry.refresh(self._atlas)

    def skip_ids(self, count: int) -> None:
        """Never give the next so many ids: somebody may have given them meanwhile."""
        if self._registry is not None:
            self._registry.skip(count)

    def state(self) -> dict[str, NDArray[Any]]:
        """All that the builder knows as arrays by name, empty before the first window.

        `from_state` goes on from it.
        """
        if self._surroundings is None or self._registry is None:
            return {}
        own = {'taken': np.array(self._taken)}
        return own | self._surroundings.state() | self._atlas.state() | self._registry.state()

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: TopologyConfig | None = None
    ) -> 'TopologyBuilder':
        """Builder that goes on from the `state` of another one with the same configuration.

        Raises InputError where it is no such state.
        """
        builder = TopologyBuilder(config)
        if not state:
            return builder
        checked = snapshot.validate(state, FIELDS, 'topology')
        builder._surroundings = Surroundings.from_state(checked, builder.config)
        builder._atlas = Atlas.from_state(checked)
        builder._taken = int(checked['taken'])
        builder._registry = Registry(builder.config, builder._surroundings.lattice)
        builder._registry.restore(builder._atlas, checked)
        return builder

    def _take(self, window: GridPatch, T_map_base: Array, wide: bool) -> '_View':
        """Look at a window and bring the atlas up to date."""
        if self._surroundings is None:
            self._surroundings = Surroundings(window.frame, window.shape, self.config)
        around = self._surroundings
        around.take(window, wide)
        known = self._atlas.within(around.box)
        view = _View(around, known, (float(T_map_base[0]), float(T_map_base[1])), self.config)
        self._merge(view, known, around.box)
        return view

    def _merge(self, view: '_View', known: tuple[Cells, Cells], box: Box) -> None:
        """Put the skeleton of the window into the atlas where it differs from what was there."""
        low = np.array([box.row, box.col])
        old = _raster(known[0] - low, known[1], box.rows, box.cols)
        fresh = view.fresh()
        if _agree(fresh, old, view.redrawn):
            return
        seam = Seam(fresh > 0, old > 0, view.redrawn, view.free, view.robot)
        stitched = stitch(seam, lambda parts: self._atlas.joined_outside(box, parts))
        squared, changed = _put_together(stitched, view.redrawn, fresh, old, view.distance)
        touched: set[int] = set()
        for part in self._places_to_redraw(changed, box):
            touched |= self._redraw(np.ascontiguousarray(squared[part.within(box)]), part)
        simplify(self._atlas, touched, view.outlook.at(box.row, box.col), view.limits)

    def _places_to_redraw(self, cells: Cells, box: Box) -> list[Box]:
        """Separate rectangles of the lattice that hold the cells (N, 2) of a box that changed."""
        blocks = cells // _APART
        coarse = np.zeros((box.rows // _APART + 1, box.cols // _APART + 1), dtype=np.bool_)
        coarse[blocks[:, 0], blocks[:, 1]] = True
        numbers, sizes = label(coarse)
        groups = numbers[blocks[:, 0], blocks[:, 1]]
        places: list[Box] = []
        for number in range(1, len(sizes)):
            group = cells[groups == number] + (box.row, box.col)
            row, col = group[0].tolist()
            place = self._atlas.calm(Box(row, col, 1, 1).around(group, _PAD, box), box)
            while beside := [other for other in places if place.meets(other)]:
                places = [other for other in places if other not in beside]
                corners = [(other.row, other.col) for other in beside]
                ends = [
                    (other.row + other.rows - 1, other.col + other.cols - 1) for other in beside
                ]
                place = self._atlas.calm(place.around(np.array(corners + ends), 0, box), box)
            places.append(place)
        return places

    def _redraw(self, squared: Cells, place: Box) -> set[int]:
        """Draw the atlas anew in a place; returns the spots that were touched.

        squared (H, W): the skeleton as it is to be: squared clearances, 0 elsewhere.
        """
        cut = self._atlas.cut_out(place)
        pinned = np.zeros(squared.shape, dtype=np.bool_)
        low = (place.row, place.col)
        anchors = np.array(list(cut.anchors), dtype=np.int64).reshape(-1, 2) - low
        pinned[anchors[:, 0], anchors[:, 1]] = True
        net = net_along(squared > 0, lambda cells: squared[cells[:, 0], cells[:, 1]], pinned)
        return self._atlas.graft(net, place, cut.anchors) | cut.touched


@kernel
def _raster(cells: Cells, values: Cells, rows: int, cols: int) -> Cells:
    """Values (N,) at their cells (N, 2) of an array (rows, cols), 0 elsewhere."""
    raster = np.zeros((rows, cols), dtype=np.int64)
    for k in range(cells.shape[0]):
        raster[cells[k, 0], cells[k, 1]] = values[k]
    return raster


@kernel
def _agree(fresh: Cells, old: Cells, where: NDArray[np.bool_]) -> bool:
    """Whether two arrays (H, W) are the same at some cells, and the first is 0 at all others."""
    for row in range(fresh.shape[0]):
        for col in range(fresh.shape[1]):
            if fresh[row, col] != (old[row, col] if where[row, col] else 0):
                return False
    return True


@kernel
def _put_together(
    drawn: NDArray[np.bool_],
    where: NDArray[np.bool_],
    fresh: Cells,
    old: Cells,
    distance: NDArray[np.int16],
) -> tuple[Cells, Cells]:
    """Squared clearances (H, W) of what is drawn, 0 elsewhere, and the cells (N, 2) that changed.

    The clearances are the fresh ones where these take the old ones' place, and measured anew at
    cells that were neither.
    """
    squared = np.zeros_like(old)
    changed = np.empty((old.size, 2), dtype=np.int64)
    cell = np.empty((1, 2), dtype=np.int64)
    count = 0
    for row in range(old.shape[0]):
        for col in range(old.shape[1]):
            if drawn[row, col]:
                known = fresh[row, col] if where[row, col] else old[row, col]
                cell[0, 0] = row
                cell[0, 1] = col
                squared[row, col] = known if known > 0 else squared_clearance(distance, cell)[0]
            if squared[row, col] != old[row, col]:
                changed[count, 0] = row
                changed[count, 1] = col
                count += 1
    return squared, changed[:count].copy()


def _thinned_out(poses: Array) -> Array:
    """Some of the poses (N, 3): the first, each _STRIDE_M from the last one taken, and the last."""
    taken = [0] if len(poses) else []
    for k in range(1, len(poses)):
        if k == len(poses) - 1 or np.hypot(*(poses[k, :2] - poses[taken[-1], :2])) >= _STRIDE_M:
            taken.append(k)
    return poses[taken]


def _carried_along(nodes: list[Node], before: Array, after: Array) -> list[Node]:
    """Nodes, each moved as the pose nearest to it was."""
    moved = []
    for node in nodes:
        k = int(((before[:, :2] - node.position) ** 2).sum(axis=1).argmin())
        seen = transform_points(invert(before[k]), node.position[None])
        place = transform_points(after[k], seen)[0]
        moved.append(replace(node, x=float(place[0]), y=float(place[1])))
    return moved


class _View:
    """The surroundings thinned: free space, pruned skeleton, clearances, on cells of their box."""

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
        self.distance = distance = column_distance(known)
        room = standing_room(distance, config.robot_radius_m / patch.frame.resolution)
        seeds = known_skeleton[0] - (around.box.row, around.box.col)
        seed = nearest_cell(room, patch, robot_xy, config.seed_search_radius_m)
        self.robot: Cells = np.empty((0, 2), dtype=np.int64) if seed is None else seed[None]
        self.free = reachable(room, np.concatenate((seeds, self.robot)))
        self.measure: Measure = lambda cells: squared_clearance(distance, cells)
        self.outlook = Outlook.of(known, patch.occupied, rim_is_unknown=True)
        self.limits = Limits.of(config, patch.frame.resolution)
        net = simplified(skeleton_of(self.free, distance), self.measure, self.outlook, self.limits)
        self.skeleton = draw(net, *patch.shape)

    def fresh(self) -> Cells:
        """Squared clearances (H, W) of the new skeleton where it replaces the old, 0 elsewhere."""
        cells = true_cells(self.skeleton & self.redrawn)
        return _raster(cells, self.measure(cells), *self.skeleton.shape)
