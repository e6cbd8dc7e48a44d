"""Kernels that are compiled before they are needed, with progress and within memory.

Each algorithm warms up in a small room, so that its kernels are loaded before the first step: a
node does so before it subscribes. Otherwise a robot loses its first seconds, and a simulation
faster than real time many more. Each warm-up imports its own modules only, so that a node does not
load the kernels of others, and is done once in a process.
"""

import ctypes
import gc
import math
import mmap
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.core import event
from numba.core.codegen import CPUCodeLibrary, ll
from numba.core.compiler_lock import global_compiler_lock
from numpy.typing import NDArray

from thinmap_ros import jit
from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import cache as kernel_cache

_WORTH_BYTES = 4e6
_REPORT_PERIOD_S = 5.0
# 184 kernels took 115 s on one core of 2026. The time that they take here counts for more once
# there are as many.
_USUAL_S = 0.63
_USUAL_KERNELS = 20


def compiler_memory_releaser(period_s: float = 3.0) -> Callable[[], None]:
    """Return a function that releases the pages of the compiler, to be called repeatedly.

    Kernels that are loaded later, with the first message, load the compiler again.
    """
    looked_at = time.monotonic()
    least = _shared_bytes()

    def look() -> None:
        nonlocal looked_at, least
        if time.monotonic() - looked_at > period_s:
            if _shared_bytes() > least + _WORTH_BYTES:
                release_compiler_pages()
                least = _shared_bytes()
            looked_at = time.monotonic()

    return look


def _shared_bytes() -> int:
    """File-backed memory of the process, such as libraries; 0 without /proc."""
    try:
        return int(Path('/proc/self/statm').read_text().split()[2]) * mmap.PAGESIZE
    except OSError:  # no /proc, or no further file may be opened now
        return 0


def release_free_pages() -> None:
    """Return what was freed to the system, which the allocator would keep; where it can."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, 'malloc_trim'):
        libc.malloc_trim(0)


def release_compiler_pages() -> None:
    """Release the memory pages of the kernel compiler.

    Its library, some 100 MB, is idle once all kernels are loaded. Only unmodified mappings are
    released: the system reads them again from the library when needed. Without /proc, nothing of
    it is.
    """
    gc.collect()
    _pack_modules()
    try:
        smaps = Path('/proc/self/smaps').read_text()
    except OSError:
        return
    release_free_pages()
    libc = ctypes.CDLL(None)
    for first, last in _clean_mappings(smaps, 'llvmlite'):
        libc.madvise(ctypes.c_void_p(first), ctypes.c_size_t(last - first), mmap.MADV_DONTNEED)


def _pack_modules() -> None:
    """Keep the modules of loaded kernels as bitcode, which needs a sixth of their memory.

    They serve only for a kernel that is compiled later and calls one of these.
    """
    with global_compiler_lock:
        for library in gc.get_objects():
            if issubclass(type(library), CPUCodeLibrary) and library._shared_module is not None:
                bitcode = library._shared_module.as_bitcode()
                library._shared_module = None
                library._get_module_for_linking = partial(ll.parse_bitcode, bitcode)


def _clean_mappings(smaps: str, name: str) -> Iterator[tuple[int, int]]:
    """Address ranges of the unmodified mappings of a file."""
    header = ''
    for line in smaps.splitlines():
        key = line.split(maxsplit=1)[0]
        if not key.endswith(':'):
            header = line
        elif key == 'Anonymous:' and name in header and int(line.split()[1]) == 0:
            first, last = header.split(maxsplit=1)[0].split('-')
            yield int(first, 16), int(last, 16)


class CompilationReport(event.Listener):
    """Reports on stderr how long kernels are compiled: it delays the first start of a program.

    Which of them the program needs is not known: all that there are is the most.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._loaded = 0  # kernels that were there before the first compilation
        self._seconds = 0.0
        self._began_at = 0.0
        self._told_at = -_REPORT_PERIOD_S

    def on_start(self, event: Any) -> None:
        """Handle the start of a compilation, possibly nested in another one."""
        now = time.monotonic()
        if self._depth == 0:
            self._began_at = now
        self._depth += 1
        if now - self._told_at >= _REPORT_PERIOD_S:
            self._told_at = now
            # Kernels that are compiled for further types count once.
            there = sum(1 for kernel in jit.KERNELS if kernel.signatures)
            seconds = self._seconds + now - self._began_at
            if not seconds:
                self._loaded = there
            _tell(progress_text(there, there - self._loaded, seconds))

    def on_end(self, event: Any) -> None:
        """Handle the end of a compilation."""
        self._depth -= 1
        if self._depth == 0:
            self._seconds += time.monotonic() - self._began_at

    def end(self) -> None:
        """Report duration and cache folder, if any kernels were compiled."""
        if self._seconds:
            kept = kernel_cache.folder()
            where = f'cached in {kept}' if kept else 'not cached'
            _tell(f'kernels compiled in {self._seconds:.0f} s, {where}')
            self._seconds = 0.0


