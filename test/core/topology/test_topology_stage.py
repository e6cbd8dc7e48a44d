"""A graph that follows its map: changes, whole maps and corrections arrive in turn."""

import math

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.correction import CorrectedPoses
from thinmap_ros.core.grid.mapper import MapUpdate, WholeMap
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.stage import Destination, LocalizedScan
from thinmap_ros.core.topology.layers.stack import Layers
from thinmap_ros.core.topology.topology import Finished, Topology

POSES = np.array([[4.0 + 0.5 * k, 5.0, 0.0] for k in range(5)])
STILL = CorrectedPoses(POSES, POSES)


class Later:
    """A function that is called when its result is asked for, as late as a thread may be."""

    def __init__(self, work):
        self._work = work

    def done(self):
        return False

    def result(self):
        return self._work()


def hall(shift_m=0.0):
    """A hall of 8 x 4 m in unknown space, cells of 10 cm."""
    cells = np.full((160, 160), UNKNOWN, dtype=np.int8)
    cells[29:72, 20:102] = 100
    cells[30:71, 21:101] = 0
    return GridPatch(GridFrame(shift_m, 0.0, 0.1), cells)


def halved():
    """The hall without its right half."""
    closed = hall()
    closed.cells[30:71, 60:] = 100
    return closed


def wall(x=3.0):
    return GridPatch(GridFrame(x, 3.0, 0.1), np.full((20, 20), 100, dtype=np.int8))


def update(patch, corrected_ns, stamp_ns=10, is_rerendering=False, T_map_base=POSES[-1]):
    scan = Scan.create(stamp_ns, np.full(181, 2.0), -math.pi / 2, math.pi / 180, 0.05, 8.0)
    localized = LocalizedScan(scan, T_map_base, Destination.MAP)
    return MapUpdate(localized, patch, corrected_ns, is_rerendering)


def whole(patch, corrected_ns=0, previous_ns=0, moved=STILL):
    return WholeMap(patch, corrected_ns, previous_ns, moved)


def built(**options):
    topology = Topology(**options)
    for k, T in enumerate(POSES):
        changed = topology.step(update(hall(), 0, k + 1, T_map_base=T))
        assert (changed is not None) == (k == 0)
    return topology


def places(topology):
    return {(round(n.x, 6), round(n.y, 6)) for n in topology.map.nodes.values()}


@pytest.mark.parametrize('is_next', [True, False])
def test_the_graph_goes_where_the_grid_has_gone_and_its_nodes_keep_their_ids(is_next):
    topology = built()
    before = {i: node.position for i, node in topology.map.nodes.items()}
    assert before
    moved = CorrectedPoses(POSES, POSES + [1.0, 0.0, 0.0])
    assert topology.add_map(whole(hall(1.0), 9, 0 if is_next else 8, moved)) is topology.map
    assert len(topology.map.nodes) == len(before)
    if is_next:
        for i, place in before.items():
            np.testing.assert_allclose(
                topology.map.nodes[i].position, np.add(place, [1.0, 0.0]), atol=0.15
            )


def test_nothing_is_taken_while_the_grid_is_rendered_again_nor_what_is_out_of_date():
    topology = built()
    assert topology.step(update(halved(), 0, 9, is_rerendering=True)) is None
    topology.add_map(whole(hall(), 9))
    assert topology.step(update(halved(), 0, 8)) is None, 'cut out before'
    assert topology.step(update(halved(), 9)) is not None


def test_changes_that_come_while_the_graph_is_rebuilt_are_added_to_the_new_one():
    topology = built(begin=Later)
    old = topology.builder
    assert topology.add_map(whole(hall(), 9)) is None
    assert topology.step(update(halved(), 9)) is None
    assert topology.builder is old
    topology.finish()
    assert topology.builder is not old
    assert max(node.x for node in topology.map.nodes.values()) < 6.0
    far = max(node.x for node in old.map.nodes.values())
    assert far > 6.0, 'the old one is as it was'


