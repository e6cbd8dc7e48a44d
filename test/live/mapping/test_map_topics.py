"""What grid_mapper publishes of its map, and when: whole maps, and updates of what has changed."""

from dataclasses import replace

import numpy as np
import pytest
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger
from support.office_mapping import Mapping

from thinmap_ros.core.grid.patch import UNKNOWN
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.maps import received_map, received_update

pytestmark = pytest.mark.live
# By then each cell that the scan shows is as free or as occupied as cells can be.
UNTIL_SETTLED = 40
STEP_NS = 200_000_000
INTERVAL_NS = 10**9  # of the parameter map_update_interval


def stamp_ns(message):
    return messages.stamp_ns(message.header.stamp)


def replayed(maps, updates):
    """What a subscriber of both topics knows after each message: stamp and patch."""
    receiver = MapReceiver()
    for message in sorted([*maps, *updates], key=stamp_ns):
        if isinstance(message, OccupancyGrid):
            received_map(receiver, message)
        else:
            received_update(receiver, message)
        yield stamp_ns(message), receiver.patch


def is_the_map(known, patch):
    """Whether what is known are the cells of a patch, and unknown cells around it."""
    around = known.with_part(*known.offset_of(patch), np.full(patch.shape, UNKNOWN, dtype=np.int8))
    row, col = known.offset_of(patch)
    rows, cols = patch.shape
    inside = known.part((row, col, row + rows, col + cols))
    return np.array_equal(inside.cells, patch.cells) and (around.cells == UNKNOWN).all()


def present(graph):
    """The map that the service returns."""
    return messages.grid_from_msg(graph.call(GetMap, 'dynamic_map', GetMap.Request()).map)


class Following:
    """A mapper whose only subscriber follows map and map_updates; its clock advances in steps."""

    def __init__(self, graph):
        self.graph = graph
        self.updates = graph.heard('map_updates', OccupancyGridUpdate)
        self._clock = graph.node.create_publisher(Clock, '/clock', qos.STREAM)
        self._now_ns = 10**9
        self.mapping = Mapping(graph, use_sim_time=True)
        self.mapping.wait_for('map: subscribers', 'map_updates: subscribers')
        self.maps = self.mapping.maps

    def step(self):
        """A period later: the mapper publishes what has changed."""
        self._now_ns += INTERVAL_NS
        self._clock.publish(Clock(clock=messages.time_msg(self._now_ns)))

    def add(self, sample):
        """Add a sample that changes the map, and wait until the map is published."""
        self.mapping.add(sample)
        grids = self.mapping.grids
        self.graph.until(
            lambda: self.step() or (grids and stamp_ns(grids[-1]) == sample.scan.stamp_ns),
            'the grid of this scan',
        )

    def drive(self):
        """Map, until all that was published is here."""
        for sample in self.mapping.samples:
            self.add(sample)
        patch = present(self.graph)
        self.graph.until(
            lambda: self.maps and is_the_map(self.known(), patch), 'the map of the last scan'
        )

    def stand(self):
        """Measure the same again and again at the end of the drive."""
        last = self.mapping.samples[-1]
        for _ in range(UNTIL_SETTLED):
            scan = replace(last.scan, stamp_ns=last.scan.stamp_ns + STEP_NS)
            last = replace(last, scan=scan)
            self.mapping.samples.append(last)
            self.mapping.add(last)
            self.step()

    def known(self):
        return list(replayed(self.maps, self.updates))[-1][1]

    def is_behind(self):
        """Whether updates are newer than the last whole map."""
        return bool(self.updates) and stamp_ns(self.updates[-1]) > stamp_ns(self.maps[-1])


def test_a_whole_map_and_its_updates_are_the_map_at_all_times_of_a_drive(graph):
    following = Following(graph)
    following.drive()
    graph.drain()
    grids = {stamp_ns(message): message for message in following.mapping.grids}
    for stamp, known in replayed(following.maps, following.updates):
        exact = messages.grid_from_msg(grids[stamp])
        trinary = replace(exact, cells=exact.trinary())
        assert is_the_map(known, trinary), stamp
    sizes = {(m.info.width, m.info.height) for m in following.maps}
    assert len(sizes) > 2, 'it grows'
    assert len(following.updates) > len(following.maps), 'mostly, only what changed is sent'
    assert graph.stop('grid_mapper') == 0


@pytest.fixture
def behind(graph):
    """A mapper whose last whole map is out of date."""
    following = Following(graph)
    samples = iter(following.mapping.samples)
    while not following.is_behind():
        following.add(next(samples))
    graph.drain()
    return following


def test_a_late_subscriber_has_the_map_that_others_know(graph, behind):
    known = behind.known()
    for topic in ('map alone', 'both'):
        late_updates = graph.heard('map_updates', OccupancyGridUpdate) if topic == 'both' else []
        late = graph.heard('map', OccupancyGrid, qos.LATCHED)
        graph.until(lambda late=late: late and is_the_map(known_by(late), known), topic)
        assert not late_updates
    assert graph.stop('grid_mapper') == 0


def known_by(maps):
    return messages.grid_from_msg(maps[-1])


def test_a_lost_update_is_healed_by_the_next_whole_map(graph, behind):
    lost = behind.updates.pop()
    known = present(graph)
    assert not is_the_map(behind.known(), known), 'it is missing'
    updates = len(behind.updates)

    def is_whole():
        behind.step()
        return stamp_ns(behind.maps[-1]) >= stamp_ns(lost)

    graph.until(is_whole, 'a whole map, though nothing changes')
    assert is_the_map(behind.known(), known)
    assert len(behind.updates) == updates
    assert graph.stop('grid_mapper') == 0


def test_who_subscribes_to_map_alone_sees_it_grow(graph):
    following = Following(graph)
    alone = graph.heard('map', OccupancyGrid, qos.LATCHED)
    following.graph.until(
        lambda: following.mapping.doctor.number('grid_mapper', 'map: subscribers') == 2, 'two'
    )
    following.drive()
    graph.drain()
    assert not following.updates
    shown = [messages.grid_from_msg(message) for message in alone]
    known = [np.count_nonzero(patch.cells != UNKNOWN) for patch in shown]
    assert len(known) > 10 and known[-1] > 2 * known[0]
    assert {stamp_ns(m) for m in alone} <= {stamp_ns(m) for m in following.mapping.grids}
    # It ends at the known cells: room to grow is of no use to those who receive all of it.
    last = messages.grid_from_msg(following.mapping.grids[-1])
    assert shown[-1].frame == last.frame and shown[-1].shape == last.shape
    assert graph.stop('grid_mapper') == 0


def test_nothing_is_published_while_nothing_changes(graph):
    following = Following(graph)
    mapping = following.mapping
    following.drive()
    following.stand()
    graph.until(
        lambda: following.step() or not following.is_behind(), 'the whole map after the last update'
    )
    graph.drain()
    before = mapping.maps[-1]
    mapping.maps.clear(), mapping.grids.clear(), following.updates.clear()
    following.stand()
    # The map of the reset is the only one: of a topic, messages come in their order.
    assert graph.call(Trigger, '/grid_mapper/reset', Trigger.Request()).success
    graph.until(lambda: mapping.maps and mapping.grids, 'the empty map')
    graph.drain()
    assert len(mapping.maps) == len(mapping.grids) == 1 and not following.updates
    assert mapping.maps[0].info.map_load_time != before.info.map_load_time
    assert graph.stop('grid_mapper') == 0
