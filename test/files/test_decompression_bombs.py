"""Small files that expand to huge data: rejected at once, with an error of one line."""

import json
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.files.occupancy_maps import read_map
from thinmap_ros.files.safe import parse_yaml
from thinmap_ros.files.worlds import read_starts, read_tour, read_world

WORLD = {'resolution': 0.1, 'wall_thickness': 0.2, 'start': [1, 1, 0], 'walls': [[[0, 0], [4, 0]]]}
MAP = {'image': 'm.png', 'resolution': 0.05, 'origin': [0, 0, 0]}
LONGEST = 500  # characters: a path, two values and what was expected


def nested(levels: int, repeated: str) -> str:
    """Lists of nine aliases of the previous list each."""
    lines = [f'a0: &a0 [{repeated}]']
    for i in range(1, levels):
        lines.append(f'a{i}: &a{i} [{", ".join(9 * [f"*a{i - 1}"])}]')
    return '\n'.join(lines)


def merged(levels: int) -> str:
    lines = ['a0: &a0 {k: 1}']
    for i in range(1, levels):
        lines.append(f'a{i}: &a{i} {{<<: [{", ".join(9 * [f"*a{i - 1}"])}]}}')
    return '\n'.join(lines)


BOMBS = {
    'aliases': nested(7, 'x, x, x, x, x, x, x, x, x') + '\nimage: *a6\n',
    'merge keys': merged(8) + '\nimage: m.png\n',
    'one merge key': 'image: m.png\n<<: {resolution: 1}\n',
    'a list in itself': '&a [*a]',
    'depth': 'walls: ' + 100_000 * '[',
    'depth, closed': 'walls: ' + 500 * '[' + 500 * ']',
    'nodes': 'walls: [' + 300_000 * '1,' + ']',
    'digits': 'resolution: ' + 400 * '9',
    'more digits': 'resolution: ' + 100_000 * '9',
    'sixties': 'resolution: 1' + 100_000 * ':1',
    'hexadecimal': 'resolution: 0x' + 400_000 * 'f',
    'a long key': 4_000_000 * 'k' + ': 1',
    'a long tag': 'walls: !' + 200_000 * 't' + ' 1',
    'an alias with a long name': 'walls: *' + 200_000 * 'a',
    'a long text': 'image: ' + 2_000_000 * 'x',
    'a long text for a number': 'resolution: ' + 2_000_000 * 'x',
    'bytes': 5_000_000 * ' ',
    'a date': 'start: 2001-99-99',
}


@pytest.mark.parametrize('name', BOMBS)
@pytest.mark.parametrize('read', [read_map, read_world, read_tour, read_starts])
def test_yaml_bombs(tmp_path: Path, name: str, read: object) -> None:
    path = tmp_path / 'm.yaml'
    path.write_text(BOMBS[name])
    begun = time.process_time()
    try:
        read(path)  # type: ignore[operator]
    except InputError as error:
        assert len(str(error)) <= LONGEST and '\n' not in str(error)
    else:
        # Parts of a world, which may have none.
        assert read in (read_tour, read_starts)
    # Fast on a slow machine, too: without limits some of these took minutes.
    assert time.process_time() - begun < 10.0


def test_what_yaml_is_for_is_read() -> None:
    text = 'a: [1, 2.5, 0x1f, .inf, yes, null, 2001-02-03, text]\nb:\n  c: {d: "<<"}\n'
    assert parse_yaml(text) == yaml.safe_load(text)
    assert parse_yaml('') is None


@pytest.mark.parametrize('digits', [100, 101, 400, 5000])
@pytest.mark.parametrize(
    'key', ['resolution', 'wall_thickness', 'start', 'walls', 'tour', 'name', 'starts']
)
def test_numbers_of_many_digits_in_a_world(tmp_path: Path, key: str, digits: int) -> None:
    path = tmp_path / 'w.yaml'
    value = {
        'start': '[{}, 0, 0]',
        'walls': '[[[0, 0], [{}, 0]]]',
        'tour': '[[{}, 0]]',
        'starts': '[[{}, 0, 0]]',
    }.get(key, '{}')
    lines = [f'{k}: {json.dumps(v)}' for k, v in WORLD.items() if k != key]
    path.write_text('\n'.join([*lines, f'{key}: {value.format(digits * "9")}']))
    if digits == 100 and key in ('start', 'starts', 'tour', 'name'):
        read_world(path), read_tour(path), read_starts(path)
        return
    with pytest.raises(InputError) as error:
        read_world(path)
        read_tour(path)
        read_starts(path)
    assert len(str(error.value)) <= LONGEST


