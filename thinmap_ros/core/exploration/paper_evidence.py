"""Evidence about end nodes, as the paper counts it: views, visits and failed drives.

What the paper leaves open, and how it is settled here:

- *Independent views.* A view counts only if, since the last one that counted, the place as seen
  from the laser has moved by `observation_distance_m` or turned by `observation_angle_deg`.
- *Which views.* The place lies in the laser's range and field of view, and all cells between are
  free.
- *Moved places.* A place farther than `node_reset_distance_m` from where its evidence began loses
  its evidence: it was about another place. Evidence continues that of the nearest place before.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.distance import cdist

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.position_probability import (
    angle_index,
    distance_index,
    reliability,
)
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Node

Place = tuple[float, float]
PRIOR = 0.5


@dataclass(frozen=True)
class PaperConfig:
    """What the paper leaves open: which views count, and how long evidence stays with a place.

    probability_threshold: end nodes with at least this position probability are not visited;
    observation_distance_m, observation_angle_deg: motion of the robot, and change of the bearing,
    after which an end node counts as observed again; node_reset_distance_m: an end node that moves
    farther loses its evidence.
    """

    probability_threshold: float = 0.9
    observation_distance_m: float = 0.5
    observation_angle_deg: float = 15.0
    node_reset_distance_m: float = 0.5


@dataclass(eq=False)
class PaperEndNode:
    """An end node of the graph with its position probability, and the evidence for it.

    place (x, y), m; began_at: where its evidence began; views: distance, m, and bearing, rad, of
    each view that counted; angle_span_deg: largest difference between two of these bearings;
    visits, failures: how often the robot was there, and could not get there.
    """

    node_id: int
    place: Place
    began_at: Place
    probability: float = PRIOR
    views: list[tuple[float, float]] = field(default_factory=list)
    angle_span_deg: float = 0.0
    visits: int = 0
    failures: int = 0

    @property
    def tries(self) -> int:
        """How often the robot was there, or could not get there."""
        return self.visits + self.failures

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

    def add_view(self, laser: Array, config: PaperConfig) -> bool:
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
            self.probability = PRIOR
            self.views = []
            self.angle_span_deg = 0.0
            self.visits = 0


class PaperEndNodes:
    """End nodes of the present graph, and earlier ones that were tried."""

    def __init__(self) -> None:
        self.items: list[PaperEndNode] = []

    def follow(self, nodes: Sequence[Node], reset_distance_m: float) -> list[PaperEndNode]:
        """Each end node now; it continues the nearest earlier one within reset_distance_m."""
        earlier = self.items
        places = [(node.x, node.y) for node in nodes]
        indices = _continued(
            np.array([item.place for item in earlier]).reshape(-1, 2),
            np.array(places, dtype=np.float64).reshape(-1, 2),
            reset_distance_m,
        )
        found = []
        for node, place, index in zip(nodes, places, indices, strict=True):
            if index < 0:
                found.append(PaperEndNode(node.id, place, place))
                continue
            earlier[index].node_id = node.id
            earlier[index].move_to(place, reset_distance_m)
            found.append(earlier[index])
        continued = set(indices)
        left = [item for i, item in enumerate(earlier) if i not in continued and item.tries]
        for item in left:
            item.probability = PRIOR
        self.items = found + left
        return found


def _continued(earlier: Array, places: Array, radius_m: float) -> list[int]:
    """Index of the earlier place (N, 2), m, that each place (M, 2), m, continues; -1: none.

    It is the nearest one within a radius; each is continued once, by the first place.
    """
    away_m = np.pad(cdist(places, earlier), ((0, 0), (0, 1)), constant_values=radius_m)
    indices = []
    for own in away_m:
        nearest = int(own.argmin())
        is_new = nearest == len(earlier)
        indices.append(-1 if is_new else nearest)
        away_m[:, nearest] = radius_m if is_new else np.inf
    return indices
