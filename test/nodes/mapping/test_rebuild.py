"""A graph that is rebuilt after trajectory, grid and windows arrive in turn."""

import numpy as np
import pytest
from support.localized import local_grid

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.topology.builder import TopologyBuilder
from thinmap_ros.nodes.mapping.rebuild import Rebuilding
from thinmap_ros.ros.localized_scan import mapped_scan_from_msg

POSES = np.array([[4.0 + 0.5 * k, 5.0, 0.0] for k in range(5)])
STAMPS = np.arange(1, 6)


def hall(shift_m=0.0):
    """A hall of 8 x 4 m in unknown space, cells of 10 cm."""
    cells = np.full((160, 160), UNKNOWN, dtype=np.int8)
    cells[29:72, 20:102] = 100
    cells[30:71, 21:101] = 0
    return GridPatch(GridFrame(shift_m, 0.0, 0.1), cells)


def window(patch, corrected_ns, stamp_ns=10, is_rerendering=False, T_map_base=POSES[-1]):
    message = local_grid(patch, T_map_base, stamp_ns)
    message.grid.correction_stamp.nanosec = corrected_ns
    message.is_rerendering = is_rerendering
    return mapped_scan_from_msg(message)


def built(rebuilding):
    builder = TopologyBuilder()
    for stamp, T in zip(STAMPS.tolist(), POSES, strict=True):
        rebuilding.window(window(hall(), 0, stamp, T_map_base=T))
        assert rebuilding.accepts_window()
        builder.update(hall(), T)
    return builder


@pytest.mark.parametrize('from_the_start', [True, False])
def test_the_graph_goes_where_the_grid_has_gone_and_its_nodes_keep_their_ids(from_the_start):
    rebuilding = Rebuilding(from_the_start)
    builder = built(rebuilding)
    before = {i: node.position for i, node in builder.map.nodes.items()}
    assert before
    moved = POSES + [1.0, 0.0, 0.0]
    rebuilding.correct(9, STAMPS, moved)
    rebuilding.grid(hall(), 8)
    assert rebuilding.result(rebuilding.start(builder)) is builder, 'not the awaited grid'
    rebuilding.grid(hall(1.0), 9)
    builder = rebuilding.result(rebuilding.start(builder))
    assert len(builder.map.nodes) == len(before)
    if from_the_start:
        for i, place in before.items():
            np.testing.assert_allclose(
                builder.map.nodes[i].position, np.add(place, [1.0, 0.0]), atol=0.15
            )


def test_nothing_is_taken_while_the_grid_is_rendered_again_nor_what_is_out_of_date():
    rebuilding = Rebuilding()
    builder = built(rebuilding)
    rebuilding.correct(9, STAMPS, POSES)
    rebuilding.window(window(hall(), 0, 9, is_rerendering=True))
    assert not rebuilding.accepts_window()
    rebuilding.grid(hall(), 9)
    rebuilding.start(builder)
    rebuilding.window(window(hall(), 0, 8))
    assert not rebuilding.accepts_window(), 'cut out before'
    rebuilding.window(window(hall(), 9))
    assert rebuilding.accepts_window()


def test_windows_that_come_while_the_graph_is_rebuilt_are_added_to_the_new_one():
    rebuilding = Rebuilding()
    old = built(rebuilding)
    rebuilding.correct(9, STAMPS, POSES)
    rebuilding.grid(hall(), 9)
    assert rebuilding.start(old) is old
    closed = hall()
    closed.cells[30:71, 60:] = 100
    rebuilding.window(window(closed, 9))
    builder, _ = rebuilding.update(old)
    builder = rebuilding.result(builder)
    assert builder is not old
    assert max(node.x for node in builder.map.nodes.values()) < 6.0
    far = max(node.x for node in old.map.nodes.values())
    assert far > 6.0, 'the old one is as it was'


def test_cells_outside_of_the_windows_are_those_of_the_grid():
    rebuilding = Rebuilding()
    built(rebuilding)
    wall = GridPatch(GridFrame(3.0, 3.0, 0.1), np.full((20, 20), 100, dtype=np.int8))
    rebuilding.window(window(wall, 0))
    rebuilding.grid(hall(), 0)
    shown = rebuilding.whole_map()
    assert shown.shape == hall().shape
    assert (shown.cells[30:50, 30:50] == 100).all() and shown.cells[60, 60] == 0
    assert rebuilding.whole_map() is None, 'used'
    rebuilding.grid(hall(), 7)
    assert rebuilding.whole_map() is None, 'of another correction'


def test_a_grid_that_comes_too_early_is_used_later_with_the_windows_since():
    rebuilding = Rebuilding()
    rebuilding.grid(hall(), 0)
    assert rebuilding.whole_map() is None, 'no window yet'
    old = built(rebuilding)
    assert rebuilding.whole_map() is not None
    # While the graph is rebuilt.
    rebuilding.correct(9, STAMPS, POSES)
    rebuilding.grid(hall(), 9)
    rebuilding.start(old)
    rebuilding.grid(hall(), 9)
    for x in (3.0, 5.0):
        wall = GridPatch(GridFrame(x, 3.0, 0.1), np.full((20, 20), 100, dtype=np.int8))
        rebuilding.window(window(wall, 9))
        assert rebuilding.whole_map() is None
    rebuilding.result(old)
    shown = rebuilding.whole_map()
    assert (shown.cells[30:50, 30:70] == 100).all() and shown.cells[60, 60] == 0


def test_a_grid_may_come_before_the_trajectory_that_it_has_undergone():
    rebuilding = Rebuilding()
    old = built(rebuilding)
    rebuilding.grid(hall(), 9)
    rebuilding.window(window(hall(), 9))
    assert not rebuilding.accepts_window()
    rebuilding.correct(9, STAMPS, POSES)
    assert rebuilding.result(rebuilding.start(old)) is not old
    assert rebuilding.accepts_window()


def test_a_window_that_does_not_fit_the_grid_is_reported_once():
    rebuilding = Rebuilding()
    rebuilding.grid(hall(), 0)
    off = GridPatch(GridFrame(0.03, 0.0, 0.1), hall().cells)
    with pytest.raises(InputError, match='lattice'):
        rebuilding.window(window(off, 0))
    rebuilding.window(window(off, 0))
    assert rebuilding.accepts_window() and rebuilding.whole_map() is None


def test_a_builder_that_is_new_takes_windows_of_a_grid_that_was_corrected_before():
    rebuilding = Rebuilding()
    rebuilding.window(window(hall(), 7))
    assert rebuilding.accepts_window()


def test_a_mapper_that_begins_anew_after_a_correction_is_followed():
    rebuilding = Rebuilding()
    builder = built(rebuilding)
    rebuilding.correct(9, STAMPS, POSES)
    rebuilding.grid(hall(), 9)
    rebuilding.start(builder)
    for corrected_ns in (9, 0):
        rebuilding.window(window(hall(), corrected_ns))
        assert rebuilding.accepts_window()


@pytest.mark.parametrize('checkpoint_ns', [8, 9])
def test_a_graph_of_a_checkpoint_follows_the_corrections_since(checkpoint_ns):
    rebuilding = Rebuilding(from_the_start=False, restored_ns=checkpoint_ns)
    old = TopologyBuilder()
    rebuilding.correct(9, STAMPS, POSES)
    rebuilding.grid(hall(), 9)
    rebuilding.window(window(hall(), 9))
    assert rebuilding.accepts_window() == (checkpoint_ns == 9)
    builder, _ = rebuilding.update(old)
    assert (rebuilding.result(builder) is old) == (checkpoint_ns == 9)
    assert rebuilding.accepts_window()
