"""Baseline exploration strategies: which frontier, or which end node, is visited next.

All of them use the same map and navigator. They choose once a second, and as soon as the target has
been observed, and stop when no target is left. They differ in the choice only.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.candidates import ASSIGNMENT_RADIUS_M
from thinmap_ros.core.exploration.explorer import ExplorerConfig
from thinmap_ros.core.exploration.space import FrontierMap, box_of_scan, search_beside
from thinmap_ros.core.exploration.strategy import (
    FIRST_FRONTIER_ID,
    Decision,
    FinishCode,
    Streak,
    is_at,
    unobserved,
)
from thinmap_ros.core.grid.fields import reachable
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.raytrace import begin_ray, next_cell
from thinmap_ros.core.planning.grid_search import path_lengths_from
from thinmap_ros.core.planning.obstacles import RecentPath
from thinmap_ros.core.planning.paths import path_lengths_to_nodes
from thinmap_ros.core.planning.wavefront import ways_out
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array, Cells, Mask
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap
from thinmap_ros.core.topology.segmentation import any_in_squares
from thinmap_ros.core.topology.thinning import standing_room
from thinmap_ros.jit import kernel

_COARSE = 2
_PART_M = 1.0
# The same robot and the same frontiers as for the exploration of the paper.
_EXPLORER = ExplorerConfig()
_MIN_FRONTIER_M = 0.5  # as of explore_lite


@dataclass(frozen=True, eq=False)
class Frontier:
    """A frontier cluster: its cells (N, 2), centroid (2,) and viewpoint (2,), m.

    path_length_m: length of the path from the robot to the viewpoint.
    """

    cells: Cells
    centroid: Array
    viewpoint: Array
    path_length_m: float

    @property
    def goal(self) -> Array:
        """The viewpoint, facing the centroid, (3,)."""
        x, y = self.viewpoint
        return se2.pose(x, y, se2.bearing(self.viewpoint, self.centroid))


class FrontierFinder:
    """The frontiers of a growing map, without those that persist after close observation."""

    def __init__(self, allow_backtracking: bool = False) -> None:
        """allow_backtracking: the recent path counts as traversable, however narrow it appears."""
        self.map = FrontierMap()
        self._recent_path = RecentPath() if allow_backtracking else None
        self.patch: GridPatch | None = None
        self._given_up: set[tuple[int, int]] = set()
        self._reachable: Mask = np.zeros((0, 0), dtype=np.bool_)

    def update(self, patch: GridPatch, scan: Scan, T_map_base: Array) -> None:
        """Update the frontiers after a scan made at a pose (3,)."""
        self.patch = patch
        if self._recent_path is not None:
            self._recent_path.add_pose(T_map_base)
        self.map.update(patch, box_of_scan(scan, T_map_base))

    def is_open(self, frontier: Frontier) -> bool:
        """Whether enough of a frontier remains; its cells must be of the present frame."""
        return self.map.is_long(self.map.remaining(frontier.cells), _MIN_FRONTIER_M)

    def find(self, T_map_base: Array) -> list[Frontier]:
        """All frontiers with a viewpoint that is reachable from a pose (3,)."""
        frame = self.map.frame
        clusters = self._clusters()
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        standing = standing_room(self.map.free, _EXPLORER.planner.robot_radius_m / frame.resolution)
        reach = self._reach_from(standing, xy)
        if not clusters:
            return []
        self._reachable = any_in_squares(reach, _COARSE)
        places = [self._place_at(cells, reach & standing, xy) for cells in clusters]
        found = [(c, p) for c, p in zip(clusters, places, strict=True) if p is not None]
        ways = self.path_lengths_from(
            np.array(T_map_base[:2]), np.array([p for _, p in found]).reshape(-1, 2)
        )
        return [
            Frontier(c, np.array(self.map.middle_of(c)), p, float(way))
            for (c, p), way in zip(found, ways, strict=True)
            if math.isfinite(way)
        ]

    def give_up(self, frontier: Frontier, xy: Array) -> None:
        """Ignore the part of a frontier nearest to a point (2,), from which it was observed."""
        away_m = np.hypot(*(self.map.frame.centres_of(frontier.cells) - xy).T)
        near = away_m <= away_m.min() + _PART_M
        self._given_up.update(self._lattice_cells(frontier.cells[near]))

    def _clusters(self) -> list[Cells]:
        """Frontier cells of each cluster, without those that were given up."""
        min_length_m = _MIN_FRONTIER_M
        clusters = []
        for cells in self.map.clusters(min_length_m):
            keys = self._lattice_cells(cells)
            left = cells[[key not in self._given_up for key in keys]]
            if self.map.is_long(len(left), min_length_m):
                clusters.append(left)
        return clusters

    def _lattice_cells(self, cells: Cells) -> list[tuple[int, int]]:
        """Indices of cells (N, 2) that stay when the map grows."""
        frame = self.map.frame
        first = np.round(np.array([frame.origin_y, frame.origin_x]) / frame.resolution)
        return [(int(row), int(col)) for row, col in cells + first]

    def _reach_from(self, standing: Mask, xy: tuple[float, float]) -> Mask:
        """Cells (H, W) that are reachable from a point (m)."""
        frame = self.map.frame
        row, col = frame.cells_of(np.array([xy]))[0].tolist()
        if not (0 <= row < standing.shape[0] and 0 <= col < standing.shape[1]):
            return np.zeros_like(standing)
        path = self._recent_path
        trail = None if path is None else path.cells(frame, standing.shape)
        occupied = ~self.map.passable
        cell = (row, col)
        ways = ways_out(standing, occupied, cell, frame.resolution, _EXPLORER.planner, trail)
        allowed = standing.copy()
        allowed[tuple(ways.T)] = True
        reach = reachable(allowed, np.array([cell]))
        return reach & standing if path is None else reach

    def path_lengths_from(self, xy: Array, places: Array) -> Array:
        """Path lengths, m, from a point (2,) to viewpoints (N, 2) of `find`, (N,)."""
        frame = self.map.frame
        cells = frame.cells_of(np.vstack([xy[None], places])) // _COARSE
        start = (int(cells[0, 0]), int(cells[0, 1]))
        return path_lengths_from(self._reachable, start, cells[1:]) * frame.resolution * _COARSE

    def _place_at(self, cells: Cells, allowed: Mask, xy: tuple[float, float]) -> Array | None:
        """Centre (2,), m, of the allowed cell at a frontier (N, 2) nearest to a point, m."""
        frame = self.map.frame
        row, col = (int(v) for v in frame.cells_of(np.array([xy]))[0])
        max_steps = int(ASSIGNMENT_RADIUS_M / frame.resolution)
        cell = search_beside(self.map.free, cells, allowed, max_steps, (row, col))
        return None if cell is None else np.asarray(frame.centres_of(np.array([cell]))[0])


# When a target is chosen, reached, the same as another, or given up.
_CHOICE_PERIOD_NS = SECOND_NS
_GOAL_TOLERANCE_M = 0.3
_SAME_PLACE_M = 1.0
_VISIT_RADIUS_M = 0.5  # an end node is visited where the robot comes nearer
_MAX_FAILURES = 3
_PROGRESS_M = 0.1
_PROGRESS_TIMEOUT_NS = 30 * SECOND_NS  # without this progress


@dataclass(eq=False)
class _Progress:
    """Progress towards a place: the shortest remaining path, and the time since then."""

    place: tuple[float, float]
    nearest_m: float
    waited_ns: int = 0


class _ProgressTimeout:
    """Detects targets without progress while the robot drives to them."""

    def __init__(self) -> None:
        self._watched: list[_Progress] = []
        self._driven: _Progress | None = None
        self._stamp_ns = 0

    def has_expired(self, place: Array, length_m: float, stamp_ns: int) -> bool:
        """Add driving time towards a place (2,) at a remaining path length, m."""
        same = (p for p in self._watched if math.dist(p.place, place) <= _SAME_PLACE_M)
        progress = next(same, None)
        if progress is None:
            progress = _Progress((float(place[0]), float(place[1])), length_m)
            self._watched.append(progress)
        if length_m < progress.nearest_m - _PROGRESS_M:
            progress.nearest_m = length_m
            progress.waited_ns = 0
        if self._driven is progress:
            progress.waited_ns += max(stamp_ns - self._stamp_ns, 0)
        self._driven = progress
        self._stamp_ns = stamp_ns
        if progress.waited_ns <= _PROGRESS_TIMEOUT_NS:
            return False
        self._watched.remove(progress)
        return True


class FrontierExplorer(ABC):
    """Visits frontiers until no reachable one is left."""

    def __init__(self) -> None:
        self.finder = FrontierFinder()
        self.target: Frontier | None = None
        self._survey_ns = 0
        self._frame = self.finder.map.frame
        self._number = 0
        self._visit = Streak()
        self._end = Streak()
        self._failures: list[tuple[float, float]] = []

    @abstractmethod
    def costs(self, frontiers: list[Frontier], T_map_base: Array) -> Array:
        """Cost of each frontier, (N,), from a pose (3,); the cheapest one is next."""

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Choose a target; see `Strategy`."""
        self.finder.update(patch, scan, T_map_base)
        self._drop_unchanged_target(T_map_base)
        if self._is_due(scan.stamp_ns):
            self._survey_ns = scan.stamp_ns
            self._frame = self.finder.map.frame
            self._choose(T_map_base)
        is_over = self._end.add(self.target is None)
        return _decision(topology, self.target, self._number, is_over, bool(self._failures))

    def target_failed(self, reason: str) -> None:
        """Store the position of a target that could not be reached."""
        if self.target is not None:
            self._failures.append(_place(self.target.viewpoint))
        self.target = None

    def _is_due(self, stamp_ns: int) -> bool:
        gone = (
            self.target is None
            or self._frame != self.finder.map.frame
            or not self.finder.is_open(self.target)
        )
        return gone or stamp_ns - self._survey_ns >= _CHOICE_PERIOD_NS

    def _choose(self, T_map_base: Array) -> None:
        left = [f for f in self.finder.find(T_map_base) if self._tries(f) < _MAX_FAILURES]
        fewest = min((self._tries(f) for f in left), default=0)
        left = [f for f in left if self._tries(f) == fewest]
        before = self.target
        self.target = None
        if left:
            best = left[int(np.argmin(self.costs(left, T_map_base)))]
            if before is None or math.dist(before.centroid, best.centroid) > _SAME_PLACE_M:
                self._number += 1
            near = (
                before is not None
                and math.dist(before.viewpoint, best.viewpoint) < _GOAL_TOLERANCE_M
            )
            # A goal that hardly moved is kept: the robot would otherwise replan every second.
            if near and before:
                best = Frontier(best.cells, best.centroid, before.viewpoint, best.path_length_m)
            self.target = best

    def _tries(self, frontier: Frontier) -> int:
        return sum(
            math.dist(frontier.viewpoint, place) <= _SAME_PLACE_M for place in self._failures
        )

    def _drop_unchanged_target(self, T_map_base: Array) -> None:
        """Drop a target that stays unknown although the robot is at its viewpoint."""
        if self.target is None or self._frame != self.finder.map.frame:
            return
        if self._visit.add(is_at(T_map_base, self.target.goal)):
            self.finder.give_up(self.target, T_map_base[:2])
            self.target = None
            self._visit = Streak()