def test_keys_of_several_kinds_in_a_world(tmp_path: Path) -> None:
    path = tmp_path / 'w.yaml'
    path.write_text(yaml.safe_dump(WORLD) + '1: 2\nzz: 3\n')
    with pytest.raises(InputError, match='key 1: expected a name'):
        read_world(path)


@pytest.mark.parametrize(
    'value',
    [
        10**5000,
        -(10**400),
        10**7 * 'x',
        10**6 * [1],
        {10**4000: 1},
        100_000 * '\n',
        'a\x1b[31m\u2028b',
        [[[[[1]]]]],
    ],
    ids=range(8),
)
def test_whatever_is_quoted_is_short_and_on_one_line(value: object) -> None:
    text = quoted(value)
    assert 0 < len(text) <= 200 and text.isprintable()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack('>I', len(data)) + kind + data + struct.pack('>I', zlib.crc32(kind + data))


def png(width: int, height: int, *extra: bytes) -> bytes:
    """A PNG of one colour, 1 bit per pixel, with the highest compression."""
    row = b'\0' + (width + 7) // 8 * b'\xff'
    packer = zlib.compressobj(9)
    block = min(height, 1 + 2**20 // len(row))  # rows that are packed at once
    rows = b''.join(packer.compress(block * row) for _ in range(height // block))
    rows += packer.compress(height % block * row) + packer.flush()
    header = chunk(b'IHDR', struct.pack('>IIBBBBB', width, height, 1, 0, 0, 0, 0))
    return (
        b'\x89PNG\r\n\x1a\n' + header + b''.join(extra) + chunk(b'IDAT', rows) + chunk(b'IEND', b'')
    )


def peak_mb(
    path: Path, module: str = 'thinmap_ros.files.occupancy_maps', reader: str = 'read_map'
) -> tuple[float, str]:
    """Peak memory of reading a map, in MB above that of a small one, and its shape or error."""
    code = """
import sys
from importlib import import_module
from pathlib import Path
from thinmap_ros.core.errors import InputError

def shape(path):
    read = getattr(import_module(sys.argv[1]), sys.argv[2])
    if sys.argv[2] == 'read_map':
        return read(Path(path)).shape
    return read(path).known_area().shape

def peak_kb():
    # Not ru_maxrss: after a fork that is at least what the parent had.
    return int(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])

shape(sys.argv[3])
before = peak_kb()
try:
    said = str(shape(sys.argv[4]))
except InputError as error:
    said = str(error)
print((peak_kb() - before) / 1024.0, said)
"""
    small = path.parent / 'small.yaml'
    small.write_text(yaml.safe_dump(MAP | {'image': 'small.png'}))
    (path.parent / 'small.png').write_bytes(png(8, 8))
    done = subprocess.run(
        [sys.executable, '-c', code, module, reader, small, path],
        capture_output=True,
        text=True,
        check=True,
    )
    megabytes, said = done.stdout.split(' ', 1)
    return float(megabytes), said.strip()


BIG_HEADERS = {
    'png': png(8, 8)[:8]
    + chunk(b'IHDR', struct.pack('>IIBBBBB', 17000, 17000, 1, 0, 0, 0, 0))
    + png(8, 8)[33:],
    'pgm': b'P5\n100000 100000\n255\n' + 100 * b'\0',
    'p2': b'P2\n17000 17000\n255\n' + 100 * b'0 ',
}


@pytest.mark.programs
@pytest.mark.parametrize('size', [(16_385, 16_384), (67_108_864, 1), (1, 67_108_864), (16_385, 64)])
def test_a_png_of_more_pixels_than_any_map_has(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / 'm.yaml'
    path.write_text(yaml.safe_dump(MAP))
    (tmp_path / 'm.png').write_bytes(png(*size))
    assert (tmp_path / 'm.png').stat().st_size < 200_000
    megabytes, said = peak_mb(path)
    assert megabytes < 50.0 and 'pixels' in said and len(said) <= LONGEST


@pytest.mark.programs
@pytest.mark.parametrize('size', [(8192, 8192), (16_384, 2048), (4000, 4000)])
def test_large_maps_take_a_few_bytes_a_pixel(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / 'm.yaml'
    path.write_text(yaml.safe_dump(MAP))
    (tmp_path / 'm.png').write_bytes(png(*size))
    megabytes, said = peak_mb(path)
    assert said == str(size[::-1])
    pixels = size[0] * size[1]
    # The image, its cells, and one strip; without strips it was six times as much.
    assert megabytes < 3.0 * pixels / 2**20 + 20.0
    megabytes, said = peak_mb(path, 'thinmap_ros.files.sessions', 'load_grid')
    assert said == str(size[::-1])
    # Two bytes a cell of the grid, and the cells that it publishes.
    assert megabytes < 9.0 * pixels / 2**20 + 20.0


@pytest.mark.programs
def test_an_image_of_200_million_pixels_is_read(tmp_path: Path) -> None:
    path = tmp_path / 'm.yaml'
    path.write_text(yaml.safe_dump(MAP))
    (tmp_path / 'm.png').write_bytes(png(16_384, 12_288))
    megabytes, said = peak_mb(path)
    assert said == '(12288, 16384)'
    assert megabytes < 3.0 * 192.0 + 20.0
    # A grid that is mapped on has fewer cells; what it lacks the memory for is not begun.
    megabytes, said = peak_mb(path, 'thinmap_ros.files.sessions', 'load_grid')
    assert said.endswith('tiles: expected 32768 at most')
    assert megabytes < 4.0 * 192.0 + 20.0


@pytest.mark.parametrize('magic', [b'P5', b'P2'])
def test_a_pgm_whose_header_is_a_comment(tmp_path: Path, magic: bytes) -> None:
    path = tmp_path / 'm.yaml'
    path.write_text(yaml.safe_dump(MAP))
    comment = 50 * 2**20 * b'#'
    (tmp_path / 'm.png').write_bytes(magic + b'\n' + comment + b'\n2 2\n255\n' + 4 * b'0 ')
    begun = time.process_time()
    with pytest.raises(InputError, match=r'm\.png: .*expected an image'):
        read_map(path)
    # Byte by byte it took longer than a minute.
    assert time.process_time() - begun < 5.0


def test_a_pgm_with_comments_between_its_pixels(tmp_path: Path) -> None:
    path = tmp_path / 'm.yaml'
    path.write_text(yaml.safe_dump(MAP))
    (tmp_path / 'm.png').write_bytes(b'P2\n# of a room\n2 2\n255\n0 # a wall\n0 255 255\n')
    assert read_map(path).cells.tolist() == [[0, 0], [100, 100]]
    (tmp_path / 'm.png').write_bytes(b'P2\n2 2\n255\n' + 2**20 * b'#\n' + b'0 0 255 255\n')
    begun = time.process_time()
    with pytest.raises(InputError, match='more than 100 comments'):
        read_map(path)
    assert time.process_time() - begun < 5.0


@pytest.mark.programs
@pytest.mark.parametrize('kind', ['zTXt', 'iTXt', 'iCCP'])
def test_bombs_beside_the_pixels(tmp_path: Path, kind: str) -> None:
    packed = zlib.compress(bytes(200_000_000), 9)
    heads = {'zTXt': b'Comment\0\0', 'iTXt': b'Comment\0\1\0\0\0', 'iCCP': b'profile\0\0'}
    path = tmp_path / 'm.yaml'
    path.write_text(yaml.safe_dump(MAP))
    (tmp_path / 'm.png').write_bytes(png(8, 8, chunk(kind.encode(), heads[kind] + packed)))
    megabytes, said = peak_mb(path)
    assert megabytes < 50.0, said


@pytest.mark.parametrize('header', ['png', 'pgm', 'p2'])
def test_headers_that_say_more_than_is_there(tmp_path: Path, header: str) -> None:
    path = tmp_path / 'm.yaml'
    path.write_text(yaml.safe_dump(MAP))
    (tmp_path / 'm.png').write_bytes(BIG_HEADERS[header])
    with pytest.raises(InputError) as error:
        read_map(path)
    assert 'pixels' in str(error.value) and len(str(error.value)) <= LONGEST


def test_images_that_a_program_would_have_to_be_run_for(tmp_path: Path) -> None:
    path = tmp_path / 'm.yaml'
    path.write_text(yaml.safe_dump(MAP))
    Image.fromarray(np.zeros((4, 4), dtype=np.uint8)).save(tmp_path / 'm.png', format='EPS')
    with pytest.raises(InputError, match='no PGM, PNG, BMP or JPEG image'):
        read_map(path)


@pytest.mark.parametrize('name', ['x\ny.png', 100_000 * 'x', 'a\0b', '../m.png', '/etc/hostname'])
def test_names_of_images(tmp_path: Path, name: str) -> None:
    path = tmp_path / 'below' / 'm.yaml'
    path.parent.mkdir()
    path.write_text(yaml.safe_dump(MAP | {'image': name}))
    (tmp_path / 'm.png').write_bytes(png(8, 8))
    with pytest.raises(InputError) as error:
        read_map(path, path.parent.resolve())
    assert len(str(error.value)) <= LONGEST and '\n' not in str(error.value)
    (path.parent / 'link.png').symlink_to(tmp_path / 'm.png')
    path.write_text(yaml.safe_dump(MAP | {'image': 'link.png'}))
    assert read_map(path).shape == (8, 8)
    with pytest.raises(InputError, match='expected a file below'):
        read_map(path, path.parent.resolve())
