"""Paper 3, Fig. 13: time of a filter's step against the number of features."""

from dataclasses import dataclass
from functools import cached_property
from time import process_time

import numpy as np

from thinmap_ros.core.ekf_slam.ekf import CompressedEkf
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Table
from thinmap_ros.experiments.drives import Source
from thinmap_ros.view.plots import Curve, Panel, Plot

_COUNTS = (25, 50, 88, 200, 400, 800, 1500, 3000)
_COUNTS_QUICK = (25, 88)


@dataclass(frozen=True)
class _Setup:
    """The steps that are timed, and what counts as constant and as the same.

    local: features of a local area. seen: those of them that a step sees. steps: of each filter.
    area_steps: steps in a local area, a metre. step_m: length of a step, 0.2 m/s at 5 Hz.
    motion_variance: of a step in x, y and heading, m^2 and rad^2. line_variances: of a line in
    distance and direction, m^2 and rad^2. flat_ratio: largest ratio of step times that are nearly
    constant, from the first count to flat_until. same: largest difference of poses, m and rad.
    """

    local: int
    seen: int
    steps: int
    area_steps: int
    step_m: float
    motion_variance: float
    line_variances: tuple[float, float]
    flat_ratio: float
    flat_until: int
    same: float

    @cached_property
    def step(self) -> Array:
        """A step straight ahead (3,)."""
        return np.array([self.step_m, 0.0, 0.0])

    @cached_property
    def motion_covariance(self) -> Array:
        """Covariance of a step (3, 3)."""
        return self.motion_variance * np.eye(3)

    @cached_property
    def line_covariance(self) -> Array:
        """Covariance of a line (2, 2)."""
        return np.diag(self.line_variances)


_SETUP = _Setup(
    local=12,
    seen=7,
    steps=100,
    area_steps=25,
    step_m=0.04,
    motion_variance=1e-6,
    line_variances=(1e-4, 1e-5),
    flat_ratio=1.5,
    flat_until=800,
    same=1e-6,
)


def run(source: Source) -> Outcome:
    """Time both filters on the same steps."""
    counts = _COUNTS_QUICK if source.quick else _COUNTS
    times = []
    same = []
    for count in counts:
        local_ms, local_pose = _drive(source.seed, count, True)
        full_ms, full_pose = _drive(source.seed, count, False)
        times.append([count, *_spread(local_ms), *_spread(full_ms)])
        same.append([count, float(np.abs(local_pose - full_pose).max())])
    first = times[0]
    last = times[-1]
    half = next((row for row in times if row[0] >= _SETUP.flat_until), last)
    apart = max(row[1] for row in same)
    return Outcome(
        'Time of a filter step against the number of features',
        'SLAM paper, section 5.2, Fig. 13',
        f'Maps of {counts[0]} to {counts[-1]} lines. A step is a prediction and an update with '
        f'{_SETUP.seen} observed lines. A local area has {_SETUP.local} features; '
        f'it changes after every {_SETUP.area_steps} steps (1 m). '
        'The conventional filter makes the same steps with all features in its state. '
        'Times are CPU times of the filter alone; the page Speed has those of a whole scan.',
        [
            Table('times', _COLUMNS, times, timed=True),
            Table('difference', ['features', 'largest_difference_of_pose'], same),
        ],
        [_plot(np.array(times))],
        [
            Comparison(
                'EKF-SLAM/TI',
                'nearly constant, 30-40 ms in all',
                f'{first[1]:.2f} ms with {first[0]}, '
                f'{last[1]:.2f} ms with {last[0]} features (medians)',
                bool(half[1] <= _SETUP.flat_ratio * first[1]),
                timed=True,
                remark=f'{half[1] / first[1]:.2f} times as much with {half[0]} '
                f'as with {first[0]} features, '
                f'{last[1] / first[1]:.2f} times with {last[0]}; '
                f'mean {first[2]:.2f} and {last[2]:.2f} ms, '
                f'up to {last[3]:.0f} ms for a change of the local area',
            ),
            Comparison(
                'conventional EKF-SLAM',
                'grows, rapidly from about 100 on',
                f'{first[4]:.2f} ms with {first[0]}, '
                f'{last[4]:.1f} ms with {last[0]} features (medians)',
                bool(last[4] > 2.0 * first[4]),
                timed=True,
            ),
            Comparison(
                'difference of the estimates',
                'almost identical',
                f'pose: at most {apart:.1e} (m, rad)',
                apart < _SETUP.same,
                remark='the compressed update is exact; that of the paper is an approximation',
            ),
        ],
    )


_COLUMNS = [
    'features',
    'ti_median_ms',
    'ti_mean_ms',
    'ti_longest_ms',
    'full_median_ms',
    'full_mean_ms',
    'full_longest_ms',
]


def _drive(seed: int, count: int, local: bool) -> tuple[Array, Array]:
    """Time of each step, ms, (N,), and the pose at the end (3,)."""
    rng = np.random.default_rng([seed, count])
    ekf = CompressedEkf(np.zeros(3), np.diag([1e-4, 1e-4, 1e-4]))
    lines = np.column_stack([rng.uniform(1.0, 40.0, count), rng.uniform(-np.pi, np.pi, count)])
    for number, line in enumerate(lines):
        ekf.add(number, line, _SETUP.line_covariance)
    areas = [
        rng.choice(count, min(_SETUP.local, count), replace=False).tolist()
        for _ in range(_SETUP.steps // _SETUP.area_steps)
    ]
    size = (_SETUP.steps, min(_SETUP.seen, count), 2)
    noise = rng.normal(0.0, 1.0, size) * np.sqrt(_SETUP.line_variances)
    taken = []
    for step in range(_SETUP.steps):
        area = areas[step // _SETUP.area_steps]
        began = process_time()
        if local and step % _SETUP.area_steps == 0:
            ekf.set_local_area(area)
        _step(ekf, area[: len(noise[step])], noise[step])
        taken.append(1e3 * (process_time() - began))
    return np.array(taken[1:]), ekf.local.pose


def _step(ekf: CompressedEkf, seen: list[int], noise: Array) -> None:
    """Predict, and correct by the features that are seen."""
    pose = ekf.local.pose
    ahead = pose + [_SETUP.step_m * np.cos(pose[2]), _SETUP.step_m * np.sin(pose[2]), 0.0]
    ekf.local.predict(ahead, _SETUP.step, _SETUP.motion_covariance)
    indices = np.array([ekf.area.index(number) for number in seen])
    z = np.array([ekf.local.innovations(int(k))[0] for k in indices]) + noise
    ekf.local.update(indices, z, np.tile(_SETUP.line_covariance, (len(indices), 1, 1)))
    ekf.flush_step()


def _spread(taken: Array) -> list[float]:
    return [float(np.median(taken)), float(taken.mean()), float(taken.max())]


def _plot(times: Array) -> Plot:
    layers = [
        Curve(times[:, [0, 4]], 'conventional EKF-SLAM, median', 6, '-', marker='s'),
        Curve(times[:, [0, 1]], 'EKF-SLAM/TI, median', 2, '--', marker='o'),
        Curve(times[:, [0, 3]], 'EKF-SLAM/TI, longest step', 4, ':', marker='^'),
    ]
    panel = Panel(
        layers,
        '',
        'features in the map',
        'CPU time of a step (ms)',
        plan=False,
        log_x=True,
        log_y=True,
    )
    caption = 'Paper 3, Fig. 13: processing time of EKF-SLAM (solid) and EKF-SLAM/TI (dashed).'
    return Plot('fig13', caption, [panel], panel_inches=(7.0, 4.4), legend='inside')
