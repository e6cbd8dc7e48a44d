"""Runs a drive through localizer, grid and topology, and computes its errors."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum
from time import process_time

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import config_class
from thinmap_ros.pipeline import Pipeline, PipelineConfig, PipelineResult
from thinmap_ros.sim.drives import DriveSample

Watch = Callable[[int, DriveSample, Pipeline, PipelineResult], None]


@dataclass(eq=False)
class Run:
    """Results of each scan: seconds (N,); poses (N, 3) true, by odometry and estimated.

    Also 1 sigma (N, 3), and numbers of features.
    """

    pipeline: Pipeline
    seconds: list[float] = field(default_factory=list)
    truth: list[Array] = field(default_factory=list)
    odometry: list[Array] = field(default_factory=list)
    estimate: list[Array] = field(default_factory=list)
    sigmas: list[Array] = field(default_factory=list)
    features: list[int] = field(default_factory=list)
    local: list[int] = field(default_factory=list)
    matched: list[int] = field(default_factory=list)
    step_ms: list[float] = field(default_factory=list)

    def errors(self, poses: list[Array] | None = None) -> Array:
        """Errors of poses (N, 3), or of the estimates.

        Along and across the true heading, m, and in heading, rad.
        """
        found = self.estimate if poses is None else poses
        return np.array([se2.between(T, other) for T, other in zip(self.truth, found, strict=True)])

    @property
    def position_error(self) -> str:
        """Position errors as text."""
        off = 100.0 * np.hypot(*self.errors()[:, :2].T)
        return f'{off.mean():.1f} cm (mean), {off.max():.1f} cm (maximum)'

    @property
    def path_length_m(self) -> float:
        """Length of the true path, m."""
        return se2.path_length_m(np.array(self.truth))


def run_drive(
    samples: Iterable[DriveSample], slam: str = 'ekf_ti', watch: Watch | None = None
) -> Run:
    """Run a drive in the world frame.

    slam: ekf_ti and ekf_full are the paper's filter, ti is ours. watch is called after each scan
    with its number.
    """
    run: Run | None = None
    for k, sample in enumerate(samples):
        if run is None:
            x, y, yaw = (float(v) for v in sample.T_world_base)
            kind = config_class(slam)
            config = kind(slam=slam, initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)
            run = Run(Pipeline(PipelineConfig(localizer=config, grid=PAPER_GRID)))
            start = sample
        began = process_time()
        step = run.pipeline.step(sample.scan, sample.T_odom_base)
        run.step_ms.append(1e3 * (process_time() - began))
        run.seconds.append(sample.scan.stamp_ns / 1e9)
        run.truth.append(sample.T_world_base)
        run.odometry.append(
            se2.compose(start.T_world_base, se2.between(start.T_odom_base, sample.T_odom_base))
        )
        run.estimate.append(step.estimate.T_map_base)
        run.sigmas.append(np.sqrt(np.diag(step.estimate.covariance)))
        run.features.append(step.estimate.n_features)
        run.local.append(step.estimate.n_local_features)
        run.matched.append(step.estimate.matched_lines)
        if watch is not None:
            watch(k, sample, run.pipeline, step)
    assert run is not None, 'a drive has at least one scan'
    return run


Range = tuple[float, float]  # lowest and highest of some runs; twice the same of one
INTEL = 'intel'  # 5,438 scans
COMPLETE = ('intel_raw', 'aces_raw', 'csail_raw')


class Origin(Enum):
    """Where a figure comes from."""

    TEAM = 'run by the team outside this repository'
    PUBLISHED = 'published'


@dataclass(frozen=True)
class PeerRun:
    """Mean errors of a program on a log, m, live and after all corrections; None: not recorded.

    cpu_ms: CPU time per scan; peak_mb: resident memory; note: what distinguishes the run.
    """

    system: str
    log: str
    origin: Origin
    live_m: Range | None
    final_m: Range | None
    cpu_ms: float | None = None
    peak_mb: float | None = None
    note: str = ''


def _team(
    system: str,
    log: str,
    live_m: Range | None,
    final_m: Range | None,
    costs: tuple[float | None, float | None] = (None, None),
    note: str = '',
) -> PeerRun:
    return PeerRun(system, log, Origin.TEAM, live_m, final_m, *costs, note)


def _published(system: str, log: str, final_m: float, note: str = '') -> PeerRun:
    final = (final_m, final_m)
    return PeerRun(system, log, Origin.PUBLISHED, None, final, note=note)


LAMA = 'IRIS LaMa slam2d'
CARTOGRAPHER = 'Cartographer 2D'
_HESS = 'Hess et al., ICRA 2016, Table II'
_KUEMMERLE = 'Kümmerle et al., Autonomous Robots 27, 2009'

# LaMa closes no loops. Of all but its first build, one error is recorded for a log: it is listed
# as live.
PEERS = (
    _team(LAMA, INTEL, (0.036, 0.036), (0.033, 0.033), (0.17, 13.0), 'first build'),
    _team(LAMA, INTEL, (0.047, 0.047), None, note='second build'),
    _team(LAMA, INTEL, (0.063, 0.063), None, note='third build'),
    _team('Karto', INTEL, (0.073, 0.073), (0.038, 0.038), (12.3, 73.0)),
    _team('GMapping', INTEL, (0.104, 0.113), (0.046, 0.046), (8.7, 110.0)),
    _team('slam_toolbox', INTEL, (0.113, 0.113), (0.056, 0.056), (1.17, 45.0)),
    _team(CARTOGRAPHER, INTEL, (1.55, 1.55), (0.081, 0.081), (34.0, 257.0)),
    _team('line-feature EKF-SLAM', INTEL, (1.87, 1.87), (1.87, 1.87), (30.0, 79.0)),
    _team(LAMA, 'intel_raw', (1.57, 3.3), None, note='3.3 with small steps'),
    _team(LAMA, 'aces_raw', (0.64, 0.95), None),
    _team(LAMA, 'csail_raw', (0.27, 2.2), None),
    _team(LAMA, 'aces', (0.046, 0.046), None),
    _team(LAMA, 'csail', (1.09, 1.09), None),
    _team(LAMA, 'fhw', (0.75, 0.75), None),
    _published(CARTOGRAPHER, 'intel_raw', 0.0229, _HESS),
    _published(CARTOGRAPHER, 'aces_raw', 0.0375, _HESS),
    _published(CARTOGRAPHER, 'csail_raw', 0.0319, _HESS),
    _published('graph mapping', 'intel_raw', 0.031, _HESS),
    _published('graph mapping', 'aces_raw', 0.044, _HESS),
    _published('graph mapping', 'csail_raw', 0.004, _HESS),
    _published('scan matching', 'intel_raw', 0.220, _KUEMMERLE),
    _published('RBPF', 'intel_raw', 0.070, _KUEMMERLE),
)


def runs(log: str) -> list[PeerRun]:
    """Recorded runs of a log, in the order of the list."""
    return [run for run in PEERS if run.log == log]


def shown(metres: Range | None) -> str:
    """An error as text, with the digits that are recorded: `0.036`, `0.104 to 0.113`, or empty."""
    if metres is None:
        return ''
    low, high = metres
    return f'{low:g}' if low == high else f'{low:g} to {high:g}'
