"""Random buildings, each from a seed: rooms, corridors, halls, oblique wings, clutter.

Any number of them can be generated: development and evaluation use different seeds.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from benchmarks.floor_plan import (
    FloorPart,
    FloorPlan,
    FloorPlanConfig,
    Kind,
    Opening,
    generate_floor_plan,
)
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.moving_obstacles import Doors, MovingObstacles, Pedestrians
from thinmap_ros.sim.world import World

DEVELOPMENT_SEEDS = range(1000)  # others are for evaluation
_AREA_RANGE_M2 = (150.0, 100_000.0)
_ROWS_AT_ONCE = 256
_TRIES = 40


class _Cell(IntEnum):
    """Contents of a cell of a building."""

    FREE = 0
    SOLID = 1
    GLASS = 2


@dataclass(frozen=True)
class LayoutConfig:
    """Sizes that all buildings share; pairs: smallest and largest.

    A door with a leaf has another opening angle after each period, or is closed.
    """

    fine_cell_m: float = 0.05
    coarse_cell_m: float = 0.1
    coarse_from_m2: float = 20_000.0
    margin_m: float = 1.0  # of solid cells around the wings
    passage_width_m: tuple[float, float] = (1.8, 3.0)  # between two wings
    wing_gap_m: tuple[float, float] = (2.0, 6.0)
    start_clearance_m: float = 0.45
    furniture_door_gap_m: float = 1.0
    door_open_rad: tuple[float, float] = (0.6, 1.9)
    door_closed_share: float = 0.5
    door_periods: int = 64  # before they repeat


@dataclass(frozen=True)
class BuildingConfig:
    """Properties of a building: shares from 0 to 1, areas in m2. None: random, from the seed."""

    area_m2: float | None = None
    hall_share: float | None = None
    clutter: float | None = None
    glass_share: float | None = None
    wings: int | None = None
    people_per_1000_m2: float | None = None
    moving_doors: float | None = None
    layout: LayoutConfig = LayoutConfig()


@dataclass(frozen=True)
class Wing:
    """A floor plan at a pose in the world (3,): its lower left corner."""

    plan: FloorPlan
    T_world_wing: Array


@dataclass(frozen=True)
class Link:
    """A straight passage of a width, m, from a place inside one wing to one inside another.

    a, b: (2,), m, world frame.
    """

    a: Array
    b: Array
    width: float


@dataclass(frozen=True)
class Building:
    """A generated world, and the wings and links that it is made of."""

    world: World
    wings: list[Wing]
    links: list[Link]

    @property
    def area_m2(self) -> float:
        """Free area."""
        return float(np.count_nonzero(self.world.occupied == 0)) * self.world.frame.resolution**2


def generate_building(seed: int, config: BuildingConfig | None = None) -> Building:
    """Generate the building of a seed; it is the same on every machine.

    Raises InputError if the area is out of range.
    """
    asked = config or BuildingConfig()
    rng = np.random.default_rng(seed)
    chosen = _random_config(asked, rng)
    wings, links = _wings(chosen, rng)
    frame, occupied = _rasterized(wings, links, chosen, rng)
    moving = _moving_obstacles(wings, chosen, rng)
    name = f'building_{seed}'
    glass = occupied == _Cell.GLASS
    start = _start(wings[0], frame, occupied, chosen.layout, rng)
    solid = (occupied != 0).astype(np.uint8)
    world = World(name, solid, frame, start, glass if glass.any() else None, moving)
    return Building(world, wings, links)


def _random_config(asked: BuildingConfig, rng: np.random.Generator) -> BuildingConfig:
    """Draw all random properties; always all of them, so that each is independent of the others."""
    least, most = _AREA_RANGE_M2
    area = math.exp(rng.uniform(math.log(300.0), math.log(12_000.0)))
    if rng.random() < 0.1:
        area = math.exp(rng.uniform(math.log(12_000.0), math.log(most)))
    drawn = {
        'area_m2': area,
        'hall_share': float(rng.choice([0.0, 0.2, 0.6])),
        'clutter': float(rng.choice([0.0, 0.3, 1.0])),
        'glass_share': float(rng.choice([0.0, 0.0, 0.05, 0.2])),
        'wings': 1 + int(rng.integers(3)),
        'people_per_1000_m2': float(rng.choice([0.0, 3.0, 15.0])),
        'moving_doors': float(rng.choice([0.0, 0.3, 0.8])),
    }
    given = {name: value for name, value in vars(asked).items() if value is not None}
    chosen = BuildingConfig(**{**drawn, **given})
    if not least <= float(chosen.area_m2 or 0.0) <= most:
        expected = f'expected {least:g} to {most:g} m2'
        raise InputError(f'building: area_m2: {chosen.area_m2}: {expected}')
    return chosen


def _wings(config: BuildingConfig, rng: np.random.Generator) -> tuple[list[Wing], list[Link]]:
    """The main wing at the origin, and oblique wings attached to it where they fit."""
    count = config.wings or 1
    share = 1.0 if count == 1 else 0.6
    area = config.area_m2 or 0.0
    wings = [Wing(_plan(share * area, config, rng), se2.pose(0.0, 0.0, 0.0))]
    links: list[Link] = []
    for _ in range(count - 1):
        plan = _plan((1.0 - share) * area / (count - 1), config, rng)
        for _ in range(_TRIES):
            joined = _joined(wings[int(rng.integers(len(wings)))], plan, config.layout, rng)
            if joined is not None and not any(_overlap(joined[0], other) for other in wings):
                wings.append(joined[0])
                links.append(joined[1])
                break
    return wings, links


def _plan(area_m2: float, config: BuildingConfig, rng: np.random.Generator) -> FloorPlan:
    ratio = rng.uniform(1.0, 3.0)
    depth = math.sqrt(area_m2 / ratio)
    return generate_floor_plan(ratio * depth, depth, FloorPlanConfig(config.hall_share or 0.0), rng)


def _joined(
    wing: Wing, plan: FloorPlan, layout: LayoutConfig, rng: np.random.Generator
) -> tuple[Wing, Link] | None:
    """A wing of a plan, at an angle behind an exit of another wing; None if it does not fit."""
    exits = _exits(wing.plan)
    entries = _exits(plan)
    if not exits or not entries:
        return None
    way_out = exits[int(rng.integers(len(exits)))]
    way_in = entries[int(rng.integers(len(entries)))]
    width = rng.uniform(*layout.passage_width_m)
    oblique = float(rng.choice([0.0, *rng.uniform(-0.9, 0.9, 2)]))
    T_exit = se2.compose(wing.T_world_wing, way_out)
    gap = rng.uniform(*layout.wing_gap_m) + 0.5 * width * abs(math.tan(oblique))
    # The entry faces the exit, rotated by the angle between the wings.
    T_entry = se2.compose(T_exit, se2.pose(gap, 0.0, math.pi + oblique))
    T_world_wing = se2.compose(T_entry, se2.invert(way_in))
    inside = 0.5 * width + 1.0
    a = se2.compose(T_exit, se2.pose(-inside, 0.0, 0.0))[:2]
    b = se2.compose(T_entry, se2.pose(-inside, 0.0, 0.0))[:2]
    return Wing(plan, T_world_wing), Link(a, b, width)


def _exits(plan: FloorPlan) -> list[Array]:
    """Poses (3,) at the outer wall of a plan, facing outwards, at corridors and halls."""
    found = []
    for part in plan.parts:
        if part.kind is Kind.ROOM:
            continue
        x = 0.5 * (part.x0 + part.x1)
        y = 0.5 * (part.y0 + part.y1)
        if part.x0 == 0.0:
            found.append(se2.pose(0.0, y, math.pi))
        if part.y0 == 0.0:
            found.append(se2.pose(x, 0.0, -0.5 * math.pi))
        if part.x1 == plan.width:
            found.append(se2.pose(plan.width, y, 0.0))
        if part.y1 == plan.depth:
            found.append(se2.pose(x, plan.depth, 0.5 * math.pi))
    return found


def _corners(wing: Wing, margin_m: float) -> Array:
    low = -margin_m
    width = wing.plan.width + margin_m
    depth = wing.plan.depth + margin_m
    corners = np.array([(low, low), (width, low), (width, depth), (low, depth)])
    return se2.transform_points(wing.T_world_wing, corners)


def _overlap(a: Wing, b: Wing) -> bool:
    """Whether two wings are closer than half a metre, by the separating axis theorem."""
    first = _corners(a, 0.25)
    second = _corners(b, 0.25)
    for corners in (first, second):
        for side in (corners[1] - corners[0], corners[3] - corners[0]):
            one = first @ side
            other = second @ side
            if one.max() < other.min() or other.max() < one.min():
                return False
    return True


def _rasterized(
    wings: list[Wing], links: list[Link], config: BuildingConfig, rng: np.random.Generator
) -> tuple[GridFrame, NDArray[np.uint8]]:
    """Cells of the world: 0 free, else obstacle or glass."""
    layout = config.layout
    is_coarse = (config.area_m2 or 0.0) >= layout.coarse_from_m2
    cell = layout.coarse_cell_m if is_coarse else layout.fine_cell_m
    corners = np.concatenate([_corners(wing, layout.margin_m) for wing in wings])
    low = np.floor(corners.min(axis=0) / cell)
    cols, rows = (np.ceil(corners.max(axis=0) / cell) - low).astype(int)
    frame = GridFrame(float(low[0] * cell), float(low[1] * cell), cell)
    occupied = np.full((int(rows), int(cols)), _Cell.SOLID, dtype=np.uint8)
    for wing in wings:
        _paste(occupied, frame, wing, _interior(wing.plan, cell, config, rng))
    for link in links:
        _carve(occupied, frame, link)
    return frame, occupied


def _interior(
    plan: FloorPlan, cell: float, config: BuildingConfig, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Cells of a plan in its own frame."""
    shape = (math.ceil(plan.depth / cell), math.ceil(plan.width / cell))
    cells = np.full(shape, _Cell.SOLID, dtype=np.uint8)
    half = 0.5 * plan.wall_m
    for wall in plan.walls:
        if rng.random() < (config.glass_share or 0.0):
            _fill(cells, cell, _thick(wall, half), _Cell.GLASS)
    for part in plan.parts:
        inner = (part.x0 + half, part.y0 + half, part.x1 - half, part.y1 - half)
        _fill(cells, cell, inner, _Cell.FREE)
    for opening in (*plan.doors, *plan.passages):
        _fill(cells, cell, _thick(opening, half + cell), _Cell.FREE)
    _furnish(cells, cell, plan, config, rng)
    return cells


