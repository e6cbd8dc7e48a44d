"""Masks for Nav2's KeepoutFilter: their cells, and the keep-out areas that they become."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy import ndimage

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.edits import MAX_CORNERS, KeepOut
from thinmap_ros.core.grid.moved import resampled
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.files.keep_out_masks import outlines_of, read_mask

WHITE = 254


def room() -> GridPatch:
    """A room of 8 x 6 m, with its lower left corner at 0, 0."""
    cells = np.zeros((60, 80), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    return GridPatch(GridFrame(0.0, 0.0, 0.1), cells)


def written(folder: Path, grey: np.ndarray, **changes: object) -> Path:
    """A mask of grey values, the first row at the bottom."""
    Image.fromarray(grey[::-1].astype(np.uint8)).save(folder / 'mask.pgm')
    content = {
        'image': 'mask.pgm',
        'resolution': 0.1,
        'origin': [0.0, 0.0, 0.0],
        'negate': 0,
        'occupied_thresh': 0.65,
        'free_thresh': 0.25,
    }
    (folder / 'mask.yaml').write_text(yaml.safe_dump(content | changes))
    return folder / 'mask.yaml'


def painted(*boxes: tuple[int, int, int, int], value: int = 0, back: int = WHITE) -> np.ndarray:
    """Grey values with boxes (row, col, end row, end col)."""
    grey = np.full((60, 80), back)
    for row, col, end_row, end_col in boxes:
        grey[row:end_row, col:end_col] = value
    return grey


def laid(outlines: list[np.ndarray], patch: GridPatch) -> np.ndarray:
    """Cells (H, W) of a map in the keep-out areas of these outlines."""
    keep_out = KeepOut()
    for corners in outlines:
        keep_out = keep_out.with_area(corners, is_wall=False)
    return keep_out.cells(patch.frame, patch.shape)


@pytest.mark.parametrize(
    ('mode', 'value', 'back', 'is_forbidden'),
    [
        ('trinary', 0, WHITE, True),
        ('trinary', 128, WHITE, False),  # unknown
        ('scale', 0, WHITE, True),
        ('scale', 128, WHITE, False),  # a preferred lane: slow, not forbidden
        ('raw', 100, 0, True),
        ('raw', 99, 0, False),
        ('raw', 255, 0, False),  # unknown
    ],
)
def test_cells_of_100_are_forbidden_in_each_mode(
    tmp_path: Path, mode: str, value: int, back: int, is_forbidden: bool
) -> None:
    least = 100 if mode == 'raw' else 0
    grey = painted((20, 30, 30, 50), value=value, back=back)
    grey[40, 40] = least  # one cell that is forbidden in any case
    mask = read_mask(written(tmp_path, grey, mode=mode), room())
    expected = painted((20, 30, 30, 50)) == 0
    expected &= is_forbidden
    expected[40, 40] = True
    assert np.array_equal(mask.occupied, expected)
    assert (mask.cells[~expected] == UNKNOWN).all()


def test_cells_of_another_size_and_origin_lie_at_their_place(tmp_path: Path) -> None:
    patch = room()
    for resolution_m, scale in ((0.25, 0.4), (0.05, 2.0), (0.1, 1.0)):
        rows, cols = (round(each * scale) for each in (40, 50))
        grey = np.full((rows, cols), WHITE)
        grey[rows // 4 : rows // 2, cols // 5 : cols // 2] = 0
        changes = {'resolution': resolution_m, 'origin': [1.5, 0.5, 0.0]}
        mask = read_mask(written(tmp_path, grey, **changes), patch)
        found = np.argwhere(resampled(mask, patch).occupied)
        places = patch.frame.centres_of(found)
        assert np.abs(places.min(axis=0) - (2.5, 1.5)).max() <= 0.1
        assert np.abs(places.max(axis=0) - (4.0, 2.5)).max() <= 0.1
        assert len(found) == pytest.approx(150, abs=30)


def test_a_mask_with_a_yaw_is_turned_about_its_origin(tmp_path: Path) -> None:
    mask = written(tmp_path, painted((10, 20, 20, 40)), origin=[6.0, 0.0, np.pi / 2])
    found = resampled(read_mask(mask, room()), room()).occupied
    assert np.array_equal(np.flatnonzero(found.any(axis=1)), np.arange(20, 40))
    assert np.array_equal(np.flatnonzero(found.any(axis=0)), np.arange(40, 50))


SHAPES = {
    'two boxes': painted((5, 5, 15, 25), (30, 40, 50, 60)),
    'a frame': painted((10, 10, 50, 70)) + (painted((20, 20, 40, 60)) == 0) * WHITE,
    'two holes': painted((5, 5, 55, 75))
    + ((painted((10, 10, 20, 20), (30, 50, 40, 60)) == 0) * WHITE),
    'a disc': np.where(np.hypot(*np.mgrid[-30:30, -40:40]) < 25, 0, WHITE),
    'stairs': np.where(np.abs(np.subtract(*np.mgrid[:60, :80])) < 4, 0, WHITE),
    'a comb': painted(*((10, 4 * k, 50, 4 * k + 2) for k in range(1, 19)), (10, 4, 13, 76)),
}


@pytest.mark.parametrize('shape', SHAPES)
def test_areas_cover_what_the_mask_forbids_and_a_cell_around_at_most(
    tmp_path: Path, shape: str
) -> None:
    patch = room()
    mask = read_mask(written(tmp_path, SHAPES[shape]), patch)
    outlines = outlines_of(mask, patch)
    assert 1 <= len(outlines) <= 20
    cells = laid(outlines, patch)
    inner = np.zeros(patch.shape, dtype=np.bool_)
    inner[2:-2, 2:-2] = True
    assert (cells | ~mask.occupied | ~inner).all()
    around = ndimage.binary_dilation(mask.occupied, np.ones((3, 3)))
    assert not (cells & ~around).any()


def test_a_large_rough_area_becomes_several_of_few_corners(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    grey = painted((5, 5, 55, 75))
    grey[5:55, 5:8] = np.where(rng.random((50, 3)) < 0.5, 0, WHITE)
    grey[52:55, 8:75] = np.where(rng.random((3, 67)) < 0.5, 0, WHITE)
    patch = room()
    outlines = outlines_of(read_mask(written(tmp_path, grey), patch), patch)
    assert max(map(len, outlines)) <= MAX_CORNERS
    assert (laid(outlines, patch)[10:50, 10:70]).all()


def test_walls_of_an_edited_map_are_no_areas(tmp_path: Path) -> None:
    """The tutorial of Nav2 begins with a copy of the map."""
    patch = room()
    grey = np.where(patch.occupied, 0, WHITE)
    grey[20:40, 50:] = 0  # to the wall
    (outline,) = outlines_of(read_mask(written(tmp_path, grey), patch), patch)
    assert outline.min(axis=0) == pytest.approx([5.0, 2.0])
    assert outline.max(axis=0) == pytest.approx([7.8, 4.0])


@pytest.mark.parametrize(
    ('grey', 'changes', 'expected'),
    [
        (painted(), {}, 'mask.yaml: no cell is 100: expected a keep-out mask'),
        (
            painted((5, 5, 9, 9)),
            {'origin': [100.0, 2.0, 0.0]},
            r'mask.yaml: mask of x 100.0 to 108.0 m, y 2.0 to 8.0 m: expected one that overlaps '
            r'the map, x 0.0 to 8.0 m, y 0.0 to 6.0 m',
        ),
        (painted((5, 5, 9, 9)), {'image': 'none.pgm'}, 'none.pgm: No such file'),
    ],
)
def test_wrong_masks_are_named(
    tmp_path: Path, grey: np.ndarray, changes: dict[str, object], expected: str
) -> None:
    with pytest.raises(InputError, match=expected):
        read_mask(written(tmp_path, grey, **changes), room())
