"""How well poses in a map explain one scan: loops over samples, beams and nodes, and a judge."""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.places.place_database import (
    NEAR_UNIT_M,
    SIGHT_UNIT_M,
    Bytes,
    GlobalLocalizationConfig,
    NodeModel,
    Observation,
    Places,
    Short,
    free_way,
)
from thinmap_ros.core.places.wall_field import UNKNOWN, WALL
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array
from thinmap_ros.jit import inlined, kernel

_ASIDE_M = 0.12  # a beam is blocked only if parallel ones at this distance are blocked too

_NO = 0
_YES = 1
_SAYS_NOTHING = 2

# Nodes lie within 13,000 units of their block; squares of differences from what is farther off than
# this do not fit.
_AFAR = 16_000.0

_NOWHERE = 2**31 - 1

_NODE_SIGMAS = 5.0  # beyond so many sigma nodes do not agree at all

_STEPS = 2048  # of squared distance up to there


@kernel
def range_scores(
    poses: Array,
    ends: Array,
    near: Bytes,
    origin: tuple[float, float],
    resolution: float,
    table: Array,
) -> Array:
    """Sum (N,) over the beams' ends of a table's value at their distance from the nearest wall.

    poses (N, 3); ends (B, 2): of beams that met something, robot frame; near (H, W): see Places;
    table (256,): by that distance; its last value counts outside the map.
    """
    rows, cols = near.shape
    scores = np.zeros(len(poses))
    for i in range(len(poses)):
        scores[i] = _range_score(
            poses[i, 0] - origin[0],
            poses[i, 1] - origin[1],
            poses[i, 2],
            ends,
            near,
            rows,
            cols,
            resolution,
            table,
        )
    return scores


@inlined
def _range_score(
    x: float,
    y: float,
    theta: float,
    ends: Array,
    near: Bytes,
    rows: int,
    cols: int,
    resolution: float,
    table: Array,
) -> float:
    c = math.cos(theta) / resolution
    s = math.sin(theta) / resolution
    at_x = x / resolution
    at_y = y / resolution
    total = 0.0
    for j in range(len(ends)):
        col = int(math.floor(at_x + c * ends[j, 0] - s * ends[j, 1]))
        row = int(math.floor(at_y + s * ends[j, 0] + c * ends[j, 1]))
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        total += table[near[row, col]] if inside else table[255]
    return total


@kernel
def node_scores(
    poses: Array,
    seen: Array,
    kinds: NDArray[np.int64],
    sights: tuple[NDArray[np.int32], NDArray[np.int32], Short],
    origin: tuple[float, float],
    block_m: float,
    found: Array,
    spread: Array,
    gain: Array,
) -> Array:
    """Log likelihood ratio of the observed nodes at each pose, against a pose anywhere, (N,).

    poses (N, 3); seen (K, 2): observed nodes, robot frame, and their kinds (K,); sights: blocks,
    first and in_sight of Places, blocks block_m wide. For each kind: found: chance that an observed
    node is one of the map; spread: 1 sigma of its place, m; gain: how much likelier its place is
    there than anywhere. An observed node agrees with one that the map has in sight of the pose when
    distance and angle agree; both do exactly when it lies at the same place.
    Source: topological map paper section 3.1, steps 3 to 6.
    """
    blocks, first, in_sight = sights
    table = _ratios_by_distance(found, gain)
    steps_a_unit = (_STEPS - 1) / (_NODE_SIGMAS**2 * (spread / SIGHT_UNIT_M) ** 2)
    scores = np.zeros(len(poses))
    for i in range(len(poses)):
        row = int((poses[i, 1] - origin[1]) / block_m)
        col = int((poses[i, 0] - origin[0]) / block_m)
        inside = 0 <= row < blocks.shape[0] and 0 <= col < blocks.shape[1]
        block = blocks[row, col] if inside else np.int32(-1)
        low, high = (first[block], first[block + 1]) if block >= 0 else (np.int32(0), np.int32(0))
        all_x = in_sight[0][low:high]
        all_y = in_sight[1][low:high]
        c = math.cos(poses[i, 2]) / SIGHT_UNIT_M
        s = math.sin(poses[i, 2]) / SIGHT_UNIT_M
        from_x = (poses[i, 0] - origin[0] - col * block_m) / SIGHT_UNIT_M
        from_y = (poses[i, 1] - origin[1] - row * block_m) / SIGHT_UNIT_M
        for j in range(len(seen)):
            x = from_x + c * seen[j, 0] - s * seen[j, 1]
            y = from_y + s * seen[j, 0] + c * seen[j, 1]
            kind = kinds[j]
            away = _nearest_squared(all_x, all_y, x, y) * steps_a_unit[kind]
            scores[i] += table[kind, int(min(away + 0.5, _STEPS))]
    return scores