def progress_text(there: int, compiled: int, seconds: float) -> str:
    """How many kernels are there, and how long all others take, for a line of progress.

    compiled: how many of them took some seconds here; the others were in the cache.
    """
    most = max(jit.declared_kernels(), len(jit.KERNELS))
    each_s = (_USUAL_S * _USUAL_KERNELS + seconds) / (_USUAL_KERNELS + compiled)
    left_s = 5 * math.ceil(each_s * (most - there) / 5.0)
    return (
        f'compiling kernels, once: {there} of at most {most}, about {left_s} s left if all are '
        'needed'
    )


@cache
def report_compilation() -> CompilationReport:
    """Report compilation until the process ends; called again, it is the same report."""
    report = CompilationReport()
    event.register('numba:compile', report)
    return report


def _tell(what: str) -> None:
    print(f'thinmap: {what}', file=sys.stderr, flush=True)


if TYPE_CHECKING:
    from thinmap_ros.core.topology.graph import TopologicalMap


@dataclass(frozen=True)
class _Rehearsal:
    """The room and the drive through it.

    room_cells, closet_cells: sides of a room and a closet. passage: rows of the passage to unknown
    space. range_m, beams: of the laser, which sees 180 degrees. scans: number, one each period_s.
    step_m, turn_rad: motion between two scans.
    """

    cell_m: float
    room_cells: int
    closet_cells: int
    passage: slice
    range_m: float
    beams: int
    scans: int
    period_s: float
    step_m: float
    turn_rad: float

    @property
    def beam_angles(self) -> Array:
        """Angles of the beams in the laser frame, rad (N,)."""
        return self.beam_step_rad * np.arange(self.beams, dtype=np.float64) - np.pi / 2.0

    @property
    def beam_step_rad(self) -> float:
        """Angle between two beams, rad."""
        return float(np.radians(180.0 / (self.beams - 1)))

    def stamp_ns(self, number: int) -> int:
        """Stamp of a scan."""
        return round(1e9 * self.period_s * number)


_REHEARSAL = _Rehearsal(
    cell_m=0.1,
    room_cells=80,
    closet_cells=16,
    passage=slice(30, 50),
    range_m=8.0,
    beams=181,
    scans=12,
    period_s=0.2,
    step_m=0.12,
    turn_rad=0.11,
)


@cache
def localizer() -> None:
    """Warm up localization."""
    from thinmap_ros.core.slam.graph.keyframes import Start, covariances_from
    from thinmap_ros.core.slam.graph.pose_graph import Edge, optimized
    from thinmap_ros.core.slam.graph.tables import EdgeTable
    from thinmap_ros.core.slam.localizer import Localizer
    from thinmap_ros.core.slam.odometry import OdometryCalibration

    _sense()
    _check_laser()
    rehearsed = Localizer()
    for scan, T_map_base in _drive():
        rehearsed.step(scan, T_map_base)
    # Also the search for a scan without a match, walls without returns, and the start from a loaded
    # map.
    rehearsed.step(_odd_scan(), T_map_base)
    rehearsed.step(_scan(_REHEARSAL.scans + 1, np.full(_REHEARSAL.beams, np.inf)), T_map_base)
    Localizer.from_state(rehearsed.state())
    Localizer.in_occupancy_map(_room())
    # A revisit needs covariances along the graph, and a loop its optimization.
    step = Edge(0, 1, np.zeros(3), np.eye(3), False)
    covariances_from(Start(0), np.zeros((2, 3)), [EdgeTable([step])], np.ones((2, 6)))
    optimized(np.zeros((2, 3)), [step])
    OdometryCalibration().smoothed()
    topology_builder()
    _recognize()


