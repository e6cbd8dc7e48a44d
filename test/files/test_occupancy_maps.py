"""map_server files.

Compatible with other readers and writers of the format.
"""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.files.occupancy_maps import read_map, write_map
from thinmap_ros.files.safe import number_of, parse_yaml

YAML = {
    'image': 'm.pgm',
    'resolution': 0.05,
    'origin': [-1.5, 2.25, 0.0],
    'negate': 0,
    'occupied_thresh': 0.65,
    'free_thresh': 0.196,
}


def described(tmp_path: Path, grey: np.ndarray, suffix: str = 'pgm', **changes: object) -> Path:
    Image.fromarray(grey).save(tmp_path / f'm.{suffix}')
    path = tmp_path / 'm.yaml'
    path.write_text(yaml.safe_dump(YAML | {'image': f'm.{suffix}'} | changes))
    return path


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    arrays(
        np.int8,
        st.tuples(st.integers(1, 12), st.integers(1, 12)),
        elements=st.sampled_from([-1, 0, 100]),
    ),
    st.integers(-400, 400),
    st.integers(-400, 400),
)
def test_round_trip(tmp_path: Path, cells: np.ndarray, col: int, row: int) -> None:
    patch = GridPatch(GridFrame(col * 0.1, row * 0.1, 0.1), cells)
    again = read_map(write_map(tmp_path / 'map', patch))
    assert np.array_equal(again.cells, cells)
    assert again.frame.resolution == 0.1
    assert (again.frame.origin_x, again.frame.origin_y) == pytest.approx(
        (col * 0.1, row * 0.1), abs=1e-6
    )


def test_each_state_is_read_back_as_what_it_is(tmp_path: Path) -> None:
    cells = np.array([[-1, 0, 10, 25, 26, 50, 64, 65, 100]], dtype=np.int8)
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), cells)
    again = read_map(write_map(tmp_path / 'map', patch))
    for state in ('free', 'occupied', 'unknown'):
        assert np.array_equal(getattr(again, state), getattr(patch, state)), state


def test_rows_are_turned_over_and_the_image_is_a_pgm(tmp_path: Path) -> None:
    cells = np.full((3, 2), UNKNOWN, dtype=np.int8)
    cells[0, 0] = 100
    cells[2, 1] = 0
    path = write_map(tmp_path / 'sub' / 'map', GridPatch(GridFrame(1.0, 2.0, 0.1), cells))
    assert path == tmp_path / 'sub' / 'map.yaml'
    assert (tmp_path / 'sub' / 'map.pgm').read_bytes().startswith(b'P5')
    grey = np.asarray(Image.open(tmp_path / 'sub' / 'map.pgm'))
    assert grey.tolist() == [[205, 254], [205, 205], [0, 205]]
    assert yaml.safe_load(path.read_text())['origin'] == [1.0, 2.0, 0.0]
    assert sorted(p.name for p in (tmp_path / 'sub').iterdir()) == ['map.pgm', 'map.yaml']


def test_thresholds_of_a_trinary_map(tmp_path: Path) -> None:
    grey = np.array([[0, 88, 90, 150, 204, 206, 255]], dtype=np.uint8)
    patch = read_map(described(tmp_path, grey))
    # darkness: 1, 0.655, 0.647, 0.412, 0.2, 0.192, 0
    assert patch.cells[0].tolist() == [100, 100, -1, -1, -1, 0, 0]
    assert patch.frame == GridFrame(-1.5, 2.25, 0.05)


def test_a_darkness_equal_to_a_threshold_is_unknown(tmp_path: Path) -> None:
    grey = np.array([[50, 51, 52, 203, 204, 205]], dtype=np.uint8)
    patch = read_map(
        described(tmp_path, grey, negate=1, free_thresh=51 / 255, occupied_thresh=204 / 255)
    )
    assert patch.cells[0].tolist() == [0, -1, -1, -1, -1, 100]


@pytest.mark.parametrize('negate', [1, True, 'yes', 'Y', 'ON'])
def test_negate(tmp_path: Path, negate: object) -> None:
    grey = np.array([[0, 255]], dtype=np.uint8)
    assert read_map(described(tmp_path, grey, negate=negate)).cells[0].tolist() == [0, 100]
    for none in (0, False, 'no', 'Off'):
        assert read_map(described(tmp_path, grey, negate=none)).cells[0].tolist() == [100, 0]