class NearestFrontier(FrontierExplorer):
    """The frontier with the shortest path on the grid.

    Source: Yamauchi, "A frontier-based approach for autonomous exploration", 1997; Holz et al.,
    "Evaluating the efficiency of frontier-based exploration strategies", 2010 (a new choice when
    the frontier is gone).
    """

    def costs(self, frontiers: list[Frontier], T_map_base: Array) -> Array:
        """Path length to each frontier."""
        return np.array([f.path_length_m for f in frontiers])


class ImpatientExplorer(FrontierExplorer):
    """Gives up a target without progress for 30 s, also after an interruption.

    Where costs are other than the path length, two targets may alternate for ever.
    """

    def __init__(self) -> None:
        super().__init__()
        self._progress_timeout = _ProgressTimeout()

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Choose a target; a target without progress has failed."""
        decision = super().step(topology, patch, scan, T_map_base)
        target = self.target
        if target is not None and self._progress_timeout.has_expired(
            target.viewpoint, target.path_length_m, scan.stamp_ns
        ):
            self.target_failed('no progress')
        return decision


class ExploreLite(ImpatientExplorer):
    """explore_lite's cost: potential_scale * straight distance - gain_scale * size.

    Both are scaled by the cell size. Scales as in its launch file; size in cells, distance that of
    the nearest frontier cell, m; the target is the centroid of the frontier. The package blacklists
    a goal without progress, too, but not after an interruption: it would oscillate between two.
    Source: Hörner, "Map-merging for multi-robot system", 2016, package explore_lite.
    """

    potential_scale = 3.0
    gain_scale = 1.0

    def costs(self, frontiers: list[Frontier], T_map_base: Array) -> Array:
        """Weighted distance minus weighted size."""
        frame = self.finder.map.frame
        nearest = [
            np.hypot(*(frame.centres_of(f.cells) - T_map_base[:2]).T).min() for f in frontiers
        ]
        sizes = [len(f.cells) for f in frontiers]
        return (
            self.potential_scale * np.array(nearest) - self.gain_scale * np.array(sizes)
        ) * frame.resolution


class InformationGain(ImpatientExplorer):
    """The largest area visible from a place, discounted by the path length: A exp(-lambda L).

    Source: Gonzalez-Banos and Latombe, "Navigation strategies for exploring indoor environments",
    2002.
    """

    discount_per_m = 0.2
    range_m = 8.0

    def costs(self, frontiers: list[Frontier], T_map_base: Array) -> Array:
        """Negative discounted gain."""
        assert self.finder.patch is not None
        frame = self.finder.map.frame
        cells = frame.cells_of(np.array([f.viewpoint for f in frontiers]))
        areas = _unknown_in_sight(self.finder.patch.cells, cells, self.range_m / frame.resolution)
        return -(areas + 1.0) * np.exp(
            -self.discount_per_m * np.array([f.path_length_m for f in frontiers])
        )


class BoundedTour(ImpatientExplorer):
    """The frontier with which the shortest open path through the nearest ones begins.

    The order of the `max_places` nearest frontiers is exact, by dynamic programming over the sets
    of visited ones; all others come later.
    Source: Held and Karp, "A dynamic programming approach to sequencing problems", 1962; the order
    of the package frontier_exploration_ros2, 2026.
    """

    max_places = 10

    def costs(self, frontiers: list[Frontier], T_map_base: Array) -> Array:
        """Length of the shortest path through the nearest frontiers, by the first one."""
        lengths = np.array([f.path_length_m for f in frontiers])
        near = np.argsort(lengths, kind='stable')[: self.max_places]
        places = np.array([frontiers[i].viewpoint for i in near])
        between = np.array([self.finder.path_lengths_from(place, places) for place in places])
        straight = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
        between = np.where(np.isfinite(between), between, straight)
        costs = np.full(len(frontiers), np.inf)
        costs[near] = lengths[near] + shortest_rest(np.ascontiguousarray(between))
        return costs


class VisitAllEndNodes(NearestFrontier):
    """The nearest end node that was not visited yet, by A* on the graph, as on a GVG.

    The robot follows an edge to its end. It chooses another one when it has arrived, when the end
    node disappears, or without progress for progress_timeout_s: in wide halls end nodes appear and
    disappear as the map grows. Frontiers without an end node are visited at the end, nearest first.
    Source: Choset and Nagatani, "Topological simultaneous localization and mapping (SLAM)", 2001.
    """

    def __init__(self) -> None:
        super().__init__()
        self.finder = FrontierFinder(
            allow_backtracking=True
        )  # the graph may lead through narrow passages
        self._progress_timeout = _ProgressTimeout()
        self._visited: list[tuple[float, float]] = []
        self._end_node: Array | None = None  # the goal (3,) there

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Choose an end node, or a frontier if none is left."""
        found = self._next_end_node(topology, T_map_base)
        if found is None:
            self._end_node = None
            return super().step(topology, patch, scan, T_map_base)
        goal, length_m = found
        self.finder.update(patch, scan, T_map_base)
        if not self._is_end_node_at(goal):
            self._number += 1
            self._end_node = goal
        decision = _decision(topology, self._end_node, self._number, False, False)
        if self._progress_timeout.has_expired(goal[:2], length_m, scan.stamp_ns):
            self.target_failed('no progress')
        return decision

    def target_failed(self, reason: str) -> None:
        """Mark an unreachable end node as visited."""
        if self._end_node is None:
            super().target_failed(reason)
        else:
            self._visited.append((float(self._end_node[0]), float(self._end_node[1])))
            self._end_node = None

    def _next_end_node(
        self, topology: TopologicalMap, T_map_base: Array
    ) -> tuple[Array, float] | None:
        """Goal (3,) at the next end node, and the path length to it, m; None without one."""
        ends = [node for node in topology.nodes.values() if node.kind == NodeKind.END]
        self._visited += [
            (node.x, node.y)
            for node in ends
            if math.dist((node.x, node.y), T_map_base[:2]) < _VISIT_RADIUS_M
            and not self._was_visited(node.x, node.y)
        ]
        left = {node.id: node for node in ends if not self._was_visited(node.x, node.y)}
        if not left:
            return None
        costs = path_lengths_to_nodes(topology, float(T_map_base[0]), float(T_map_base[1]))
        followed = {i: node for i, node in left.items() if self._is_followed(node.x, node.y)}
        best = min((followed or left).values(), key=lambda node: costs.get(node.id, math.inf))
        length_m = costs.get(best.id, math.inf)
        if not math.isfinite(length_m):
            return None
        place = (best.x, best.y)
        return se2.pose(*place, se2.bearing(T_map_base, place)), length_m

    def _is_end_node_at(self, goal: Array) -> bool:
        """Whether the present end node is at a goal (3,)."""
        if self._end_node is None:
            return False
        return math.dist(self._end_node[:2], goal[:2]) < _GOAL_TOLERANCE_M

    def _is_followed(self, x: float, y: float) -> bool:
        """Whether the end node at a place is the present target, which moves as the map grows."""
        return self._end_node is not None and math.dist((x, y), self._end_node[:2]) < _SAME_PLACE_M

    def _was_visited(self, x: float, y: float) -> bool:
        return any(math.dist((x, y), place) < _VISIT_RADIUS_M for place in self._visited)


