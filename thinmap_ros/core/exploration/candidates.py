"""What there is to choose from.

These are end nodes with the borders to the unknown that belong to them, and from where to look.

Unknown space that no end node has in sight (a niche, or a gap that the skeleton does not reach
into) is not lost: the middle of such a border stands in for an end node.

The place to look from is the nearest one from which most of what the border hides can be seen, up
to the laser's range. Where such a look showed nothing, the robot goes to the end node itself, and
then right up to the border.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import parameter, robot_radius
from thinmap_ros.core.exploration import end_node_tracker, frontiers
from thinmap_ros.core.exploration.end_node_tracker import EndNodeTracker, Track, TrackerConfig
from thinmap_ros.core.exploration.frontiers import NOTHING, OpenBorders
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID, EndNode
from thinmap_ros.core.exploration.stretches import middle_one, without_scraps
from thinmap_ros.core.exploration.viewpoints import SQUARE
from thinmap_ros.core.planning.grid_search import (
    distance_field_from,
    downsample_mask,
    upsample_mask,
)
from thinmap_ros.core.planning.recent_path import RecentPath
from thinmap_ros.core.planning.traversability import (
    escape_cells,
    near_true_cell,
    traversable_cells,
    update_traversable_cells,
)
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_ID, Field, Fields

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]
Place = tuple[float, float]
_SAME_PLACE_M = 1.0
_NEAR_VISIT_M = 0.3
_ESCAPE_M = 0.6
_SAME_BORDER_M = 1.5
_RIM_M = 0.5
_PARTS: dict[str, Fields] = {
    'nodes': end_node_tracker.FIELDS,
    'stand_ins': end_node_tracker.FIELDS,
    'borders': frontiers.FIELDS,
}
FIELDS = {
    # id, x, y of end nodes that were visited without success
    'visited': Field(
        np.float64,
        ('v', 3),
        (1, -MAX_COORDINATE_M, -MAX_COORDINATE_M),
        (MAX_ID, MAX_COORDINATE_M, MAX_COORDINATE_M),
    ),
    'look_closer': Field(np.float64, ('c', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'next_stand_in': Field(np.int64, (), FIRST_FRONTIER_ID, MAX_ID),
}


@dataclass(frozen=True)
class SurveyConfig(TrackerConfig):
    """Which borders count, to whom they belong, and from where they are looked at."""

    robot_radius_m: float = robot_radius()
    # The name of explore_lite's parameter.
    min_frontier_size: float = parameter(
        0.5,
        'Shorter frontiers are ignored (m). Raise it for shorter paths, lower it for higher '
        'coverage.',
        low=0.0,
        high=5.0,
    )
    frontier_assignment_radius_m: float = parameter(
        3.0,
        'A frontier belongs to the nearest visible end node within this distance (m). Raise it in '
        'halls.',
        low=0.1,
        high=50.0,
    )
    view_depth_m: float = parameter(
        2.0,
        'Depth behind a frontier that a viewpoint must be able to see (m). Raise it to drive '
        'closer to the middle of openings.',
        low=0.1,
        high=20.0,
    )


@dataclass
class Candidate:
    """A place worth a visit.

    The border cells that belong to it, and the pose (3,) from which to look at it.
    """

    track: Track
    cells: Cells
    goal: Array

    @property
    def place(self) -> Place:
        """Where the end node is, m."""
        return self.track.x, self.track.y


@dataclass
class _Memory:
    """End nodes that were visited without success, with their places.

    Also borders that are to be looked at from near.
    """

    visited: dict[int, Place] = field(default_factory=dict)
    look_closer: list[Place] = field(default_factory=list)
    next_stand_in: int = FIRST_FRONTIER_ID


class Surveyor:
    """Shares the borders of the known among the end nodes.

    tracks: end nodes; stand_ins: what stands in for them; reached (H, W): cells on which the robot
    can stand and to which it can get; maybe (H, W): those on which it could stand if nothing stood
    in the unknown; ways: length of the way, in squares, from the robot to each square of reached
    cells; all as they were at the last survey, on `frame`.
    """

    def __init__(self, config: SurveyConfig) -> None:
        self.config = config
        self.borders = OpenBorders(config.min_frontier_size)
        self.tracker = EndNodeTracker(config)
        self.stand_ins = EndNodeTracker(config)
        self.trail = RecentPath()
        self.frame = self.borders.frame
        self.reached = self.maybe = self._standing = self.borders.mask
        self.ways: Array = np.zeros((0, 0))
        self._memory = _Memory()
        self._ends: dict[int, Place] | None = None

    def state(self) -> dict[str, NDArray[Any]]:
        """All that is remembered, as arrays by name; `restore` goes on from it."""
        memory = self._memory
        visited = [(node_id, *place) for node_id, place in memory.visited.items()]
        parts = {
            'nodes': self.tracker.state(),
            'stand_ins': self.stand_ins.state(),
            'borders': self.borders.state(),
        }
        named = {f'{part}_{k}': array for part, own in parts.items() for k, array in own.items()}
        return named | {
            'visited': np.array(visited, dtype=np.float64).reshape(-1, 3),
            'look_closer': np.array(memory.look_closer, dtype=np.float64).reshape(-1, 2),
            'next_stand_in': np.array(memory.next_stand_in),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take over the `state` of another surveyor, all of it or nothing.

        Raises InputError where it is none.
        """
        parts = {name: _part(state, name, fields) for name, fields in _PARTS.items()}
        prefixes = tuple(f'{name}_' for name in _PARTS)
        rest = {key: array for key, array in state.items() if not key.startswith(prefixes)}
        own = snapshot.validate(rest, FIELDS, 'exploration')
        ids = own['visited'][:, 0]
        snapshot.require(bool((ids == np.floor(ids)).all()), 'exploration: visited', 'whole ids')
        next_id = int(own['next_stand_in'])
        stand_ins = parts['stand_ins']['ids']
        given = bool(((stand_ins >= FIRST_FRONTIER_ID) & (stand_ins < next_id)).all())
        expected = f'from {FIRST_FRONTIER_ID} to below {next_id}'
        snapshot.require(given, 'exploration: ids of stand-ins', expected)
        tracker = EndNodeTracker.from_state(parts['nodes'], self.config)
        self.stand_ins = EndNodeTracker.from_state(parts['stand_ins'], self.config)
        self.tracker = tracker
        self.borders = OpenBorders.from_state(parts['borders'], self.config.min_frontier_size)
        visited = {int(row[0]): (float(row[1]), float(row[2])) for row in own['visited']}
        closer = [(float(x), float(y)) for x, y in own['look_closer']]
        self._memory = _Memory(visited, closer, next_id)
        self._ends = None

    def follow(self, ends: dict[int, Place]) -> dict[int, int]:
        """Take in where the end nodes are now.

        Returns the new id of each one that lives on under another one.
        """
        if ends == self._ends:
            return {}  # scans come more often than graphs
        self._ends = ends
        renamed = self.tracker.follow(ends)
        visited = {renamed.get(i, i): place for i, place in self._memory.visited.items()}
        # One that has moved is another one.
        self._memory.visited = {
            i: place
            for i, place in visited.items()
            if i in self.tracker.tracks
            and math.dist(place, _place(self.tracker.tracks[i]))
            <= self.config.node_reset_distance_m
        }
        return renamed

    def track(self, node_id: int) -> Track | None:
        """The end node, or stand-in, of an id."""
        return self.tracker.tracks.get(node_id) or self.stand_ins.tracks.get(node_id)

    def survey(self, T_map_base: Array, range_m: float) -> list[Candidate]:
        """End nodes with their borders, and stand-ins for the borders that no end node sees.

        range_m: the laser's.
        """
        cells, numbers, _ = self.borders.stretches()
        self._look_around(T_map_base)
        owners = self._without_scraps(self._owners(cells), numbers)
        candidates = []
        for node_id, track in self.tracker.tracks.items():
            own = cells[owners == node_id]
            if len(own) or (self.config.mode == 'paper' and node_id not in self._memory.visited):
                goal = self._goal_at(track, own, T_map_base, range_m)
                candidates.append(Candidate(track, own, goal))
        left = owners < 0
        return candidates + self._stand_in(cells[left], numbers[left], T_map_base, range_m)

    def still_open(self, candidate: Candidate) -> Candidate | None:
        """What is left of a candidate of the last survey; None if that is nothing."""
        if self.track(candidate.track.node_id) is not candidate.track:
            return None
        still = self.borders.mask[candidate.cells[:, 0], candidate.cells[:, 1]]
        if still.all() and len(still):
            return candidate
        cells = candidate.cells[still]
        length_m = len(cells) * self.borders.frame.resolution
        long_enough = length_m >= self.config.min_frontier_size - 1e-6
        if not (long_enough or self.config.mode == 'paper'):
            return None
        return Candidate(candidate.track, cells, candidate.goal)

    def examined(self, candidate: Candidate, T_map_base: Array) -> None:
        """Hear that a candidate stays open although the robot stands at its goal and looks.

        Then it is to be looked at from nearer; after that, an end node owns no border any more, and
        what is left of it gets a stand-in with a place right at it; the border of a stand-in is
        exhausted.
        """
        memory = self._memory
        node_id = candidate.track.node_id
        middle = self.border_of(candidate)
        if (
            len(candidate.cells)
            and self.config.mode == 'frontier'
            and not self._is_to_be_looked_at_closer(middle)
        ):
            memory.look_closer.append(middle)
        elif node_id >= FIRST_FRONTIER_ID:
            self.borders.exhaust(candidate.cells, (float(T_map_base[0]), float(T_map_base[1])))
        else:
            memory.visited[node_id] = candidate.place

    def border_of(self, candidate: Candidate) -> Place:
        """Where the border of a candidate is, m; where the node itself is if it has none."""
        return self._middle(candidate.cells) if len(candidate.cells) else candidate.place

    def way_m(self, goal: Array) -> float:
        """Length of the way from the robot to a goal, m; inf where there is none."""
        row, col = (int(v) // SQUARE for v in self.frame.cells_of(goal[None, :2])[0])
        inside = 0 <= row < self.ways.shape[0] and 0 <= col < self.ways.shape[1]
        return float(self.ways[row, col]) * SQUARE * self.frame.resolution if inside else math.inf

    def _look_around(self, T_map_base: Array) -> None:
        self._renew_standing()
        free = self.borders.free
        standing = self._standing
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        trail = self.trail.cells(self.frame, free.shape)
        ways = escape_cells(standing, free, self.frame, xy, _ESCAPE_M, trail)
        row, col = (int(v) for v in self.frame.cells_of(T_map_base[None, :2])[0])
        self.ways = distance_field_from(
            downsample_mask(ways, SQUARE), (row // SQUARE, col // SQUARE)
        )
        self.reached = upsample_mask(np.isfinite(self.ways), SQUARE, standing)

    def _renew_standing(self) -> None:
        """Where the robot can stand, and where it could.

        Both are found anew in the part of the map that has changed.
        """
        borders = self.borders
        radius = self.config.robot_radius_m
        resolution = borders.frame.resolution
        part = borders.changed
        borders.changed = NOTHING
        self.frame = borders.frame
        if part is None:
            self._standing = traversable_cells(borders.free, radius, resolution)
            self.maybe = traversable_cells(borders.passable, radius, resolution)
        elif part != NOTHING:
            update_traversable_cells(self._standing, borders.free, part, radius, resolution)
            update_traversable_cells(self.maybe, borders.passable, part, radius, resolution)

    def _owners(self, cells: Cells) -> Cells:
        """Id of the end node to which each border cell belongs, or -1.

        Not one that was visited in vain, nor one to which the robot cannot get: the graph remembers
        a passage that the map, as it is now, no longer shows.
        """
        ids = np.array(
            [i for i in self.tracker.tracks if i not in self._memory.visited], dtype=np.int64
        )
        if ids.size == 0 or len(cells) == 0:
            return np.full(len(cells), -1, dtype=np.int64)
        nodes = self.frame.cells_of(np.array([_place(self.tracker.tracks[int(i)]) for i in ids]))
        within = near_true_cell(self.reached, nodes, _NEAR_VISIT_M / self.frame.resolution)
        ids = ids[within]
        nodes = nodes[within]
        index = self.borders.owners(cells, nodes, self.config.frontier_assignment_radius_m)
        return np.where(index < 0, -1, ids[index]) if ids.size else index

    def _without_scraps(self, owners: Cells, numbers: Cells) -> Cells:
        """Owners (N,) of border cells; none holds less of a stretch than counts as a border.

        Such a scrap goes to whoever holds most of the stretch: it would be a target that is none at
        the next scan.
        """
        fewest = round(self.config.min_frontier_size / self.borders.frame.resolution)
        return without_scraps(owners, numbers, fewest)

    def _stand_in(
        self, cells: Cells, numbers: Cells, T_map_base: Array, range_m: float
    ) -> list[Candidate]:
        """One candidate for each stretch of border left over that can be seen from somewhere."""
        found: list[tuple[Cells, Array]] = []
        if len(cells) and self.config.mode == 'frontier':
            for number in np.unique(numbers):
                stretch = cells[numbers == number]
                place = self._place_for(stretch, T_map_base, range_m)
                if place is not None:
                    found.append((stretch, place))
        middles = [self._middle(stretch) for stretch, _ in found]
        ids = self._ids_of_stand_ins(middles)
        self.stand_ins.follow(dict(zip(ids, middles, strict=True)))
        return [
            Candidate(self.stand_ins.tracks[i], stretch, _facing(goal, middle))
            for i, middle, (stretch, goal) in zip(ids, middles, found, strict=True)
        ]

    def _place_for(self, stretch: Cells, T_map_base: Array, range_m: float) -> Array | None:
        """Where to look at a border: from afar if that may show something, else right from it."""
        place = self._far_place_for(stretch, range_m)
        if place is not None:
            return place
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        return self.borders.place_to_look(
            stretch, self.reached, self.config.frontier_assignment_radius_m, xy
        )

    def _far_place_for(self, cells: Cells, range_m: float) -> Array | None:
        if self.config.mode == 'paper' or self._is_to_be_looked_at_closer(self._middle(cells)):
            return None
        depth = self.config.view_depth_m
        reach = range_m - _RIM_M
        return self.borders.place_to_view(cells, self.reached, self.ways, reach, depth)

    def still_shows(self, candidate: Candidate, goal: Array, range_m: float) -> bool:
        """Whether a goal (3,) is still one from which to look at a candidate's border from afar."""
        cells = candidate.cells
        if (
            not len(cells)
            or self.config.mode == 'paper'
            or self._is_to_be_looked_at_closer(self._middle(cells))
        ):
            return False
        row, col = self.frame.cells_of(goal[None, :2])[0]
        inside = 0 <= row < self.reached.shape[0] and 0 <= col < self.reached.shape[1]
        return bool(inside and self.reached[row, col]) and self.borders.shows_enough(
            cells, goal[:2], range_m - _RIM_M, self.config.view_depth_m
        )

    def _is_to_be_looked_at_closer(self, middle: Place) -> bool:
        return any(math.dist(middle, place) < _SAME_BORDER_M for place in self._memory.look_closer)

    def _goal_at(self, track: Track, own: Cells, T_map_base: Array, range_m: float) -> Array:
        """Where to look at an end node's border from.

        Without one, at the node, on in the direction of approach.
        """
        if len(own) == 0:
            heading = math.atan2(track.y - T_map_base[1], track.x - T_map_base[0])
            return se2.pose(track.x, track.y, heading)
        place = self._far_place_for(own, range_m)
        return _facing(np.array(_place(track)) if place is None else place, self._middle(own))

    def _ids_of_stand_ins(self, middles: list[Place]) -> list[int]:
        """Each keeps the id of the nearest earlier one within a metre; no id is given twice."""
        free = dict(self.stand_ins.tracks)
        ids = []
        for middle in middles:
            near = min(free.values(), key=lambda t: math.dist(middle, _place(t)), default=None)
            if near is not None and math.dist(middle, _place(near)) <= _SAME_PLACE_M:
                ids.append(near.node_id)
                del free[near.node_id]
            else:
                ids.append(self._memory.next_stand_in)
                self._memory.next_stand_in += 1
        return ids

    def _middle(self, stretch: Cells) -> Place:
        """The cell of a stretch nearest to its centre of gravity, in m."""
        row, col = stretch[middle_one(stretch)].tolist()
        frame = self.borders.frame
        x = (col + 0.5) * frame.resolution + frame.origin_x
        y = (row + 0.5) * frame.resolution + frame.origin_y
        return x, y


def end_node_of(
    track: Track, candidate: Candidate | None, target_goal: Array | None, resolution: float
) -> EndNode:
    """An end node as it is told of.

    With its candidate, if it is one, and its goal (3,), if it is the target.
    """
    goal = target_goal
    if goal is None:
        goal = np.array([track.x, track.y, 0.0]) if candidate is None else candidate.goal
    return EndNode(
        node_id=track.node_id,
        x=track.x,
        y=track.y,
        probability=track.probability,
        distance_index=track.distance_index,
        angle_index=track.angle_index,
        min_distance_m=track.min_distance_m,
        angle_span_deg=track.angle_span_deg,
        frontier_length_m=0.0 if candidate is None else len(candidate.cells) * resolution,
        is_target=target_goal is not None,
        goal=goal,
    )


def _part(state: Mapping[str, NDArray[Any]], name: str, fields: Fields) -> dict[str, NDArray[Any]]:
    """The arrays of one part of a state, checked."""
    own = {
        key.removeprefix(f'{name}_'): array
        for key, array in state.items()
        if key.startswith(f'{name}_')
    }
    return snapshot.validate(own, fields, f'exploration: {name}')


def _place(track: Track) -> Place:
    return track.x, track.y


def _facing(place: Array, towards: Place) -> Array:
    return se2.pose(place[0], place[1], math.atan2(towards[1] - place[1], towards[0] - place[0]))