def test_scale_mode_and_transparency(tmp_path: Path) -> None:
    ramp = np.arange(255, -1, -15, dtype=np.uint8)[None]
    cells = read_map(
        described(tmp_path, ramp, mode='scale', free_thresh=0.1, occupied_thresh=0.9)
    ).cells[0]
    assert cells[0] == 0 and cells[-1] == 100
    # As map_server: 100 times the share between the thresholds, (0.47 - 0.1) / 0.8 and so on.
    assert cells[[8, 15]].tolist() == [46, 98]
    assert np.all(np.diff(cells) >= 0) and len(set(cells.tolist())) > 10
    rgba = np.zeros((1, 3, 4), dtype=np.uint8)
    rgba[0, :, 3] = [255, 0, 254]
    for mode, expected in (('scale', [100, -1, -1]), ('trinary', [100, -1, 100])):
        cells = read_map(described(tmp_path, rgba, 'png', mode=mode)).cells
        assert cells[0].tolist() == expected


@pytest.mark.parametrize('deep', [False, True])
def test_raw_mode(tmp_path: Path, deep: bool) -> None:
    grey = np.array([[0, 1, 50, 100, 101, 205, 255]], dtype=np.uint8)
    image = grey.astype(np.uint16) * 257 if deep else grey
    for negate in (0, 1):  # of no meaning in this mode
        cells = read_map(described(tmp_path, image, 'png', mode='Raw', negate=negate)).cells
        assert cells[0].tolist() == [0, 1, 50, 100, -1, -1, -1]


def test_other_images(tmp_path: Path) -> None:
    colours = np.array([[[255, 255, 255], [0, 0, 0]]], dtype=np.uint8)
    assert read_map(described(tmp_path, colours, 'png')).cells[0].tolist() == [0, 100]
    deep = np.array([[65535, 0]], dtype=np.uint16)
    assert read_map(described(tmp_path, deep, 'png')).cells[0].tolist() == [0, 100]


WALLS = {(255, 0, 0): 100, (0, 255, 0): 100, (0, 0, 255): 100, (200, 80, 0): -1, (255, 255, 0): -1}


@pytest.mark.parametrize('colour', WALLS)
@pytest.mark.parametrize('kind', ['RGB', 'RGBA', 'P'])
def test_colours_count_by_their_mean(
    tmp_path: Path, colour: tuple[int, int, int], kind: str
) -> None:
    pixels = np.array([[colour, (254, 254, 254)]], dtype=np.uint8)
    path = described(tmp_path, pixels, 'png')
    Image.fromarray(pixels).convert(kind).save(tmp_path / 'm.png')
    assert read_map(path).cells[0].tolist() == [WALLS[colour], 0]


def test_a_mean_on_a_threshold_is_that_of_the_grey(tmp_path: Path) -> None:
    grey = np.arange(256, dtype=np.uint8)[None]
    cells = read_map(described(tmp_path, grey)).cells
    colours = np.repeat(grey[..., None], 3, axis=-1)
    # The same mean, with another red and green.
    between = (grey > 0) & (grey < 255)
    colours[..., 0] -= between
    colours[..., 1] += between
    assert np.array_equal(read_map(described(tmp_path, colours, 'png')).cells, cells)
    deep = grey.astype(np.uint16) * 257
    assert np.array_equal(read_map(described(tmp_path, deep, 'png')).cells, cells)


def transparent_pictures() -> dict[str, tuple[Image.Image, dict[str, object]]]:
    """A wall, free floor, and a transparent pixel, in each form that PNG has."""
    grey = np.array([[0, 254, 100]], dtype=np.uint8)
    alpha = np.array([[255, 255, 0]], dtype=np.uint8)
    colours = np.dstack([grey, grey, grey])
    palette = Image.fromarray(np.array([[0, 1, 2]], dtype=np.uint8), 'P')
    palette.putpalette([0, 0, 0, 254, 254, 254, 255, 255, 255])
    return {
        'LA': (Image.fromarray(np.dstack([grey, alpha]), 'LA'), {}),
        'RGBA': (Image.fromarray(np.dstack([colours, alpha])), {}),
        'palette, an index': (palette, {'transparency': 2}),
        'palette, an alpha for each': (palette, {'transparency': b'\xff\xff\x00'}),
        'a grey': (Image.fromarray(grey), {'transparency': 100}),
        'a colour': (Image.fromarray(colours), {'transparency': (100, 100, 100)}),
        'a grey of 16 bit': (
            Image.fromarray(grey.astype(np.uint16) * 257),
            {'transparency': 25700},
        ),
    }


