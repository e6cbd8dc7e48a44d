"""Saved states with one array replaced: refused in one line, or as good as the saved one."""

import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thinmap_ros.adapters.archive_files import read_arrays
from thinmap_ros.adapters.session_files import (
    load_exploration,
    load_features,
    load_grid,
    load_topology,
)
from thinmap_ros.adapters.world_files import read_world
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.odometry import LastPose
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.topology.update import TopologyBuilder
from thinmap_ros.sim.world import World
from thinmap_ros.tools.explore_world import ClosedLoop, Options, coverable, make_loop

ROOM = Path(__file__).resolve().parents[2] / 'worlds' / 'room_10x10.yaml'
State = dict[str, np.ndarray]
Work = Callable[[Any, Any], object]
LONGEST = 500
STEPS = 4
KINDS = ('topology', 'exploration', 'features', 'grid')


class Explored:
    """A room that a robot is exploring, and what each part of it knows."""

    def __init__(self) -> None:
        name, patch, start = read_world(ROOM)
        world = World(name, patch.occupied.astype(np.uint8), patch.frame, start)
        self.loop: ClosedLoop = make_loop(world, start, Options(localization='slam', speed_m_s=0.4))
        self.scans: list[tuple[Any, Any]] = []
        note = self.loop.note

        def noted(scan: Any, estimate: Any) -> None:
            self.scans.append((scan, estimate.T_map_base))
            note(scan, estimate)

        self.loop.note = noted  # type: ignore[method-assign]
        self.loop.run(coverable(world, start, 0.3, 8.0), 40.0, lambda seconds, share: None)
        pipeline = self.loop.pipeline
        self.states: dict[str, State] = {
            'topology': pipeline.topology.state(),
            'exploration': self.loop.strategy.state(),  # type: ignore[attr-defined]
            'features': pipeline.localizer.state(),
            'grid': pipeline.grid.state(),
        }

    def use(self, kind: str, state: State) -> None:
        """Make what a state is of, and let it do its work for some scans."""
        work = getattr(self, f'_use_{kind}')(state)
        for scan, T_map_base in self.scans[-STEPS:]:
            work(scan, T_map_base)

    def _use_topology(self, state: State) -> Work:
        builder = TopologyBuilder.from_state(state)

        def work(scan: Any, T: Any) -> None:
            builder.update(self.loop.pipeline.grid.window(T[0], T[1], 16.0), T)
            builder.local_map()

        return work

    def _use_exploration(self, state: State) -> Work:
        explorer, pipeline = Explorer.from_state(state), self.loop.pipeline
        patch = pipeline.grid.patch()
        return lambda scan, T: explorer.step(pipeline.topology.map, patch, scan, T)

    def _use_features(self, state: State) -> Work:
        localizer = Localizer.from_state(state, self.loop.pipeline.localizer.config)
        localizer.set_pose(self.scans[-STEPS][1], 1e-4 * np.eye(3))

        def work(scan: Any, T: Any) -> None:
            localizer.step(scan, T)
            assert len(localizer.features) == len({f.id for f in localizer.features})

        return work

    def _use_grid(self, state: State) -> Work:
        grid = OccupancyGrid.from_state(state)

        def work(scan: Any, T: Any) -> None:
            grid.update(scan, T)
            grid.window(T[0], T[1], 8.0)
            grid.patch()

        return work


@pytest.fixture(scope='module')
def explored() -> Explored:
    return Explored()


def replaced(array: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """What may stand in an archive in the place of an array."""
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
    """Whether a state is refused, with a good reason; any other exception is a failure."""
    try:
        explored.use(kind, state)
    except InputError as error:
        assert len(str(error)) <= LONGEST and str(error).isprintable(), (what, str(error))
        # What no array tells is whether the windows that come will lie on the saved lattice.
        beside = kind == 'topology' and str(error).startswith('window')
        beside |= kind in ('grid', 'features') and str(error).startswith('map ')
        assert str(error).startswith('saved') or beside, (what, str(error))
        return True
    return False


@pytest.mark.filterwarnings('ignore::numpy.exceptions.ComplexWarning', 'ignore:invalid value')
@pytest.mark.parametrize('kind', KINDS)
def test_each_array_replaced(explored: Explored, kind: str) -> None:
    whole = explored.states[kind]
    assert not check(explored, kind, whole, 'as it was saved')
    refused = tried = 0
    for name, array in whole.items():
        assert check(
            explored, kind, {k: a for k, a in whole.items() if k != name}, f'no {name}'
        ) or (name == 'usual')
        for how, other in replaced(array):
            tried += 1
            refused += check(explored, kind, whole | {name: other}, f'{name}: {how}')
    assert check(explored, kind, whole | {'more': np.zeros(3)}, 'one more')
    assert check(explored, kind, whole | {100_000 * 'x': np.zeros(3)}, 'a long name')
    assert check(explored, kind, {}, 'nothing') != (kind == 'topology'), (
        'an empty graph is one, too'
    )
    assert refused > 0.5 * tried, 'these are hardly ever right'


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('seed', range(4))
def test_single_numbers_replaced(explored: Explored, kind: str, seed: int) -> None:
    whole, rng = explored.states[kind], np.random.default_rng(seed)
    names = [name for name, array in whole.items() if array.size]
    for _ in range(60):
        state = {name: array.copy() for name, array in whole.items()}
        name = str(rng.choice(names))
        flat = state[name].reshape(-1)
        at = int(rng.integers(0, flat.size))
        if flat.dtype.kind == 'f':
            flat[at] = rng.choice([0.0, -1.0, 0.5, 7.0, 1e3, 1e5, -1e6, np.nan, flat[at - 1]])
        else:
            flat[at] = rng.choice([0, 1, 2, 3, 50, 127, int(flat[at - 1]) % 128])
        state[name] = flat.reshape(whole[name].shape)
        check(explored, kind, state, f'{name}[{at}] = {flat[at]}')


def test_a_chain_that_leaps_is_not_taken_for_one(explored: Explored) -> None:
    state = {name: array.copy() for name, array in explored.states['topology'].items()}
    state['cells'][5, 0] = 10**9
    with pytest.raises(InputError, match='cells'):
        TopologyBuilder.from_state(state)
    state['cells'][5, 0] = explored.states['topology']['cells'][5, 0] + 3
    with pytest.raises(InputError, match='each beside the next'):
        TopologyBuilder.from_state(state)


def test_what_a_killed_localizer_left() -> None:
    whole = LastPose(10**18, np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.2, 0.3])).state()
    assert LastPose.from_state(whole).stamp_ns == 10**18
    for name, array in whole.items():
        for _, other in replaced(array):
            try:
                LastPose.from_state(whole | {name: other}).leads_to(10**18, np.zeros(3))
            except InputError as error:
                assert len(str(error)) <= LONGEST


