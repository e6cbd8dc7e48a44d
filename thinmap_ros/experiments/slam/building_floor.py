"""Paper 3, Fig. 7, 8, 11, 12: a building floor by both filters; features used; error bounds."""

from dataclasses import dataclass
from itertools import islice

import numpy as np

from thinmap_ros.core.ekf_slam.features import LineFeature
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.evaluation import map_errors
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Rows, Table
from thinmap_ros.evaluation.slam_run import Run, run_drive
from thinmap_ros.experiments.drives import Source, world_of
from thinmap_ros.pipeline import Pipeline, PipelineResult
from thinmap_ros.sim.drives import DriveSample
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.view.plots import (
    Band,
    Curve,
    GraphLayer,
    Layer,
    MapLayer,
    Panel,
    Plot,
    RobotMarkers,
    Segments,
    xy,
)


@dataclass(frozen=True)
class _Setup:
    """The drive, its tables and figures, and what the paper reports.

    quick_scans: length of a short drive. local_area_at: moment of Fig. 7 and 8, as a share of the
    drive. row_scans: scans for each row of the tables. sigmas: width of the error bounds.
    limits: of a picture, x, x, y, y, m; the odometry alone goes far beyond. paper_lines, paper_all,
    paper_used: features of the floor, of the conventional filter, of an update with local areas.
    """

    quick_scans: int
    local_area_at: float
    row_scans: int
    sigmas: float
    limits: tuple[float, float, float, float]
    paper_lines: int
    paper_all: int
    paper_used: int


_SETUP = _Setup(
    quick_scans=200,
    local_area_at=0.45,
    row_scans=5,
    sigmas=3.0,
    limits=(-1.0, 41.0, -2.0, 12.0),
    paper_lines=33,
    paper_all=25,
    paper_used=7,
)


