"""A keep-out mask of Nav2 is loaded into a live map, published as areas, and saved with it."""

import numpy as np
import pytest
from support.office_mapping import Mapping

from thinmap_msgs.msg import KeepOut
from thinmap_msgs.srv import LoadMap, SaveMap
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.files.occupancy_maps import write_map
from thinmap_ros.files.sessions import load_edits
from thinmap_ros.logs import decode
from thinmap_ros.ros import qos

pytestmark = pytest.mark.live


def mask_at(x_m: float) -> GridPatch:
    """Two areas of 0.5 x 1 m, with cells of another size than those of the map."""
    cells = np.zeros((30, 60), dtype=np.int8)
    cells[5:15, 20:25] = cells[5:15, 30:35] = 100
    return GridPatch(GridFrame(x_m, 0.3, 0.1), cells)


def test_a_mask_becomes_areas_that_are_published_and_saved(graph, tmp_path):
    areas = graph.heard('keep_out', KeepOut, qos.LATCHED)
    mapping = Mapping(graph, save_directory=str(tmp_path))
    for sample in mapping.samples[:3]:
        mapping.add(sample)
    write_map(tmp_path / 'mask', mask_at(0.5))
    write_map(tmp_path / 'beside', mask_at(500.0))

    def load(name):
        return graph.call(LoadMap, 'load_keep_out', LoadMap.Request(path=name))

    answer = load('mask.yaml')
    assert (answer.success, answer.message) == (True, '2 keep-out areas added')
    graph.until(lambda: areas and len(areas[-1].areas) == 2, 'the areas')
    beside = load('beside.yaml')
    assert not beside.success and 'expected one that overlaps the map' in beside.message
    outside = load('../mask.yaml')
    assert not outside.success and 'expected a file below' in outside.message
    assert graph.call(SaveMap, 'save_map', SaveMap.Request(path='office')).success
    published = decode.keep_out(areas[-1]).areas
    saved = load_edits(str(tmp_path / 'office')).keep_out.areas
    assert [area.id for area in saved] == [1, 2]
    for own, shown in zip(saved, published, strict=True):
        assert np.abs(own.corners - shown.corners).max() < 1e-3
        assert np.ptp(own.corners, axis=0) == pytest.approx([0.5, 1.0])
