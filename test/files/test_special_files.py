"""Pipes, sockets and devices in the place of files: refused before they are opened."""

import os
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.files import occupancy_maps, safe, sessions, trajectories, worlds
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.logs.reading import open_log
from thinmap_ros.logs.storage import bag_files
from thinmap_ros.tools.bag_repair import files_of

# A reader that waits for a writer of the pipe is interrupted; the other tests are run.
pytestmark = pytest.mark.timeout(60, method='signal')


def pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


def linked_pipe(path: Path) -> Path:
    path.symlink_to(pipe(path.with_name('pipe')))
    return path


def linked_device(path: Path) -> Path:
    path.symlink_to('/dev/zero')
    return path


def unix_socket(path: Path) -> Path:
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(path))
    return path


KINDS = (pipe, linked_pipe, linked_device, unix_socket)
READERS = {
    'map.yaml': occupancy_maps.read_map,
    'resolution.yaml': occupancy_maps.read_resolution,
    'world.yaml': worlds.read_world,
    'tour.yaml': worlds.read_tour,
    'laser.yaml': lambda path: safe.read_mapping(path, 'a mapping'),
    'poses.tum': trajectories.read_tum,
    'room.grid.npz': lambda path: sessions.load_grid(str(path)),
    'room.yaml': lambda path: sessions.load_grid(str(path)),
    'room.topology.npz': lambda path: sessions.load_topology(str(path)),
    'room.keyframes.npz': lambda path: sessions.KEYFRAMES.load(str(path)),
    'room.slam.npz': lambda path: sessions.LOCALIZER.load(str(path)),
    'room.exploration.npz': lambda path: sessions.EXPLORATION.load_optional(str(path)),
    'some.clf': lambda path: list(open_log(path).events()),
    'carmen.log': lambda path: list(CarmenLog(path).events()),
    'some.mcap': lambda path: list(open_log(path).events()),
    'some.db3': Bag,
    'some.mcap.zstd': Bag,
    'damaged.mcap': files_of,
}


@pytest.mark.parametrize('kind', KINDS, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize('name', READERS)
def test_no_reader_opens_a_file_of_another_kind(tmp_path, name, kind):
    file = kind(tmp_path / name)
    with pytest.raises(InputError) as refused:
        READERS[name](file)
    assert str(file) in str(refused.value) and 'expected a' in str(refused.value)


@pytest.mark.parametrize('kind', KINDS, ids=lambda kind: kind.__name__)
def test_the_image_that_a_map_names_is_a_file(tmp_path, kind):
    patch = GridPatch(GridFrame(0.0, 0.0, 0.05), np.zeros((4, 4), dtype=np.int8))
    description = occupancy_maps.write_map(tmp_path / 'map', patch)
    (tmp_path / 'map.pgm').unlink()
    kind(tmp_path / 'map.pgm')
    with pytest.raises(InputError, match=r'map\.pgm: .*expected a regular file'):
        occupancy_maps.read_map(description)


@pytest.mark.parametrize('name', ['metadata.yaml', 'bag_0.mcap'])
def test_a_folder_of_a_bag_holds_files(tmp_path, name):
    if name == 'metadata.yaml':
        shutil.copy(next(Path('bags').rglob('*.mcap')), tmp_path / 'bag_0.mcap')
        pipe(tmp_path / name)
        found = bag_files(tmp_path)
        assert 'expected a regular file' in found.without_metadata
        return
    pipe(tmp_path / name)
    with pytest.raises(InputError, match=r'bag_0\.mcap: .*expected a regular file'):
        Bag(tmp_path)


def test_a_link_to_a_file_is_read_as_the_file(tmp_path):
    (tmp_path / 'real.yaml').write_text('a: 1\n')
    (tmp_path / 'link.yaml').symlink_to(tmp_path / 'real.yaml')
    assert safe.read_mapping(tmp_path / 'link.yaml', 'a mapping') == {'a': 1}