# Archives.


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


class Evil:
    """An object that does something when it is unpickled."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.path,)


HEADERS = {
    'far too large': with_header(plain((180_000_000_000,)), bytes(800)),
    'larger than it is': with_header(plain((101,)), bytes(800)),
    'smaller than it is': with_header(plain((99,)), bytes(800)),
    'negative': with_header(plain((-100, -1)), bytes(800)),
    'no bytes': with_header(plain((10**15,), '<U0'), b''),
    'overflow': with_header(plain((2**62, 4)), b''),
    'no header': b'',
    'half a header': npy(np.zeros(3))[:40],
    'a long header': with_header(plain(5000 * (1,)), bytes(8)),
    'no such type': with_header(plain((1,), 'nonsense'), bytes(8)),
    'version 3': b'\x93NUMPY\x03\x00' + npy(np.zeros(3))[8:],
}


@pytest.mark.parametrize('name', HEADERS)
@pytest.mark.parametrize('load', [load_grid, load_topology, load_features, load_exploration])
def test_headers_of_arrays(tmp_path: Path, load: Callable[[str], object], name: str) -> None:
    end = load.__name__.removeprefix('load_')
    label = npy(np.array(f'{end} 1'))
    archive(tmp_path / f'a.{end}.npz', thinmap_format=label, frame=HEADERS[name])
    with pytest.raises(InputError, match=rf'a\.{end}\.npz: .*expected') as error:
        load(str(tmp_path / 'a'))
    assert len(str(error.value)) <= LONGEST and str(error.value).isprintable()


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    trap = tmp_path / 'sprung'
    content = pickle.dumps(np.array([Evil(str(trap))], dtype=object), protocol=2)
    # As many objects as fill the bytes that are there, for whoever compares the two.
    content += bytes(-len(content) % 8)
    member = with_header(plain((len(content) // 8,), '|O'), content)
    path = archive(tmp_path / 'a.grid.npz', thinmap_format=npy(np.array('grid 1')), frame=member)
    with pytest.raises(InputError, match='expected a saved grid'):
        load_grid(str(path))
    assert not trap.exists()


def test_archives_that_unpack_to_more_than_any_map(tmp_path: Path) -> None:
    path = tmp_path / 'a.grid.npz'
    with (
        zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED, compresslevel=9) as file,
        file.open('frame.npy', 'w', force_zip64=True) as stream,
    ):
        stream.write(with_header(plain((600 << 20,), '|i1'), b''))
        for _ in range(600):
            stream.write(bytes(1 << 20))
    assert path.stat().st_size < 1_000_000
    with pytest.raises(InputError, match='bytes unpacked: expected at most'):
        load_grid(str(path))


def test_what_else_an_archive_may_hold(tmp_path: Path) -> None:
    one = npy(np.zeros(3))
    path = archive(tmp_path / 'many.npz', **{f'a{i}': one for i in range(100)})
    with path.open('rb') as stream, pytest.raises(InputError, match='100 arrays'):
        read_arrays(stream)
    with zipfile.ZipFile(tmp_path / 'slow.npz', 'w', zipfile.ZIP_LZMA) as file:
        file.writestr('a.npy', one)
    with (tmp_path / 'slow.npz').open('rb') as stream, pytest.raises(InputError, match='deflated'):
        read_arrays(stream)
    with zipfile.ZipFile(tmp_path / 'other.npz', 'w') as file:
        file.writestr('a.json', json.dumps({}))
    with (tmp_path / 'other.npz').open('rb') as stream, pytest.raises(InputError, match='an array'):
        read_arrays(stream)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'a.grid.npz')
    with pytest.raises(InputError, match='expected a regular file'):
        load_grid(str(tmp_path / 'a'))