@pytest.mark.parametrize('name', transparent_pictures())
def test_transparent_pixels_are_unknown(tmp_path: Path, name: str) -> None:
    picture, options = transparent_pictures()[name]
    path = described(tmp_path, np.zeros((1, 1), dtype=np.uint8), 'png')
    picture.save(tmp_path / 'm.png', **options)
    assert read_map(path).cells[0].tolist() == [100, 0, -1]


def with_line(tmp_path: Path, line: str) -> Path:
    """A map whose description has a line as it is written."""
    path = described(tmp_path, np.zeros((2, 2), dtype=np.uint8))
    key = line.split(':')[0]
    rest = [f'{k}: {v}' for k, v in YAML.items() if k != key]
    path.write_text('\n'.join([*rest, line]))
    return path


@pytest.mark.parametrize(
    ('written', 'value'),
    [
        ('1e-1', 0.1),
        ('1E+00', 1.0),
        ('5.e-2', 0.05),
        ('.5', 0.5),
        ('+.5', 0.5),
        ('+1.0', 1.0),
        ('010', 10.0),  # octal in YAML 1.1
        ('"0.05"', 0.05),
        ('!!float 1', 1.0),
    ],
)
def test_numbers_are_those_of_yaml_cpp(tmp_path: Path, written: str, value: float) -> None:
    assert read_map(with_line(tmp_path, f'resolution: {written}')).frame.resolution == value
    frame = read_map(with_line(tmp_path, f'origin: [-1e+3, {written}, -0]')).frame
    assert (frame.origin_x, frame.origin_y) == (-1000.0, value)


@pytest.mark.parametrize(
    'written',
    ['0x1', '0b1', '0o1', '1_0', '0:1', '1e', 'e1', '.', '1.0f', 'true', 'null', '\u0661'],
)
def test_what_yaml_cpp_does_not_read_as_a_number(tmp_path: Path, written: str) -> None:
    with pytest.raises(InputError, match=r'resolution: .*expected a number'):
        read_map(with_line(tmp_path, f'resolution: {written}'))


def test_an_image_whose_name_looks_like_another_type(tmp_path: Path) -> None:
    for name in ('2026-01-02', '12', 'on', '~'):
        path = with_line(tmp_path, f'image: {name}')
        (tmp_path / 'm.pgm').rename(tmp_path / name)
        assert read_map(path).shape == (2, 2)


# As map_saver writes a map: half of it unknown.
SAVED = np.array([[205, 205, 205, 0], [205, 254, 254, 0]], dtype=np.uint8)
PAINTED = np.array([[205, 205, 205, 170], [205, 255, 254, 0]], dtype=np.uint8)
DRAWN = np.array([[205, 220, 235, 0], [120, 254, 254, 0]], dtype=np.uint8)


def test_unknown_cells_that_become_free_are_counted_in_a_line(tmp_path: Path) -> None:
    def lines(grey: np.ndarray, **changes: object) -> list[str]:
        said: list[str] = []
        suffix = 'png' if grey.ndim == 3 else 'pgm'
        cells = read_map(described(tmp_path, grey, suffix, **changes), report=said.append).cells
        assert all('\n' not in line and str(tmp_path / 'm.yaml') in line for line in said)
        assert said or np.count_nonzero(cells == UNKNOWN) >= 4 or grey is DRAWN
        return said

    assert lines(SAVED) == []
    (line,) = lines(SAVED, free_thresh=0.25)
    assert '4 cells of grey 205' in line and 'are free' in line and 'free_thresh: 0.196' in line
    assert '4 cells' in lines(PAINTED, free_thresh=0.25)[0]
    assert '4 cells of grey 50' in lines(255 - SAVED, free_thresh=0.25, negate=1)[0]
    assert '4 cells' in lines(np.dstack([SAVED] * 3), free_thresh=0.25)[0]
    assert 'mode: trinary' in lines(SAVED, mode='scale')[0]
    assert lines(DRAWN, free_thresh=0.25) == []  # greys of a picture
    assert lines(SAVED, mode='raw', free_thresh=0.25) == []
    with pytest.warns(UserWarning, match='4 cells of grey 205'):
        read_map(described(tmp_path, SAVED, free_thresh=0.25))


