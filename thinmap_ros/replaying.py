"""Replays a log or bag through localizer, grid and topology, and writes the results."""

import resource
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.core.scan import Scan, delayed_ns, laser_names
from thinmap_ros.core.se2 import Array, path_length_m
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.segmentation import RegionConfig
from thinmap_ros.kernels import compiler_memory_releaser, release_compiler_pages
from thinmap_ros.logs.log import Log
from thinmap_ros.logs.reading import (
    WAITING_SCANS,
    SilentLasers,
    complete_scans,
    recording_events,
)
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.view.progress_bar import ProgressBar
from thinmap_ros.view.run_folder import RunResult, Trajectory, write_report, write_run

_STAGES = ('localizer', 'grid')  # of every scan
_REPEATED = 0.01  # m and rad: the pose of a scan that was matched twice differs by less


@dataclass(eq=False)
class ScanCounts:
    """Scans that did not change the map, by reason.

    They are without odometry, blind, of a misaligned laser, or of a lost robot.
    apart: those of a lost robot that were mapped apart; they are in the map if it was joined.
    records: unusable records of the log, by reason.
    """

    without_odometry: dict[str, int] = field(default_factory=dict)
    misaligned: int = 0
    lost: int = 0
    apart: int = 0
    records: Counter[str] = field(default_factory=Counter)
    _blind: dict[str, Counter[str]] = field(default_factory=dict)  # by the frame of the laser

    @property
    def blind(self) -> Counter[str]:
        """Number of blind scans by reason."""
        names = laser_names(self._blind.keys())
        counts = ((names[frame], own.items()) for frame, own in self._blind.items())
        return Counter({name + text: count for name, own in counts for text, count in own})

    def add(self, estimate: Estimate, frame: str) -> None:
        """Count the estimate of a scan of the laser of a frame."""
        blind = self._blind.setdefault(frame, Counter())
        if estimate.blind_reason:
            blind[estimate.blind_reason] += 1
        elif estimate.mount_fault:
            self.misaligned += 1
        elif estimate.is_lost:
            self.lost += 1
            self.apart += estimate.is_mapping_apart

    @property
    def unused(self) -> int:
        """Number of scans that did not change the map."""
        return (
            sum(self.without_odometry.values()) + self.blind.total() + self.misaligned + self.lost
        )

    def unpaired(self) -> list[str]:
        """Reasons of the scans without odometry, with their number, the most frequent first."""
        reasons = Counter(self.without_odometry).most_common()
        return [f'{count} scan{"s"[: count > 1]} {text}' for text, count in reasons]

    def unmapped(self) -> list[str]:
        """Reasons of the processed scans that did not change the map, with their number."""
        reasons = [f'{count} blind: {text}' for text, count in self.blind.most_common()]
        others = ((self.misaligned, 'of a misaligned laser'), (self.lost, 'of a lost robot'))
        return reasons + [f'{count} {text}' for count, text in others if count]


@dataclass(eq=False)
class Replay:
    """Result of a replay: the pipeline at the end, and the pose (3,) of every scan.

    frames: of the laser of every scan; delays_s: of the scans of each of them, s.
    counts: of scans that did not change the map. notes: what was assumed of the log, a line each.
    warnings: contradictions within the log, a line each. odometry_jumps: discontinuities of the
    odometry, a line each.
    ended_by: what ended the replay before the end of the log; None if nothing did.
    session, continued: path STEM of the session that was saved, and of the one that was continued;
    '': none.
    """

    pipeline: Pipeline
    stamps_ns: list[int] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)
    delays_s: dict[str, float] = field(default_factory=dict)
    poses: list[Array] = field(default_factory=list)
    local_features: list[int] = field(default_factory=list)
    skipped: int = 0
    first_skipped: str = ''
    counts: ScanCounts = field(default_factory=ScanCounts)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    odometry_jumps: list[str] = field(default_factory=list)
    ended_by: Exception | KeyboardInterrupt | None = None
    session: str = ''
    continued: str = ''

    def measured_ns(self) -> list[int]:
        """Time of the measurement of every scan, ns.

        None is stamped before it: where the odometry is late, the stamp of the scan is right.
        """
        delays_s = {frame: max(delay_s, 0.0) for frame, delay_s in self.delays_s.items()}
        pairs = zip(self.stamps_ns, self.frames, strict=True)
        return [delayed_ns(stamp_ns, delays_s[frame]) for stamp_ns, frame in pairs]


