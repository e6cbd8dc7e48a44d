"""One case of the scoreboard: the numbers that stand for it."""

import math
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.alignment import aligned_rms
from benchmarks.memory import forget_peak, peak_mb, resident_mb
from benchmarks.scoreboard.cases import EXACT_S, BuildingCase, Case, LogCase
from benchmarks.scoreboard.drives import looks
from benchmarks.timing import CpuTimedPipeline
from thinmap_ros.adapters.carmen import CarmenLog
from thinmap_ros.adapters.events import OdometryEvent
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.odometry import ScanPairing
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import LocalizerConfig
from thinmap_ros.core.slam.scan_localizer import ScanLocalizerConfig
from thinmap_ros.pipeline import CORES, PipelineConfig, Step
from thinmap_ros.tools.experiments.logs import laser_of
from thinmap_ros.tools.experiments.relations import read_columns, relation_errors

Numbers = dict[str, Any]
_STANDS_M = 0.01
_STANDS_RAD = math.radians(0.5)
_KNOWN_AGAIN_M = 30.0  # of way after a slip or a gap, from which on relations over it are judged
_CHI2_95 = 5.991  # of two degrees of freedom
_WRONG_M = 0.5
DISTURBED = (5e-4, 5e-4, 5e-4)  # of odometry between scans, m, m, rad, in runs but the first


@dataclass(eq=False)
class Played:
    """What a pipeline made of a drive: (N,) and (N, 3) by scan."""

    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    lost: list[bool] = field(default_factory=list)
    localizer_ms: list[float] = field(default_factory=list)
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


@dataclass(frozen=True)
class Task:
    """A case, and what it is measured with.

    logs: folder of the logs; degrade: the program that degrades one; folder: for what is degraded;
    options: of the localizer.
    """

    case: Case
    logs: Path
    degrade: Path
    folder: Path
    options: Numbers

    @property
    def name(self) -> str:
        """That of the case."""
        return self.case.name


def measure(task: Task) -> Numbers:
    """Name, options and numbers of a case, and what it took of the processor."""
    began = time.process_time()
    case = task.case
    if isinstance(case, LogCase):
        numbers = _measure_log(case, task)
    else:
        numbers = _measure_building(case, task.options)
    taken = {'cpu_s': time.process_time() - began}
    return {'name': task.name, 'options': task.options, **taken, **numbers}


def _measure_log(case: LogCase, task: Task) -> Numbers:
    own = task.logs / case.log
    if case.version:
        own = _degraded(case, own, task.degrade, task.folder)
    played = _play(_disturbed(_scans(own, case.log), case.run), config_of(task.options))
    numbers = played.numbers()
    times = np.array(played.stamps_ns) / 1e9
    live = np.array(played.poses)
    if not (own / 'relations').exists():
        return numbers | {'path': np.column_stack([times, live]).tolist()}
    for name, path in (('live', live), ('final', played.final)):
        numbers |= _relations(own, times, path, name, case.exact_s)
    return numbers | _over_the_event(own, times, live, case.exact_s)


def _relations(own: Path, times: Array, path: Array, name: str, exact_s: float) -> Numbers:
    """Mean errors of a path (N, 3) by the relations of a log's folder."""
    odometry = own / 'odom.txt'
    errors = relation_errors(times, path, own / 'relations', odometry, exact_s)
    numbers = {
        f'{name}_m': float(errors.metres.mean()),
        f'{name}_deg': float(errors.degrees.mean()),
    }
    if exact_s > EXACT_S:
        carried = relation_errors(times, path, own / 'relations', odometry, EXACT_S)
        numbers[f'exact_{name}_m'] = float(carried.metres.mean())
    again = own / 'relations_again'
    if again.exists() and read_columns(again, [0]).size:
        errors = relation_errors(times, path, again, odometry, exact_s)
        numbers[f'again_{name}_m'] = float(errors.metres.mean())
    return numbers


def _over_the_event(own: Path, times: Array, poses: Array, exact_s: float) -> Numbers:
    """Errors of relations that begin before a slip or a gap and end on known ground after it."""
    for name in ('slip.txt', 'gap.txt'):
        if not (own / name).exists():
            continue
        began, ended = read_columns(own / name, [0, 1])[0]
        wheels = read_columns(own / 'odom.txt', [0, 1, 2])
        after = wheels[wheels[:, 0] > ended]
        way = np.cumsum(np.hypot(*np.diff(after[:, 1:], axis=0).T))
        far = np.flatnonzero(way > _KNOWN_AGAIN_M)
        if not len(far):
            return {}
        again_s = after[far[0] + 1, 0]
        over: list[float] = []
        for file in ('relations', 'relations_again'):
            if not (own / file).exists():
                continue
            ends = read_columns(own / file, [0, 1])
            errors = relation_errors(times, poses, own / file, own / 'odom.txt', exact_s)
            spans = (ends.min(axis=1) < began) & (ends.max(axis=1) > again_s)
            over += errors.metres[spans].tolist()
        return {'over_m': float(np.mean(over)), 'over': len(over)} if over else {}
    return {}