def _thick(opening: Opening, half: float) -> tuple[float, float, float, float]:
    """Box of an opening, as deep as its wall."""
    along_x = abs(opening.x1 - opening.x0) > abs(opening.y1 - opening.y0)
    dx = 0.0 if along_x else half
    dy = half if along_x else 0.0
    return opening.x0 - dx, opening.y0 - dy, opening.x1 + dx, opening.y1 + dy


def _fill(
    cells: NDArray[np.uint8], cell: float, box: tuple[float, float, float, float], value: _Cell
) -> None:
    """Set the cells whose centres lie in a box (x0, y0, x1, y1), m."""
    col, row, end_col, end_row = (max(math.ceil(edge / cell - 0.5), 0) for edge in box)
    cells[row:end_row, col:end_col] = value


def _furnish(
    cells: NDArray[np.uint8],
    cell: float,
    plan: FloorPlan,
    config: BuildingConfig,
    rng: np.random.Generator,
) -> None:
    """Add cupboards along walls, tables and chair legs, and pillars in halls."""
    door_gap_m = config.layout.furniture_door_gap_m
    doors = np.array([(0.5 * (d.x0 + d.x1), 0.5 * (d.y0 + d.y1)) for d in plan.doors])
    for part in plan.parts:
        if part.kind is Kind.HALL and rng.random() < 0.5:
            _pillars(cells, cell, part, rng)
        density = {Kind.ROOM: 0.12, Kind.HALL: 0.02, Kind.CORRIDOR: 0.0}[part.kind]
        count = rng.poisson((config.clutter or 0.0) * density * part.width * part.depth)
        for _ in range(min(count, 60)):
            at = np.array([rng.uniform(part.x0, part.x1), rng.uniform(part.y0, part.y1)])
            size = rng.choice([0.06, 0.5, 0.9, 1.4]) * rng.uniform(0.7, 1.3, 2)
            if len(doors) and np.hypot(*(doors - at).T).min() < door_gap_m + size.max():
                continue
            turn = float(rng.choice([0.0, rng.uniform(0.0, math.pi)]))
            _box(cells, cell, at, size, turn, part)