@cache
def ekf_localizer() -> None:
    """Warm up localization by line features."""
    from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig, EkfLocalizer

    _sense()
    _check_laser()
    rehearsed = EkfLocalizer(EkfConfig())
    for scan, T_map_base in _drive():
        rehearsed.step(scan, T_map_base)
    EkfLocalizer.from_state(rehearsed.state(), EkfConfig())


@cache
def map_joiner() -> None:
    """Warm up recognition between maps, and merging."""
    from thinmap_ros.core.slam.joining.join import refined
    from thinmap_ros.core.slam.joining.team import RobotMap, merged

    topology_builder()
    _recognize()
    room = RobotMap(_room())
    refined(room.piece, room.piece, np.zeros(3))
    merged({'a': room, 'b': room}, {'a': np.zeros(3), 'b': np.full(3, 0.1)}, None)


def _recognize() -> None:
    """Warm up place recognition: a room is looked for in itself."""
    from thinmap_ros.core.places.piece import MapPiece
    from thinmap_ros.core.places.recognition import Recognition, log_odds_back
    from thinmap_ros.core.slam.graph.keyframes import Keyframe
    from thinmap_ros.core.slam.matching.surface import surface_points
    from thinmap_ros.core.topology.graph import Node, NodeKind, TopologicalMap

    frames = [
        Keyframe(scan, surface_points(scan), T_map_base, 0.0, np.zeros((3, 3)), submap=0)
        for scan, T_map_base in _drive()
    ]
    places = ((1.0, 1.0), (3.0, 1.0), (2.0, 3.0))
    nodes = [Node(i, NodeKind.BRANCH, x, y, 0.8) for i, (x, y) in enumerate(places, 1)]
    room = MapPiece(frames, _room(), TopologicalMap(nodes, []))
    recognition = Recognition(room)
    for _ in range(2):  # the second one is judged by the hypothesis of the first
        for view in room.views:
            recognition.add(view, room.landmarks.around(view))
    for hypothesis in recognition.hypotheses:
        log_odds_back(room, room, recognition.views, hypothesis)


def _sense() -> None:
    """Warm up the correction for motion within a scan, and the search for dropouts."""
    from dataclasses import replace

    from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer

    pairing = ScanOdometrySynchronizer()
    beam_s = _REHEARSAL.period_s * _REHEARSAL.beam_step_rad / (2.0 * np.pi)
    for scan, T_map_base in _drive():
        pairing.add_odometry(scan.stamp_ns, T_map_base)
        pairing.add_scan(replace(scan, beam_period_s=beam_s))


def _check_laser() -> None:
    """Warm up the comparison of a laser's motion with that of the odometry."""
    from thinmap_ros.core.sensing.consistency import (
        MountErrorConfig,
        MountErrorEstimator,
        TurnComparison,
    )

    mount = MountErrorEstimator(MountErrorConfig(span_m=0.0, windows=(1, 2)))
    turns = TurnComparison()
    for scan, T_map_base in _drive():
        mount.add(T_map_base, np.eye(3), T_map_base, scan.T_base_laser)
        turns.add(scan, T_map_base)
    mount.estimates(scan.T_base_laser)


@cache
def grid_mapper() -> None:
    """Warm up the map update, its windows, keyframes of a loaded session, and keep-out masks."""
    from thinmap_ros.core.grid.occupancy import OccupancyGrid, WindowConfig
    from thinmap_ros.core.slam.matching.surface import surface_points
    from thinmap_ros.core.topology.segmentation import outline_of

    rehearsed = OccupancyGrid()
    for scan, T_map_base in _drive():
        surface_points(scan)
        rehearsed.add_scan(scan, T_map_base)
        rehearsed.window(T_map_base[0], T_map_base[1], WindowConfig().local_map_size_m)
    known = rehearsed.known_area()
    outline_of(known.occupied, known.frame)