@pytest.mark.parametrize('grey', [SAVED, PAINTED])
def test_unknown_cells_are_kept_on_request(tmp_path: Path, grey: np.ndarray) -> None:
    right = read_map(described(tmp_path, grey)).cells
    said: list[str] = []
    path = described(tmp_path, grey, free_thresh=0.25)
    assert np.count_nonzero(read_map(path, report=said.append).cells != right) == 4
    kept = read_map(path, report=said.append, keeps_unknown=True)
    assert np.array_equal(kept.cells, right)
    assert 'are free' in said[0] and 'are unknown here' in said[1]
    drawn = read_map(described(tmp_path, DRAWN, free_thresh=0.25), keeps_unknown=True)
    assert drawn.cells[1, 0] == 0  # as in map_server


@given(st.floats(allow_nan=False))
def test_every_number_is_read_back_from_its_text(number: float) -> None:
    text = repr(number).replace('inf', '.inf')
    assert number_of(text) == number
    assert parse_yaml(f'a: {text}') == {'a': number}


@pytest.mark.parametrize('written', ['1e5', '-.5', '1.e2', '010', '1:30', '1_000', '+12', 'y'])
def test_other_yaml_files_have_the_same_numbers(written: str) -> None:
    value = parse_yaml(written)
    try:
        assert value == number_of(written) and isinstance(value, float | int)
    except ValueError:
        assert value == written


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'origin': [0, 0, float('nan')]}, 'origin'),
        ({'origin': [0, 0]}, 'origin'),
        ({'origin': [0, 'a', 0]}, 'origin'),
        ({'origin': [0, float('inf'), 0]}, 'origin'),
        ({'resolution': 0}, 'resolution'),
        ({'resolution': None}, 'resolution'),
        ({'image': None}, 'image'),
        ({'image': 'other.pgm'}, 'other.pgm'),
        ({'image': 'm.yaml'}, 'm.yaml'),
        ({'image': '.'}, 'expected an image'),
        ({'mode': 'colour'}, 'mode'),
        ({'negate': 2}, 'negate'),
        ({'free_thresh': 0.7}, 'free_thresh'),
        ({'occupied_thresh': 'x'}, 'occupied_thresh'),
    ],
)
def test_errors_are_reported(tmp_path: Path, changes: dict[str, object], said: str) -> None:
    path = described(tmp_path, np.zeros((2, 2), dtype=np.uint8))
    path.write_text(yaml.safe_dump(YAML | changes))
    with pytest.raises(InputError, match=said) as error:
        read_map(path)
    assert str(tmp_path) in str(error.value) and '\n' not in str(error.value)


@settings(
    deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.binary(max_size=120), st.sampled_from(['pgm', 'png']), st.integers(0, 200))
def test_damaged_images(tmp_path: Path, noise: bytes, suffix: str, at: int) -> None:
    path = described(tmp_path, np.arange(100, dtype=np.uint8).reshape(10, 10), suffix)
    image = tmp_path / f'm.{suffix}'
    whole = image.read_bytes()
    image.write_bytes(whole[:at] + noise)
    try:
        read_map(path)
    except InputError as error:
        assert '\n' not in str(error)


@settings(
    deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.text(max_size=80) | st.binary(max_size=80))
def test_damaged_yaml(tmp_path: Path, content: str | bytes) -> None:
    path = tmp_path / 'm.yaml'
    path.write_bytes(
        content.encode('utf-8', errors='replace') if isinstance(content, str) else content
    )
    with pytest.raises(InputError) as error:
        read_map(path)
    assert '\n' not in str(error.value)


def test_a_write_that_fails_leaves_the_old_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((2, 2), dtype=np.int8))
    write_map(tmp_path / 'map', patch)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def fails(*_: object, **__: object) -> None:
        raise OSError('disk full')

    monkeypatch.setattr(Image.Image, 'save', fails)
    with pytest.raises(OSError, match='disk full'):
        write_map(tmp_path / 'map', patch)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
