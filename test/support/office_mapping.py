"""A grid_mapper on a live graph that maps the first part of an office."""

from itertools import islice

from nav_msgs.msg import OccupancyGrid
from support.doctor import Doctor
from support.localized import localized

from thinmap_msgs.msg import LocalGrid, LocalizedScan, ProbabilityGrid, SlamStatus
from thinmap_ros.experiments.drives import Source
from thinmap_ros.ros import messages, qos

EVERY = 6  # scans of the drive that are used


class Mapping:
    """A grid_mapper that maps the first part of an office at the true poses."""

    def __init__(self, graph, **parameters):
        self.graph = graph
        self.maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
        self.grids = graph.heard('grid', ProbabilityGrid, qos.LATCHED)
        self.windows = graph.heard('local_grid', LocalGrid, qos.LATCHED)
        self.samples = list(islice(Source().samples('office'), 0, 360, EVERY))
        self._scan = graph.node.create_publisher(LocalizedScan, 'localized_scan', qos.STREAM)
        self.doctor = Doctor(graph)
        graph.start('grid_mapper', **parameters)
        self.wait_for('localized_scan: publishers', 'local_grid: subscribers')
        graph.until(self._scan.get_subscription_count, 'grid_mapper')

    def wait_for(self, *keys):
        """Wait until the mapper has found the test: what is published earlier is lost."""
        self.graph.until(
            lambda: all(self.doctor.number('grid_mapper', key) for key in keys), 'discovery'
        )

    def publish(self, sample, state=SlamStatus.TRACKING):
        self._scan.publish(localized(sample.scan, sample.T_world_base, state=state))

    def add(self, sample):
        """Add a sample, and wait for its window."""
        before = len(self.windows)
        self.publish(sample)
        self.graph.until(lambda: len(self.windows) > before, 'a window')

    def drive(self):
        """Map; returns the cells of map and of grid, of the last scan."""
        for sample in self.samples:
            self.add(sample)
        last = messages.time_msg(self.samples[-1].scan.stamp_ns)
        self.graph.until(
            lambda: (
                self.maps
                and self.grids
                and self.maps[-1].header.stamp == last
                and self.grids[-1].header.stamp == last
            ),
            'the whole map',
        )
        shown = messages.grid_from_msg(self.maps[-1])
        exact = messages.grid_from_msg(self.grids[-1])
        assert shown.frame.as_array().tolist() == exact.frame.as_array().tolist()
        return shown, exact
