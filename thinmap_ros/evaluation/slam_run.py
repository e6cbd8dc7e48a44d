"""Runs a drive through localizer, grid and topology, and computes its errors."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
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
        return float(np.hypot(*np.diff(np.array(self.truth)[:, :2], axis=0).T).sum())


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
