"""A robot's own log as two: a map of the first half, and drives of the second."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from benchmarks.kidnapped.trials import Map, Record, fresh, prepared, search
from thinmap_ros.core import se2
from thinmap_ros.core.places.global_localizer import GlobalLocalization
from thinmap_ros.core.places.likelihood import Judge
from thinmap_ros.core.places.place_database import calibrate, observe
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.evaluation.trajectory_errors import between_paths
from thinmap_ros.logs.log import OdometryEvent
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.pipeline import Pipeline
from thinmap_ros.sim.drives import DriveSample

SCANS = 60
_STARTS = 100
_RIGHT_M = 0.5
_EVERY = 10  # scan that is looked at to tell whether a place is in the map
# Shares of the beams
_SHOWN = 0.7
_AGREES = 0.8


@dataclass(frozen=True, eq=False)
class _Halves:
    """Looks of the whole log with poses in the frame of the map of the first half, and that map."""

    samples: list[DriveSample]
    half: int
    known: Map


def first_half(log: Path) -> Map:
    """The map of the first half of a log."""
    return _halves(log).known


def samples_from(log: Path, seed: int) -> Iterator[DriveSample]:
    """Looks of a log from a random one of its first three quarters on."""
    samples = _halves(log).samples
    yield from samples[int(np.random.default_rng(seed).integers(3 * len(samples) // 4)) :]


def in_second_half(log: Path, number: int) -> Record:
    """A robot switched on at one of 100 stamps of the second half, with the map of the first."""
    halves = _halves(log)
    begin = int(np.linspace(halves.half, len(halves.samples) - SCANS - 1, _STARTS)[number])
    samples = halves.samples[begin : begin + SCANS]
    shown, agrees = _in_map(_finder(log), samples)
    record = search(fresh(_finder(log)), samples, steps=SCANS, right_m=_RIGHT_M)
    return record | {'shown': round(shown, 3), 'agrees': round(agrees, 3)}


@lru_cache(maxsize=1)
def _finder(log: Path) -> GlobalLocalization:
    return prepared(_halves(log).known, _halves(log).samples[0], seed=1)


def _in_map(finder: GlobalLocalization, samples: list[DriveSample]) -> tuple[float, float]:
    """Of how many beams the map tells, from true poses, and with how many of these it agrees."""
    asked = 0.0
    agreed = 0.0
    beams = 0
    model = calibrate(finder.places, samples[0].scan, finder.config, np.random.default_rng(0))
    judge = Judge(finder.places, finder.config, model)
    for sample in samples[: SCANS // 2 : _EVERY // 2]:
        seen = observe(sample.scan, finder.places.frame.resolution, finder.config)
        counts, silent = judge.explained(judge.refined(sample.T_world_base[None], seen), seen)
        beams += len(seen.ranges_m)
        asked += len(seen.ranges_m) - float(silent[0])
        agreed += float(counts[0])
    return asked / beams, agreed / max(asked, 1.0)


def is_in_map(record: dict[str, str]) -> bool:
    """Whether the map shows the place where a robot was switched on, as it was then."""
    return float(record['shown']) >= _SHOWN and float(record['agrees']) >= _AGREES


@lru_cache(maxsize=1)
def _halves(log: Path) -> _Halves:
    pairs = _pairs(log)
    half = len(pairs) // 2
    pipeline = Pipeline()
    for scan, T_odom_base in pairs[:half]:
        pipeline.step(scan, T_odom_base)
    known = Map(pipeline.grid.known_area(), copy.deepcopy(pipeline.topology.map))
    first = pipeline.localizer.optimized_trajectory()
    for scan, T_odom_base in pairs[half:]:
        pipeline.step(scan, T_odom_base)
    whole = pipeline.localizer.optimized_trajectory()
    T_first_whole = between_paths(whole[:half], first)
    poses = [se2.compose(T_first_whole, T) for T in whole]
    return _Halves(
        [DriveSample(*pair, T) for pair, T in zip(pairs, poses, strict=True)], half, known
    )


def _pairs(log: Path) -> list[tuple[Scan, Array]]:
    """Scans with their odometry poses."""
    pairing = ScanOdometrySynchronizer()
    pairs = []
    for event in CarmenLog(log).events():
        if isinstance(event, OdometryEvent):
            pairs += pairing.add_odometry(event.stamp_ns, event.T_odom_base)
        else:
            pairs += pairing.add_scan(event.scan)
    return pairs