class Watcher(Protocol):
    """Receives the results of the pipeline, scan by scan."""

    def step(self, scan: Scan, T_odom_base: Array, estimate: Estimate, pipeline: Pipeline) -> None:
        """Receive the result of a scan with the odometry pose (3,) at its stamp."""

    def finish(self, ns: int, pipeline: Pipeline) -> None:
        """Receive the end of the log, with the stamp of the last scan."""


def replay(
    log: Log,
    config: PipelineConfig,
    show_progress: bool = False,
    watcher: Watcher | None = None,
    keep_partial: bool = False,
    continued: str = '',
) -> Replay:
    """Replay a log through the pipeline. Raises InputError if it has no scan with odometry.

    keep_partial: an error, or Ctrl-C, after the first scan ends the replay there
    (`Replay.ended_by`) instead of being raised. continued: session in which the replay continues.
    """
    result = Replay(Pipeline(config), continued=continued)
    if continued:
        result.pipeline.load_session(continued)
    pairing = ScanOdometrySynchronizer(WAITING_SCANS)
    lasers = SilentLasers()
    # The records of a sorted log state which odometry belongs to a scan: its stamps have no delay.
    learn = None if log.is_sorted else pairing.add_estimate
    tidy_up = compiler_memory_releaser()
    with _errors_kept(result, keep_partial), ProgressBar('replay', not show_progress) as bar:
        expected = None
        for number, event in enumerate(recording_events(log)):
            lasers.add(event)
            _process(result, complete_scans(pairing, event), watcher, learn)
            tidy_up()
            if show_progress:
                # Of a bag it is known once the bag has been opened.
                expected = log.expected_scans if number == 0 else expected
                _show(bar, len(result.poses), expected)
    with _errors_kept(result, keep_partial):
        _process(result, pairing.finish(), watcher, learn)
        result.pipeline.finish()
        _ = result.pipeline.topology  # made now, for all scans
    result.delays_s = pairing.delays_s
    result.skipped = log.skipped.count + pairing.dropped + pairing.waiting
    result.first_skipped = log.skipped.first
    result.counts.without_odometry = pairing.reasons()
    result.counts.records = log.skipped.reasons
    result.notes = log.skipped.notes
    result.warnings = [*pairing.warnings.values(), *result.pipeline.warnings]
    result.warnings += [*_jump_warnings(result.odometry_jumps), *lasers.warnings()]
    if not result.poses:
        reasons = '; '.join(result.counts.unpaired())
        raise InputError(
            f'no scan with odometry around its stamp; {result.skipped} skipped: {reasons}'
        )
    if watcher is not None:
        with _errors_kept(result, keep_partial):
            watcher.finish(result.stamps_ns[-1], result.pipeline)
    return result


def _jump_warnings(jumps: list[str]) -> list[str]:
    """Warning of the discontinuities of the odometry; none without any."""
    if not jumps:
        return []
    times = f' ({len(jumps)} times; the first time)' if len(jumps) > 1 else ''
    return [f'{jumps[0]}{times}: the pose follows from the scan there']


def _show(bar: ProgressBar, scans: int, expected: int | None) -> None:
    """Show the number of scans, and the expected one; with more than that, it was a bad guess."""
    if expected is None or scans > expected:
        bar.show(None, f'{scans} scans')
    else:
        bar.show(scans / expected, f'{scans} of {expected} scans')


@contextmanager
def _errors_kept(result: Replay, keep_partial: bool) -> Iterator[None]:
    """Keep the first error as `Replay.ended_by`, if there are results to be kept."""
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        if not (keep_partial and result.poses):
            raise
        result.ended_by = result.ended_by or error


def _process(
    result: Replay,
    ready: list[tuple[Scan, Array]],
    watcher: Watcher | None,
    learn: Callable[[Scan, Estimate], None] | None,
) -> None:
    """Process scans with their odometry poses (3,).

    learn: receives each scan with its estimate.
    """
    for scan, T_odom_base in ready:
        step = result.pipeline.step(scan, T_odom_base)
        result.stamps_ns.append(scan.stamp_ns)
        result.frames.append(scan.frame)
        result.poses.append(step.estimate.T_map_base)
        result.local_features.append(step.estimate.n_local_features)
        result.counts.add(step.estimate, scan.frame)
        if learn is not None:
            learn(scan, step.estimate)
        if step.estimate.odometry_discontinuity:
            result.odometry_jumps.append(step.estimate.odometry_discontinuity)
        if watcher is not None:
            watcher.step(scan, T_odom_base, step.estimate, result.pipeline)


