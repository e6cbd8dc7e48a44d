"""Follows end nodes from scan to scan and gathers the evidence for their position probability.

What the paper leaves open, and how it is settled here:

- *Independent evidence.* A look at a node counts only if, since the last look that counted, the
  robot has moved `observation_distance_m` or the bearing to the node has turned by
  `observation_angle_deg`. A robot that stands still learns nothing new.
- *Which looks.* The node lies in the laser's field of view and range, and all cells between are
  free.
- *Moved nodes.* A node that is farther than `moved_m` from where its evidence began loses all of
  it: the looks were about another place.
- *Which node continues which.* The topological map's ids decide. An end node with a new id takes
  over the evidence of one that vanished at the same scan within `moved_m`; so a merged node keeps
  that of the nearest one.
- *Rim of the range, and of the known.* A skeleton also ends where only knowledge ends. In mode
  `frontier`, a node with unknown space at its neighbourhood's border (see `frontiers`) is not made
  more reliable by any look (R is at most 0.5), and one without any cannot move any more: that
  counts as one look of reliability `closed_node_reliability`. In mode `paper` the looks are all
  there is.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.exploration.field_of_view import field_of_view
from thinmap_ros.core.exploration.position_probability import (
    angle_difference,
    angle_index,
    bayes_update,
    distance_index,
    nearest_distance,
    reliability,
)
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_COUNT, MAX_ID, Field

Cells = NDArray[np.int64]
PRIOR = 0.5
_NEUTRAL = 0.5
_SEEN = slice(5, 7)  # of a row of 'tracks': from where the node was last seen, NaN if it was not
FIELDS = {
    'ids': Field(np.int64, ('n',), 1, MAX_ID),
    # x, y, x and y where the evidence began, probability, x and y of where it was seen from, closed
    'tracks': Field(
        np.float64,
        ('n', 8),
        (
            -MAX_COORDINATE_M,
            -MAX_COORDINATE_M,
            -MAX_COORDINATE_M,
            -MAX_COORDINATE_M,
            0.0,
            -MAX_COORDINATE_M,
            -MAX_COORDINATE_M,
            0.0,
        ),
        (
            MAX_COORDINATE_M,
            MAX_COORDINATE_M,
            MAX_COORDINATE_M,
            MAX_COORDINATE_M,
            1.0,
            MAX_COORDINATE_M,
            MAX_COORDINATE_M,
            1.0,
        ),
        nan=True,
    ),
    'look_counts': Field(np.int64, ('n',), 0, MAX_COUNT),
    # distance and bearing of each look, node after node
    'looks': Field(
        np.float64, ('k', 2), (0.0, -2.0 * math.pi), (2.0 * MAX_COORDINATE_M, 2.0 * math.pi)
    ),
}


@dataclass(frozen=True)
class TrackerConfig(Config):
    """Which looks count, and what becomes of a node's evidence."""

    mode: str = parameter(
        'frontier',
        'frontier: end nodes are judged by the frontiers at them. paper: by viewing distance and '
        'angle alone, as printed.',
        choices=('frontier', 'paper'),
    )
    observation_distance_m: float = parameter(
        0.5,
        'Motion of the robot after which an end node counts as observed again (m). Lower: '
        'probabilities change faster.',
        low=0.0,
        high=10.0,
    )
    observation_angle_deg: float = parameter(
        15.0,
        'Change of the bearing after which an end node counts as observed again (deg). Lower: '
        'probabilities change faster.',
        low=0.0,
        high=180.0,
    )
    node_reset_distance_m: float = parameter(
        0.4,
        'An end node that moves farther than this loses its evidence (m). Raise it for a noisy '
        'map.',
        low=0.0,
        high=10.0,
    )
    closed_node_reliability: float = parameter(
        0.95,
        'Reliability of an end node without a frontier. Lower it to visit closed end nodes as '
        'well.',
        low=0.5,
        high=0.999,
    )


@dataclass
class Track:
    """An end node and its evidence.

    Place (x, y) m, where the evidence began, and the looks that counted.
    angle_span_deg: largest difference between the bearings of these looks.
    """

    node_id: int
    x: float
    y: float
    began_at: tuple[float, float]
    probability: float = PRIOR
    distances_m: list[float] = field(default_factory=list)
    bearings_rad: list[float] = field(default_factory=list)
    angle_span_deg: float = 0.0
    last_seen_from: tuple[float, float] | None = None
    closed: bool = False

    @property
    def min_distance_m(self) -> float:
        """Nearest place of the looks that counted, m; inf before the first."""
        return min(self.distances_m, default=math.inf)

    @property
    def distance_index(self) -> float:
        """D of equation (1); 0 before the first look."""
        return distance_index(self.min_distance_m) if self.distances_m else 0.0

    @property
    def angle_index(self) -> float:
        """A of equation (4)."""
        return angle_index(self.angle_span_deg)

    def forget(self) -> None:
        """Begin anew at the present place."""
        self.began_at = (self.x, self.y)
        self.probability = PRIOR
        self.last_seen_from = None
        self.closed = False
        self.distances_m = []
        self.bearings_rad = []
        self.angle_span_deg = 0.0


