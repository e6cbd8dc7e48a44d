"""Tiles of a map that have changed, from one robot to another."""

import zlib

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.shared import ReceivedTiles, TileMessage, TileSender, changed_part

LATTICE = GridFrame(0.0, 0.0, 0.1)
VALUES = np.array([-1, 3, 100, 40], dtype=np.int8)
SENT = np.array([-1, 0, 100, 50], dtype=np.int8)
NOTHING = GridPatch(LATTICE, np.full((1, 1), -1, dtype=np.int8))


def random_map(seed, row=-37, col=21, shape=(50, 70)):
    """A map at a place that is no corner of tiles; returns it, and as it is sent."""
    choice = np.random.default_rng(seed).integers(4, size=shape)
    frame = LATTICE.with_origin_at(row, col)
    return GridPatch(frame, VALUES[choice]), GridPatch(frame, SENT[choice])


def sent(message):
    return TileMessage.decode(message.encode())


def assert_same(patch, expected):
    assert changed_part(patch, expected) is None


@pytest.mark.parametrize('seed', range(3))
def test_a_map_arrives_as_it_was(seed):
    patch, expected = random_map(seed)
    sender = TileSender(LATTICE)
    sender.update(patch)
    receiver = ReceivedTiles(LATTICE)
    box = receiver.add('a', sent(sender.changes_after(0)))
    assert_same(receiver.completed(NOTHING), expected)
    assert (box <= [[2.1, -3.7], [9.2, 1.4]]).tolist() == [[True, True], [False, False]]


def test_only_what_changed_is_sent():
    cells = np.zeros((160, 160), dtype=np.int8)
    sender = TileSender(LATTICE)
    sender.update(GridPatch(LATTICE, cells))
    first = sender.changes_after(0)
    assert len(first.tiles) == 100
    cells[17, 33] = 100
    cells[18, 33] = 1  # still free
    sender.update(GridPatch(LATTICE, cells.copy()))
    assert list(sender.changes_after(first.version).tiles) == [(1, 2)]
    sender.update(GridPatch(LATTICE, cells.copy()))
    assert not sender.changes_after(2).tiles
    assert sender.version == 2


def test_what_a_correction_removes_is_removed_elsewhere():
    sender = TileSender(LATTICE)
    receiver = ReceivedTiles(LATTICE)
    cells = np.zeros((64, 64), dtype=np.int8)
    sender.update(GridPatch(LATTICE, cells))
    receiver.add('a', sent(sender.changes_after(0)))
    sender.update(GridPatch(LATTICE, cells[:32]))
    receiver.add('a', sent(sender.changes_after(1)))
    assert int((receiver.completed(NOTHING).cells == 0).sum()) == 32 * 64


def test_a_receiver_that_missed_a_message_gets_all_it_needs():
    sender = TileSender(LATTICE)
    receiver = ReceivedTiles(LATTICE)
    for seed in range(4):
        patch, expected = random_map(seed)
        sender.update(patch)
        if seed == 0:
            receiver.add('a', sender.changes_after(0))
    assert receiver.add('a', sender.changes_after(3)) is None
    assert receiver.version_of('a') == 1
    assert receiver.add('a', sender.changes_after(receiver.version_of('a'))) is not None
    assert_same(receiver.completed(NOTHING), expected)
    assert receiver.add('a', sender.changes_after(0)) is None


def test_a_robot_believes_its_own_cells_first_and_the_newest_of_others():
    own = GridPatch(LATTICE, np.array([[0, 100, 50, -1]], dtype=np.int8))
    receiver = ReceivedTiles(LATTICE)
    senders = {}
    for name, cells in (('a', [100, 0, 0, 0]), ('b', [-1, -1, 100, 100])):
        senders[name] = TileSender(LATTICE)
        senders[name].update(GridPatch(LATTICE, np.array([cells], dtype=np.int8)))
        receiver.add(name, senders[name].changes_after(0))
    assert receiver.completed(own).cells[0, :4].tolist() == [0, 100, 100, 100]
    senders['a'].update(GridPatch(LATTICE, np.array([[100, 0, 0, 50]], dtype=np.int8)))
    receiver.add('a', senders['a'].changes_after(1))
    assert receiver.completed(own).cells[0, :4].tolist() == [0, 100, 0, 100]


def test_a_robot_believes_others_where_it_is_not_sure():
    own = GridPatch(LATTICE, np.array([[22, 80, 5, 97, 22, 40]], dtype=np.int8))
    sender = TileSender(LATTICE)
    sender.update(GridPatch(LATTICE, np.array([[100, 0, 100, 0, -1, 50]], dtype=np.int8)))
    receiver = ReceivedTiles(LATTICE)
    receiver.add('a', sender.changes_after(0))
    assert receiver.completed(own).cells[0, :6].tolist() == [100, 0, 5, 97, 22, 40]


def test_a_corridor_takes_few_bytes():
    cells = np.full((400, 400), -1, dtype=np.int8)
    cells[100:120, 20:380] = 0
    cells[[100, 119], 20:380] = 100
    sender = TileSender(LATTICE)
    sender.update(GridPatch(LATTICE, cells))
    assert len(sender.changes_after(0).encode()) < cells.size / 300


@pytest.mark.parametrize(
    ('data', 'said'),
    [
        (b'', 'map tiles: 0 bytes: expected at least 36'),
        (b'nonsense', 'map tiles: '),
        (zlib.compress(bytes(20)), '20 bytes: expected at least 36'),
        (zlib.compress(bytes(99)), '99 bytes for 0 tiles'),
        (zlib.compress(bytes(10**8)), 'bytes for 0 tiles'),
    ],
)
def test_what_is_no_message_is_refused(data, said):
    with pytest.raises(InputError, match=said):
        TileMessage.decode(data)


def test_another_lattice_is_refused():
    receiver = ReceivedTiles(LATTICE)
    with pytest.raises(InputError, match='expected those of'):
        receiver.add('a', TileSender(GridFrame(0.0, 0.0, 0.05)).changes_after(0))