def _pillars(
    cells: NDArray[np.uint8], cell: float, hall: FloorPart, rng: np.random.Generator
) -> None:
    spacing = rng.uniform(4.0, 8.0)
    side = np.full(2, rng.uniform(0.3, 0.8))
    for x in np.arange(hall.x0 + spacing, hall.x1 - 1.5, spacing):
        for y in np.arange(hall.y0 + spacing, hall.y1 - 1.5, spacing):
            _box(cells, cell, np.array([x, y]), side, 0.0, hall)


def _box(
    cells: NDArray[np.uint8], cell: float, at: Array, size: Array, turn: float, part: FloorPart
) -> None:
    """Draw a rotated box (2,), m, clipped to a part of the floor."""
    reach = 0.5 * float(np.hypot(*size)) + cell
    low = np.maximum(at - reach, (part.x0, part.y0))
    high = np.minimum(at + reach, (part.x1, part.y1))
    first = np.floor(low / cell).astype(int)
    last = np.ceil(high / cell).astype(int)
    cols, rows = np.meshgrid(np.arange(first[0], last[0]), np.arange(first[1], last[1]))
    beside = np.stack([(cols + 0.5) * cell - at[0], (rows + 0.5) * cell - at[1]])
    c = math.cos(turn)
    s = math.sin(turn)
    u = np.abs(c * beside[0] + s * beside[1])
    v = np.abs(-s * beside[0] + c * beside[1])
    inside = (u <= 0.5 * size[0]) & (v <= 0.5 * size[1])
    view = cells[first[1] : last[1], first[0] : last[0]]
    view[inside[: view.shape[0], : view.shape[1]]] = _Cell.SOLID


