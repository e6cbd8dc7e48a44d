"""Evidence about places that may hide unknown space: views, visits and failed drives.

What the paper leaves open, and how it is settled here:

- *Independent views.* A view counts only if, since the last one that counted, the place as seen
  from the laser has moved by `observation_distance_m` or turned by `observation_angle_deg`.
- *Which views.* The place lies in the laser's range and field of view, and all cells between are
  free.
- *Moved places.* A place farther than `node_reset_distance_m` from where its evidence began loses
  its evidence: it was about another place. Evidence continues that of the nearest place before.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.exploration.position_probability import (
    angle_difference,
    angle_index,
    distance_index,
    reliability,
)
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_COUNT, MAX_ID, Field
from thinmap_ros.jit import kernel

Place = tuple[float, float]
FIELDS = {
    'ids': Field(np.int64, ('n',), 1, MAX_ID),
    'places': Field(np.float64, ('n', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'began_at': Field(np.float64, ('n', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'visits': Field(np.int64, ('n',), 0, MAX_COUNT),
    'view_counts': Field(np.int64, ('n',), 0, MAX_COUNT),
    # distance, m, and bearing of each view, place after place
    'views': Field(
        np.float64, ('k', 2), (0.0, -2.0 * math.pi), (2.0 * MAX_COORDINATE_M, 2.0 * math.pi)
    ),
}


@dataclass(frozen=True)
class EvidenceConfig(Config):
    """Which views count, and how long evidence stays with a place."""

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
        0.5,
        'An end node that moves farther than this loses its evidence (m). Raise it for a noisy '
        'map.',
        low=0.0,
        high=10.0,
    )


@dataclass(eq=False)
class Evidence:
    """Evidence about one place (x, y), m.

    id: from FIRST_FRONTIER_ID on; began_at: where it began; views: distance, m, and bearing, rad,
    of each view that counted; angle_span_deg: largest difference between two of these bearings;
    visits: how often the robot was there and the place stayed as it was; failures: how often the
    robot could not get there, the last time at failed_ns.
    """

    id: int
    place: Place
    began_at: Place
    views: list[tuple[float, float]] = field(default_factory=list)
    angle_span_deg: float = 0.0
    visits: int = 0
    failures: int = 0
    failed_ns: int = 0

    @property
    def min_distance_m(self) -> float:
        """Distance of the nearest view, r of equation (2); inf before the first."""
        return min((distance for distance, _ in self.views), default=math.inf)

    @property
    def distance_index(self) -> float:
        """D of equation (1); 0 before the first view."""
        return distance_index(self.min_distance_m) if self.views else 0.0

    @property
    def angle_index(self) -> float:
        """A of equation (4)."""
        return angle_index(self.angle_span_deg)

    @property
    def reliability(self) -> float:
        """R of equation (5); 0 before the first view."""
        return reliability(self.min_distance_m, self.angle_span_deg) if self.views else 0.0

    @property
    def is_lasting(self) -> bool:
        """Whether it is kept when its place is no candidate for a while."""
        return self.visits > 0 or self.failures > 0

    def add_view(self, laser: Array, config: EvidenceConfig) -> bool:
        """Add a view from a laser at (x, y, ...), m; returns whether it counts."""
        dx = self.place[0] - float(laser[0])
        dy = self.place[1] - float(laser[1])
        distance_m = math.hypot(dx, dy)
        bearing = math.atan2(dy, dx)
        if self.views:
            last_m, last = self.views[-1]
            moved_m = math.dist((dx, dy), (last_m * math.cos(last), last_m * math.sin(last)))
            turned = abs(se2.wrap(bearing - last))
            if moved_m < config.observation_distance_m and turned < math.radians(
                config.observation_angle_deg
            ):
                return False
        turns = (abs(math.degrees(se2.wrap(bearing - other))) for _, other in self.views)
        self.angle_span_deg = max(self.angle_span_deg, *turns, 0.0)
        self.views.append((distance_m, bearing))
        return True

    def move_to(self, place: Place, reset_distance_m: float) -> None:
        """Follow the place; evidence about a place too far away is forgotten."""
        self.place = place
        if math.dist(place, self.began_at) > reset_distance_m:
            self.began_at = place
            self.views = []
            self.angle_span_deg = 0.0
            self.visits = 0


class EvidenceStore:
    """Evidence by place: of the present candidates, and lasting evidence of earlier ones."""

    def __init__(self, first_id: int) -> None:
        """first_id: id of the first place; no id is used twice."""
        self.items: list[Evidence] = []
        self._next_id = first_id

    def follow(self, places: Sequence[Place], reset_distance_m: float) -> list[Evidence]:
        """Evidence of each place now; each continues the nearest one within reset_distance_m."""
        earlier = self.items
        indices = _continued(
            np.array([item.place for item in earlier]).reshape(-1, 2),
            np.array(places, dtype=np.float64).reshape(-1, 2),
            reset_distance_m,
        ).tolist()
        found = []
        for place, index in zip(places, indices, strict=True):
            if index < 0:
                found.append(Evidence(self._next_id, place, place))
                self._next_id += 1
            else:
                earlier[index].move_to(place, reset_distance_m)
                found.append(earlier[index])
        continued = set(indices)
        left = (item for i, item in enumerate(earlier) if i not in continued)
        self.items = found + [item for item in left if item.is_lasting]
        return found

    def state(self) -> dict[str, NDArray[Any]]:
        """All evidence but failures as arrays by name, for `restore`.

        What could not be reached is worth another try.
        """
        items = self.items
        return {
            'ids': np.array([item.id for item in items], dtype=np.int64),
            'places': np.array([item.place for item in items]).reshape(-1, 2),
            'began_at': np.array([item.began_at for item in items]).reshape(-1, 2),
            'visits': np.array([item.visits for item in items], dtype=np.int64),
            'view_counts': np.array([len(item.views) for item in items], dtype=np.int64),
            'views': np.array([view for item in items for view in item.views]).reshape(-1, 2),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a `state`, checked by FIELDS.

        Raises InputError where its arrays contradict each other.
        """
        counts = state['view_counts']
        total = len(state['views'])
        fits = bool((counts <= total).all()) and int(counts.sum()) == total
        snapshot.require(fits, f'exploration: {total} views', 'as many as the places have')
        snapshot.require_unique(state['ids'], 'exploration: id of a place')
        ends = np.cumsum(counts).tolist()
        items = []
        for i, end in enumerate(ends):
            views = state['views'][end - int(counts[i]) : end]
            item = Evidence(
                int(state['ids'][i]),
                _place(state['places'][i]),
                _place(state['began_at'][i]),
                [(float(distance), float(bearing)) for distance, bearing in views],
                angle_difference(views[:, 1]) if len(views) else 0.0,
                int(state['visits'][i]),
            )
            items.append(item)
        self.items = items
        self._next_id = max([self._next_id, *(item.id + 1 for item in items)])


@kernel
def _continued(earlier: Array, places: Array, radius_m: float) -> NDArray[np.int64]:
    """Index of the earlier place (N, 2), m, that each place (M, 2), m, continues; -1: none.

    It is the nearest one within a radius; each is continued once, by the first place.
    """
    taken = np.zeros(earlier.shape[0], dtype=np.bool_)
    indices = np.full(places.shape[0], -1, dtype=np.int64)
    for i in range(places.shape[0]):
        best_m = np.inf
        for k in range(earlier.shape[0]):
            dx = earlier[k, 0] - places[i, 0]
            # Most are far away, and a comparison is faster than a distance.
            if taken[k] or abs(dx) > radius_m:
                continue
            away_m = math.hypot(dx, earlier[k, 1] - places[i, 1])
            if away_m <= radius_m and away_m < best_m:
                best_m = away_m
                indices[i] = k
        if indices[i] >= 0:
            taken[indices[i]] = True
    return indices


def _place(xy: NDArray[np.float64]) -> Place:
    return float(xy[0]), float(xy[1])