def _degraded(case: LogCase, own: Path, degrade: Path, folder: Path) -> Path:
    """Folder of the degraded log, made where it is not there yet.

    Each run has its own: two that run at once would write into one.
    """
    made = folder / case.name
    if not (made / 'done').exists():
        log = next(own.glob('log.clf*'))
        command = [sys.executable, str(degrade), str(log), str(made), *case.options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise InputError(f'{case.name}: {degrade.name}: {done.stderr.strip()[-200:]}')
        (made / 'done').touch()
    return made


def _scans(own: Path, laser: str) -> Iterator[tuple[Scan, Array]]:
    """Scans with the odometry at their stamps, in the order of the file."""
    pairing = ScanPairing()
    for event in CarmenLog(next(own.glob('log.clf*')), laser_of(own, laser)).events():
        if isinstance(event, OdometryEvent):
            yield from pairing.add_odometry(event.stamp_ns, event.T_odom_base)
        else:
            yield from pairing.add_scan(event.scan)


def _disturbed(pairs: Iterator[tuple[Scan, Array]], run: int) -> Iterator[tuple[Scan, Array]]:
    """Scans with odometry poses (3,) that are disturbed, by the number of the run; 0: they are not.

    By less than any wheels err: what comes out otherwise is the estimate's own instability.
    """
    if run == 0:
        yield from pairs
        return
    rng = np.random.default_rng(run)
    last: Array | None = None
    T_odom_base = np.zeros(3)
    for scan, T in pairs:
        if last is None:
            T_odom_base = T
        else:
            increment = se2.between(last, T) + rng.normal(0.0, DISTURBED)
            T_odom_base = se2.compose(T_odom_base, increment)
        last = T
        yield scan, T_odom_base


def _measure_building(case: BuildingCase, options: Numbers) -> Numbers:
    drive = list(looks(case.seed, case.robot, case.noise))
    truth = np.array([look.T_world_base for look in drive])
    x, y, yaw = truth[0].tolist()
    start = {'start_x_m': x, 'start_y_m': y, 'start_yaw_rad': yaw}
    config = config_of(options | start)
    pairs = ((look.scan, look.T_odom_base) for look in drive)
    played = _play(_disturbed(pairs, case.run), config)
    numbers = played.numbers()
    for name, path in (('live', np.array(played.poses)), ('final', played.final)):
        off = np.hypot(*(path - truth)[:, :2].T)
        numbers[f'{name}_m'] = float(np.sqrt((off**2).mean()))
        numbers[f'{name}_most_m'] = float(off.max())
        numbers[f'{name}_aligned_m'] = aligned_rms(path, truth)
    return numbers | _consistency(played, truth)


def _consistency(played: Played, truth: Array) -> Numbers:
    """How well the covariance of the position tells the errors of the live poses.

    Normalized estimation error squared of two dimensions, chi-square distributed where it does;
    sigma: root of the mean trace, what the rms error would be; of scans that are not lost, as one
    that is has a sigma of hundreds of metres, which a few scans more or less would decide.
    """
    errors = (np.array(played.poses) - truth)[:, :2]
    covariances = np.array(played.covariances)[:, :2, :2] + 1e-12 * np.eye(2)
    whitened = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    squared = np.einsum('ni,ni->n', errors, whitened)
    widest = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    metres = np.hypot(*errors.T)
    known = ~np.array(played.lost)
    if not known.any():
        known[:] = True
    rms = math.sqrt(float((metres[known] ** 2).mean()))
    sigma = math.sqrt(float(np.trace(covariances[known], axis1=1, axis2=2).mean()))
    return {
        'inside_95': float((squared < _CHI2_95).mean()),
        'sigma_of_rms': sigma / max(rms, 1e-3),
        'wrong_and_sure': int(((metres > _WRONG_M) & (3.0 * widest < metres)).sum()),
    }


def config_of(options: Numbers) -> LocalizerConfig | ScanLocalizerConfig:
    """Configuration of the localizer that the option `core` names."""
    own = dict(options)
    return CORES[own.pop('core', 'scan')](**own)


def _play(
    scans: Iterator[tuple[Scan, Array]], config: LocalizerConfig | ScanLocalizerConfig
) -> Played:
    """All scans through localizer, grid and topology."""
    _rehearse(config)
    pipeline = CpuTimedPipeline(PipelineConfig(localizer=config))
    forget_peak()
    played = Played(before_mb=resident_mb())
    for scan, T_odom_base in scans:
        rebuilds = len(pipeline.stage_seconds.get('rebuild', []))
        _keep(played, scan, pipeline.step(scan, T_odom_base))
        stages = pipeline.stage_seconds
        rebuild_s = sum(stages.get('rebuild', [])[rebuilds:])
        played.localizer_ms.append(1e3 * stages['localizer'][-1])
        played.stall_ms.append(1e3 * (stages['localizer'][-1] + stages['grid'][-1] + rebuild_s))
    if not played.poses:
        raise InputError('no scan with odometry around its stamp')
    played.final = pipeline.localizer.corrected_path()
    played.peak_mb = peak_mb()
    return played


def _keep(played: Played, scan: Scan, step: Step) -> None:
    played.stamps_ns.append(scan.stamp_ns)
    played.poses.append(step.estimate.T_map_base)
    played.covariances.append(step.estimate.covariance)
    played.lost.append(step.estimate.lost)


def _rehearse(config: LocalizerConfig | ScanLocalizerConfig) -> None:
    """Load the compiled kernels before anything is timed."""
    from thinmap_ros import warm_up

    is_scan = isinstance(config, ScanLocalizerConfig)
    (warm_up.localizer if is_scan else warm_up.ekf_localizer)()
    warm_up.grid_mapper()
    warm_up.topology_builder()