class EndNodeTracker:
    """The end nodes of the topological map by id, each with its position probability."""

    def __init__(self, config: TrackerConfig | None = None) -> None:
        self.config = config or TrackerConfig()
        self.tracks: dict[int, Track] = {}

    def follow(self, places: dict[int, tuple[float, float]]) -> dict[int, int]:
        """Take in where the end nodes (id -> x, y in m) are now.

        Tracks move, appear and vanish with them.
        Returns the new id of each node that lives on under another one.
        """
        lost = {i: track for i, track in self.tracks.items() if i not in places}
        tracks = {}
        renamed = {}
        for node_id, (x, y) in places.items():
            track = self.tracks.get(node_id)
            if track is None:
                track = self._heir(lost, x, y) or Track(node_id, x, y, (x, y))
                if track.node_id != node_id:
                    renamed[track.node_id] = node_id
                    track.node_id = node_id
            track.x = x
            track.y = y
            if math.dist((x, y), track.began_at) > self.config.node_reset_distance_m:
                track.forget()
            tracks[node_id] = track
        self.tracks = tracks
        return renamed

    def look(
        self,
        scan: Scan,
        T_map_base: Array,
        free: NDArray[np.bool_],
        frame: GridFrame,
        open_ids: set[int],
    ) -> None:
        """Update the probability of each node that this scan sees.

        free (H, W) bool: cells in `frame` through which one can see; open_ids: nodes with unknown
        space around (used in mode open_border only).
        """
        if not self.tracks:
            return
        T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
        places = np.array([(track.x, track.y) for track in self.tracks.values()])
        at = frame.as_array()
        (low, high) = field_of_view(scan)
        seen = _in_sight(
            free, at, T_map_laser, places, scan.range_max_m, 0.5 * (low + high), 0.5 * (high - low)
        )
        for track in itertools.compress(self.tracks.values(), seen):
            if self._is_news(track, T_map_laser):
                self._count(track, T_map_laser, track.node_id in open_ids)
        if self.config.mode == 'frontier':
            for track in self.tracks.values():
                self._judge_border(track, track.node_id in open_ids)

    def state(self) -> dict[str, NDArray[Any]]:
        """All that is known of the end nodes as arrays by name; `from_state` goes on from it."""
        tracks = list(self.tracks.values())
        unseen = (math.nan, math.nan)
        rows = [
            (t.x, t.y, *t.began_at, t.probability, *(t.last_seen_from or unseen), t.closed)
            for t in tracks
        ]
        looks = [look for t in tracks for look in zip(t.distances_m, t.bearings_rad, strict=True)]
        return {
            'ids': np.array([t.node_id for t in tracks], dtype=np.int64),
            'tracks': np.array(rows, dtype=np.float64).reshape(-1, 8),
            'look_counts': np.array([len(t.distances_m) for t in tracks], dtype=np.int64),
            'looks': np.array(looks, dtype=np.float64).reshape(-1, 2),
        }

    @staticmethod
    def from_state(state: Mapping[str, NDArray[Any]], config: TrackerConfig) -> 'EndNodeTracker':
        """Tracker that goes on from the `state` of another one.

        state: checked by FIELDS. Raises InputError where its arrays contradict each other.
        """
        _check_references(state)
        tracker = EndNodeTracker(config)
        ends = np.cumsum(state['look_counts'])
        for node_id, row, end, count in zip(
            state['ids'], state['tracks'], ends, state['look_counts'], strict=True
        ):
            x, y, began_x, began_y, probability, seen_x, seen_y, closed = row.tolist()
            looks = state['looks'][end - count : end]
            tracker.tracks[int(node_id)] = Track(
                int(node_id),
                x,
                y,
                (began_x, began_y),
                probability,
                looks[:, 0].tolist(),
                looks[:, 1].tolist(),
                angle_difference(looks[:, 1]) if count else 0.0,
                None if math.isnan(seen_x) else (seen_x, seen_y),
                bool(closed),
            )
        return tracker

    def _heir(self, lost: dict[int, Track], x: float, y: float) -> Track | None:
        """The nearest vanished track within moved_m; each is inherited once."""
        near = min(
            lost.values(), key=lambda track: math.dist((x, y), (track.x, track.y)), default=None
        )
        if near is None or math.dist((x, y), (near.x, near.y)) > self.config.node_reset_distance_m:
            return None
        return lost.pop(near.node_id)

    def _is_news(self, track: Track, T_map_laser: Array) -> bool:
        if track.last_seen_from is None:
            return True
        if math.dist(track.last_seen_from, T_map_laser[:2]) >= self.config.observation_distance_m:
            return True
        turned = se2.wrap(_bearing(track, T_map_laser) - track.bearings_rad[-1])
        return abs(turned) >= math.radians(self.config.observation_angle_deg)

    def _count(self, track: Track, T_map_laser: Array, is_open: bool) -> None:
        """Equations (1) to (10) for one look."""
        track.last_seen_from = (float(T_map_laser[0]), float(T_map_laser[1]))
        track.distances_m.append(math.dist((track.x, track.y), track.last_seen_from))
        track.bearings_rad.append(_bearing(track, T_map_laser))
        track.angle_span_deg = angle_difference(np.array(track.bearings_rad))
        value = reliability(nearest_distance(np.array(track.distances_m)), track.angle_span_deg)
        if self.config.mode == 'frontier' and is_open:
            value = min(value, _NEUTRAL)
        track.probability = bayes_update(track.probability, value)

    def _judge_border(self, track: Track, is_open: bool) -> None:
        """Closing counts once; a node that has opened again is as doubtful as at first."""
        if is_open and track.closed:
            track.forget()
        elif not is_open and not track.closed:
            # What far looks said against the node is settled by the map: nothing is left that could
            # move it.
            before = max(track.probability, PRIOR)
            track.probability = bayes_update(before, self.config.closed_node_reliability)
        track.closed = not is_open


