"""What a pipeline makes of a drive, scan by scan, and the numbers that sum it up."""

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.time_and_memory import resident_mb
from thinmap_ros import kernels
from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.trajectory_errors import aligned_rms
from thinmap_ros.pipeline import Pipeline, PipelineConfig, PipelineResult

Numbers = dict[str, Any]
_STANDS_M = 0.01
_STANDS_RAD = math.radians(0.5)
_CHI2_95 = 5.991  # of two degrees of freedom
_WRONG_M = 0.5


@dataclass(eq=False)
class Played:
    """What a pipeline made of a drive: (N,) and (N, 3) by scan.

    step_ms: localizer and grid, corrections included; stall_ms: the same, and the graph where it is
    rebuilt after a correction.
    """

    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    lost: list[bool] = field(default_factory=list)
    localizer_ms: list[float] = field(default_factory=list)
    step_ms: list[float] = field(default_factory=list)
    stall_ms: list[float] = field(default_factory=list)
    final: Array = field(default_factory=lambda: np.zeros((0, 3)))
    before_mb: float = 0.0
    peak_mb: float = 0.0

    def numbers(self) -> Numbers:
        """What every case is judged by; times of the processor."""
        taken = np.array(self.localizer_ms)
        return {
            'scans': len(self.poses),
            'unmapped': self._unmapped(),
            'ms_median': float(np.median(taken)),
            'ms_mean': float(taken.mean()),
            'ms_99': float(np.percentile(taken, 99.0)),
            'step_ms': max(self.step_ms),
            'stall_ms': max(self.stall_ms),
            'mb': self.peak_mb,
            'mb_more': self.peak_mb - self.before_mb,
        }

    def _unmapped(self) -> float:
        """Share of scans, standing ones aside, whose pose is in no map that is being extended."""
        moves = [True]
        for before, after in pairwise(self.poses):
            x, y, turn = se2.between(before, after)
            moves.append(math.hypot(x, y) > _STANDS_M or abs(turn) > _STANDS_RAD)
        moving = np.array(moves)
        return float(np.array(self.lost)[moving].mean())


class PlayedPipeline(Pipeline):
    """A pipeline that keeps what came of each scan."""

    def __init__(self, config: PipelineConfig) -> None:
        super().__init__(config)
        self.played = Played(before_mb=resident_mb())

    def step(self, scan: Scan, T_odom_base: Array) -> PipelineResult:
        """Add a scan with the odometry pose (3,) at its stamp, and keep the result."""
        stages = self.stage_seconds
        rebuilds = len(stages.get('rebuild', []))
        step = super().step(scan, T_odom_base)
        _ = self.topology  # made for each scan, as an explorer asks for it
        rebuild_s = sum(stages.get('rebuild', [])[rebuilds:])
        localizer_s = stages['localizer'][-1]
        step_s = localizer_s + stages['grid'][-1]
        played = self.played
        played.localizer_ms.append(1e3 * localizer_s)
        played.step_ms.append(1e3 * step_s)
        played.stall_ms.append(1e3 * (step_s + rebuild_s))
        played.stamps_ns.append(scan.stamp_ns)
        played.poses.append(step.estimate.T_map_base)
        played.covariances.append(step.estimate.covariance)
        played.lost.append(step.estimate.is_lost)
        return step


def rehearse() -> None:
    """Load the compiled kernels before anything is timed."""
    kernels.localizer()
    kernels.grid_mapper()
    kernels.topology_builder()


def simulated_numbers(played: Played, truth: Array) -> Numbers:
    """Numbers of a drive whose true poses (N, 3), map frame, are known."""
    numbers = played.numbers()
    for name, path in (('live', np.array(played.poses)), ('final', played.final)):
        off = np.hypot(*(path - truth)[:, :2].T)
        numbers[f'{name}_m'] = float(np.sqrt((off**2).mean()))
        numbers[f'{name}_most_m'] = float(off.max())
        numbers[f'{name}_aligned_m'] = aligned_rms(path, truth)
    return numbers | consistency(played, truth)


def consistency(played: Played, truth: Array) -> Numbers:
    """How well the covariance of the position tells the errors of the live poses.

    Normalized estimation error squared of two dimensions, chi-square distributed where it does;
    sigma: root of the mean trace, what the rms error would be; of scans that are not lost: a robot
    that is claims no place.
    """
    errors = (np.array(played.poses) - truth)[:, :2]
    covariances = np.array(played.covariances)[:, :2, :2] + 1e-12 * np.eye(2)
    whitened = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    squared = np.einsum('ni,ni->n', errors, whitened)
    widest = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    metres = np.hypot(*errors.T)
    is_lost = np.array(played.lost)
    known = ~is_lost
    if not known.any():
        known[:] = True
    rms = math.sqrt(float((metres[known] ** 2).mean()))
    sigma = math.sqrt(float(np.trace(covariances[known], axis1=1, axis2=2).mean()))
    return {
        'inside_95': float(((squared < _CHI2_95) | is_lost).mean()),
        'sigma_of_rms': sigma / max(rms, 1e-3),
        'wrong_and_sure': int(((metres > _WRONG_M) & (3.0 * widest < metres) & ~is_lost).sum()),
    }
