"""What a finished map shows at each place, what one scan shows, and how reliable its nodes are."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, laser_range_noise, parameter, robot_radius
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import begin_ray, line_is_clear, next_cell
from thinmap_ros.core.places.wall_field import FREE, UNKNOWN, WALL
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.jit import kernel

# A better laser meets walls that are rougher than it measures; the results were measured with this.
_MIN_BEAM_NOISE_M = 0.02


@dataclass(frozen=True)
class GlobalLocalizationConfig(Config):
    """How many samples, how often updated, what counts as explained, when the robot is sure."""

    samples: int = parameter(
        5000,
        'Number of samples of the pose. Raise it for large maps, lower it to save time.',
        low=100,
        high=100_000,
    )
    max_beams: int = parameter(
        60,
        'Number of beams of a scan that are compared with the map. Raise it for similar rooms, '
        'lower it to save time.',
        low=8,
        high=1000,
    )
    compared_range_m: float = 15.0  # longer ranges decide little and take time
    robot_radius_m: float = robot_radius()
    laser_range_noise_m: float = laser_range_noise()
    map_noise_m: float = parameter(
        0.05,
        'Standard deviation of the position of a correct hypothesis in the map (m). Raise it for '
        'a map with errors.',
        low=0.001,
        high=1.0,
    )
    accept_odds: float = parameter(
        300.0,
        'Odds of a pose, against all others in the map and against none of them, from which it is '
        'accepted: by the model, one in so many is false. Raise it against false localization, '
        'lower it to be localized sooner.',
        low=1.0,
        high=1e9,
    )

    @property
    def beam_noise_m(self) -> float:
        """Standard deviation of a range that is compared with the map (m)."""
        return max(self.laser_range_noise_m, _MIN_BEAM_NOISE_M)


Bytes = NDArray[np.uint8]
Short = NDArray[np.int16]

DIRECTIONS = 72

# Side of the square round the robot in which the nodes of a scan are observed and compared.
NODE_WINDOW_M = 10.0

NEAR_UNIT_M = 0.004  # of the distance to the nearest wall: up to 1.02 m in a byte
RANGE_UNIT_M = 0.05  # of the ranges all round: up to 12.75 m in a byte

_SPACING_M = 0.3
_MAX_PLACES = 100_000

_BLOCK_M = 0.5  # nodes in sight are listed for blocks of this size

SIGHT_UNIT_M = 0.002  # of where these lie, from the corner of their block: up to 65 m in two bytes


@dataclass(frozen=True, eq=False)
class Places:
    """A map as a lost robot looks at it; all in the map frame.

    frame: of the cells; states (H, W) uint8: FREE, WALL or UNKNOWN; near (H, W) uint8: distance
    from a cell to the nearest wall, in NEAR_UNIT_M, at most 255; standing (N, 2) int32: cells in
    which the robot can stand; spots (P, 2): places among these, a spacing apart, and
    around (P, DIRECTIONS) uint8: what a laser would measure from there towards the headings
    k / DIRECTIONS of a turn, in RANGE_UNIT_M; spacing_m: between the spots; nodes (M, 2): of the
    topological map; blocks, first, in_sight (2, K): x and y, in SIGHT_UNIT_M from the corner of
    block (i, j) of the map, of the nodes in sight of it are
    in_sight[:, first[blocks[i, j]] : first[blocks[i, j] + 1]]; blocks are block_cells wide.
    """

    frame: GridFrame
    states: Bytes
    near: Bytes
    standing: NDArray[np.int32]
    spots: Array
    around: Bytes
    spacing_m: float
    nodes: Array
    blocks: NDArray[np.int32]
    first: NDArray[np.int32]
    in_sight: Short
    block_cells: int

    @property
    def free_area_m2(self) -> float:
        """Area on which the robot can stand."""
        return len(self.standing) * self.frame.resolution**2

    def are_free(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (N, 2) lie in cells that are known to be free, (N,)."""
        cells = self.frame.cells_of(points)
        inside = ((cells >= 0) & (cells < self.states.shape)).all(axis=1)
        cells[~inside] = 0
        return np.asarray(inside & (self.states[cells[:, 0], cells[:, 1]] == FREE))

    def memory_bytes(self) -> int:
        """What all arrays take."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))

    @staticmethod
    def of(
        patch: GridPatch, topology: TopologicalMap, config: GlobalLocalizationConfig
    ) -> 'Places':
        """Places of a map and its topological map.

        Raises InputError where there is no free cell on which the robot can stand, no wall, or no
        node.
        """
        if not topology.nodes:
            raise InputError('topology without nodes: expected that of the map')
        others = np.where(patch.occupied, WALL, UNKNOWN)
        states = np.where(patch.free, FREE, others).astype(np.uint8)
        if not patch.occupied.any():
            raise InputError(f'map of {patch.shape} cells without an occupied one: expected walls')
        near = _near_walls(states, patch.frame.resolution)
        has_room = near * NEAR_UNIT_M >= config.robot_radius_m
        standing = np.argwhere((states == FREE) & has_room).astype(np.int32)
        if not len(standing):
            raise InputError(
                f'map of {patch.shape} cells: no free place for a robot '
                f'of {config.robot_radius_m} m'
            )
        spots, spacing_m = _spots(standing, patch.frame)
        around = ranges_around(states, patch.frame.in_cells(spots), patch.frame.resolution)
        nodes = np.array([node.position for node in topology.nodes.values()])
        block_cells = max(1, round(_BLOCK_M / patch.frame.resolution))
        blocks, first, in_sight = _sights(states, standing, nodes, patch.frame, block_cells)
        return Places(
            patch.frame,
            states,
            near,
            standing,
            spots,
            around,
            spacing_m,
            nodes,
            blocks,
            first,
            in_sight,
            block_cells,
        )


def _spots(standing: NDArray[np.int32], frame: GridFrame) -> tuple[Array, float]:
    """Of the cells (N, 2), the one nearest to the middle of each square of a spacing.

    Returns points (P, 2), and the spacing in m.
    """
    spacing = max(_SPACING_M, math.sqrt(len(standing) * frame.resolution**2 / _MAX_PLACES))
    edge = max(1, round(spacing / frame.resolution))
    squares = standing // edge
    off = np.abs(standing - squares * edge - (edge - 1) / 2.0).sum(axis=1)
    order = np.lexsort((off, squares[:, 1], squares[:, 0]))
    sorted_squares = squares[order]
    leads = np.ones(len(order), dtype=np.bool_)
    leads[1:] = (sorted_squares[1:] != sorted_squares[:-1]).any(axis=1)
    return frame.centres_of(standing[order[leads]].astype(np.int64)), edge * frame.resolution


def _near_walls(states: Bytes, resolution: float) -> Bytes:
    """Distance between the centres of each cell (H, W) and of the nearest wall; exact.

    In NEAR_UNIT_M, at most 255.
    """
    units = distance_cells(states == WALL) * resolution / NEAR_UNIT_M
    return np.minimum(units + 0.5, 255).astype(np.uint8)


@kernel
def free_way(states: Bytes, x: float, y: float, angle: float, most: float) -> tuple[float, int]:
    """Distance from a point (x, y) to the edge of the first cell that is not free, and its state.

    Distance, x and y in cells.
    FREE if there is none within `most`; UNKNOWN if the ray leaves the map.
    """
    rows, cols = states.shape
    ray = begin_ray(x, y, math.cos(angle), math.sin(angle))
    way, row, col = ray[:3]
    while way <= most:
        if row < 0 or col < 0 or row >= rows or col >= cols:
            return way, UNKNOWN
        if states[row, col] != FREE:
            return way, int(states[row, col])
        ray = next_cell(ray)
        way, row, col = ray[:3]
    return most, FREE


@kernel
def ranges_around(states: Bytes, points: Array, resolution: float) -> Bytes:
    """Ranges (P, DIRECTIONS) in all directions from points (P, 2), x and y in cells.

    In RANGE_UNIT_M; 255: farther.
    """
    around = np.empty((len(points), DIRECTIONS), dtype=np.uint8)
    most = 255 * RANGE_UNIT_M / resolution
    for i in range(len(points)):
        for k in range(DIRECTIONS):
            angle = 2.0 * math.pi * k / DIRECTIONS
            way, _ = free_way(states, points[i, 0], points[i, 1], angle, most)
            around[i, k] = min(int(way * resolution / RANGE_UNIT_M + 0.5), 255)
    return around


def _sights(
    states: Bytes,
    standing: NDArray[np.int32],
    nodes: Array,
    frame: GridFrame,
    block_cells: int,
) -> tuple[NDArray[np.int32], NDArray[np.int32], Short]:
    """Nodes in sight of each block in which the robot can stand: see Places."""
    rows, cols = states.shape
    blocks = np.full((rows // block_cells + 1, cols // block_cells + 1), -1, dtype=np.int32)
    numbers, leads = np.unique(
        (standing // block_cells) @ np.array([blocks.shape[1], 1], dtype=np.int64),
        return_index=True,
    )
    blocks.ravel()[numbers] = np.arange(len(numbers), dtype=np.int32)
    cells = frame.cells_of(nodes)
    reach = NODE_WINDOW_M / 2.0 / frame.resolution + block_cells
    first, in_sight = _list_sights(states == FREE, standing[leads].astype(np.int64), cells, reach)
    # Coordinates, not numbers of nodes: samples look at these lists in no order, and each look is
    # one short run of whole numbers, which the compiler compares several at a time.
    across = blocks.shape[1]
    corners = np.stack([numbers % across, numbers // across], axis=1) * block_cells
    corner = np.repeat(corners, np.diff(first), axis=0) * frame.resolution
    away = nodes[in_sight] - (frame.origin_x, frame.origin_y) - corner
    return blocks, first, np.ascontiguousarray(np.round(away / SIGHT_UNIT_M).astype(np.int16).T)


@kernel
def _list_sights(
    free: NDArray[np.bool_], places: NDArray[np.int64], nodes: NDArray[np.int64], reach: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Of the nodes (M, 2) within a square round each place (N, 2), those in line of sight.

    Before them, the index of the first of each place.
    """
    first = np.zeros(len(places) + 1, dtype=np.int32)
    in_sight = np.empty(max(len(places), 64), dtype=np.int32)
    order = np.argsort(nodes[:, 1])
    sorted_cols = nodes[order, 1]
    count = 0
    for i in range(len(places)):
        row, col = places[i]
        for k in range(np.searchsorted(sorted_cols, col - reach), len(order)):
            node = order[k]
            if nodes[node, 1] > col + reach:
                break
            if abs(nodes[node, 0] - row) <= reach and line_is_clear(
                free, row, col, nodes[node, 0], nodes[node, 1]
            ):
                if count == len(in_sight):
                    in_sight = np.concatenate((in_sight, np.empty_like(in_sight)))
                in_sight[count] = node
                count += 1
        first[i + 1] = count
    return first, in_sight[:count].copy()


