"""Paper 3, Fig. 14: a floor of 70 x 10 m over twenty minutes, at marked places."""

from dataclasses import dataclass
from itertools import islice

import numpy as np

from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation import map_errors
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Table
from thinmap_ros.evaluation.slam_run import Run, run_drive
from thinmap_ros.experiments.drives import Source, world_of
from thinmap_ros.pipeline import Pipeline, PipelineResult
from thinmap_ros.sim.drives import DriveSample
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.view.plots import (
    Curve,
    GraphLayer,
    MapLayer,
    Panel,
    Plot,
    RobotMarkers,
    TextLabels,
    xy,
)

_MARKS = 'ABCDE'


@dataclass(frozen=True)
class _Setup:
    """The drive, its tables and figures, and what the paper reports.

    quick_scans: length of a short drive. row_scans: scans for each row of the table.
    window_m: side of a local map. limits: of a picture of the floor, x, x, y, y, m.
    paper_lines: features of the floor. paper_error_m, paper_error_deg, paper_step_ms: the largest.
    """

    quick_scans: int
    row_scans: int
    window_m: float
    limits: tuple[float, float, float, float]
    paper_lines: int
    paper_error_m: float
    paper_error_deg: float
    paper_step_ms: float


_SETUP = _Setup(
    quick_scans=150,
    row_scans=10,
    window_m=10.0,
    limits=(-1.0, 71.0, -0.5, 10.5),
    paper_lines=88,
    paper_error_m=0.20,
    paper_error_deg=5.0,
    paper_step_ms=40.0,
)


class _Marks:
    """What the map and its window look like at some scans."""

    def __init__(self, scans: int) -> None:
        self._at = {
            round((k + 1) / len(_MARKS) * (scans - 1)): name for k, name in enumerate(_MARKS)
        }
        self.wide: list[Panel] = []
        self.near: list[Panel] = []
        self._passed: list[tuple[str, Array]] = []

    def __call__(
        self, k: int, sample: DriveSample, pipeline: Pipeline, step: PipelineResult
    ) -> None:
        if k not in self._at:
            return
        T = step.estimate.T_map_base
        self._passed.append((self._at[k], T[:2]))
        names, places = zip(*self._passed, strict=True)
        graph = pipeline.topology.map.copy()
        robot = RobotMarkers(T[None], radius_m=PRESETS['3at'].radius_m)
        words = TextLabels(np.array(places), names, 11.0)
        title = (
            f'{self._at[k]}: after {sample.scan.stamp_ns / 6e10:.1f} min, '
            f'{step.estimate.n_features} features'
        )
        self.wide.append(
            Panel(
                [MapLayer(pipeline.grid.known_area()), robot, words],
                title,
                limits=_SETUP.limits,
            )
        )
        window = pipeline.grid.window(float(T[0]), float(T[1]), _SETUP.window_m)
        self.near.append(
            Panel([MapLayer(window), GraphLayer(graph), robot], self._at[k], limits=_box(T))
        )


def _box(T: Array) -> tuple[float, float, float, float]:
    half = _SETUP.window_m / 2.0
    return float(T[0]) - half, float(T[0]) + half, float(T[1]) - half, float(T[1]) + half


def run(source: Source) -> Outcome:
    """Drive the floor once, both filters and our localizer on the same scans."""
    world = world_of('floor_70x10')
    length = _SETUP.quick_scans if source.quick else None
    samples = list(islice(source.samples('floor_70x10'), length))
    marks = _Marks(len(samples))
    ti = run_drive(samples, 'ekf_ti', marks)
    full = run_drive(samples, 'ekf_full')
    ours = run_drive(samples, 'scan_matching')
    error = map_errors.map_error(ti.pipeline.grid.known_area(), world)
    off = np.hypot(*ti.errors()[:, :2].T)
    turned = np.degrees(np.abs(ti.errors()[:, 2]))
    return Outcome(
        'A floor of 70 x 10 m over twenty minutes',
        'SLAM paper, section 5.2, Fig. 14',
        'A Pioneer 3-AT with an LMS200 drives the tour of the floor with its 88 lines at 0.2 m/s: '
        f'{ti.path_length_m:.0f} m in {ti.seconds[-1] / 60.0:.0f} minutes.',
        [
            Table('path', _PATH, _rows(ti)),
            Table('map', map_errors.COLUMNS, [map_errors.row('floor_70x10', error)]),
            Table(
                'times', ['time_s', 'features', 'ti_ms', 'full_ms'], _times(ti, full), timed=True
            ),
        ],
        [
            Plot(
                'fig14_global',
                'Paper 3, Fig. 14 (left): the global grid map when the robot is at A to E.',
                marks.wide,
                panel_inches=(9.0, 2.0),
            ),
            Plot(
                'fig14_local',
                'Paper 3, Fig. 14 (right): the local maps of 10 x 10 m there, '
                'with the topological map.',
                marks.near,
                columns=len(marks.near),
                panel_inches=(3.4, 3.4),
            ),
            Plot(
                'map_error',
                'Paper 3, to Fig. 14: the floor, its map, and the errors of the map.',
                map_errors.panels(error, world),
                panel_inches=(9.5, 2.4),
            ),
            _over_time(ti, full, off, turned),
        ],
        _comparisons(ti, full, ours, turned),
    )


