"""A live map that is re-rendered after a correction, with a save or a crash meanwhile."""

import signal

import numpy as np
import pytest
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid, Path
from support.doctor import Doctor
from support.localized import localized
from support.slam_room import corridor_ring, scan_in

from thinmap_msgs.msg import LocalGrid, LocalizedScan, ProbabilityGrid
from thinmap_msgs.srv import SaveMap
from thinmap_ros.core import se2
from thinmap_ros.core.grid import occupancy
from thinmap_ros.core.grid.correction import CorrectableGrid
from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.files import sessions
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
CONFIG = OccupancyConfig(resolution_m=0.03)
SECOND_NS = 10**9
COUNT = 110
TRUE = np.array([se2.pose(2.0 + 0.32 * k, 1.2, 0.0) for k in range(COUNT + 40)])
DRIFTED = TRUE + np.arange(len(TRUE))[:, None] * [0.0, 0.004, 0.0]
WALLS = corridor_ring()


def scan_of(k):
    return scan_in(WALLS, TRUE[k], None, (k + 1) * SECOND_NS)


def named_by(message):
    """Stamp of the correction that a map contains."""
    return messages.stamp_ns(message.correction_stamp)


class Mapping:
    """A grid_mapper with scans, poses and corrections, and a reference grid with the same input."""

    def __init__(self, graph):
        self.graph = graph
        self.by_hand = CorrectableGrid(occupancy.OccupancyGrid(CONFIG))
        self.maps = graph.heard('grid', ProbabilityGrid, qos.LATCHED)
        self.windows = graph.heard('local_grid', LocalGrid)
        # Of somebody who follows updates: a whole map comes only where it must.
        self.whole = graph.heard('map', OccupancyGrid, qos.LATCHED)
        self.updates = graph.heard('map_updates', OccupancyGridUpdate)
        self._scans = graph.node.create_publisher(LocalizedScan, 'localized_scan', qos.STREAM)
        self._corrected_ns = 0
        self._paths = graph.node.create_publisher(Path, 'trajectory', qos.LATCHED)
        self.start()

    def start(self):
        doctor = Doctor(self.graph)
        self.graph.start('grid_mapper', recovery_timeout_s=1000.0, resolution_m=0.03)
        keys = [
            'localized_scan: publishers',
            'trajectory: publishers',
            'local_grid: subscribers',
        ]
        self.graph.until(
            lambda: (
                all(doctor.number('grid_mapper', key) for key in keys)
                and all(p.get_subscription_count() for p in (self._scans, self._paths))
            ),
            'the mapper and the test have found each other',
        )

    def add(self, k, T_map_base):
        """Add scan number k; returns the stamp of the correction in its local map."""
        self.by_hand.update(scan_of(k), T_map_base)
        self.windows.clear()
        self.publish(k, T_map_base)
        self.graph.until(lambda: self.windows, 'a local map')
        return named_by(self.windows[-1].grid)

    def publish(self, k, T_map_base):
        self._scans.publish(localized(scan_of(k), T_map_base, self._corrected_ns))

    def correct(self, k):
        """Correct the poses of the scans before number k to the true ones."""
        stamps = (np.arange(k) + 1) * SECOND_NS
        ns = (k + 1) * SECOND_NS
        self.by_hand.apply_correction(stamps, TRUE[:k], ns)
        self._corrected_ns = ns
        self._paths.publish(messages.trajectory_msg(stamps.tolist(), TRUE[:k], 'map', ns))
        return ns

    def drive_and_correct(self):
        """Wait until re-rendering is in progress; returns its stamp."""
        for k in range(COUNT):
            assert self.add(k, DRIFTED[k]) == 0
        corrected_ns = self.correct(COUNT)
        assert self.add(COUNT, TRUE[COUNT]) == 0
        assert self.by_hand.is_rerendering
        return corrected_ns


def test_windows_name_a_correction_when_all_of_the_map_has_undergone_it(graph):
    mapping = Mapping(graph)
    corrected_ns = mapping.drive_and_correct()
    named = [0]
    expected = [0]
    while mapping.by_hand.is_rerendering:
        k = COUNT + len(named)
        named.append(mapping.add(k, TRUE[k]))
        expected.append(mapping.by_hand.corrected_ns)
    assert named == expected and len(named) > 2

    def is_corrected():
        return any(named_by(shown) == corrected_ns for shown in mapping.maps[-1:])

    graph.until(is_corrected, 'the corrected map')
    corrected = next(shown for shown in mapping.maps if named_by(shown) == corrected_ns)
    graph.until(
        lambda: corrected.header.stamp in [shown.header.stamp for shown in mapping.whole],
        'a whole map of the correction',
    )
    assert graph.stop('grid_mapper') == 0


def test_a_map_that_is_saved_meanwhile_has_undergone_the_correction(graph, tmp_path):
    mapping = Mapping(graph)
    corrected_ns = mapping.drive_and_correct()
    response = graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(tmp_path / 'room')))
    assert response.success, response.message
    mapping.by_hand.finish()
    saved = sessions.load_grid(str(tmp_path / 'room'), CONFIG)
    expected = mapping.by_hand.shown.known_area()
    np.testing.assert_array_equal(saved.known_area().cells, expected.cells)
    assert mapping.add(COUNT + 1, TRUE[COUNT + 1]) == corrected_ns
    assert graph.stop('grid_mapper') == 0


def test_a_mapper_that_is_killed_meanwhile_resumes_with_the_published_map(graph):
    mapping = Mapping(graph)
    corrected_ns = mapping.drive_and_correct()
    shown = mapping.by_hand.shown.state()

    def is_kept():
        files = list((graph.folder / 'state').glob('[!.]*.grid_mapper.npz'))
        if not files:
            return False
        with np.load(files[0]) as state:
            return int(state['latest_ns']) == corrected_ns

    graph.until(is_kept, 'its state')
    graph.stop('grid_mapper', signal.SIGKILL)
    graph.drain()
    mapping.maps.clear()
    mapping.start()
    graph.until(lambda: mapping.maps, 'the map, at once')
    known = messages.grid_from_msg(mapping.maps[-1])
    expected = occupancy.OccupancyGrid.from_state(shown, CONFIG).known_area()
    np.testing.assert_array_equal(known.cells, expected.cells)
    # Messages published before discovery are lost.
    mapping.windows.clear()
    graph.until(
        lambda: (
            mapping.publish(COUNT + 1, TRUE[COUNT + 1])
            or any(named_by(window.grid) == corrected_ns for window in mapping.windows)
        ),
        'a local map of the corrected grid, or others would wait for it',
    )
    assert graph.stop('grid_mapper') == 0
