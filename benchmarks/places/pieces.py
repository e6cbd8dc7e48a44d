"""Pieces of map: recorded from logs and explorations, in files, their pairs and true errors."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.worlds import floor
from thinmap_ros.closed_loop.loop import make_loop, no_progress
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.topology.graph import TopologicalMap, flat_topology, topology_from_msg
from thinmap_ros.logs.reading import open_log, paired_scans
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.coverage import ObservableCells

_GRAPH = 'graph_'


@dataclass(frozen=True, eq=False)
class RecordedPiece:
    """A piece of map, and the true poses (N, 3) of its keyframes; NaN where they are unknown."""

    name: str
    frames: list[Keyframe]
    edges: list[Edge]
    patch: GridPatch
    graph: TopologicalMap
    truth: Array

    @property
    def building(self) -> str:
        """Name of the building: that of the piece without its part."""
        return self.name.rpartition('.')[0]

    @property
    def poses(self) -> Array:
        """Poses (N, 3) of the keyframes."""
        return np.array([frame.T_map_base for frame in self.frames])

    def save(self, folder: Path) -> None:
        """Write FOLDER/NAME.npz."""
        arrays = {
            **_scan_arrays([frame.scan for frame in self.frames]),
            'poses': self.poses,
            'path_m': np.array([frame.path_m for frame in self.frames]),
            'truth': self.truth,
            'edge_ends': np.array([(edge.a, edge.b) for edge in self.edges]),
            'edge_poses': np.array([edge.T_a_b for edge in self.edges]),
            'edge_information': np.array([edge.information for edge in self.edges]),
            'edge_robust': np.array([edge.robust for edge in self.edges]),
            'cells': self.patch.cells,
            'frame': self.patch.frame.as_array(),
            **{_GRAPH + name: values for name, values in flat_topology(self.graph).items()},
        }
        folder.mkdir(parents=True, exist_ok=True)
        aside = folder / f'.{self.name}.npz'
        with aside.open('wb') as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        aside.rename(folder / f'{self.name}.npz')

    @staticmethod
    def load(folder: Path, name: str) -> 'RecordedPiece':
        """Read FOLDER/NAME.npz."""
        with np.load(folder / f'{name}.npz') as arrays:
            return _of(name, {key: arrays[key] for key in arrays.files})


def _of(name: str, arrays: dict[str, NDArray[Any]]) -> RecordedPiece:
    frames = [
        Keyframe(scan, surface_points(scan), T, float(path_m), np.zeros((3, 3)), 0)
        for scan, T, path_m in zip(_scans(arrays), arrays['poses'], arrays['path_m'], strict=True)
    ]
    edges = [
        Edge(int(a), int(b), T, information, bool(robust))
        for (a, b), T, information, robust in zip(
            arrays['edge_ends'],
            arrays['edge_poses'],
            arrays['edge_information'],
            arrays['edge_robust'],
            strict=True,
        )
    ]
    patch = GridPatch(GridFrame(*arrays['frame'].tolist()), arrays['cells'])
    flat = {
        key.removeprefix(_GRAPH): values for key, values in arrays.items() if key.startswith(_GRAPH)
    }
    graph = topology_from_msg(SimpleNamespace(**flat))
    return RecordedPiece(name, frames, edges, patch, graph, arrays['truth'])


def _scan_arrays(scans: Sequence[Scan]) -> dict[str, NDArray[Any]]:
    first = scans[0]
    limits = (first.angle_min_rad, first.angle_increment_rad, first.range_min_m, first.range_max_m)
    return {
        'stamps_ns': np.array([scan.stamp_ns for scan in scans]),
        'ranges_m': np.array([scan.ranges_m for scan in scans], dtype=np.float32),
        'T_base_laser': np.array([scan.T_base_laser for scan in scans]),
        'limits': np.array(limits),
    }


def _scans(arrays: dict[str, NDArray[Any]]) -> list[Scan]:
    first, step, low, high = arrays['limits'].tolist()
    return [
        Scan.create(int(stamp_ns), ranges_m, first, step, low, high, T_base_laser)
        for stamp_ns, ranges_m, T_base_laser in zip(
            arrays['stamps_ns'], arrays['ranges_m'], arrays['T_base_laser'], strict=True
        )
    ]


_NEAR_M = 2.0  # of a keyframe of one piece from the nearest one of the other


def relative_errors(
    known: RecordedPiece, query: RecordedPiece, known_poses: Array, query_poses: Array
) -> Array:
    """Errors (N,), m, of the poses of keyframes of the query relative to the nearest known ones.

    known_poses (K, 3), query_poses (Q, 3): of all keyframes, in one frame. Of keyframes that
    are near each other by the truth.
    """
    errors = []
    for k, T_true in enumerate(query.truth):
        away = np.hypot(*(known.truth[:, :2] - T_true[:2]).T)
        if np.isnan(away).all():
            continue
        j = int(np.nanargmin(away))
        if away[j] > _NEAR_M:
            continue
        want = se2.between(known.truth[j], T_true)
        off = se2.between(want, se2.between(known_poses[j], query_poses[k]))
        errors.append(float(np.hypot(off[0], off[1])))
    return np.array(errors)


def rigid_errors(known: RecordedPiece, query: RecordedPiece, T_known_query: Array) -> Array:
    """Errors (N,), m, as `relative_errors`, with the query at a pose (3,)."""
    moved = np.array([se2.compose(T_known_query, T) for T in query.poses])
    return relative_errors(known, query, known.poses, moved)


def true_pose(known: RecordedPiece, T_true: Array) -> tuple[Array, float]:
    """A true pose (3,) in the frame of a piece, by its nearest keyframe, and the distance, m."""
    away = np.hypot(*(known.truth[:, :2] - T_true[:2]).T)
    j = int(np.nanargmin(away))
    return se2.compose(known.poses[j], se2.between(known.truth[j], T_true)), float(away[j])


_SPEED_M_S = 0.5
_SCANS_PER_GRAPH = 10  # of logs
_NO_GOAL = ObservableCells(np.zeros((0, 0), dtype=np.bool_), GridFrame(0.0, 0.0, 0.1))
HALVES = ('a', 'b')


def make_halves(logs: Path, name: str, folder: Path) -> None:
    """Make the pieces NAME.a and NAME.b of the halves of a log.

    The truth is the trajectory of the whole log after all corrections, where the robot is in the
    published map.
    """
    if all((folder / f'{name}.{half}.npz').exists() for half in HALVES):
        return
    paths = (logs / name / 'log.clf.gz', logs / name / 'log.clf')
    pairs = list(paired_scans(open_log(next(path for path in paths if path.exists()))))
    _, truth = _mapped(pairs)
    middle = len(pairs) // 2
    for half, some in zip(HALVES, (pairs[:middle], pairs[middle:]), strict=True):
        pipeline, _ = _mapped(some)
        _recorded(f'{name}.{half}', pipeline, truth).save(folder)


def make_exploration(worlds: Path, name: str, start: int, folder: Path, limit_s: float) -> None:
    """Make the piece NAME.sSTART of an exploration from a start of a world, for so many seconds.

    With SLAM, from an origin of its own.
    """
    piece = f'{name.replace("/", "_")}.s{start}'
    if (folder / f'{piece}.npz').exists():
        return
    there = floor(name, worlds)
    options = Options(strategy='nearest_frontier', seed=start, speed_m_s=_SPEED_M_S)
    loop = make_loop(there.world, [there.starts[start]], options)
    (robot,) = loop.robots
    pipeline = Pipeline(replace(robot.pipeline.config, localizer=LocalizerConfig()))
    robot.pipeline = pipeline
    loop.run(_NO_GOAL, limit_s, no_progress, scans_per_show=10**9)
    pipeline.localizer.optimized_trajectory()
    truth = dict(zip(robot.log.stamps_ns, robot.log.true_poses, strict=True))
    _recorded(piece, pipeline, truth).save(folder)


def _mapped(pairs: Iterable[tuple[Scan, Array]]) -> tuple[Pipeline, dict[int, Array]]:
    """Map scans with their odometry; returns the corrected poses (3,) by stamp, too."""
    pipeline = Pipeline(PipelineConfig(grid=PAPER_GRID, scans_per_graph=_SCANS_PER_GRAPH))
    stamps = []
    for scan, T_odom_base in pairs:
        estimate = pipeline.step(scan, T_odom_base).estimate
        stamps.append(None if estimate.is_mapping_apart else scan.stamp_ns)
    pipeline.finish()
    poses = pipeline.localizer.optimized_trajectory()
    return pipeline, {s: T for s, T in zip(stamps, poses, strict=True) if s is not None}


def _recorded(name: str, pipeline: Pipeline, truth: dict[int, Array]) -> RecordedPiece:
    localizer = pipeline.localizer
    assert isinstance(localizer, Localizer)
    frames = localizer.keyframes
    unknown = np.full(3, np.nan)
    poses = np.array([truth.get(frame.scan.stamp_ns, unknown) for frame in frames])
    return RecordedPiece(
        name,
        frames,
        localizer.edges,
        pipeline.grid.known_area(),
        pipeline.topology.map,
        poses,
    )


LOGS = ('fhw', 'intel_raw', 'aces_raw', 'csail_raw')
EXPLORATIONS = (
    ('kth/50052748', 0),
    ('kth/50052748', 1),
    ('kth/50052748', 9),
    ('kth/50052751', 0),
    ('kth/50052751', 1),
    ('kth/50052749', 0),
    ('kth/50052749', 1),
    ('kth/50037764_PLAN1', 0),
    ('kth/50037764_PLAN1', 6),
    ('dungeon/d1115', 0),
    ('dungeon/d1115', 1),
    ('dungeon/d114', 0),
    ('dungeon/d1305', 0),
    ('dungeon/d1336', 0),
    ('dungeon/d1407', 0),
)
_EXPLORATION_S = 500.0
_APART_M = 8.0  # range of the simulated laser
_MIN_SHARED = 30  # keyframes: 20 m of path, which recognition needs
Pairs = list[tuple[RecordedPiece, RecordedPiece]]


def recorded(folder: Path, data: Path, count: int | None) -> list[RecordedPiece]:
    """All pieces, made where a folder does not have them; count: of logs and of explorations."""
    for name in LOGS[:count]:
        make_halves(data / 'logs', name, folder)
    for name, start in EXPLORATIONS[:count]:
        make_exploration(data / 'worlds', name, start, folder, _EXPLORATION_S)
    names = [f'{name}.{half}' for name in LOGS[:count] for half in HALVES]
    names += [f'{name.replace("/", "_")}.s{start}' for name, start in EXPLORATIONS[:count]]
    return [RecordedPiece.load(folder, name) for name in names]


def with_shared_ground(pieces: Iterable[RecordedPiece]) -> Pairs:
    """Ordered pairs that share enough ground."""
    return [pair for pair in _ordered(pieces) if is_shared(*pair)]


def without_shared_ground(pieces: Iterable[RecordedPiece]) -> Pairs:
    """Ordered pairs of two buildings, or of two parts of one that are not in sight."""
    return [pair for pair in _ordered(pieces) if not _count_near(*pair, _APART_M)]


def is_shared(known: RecordedPiece, query: RecordedPiece) -> bool:
    """Whether two pieces share enough ground, by the truth."""
    return _count_near(known, query, _NEAR_M) >= _MIN_SHARED


def _count_near(known: RecordedPiece, query: RecordedPiece, near_m: float) -> int:
    """Keyframes of the query that are near one of the known piece, by the truth."""
    if known.building != query.building:
        return 0
    places = [piece.truth[~np.isnan(piece.truth[:, 0]), :2] for piece in (known, query)]
    away, _ = cKDTree(places[0]).query(places[1])
    return int(np.count_nonzero(away < near_m))


def _ordered(pieces: Iterable[RecordedPiece]) -> Pairs:
    known = list(pieces)
    return [(one, other) for one in known for other in known if one is not other]
