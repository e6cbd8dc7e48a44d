"""Shows messages, live or from a bag, in a view."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import topology_from_msg
from thinmap_ros.files.safe import atomic_write
from thinmap_ros.logs import decode
from thinmap_ros.logs.readers.bag import SCAN, Bag
from thinmap_ros.logs.transforms import StaticTransforms
from thinmap_ros.view import palette
from thinmap_ros.view.interface import ApartScans, NullView, StampMatcher
from thinmap_ros.view.rerun_view import View

_TF_STATIC = '/tf_static'
_MEDIAN = re.compile(r'median (\d+\.\d+) ms')
_STEPS = {'map update', 'graph update', 'explorer', 'global localization'}


class MessageView:
    """Shows messages by topic in a view.

    laser_pose returns T_base_laser (3,) of a laser frame, or None while it is unknown: scans of
    this laser are not shown.
    namespace: of the nodes whose step times are shown; /diagnostics contains those of all robots.
    """

    def __init__(
        self, view: NullView, laser_pose: Callable[[str], Array | None], namespace: str = ''
    ) -> None:
        self._view = view
        self._laser_pose = laser_pose
        self._namespace = namespace.strip('/')
        self._map = MapReceiver()
        self._places: dict[int, Array] = {}
        self._T_odom_base: Array | None = None
        self._T_map_odom: Array | None = None
        self._apart = ApartScans()
        self._distance_m = 0.0
        self._seen_m2 = 0.0
        self._pairs: StampMatcher[Array, Array] = StampMatcher()
        self._takers: dict[str, Callable[[int, Any], None]] = {
            'map': self._on_map,
            'map_updates': self._on_map_update,
            'scan': self._on_scan,
            'pose': self._on_pose,
            'odom': self._on_odometry,
            'ground_truth': self._on_truth,
            'topology': self._on_topology,
            'regions': self._on_regions,
            'end_nodes': self._on_end_nodes,
            'line_features': self._on_lines,
            'plan': self._on_plan,
            'exploration_status': self._on_exploration,
            'slam_status': self._on_slam,
            'localized_scan': self._on_localized_scan,
            'localization_samples': self._on_samples,
            'diagnostics': self._on_diagnostics,
        }

    @property
    def topics(self) -> set[str]:
        """Relative names of the supported topics."""
        return set(self._takers)

    def show(self, topic: str, message: Any) -> None:
        """Show a message (of ROS's class or rosbags'). Raises InputError if it is invalid."""
        try:
            self._takers[topic](decode.stamp_ns(message), message)
        except ValueError as error:  # unknown region kinds, cells that form no rectangle
            raise InputError(' '.join(str(error).split())) from error

    def _on_map(self, ns: int, message: Any) -> None:
        self._map.replace(decode.patch(message), ns)
        self._show_map(ns)

    def _on_map_update(self, ns: int, message: Any) -> None:
        if self._map.update(ns, *decode.map_update(message)):
            self._show_map(ns)

    def _show_map(self, ns: int) -> None:
        if self._map.patch is not None:
            self._view.grid(ns, self._map.patch)

    def _on_scan(self, ns: int, message: Any) -> None:
        T_base_laser = self._laser_pose(message.header.frame_id)
        if T_base_laser is not None:
            self._view.scan(ns, decode.scan(message, ns, T_base_laser))

    def _on_pose(self, ns: int, message: Any) -> None:
        T_map_base = decode.checked_pose(message.pose.pose)
        full = np.asarray(message.pose.covariance, dtype=np.float64).reshape(6, 6)
        covariance = full[np.ix_((0, 1, 5), (0, 1, 5))]
        if not np.isfinite(covariance).all():
            raise InputError('covariance: expected finite numbers')
        self._view.pose(ns, T_map_base, covariance)
        self._view.scalar(ns, 'error', '2 sigma, cm', 200.0 * se2.sigma_m(covariance))
        self._compare(ns, self._pairs.add_left(ns, T_map_base))
        if self._T_map_odom is None and self._T_odom_base is not None:
            self._T_map_odom = se2.compose(T_map_base, se2.invert(self._T_odom_base))

    def _on_odometry(self, ns: int, message: Any) -> None:
        """Trajectory of dead reckoning from the first pose."""
        self._T_odom_base = decode.checked_pose(message.pose.pose)
        if self._T_map_odom is not None:
            self._view.trajectory(ns, 'odometry', se2.compose(self._T_map_odom, self._T_odom_base))

    def _on_truth(self, ns: int, message: Any) -> None:
        T_map_base = decode.checked_pose(message.pose)
        self._view.trajectory(ns, 'truth', T_map_base)
        self._compare(ns, self._pairs.add_right(ns, T_map_base))

    def _compare(self, ns: int, pair: tuple[Array, Array] | None) -> None:
        if pair is None:
            return
        difference = pair[0] - pair[1]
        self._view.scalar(
            ns, 'error', 'position, cm', 100.0 * float(np.hypot(difference[0], difference[1]))
        )
        heading = abs(float(np.degrees(se2.wrap(float(difference[2])))))
        self._view.scalar(ns, 'error', 'heading, deg', heading)

    def _on_topology(self, ns: int, message: Any) -> None:
        topology = topology_from_msg(message)
        self._places = {node.id: node.position for node in topology.nodes.values()}
        self._view.topology(ns, topology)
        self._view.scalar(ns, 'count', 'nodes', len(topology.nodes))

    def _on_regions(self, ns: int, message: Any) -> None:
        regions = decode.regions(message)
        colours = [palette.region(region.kind, region.id) for region in regions]
        self._view.regions(ns, [region.outline for region in regions], colours)

    def _on_end_nodes(self, ns: int, message: Any) -> None:
        nodes = decode.end_nodes(message)
        places = np.array([[node.x, node.y] for node in nodes]).reshape(-1, 2)
        self._view.end_nodes(ns, places, np.array([node.probability for node in nodes]))

    def _on_lines(self, ns: int, message: Any) -> None:
        ends = [[[f.start.x, f.start.y], [f.end.x, f.end.y]] for f in message.features]
        local = np.array([f.in_local_area for f in message.features], dtype=bool)
        self._view.lines(ns, np.array(ends, dtype=np.float64).reshape(-1, 2, 2), local)
        near = {int(node) for f in message.features if f.in_local_area for node in f.node_ids}
        places = [self._places[node] for node in sorted(near & self._places.keys())]
        self._view.local_area(ns, np.array(places).reshape(-1, 2))

    def _on_samples(self, ns: int, message: Any) -> None:
        places = [[pose.position.x, pose.position.y] for pose in message.poses]
        self._view.particles(ns, np.array(places, dtype=np.float64).reshape(-1, 2))

    def _on_plan(self, ns: int, message: Any) -> None:
        self._view.plan(ns, decode.path(message))

    def _on_exploration(self, ns: int, message: Any) -> None:
        place = message.target_position
        self._view.target(ns, np.array([place.x, place.y]) if message.has_target else None)
        distance_m = float(message.distance_m)
        if distance_m < self._distance_m:  # another exploration
            self._seen_m2 = 0.0
        self._distance_m = distance_m
        # What was seen stays so, even where a chair then covers it or the map is corrected.
        self._seen_m2 = max(self._seen_m2, float(message.known_area_m2))
        self._view.scalar(ns, 'progress', 'seen, m2', self._seen_m2)
        self._view.scalar(ns, 'progress', 'distance, m', distance_m)
        self._view.scalar(ns, 'count', 'end nodes left', float(message.end_nodes_remaining))

    def _on_slam(self, ns: int, message: Any) -> None:
        self._view.scalar(ns, 'step', 'localizer', float(message.step_time_ms))
        self._view.scalar(ns, 'count', 'features', float(message.features))
        self._view.scalar(ns, 'count', 'local features', float(message.local_features))
        self._view.scalar(ns, 'count', 'matched lines', float(message.matched))

    def _on_localized_scan(self, ns: int, message: Any) -> None:
        if self._apart.update(message):
            self._view.apart(ns, self._apart.points)

    def _on_diagnostics(self, ns: int, message: Any) -> None:
        """Step times of nodes, from /diagnostics."""
        if ns <= 0:
            return  # published before the first step
        for status in message.status:
            if status.name.rpartition(': ')[0].rpartition('/')[0] != self._namespace:
                continue
            for pair in status.values:
                step, _, key = pair.key.rpartition(': ')
                median = _MEDIAN.match(pair.value)
                if key == 'step time' and median and step in _STEPS:
                    self._view.scalar(ns, 'step', step, float(median[1]))


def recording_from_bag(bag_path: Path, out_rrd: Path) -> None:
    """Write the .rrd recording of the bag of a run, atomically.

    Invalid messages are omitted. Raises InputError if rerun is missing or the bag is invalid.
    """
    bag = Bag(bag_path)
    mounts = _static_transforms(bag)
    with atomic_write(out_rrd) as aside:
        view = View(aside)
        try:
            _tell(bag, MessageView(view, lambda frame: _laser_pose(mounts, frame)))
        finally:
            view.close()


def _tell(bag: Bag, feed: MessageView) -> None:
    names = {f'/{topic}': topic for topic in feed.topics}
    names |= {topic: 'scan' for topic, kind in bag.topics.items() if kind == SCAN}
    for raw in bag.messages(set(names)):
        try:
            feed.show(names[raw.topic], bag.decode(raw))
        except InputError:
            continue


def _static_transforms(bag: Bag) -> StaticTransforms:
    transforms = StaticTransforms()
    for raw in bag.messages({_TF_STATIC}):
        for transform in bag.decode(raw).transforms:
            transforms.add(transform)
    return transforms


def _laser_pose(transforms: StaticTransforms, frame: str) -> Array | None:
    mount = transforms.laser_mount(frame, 'base_link')
    return None if mount is None else mount.T_base_laser
