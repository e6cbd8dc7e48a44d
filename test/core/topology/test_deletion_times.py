"""Deletion times after any changes are those of thinning the whole mask at once."""

import numpy as np
import pytest
from scipy import ndimage

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.layers import deletion_times as layer
from thinmap_ros.core.topology.layers.deletion_times import update_skeleton
from thinmap_ros.core.topology.layers.free_space import FreeSpace
from thinmap_ros.core.topology.thinning import KEPT, deletion_times, thin

SHAPE = (90, 110)


def blocks(rng, share, scale):
    small = rng.random((SHAPE[0] // scale + 1, SHAPE[1] // scale + 1)) < share
    return np.kron(small, np.ones((scale, scale), dtype=bool))[: SHAPE[0], : SHAPE[1]]


def changed(rng, mask):
    """A mask with some single cells, a box or a disc changed, or another mask."""
    new = mask.copy()
    row = rng.integers(SHAPE[0])
    col = rng.integers(SHAPE[1])
    kind = rng.integers(4)
    if kind == 0:
        new[rng.integers(SHAPE[0], size=20), rng.integers(SHAPE[1], size=20)] ^= True
    elif kind == 1:
        new[row : row + rng.integers(1, 60), col : col + rng.integers(1, 60)] = rng.random() < 0.6
    elif kind == 2:
        rows, cols = np.ogrid[: SHAPE[0], : SHAPE[1]]
        inside = (rows - row) ** 2 + (cols - col) ** 2 <= rng.integers(1, 900)
        new[inside] = rng.random() < 0.6
    else:
        new = blocks(rng, rng.uniform(0.3, 0.95), int(rng.integers(1, 12)))
    return new


def read(space, field):
    """Values (H, W) of a field; the cells of the masks are the first ones."""
    store = space._store._store
    return store.read(0, 0, *SHAPE)[field]


def test_the_sub_iteration_of_each_deletion():
    free = np.zeros((7, 9), dtype=bool)
    free[1:6, 1:8] = True
    times = deletion_times(free)
    assert np.array_equal(times == KEPT, thin(free))
    assert (times[~free] == 0).all() and (times[free] > 0).all()
    # The first one deletes cells of the south-east border and the north-west corner.
    assert times[5, 4] == 1 and times[3, 7] == 1 and times[1, 1] == 1
    assert times[1, 4] == 2 and times[3, 1] == 2


# A robot smaller than a cell: traversable is what is free.
CONFIG = TopologyConfig(robot_radius_m=0.01, max_unknown_gap_m=0.0)


# Many cells that flip are thinned at once, with so many around them, and few are not.
@pytest.mark.parametrize(('around', 'worth'), [(64, 256), (1, 256), (8, 256), (64, 0)])
@pytest.mark.parametrize('seed', range(12))
def test_repaired_times_are_those_of_the_whole(seed, around, worth, monkeypatch):
    monkeypatch.setattr(layer, '_AROUND', around)
    monkeypatch.setattr(layer, '_WORTH', worth)
    rng = np.random.default_rng(seed)
    space = FreeSpace(CONFIG, 0.1)
    mask = blocks(rng, 0.6, int(rng.integers(1, 12)))
    for _ in range(30):
        mask = changed(rng, mask)
        _, flipped = space.update(np.where(mask, 0, 100).astype(np.int8), 0, 0)
        assert np.array_equal(read(space, 'free') > 0, mask)
        lattice = space.lattice
        lattice.cells['kept'][update_skeleton(lattice, rng.permutation(flipped))] ^= 1
        assert np.array_equal(read(space, 'time'), deletion_times(mask))
        kept = read(space, 'kept') > 0
        assert (kept >= thin(mask)).all()
        parts, count = ndimage.label(mask, np.ones((3, 3)))
        assert ndimage.label(kept, np.ones((3, 3)))[1] == count
        assert len(np.unique(parts[kept])) == count, 'a part without a skeleton'


def test_a_filled_layer_is_that_of_updates():
    rng = np.random.default_rng(3)
    cells = np.where(blocks(rng, 0.8, 9), 0, rng.choice([100, -1], SHAPE)).astype(np.int8)
    filled = FreeSpace(TopologyConfig(), 0.1)
    updated = FreeSpace(TopologyConfig(), 0.1)
    filled.fill(GridPatch(GridFrame(0.0, 0.0, 0.1), cells), None, 0, 0)
    _, flipped = updated.update(cells, 0, 0)
    update_skeleton(updated.lattice, flipped)
    for field in ('state', 'known', 'free', 'column', 'time'):
        assert np.array_equal(read(filled, field), read(updated, field)), field