def _paste(
    occupied: NDArray[np.uint8], frame: GridFrame, wing: Wing, inside: NDArray[np.uint8]
) -> None:
    """Copy the cells of a wing into the world, some rows at a time."""
    cell = frame.resolution
    corners = frame.cells_of(_corners(wing, 0.0))
    first = np.maximum(corners.min(axis=0) - 1, 0)
    last = np.minimum(corners.max(axis=0) + 2, occupied.shape)
    T_wing_world = se2.invert(wing.T_world_wing)
    for row in range(int(first[0]), int(last[0]), _ROWS_AT_ONCE):
        rows = np.arange(row, min(row + _ROWS_AT_ONCE, int(last[0])))
        cols = np.arange(int(first[1]), int(last[1]))
        at = np.stack(np.meshgrid(rows, cols, indexing='ij'), axis=2).reshape(-1, 2)
        own = np.floor(se2.transform_points(T_wing_world, frame.centres_of(at)) / cell + 1e-6)
        own = own.astype(np.int64)[:, ::-1]
        here = (own >= 0).all(axis=1) & (own < inside.shape).all(axis=1)
        occupied[at[here, 0], at[here, 1]] = inside[own[here, 0], own[here, 1]]


def _carve(occupied: NDArray[np.uint8], frame: GridFrame, link: Link) -> None:
    """Clear the cells of a passage."""
    reach = 0.5 * link.width
    ends = np.stack([link.a, link.b])
    first = frame.cells_of(ends.min(axis=0)[None] - reach)[0]
    last = frame.cells_of(ends.max(axis=0)[None] + reach)[0] + 1
    rows = np.arange(first[0], last[0])
    cols = np.arange(first[1], last[1])
    at = np.stack(np.meshgrid(rows, cols, indexing='ij'), axis=2).reshape(-1, 2)
    along = (link.b - link.a) / np.hypot(*(link.b - link.a))
    beside = frame.centres_of(at) - link.a
    u = beside @ along
    v = np.abs(beside @ np.array([-along[1], along[0]]))
    free = at[(u >= 0.0) & (u <= np.hypot(*(link.b - link.a))) & (v <= reach)]
    occupied[free[:, 0], free[:, 1]] = 0


