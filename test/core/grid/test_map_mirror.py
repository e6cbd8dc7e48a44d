"""A map assembled from published local maps."""

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.map_mirror import MapMirror
from thinmap_ros.core.grid.patch import GridPatch


def patch(x, y, value, size=4, resolution=0.1):
    return GridPatch(GridFrame(x, y, resolution), np.full((size, size), value, dtype=np.int8))


def test_a_window_is_laid_over_the_map_and_the_map_grows():
    mirror = MapMirror()
    mirror.replace(patch(0.0, 0.0, 0))
    merged = mirror.paste(patch(-0.2, 0.2, 100))
    assert merged.shape == (6, 6)
    assert merged.frame.origin_x == pytest.approx(-0.2)
    assert merged.frame.origin_y == pytest.approx(0.0)
    np.testing.assert_array_equal(merged.cells[0], [-1, -1, 0, 0, 0, 0])
    np.testing.assert_array_equal(merged.cells[5], [100, 100, 100, 100, -1, -1])


def test_the_first_window_is_the_map_and_a_new_map_replaces_all():
    mirror = MapMirror()
    assert mirror.paste(patch(1.0, 1.0, 0)).shape == (4, 4)
    mirror.replace(patch(0.0, 0.0, 0, size=2))
    assert mirror.patch is not None
    assert mirror.patch.shape == (2, 2)


@pytest.mark.parametrize('other', [patch(0.05, 0.0, 0), patch(0.0, 0.0, 0, resolution=0.2)])
def test_a_window_off_the_lattice_is_refused(other):
    mirror = MapMirror()
    mirror.replace(patch(0.0, 0.0, 0))
    with pytest.raises(InputError, match='lattice'):
        mirror.paste(other)