def _check_references(state: Mapping[str, NDArray[Any]]) -> None:
    """Raise InputError unless each node has its looks, and a place of the last one if any."""
    counts = state['look_counts']
    tracks = state['tracks']
    total = len(state['looks'])
    fits = bool((counts <= total).all()) and int(counts.sum()) == total
    snapshot.require(fits, f'exploration: {total} looks', 'as many as the nodes have')
    snapshot.require_unique(state['ids'], 'exploration: id of an end node')
    unseen = np.isnan(tracks[:, _SEEN])
    told = np.delete(tracks, np.r_[_SEEN], axis=1)
    snapshot.require(not np.isnan(told).any(), 'exploration: place or probability NaN', 'a number')
    consistent = (unseen[:, 0] == unseen[:, 1]) & (unseen[:, 0] == (counts == 0))
    expected = 'a place from which it was seen of each node with looks, and of no other'
    snapshot.require(bool(consistent.all()), 'exploration: tracks', expected)
    closed = tracks[:, -1]
    snapshot.require(bool(np.isin(closed, (0.0, 1.0)).all()), 'exploration: closed', '0 or 1')


@kernel
def _in_sight(
    free: NDArray[np.bool_],
    frame: Array,
    laser: Array,
    places: Array,
    reach_m: float,
    middle: float,
    half: float,
) -> NDArray[np.bool_]:
    """Which places (N, 2), m, a laser at a pose (3,) sees.

    They lie in its range and field of view, with free cells all the way.
    frame (3,): origin and resolution, m, of the free cells (H, W); middle, half: the field of view,
    rad.
    """
    seen = np.zeros(places.shape[0], dtype=np.bool_)
    x = frame[0]
    y = frame[1]
    resolution = frame[2]
    row = int(math.floor((laser[1] - y) / resolution))
    col = int(math.floor((laser[0] - x) / resolution))
    for i in range(places.shape[0]):
        dx = places[i, 0] - laser[0]
        dy = places[i, 1] - laser[1]
        if dx * dx + dy * dy >= reach_m * reach_m:
            continue
        off = math.pi - (math.pi - (math.atan2(dy, dx) - (laser[2] + middle))) % (2.0 * math.pi)
        if abs(off) <= half:
            to_row = int(math.floor((places[i, 1] - y) / resolution))
            to_col = int(math.floor((places[i, 0] - x) / resolution))
            seen[i] = line_is_clear(free, row, col, to_row, to_col)
    return seen


def _bearing(track: Track, T_map_laser: Array) -> float:
    """Angle of the vector from robot to node in the global frame, rad."""
    return math.atan2(track.y - T_map_laser[1], track.x - T_map_laser[0])