def test_cells_outside_of_the_windows_are_those_of_the_grid():
    topology = Topology()
    topology.step(update(wall(), 0))
    assert not topology.map.nodes
    assert topology.add_map(whole(hall())) is not None
    expected = Topology()
    pasted = hall()
    pasted.cells[30:50, 30:50] = 100
    expected.step(update(pasted, 0))
    assert places(topology) == places(expected)
    assert topology.step(update(pasted, 0)) is None, 'nothing is missing'
    topology.step(update(wall(), 7))
    assert topology.add_map(whole(halved(), 0)) is None, 'of another correction'


def test_a_grid_that_comes_too_early_is_used_later_with_the_changes_since():
    topology = Topology(begin=Later)
    assert topology.add_map(whole(hall())) is None, 'no changes yet'
    assert topology.step(update(wall(), 0)) is not None
    # While the graph is rebuilt.
    topology.add_map(whole(hall(), 9))
    assert topology.add_map(whole(hall(), 9)) is None
    for x in (3.0, 5.0):
        assert topology.step(update(wall(x), 9)) is None
    topology.finish()
    topology.step(update(wall(), 9))
    pasted = hall()
    pasted.cells[30:50, 30:70] = 100
    assert topology.step(update(pasted, 9)) is None, 'nothing is missing'


def test_changes_of_a_correction_wait_for_its_grid():
    topology = built()
    assert topology.step(update(halved(), 9)) is None
    assert topology.add_map(whole(hall(), 9)) is not None
    assert topology.step(update(hall(), 9)) is not None


def test_a_window_that_does_not_fit_the_grid_is_reported_once():
    topology = Topology()
    topology.add_map(whole(hall()))
    off = GridPatch(GridFrame(0.03, 0.0, 0.1), hall().cells)
    with pytest.raises(InputError, match='lattice'):
        topology.step(update(off, 0))
    assert topology.step(update(off, 0)) is not None


def test_a_graph_that_is_new_takes_changes_of_a_grid_that_was_corrected_before():
    assert Topology().step(update(hall(), 7)) is not None


def test_a_mapper_that_begins_anew_after_a_correction_is_followed():
    topology = built()
    topology.add_map(whole(hall(), 9))
    assert topology.step(update(halved(), 9)) is not None
    assert topology.step(update(hall(), 0)) is not None


@pytest.mark.parametrize('corrected_ns', [0, 9])
def test_a_graph_of_a_checkpoint_follows_the_corrections_since(corrected_ns):
    saved = built()
    if corrected_ns:
        saved.add_map(whole(hall(), corrected_ns))
    topology = Topology()
    topology.restore(saved.state())
    old = topology.builder
    topology.add_map(whole(halved(), 9))
    assert (topology.builder is old) == (corrected_ns == 9)
    assert topology.step(update(halved(), 9)) is not None or corrected_ns == 0
    assert max(node.x for node in topology.map.nodes.values()) < 6.0


def test_a_graph_is_saved_as_not_corrected_while_it_is_rebuilt():
    topology = built(begin=Later)
    topology.add_map(whole(hall(), 9))
    assert topology.state()['corrected_ns'] == 0
    topology.finish()
    assert topology.state()['corrected_ns'] == 9


@pytest.mark.parametrize('begin', [Finished, Later])
@pytest.mark.parametrize('failing', [(Layers, 'update_skeleton'), (Layers, 'fill')])
def test_a_graph_that_an_error_has_left_half_changed_is_rebuilt(begin, failing, monkeypatch):
    topology = built(begin=begin)

    def fail(*_):
        raise ZeroDivisionError('planted')

    def correct():
        topology.add_map(whole(halved(), 9))
        topology.finish()

    part, name = failing
    with monkeypatch.context() as broken, pytest.raises(ZeroDivisionError):
        broken.setattr(part, name, fail)
        correct() if name == 'fill' else topology.step(update(halved(), 0))
    assert topology.step(update(halved(), 0)) is None, 'before it is rebuilt'
    assert int(topology.state()['corrected_ns']) == 0
    topology.add_map(whole(halved(), 0))
    topology.finish()
    expected = built()
    expected.step(update(halved(), 0))
    assert places(topology) == places(expected)
    assert topology.step(update(hall(), 0)) is not None