@cache
def topology_builder() -> None:
    """Warm up thinning, the merging of local maps, and the regions."""
    from thinmap_ros.core.grid.occupancy import OccupancyGrid, WindowConfig
    from thinmap_ros.core.topology.segmentation import find_regions
    from thinmap_ros.core.topology.topology import TopologyBuilder

    find_regions(_room())
    _graph(_room())
    grid = OccupancyGrid()
    rehearsed = TopologyBuilder()
    for scan, T_map_base in _drive():
        grid.add_scan(scan, T_map_base)
        rehearsed.update(
            grid.window(T_map_base[0], T_map_base[1], WindowConfig().local_map_size_m), T_map_base
        )
        rehearsed.local_map()
    poses = np.zeros((1, 3))
    rehearsed.rebuilt(grid.known_area(), poses, poses)


@cache
def route_graph() -> None:
    """Warm up the reduction of a graph for a route server."""
    from thinmap_ros.core.topology.graph import TopologyConfig
    from thinmap_ros.core.topology.topology import build_routes

    for patch in (_room(), _closet(), _corridors()):
        build_routes(patch, None, TopologyConfig())


@cache
def explorer() -> None:
    """Warm up the choice of an end node, in a partly unknown room, and what other maps need."""
    from thinmap_ros.core.exploration.explorer import Explorer
    from thinmap_ros.core.exploration.space import search_beside
    from thinmap_ros.core.grid.patch import scan_in_map
    from thinmap_ros.core.grid.raytrace import line_is_clear

    patch = _room()
    # Of other strategies, and of a frontier that no viewpoint sees into.
    line_is_clear(patch.free, *np.array([20, 20, 30, 30]))
    search_beside(patch.free, np.array([[20, 20]]), patch.free, 5, (30, 30))
    rehearsed = Explorer()
    topology = _graph(patch)
    for scan, T_map_base in _drive():
        rehearsed.step(topology, patch, scan, T_map_base)
        scan_in_map(patch, T_map_base, scan.range_max_m, scan.stamp_ns)


@cache
def navigator() -> None:
    """Warm up planning and driving."""
    from thinmap_ros.core.planning.navigator import Navigator
    from thinmap_ros.core.planning.paths import route_band
    from thinmap_ros.core.planning.wavefront import Obstacles, WavefrontConfig, find_path

    _sense()
    _be_blind()
    patch = _room()
    topology = _graph(patch)
    route_band(topology, patch, (2.0, 2.0), (4.0, 3.0), WavefrontConfig())
    obstacles = Obstacles(np.array([[3.0, 2.5]]), 0.2)
    find_path(patch, (2.0, 2.0), (4.0, 3.0), WavefrontConfig(), obstacles)
    rehearsed = Navigator()
    rehearsed.set_goal(4.0, 3.0, 0.0)
    for scan, T_map_base in _drive():
        rehearsed.step(T_map_base, patch, scan, _REHEARSAL.period_s)


def _be_blind() -> None:
    """Warm up what takes the place of beams that measure nothing."""
    from thinmap_ros.core.planning.obstacles import BlindSectors

    sectors = BlindSectors()
    for number in range(2):
        T_map_laser = se2.pose(2.0 + number, 2.0, 0.0)
        sectors.add_scan(T_map_laser, _scan(number, np.full(_REHEARSAL.beams, np.nan)))
    sectors.points(1.0, 2.0)


@cache
def global_localizer() -> None:
    """Warm up global localization."""
    from thinmap_ros.core.places.global_localizer import GlobalLocalization

    _sense()
    patch = _room()
    rehearsed = GlobalLocalization(patch, _graph(patch))
    for scan, T_map_base in _drive():
        rehearsed.step(scan, T_map_base)