@kernel
def _ratios_by_distance(found: Array, gain: Array) -> Array:
    """Log likelihood ratio of a node, by kind and step of squared distance (kinds, _STEPS + 1)."""
    table = np.empty((len(found), _STEPS + 1))
    for kind in range(len(found)):
        for k in range(_STEPS + 1):
            agrees = math.exp(-0.5 * _NODE_SIGMAS**2 * k / (_STEPS - 1)) if k < _STEPS else 0.0
            table[kind, k] = math.log(1.0 - found[kind] + found[kind] * gain[kind] * agrees)
    return table


@inlined
def _nearest_squared(all_x: Short, all_y: Short, x: float, y: float) -> float:
    """Squared distance from (x, y) to the nearest of points (K,), all in whole units.

    A huge one where there is none.
    In numbers of four bytes throughout, so that the compiler takes eight points at a time.
    """
    at_x = np.int32(min(max(x, -_AFAR), _AFAR))
    at_y = np.int32(min(max(y, -_AFAR), _AFAR))
    nearest = np.int32(_NOWHERE)
    for k in range(len(all_x)):
        d_x = np.int32(np.int32(all_x[k]) - at_x)
        d_y = np.int32(np.int32(all_y[k]) - at_y)
        nearest = min(nearest, np.int32(np.int32(d_x * d_x) + np.int32(d_y * d_y)))
    return float(nearest)


@kernel
def refine(
    poses: Array,
    ends: Array,
    near: Bytes,
    origin: tuple[float, float],
    resolution: float,
    table: Array,
    steps: Array,
    rounds: int,
    expected: Array,
    information: Array,
) -> tuple[Array, Array]:
    """Poses (N, 3) moved uphill on their range score: along x, y and heading by ever smaller steps.

    Also their scores (N,).

    steps (S, 2): m and rad; at each, up to `rounds` times the best of six neighbours is taken.
    Taken off the score is half the squared distance from the expected poses (N, 3), measured by
    information matrices (N, 3, 3).
    """
    rows, cols = near.shape
    result = poses.copy()
    scores = np.zeros(len(poses))
    for i in range(len(poses)):
        x = poses[i, 0] - origin[0]
        y = poses[i, 1] - origin[1]
        theta = poses[i, 2]
        mid = (expected[i, 0] - origin[0], expected[i, 1] - origin[1], expected[i, 2])
        best = _range_score(x, y, theta, ends, near, rows, cols, resolution, table)
        best -= _unlikely(x - mid[0], y - mid[1], theta - mid[2], information[i])
        for step in range(len(steps)):
            for _ in range(rounds):
                move = -1
                for k in range(6):
                    sign = 1.0 if k % 2 else -1.0
                    d_x = sign * steps[step, 0] if k < 2 else 0.0
                    d_y = sign * steps[step, 0] if 2 <= k < 4 else 0.0
                    turn = sign * steps[step, 1] if k >= 4 else 0.0
                    score = _range_score(
                        x + d_x, y + d_y, theta + turn, ends, near, rows, cols, resolution, table
                    )
                    score -= _unlikely(
                        x + d_x - mid[0], y + d_y - mid[1], theta + turn - mid[2], information[i]
                    )
                    if score > best + 1e-9:
                        best = score
                        move = k
                if move < 0:
                    break
                sign = 1.0 if move % 2 else -1.0
                x += sign * steps[step, 0] if move < 2 else 0.0
                y += sign * steps[step, 0] if 2 <= move < 4 else 0.0
                theta += sign * steps[step, 1] if move >= 4 else 0.0
        result[i, 0] = x + origin[0]
        result[i, 1] = y + origin[1]
        result[i, 2] = theta
        scores[i] = best
    return result, scores