# One scan alone has to make cells free and occupied.
_P_OCCUPIED = 0.8


@dataclass(frozen=True, eq=False)
class Observation:
    """What one scan shows: some of its beams, and the nodes of its own map, in the robot frame.

    laser (3,): its pose on the robot; ranges_m, bearings_rad (B,): beams from there, ranges cut at
    what is usable; ends (B, 2): where they end; met (B,): whether they met something there; nodes
    (K, 2): places of the nodes of the scan's topological map, and their kinds (K,).
    """

    laser: Array
    ranges_m: Array
    bearings_rad: Array
    ends: Array
    met: NDArray[np.bool_]
    nodes: Array
    node_kinds: NDArray[np.int64]


def observe(scan: Scan, resolution_m: float, config: GlobalLocalizationConfig) -> Observation:
    """Observation of a scan; the nodes are those of a grid with the map's resolution."""
    nodes, kinds = observed_nodes(scan, resolution_m, config)
    return replace(observed_beams(scan, config), nodes=nodes, node_kinds=kinds)


def observed_beams(scan: Scan, config: GlobalLocalizationConfig) -> Observation:
    """Observation of a scan without its nodes: beams alone."""
    usable = np.flatnonzero(scan.returned | scan.no_return)
    if usable.size > config.max_beams:
        usable = usable[
            np.linspace(0.0, usable.size - 1.0, config.max_beams).round().astype(np.int64)
        ]
    farthest = min(scan.range_max_m, scan.max_range_m, config.compared_range_m)
    met = scan.hit[usable] & (scan.ranges_m[usable] < farthest)
    ranges = np.where(met, scan.ranges_m[usable], farthest)
    bearings = scan.angles_rad[usable]
    ends = se2.transform_points(
        scan.T_base_laser, np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])
    )
    none = np.empty(0, dtype=np.int64)
    return Observation(scan.T_base_laser, ranges, bearings, ends, met, np.empty((0, 2)), none)


