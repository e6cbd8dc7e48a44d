"""Saved states with one array replaced: rejected in one line, or valid."""

import json
import os
import pickle
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzz.saved_states import (
    KINDS,
    LONGEST,
    Explored,
    State,
    archive,
    check,
    npy,
    one_number_replaced,
    plain,
    replaced,
    with_header,
)

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.files import sessions
from thinmap_ros.files.safe import VERSION, read_arrays
from thinmap_ros.files.sessions import load_grid


@pytest.fixture(scope='module')
def explored() -> Explored:
    return Explored()


@pytest.mark.cpu_budget(20.0, 'a saved map for each wrong value of each array')
@pytest.mark.filterwarnings('ignore::numpy.exceptions.ComplexWarning', 'ignore:invalid value')
@pytest.mark.parametrize('kind', KINDS)
def test_each_array_replaced(explored: Explored, kind: str) -> None:
    whole = explored.states[kind]
    assert not check(explored, kind, whole, 'as it was saved')
    refused = tried = 0
    for name, array in whole.items():
        assert check(explored, kind, {k: a for k, a in whole.items() if k != name}, f'no {name}')
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
    rng = np.random.default_rng(seed)
    for _ in range(60):
        what, state = one_number_replaced(explored.states[kind], rng)
        check(explored, kind, state, what)


@pytest.mark.parametrize(
    'name, index, value, reason',
    [
        ('edges', (0, 1), 10**6, 'node of an edge'),
        ('nodes', (0, 0), 1, 'node of an edge'),
        ('next_id', (), 1, 'below next_id'),
        ('tiles', (0,), 10**5, 'cells'),
    ],
)
def test_a_graph_that_contradicts_itself_is_rejected(
    explored: Explored, name: str, index: tuple[int, ...], value: int, reason: str
) -> None:
    state = {key: array.copy() for key, array in explored.states['topology'].items()}
    state[name][index] = value
    with pytest.raises(InputError, match=reason):
        TopologyBuilder.from_state(state)


def test_what_a_killed_localizer_left() -> None:
    whole = OdometryAnchor(10**18, np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.2, 0.3])).state()
    assert OdometryAnchor.from_state(whole).stamp_ns == 10**18
    for name, array in whole.items():
        for _, other in replaced(array):
            try:
                OdometryAnchor.from_state(whole | {name: other}).is_continuous_with(
                    10**18, np.zeros(3)
                )
            except InputError as error:
                assert len(str(error)) <= LONGEST


# Archives.

PARTS = {part.name: part for part in sessions.PARTS}
# The largest integer, or a number of 300 digits; -1 for integers, NaN for others.
LARGE = b'\x7f'
MINUS_ONE = b'\xff'
# Arrays in which -1 is valid, and arrays in which NaN means "not known".
MAY_BE_NEGATIVE = {
    'topology': {'robot_places', 'tiles'},
    'grid': {'tiles', 'log_odds'},
    'localizer': {'tiles'},
    'exploration': {'cells'},
}
# Counts of a byte each, and numbers of ranges, for which any value is valid.
MAY_BE_ANY = {'localizer': {'seen'}, 'topology': {'states'}, 'keyframes': {'ranges'}}
MAY_BE_NAN = {'localizer': {'spans'}, 'keyframes': {'headings'}}


def label(kind: str) -> bytes:
    """The member of an archive that describes its contents."""
    return npy(np.array(f'{kind} {VERSION}'))


def saved(folder: Path, kind: str, state: State) -> Path:
    """An archive in the format of files.sessions."""
    members = {name: npy(array) for name, array in state.items()}
    return archive(folder / f'a{PARTS[kind].ending}', thinmap_format=label(kind), **members)


def overwritten(array: np.ndarray, byte: bytes) -> np.ndarray:
    """An array of the same type and shape with equal bytes."""
    return np.frombuffer(byte * array.nbytes, dtype=array.dtype).reshape(array.shape)


@pytest.mark.parametrize('byte', [LARGE, MINUS_ONE])
@pytest.mark.parametrize('kind', KINDS)
def test_what_no_field_may_hold_is_refused_by_its_name(
    explored: Explored, tmp_path: Path, kind: str, byte: bytes
) -> None:
    state = explored.states[kind]
    assert PARTS[kind].load(str(saved(tmp_path, kind, state))) is not None
    bounded = 0
    for name, array in state.items():
        told = re.sub('^(nodes|stand_ins|borders)_', r'\1: ', name)
        may = MAY_BE_NAN if array.dtype.kind == 'f' else MAY_BE_NEGATIVE
        may_be = byte == MINUS_ONE and told.rpartition(' ')[2] in may.get(kind, ())
        may_be |= name in MAY_BE_ANY.get(kind, ())
        if array.size == 0 or array.dtype.kind == 'b' or may_be:
            continue
        path = saved(tmp_path, kind, state | {name: overwritten(array, byte)})
        with pytest.raises(InputError) as error:
            PARTS[kind].load(str(path))
        what = 'local map' if kind == 'localizer' else kind
        assert str(error.value).startswith(f'{path}: saved {what}: {told}'), name
        bounded += 1
    least = {
        'grid': 1,
        'edits': 5,
        'localizer': 5,
        'topology': 6,
        'exploration': 4 + (byte == LARGE),
    }
    assert bounded >= least.get(kind, 7)


class Evil:
    """An object with a side effect when it is unpickled."""

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
@pytest.mark.parametrize('kind', PARTS)
def test_headers_of_arrays(tmp_path: Path, kind: str, name: str) -> None:
    part = PARTS[kind]
    archive(tmp_path / f'a{part.ending}', thinmap_format=label(kind), frame=HEADERS[name])
    with pytest.raises(InputError, match=rf'a{re.escape(part.ending)}: .*expected') as error:
        part.load(str(tmp_path / 'a'))
    assert len(str(error.value)) <= LONGEST and str(error.value).isprintable()


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    trap = tmp_path / 'sprung'
    content = pickle.dumps(np.array([Evil(str(trap))], dtype=object), protocol=2)
    # As many objects as match the declared size in bytes.
    content += bytes(-len(content) % 8)
    member = with_header(plain((len(content) // 8,), '|O'), content)
    path = archive(tmp_path / 'a.grid.npz', thinmap_format=label('grid'), frame=member)
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
    with pytest.raises(InputError, match='bytes decompressed: expected at most'):
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


@pytest.mark.filterwarnings('ignore:Duplicate name')
def test_an_array_that_is_there_twice_is_not_read_as_either(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / 'twice.npz', 'w') as file:
        file.writestr('a.npy', npy(np.zeros(3)))
        file.writestr('a.npy', npy(np.ones(3)))
    with (tmp_path / 'twice.npz').open('rb') as stream, pytest.raises(InputError) as error:
        read_arrays(stream)
    assert str(error.value) == '2 arrays of 1 names: expected at most 64, each once'


@pytest.mark.parametrize('more', [-8, -1, 1, 8, 800])
def test_a_member_is_as_large_as_its_header_says(
    explored: Explored, tmp_path: Path, more: int
) -> None:
    members = {name: npy(array) for name, array in explored.states['grid'].items()}
    whole = members['frame']
    members['frame'] = whole[:more] if more < 0 else whole + bytes(more)
    path = archive(tmp_path / 'a.grid.npz', thinmap_format=label('grid'), **members)
    with pytest.raises(InputError, match=rf'expected an array of {24 + more} bytes: expected a'):
        load_grid(str(path))


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'a.grid.npz')
    with pytest.raises(InputError, match='expected a regular file'):
        load_grid(str(tmp_path / 'a'))