@inlined
def _unlikely(x: float, y: float, turn: float, information: Array) -> float:
    """Half the squared length of a difference of poses, by an information matrix (3, 3)."""
    turn = math.pi - (math.pi - turn) % (2.0 * math.pi)
    squared = (
        x * x * information[0, 0] + y * y * information[1, 1] + turn * turn * information[2, 2]
    )
    squared += 2.0 * (
        x * y * information[0, 1] + x * turn * information[0, 2] + y * turn * information[1, 2]
    )
    half: float = 0.5 * squared
    return half


@kernel
def explained(
    poses: Array,
    laser: Array,
    ranges: Array,
    bearings: Array,
    met: NDArray[np.bool_],
    maps: tuple[Bytes, Bytes],
    origin: tuple[float, float],
    resolution: float,
    tolerance: tuple[float, float],
) -> tuple[Array, Array]:
    """How many beams the map explains from each pose, and of how many it says nothing, (N,) each.

    Explained is what could have come about as measured.

    poses (N, 3): of the robot; laser (3,): on it; ranges, bearings, met (B,): see Observation;
    maps: states and near of Places; tolerance: in m, and in m for each m of range. A beam that met
    something must end beside a wall, one that met nothing nowhere; on its way there must be no
    wall. Of what ends in or passes through the unknown the map says nothing.
    """
    counts = np.zeros(len(poses))
    silent = np.zeros(len(poses))
    for i in range(len(poses)):
        c = math.cos(poses[i, 2])
        s = math.sin(poses[i, 2])
        x = (poses[i, 0] + c * laser[0] - s * laser[1] - origin[0]) / resolution
        y = (poses[i, 1] + s * laser[0] + c * laser[1] - origin[1]) / resolution
        heading = poses[i, 2] + laser[2]
        for j in range(len(ranges)):
            slack = tolerance[0] + tolerance[1] * ranges[j]
            angle = heading + bearings[j]
            answer = _explains(maps, x, y, angle, ranges[j], met[j], slack, resolution)
            counts[i] += answer == _YES
            silent[i] += answer == _SAYS_NOTHING
    return counts, silent


@inlined
def _explains(
    maps: tuple[Bytes, Bytes],
    x: float,
    y: float,
    angle: float,
    range_m: float,
    met: bool,
    slack: float,
    resolution: float,
) -> int:
    """Whether the map explains a beam from a point (x, y, in cells): _YES, _NO or _SAYS_NOTHING."""
    states, near = maps
    c = math.cos(angle)
    s = math.sin(angle)
    answer = _YES
    if met:
        row = int(math.floor(y + s * range_m / resolution))
        col = int(math.floor(x + c * range_m / resolution))
        if row < 0 or col < 0 or row >= near.shape[0] or col >= near.shape[1]:
            answer = _SAYS_NOTHING
        elif near[row, col] * NEAR_UNIT_M > slack:
            answer = _SAYS_NOTHING if states[row, col] == UNKNOWN else _NO
    most = max((range_m - slack) / resolution, 0.0)
    if answer != _NO:
        way, state = free_way(states, x, y, angle, most)
        if state == UNKNOWN and way < most:
            answer = _SAYS_NOTHING
        elif state == WALL and way < most:
            # A beam that grazes a wall, or passes close by an edge, is off by less than a body's
            # width.
            aside = _ASIDE_M / resolution
            left, left_state = free_way(states, x - s * aside, y + c * aside, angle, most)
            right, right_state = free_way(states, x + s * aside, y - c * aside, angle, most)
            if left_state == WALL and left < most and right_state == WALL and right < most:
                answer = _NO
    return answer


