"""Saved states of a robot that explores a room, and replacements for their arrays."""

import io
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.closed_loop.loop import make_loop
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.grid.correction import CorrectableGrid
from thinmap_ros.core.grid.edits import Erasures, KeepOut, MapEdits
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.slam.graph.keyframes import SavedKeyframes
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.coverage import observable_cells
from thinmap_ros.sim.world import World

ROOM = Path(__file__).resolve().parents[2] / 'worlds' / 'room_10x10.yaml'
State = dict[str, np.ndarray]
Work = Callable[[Any, Any], object]
LONGEST = 500
STEPS = 4
KINDS = ('topology', 'exploration', 'localizer', 'keyframes', 'grid', 'edits')


class Explored:
    """A robot that explores a room, and the states of its parts."""

    def __init__(self) -> None:
        name, patch, start = read_world(ROOM)
        world = World(name, patch.occupied.astype(np.uint8), patch.frame, start)
        loop = make_loop(world, [start], Options(localization='slam', speed_m_s=0.4))
        (robot,) = loop.robots
        self.robot = robot
        self.scans: list[tuple[Any, Any]] = []
        log_poses = robot.log_poses

        def noted(scan: Any, estimate: Any) -> None:
            self.scans.append((scan, estimate.T_map_base))
            log_poses(scan, estimate)

        robot.log_poses = noted  # type: ignore[method-assign]
        loop.run(observable_cells(world, start, 0.3, 8.0), 40.0, lambda seconds, share: None)
        pipeline = robot.pipeline
        keyframes = pipeline.localizer.saved_keyframes()  # type: ignore[union-attr]
        assert keyframes is not None
        self.states: dict[str, State] = {
            'topology': pipeline.topology.state(),
            'exploration': robot.explorer.state(),
            'localizer': pipeline.localizer.state(),
            'keyframes': keyframes.state(),
            'grid': pipeline.grid.state(),
            'edits': dict(edited(start[:2]).state()),
        }

    def use(self, kind: str, state: State) -> None:
        """Restore an object from a state, and run it for some scans."""
        work = getattr(self, f'_use_{kind}')(state)
        for scan, T_map_base in self.scans[-STEPS:]:
            work(scan, T_map_base)

    def _use_topology(self, state: State) -> Work:
        builder = TopologyBuilder.from_state(state)

        def work(scan: Any, T: Any) -> None:
            builder.update(self.robot.pipeline.grid.window(T[0], T[1], 16.0), T)
            builder.local_map()

        return work

    def _use_exploration(self, state: State) -> Work:
        explorer = Explorer.from_state(state)
        pipeline = self.robot.pipeline
        patch = pipeline.grid.known_area()
        return lambda scan, T: explorer.step(pipeline.topology.map, patch, scan, T)

    def _use_localizer(self, state: State) -> Work:
        localizer = Localizer.from_state(state, self.robot.pipeline.localizer.config)
        localizer.set_pose(self.scans[-STEPS][1], 1e-4 * np.eye(3))
        return localizer.step

    def _use_keyframes(self, state: State) -> Work:
        keyframes = SavedKeyframes.from_state(state)
        config = self.robot.pipeline.localizer.config
        localizer = Localizer.from_state(self.states['localizer'], config, keyframes)
        localizer.set_pose(self.scans[-STEPS][1], 1e-4 * np.eye(3))
        grid = CorrectableGrid(OccupancyGrid(PAPER_GRID), scans=keyframes.scans)
        work = localizer.step

        def step(scan: Any, T: Any) -> None:
            work(scan, T)
            grid.update(scan, T)

        localizer.optimized_trajectory()
        grid.apply_correction(*localizer.keyframe_trajectory(), self.scans[-STEPS][0].stamp_ns)
        return step

    def _use_grid(self, state: State) -> Work:
        grid = OccupancyGrid.from_state(state)

        def work(scan: Any, T: Any) -> None:
            grid.add_scan(scan, T)
            grid.window(T[0], T[1], 8.0)
            grid.known_area()

        return work

    def _use_edits(self, state: State) -> Work:
        edits = MapEdits.from_state(state)
        grid = CorrectableGrid(
            OccupancyGrid(PAPER_GRID), scans=self.scans[:STEPS], erasures=edits.erasures
        )
        grid.apply_correction(np.empty(0, dtype=np.int64), np.empty((0, 3)), 0)
        grid.finish()

        def work(scan: Any, T: Any) -> None:
            grid.update(scan, T)
            edits.keep_out.laid_on(grid.shown.known_area(), T)

        return work


