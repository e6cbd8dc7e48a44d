"""Regions of generated buildings against the parts and doors that these were made of.

`python -m benchmarks.regions 100-119` on perfect maps; with `--slam` on maps by SLAM of drives of
some 250 m, of which only the parts and doors that the map shows count.
"""

import argparse
import math
import time
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from benchmarks.buildings import Building, Wing, generate_building
from benchmarks.floor_plan import FloorPart, FloorPlan, Kind
from benchmarks.scoreboard.drives import samples
from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.topology.regions import RegionMap
from thinmap_ros.core.topology.segmentation import RegionTracker, find_regions
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.drives import DriveSample, world_to_grid
from thinmap_ros.sim.world import World

_DOOR_M = 0.5  # distance up to which a door is found
_SEEN_M2 = 4.0  # of a part, from which it counts
_PERIOD_SCANS = 10  # between updates of the regions
_ROBOT = '2dx'


@dataclass(frozen=True, eq=False)
class Truth:
    """Parts of a building: part (H, W) of each cell from 1, 0 for none; kinds; doors (N, 2), m.

    asked (N,): which doors have to be found.
    """

    labels: NDArray[np.int32]
    kinds: list[str]
    doors: Array
    asked: NDArray[np.bool_]


@dataclass(frozen=True)
class Score:
    """What was found of the parts and doors of one building; iou and kind: shares of the area."""

    iou: float
    kind: float
    parts: int
    regions: int
    doors_asked: int
    doors_found: int
    doors: int
    doors_right: int
    seconds: float
    ids_asked: int = 0
    ids_kept: int = 0


def truth_of(made: Building) -> Truth:
    """Parts of a building; corridors that open into each other are one part, in one wing or two."""
    labels = np.zeros(made.world.occupied.shape, dtype=np.int32)
    kinds: list[str] = []
    doors = []
    for wing in made.wings:
        numbers: dict[int, int] = {}
        for part, group in zip(wing.plan.parts, _groups(wing.plan), strict=True):
            if group not in numbers:
                kinds.append(part.kind.value)
                numbers[group] = len(kinds)
            labels[tuple(_free_cells_of(part, wing, made.world).T)] = numbers[group]
        middles = [(0.5 * (d.x0 + d.x1), 0.5 * (d.y0 + d.y1)) for d in wing.plan.doors]
        doors.append(se2.transform_points(wing.T_world_wing, np.array(middles).reshape(-1, 2)))
    places = np.concatenate(doors)
    labels, kinds = _linked(made, labels, kinds)
    return Truth(labels, kinds, places, np.ones(len(places), dtype=np.bool_))


def _linked(
    made: Building, labels: NDArray[np.int32], kinds: list[str]
) -> tuple[NDArray[np.int32], list[str]]:
    """Labels (H, W) and kinds of the parts, with corridors that links join as one part."""
    group = np.arange(len(kinds) + 1)
    for link in made.links:
        row, col = made.world.frame.cells_of(np.stack([link.a, link.b])).T
        low, high = sorted(labels[row, col].tolist())
        if low and kinds[low - 1] == kinds[high - 1] == Kind.CORRIDOR.value:
            group[group == group[high]] = group[low]
    left, numbers = np.unique(group, return_inverse=True)
    return numbers[labels].astype(np.int32), [kinds[number - 1] for number in left[1:]]


def _free_cells_of(part: FloorPart, wing: Wing, world: World) -> NDArray[np.int64]:
    """Free cells (N, 2) of the world whose centres lie in a part of a wing."""
    corners = np.array([(x, y) for x in (part.x0, part.x1) for y in (part.y0, part.y1)])
    around = world.frame.cells_of(se2.transform_points(wing.T_world_wing, corners))
    low = (around.min(axis=0) - 1).clip(0)
    high = around.max(axis=0) + 2
    free = world.occupied[low[0] : high[0], low[1] : high[1]] == 0
    cells = np.argwhere(free) + low
    centres = world.frame.centres_of(cells)
    own = se2.transform_points(se2.invert(wing.T_world_wing), centres)
    inside = (own >= (part.x0, part.y0)) & (own < (part.x1, part.y1))
    return np.asarray(cells[inside.all(axis=1)])


def _groups(plan: FloorPlan) -> list[int]:
    """Lowest part that each part is joined to by passages: corridors that open into corridors."""
    group = list(range(len(plan.parts)))
    for passage in plan.passages:
        low, high = sorted((group[passage.a], group[passage.b]))
        group = [low if number == high else number for number in group]
    return group


def seen_truth(truth: Truth, frame: GridFrame, patch: GridPatch) -> Truth:
    """The parts on the cells of a map, those that it shows, and the doors that it shows open."""
    cells = np.argwhere(patch.free)
    at = frame.cells_of(patch.frame.centres_of(cells))
    inside = ((at >= 0) & (at < truth.labels.shape)).all(axis=1)
    labels = np.zeros(patch.shape, dtype=np.int32)
    labels[tuple(cells[inside].T)] = truth.labels[tuple(at[inside].T)]
    shown = np.bincount(labels.ravel(), minlength=len(truth.kinds) + 1)
    is_seen = shown * patch.frame.resolution**2 >= _SEEN_M2
    is_seen[0] = False
    numbers = np.where(is_seen, np.cumsum(is_seen), 0).astype(np.int32)
    kinds = [kind for kind, seen in zip(truth.kinds, is_seen[1:], strict=True) if seen]
    asked = np.array([_is_shown(patch, numbers[labels], door) for door in truth.doors], dtype=bool)
    return Truth(numbers[labels], kinds, truth.doors, asked)