def _start(
    wing: Wing,
    frame: GridFrame,
    occupied: NDArray[np.uint8],
    layout: LayoutConfig,
    rng: np.random.Generator,
) -> Array:
    """A pose (3,) in a corridor or hall of a wing, or in a room if there is neither."""
    parts = [part for part in wing.plan.parts if part.kind is not Kind.ROOM] or wing.plan.parts
    reach = math.ceil(layout.start_clearance_m / frame.resolution)
    while True:
        part = parts[int(rng.integers(len(parts)))]
        at = se2.pose(rng.uniform(part.x0, part.x1), rng.uniform(part.y0, part.y1), 0.0)
        T = se2.compose(wing.T_world_wing, at)
        row, col = frame.cells_of(T[None, :2])[0]
        near = occupied[row - reach : row + reach + 1, col - reach : col + reach + 1]
        if not near.any():
            return se2.pose(T[0], T[1], rng.uniform(-math.pi, math.pi))


def _moving_obstacles(
    wings: list[Wing], config: BuildingConfig, rng: np.random.Generator
) -> MovingObstacles | None:
    pedestrians = _pedestrians(wings, config, rng)
    doors = _doors(wings, config, rng)
    if not len(pedestrians.points) and not len(doors.hinges):
        return None
    return MovingObstacles(pedestrians, doors)


def _pedestrians(
    wings: list[Wing], config: BuildingConfig, rng: np.random.Generator
) -> Pedestrians:
    """Pedestrians, each in its own part of the floor: back and forth, with pauses."""
    count = rng.poisson((config.people_per_1000_m2 or 0.0) * (config.area_m2 or 0.0) / 1000.0)
    points = np.zeros((count, 4, 2))
    parts = [(wing, part) for wing in wings for part in wing.plan.parts]
    areas = np.array([part.width * part.depth for _, part in parts])
    for i in range(count):
        wing, part = parts[int(rng.choice(len(parts), p=areas / areas.sum()))]
        x = rng.uniform(part.x0 + 0.4, part.x1 - 0.4, 4)
        y = rng.uniform(part.y0 + 0.4, part.y1 - 0.4, 4)
        points[i] = se2.transform_points(wing.T_world_wing, np.column_stack([x, y]))
    return Pedestrians(points, rng.uniform(0.5, 1.4, count), rng.exponential(8.0, (count, 4)))


def _doors(wings: list[Wing], config: BuildingConfig, rng: np.random.Generator) -> Doors:
    """Door leaves for most doors; a share of them moves."""
    hinges = []
    ends = []
    for wing in wings:
        doors = [door for door in wing.plan.doors if rng.random() < 0.7]
        at = np.array([(d.x0, d.y0, d.x1, d.y1) for d in doors]).reshape(-1, 4)
        hinges.append(se2.transform_points(wing.T_world_wing, at[:, :2]))
        ends.append(se2.transform_points(wing.T_world_wing, at[:, 2:]))
    together = np.concatenate(hinges)
    count = len(together)
    moves = rng.random(count) < (config.moving_doors or 0.0)
    side = rng.choice([-1.0, 1.0], count)
    period_s = np.where(moves, rng.uniform(20.0, 300.0, count), np.inf)
    # A separate generator, so that other random choices do not depend on it.
    chance = np.random.default_rng(int(rng.integers(2**31)))
    layout = config.layout
    shape = (count, layout.door_periods)
    open_rad = side[:, None] * chance.uniform(*layout.door_open_rad, shape)
    is_shut = moves[:, None] & (chance.random(shape) < layout.door_closed_share)
    return Doors(together, np.concatenate(ends), period_s, open_rad, is_shut)
