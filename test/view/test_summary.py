"""The summary picture of a run."""

import numpy as np
import pytest
from PIL import Image

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.regions import RegionKind
from thinmap_ros.core.topology.segmentation import find_regions
from thinmap_ros.core.topology.topology import build
from thinmap_ros.view import palette
from thinmap_ros.view.summary import scale_bar_m, shortened, shown_area, summary_figure

WALL = (0, 0, 0)


def room(rows, cols, resolution=0.1):
    cells = np.zeros((rows, cols), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    return GridPatch(GridFrame(0.0, 0.0, resolution), cells)


def colours(path):
    with Image.open(path) as picture:
        return picture.size, set(map(tuple, np.asarray(picture.convert('RGB')).reshape(-1, 3)))


def hexed(colour):
    return tuple(palette.rgb(colour))


@pytest.fixture
def picture(tmp_path):
    return tmp_path / 'summary.png'


def test_both_paths_are_visible(picture):
    patch = room(60, 80)
    estimated = np.array([[1.0, 1.0, 0.0], [6.0, 4.0, 0.0]])
    summary_figure(
        picture,
        patch,
        build(patch, (1.0, 1.0), TopologyConfig()),
        estimated,
        estimated,
        'a room',
        find_regions(patch),
        np.array([[5.0, 3.0, 2.0]]),
    )
    size, found = colours(picture)
    assert 600 < max(size) < 2000
    expected = [palette.ESTIMATE, palette.TRUTH, palette.EDGE, palette.HIDDEN]
    expected += [palette.REGIONS[RegionKind.ROOM][0], palette.NODES[0]]
    assert {hexed(colour) for colour in expected} <= found


@pytest.mark.parametrize('shape', [(1, 1), (3, 3), (40, 5000), (5000, 40), (2000, 2000)])
def test_maps_of_any_size_make_a_picture_of_ordinary_size(picture, shape):
    patch = room(*shape)
    summary_figure(picture, patch, TopologicalMap(), np.zeros((1, 3)), title='$x_1$ 100 %')
    (width, height), found = colours(picture)
    assert 600 < width < 1500 and 300 < height < 1600
    assert picture.stat().st_size < 1_000_000
    assert WALL in found


def test_cells_are_drawn_as_they_are(picture):
    """A doubled wall stays doubled: it is what the picture is looked at for."""
    cells = np.zeros((20, 20), dtype=np.int8)
    dark = []
    for columns in ([10], [10, 12], [10, 11, 12]):
        cells[:, columns] = 100
        summary_figure(
            picture,
            GridPatch(GridFrame(0.0, 0.0, 0.1), cells),
            TopologicalMap(),
            np.empty((0, 2)),
        )
        with Image.open(picture) as drawn:
            dark.append(int((np.asarray(drawn.convert('L')) == 0).sum()))
    one_column = dark[1] - dark[0]
    assert one_column > 10_000
    assert dark[2] - dark[1] == pytest.approx(one_column, rel=0.1)


def test_the_same_picture_has_the_same_bytes(tmp_path):
    patch = room(30, 30)
    for name in ('a', 'b'):
        summary_figure(tmp_path / name, patch, TopologicalMap(), np.zeros((1, 3)))
    assert (tmp_path / 'a').read_bytes() == (tmp_path / 'b').read_bytes()


@pytest.mark.parametrize(
    ('width', 'bar'), [(10.0, 2.0), (79.0, 20.0), (300.0, 50.0), (1.0, 0.2), (4.0, 1.0)]
)
def test_scale_bars_have_round_lengths(width, bar):
    assert scale_bar_m(width) == pytest.approx(bar)


def test_a_strip_is_shown_with_space_around_it():
    left, right, bottom, top = shown_area(room(10, 3000))
    assert (left, right) == pytest.approx((0.0, 300.0))
    assert top - bottom == pytest.approx(300.0 * 1.2 / 7.0) and bottom + top == pytest.approx(1.0)


def test_pieces_whose_place_is_unknown_are_shown_beside_the_map(picture):
    apart = np.array([[20.0, 3.0], [20.0, 4.0]])
    summary_figure(picture, room(60, 80), TopologicalMap(), np.zeros((1, 3)), apart=apart)
    _, found = colours(picture)
    assert hexed(palette.APART) in found
    assert shown_area(room(60, 80), apart) == pytest.approx((0.0, 20.0, 0.0, 6.0))


def test_titles_are_one_line():
    assert shortened('two\nlines') == 'two lines'
    assert len(shortened(200 * 'x')) == 70
