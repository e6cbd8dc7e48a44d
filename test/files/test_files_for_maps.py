"""A file of another kind that is given for a map is named, with what was expected."""

import io
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.ros1_bag import ros1_bag

from thinmap_ros.core.errors import InputError
from thinmap_ros.files.merging import read_piece
from thinmap_ros.files.occupancy_maps import read_map
from thinmap_ros.files.sessions import load_grid
from thinmap_ros.files.worlds import read_world
from thinmap_ros.logs.bag_writer import BagWriter

BINARY = bytes(range(256)) * 4
# As boost::archive::binary_oarchive begins, and the streams of Cartographer.
BOOST = struct.pack('<Q', 22) + b'serialization::archive' + BINARY
CARTOGRAPHER = struct.pack('<Q', 0x7B1D1F7B5BF501DB) + BINARY


def image(form: str) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.full((4, 4), 254, dtype=np.uint8)).save(stream, format=form)
    return stream.getvalue()


def mcap(folder: Path) -> bytes:
    with BagWriter(folder / 'bag.mcap'):
        pass
    return (folder / 'bag.mcap').read_bytes()


def sqlite(folder: Path) -> bytes:
    path = folder / 'bag.db3'
    with sqlite3.connect(path) as connection:
        connection.execute('create table messages (id integer)')
    return path.read_bytes()


def archive() -> bytes:
    stream = io.BytesIO()
    np.savez(stream, cells=np.zeros(3))
    return stream.getvalue()


def ros1(folder: Path) -> bytes:
    ros1_bag(folder / 'bag.bag')
    return (folder / 'bag.bag').read_bytes()


KINDS = {
    'map.posegraph': (lambda folder: BOOST, 'a pose graph of slam_toolbox'),
    'map.data': (lambda folder: BOOST, 'a pose graph of slam_toolbox'),
    'map.pbstream': (lambda folder: CARTOGRAPHER, 'a state of Cartographer'),
    'map.bag': (ros1, 'a ROS 1 bag, of which `replay` makes a map'),
    'map.mcap': (mcap, 'a bag, of which `replay` makes a map'),
    'map.db3': (sqlite, 'a bag, of which `replay` makes a map'),
    'map.npz': (lambda folder: archive(), 'a NumPy archive'),
    'map.pgm': (lambda folder: image('PPM'), 'an image, which a YAML file'),
    'map.png': (lambda folder: image('PNG'), 'an image, which a YAML file'),
    'map.jpg': (lambda folder: image('JPEG'), 'an image, which a YAML file'),
}


@pytest.mark.parametrize('name', KINDS)
@pytest.mark.parametrize('read', [read_map, read_world, lambda path: read_piece(str(path))])
def test_a_file_that_is_no_map_is_named(tmp_path: Path, name: str, read) -> None:
    make, kind = KINDS[name]
    path = tmp_path / name
    path.write_bytes(make(tmp_path))
    with pytest.raises(InputError) as error:
        read(path)
    text = str(error.value)
    assert text.startswith(f'{path}: {kind}')
    assert ': expected a ' in text and text.isprintable()


def test_a_text_that_only_mentions_another_kind_is_a_map(tmp_path: Path) -> None:
    (tmp_path / 'map.pgm').write_bytes(image('PPM'))
    (tmp_path / 'map.yaml').write_text(
        'image: map.pgm # P5, of serialization::archive\nresolution: 0.05\norigin: [0, 0, 0]\n'
    )
    assert read_map(tmp_path / 'map.yaml').shape == (4, 4)


def test_a_map_whose_image_is_called_like_a_format_is_a_map(tmp_path: Path) -> None:
    (tmp_path / 'P2_floor.pgm').write_bytes(image('PPM'))
    (tmp_path / 'map.yaml').write_text('image: P2_floor.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n')
    assert read_map(tmp_path / 'map.yaml').shape == (4, 4)


def test_a_session_of_another_kind_is_named(tmp_path: Path) -> None:
    (tmp_path / 'map.mcap').write_bytes(mcap(tmp_path))
    with pytest.raises(InputError, match='a bag, of which `replay` makes a map'):
        load_grid(str(tmp_path / 'map.mcap'))