class _Glance:
    """Estimate and map at one scan."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.patch: GridPatch | None = None

    def __call__(
        self, k: int, sample: DriveSample, pipeline: Pipeline, step: PipelineResult
    ) -> None:
        if k == self.number:
            self.patch = pipeline.grid.known_area()
            self.graph = pipeline.topology.map.copy()
            self.features = pipeline.localizer.features
            self.pose = step.estimate.T_map_base


def run(source: Source) -> Outcome:
    """Drive the floor once; both filters and the scan matcher process the same scans."""
    world = world_of('floor_40x10')
    length = _SETUP.quick_scans if source.quick else None
    samples = list(islice(source.samples('floor_40x10'), length))
    glance = _Glance(round(_SETUP.local_area_at * len(samples)))
    ti = run_drive(samples, 'ekf_ti', glance)
    full = run_drive(samples, 'ekf_full')
    ours = run_drive(samples, 'scan_matching')
    error = map_errors.map_error(ti.pipeline.grid.known_area(), world)
    apart = np.hypot(*(np.array(ti.estimate) - np.array(full.estimate))[:, :2].T)
    used = float(np.median(ti.local))
    known = ti.features[-1]
    return Outcome(
        'A building floor with 33 lines',
        'SLAM paper, sections 4 and 5.1, Fig. 7, 8, 11 and 12',
        'The floor of 40 x 10 m: a Pioneer 3-AT with an LMS200 drives its tour at 0.2 m/s '
        f'({ti.path_length_m:.0f} m). Both filters process the same scans: the conventional one '
        '(all features) and EKF-SLAM/TI (local areas), each with odometry and line features only.',
        [
            Table('map', map_errors.COLUMNS, [map_errors.row('floor_40x10', error)]),
            Table('path', _PATH, _path_rows(ti, full)),
            Table(
                'features',
                ['id', 'r_m', 'alpha_rad', 'length_m', 'local'],
                _feature_rows(ti.pipeline),
            ),
        ],
        [
            _local_area(glance),
            Plot(
                'fig11',
                'Paper 3, Fig. 11: (a) CAD data, (b) global grid map by EKF-SLAM/TI, '
                '(c) its errors.',
                map_errors.panels(error, world),
                panel_inches=(9.0, 2.9),
            ),
            _paths(ti, full),
            _bounds(ti),
        ],
        [*_comparisons(ti, full, apart, used, known), _errors_beside(ti, ours), _similar(error)],
    )


def _comparisons(ti: Run, full: Run, apart: Array, used: float, known: int) -> list[Comparison]:
    inside = _inside(ti)
    return [
        Comparison(
            'line features extracted',
            str(_SETUP.paper_lines),
            str(known),
            abs(known - _SETUP.paper_lines) <= 0.1 * _SETUP.paper_lines,
            remark='the world has 33 surfaces of at least 0.8 m; those that continue behind a door '
            'are one feature',
        ),
        Comparison(
            'features used for an update',
            f'{_SETUP.paper_used} instead of more than {_SETUP.paper_all}',
            f'{used:.0f} (median; maximum {max(ti.local)}) instead of {full.local[-1]}',
            used <= 0.5 * full.local[-1],
        ),
        Comparison(
            'paths of both filters',
            'almost identical',
            f'mean distance {100 * apart.mean():.2f} cm, maximum {100 * apart.max():.1f} cm',
            bool(apart.max() < 0.05),
        ),
        Comparison(
            'errors within 3 sigma (x, y, heading)',
            '',
            ', '.join(f'{share:.1%}' for share in inside),
            remark='99.7 % in a consistent filter; more: the covariance is conservative',
        ),
    ]


def _errors_beside(ti: Run, ours: Run) -> Comparison:
    return Comparison(
        'position error',
        '',
        ti.position_error,
        remark=f'scan matching (`slam: scan_matching`): {ours.position_error}',
    )


def _similar(error: map_errors.MapError) -> Comparison:
    off = error.cells_off_m
    return Comparison(
        'map against CAD data',
        'similar to the accurate map',
        f'mean error of occupied cells {100 * off.mean():.1f} cm; '
        f'{error.found:.0%} of all surfaces found',
        bool(off.mean() < 0.1),
    )


def _errors(done: Run) -> Array:
    """Estimate minus truth in the map frame, (N, 3): m, m, rad."""
    off = np.array(done.estimate) - np.array(done.truth)
    off[:, 2] = wrap(off[:, 2])
    return off


def _inside(done: Run) -> list[float]:
    """Shares of the scans with errors within three sigma, for x, y and heading."""
    return [
        float(share)
        for share in (np.abs(_errors(done)) <= _SETUP.sigmas * np.array(done.sigmas)).mean(axis=0)
    ]


_PATH = [
    'time_s',
    'true_x_m',
    'true_y_m',
    'odometry_x_m',
    'odometry_y_m',
    'full_x_m',
    'full_y_m',
    'ti_x_m',
    'ti_y_m',
    'error_x_m',
    'error_y_m',
    'error_rad',
    'sigma_x_m',
    'sigma_y_m',
    'sigma_rad',
    'features',
    'local_features',
]


def _path_rows(ti: Run, full: Run) -> list[list[float]]:
    errors = _errors(ti)
    return [
        [
            ti.seconds[k],
            *ti.truth[k][:2],
            *ti.odometry[k][:2],
            *full.estimate[k][:2],
            *ti.estimate[k][:2],
            *errors[k],
            *ti.sigmas[k],
            ti.features[k],
            ti.local[k],
        ]
        for k in range(0, len(ti.seconds), _SETUP.row_scans)
    ]


def _feature_rows(pipeline: Pipeline) -> Rows:
    found = sorted(pipeline.localizer.features, key=lambda feature: feature.id)
    return [[f.id, f.r_m, f.alpha_rad, float(np.hypot(*(f.end - f.start))), f.local] for f in found]


def _ends(features: list[LineFeature], local: bool) -> Array:
    return np.array([[*f.start, *f.end] for f in features if f.local == local]).reshape(-1, 4)


def _local_area(glance: _Glance) -> Plot:
    assert glance.patch is not None
    stored = {node for feature in glance.features if feature.local for node in feature.nodes}
    nodes = TopologicalMap([node for i, node in glance.graph.nodes.items() if i in stored])
    layers: list[Layer] = [
        MapLayer(glance.patch),
        GraphLayer(glance.graph, 3.0),
        GraphLayer(nodes, 9.0),
        Segments(_ends(glance.features, False), 'other features', 5, 2.0),
        Segments(_ends(glance.features, True), 'features of the local area', 1, 4.0),
        RobotMarkers(glance.pose[None], radius_m=PRESETS['3at'].radius_m),
    ]
    caption = (
        'Paper 3, Fig. 7 and 8: local area: nodes near the robot (large: those that store its '
        'features) and the features of an update.'
    )
    return Plot('fig7_8', caption, [Panel(layers)], panel_inches=(9.5, 3.4))


def _paths(ti: Run, full: Run) -> Plot:
    panels = []
    for done, name in ((full, '(a) conventional EKF-SLAM'), (ti, '(b) EKF-SLAM/TI')):
        features = done.pipeline.localizer.features
        odometry = np.array(done.odometry)
        estimate = np.array(done.estimate)
        layers: list[Layer] = [
            Segments(_ends(features, False), 'features', 'black', 1.2),
            Segments(_ends(features, True), 'features used at the end', 1, 4.0),
            Curve(odometry[:, :2], 'odometry alone', 6, '-', width=1.0),
            Curve(estimate[:, :2], 'estimated path', 0, '--', width=1.6),
            RobotMarkers(estimate[-1:], radius_m=PRESETS['3at'].radius_m),
        ]
        title = f'{name}: {sum(f.local for f in features)} of {len(features)} features used'
        panels.append(Panel(layers, title, limits=_SETUP.limits))
    caption = (
        'Paper 3, Fig. 12: paths and line features by both filters; '
        'thick: the features used at the last pose.'
    )
    return Plot('fig12', caption, panels, panel_inches=(9.0, 3.2))


def _bounds(done: Run) -> Plot:
    seconds = np.array(done.seconds)
    errors = _errors(done)
    bounds = _SETUP.sigmas * np.array(done.sigmas)
    panels = []
    rows = (('x', 'cm', 100.0), ('y', 'cm', 100.0), ('heading', 'deg', 180.0 / np.pi))
    for k, (name, unit, scale) in enumerate(rows):
        layers: list[Layer] = [
            Band(seconds, -scale * bounds[:, k], scale * bounds[:, k], '3 sigma', 5),
            Curve(xy(seconds, scale * errors[:, k]), 'error', 0, width=1.0),
        ]
        panels.append(
            Panel(layers, '', 'time (s)' if k == 2 else '', f'{name} ({unit})', plan=False)
        )
    caption = (
        'Paper 3: errors of the estimated pose over time with 3-sigma bounds, '
        'EKF-SLAM/TI on the floor of 40 x 10 m.'
    )
    return Plot('bounds', caption, panels, panel_inches=(8.5, 1.9))