def write_outputs(
    result: Replay, folder: Path, title: str, seconds: tuple[float, float], command: str = ''
) -> dict[str, Any]:
    """Write all files into a folder; seconds: wall and CPU time taken. Returns the report."""
    pipeline = result.pipeline
    poses = np.array(result.poses)
    final = np.array(list(pipeline.localizer.optimized_trajectory())[: len(poses)])
    measured_ns = result.measured_ns()
    release_compiler_pages()  # before matplotlib is loaded
    run = RunResult(
        pipeline.grid.known_area(),
        pipeline.topology.map,
        title,
        {
            'trajectory': _in_order(measured_ns, poses),
            'trajectory_final': _in_order(measured_ns, final),
        },
        poses,
        {'apart': pipeline.localizer.apart_points()},
        RegionConfig(robot_radius_m=pipeline.config.topology.robot_radius_m),
    )
    write_run(folder, run)
    report = _report(result, poses, seconds)
    write_report(folder, title, report, command)
    return report


def _in_order(stamps_ns: list[int], poses: Array) -> Trajectory:
    """Stamps and poses (N, 3) in the order of the stamps, and a scan that came twice once.

    Between scans with one stamp a robot may have moved all the same: the clocks of old logs are
    coarse.
    """
    stamps = np.array(stamps_ns, dtype=np.int64)
    order = np.argsort(stamps, kind='stable')
    stamps = stamps[order]
    ordered = poses[order]
    moved = np.abs(np.diff(ordered, axis=0)).max(axis=1, initial=0.0) > _REPEATED
    is_new = np.append(True, (np.diff(stamps) > 0) | moved)
    return stamps[is_new].tolist(), list(ordered[is_new])


def _report(result: Replay, poses: Array, seconds: tuple[float, float]) -> dict[str, Any]:
    seconds_of = result.pipeline.stage_seconds
    graph_s = sum(seconds_of.get('topology', []) + seconds_of.get('rebuild', []))
    # Where an error ended it, the last scan did not pass all stages.
    complete = min(len(seconds_of[name]) for name in _STAGES)
    stages = {name: np.array(seconds_of[name][:complete]) for name in _STAGES}
    refusals = result.pipeline.refusals
    stages['all'] = np.sum(list(stages.values()), axis=0)
    return {
        'scans': len(poses),
        'skipped': result.skipped,
        'first_skipped': result.first_skipped,
        'without_odometry': sum(result.counts.without_odometry.values()),
        'blind': result.counts.blind.total(),
        'misaligned': result.counts.misaligned,
        'lost': result.counts.lost,
        'apart': result.counts.apart,
        'reasons': {
            **result.counts.records,
            **result.counts.without_odometry,
            **result.counts.blind,
        },
        'notes': result.notes,
        'refused': len(refusals),
        'first_refused': refusals[0] if refusals else '',
        'warnings': result.warnings,
        'continued': result.continued,
        'session': result.session,
        'scan_delays_s': {frame: round(s, 3) for frame, s in result.delays_s.items()},
        'odometry_ratios': {
            kind: {'value': round(ratio.value, 4), 'sigma': round(ratio.sigma, 4)}
            for kind, ratio in result.pipeline.odometry_scale.values.items()
        },
        'ended_by': '' if result.ended_by is None else one_line_reason(result.ended_by),
        'wall_s': round(seconds[0], 3),
        'cpu_s': round(seconds[1], 3),
        'peak_mb': round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        'loops_closed': result.pipeline.corrections,
        'graph_ms': round(1000.0 * graph_s, 1),
        'ms_per_scan': {name: _spread(1000.0 * seconds) for name, seconds in stages.items()},
        'cpu_ms_per_scan': round(1000.0 * seconds[1] / len(poses), 2),
        'features': len(result.pipeline.localizer.features),
        'features_local_median': float(np.median(result.local_features)),
        'rejected': result.pipeline.localizer.rejected,
        'distance': round(path_length_m(poses), 3),
        'nodes': len(result.pipeline.topology.map.nodes),
        'edges': len(result.pipeline.topology.map.edges),
    }


def _spread(milliseconds: Array) -> dict[str, float]:
    return {
        'median': round(float(np.median(milliseconds)), 3),
        'p95': round(float(np.percentile(milliseconds, 95)), 3),
        'max': round(float(milliseconds.max()), 3),
    }