@cache
def active_search() -> None:
    """Warm up the drive to where pose candidates differ."""
    from thinmap_ros.core.places.active_search import best_viewpoint
    from thinmap_ros.core.places.global_localizer import GlobalLocalization
    from thinmap_ros.core.planning.wavefront import WavefrontConfig

    navigator()
    patch = _room()
    places = GlobalLocalization(patch, _graph(patch)).places
    starts = np.array([[2.0, 2.0, 0.0], [4.0, 2.0, 1.0]])
    best_viewpoint(places, np.zeros(3), starts, np.full(2, 0.5), 5.0, WavefrontConfig())


@cache
def sim() -> None:
    """Warm up the simulated laser."""
    from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
    from thinmap_ros.sim.world import World

    start = se2.pose(2.0, 2.0, 0.3)
    world = World.from_patch('room', _room(), start)
    LaserScanner(LaserScannerConfig(), 0).scan(world, start, 0)


# Warm-ups of all nodes.
ALL = (
    localizer,
    ekf_localizer,
    grid_mapper,
    topology_builder,
    route_graph,
    explorer,
    navigator,
    global_localizer,
    active_search,
    map_joiner,
    sim,
)  # warm-ups of all nodes


def _graph(patch: GridPatch) -> 'TopologicalMap':
    """The graph of a map, after that of a closet: one node without edges."""
    from thinmap_ros.core.topology.graph import TopologyConfig
    from thinmap_ros.core.topology.topology import build

    build(_closet(), None, TopologyConfig())
    return build(patch, (2.0, 2.0), TopologyConfig())


def _room() -> GridPatch:
    """A room with a pillar, and a passage to unknown space."""
    cells = _walls(_REHEARSAL.room_cells)
    cells[40:46, 40:46] = 100
    cells[_REHEARSAL.passage, -1] = 0
    cells[:, -20:-1] = UNKNOWN
    return GridPatch(GridFrame(0.0, 0.0, _REHEARSAL.cell_m), cells)


def _closet() -> GridPatch:
    return GridPatch(GridFrame(0.0, 0.0, _REHEARSAL.cell_m), _walls(_REHEARSAL.closet_cells))


def _corridors() -> GridPatch:
    """Two corridors joined at one end; a branch of one is near places of the other, unseen."""
    cells = np.full((80, 80), 100, dtype=np.int8)
    cells[5:75, 40:52] = cells[5:75, 54:66] = cells[5:17, 40:66] = cells[35:47, 5:40] = 0
    return GridPatch(GridFrame(0.0, 0.0, _REHEARSAL.cell_m), cells)


def _walls(side: int) -> NDArray[np.int8]:
    """A square between walls."""
    cells = np.zeros((side, side), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    return cells


def _odd_scan() -> Scan:
    """A scan of random ranges, which fits no room."""
    beams = np.arange(_REHEARSAL.beams, dtype=np.float64)
    return _scan(_REHEARSAL.scans, 1.0 + beams * 0.37 % 3.0)


def _drive() -> Iterator[tuple[Scan, Array]]:
    """Scans along an arc through the room, each with its pose (3,)."""
    occupied = _room().occupied.astype(np.uint8)
    cell_m = _REHEARSAL.cell_m
    step = se2.pose(_REHEARSAL.step_m, 0.0, _REHEARSAL.turn_rad)
    T_map_base = se2.pose(2.0, 2.0, 0.3)
    for k in range(_REHEARSAL.scans):
        x, y = T_map_base[:2] / cell_m
        angles = _REHEARSAL.beam_angles + T_map_base[2]
        ranges = cell_m * cast_rays(occupied, x, y, angles, _REHEARSAL.range_m / cell_m)
        yield _scan(k, ranges), T_map_base
        T_map_base = se2.compose(T_map_base, step)


def _scan(number: int, ranges: Array) -> Scan:
    return Scan.create(
        _REHEARSAL.stamp_ns(number),
        ranges,
        -np.pi / 2.0,
        _REHEARSAL.beam_step_rad,
        0.05,
        _REHEARSAL.range_m,
    )
