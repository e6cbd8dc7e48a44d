"""Worlds: obstacles are occupied, and errors are reported in one line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from thinmap_ros.core.errors import InputError
from thinmap_ros.files import worlds
from thinmap_ros.files.safe import FILES
from thinmap_ros.files.worlds import read_starts, read_world
from thinmap_ros.sim.world import World

ROOM = Path(__file__).parents[2] / 'worlds' / 'room_10x10.yaml'
BOX = {
    'resolution': 0.05,
    'wall_thickness': 0.1,
    'start': [1.0, 1.0, 0.5],
    'walls': [[[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]]],
}


def load(path: Path) -> World:
    return World.from_patch(*read_world(path))


def box(tmp_path: Path, **changes: object) -> World:
    path = tmp_path / 'w.yaml'
    path.write_text(yaml.safe_dump(BOX | changes))
    return load(path)


def is_solid(world: World, x: float, y: float) -> bool:
    row, col = world.frame.cells_of(np.array([[x, y]]))[0]
    return bool(world.occupied[row, col])


def test_walls_have_their_thickness(tmp_path: Path) -> None:
    world = box(tmp_path)
    assert not is_solid(world, 2.0, 1.5)
    for x, y in [(2.0, 0.04), (2.0, -0.04), (3.96, 1.0), (4.04, 1.0), (4.04, 3.04), (-0.04, -0.04)]:
        assert is_solid(world, x, y), (x, y)
    for x, y in [(2.0, 0.06), (2.0, -0.06), (3.94, 1.0), (4.06, 1.0), (0.06, 2.94)]:
        assert not is_solid(world, x, y), (x, y)


def test_every_axis_parallel_wall_of_the_room_is_equally_thick() -> None:
    world = load(ROOM)
    for x, y, along in [
        (3.5, 1.0, 0),
        (6.5, 8.0, 0),
        (1.0, 6.0, 1),
        (9.0, 3.4, 1),
        (0.0, 5.0, 0),
        (5.0, 10.0, 1),
    ]:
        row, col = world.frame.cells_of(np.array([[x, y]]))[0]
        across = (
            world.occupied[row, col - 10 : col + 10]
            if along == 0
            else world.occupied[row - 10 : row + 10, col]
        )
        assert across.sum() == 5, (x, y)


def test_a_slanting_wall_lets_no_ray_through(tmp_path: Path) -> None:
    from thinmap_ros.core.grid.raytrace import cast_rays

    world = box(tmp_path, walls=[*BOX['walls'], [[0, 0], [4, 3]]])
    x, y = (np.array([1.0, 2.0]) - (world.frame.origin_x, world.frame.origin_y)) / 0.05
    angles = np.linspace(-np.pi, np.pi, 4001)
    reach = cast_rays(world.occupied, x, y, angles, 200.0) * 0.05
    ends = np.array([1.0, 2.0]) + reach[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    assert np.all(ends[:, 1] - 0.75 * ends[:, 0] > 0.0)


def test_solids_are_filled(tmp_path: Path) -> None:
    world = box(tmp_path, solids=[[[1, 1], [2, 1], [2, 2], [1, 2]], [[3, 1], [3.5, 1], [3.25, 2]]])
    inside = [(1.02, 1.02), (1.98, 1.98), (1.5, 1.5), (3.25, 1.5)]
    assert all(is_solid(world, x, y) for x, y in inside)
    assert not any(
        is_solid(world, x, y) for x, y in [(0.98, 1.5), (2.02, 1.5), (3.05, 1.8), (3.45, 1.8)]
    )
    area_m2 = (int(world.occupied.sum()) - int(box(tmp_path).occupied.sum())) * 0.05**2
    assert area_m2 == pytest.approx(1.25, abs=0.02)


@settings(deadline=None, max_examples=200)
@given(
    st.floats(-0.4, 4.4),
    st.floats(-0.4, 3.4),
    st.floats(0.02, 1.2),
)
def test_contact_is_exact(x: float, y: float, radius: float) -> None:
    world = _box_world()
    rows, cols = np.nonzero(world.occupied)
    low = np.column_stack([cols, rows]) * 0.05 + (world.frame.origin_x, world.frame.origin_y)
    nearest = np.clip([x, y], low, low + 0.05)
    gap = float(np.hypot(*(nearest - [x, y]).T).min())
    if abs(gap - radius) > 1e-9 and world.is_clear(2.0, 1.5, 0.1):
        assert world.is_clear(x, y, radius) == (
            gap > radius and -0.25 <= x < 4.25 and -0.25 <= y < 3.25
        )


_BOXES: list[World] = []


def _box_world() -> World:
    if not _BOXES:
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            _BOXES.append(box(Path(folder)))
    return _BOXES[0]


def test_the_room_is_the_papers(tmp_path: Path) -> None:
    world = load(ROOM)
    assert world.name == 'room_10x10'
    assert world.frame.resolution == 0.02
    assert world.is_clear(*world.start[:2], 0.3)
    inside = world.frame.cells_of(np.array([[0.0, 0.0], [10.0, 10.0]]))
    assert tuple(inside[1] - inside[0]) == (500, 500)


def test_passages_of_the_room_are_a_metre_wide() -> None:
    from scipy import ndimage

    world = load(ROOM)
    wide, _ = ndimage.label(world.distance_to_wall_m > 0.5)
    corners = [(1.5, 1.5), (1.0, 9.0), (9.0, 9.0), (9.0, 1.0), (5.0, 1.0), (1.0, 5.0)]
    places = world.frame.cells_of(np.array(corners))
    assert len(set(wide[places[:, 0], places[:, 1]])) == 1
    assert wide[tuple(places[0])] > 0


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        ({'resolution': 0}, 'resolution'),
        ({'resolution': 'fine'}, 'resolution'),
        ({'start': [1, 2]}, 'start'),
        ({'start': [1, 2, float('nan')]}, 'start'),
        ({'walls': 5}, 'walls'),
        ({'walls': [[[0, 0]]]}, r'walls\[0\]'),
        ({'walls': [[[0, 0], [1]]]}, r'walls\[0\]'),
        ({'walls': []}, 'walls'),
        ({'solids': [[[0, 0], [1, 1]]]}, r'solids\[0\]'),
        ({'wall_thickness': 0.01}, 'wall_thickness'),
        ({'walls': [[[0, 0], [1e9, 1]]]}, 'point wrong'),
        ({'walls': [[[-1e308, 0], [1e308, 1]]]}, 'point wrong'),
        ({'colour': 'red'}, 'colour'),
    ],
)
def test_errors_are_reported(tmp_path: Path, change: dict[str, object], said: str) -> None:
    with np.errstate(all='ignore'), pytest.raises(InputError, match=said) as error:
        box(tmp_path, **change)
    assert str(tmp_path / 'w.yaml') in str(error.value)
    assert '\n' not in str(error.value)


def test_a_world_may_have_as_many_cells_as_the_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = box(tmp_path).occupied.size
    monkeypatch.setattr(worlds, 'FILES', replace(FILES, world_cells=size))
    assert box(tmp_path).occupied.size == size
    monkeypatch.setattr(worlds, 'FILES', replace(FILES, world_cells=size - 1))
    with pytest.raises(InputError, match=f'expected at most {size - 1}'):
        box(tmp_path)


@pytest.mark.parametrize(
    'text', ['', '- 1', 'a: [', 'd: 2001-99-99', '{' * 5000, '\x00', 'a: !!python/object:x {}']
)
def test_text_that_is_no_world(tmp_path: Path, text: str) -> None:
    path = tmp_path / 'w.yaml'
    path.write_text(text)
    with pytest.raises(InputError, match=r'w\.yaml'):
        load(path)


def test_no_file_and_no_text(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='No such file'):
        load(tmp_path / 'none.yaml')
    (tmp_path / 'b.yaml').write_bytes(b'\xff\xfe\x00')
    with pytest.raises(InputError, match=r'b\.yaml'):
        load(tmp_path / 'b.yaml')


def test_a_map_is_a_world(tmp_path: Path) -> None:
    from PIL import Image

    grey = np.full((20, 30), 254, dtype=np.uint8)
    grey[0] = 0
    grey[-1] = 0
    grey[:, 0] = 0
    grey[:, -1] = 0
    grey[2, 5] = 205
    Image.fromarray(grey).save(tmp_path / 'm.pgm')
    (tmp_path / 'm.yaml').write_text(
        'image: m.pgm\nresolution: 0.1\norigin: [-1.0, 2.0, 0]\nnegate: 0\n'
        'occupied_thresh: 0.65\nfree_thresh: 0.196\n'
    )
    world = load(tmp_path / 'm.yaml')
    assert world.occupied.shape == (20, 30)
    assert world.occupied[17, 5] == 1, 'unknown is solid, and rows are turned over'
    assert world.occupied[2, 5] == 0
    assert (world.frame.origin_x, world.frame.origin_y) == (-1.0, 2.0)
    assert np.isnan(world.start[:2]).all()


def test_starts_of_several_robots_are_read(tmp_path):
    path = tmp_path / 'w.yaml'
    walls = 'resolution: 0.1\nwall_thickness: 0.2\nstart: [1, 1, 0]\nwalls: [[[0, 0], [3, 0]]]\n'
    path.write_text(walls)
    assert read_starts(path).shape == (0, 3)
    path.write_text(f'{walls}starts: [[1, 1, 0], [2, 1, 1.5]]\n')
    assert read_starts(path).tolist() == [[1.0, 1.0, 0.0], [2.0, 1.0, 1.5]]
    read_world(path)
    for wrong in ('[[1, 1]]', '[1, 1, 0]', 'here', '[[1, 1, .inf]]', '{}'):
        path.write_text(f'{walls}starts: {wrong}\n')
        with pytest.raises(InputError, match=r'w\.yaml: starts: '):
            read_starts(path)