_PATH = [
    'time_s',
    'true_x_m',
    'true_y_m',
    'x_m',
    'y_m',
    'error_m',
    'error_deg',
    'odometry_error_m',
    'features',
    'local',
]


def _rows(done: Run) -> list[list[float]]:
    off = done.errors()
    wheels = done.errors(done.odometry)
    return [
        [
            done.seconds[k],
            *done.truth[k][:2],
            *done.estimate[k][:2],
            float(np.hypot(*off[k, :2])),
            float(np.degrees(abs(off[k, 2]))),
            float(np.hypot(*wheels[k, :2])),
            done.features[k],
            done.local[k],
        ]
        for k in range(0, len(done.seconds), _SETUP.row_scans)
    ]


def _times(ti: Run, full: Run) -> list[list[float]]:
    """Medians over a minute."""
    minutes = np.floor(np.array(ti.seconds) / 60.0)
    rows = []
    for minute in np.unique(minutes):
        here = minutes == minute
        medians = (float(np.median(np.array(done.step_ms)[here])) for done in (ti, full))
        rows.append([60.0 * minute, float(np.array(ti.features)[here].max()), *medians])
    return rows


def _over_time(ti: Run, full: Run, off: Array, turned: Array) -> Plot:
    seconds = np.array(ti.seconds)
    times = np.array(_times(ti, full))
    panels = [
        Panel(
            [Curve(xy(seconds, 100.0 * off), 'position', 0, width=1.0)],
            '',
            '',
            'position (cm)',
            plan=False,
        ),
        Panel(
            [Curve(xy(seconds, turned), 'heading', 1, width=1.0)],
            '',
            '',
            'heading (deg)',
            plan=False,
        ),
        Panel(
            [
                Curve(times[:, [0, 3]], 'conventional EKF-SLAM', 6, '-', marker='s'),
                Curve(times[:, [0, 2]], 'EKF-SLAM/TI', 2, '--', marker='o'),
            ],
            '',
            'time (s)',
            'CPU a scan (ms)',
            plan=False,
        ),
    ]
    caption = (
        'Paper 3, to Fig. 14: errors of the pose over time, '
        'and CPU time of a scan (with grid and topological map).'
    )
    return Plot('over_time', caption, panels, panel_inches=(8.5, 2.1), legend='inside')


def _comparisons(ti: Run, full: Run, ours: Run, turned: Array) -> list[Comparison]:
    known = ti.features[-1]
    slowest = float(np.percentile(ti.step_ms, 99))
    medians = [float(np.median(done.step_ms)) for done in (ti, full)]
    return [
        Comparison(
            'features extracted',
            str(_SETUP.paper_lines),
            str(known),
            abs(known - _SETUP.paper_lines) <= 0.1 * _SETUP.paper_lines,
            remark='the world has 88 surfaces of at least 0.8 m; those that continue behind a door '
            'are one feature',
        ),
        Comparison(
            'position error',
            'about 20 cm',
            ti.position_error,
            bool(np.hypot(*ti.errors()[:, :2].T).max() <= _SETUP.paper_error_m),
            remark=f'scan matching (`slam: scan_matching`): {ours.position_error}',
        ),
        Comparison(
            'heading error',
            'about 5 deg',
            f'{turned.mean():.2f} deg (mean), {turned.max():.2f} deg (maximum)',
            bool(turned.max() <= _SETUP.paper_error_deg),
        ),
        Comparison(
            'CPU time of a step',
            '30-40 ms (computer of 2006)',
            f'{medians[0]:.1f} ms (median), {slowest:.1f} ms (99th percentile)',
            slowest <= _SETUP.paper_step_ms,
            timed=True,
        ),
        Comparison(
            'CPU time of a step, conventional filter',
            'grows',
            f'{medians[1]:.1f} ms (median)',
            timed=True,
            remark='with so few features both cost about the same; '
            'see the section on the number of features',
        ),
    ]
