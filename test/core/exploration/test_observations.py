"""Observations are complete with scan, pose and map, in any order of arrival."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.observations import ObservationBuffer
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import pose
from thinmap_ros.core.topology.graph import TopologicalMap

PATCH = GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((4, 5), dtype=np.int8))
STAMPS = range(4)


def scan_at(stamp_ns):
    return Scan.create(stamp_ns, np.full(181, 2.0), -math.pi / 2, math.pi / 180, 0.05, 8.0)


def a_buffer():
    return ObservationBuffer(TopologicalMap({}, {}))


def test_without_a_map_there_is_no_observation():
    buffer = a_buffer()
    assert buffer.add_scan(scan_at(1)) is None
    assert buffer.add_pose(1, pose(1.0, 2.0, 0.0)) is None
    buffer.replace_map(PATCH)
    assert buffer.add_pose(2, pose(1.0, 2.0, 0.0)) is None
    found = buffer.add_scan(scan_at(2))
    assert found.scan.stamp_ns == 2
    assert found.patch is PATCH
    assert found.topology is buffer.topology
    assert found.T_map_base.tolist() == [1.0, 2.0, 0.0]


@given(st.permutations([(kind, k) for kind in ('scan', 'pose', 'map') for k in STAMPS]))
def test_each_scan_is_complete_once_with_the_last_of_its_three_parts(order):
    buffer = a_buffer()
    buffer.add_local_map(100, PATCH)
    add = {
        'scan': lambda k: buffer.add_scan(scan_at(k)),
        'pose': lambda k: buffer.add_pose(k, pose(float(k), 0.0, 0.0)),
        'map': lambda k: buffer.add_local_map(k, PATCH),
    }
    parts = dict.fromkeys(STAMPS, 0)
    for kind, k in order:
        found = add[kind](k)
        parts[k] += 1
        assert (found is not None) == (parts[k] == 3)
        if found is not None:
            assert found.scan.stamp_ns == k
            assert found.T_map_base[0] == k


def test_a_local_map_that_does_not_fit_is_refused_and_not_waited_for():
    buffer = a_buffer()
    buffer.replace_map(PATCH)
    shifted = GridPatch(GridFrame(0.03, 0.0, 0.1), PATCH.cells)
    with pytest.raises(InputError, match='lattice'):
        buffer.add_local_map(1, shifted)
    buffer.add_pose(2, pose(0.0, 0.0, 0.0))
    assert buffer.add_scan(scan_at(2)) is not None
