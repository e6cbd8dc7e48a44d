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
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.files.occupancy_maps import read_map, write_map

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


@pytest.mark.parametrize('negate', [1, True])
def test_negate(tmp_path: Path, negate: object) -> None:
    grey = np.array([[0, 255]], dtype=np.uint8)
    assert read_map(described(tmp_path, grey, negate=negate)).cells[0].tolist() == [0, 100]
    assert read_map(described(tmp_path, grey, negate=0)).cells[0].tolist() == [100, 0]


def test_scale_mode_and_transparency(tmp_path: Path) -> None:
    ramp = np.arange(255, -1, -15, dtype=np.uint8)[None]
    cells = read_map(
        described(tmp_path, ramp, mode='scale', free_thresh=0.1, occupied_thresh=0.9)
    ).cells[0]
    assert cells[0] == 0 and cells[-1] == 100
    # As map_server: 1 + 98 times the share between the thresholds.
    assert cells[[8, 15]].tolist() == [1 + 45, 1 + 95]
    assert np.all(np.diff(cells) >= 0) and len(set(cells.tolist())) > 10
    rgba = np.zeros((1, 2, 4), dtype=np.uint8)
    rgba[0, 0, 3] = 255
    assert read_map(described(tmp_path, rgba, 'png', mode='scale')).cells[0].tolist() == [100, -1]


def test_other_images(tmp_path: Path) -> None:
    colours = np.array([[[255, 255, 255], [0, 0, 0]]], dtype=np.uint8)
    assert read_map(described(tmp_path, colours, 'png')).cells[0].tolist() == [0, 100]
    deep = np.array([[65535, 0]], dtype=np.uint16)
    assert read_map(described(tmp_path, deep, 'png')).cells[0].tolist() == [0, 100]


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
        ({'mode': 'raw'}, 'mode'),
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