def edited(xy: np.ndarray) -> MapEdits:
    """Edits around a place: an area, a wall, and two parts that are erased."""
    square = xy + np.array([[0.5, 0.5], [1.5, 0.5], [1.5, 1.5], [0.5, 1.5]])
    erasures = Erasures()
    erasures.add(square, 2_000_000_000)
    erasures.add(square + 0.5, 4_000_000_000)
    return MapEdits(KeepOut().with_area(square, False).with_area(square[:2], True), erasures)


def replaced(array: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Replacement for an array in an archive."""
    yield 'complex', array.astype(np.complex128)
    yield 'text', array.astype(str)
    yield 'objects', array.astype(object)
    yield 'times', np.zeros(array.shape, dtype='M8[s]')
    yield 'records', np.zeros(array.shape, dtype=[('a', 'f8')])
    yield 'truth values', array.astype(np.bool_)
    yield 'bytes', array.astype(np.uint8)
    yield 'half floats', array.astype(np.float16)
    yield 'long floats', array.astype(np.longdouble)
    yield 'large whole numbers', array.astype(np.uint64)
    yield 'other byte order', array.astype(array.dtype.newbyteorder())
    yield 'one axis more', array[None]
    yield 'one axis more at the end', array[..., None]
    yield 'a single number', np.array(array.ravel()[0] if array.size else 0, dtype=array.dtype)
    yield 'nothing', np.empty((0,) * array.ndim, dtype=array.dtype)
    if array.ndim:
        yield 'one less', array[:-1]
        yield 'one more', np.concatenate([array, array[-1:]])
        yield 'first row only', array[:1]
        yield 'backwards', array[::-1]
        yield 'flat', array.ravel()
    if array.ndim > 1:
        yield 'turned', np.swapaxes(array, 0, 1)
        yield 'a column less', array[:, :-1]
    for value in (np.nan, np.inf, -np.inf, 1e300, -1e300, 1e9, -1.0, 0.0, 2**62, -(2**62), 2**31):
        with np.errstate(all='ignore'):
            yield f'all {value}', np.full(array.shape, value).astype(array.dtype)
            if array.size:
                one = array.copy()
                one.ravel()[array.size // 2 :][:1] = np.full(1, value).astype(array.dtype)
                yield f'one {value}', one


def check(explored: Explored, kind: str, state: State, what: str) -> bool:
    """Whether a state is rejected with a proper reason; any other exception is a failure."""
    try:
        explored.use(kind, state)
    except InputError as error:
        assert len(str(error)) <= LONGEST and str(error).isprintable(), (what, str(error))
        # No array determines whether later windows will be aligned with the saved lattice.
        beside = kind == 'topology' and str(error).startswith('window')
        beside |= kind in ('grid', 'localizer') and 'map ' in str(error)
        assert str(error).startswith('saved') or beside, (what, str(error))
        return True
    return False


def one_number_replaced(whole: State, rng: np.random.Generator) -> tuple[str, State]:
    """A state with one number of one array replaced, and the name of the array."""
    state = {name: array.copy() for name, array in whole.items()}
    name = str(rng.choice([name for name, array in whole.items() if array.size]))
    flat = state[name].reshape(-1)
    at = int(rng.integers(0, flat.size))
    if flat.dtype.kind == 'f':
        flat[at] = rng.choice([0.0, -1.0, 0.5, 7.0, 1e3, 1e5, -1e6, np.nan, flat[at - 1]])
    else:
        flat[at] = rng.choice([0, 1, 2, 3, 50, 127, int(flat[at - 1]) % 128])
    state[name] = flat.reshape(whole[name].shape)
    return f'{name}[{at}] = {flat[at]}', state


def archive(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f'{name}.npy', content)
    return path


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def with_header(header: dict[str, Any], data: bytes) -> bytes:
    text = repr(header).encode().ljust(117) + b'\n'
    return b'\x93NUMPY\x01\x00' + len(text).to_bytes(2, 'little') + text + data


def plain(shape: tuple[int, ...], descr: str = '<i8') -> dict[str, Any]:
    return {'descr': descr, 'fortran_order': False, 'shape': shape}
