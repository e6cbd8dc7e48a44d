"""Random floor plans: rooms, corridors and halls, which are rectangles, and openings."""

import math
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise

import numpy as np

_TOUCHING_M = 1e-6


@dataclass(frozen=True)
class FloorPlanConfig:
    """Sizes of a floor plan, m; pairs: smallest and largest.

    hall_share: probability that a block whose sides are within hall_side_m is a hall.
    """

    hall_share: float = 0.0
    hall_side_m: tuple[float, float] = (12.0, 45.0)
    wall_m: float = 0.15
    corridor_width_m: tuple[float, float] = (1.6, 3.0)
    room_width_m: tuple[float, float] = (2.6, 8.0)
    row_depth_m: float = 5.5  # a block that is no deeper has one row of rooms, and
    max_row_length_m: float = 30.0  # where it is longer is cut across
    spine_depth_m: float = 18.0  # one that is no deeper has a corridor along its middle
    door_width_m: tuple[float, float] = (0.85, 1.05)
    wide_door_width_m: tuple[float, float] = (1.6, 2.4)
    jamb_m: float = 0.25  # between an opening and the corner of a room


class Kind(Enum):
    """Kind of a part of a floor."""

    ROOM = 'room'
    CORRIDOR = 'corridor'
    HALL = 'hall'


@dataclass(frozen=True)
class FloorPart:
    """A rectangle of the floor, between the centre lines of its walls, m."""

    kind: Kind
    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def width(self) -> float:
        """Along x, m."""
        return self.x1 - self.x0

    @property
    def depth(self) -> float:
        """Along y, m."""
        return self.y1 - self.y0


@dataclass(frozen=True)
class Opening:
    """A stretch of the wall between two parts (their numbers), from (x0, y0) to (x1, y1), m."""

    a: int
    b: int
    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def length(self) -> float:
        """Its width, m."""
        return math.hypot(self.x1 - self.x0, self.y1 - self.y0)


@dataclass(frozen=True)
class FloorPlan:
    """Parts that tile a rectangle of width x depth, m, from (0, 0) on; thickness of all walls.

    doors: openings of the width of a door; passages: openings between corridors and halls; walls:
    the remaining walls between two parts, which may have glass.
    """

    width: float
    depth: float
    wall_m: float
    parts: list[FloorPart]
    doors: list[Opening]
    passages: list[Opening]
    walls: list[Opening]


def generate_floor_plan(
    width: float, depth: float, config: FloorPlanConfig, rng: np.random.Generator
) -> FloorPlan:
    """Plan of one wing of width x depth, m; all parts are connected."""
    parts = _split_block(FloorPart(Kind.ROOM, 0.0, 0.0, width, depth), config, rng)
    shared = _shared_walls(parts)
    passages = [wall for wall in shared if _is_open(parts[wall.a], parts[wall.b])]
    closed = [wall for wall in shared if not _is_open(parts[wall.a], parts[wall.b])]
    shortest = config.door_width_m[1] + 2.0 * config.jamb_m
    wide_enough = [wall for wall in closed if wall.length >= shortest]
    doors = [
        _door(wall, parts, config, rng) for wall in _with_doors(parts, passages, wide_enough, rng)
    ]
    wall_m = config.wall_m
    inner = [
        _stretch(wall, 0.5 * wall_m, wall.length - 0.5 * wall_m)
        for wall in passages
        if wall.length > 2.0 * wall_m
    ]
    return FloorPlan(width, depth, wall_m, parts, doors, inner, closed)


def _split_block(
    block: FloorPart, config: FloorPlanConfig, rng: np.random.Generator
) -> list[FloorPart]:
    """Cut a block into corridors and rows of rooms."""
    short, long = sorted((block.width, block.depth))
    least, most = config.hall_side_m
    if short >= least and long <= most and rng.random() < config.hall_share:
        return [replace(block, kind=Kind.HALL)]
    along_x = block.width >= block.depth
    if short <= config.row_depth_m and long <= config.max_row_length_m:
        return _rooms(block, along_x, config, rng)
    # A corridor along a block that is as deep as two rows of rooms, else across it.
    spine = short <= config.spine_depth_m
    across_x = along_x != spine
    length = block.width if across_x else block.depth
    corridor = rng.uniform(*config.corridor_width_m)
    at = rng.uniform(0.35, 0.65) * (length - corridor)
    first, middle, last = _split(block, across_x, [at, at + corridor])
    if spine:
        sides = [_rooms(side, along_x, config, rng) for side in (first, last)]
    else:
        sides = [_split_block(side, config, rng) for side in (first, last)]
    return [*sides[0], replace(middle, kind=Kind.CORRIDOR), *sides[1]]