def observed_nodes(
    scan: Scan, resolution_m: float, config: GlobalLocalizationConfig
) -> tuple[Array, NDArray[np.int64]]:
    """Nodes (K, 2), robot frame, and their kinds (K,), of the topological map of one scan alone.

    Source: topological map paper section 2.1; the active window is a square round the robot.
    """
    half = NODE_WINDOW_M / 2.0
    grid = OccupancyGrid(
        OccupancyConfig(
            resolution_m=resolution_m,
            p_miss=1.0 - _P_OCCUPIED,
            p_hit=_P_OCCUPIED,
            no_return_clear_range_m=half,
        )
    )
    grid.add_scan(replace(scan, max_range_m=min(scan.max_range_m, half)), np.zeros(3))
    window = grid.window(0.0, 0.0, NODE_WINDOW_M)
    topology = build(window, (0.0, 0.0), TopologyConfig(robot_radius_m=config.robot_radius_m))
    nodes = np.array([node.position for node in topology.nodes.values()]).reshape(-1, 2)
    return nodes, np.array([int(node.kind) for node in topology.nodes.values()], dtype=np.int64)


def profile(observation: Observation) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Range in each of DIRECTIONS round the robot.

    Ranges (DIRECTIONS,), m, which are known, and which met something.

    Direction k covers the bearings k / DIRECTIONS of a turn, robot frame; of several beams the one
    nearest to its middle counts. Ranges are cut at what `Places.around` can hold.
    """
    most = 254 * RANGE_UNIT_M
    away = observation.ends
    ranges = np.hypot(away[:, 0], away[:, 1])
    turns = np.arctan2(away[:, 1], away[:, 0]) * (DIRECTIONS / (2.0 * math.pi))
    bins = np.round(turns).astype(np.int64)
    result = np.full(DIRECTIONS, most)
    known = np.zeros(DIRECTIONS, dtype=np.bool_)
    met = np.zeros(DIRECTIONS, dtype=np.bool_)
    # The nearest to a direction's middle comes last and stays.
    for k in np.argsort(-np.abs(turns - bins), kind='stable').tolist():
        at = bins[k] % DIRECTIONS
        result[at] = min(ranges[k], most)
        known[at] = True
        met[at] = bool(observation.met[k]) and ranges[k] < most
    return result, known, met


# Of the reliability of nodes, by scans simulated in the map.
_TRIALS = 60
_SAME_NODE_M = 1.0

_VIEW_SHARE = 0.25  # of the active window: where an observed node may lie


@dataclass(frozen=True, eq=False)
class NodeModel:
    """What an observed node is worth, by its kind (3,).

    found: chance that the map has it; spread_m: 1 sigma of its place along each axis; gain: how
    much likelier its place is, right there, than anywhere.
    """

    found: Array
    spread_m: Array
    gain: Array


def calibrate(
    places: Places, like: Scan, config: GlobalLocalizationConfig, rng: np.random.Generator
) -> NodeModel:
    """Node model for a map and a laser.

    Scans are made in the map at random poses, and their nodes looked up in it.

    like: a scan of that laser. So the tolerance follows from the grid and the sensor: from the
    cells' size, the field of view, what a view from one side leaves unknown, and how the map's own
    nodes were made.
    """
    distances: list[list[float]] = [[] for _ in NodeKind]
    for _ in range(_TRIALS):
        T = random_pose(places, rng)
        nodes, kinds = observed_nodes(
            simulated_scan(places, T, like), places.frame.resolution, config
        )
        away = se2.transform_points(T, nodes)[:, None, :] - places.nodes[None]
        nearest = np.hypot(away[..., 0], away[..., 1]).min(axis=1)
        for kind, distance in zip(kinds.tolist(), nearest.tolist(), strict=True):
            distances[kind].append(distance)
    chance = _chance(places)
    window = _VIEW_SHARE * NODE_WINDOW_M**2
    found = np.zeros(len(NodeKind))
    spread = np.full(len(NodeKind), places.frame.resolution)
    for kind in NodeKind:
        all_of_it = np.array(distances[kind])
        near = all_of_it[all_of_it < _SAME_NODE_M]
        if near.size:
            found[kind] = max(0.0, (near.size / all_of_it.size - chance) / (1.0 - chance))
            # The median distance of points with 1 sigma on each axis, Rayleigh distributed.
            sigma = float(np.median(near)) / math.sqrt(2.0 * math.log(2.0))
            spread[kind] = max(spread[kind], sigma)
    # A few trials do not prove a rate near 1.
    return NodeModel(np.minimum(found, 0.9), spread, window / (2.0 * np.pi * spread**2))


def random_pose(places: Places, rng: np.random.Generator) -> Array:
    """Pose (3,) at which the robot can stand, each as likely as any other."""
    at = places.frame.centres_of(
        places.standing[rng.integers(len(places.standing))][None].astype(np.int64)
    )[0]
    return se2.pose(float(at[0]), float(at[1]), float(rng.uniform(-np.pi, np.pi)))


def simulated_scan(places: Places, T_map_base: Array, like: Scan) -> Scan:
    """The scan that a laser would make in the map, without noise.

    What is unknown lets nothing through.
    """
    T_map_laser = se2.compose(T_map_base, like.T_base_laser)
    resolution = places.frame.resolution
    x = (T_map_laser[0] - places.frame.origin_x) / resolution
    y = (T_map_laser[1] - places.frame.origin_y) / resolution
    ranges = resolution * _ways(
        places.states, x, y, T_map_laser[2] + like.angles_rad, like.range_max_m / resolution
    )
    return Scan.create(
        like.stamp_ns,
        ranges,
        like.angle_min_rad,
        like.angle_increment_rad,
        like.range_min_m,
        like.range_max_m,
        like.T_base_laser,
    )


def _chance(places: Places) -> float:
    """Share of the places in the map that have a node near by, whatever was observed."""
    some = places.spots[:: max(1, len(places.spots) // 1000)]
    away = some[:, None, :] - places.nodes[None]
    return float((np.hypot(away[..., 0], away[..., 1]).min(axis=1) < _SAME_NODE_M).mean()) * (
        1.0 - 1e-6
    )


@kernel
def _ways(states: Bytes, x: float, y: float, angles: Array, most: float) -> Array:
    """Cells to the first one that is not free, for each angle (N,); inf beyond `most`."""
    ways = np.full(angles.size, np.inf)
    for k in range(angles.size):
        way, state = free_way(states, x, y, angles[k], most)
        if state != FREE:
            ways[k] = way
    return ways
