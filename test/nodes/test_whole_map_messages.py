"""A whole map as a message, with where a correction has moved it."""

from array import array

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.correction import CorrectedPoses
from thinmap_ros.core.grid.mapper import WholeMap
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.ros import messages

PATCH = GridPatch(GridFrame(1.0, 2.0, 0.1), np.full((3, 4), 100, dtype=np.int8))
MOVED = CorrectedPoses(np.arange(6.0).reshape(2, 3), np.arange(1.0, 7.0).reshape(2, 3))


def test_a_whole_map_is_received_as_it_was_sent():
    message = messages.whole_map_msg(WholeMap(PATCH, 9, 4, MOVED), 'map', 10)
    received = messages.whole_map_from_msg(message)
    assert (received.corrected_ns, received.previous_ns) == (9, 4)
    np.testing.assert_array_equal(received.patch.cells, PATCH.cells)
    for one, other in zip(received.moved, MOVED, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ('before', 'after', 'said'),
    [
        ([0.0] * 6, [0.0] * 3, '6 numbers of poses before a correction and 3 after it'),
        ([0.0] * 4, [0.0] * 4, 'three for each pose'),
        ([np.nan] * 3, [0.0] * 3, 'no place'),
        ([0.0] * 3, [1e300] * 3, 'no place'),
    ],
)
def test_poses_of_a_correction_that_are_none_are_refused_in_words(before, after, said):
    message = messages.whole_map_msg(WholeMap(PATCH), 'map', 10)
    message.poses_before = array('d', before)
    message.poses_after = array('d', after)
    with pytest.raises(InputError, match=said):
        messages.whole_map_from_msg(message)