def _place(xy: Array) -> tuple[float, float]:
    return float(xy[0]), float(xy[1])


def _decision(
    topology: TopologicalMap,
    target: Frontier | Array | None,
    number: int,
    finished: bool,
    failures: bool,
) -> Decision:
    """Decision with the end nodes of the graph, with a probability of 0.5 each."""
    nodes = [
        unobserved(node.id, (node.x, node.y), 0.5)
        for node in topology.nodes.values()
        if node.kind == NodeKind.END
    ]
    goal = target.goal if isinstance(target, Frontier) else target
    chosen = None
    if goal is not None:
        chosen = unobserved(FIRST_FRONTIER_ID + number, _place(goal), 0.5, goal, is_target=True)
    code = FinishCode.NONE
    reason = 'targets remain'
    if finished:
        code = FinishCode.UNREACHABLE if failures else FinishCode.ALL_RESOLVED
        reason = 'remaining targets are unreachable' if failures else 'no target is left'
    return Decision(chosen, finished, reason, code, nodes, [], 0.0)


@kernel
def shortest_rest(between: Array) -> Array:
    """Length of the shortest path through all other places from each place, (N,), exact.

    between (N, N): path lengths; time and memory grow with 2^N.
    """
    count = between.shape[0]
    sets = 1 << count
    # rest[visited, last]: shortest path from the last place through all that are not visited.
    rest = np.full((sets, count), np.inf)
    rest[sets - 1, :] = 0.0
    for visited in range(sets - 2, 0, -1):
        for last in range(count):
            if not visited >> last & 1:
                continue
            for following in range(count):
                if visited >> following & 1:
                    continue
                length = between[last, following] + rest[visited | 1 << following, following]
                rest[visited, last] = min(rest[visited, last], length)
    lengths = np.empty(count)
    for first in range(count):
        lengths[first] = rest[1 << first, first]
    return lengths


@kernel
def _unknown_in_sight(cells: NDArray[np.int8], places: Cells, reach: float) -> Array:
    """Unknown cells on rays (one a degree) from each place (N, 2) up to a known obstacle, (N,)."""
    rows, cols = cells.shape
    areas = np.zeros(places.shape[0])
    seen = np.full((rows, cols), -1, dtype=np.int32)
    for i in range(places.shape[0]):
        for degree in range(360):
            angle = math.radians(float(degree))
            x = places[i, 1] + 0.5
            ray = begin_ray(x, places[i, 0] + 0.5, math.cos(angle), math.sin(angle))
            travelled, row, col = ray[:3]
            while (
                travelled <= reach and 0 <= row < rows and 0 <= col < cols and cells[row, col] < 65
            ):
                if cells[row, col] < 0 and seen[row, col] != i:
                    seen[row, col] = i
                    areas[i] += 1.0
                ray = next_cell(ray)
                travelled, row, col = ray[:3]
    return areas
