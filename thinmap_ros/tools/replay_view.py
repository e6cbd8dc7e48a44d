"""A replay shown to a view: the same picture that the live viewer makes of the nodes."""

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.estimate import Estimate
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizers import line_features
from thinmap_ros.pipeline import Pipeline
from thinmap_ros.view.null_view import NullView

# What is large is put together once a second, as a view does not draw it more often.
_PERIOD_NS = 1_000_000_000
_STAGES = {'localizer': 'localizer', 'grid': 'map update', 'topology': 'graph update'}


class ReplayView:
    """Tells a view what a pipeline makes of each scan.

    At the end `last` tells of the map and graph once more.
    """

    def __init__(self, view: NullView) -> None:
        """Begin with nothing shown."""
        self._view = view
        self._T_map_odom: Array | None = None
        self._drawn_ns: int | None = None

    def step(self, scan: Scan, T_odom_base: Array, estimate: Estimate, pipeline: Pipeline) -> None:
        """Show what came of a scan with the odometry pose (3,) at its stamp."""
        ns = scan.stamp_ns
        view = self._view
        view.pose(ns, estimate.T_map_base, estimate.covariance)
        view.scan(ns, scan)
        if self._T_map_odom is None:
            self._T_map_odom = estimate.T_map_odom
        # Odometry as if it had been all there is since the first pose.
        view.trail(ns, 'odometry', se2.compose(self._T_map_odom, T_odom_base))
        sigma_m = float(np.sqrt(max(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1], 0.0)))
        view.number(ns, 'error', '2 sigma, cm', 200.0 * sigma_m)
        for curve, count in (
            ('features', estimate.n_features),
            ('local features', estimate.n_local),
            ('matched lines', estimate.matched),
        ):
            view.number(ns, 'count', curve, float(count))
        for stage, curve in _STAGES.items():
            view.number(ns, 'step', curve, 1000.0 * pipeline.stage_seconds[stage][-1])
        if self._drawn_ns is None or abs(ns - self._drawn_ns) >= _PERIOD_NS:
            self.last(ns, pipeline)

    def last(self, ns: int, pipeline: Pipeline) -> None:
        """Show map, graph and features as they are now."""
        self._drawn_ns = ns
        view = self._view
        topology = pipeline.topology.map
        view.grid(ns, pipeline.grid.patch())
        view.topology(ns, topology)
        view.number(ns, 'count', 'nodes', float(len(topology.nodes)))
        features = line_features(pipeline.localizer)
        ends = np.array([[feature.start, feature.end] for feature in features]).reshape(-1, 2, 2)
        view.lines(ns, ends, np.array([feature.local for feature in features], dtype=bool))
        near = {node for feature in features if feature.local for node in feature.nodes}
        places = [topology.nodes[node].position for node in sorted(near & topology.nodes.keys())]
        view.local_area(ns, np.array(places).reshape(-1, 2))