@kernel
def spot_scores(
    around: Bytes, low: Bytes, high: Bytes, least: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Positions and headings at which at least `least` directions agree with the scan.

    Returns indices of positions and headings, and the number of directions that agree.

    around (P, D): see Places; low, high (D,): limits of the measured range in each direction of the
    robot; 0 and 255 without a measurement. Of neighbouring headings at a position, the best ones
    are kept.
    """
    spots, directions = around.shape
    counts = np.empty(directions, dtype=np.int32)
    twice = np.empty(2 * directions, dtype=np.uint8)
    found = [(np.int32(0), np.int32(0), np.int32(0)) for _ in range(0)]
    for i in range(spots):
        twice[:directions] = around[i]
        twice[directions:] = around[i]
        for heading in range(directions):
            count = np.int32(0)
            for k in range(directions):
                value = twice[heading + k]
                count += np.int32((value >= low[k]) & (value <= high[k]))
            counts[heading] = count
        for heading in range(directions):
            count = counts[heading]
            before = counts[heading - 1]
            after = counts[(heading + 1) % directions]
            if count >= least and count >= before and count > after:
                found.append((np.int32(i), np.int32(heading), count))
    result = np.empty((3, len(found)), dtype=np.int32)
    for n in range(len(found)):
        result[0, n], result[1, n], result[2, n] = found[n]
    return result[0], result[1], result[2]


# A beam that one place explains and another does not: about 1 in log odds, but beams that miss come
# in groups.
LOG_ODDS_A_BEAM = 0.35

# A beam of which the map says nothing, counted in beams that it explains: what is unknown there may
# well be like that.
SILENT_COUNTS = 0.75

HEADING_NOISE_RAD = 0.01  # standard deviation of the heading of a correct hypothesis

# From afar to near: how wide a wall's pull is, 1 sigma, m, and the steps uphill, m and rad.
_PULLS: tuple[tuple[float, Array], ...] = (
    (0.30, np.array([[0.16, 0.06], [0.08, 0.03]])),
    (0.15, np.array([[0.08, 0.03], [0.04, 0.015]])),
)

_OUTLIERS = 0.1

# Beams are not independent of each other: neighbours meet the same wall, which the map has drawn
# once, and well or not.
_BEAMS_PER_OBSERVATION = 6.0

_NODES_PER_OBSERVATION = 2.0

_FINE_STEPS = np.array([[0.04, 0.015], [0.02, 0.0075]])

_ROUNDS = 6

_MIN_COVARIANCE = np.diag([0.02**2, 0.02**2, 0.01**2])


class Judge:
    """Compares poses with observations: binds the arrays of a map and the noise to the loops.

    Tolerances follow from the cells of the grid and the noise of the sensor.
    """

    def __init__(self, places: Places, config: GlobalLocalizationConfig, nodes: NodeModel) -> None:
        self._places = places
        self._nodes = nodes
        self._origin = (places.frame.origin_x, places.frame.origin_y)
        # A wall lies anywhere in its cell, and so does the end of a beam: uniform, twice.
        cells = places.frame.resolution / math.sqrt(6.0)
        sigma = math.sqrt(config.beam_noise_m**2 + config.map_noise_m**2 + cells**2)
        self.tolerance = (BOUND_SIGMAS * sigma, BOUND_SIGMAS * HEADING_NOISE_RAD)
        off = np.arange(256) * NEAR_UNIT_M / sigma
        bell = np.exp(-0.5 * off**2)
        self._log_table = np.log((1.0 - _OUTLIERS) * bell + _OUTLIERS) / _BEAMS_PER_OBSERVATION
        self._pulls = [(np.exp(-0.5 * (off * sigma / pull) ** 2), steps) for pull, steps in _PULLS]

    def log_likelihoods(self, poses: Array, seen: Observation) -> Array:
        """Log likelihood of beams and nodes at poses (N, 3), up to a constant, (N,)."""
        ends = seen.ends[seen.met]
        near = self._places.near
        resolution = self._places.frame.resolution
        scores = range_scores(poses, ends, near, self._origin, resolution, self._log_table)
        return np.asarray(scores + self.node_log_ratios(poses, seen))

    def node_log_ratios(self, poses: Array, seen: Observation) -> Array:
        """Log likelihood ratio (N,) of observed nodes at poses (N, 3), against a pose anywhere."""
        places = self._places
        model = self._nodes
        ratios = node_scores(
            poses,
            seen.nodes,
            seen.node_kinds,
            (places.blocks, places.first, places.in_sight),
            self._origin,
            places.block_cells * places.frame.resolution,
            model.found,
            model.spread_m,
            model.gain,
        )
        return np.asarray(ratios / _NODES_PER_OBSERVATION)

    def refined(
        self,
        poses: Array,
        seen: Observation,
        covariances: Array | None = None,
        others: Array | None = None,
    ) -> Array:
        """Poses (N, 3) moved to where the beams fit best near by.

        covariances (N, 3, 3): how far that may be.

        Once straight from where they are, once from where they fit when walls pull from far, and,
        where others (N, 3) are given, once from there: whichever fits better.
        """
        free = np.zeros((len(poses), 3, 3))
        held: Array = free
        if covariances is not None:
            held = np.asarray(np.linalg.inv(covariances + _MIN_COVARIANCE))
        near, near_score = self._uphill(poses, seen, self._log_table, _FINE_STEPS, poses, held)
        far = poses
        for table, steps in self._pulls:
            far, _ = self._uphill(far, seen, table, steps, poses, free)
        far, far_score = self._uphill(far, seen, self._log_table, _FINE_STEPS, poses, held)
        best = np.where((far_score > near_score)[:, None], far, near)
        score = np.maximum(far_score, near_score)
        if others is not None:
            other, other_score = self._uphill(
                others, seen, self._log_table, _FINE_STEPS, poses, held
            )
            best = np.where((other_score > score)[:, None], other, best)
        return best

    def unblocked(self, poses: Array, seen: Observation, others: Array) -> Array:
        """Poses (N, 3), or what of others (N, K, 3) explains more where they leave beams out.

        Ends of beams alone do not tell how far along a corridor a robot is that looks through a
        door: from beside the door, they end on walls just as well, but on their way they would have
        to pass one.
        """
        left = np.flatnonzero(self._left_out(poses, seen) > 0.0)
        if not len(left):
            return poses
        tried = np.concatenate([poses[left, None], others[left]], axis=1)
        flat = tried.reshape(-1, 3)
        worth = self.log_likelihoods(flat, seen) - LOG_ODDS_A_BEAM * self._left_out(flat, seen)
        best = worth.reshape(len(left), -1).argmax(axis=1)
        result = poses.copy()
        result[left] = tried[np.arange(len(left)), best]
        return result

    def _left_out(self, poses: Array, seen: Observation) -> Array:
        """How many beams the map does not explain from poses (N, 3), (N,)."""
        counts, silent = self.explained(poses, seen)
        return np.asarray(len(seen.ranges_m) - counts - SILENT_COUNTS * silent)

    def _uphill(
        self,
        poses: Array,
        seen: Observation,
        table: Array,
        steps: Array,
        expected: Array,
        held: Array,
    ) -> tuple[Array, Array]:
        near = self._places.near
        resolution = self._places.frame.resolution
        ends = seen.ends[seen.met]
        return refine(
            poses, ends, near, self._origin, resolution, table, steps, _ROUNDS, expected, held
        )

    def explained(self, poses: Array, seen: Observation) -> tuple[Array, Array]:
        """How many beams the map explains from poses (N, 3), and is silent on, (N,) each."""
        places = self._places
        return explained(
            poses,
            seen.laser,
            seen.ranges_m,
            seen.bearings_rad,
            seen.met,
            (places.states, places.near),
            self._origin,
            places.frame.resolution,
            self.tolerance,
        )
