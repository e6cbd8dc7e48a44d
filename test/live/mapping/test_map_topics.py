"""What grid_mapper publishes of its map, and when."""

from dataclasses import replace

import pytest
from std_srvs.srv import Trigger
from support.office_mapping import Mapping

pytestmark = pytest.mark.live
# By then each cell that the scan shows is as free or as occupied as cells can be.
UNTIL_SETTLED = 40
STEP_NS = 200_000_000


class Rest:
    """A robot that stands at the end of the drive and measures the same again and again."""

    def __init__(self, mapping):
        self.mapping = mapping
        self._last = mapping.samples[-1]

    def stand(self, scans=UNTIL_SETTLED):
        """Add so many scans, each with the next stamp."""
        for _ in range(scans):
            scan = replace(self._last.scan, stamp_ns=self._last.scan.stamp_ns + STEP_NS)
            self._last = replace(self._last, scan=scan)
            self.mapping.add(self._last)


def test_nothing_is_published_while_nothing_changes(graph):
    mapping = Mapping(graph, map_update_interval=0.05)
    mapping.drive()
    rest = Rest(mapping)
    rest.stand()
    graph.drain()
    before = mapping.maps[-1]
    mapping.maps.clear(), mapping.grids.clear()
    rest.stand()
    # The map of the reset is the only one: of a topic, messages come in their order.
    assert graph.call(Trigger, '/grid_mapper/reset', Trigger.Request()).success
    graph.until(lambda: mapping.maps and mapping.grids, 'the empty map')
    graph.drain()
    assert len(mapping.maps) == len(mapping.grids) == 1
    assert mapping.maps[0].info.map_load_time != before.info.map_load_time
    assert graph.stop('grid_mapper') == 0