def _rooms(
    row: FloorPart, along_x: bool, config: FloorPlanConfig, rng: np.random.Generator
) -> list[FloorPart]:
    """A row of rooms."""
    widths = config.room_width_m
    length = row.width if along_x else row.depth
    marks = [rng.uniform(*widths)]
    while marks[-1] < length - widths[0]:
        marks.append(marks[-1] + rng.uniform(*widths))
    return _split(row, along_x, [mark for mark in marks if mark < length - widths[0]])


def _split(part: FloorPart, along_x: bool, marks: list[float]) -> list[FloorPart]:
    """Pieces of a part, cut across one of its axes at distances from its lower side."""
    low = part.x0 if along_x else part.y0
    high = part.x1 if along_x else part.y1
    pieces = []
    for a, b in pairwise([low, *(low + mark for mark in marks), high]):
        if along_x:
            pieces.append(FloorPart(part.kind, a, part.y0, b, part.y1))
        else:
            pieces.append(FloorPart(part.kind, part.x0, a, part.x1, b))
    return pieces


def _is_open(a: FloorPart, b: FloorPart) -> bool:
    return a.kind is Kind.CORRIDOR and b.kind is Kind.CORRIDOR


def _shared_walls(parts: list[FloorPart]) -> list[Opening]:
    """Walls between adjacent parts, along their whole common side."""
    boxes = np.array([(p.x0, p.y0, p.x1, p.y1) for p in parts])
    found = []
    for i, part in enumerate(parts):
        rest = boxes[i + 1 :]
        low = np.maximum(rest[:, :2], (part.x0, part.y0))
        high = np.minimum(rest[:, 2:], (part.x1, part.y1))
        size = high - low
        beside_x = (np.abs(size[:, 0]) < _TOUCHING_M) & (size[:, 1] > _TOUCHING_M)
        beside_y = (np.abs(size[:, 1]) < _TOUCHING_M) & (size[:, 0] > _TOUCHING_M)
        for k in np.flatnonzero(beside_x | beside_y):
            ends = (*low[k].tolist(), *high[k].tolist())
            found.append(Opening(i, i + 1 + int(k), *ends))
    return found


def _with_doors(
    parts: list[FloorPart], passages: list[Opening], walls: list[Opening], rng: np.random.Generator
) -> list[Opening]:
    """Choose walls for doors: those that connect all parts, corridors first, and some more."""
    group = list(range(len(parts)))

    def root(i: int) -> int:
        while group[i] != i:
            group[i] = group[group[i]]
            i = group[i]
        return i

    for passage in passages:
        group[root(passage.a)] = root(passage.b)
    order = rng.permutation(len(walls)).tolist()
    # A room beside a corridor has its door there.
    order = sorted(order, key=lambda k: not _leads_to_corridor(parts, walls[k]))
    chosen = []
    for k in order:
        a = root(walls[k].a)
        b = root(walls[k].b)
        spare = 0.15 if _leads_to_corridor(parts, walls[k]) else 0.08
        if a != b or rng.random() < spare:
            group[a] = b
            chosen.append(walls[k])
    return chosen


def _leads_to_corridor(parts: list[FloorPart], wall: Opening) -> bool:
    return Kind.CORRIDOR in (parts[wall.a].kind, parts[wall.b].kind)


def _door(
    wall: Opening, parts: list[FloorPart], config: FloorPlanConfig, rng: np.random.Generator
) -> Opening:
    """A door at a random position in a wall; doors of halls may be wide."""
    is_hall = Kind.HALL in (parts[wall.a].kind, parts[wall.b].kind)
    jamb = config.jamb_m
    fits = wall.length > config.wide_door_width_m[1] + 2.0 * jamb
    wide = is_hall and fits and rng.random() < 0.6
    width = rng.uniform(*(config.wide_door_width_m if wide else config.door_width_m))
    begin = rng.uniform(jamb, wall.length - jamb - width)
    return _stretch(wall, begin, begin + width)


def _stretch(wall: Opening, begin: float, end: float) -> Opening:
    """The part of a wall between two distances from its first end."""
    along = np.array([wall.x1 - wall.x0, wall.y1 - wall.y0]) / wall.length
    first = np.array([wall.x0, wall.y0]) + begin * along
    last = np.array([wall.x0, wall.y0]) + end * along
    return Opening(wall.a, wall.b, *first.tolist(), *last.tolist())