def _is_shown(patch: GridPatch, labels: NDArray[np.int32], door: Array) -> bool:
    """Whether a map shows a free way through a door (2,), and free parts on both sides."""
    row, col = patch.frame.cells_of(door[None])[0]
    reach = math.ceil(_DOOR_M / patch.frame.resolution)
    if row < reach or col < reach:
        return False
    near = labels[row - reach : row + reach + 1, col - reach : col + reach + 1]
    counts = np.bincount(near.ravel())
    counts[:1] = 0
    return bool((counts > 0.1 * near.size).sum() >= 2)


def score(found: RegionMap, patch: GridPatch, truth: Truth, seconds: float) -> Score:
    """Compare regions with parts on the same cells: one to one, by the largest sum of IoU."""
    ids = np.array([0, *found.regions])
    numbers = np.searchsorted(np.sort(ids), np.where(patch.free, found.labels, 0))
    shape = (len(truth.kinds) + 1, len(ids))
    both = np.bincount(
        np.ravel_multi_index((truth.labels.ravel(), numbers.ravel()), shape),
        minlength=shape[0] * shape[1],
    ).reshape(shape)
    areas = both[1:].sum(axis=1)
    inter = both[1:, 1:]
    iou = inter / np.maximum(areas[:, None] + both[1:, 1:].sum(axis=0) - inter, 1)
    rows, cols = linear_sum_assignment(-iou)
    matched = np.zeros(len(areas))
    matched[rows] = iou[rows, cols]
    kinds = [found.regions[int(i)].kind.name.lower() for i in np.sort(ids)[1:]]
    right = [
        bool(kinds) and kinds[int(row.argmax())] == kind
        for row, kind in zip(iou, truth.kinds, strict=True)
    ]
    total = max(int(areas.sum()), 1)
    doors = np.array([(door.x, door.y) for door in found.doors]).reshape(-1, 2)
    return Score(
        float((matched * areas).sum() / total),
        float((np.array(right) * areas).sum() / total),
        len(truth.kinds),
        len(found.regions),
        int(truth.asked.sum()),
        _hits(doors, truth.doors[truth.asked]),
        len(doors),
        _hits(doors, truth.doors),
        seconds,
    )


def _hits(found: Array, true: Array) -> int:
    """Number of pairs of doors (N, 2), (M, 2) within _DOOR_M."""
    if not len(found) or not len(true):
        return 0
    away = np.hypot(*np.moveaxis(found[:, None] - true[None], 2, 0))
    rows, cols = linear_sum_assignment(np.minimum(away, 10.0))
    return int((away[rows, cols] <= _DOOR_M).sum())


def perfect(seed: int) -> Score:
    """Regions of the complete map of a building."""
    made = generate_building(seed)
    patch = world_to_grid(made.world)
    began = time.process_time()
    found = find_regions(patch)
    return score(found, patch, truth_of(made), time.process_time() - began)


def by_slam(seed: int) -> Score:
    """Regions of the map at the end of a drive; and ids from half of the drive on."""
    made = generate_building(seed)
    patches = _maps(list(samples(seed, _ROBOT, 1.0)))
    tracker = RegionTracker()
    found = []
    longest_s = 0.0
    for patch in patches:
        began = time.process_time()
        found.append(tracker.update(patch))
        longest_s = max(longest_s, time.process_time() - began)
    truth = seen_truth(truth_of(made), made.world.frame, patches[-1])
    half = found[len(found) // 2]
    kept = sum(_overlap_id(half, number, found[-1]) == number for number in half.regions)
    own = score(found[-1], patches[-1], truth, longest_s)
    return replace(own, ids_asked=len(half.regions), ids_kept=kept)


def _maps(drive: list[DriveSample]) -> list[GridPatch]:
    """Maps by SLAM along a drive, every _PERIOD_SCANS scans, and at its end."""
    x, y, yaw = drive[0].T_world_base.tolist()
    localizer = LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)
    config = PipelineConfig(localizer, OccupancyConfig(), scans_per_graph=len(drive))
    pipeline = Pipeline(config)
    patches = []
    for number, sample in enumerate(drive):
        pipeline.step(sample.scan, sample.T_odom_base)
        if number % _PERIOD_SCANS == 0:
            patches.append(pipeline.grid.known_area())
    pipeline.finish()
    return [*patches, pipeline.grid.known_area()]


def _overlap_id(before: RegionMap, number: int, after: RegionMap) -> int:
    """Id of the region that overlaps an earlier one most; 0 for none."""
    points = before.frame.centres_of(np.argwhere(before.labels == number))
    cells = np.bincount(after.ids_at(points), minlength=2)
    cells[0] = 0
    return int(cells.argmax())


def main() -> None:
    """Print the figures of each building, and of all together."""
    parser = argparse.ArgumentParser(prog='regions', description=__doc__)
    parser.add_argument('seeds', help='FIRST-LAST')
    parser.add_argument('--slam', action='store_true', help='maps by SLAM')
    arguments = parser.parse_args()
    first, last = (int(word) for word in arguments.seeds.split('-'))
    scores = []
    for seed in range(first, last + 1):
        scores.append(by_slam(seed) if arguments.slam else perfect(seed))
        print(seed, {name: round(value, 3) for name, value in asdict(scores[-1]).items()})
    sums = {name: sum(getattr(s, name) for s in scores) for name in asdict(scores[0])}
    print(f'IoU by area {sums["iou"] / len(scores):.3f}, kind {sums["kind"] / len(scores):.3f}')
    print(f'doors found {sums["doors_found"] / max(sums["doors_asked"], 1):.3f}')
    print(f'doors right {sums["doors_right"] / max(sums["doors"], 1):.3f}')
    if arguments.slam:
        print(f'ids kept {sums["ids_kept"] / max(sums["ids_asked"], 1):.3f}')


if __name__ == '__main__':
    main()
