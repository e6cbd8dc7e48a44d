"""Belief about a candidate: what was tried, and how likely nothing is hidden behind it."""

import bisect
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.se2 import Cells, Place
from thinmap_ros.core.snapshot import MAX_CELL_INDEX, MAX_COORDINATE_M, MAX_COUNT, MAX_ID, Field
from thinmap_ros.jit import inlined, kernel

MAX_VISITS = 3  # that show nothing, until a candidate is given up
WORTH_SEEING_M2 = 0.5  # a smaller hidden area counts as nothing
_LOG_ODDS_LIMIT = 14.0
_MIN_LENGTH_M = 0.1
_MIN_M2 = 0.05
_MIN_DEPTH_M = 0.05
_DEVIATIONS = 1.645  # of a normal distribution at 95 %

# Free cells between a frontier and the wall right behind it, for each cell of the frontier: a
# median at the end of explorations, see `benchmarks/exploration/missing_area.py`.
_FRINGE = 0.45

SAME_M = 0.5  # cells of a frontier so far apart are the same: corrections of the map move them
_SHARE = 0.5  # of its cells with which a frontier continues an earlier one

FIELDS = {
    'ids': Field(np.int64, ('n',), 1, MAX_ID),
    'places': Field(np.float64, ('n', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'visits': Field(np.int64, ('n',), 0, MAX_COUNT),
    'cell_counts': Field(np.int64, ('n',), 0, MAX_COUNT),
    # of the lattice of the map, place after place
    'cells': Field(np.int64, ('k', 2), -MAX_CELL_INDEX, MAX_CELL_INDEX),
    'seen_counts': Field(np.int64, ('n',), 0, MAX_COUNT),
    # m, map frame, place after place
    'seen_from': Field(np.float64, ('m', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
}


@dataclass(frozen=True)
class BeliefModel:
    """Fitted constants of the probability that nothing is hidden behind a candidate.

    The paper's threshold on a probability remains; the probability itself comes from the map: the
    length of the frontier, the unknown area in line of sight behind it, and how deep the unknown
    is (inside of a wall it is two or three cells); and each visit that showed nothing. Distance and
    angles of observations, the paper's D and A, add nothing to these.
    log_odds: that nothing is hidden behind a frontier of 1 m, 1 m deep, with 1 m2 in line of sight;
    length, hidden, depth: added per natural logarithm of the length, m, of the area in line of
    sight, m2, and of the depth, m, of the unknown straight behind; visit: added for each visit that
    showed nothing. area_limits_m2, mean_area_m2: mean hidden area, if there is any, where less than
    a limit is in line of sight; the last one, where more is.
    Source: exploration paper section 3.2; the constants are fitted, see `benchmarks/exploration/`.
    """

    log_odds: float
    length: float
    hidden: float
    depth: float
    visit: float
    area_limits_m2: tuple[float, ...]
    mean_area_m2: tuple[float, ...]

    def probability(
        self, length_m: float, hidden_m2: float, depth_m: float, visits: int = 0
    ) -> float:
        """Probability that nothing worth seeing is behind a frontier."""
        log_odds = (
            self.log_odds
            + self.length * math.log(max(length_m, _MIN_LENGTH_M))
            + self.hidden * math.log(max(hidden_m2, _MIN_M2))
            + self.depth * math.log(max(depth_m, _MIN_DEPTH_M))
            + self.visit * visits
        )
        return 1.0 / (1.0 + math.exp(-min(max(log_odds, -_LOG_ODDS_LIMIT), _LOG_ODDS_LIMIT)))

    def mean_area(self, hidden_m2: float) -> float:
        """Mean area, m2, behind a frontier if something is."""
        return self.mean_area_m2[bisect.bisect(self.area_limits_m2, hidden_m2)]


class MissingArea(NamedTuple):
    """Free area, m2, that an exploration has not seen: expected, and its 95 % bound."""

    expected_m2: float
    bound_m2: float


class Hidden(NamedTuple):
    """What a frontier hides: with a probability a fringe, else an area worth seeing; means, m2."""

    probability: float
    fringe_m2: float
    area_m2: float


def fringe_m2(length_m: float, resolution: float) -> float:
    """Mean free area between a frontier and the wall right behind it."""
    return _FRINGE * length_m * resolution


def missing_area(hidden: Iterable[Hidden]) -> MissingArea:
    """Area behind frontiers, from the means of each.

    Each frontier hides an exponentially distributed area, with one mean or the other. The bound is
    that of the gamma distribution with the mean and the variance of the sum.
    Source: Wilson and Hilferty, "The distribution of chi-square", 1931 (quantile of a gamma
    distribution).
    """
    mean = 0.0
    variance = 0.0
    for probability, fringe, area_m2 in hidden:
        share = 1.0 - probability
        own = probability * fringe + share * area_m2
        mean += own
        variance += 2.0 * (probability * fringe**2 + share * area_m2**2) - own**2
    if mean <= 0.0:
        return MissingArea(0.0, 0.0)
    per_shape = variance / mean**2
    root = 1.0 - per_shape / 9.0 + _DEVIATIONS * math.sqrt(per_shape) / 3.0
    return MissingArea(mean, mean * max(root, 0.0) ** 3)


def _no_cells() -> Cells:
    return np.zeros((0, 2), dtype=np.int64)


@dataclass(eq=False)
class Evidence:
    """What was tried at one place (x, y), m.

    Tries are visits that showed nothing, and failed drives. They are about the frontier as it was
    then: once half of it has changed, it is another place, and is tried anew. A visit is one from a
    place: where nothing has changed, another one from there shows nothing, either. Left is a place
    to which the robot was on its way when another one became cheaper, until it has seen something
    new.
    id: from FIRST_FRONTIER_ID on; cells (N, 2): of its frontier, on the lattice of the map, as it
    was at the first try; visits: how often the robot was there and the frontier stayed as it was;
    seen_from: where it was then, m; failures: how often the robot could not get there, the last
    time at failed_ns; left: how often for a cheaper one, the last time when left_area_m2 were
    known.
    """

    id: int
    place: Place
    cells: Cells = field(default_factory=_no_cells)
    visits: int = 0
    seen_from: tuple[Place, ...] = ()
    failures: int = 0
    failed_ns: int = 0
    left: int = 0
    left_area_m2: float = 0.0

    def times_left(self, known_area_m2: float) -> int:
        """How often it was left since the robot saw something new."""
        return self.left if known_area_m2 < self.left_area_m2 + WORTH_SEEING_M2 else 0

    def leave(self, known_area_m2: float) -> None:
        """Count that it was left."""
        self.left = self.times_left(known_area_m2) + 1
        self.left_area_m2 = known_area_m2

    @property
    def is_tried(self) -> bool:
        """Whether it is kept when its place has no frontier for a while."""
        return self.visits > 0 or self.failures > 0

    @property
    def is_last_visit(self) -> bool:
        """Whether the next visit that shows nothing is the last one."""
        return self.visits >= MAX_VISITS - 1

    def add_visit(self, place: Place) -> None:
        """Add a visit that showed nothing, at a place, m; it is reachable, whatever failed."""
        self.visits += 1
        self.seen_from += (place,)
        self.failures = 0

    def was_seen_from(self, place: Place) -> bool:
        """Whether a visit to a place, m, or beside it, showed nothing."""
        return any(math.dist(place, earlier) <= SAME_M for earlier in self.seen_from)


class EvidenceStore:
    """Evidence by place: of the present frontiers, and of earlier ones that were tried.

    A frontier continues an earlier one if at least half of its cells lie on it.
    """

    def __init__(self, first_id: int) -> None:
        """first_id: id of the first place; no id is used twice."""
        self.items: list[Evidence] = []
        self._next_id = first_id

    def follow(
        self, places: Sequence[Place], frontiers: Sequence[Cells], resolution: float
    ) -> list[Evidence]:
        """Evidence of each frontier (N, 2) now, on the lattice of the map, with its place, m."""
        # Of two that a frontier continues equally, what was tried counts.
        earlier = sorted(self.items, key=lambda item: not item.is_tried)
        reach = round(SAME_M / resolution)
        indices = _continued(*_joined([i.cells for i in earlier]), *_joined(frontiers), reach)
        found: list[Evidence] = []
        continued: set[int] = set()
        for place, cells, index in zip(places, frontiers, indices.tolist(), strict=True):
            if index < 0:
                item = Evidence(self._new_id(), place, cells)
            elif index in continued:  # a part of what another one continues
                item = replace(earlier[index], id=self._new_id())
            else:
                item = earlier[index]
                continued.add(index)
            item.place = place
            if not item.is_tried:
                item.cells = cells
            found.append(item)
        left = (item for i, item in enumerate(earlier) if i not in continued)
        self.items = found + [item for item in left if item.is_tried]
        return found

    def state(self) -> dict[str, NDArray[Any]]:
        """All evidence but failures as arrays by name, for `restore`.

        What could not be reached is worth another try.
        """
        items = self.items
        cells, ends = _joined([item.cells for item in items])
        seen = [place for item in items for place in item.seen_from]
        return {
            'ids': np.array([item.id for item in items], dtype=np.int64),
            'places': np.array([item.place for item in items]).reshape(-1, 2),
            'visits': np.array([item.visits for item in items], dtype=np.int64),
            'cell_counts': np.diff(ends),
            'cells': cells,
            'seen_counts': np.array([len(item.seen_from) for item in items], dtype=np.int64),
            'seen_from': np.array(seen, dtype=np.float64).reshape(-1, 2),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a `state`, checked by FIELDS.

        Raises InputError where its arrays contradict each other.
        """
        snapshot.require_unique(state['ids'], 'exploration: id of a place')
        cells = _split(state['cells'], state['cell_counts'], 'cells')
        seen = _split(state['seen_from'], state['seen_counts'], 'places of visits')
        self.items = [
            Evidence(
                int(number),
                (float(place[0]), float(place[1])),
                frontier,
                int(visits),
                tuple((float(x), float(y)) for x, y in places),
            )
            for number, place, visits, frontier, places in zip(
                state['ids'], state['places'], state['visits'], cells, seen, strict=True
            )
        ]
        self._next_id = max([self._next_id, *(item.id + 1 for item in self.items)])

    def _new_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1


def completed(state: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
    """A state with the places of visits, which those of releases up to 0.3.0 lack."""
    if {'seen_counts', 'seen_from'} & state.keys() or 'ids' not in state:
        return state
    counts = np.zeros(np.shape(state['ids']), dtype=np.int64)
    return {**state, 'seen_counts': counts, 'seen_from': np.zeros((0, 2))}


def _split(rows: NDArray[Any], counts: NDArray[np.int64], what: str) -> list[NDArray[Any]]:
    """Rows (K, 2) of each place, which has so many of them; raises InputError if K differs."""
    fits = bool((counts <= len(rows)).all()) and int(counts.sum()) == len(rows)
    snapshot.require(fits, f'exploration: {len(rows)} {what}', 'as many as the places have')
    return np.split(rows, np.cumsum(counts)[:-1]) if len(counts) else []


def _joined(parts: Sequence[Cells]) -> tuple[Cells, NDArray[np.int64]]:
    """Cells (K, 2) of all parts (N, 2), and where each part begins and the last one ends."""
    ends = np.cumsum([0, *map(len, parts)], dtype=np.int64)
    return np.concatenate([_no_cells(), *parts]), ends


@kernel
def _continued(
    earlier: Cells,
    earlier_ends: NDArray[np.int64],
    cells: Cells,
    ends: NDArray[np.int64],
    reach: int,
) -> NDArray[np.int64]:
    """Index of the earlier frontier that each frontier continues, (M,); -1: none.

    At least _SHARE of its cells lie on it. It is the one with most of them, and one that no other
    frontier continues, if there is such a one. Cells (K, 2) of all frontiers; ends (M + 1,): where
    each begins, and the last one ends.
    """
    indices = np.full(ends.size - 1, -1, dtype=np.int64)
    taken = np.zeros(earlier_ends.size - 1, dtype=np.bool_)
    for i in range(indices.size):
        own = cells[ends[i] : ends[i + 1]]
        best = 0
        for k in range(taken.size):
            count = _count_on(own, earlier[earlier_ends[k] : earlier_ends[k + 1]], reach)
            if count < _SHARE * own.shape[0]:
                continue
            if not taken[k]:
                count += own.shape[0]
            if count > best:
                best = count
                indices[i] = k
        if best > 0:
            taken[indices[i]] = True
    return indices


@inlined
def _count_on(cells: Cells, frontier: Cells, reach: int) -> int:
    """How many cells (N, 2) lie on a frontier (M, 2), or within reach of it."""
    if frontier.shape[0] == 0:
        return 0
    for axis in range(2):  # most frontiers are far away
        if cells[:, axis].min() - frontier[:, axis].max() > reach:
            return 0
        if frontier[:, axis].min() - cells[:, axis].max() > reach:
            return 0
    count = 0
    for a in range(cells.shape[0]):
        for b in range(frontier.shape[0]):
            down = abs(cells[a, 0] - frontier[b, 0])
            if max(down, abs(cells[a, 1] - frontier[b, 1])) <= reach:
                count += 1
                break
    return count
