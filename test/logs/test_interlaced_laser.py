"""An interlaced laser: FLASER lines of 181 and 180 beams, shifted by parts of a degree."""

from pathlib import Path

import numpy as np
import pytest
from support.slam_room import ROOM, drive, mixed, ranges_in

from thinmap_ros.core import se2
from thinmap_ros.core.config import with_values
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.logs.log import LaserOptions, ScanEvent
from thinmap_ros.logs.readers.bag import BagLog
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.pipeline import PipelineConfig
from thinmap_ros.replaying import replay
from thinmap_ros.tools.carmen_to_bag import convert

STRAIGHT = [(180, 0.0)]
INTERLACED = [(181, 0.0), (180, 0.25), (180, 0.5), (180, 0.75)]
START = np.array([2.0, 2.0, 0.0])
CONFIG = with_values(PipelineConfig(), {'localizer.initial_x_m': 2.0, 'localizer.initial_y_m': 2.0})


def written(path: Path, fans: list[tuple[int, float]], seed: int, steps: int) -> np.ndarray:
    """True poses (N, 3) of a drive written as a log; fans: beams, and shift in degrees, in turn."""
    rng = np.random.default_rng(seed)
    lines = []
    truth = []
    for k, (T_world_base, T_odom_base) in enumerate(drive(steps, rng, START)):
        count, shift = fans[k % len(fans)]
        angles = np.radians(np.arange(count) - 90.0 + shift)
        ranges = mixed(ranges_in(ROOM, T_world_base, angles), rng) + rng.normal(0.0, 0.01, count)
        readings = ' '.join(f'{r:.2f}' for r in ranges)
        pose = ' '.join(f'{v:.6f}' for v in T_odom_base)
        stamp = f'{100.0 + 0.2 * k:.3f}'
        lines.append(f'FLASER {count} {readings} {pose} {pose} {stamp} robot {stamp}\n')
        truth.append(T_world_base)
    path.write_text(''.join(lines))
    return np.array(truth)


def localized(path: Path) -> list[np.ndarray]:
    """Pose (3,) at each scan of a log."""
    localizer = Localizer(CONFIG.localizer)
    poses = []
    T_odom_base = np.zeros(3)
    for event in CarmenLog(path).events():
        if isinstance(event, ScanEvent):
            poses.append(localizer.step(event.scan, T_odom_base).T_map_base)
        else:
            T_odom_base = event.T_odom_base
    return poses


def errors(path: Path, fans: list[tuple[int, float]]) -> np.ndarray:
    """Root mean square errors (2,) of position (m) and heading (rad), the mean of three drives."""
    found = []
    for seed in range(3):
        truth = written(path, fans, seed, 200)
        off = np.array([se2.between(*pair) for pair in zip(truth, localized(path), strict=True)])
        found.append(np.sqrt([(off[:, :2] ** 2).sum(axis=1).mean(), (off[:, 2] ** 2).mean()]))
    return np.mean(found, axis=0)


def test_it_is_localized_as_well_as_a_laser_with_one_scan(tmp_path: Path) -> None:
    straight = errors(tmp_path / 'straight.clf', STRAIGHT)
    interlaced = errors(tmp_path / 'interlaced.clf', INTERLACED)
    assert (interlaced <= 1.1 * straight).all(), (interlaced, straight)


def test_the_smaller_count_is_centred_only_beside_the_greater(tmp_path: Path) -> None:
    def fans(turn: list[tuple[int, float]], **options: float) -> set[tuple[float, ...]]:
        path = tmp_path / 'log.clf'
        written(path, turn, 0, 8)
        scans = [
            e.scan
            for e in CarmenLog(path, LaserOptions(**options)).events()
            if isinstance(e, ScanEvent)
        ]
        ends = [np.degrees(scan.angles_rad[[0, -1]]).round(4).tolist() for scan in scans]
        return {tuple(pair) for pair in ends}

    assert fans(INTERLACED) == {(-90.0, 90.0), (-89.5, 89.5)}
    assert fans(STRAIGHT) == {(-90.0, 89.0)}
    assert fans(INTERLACED[:1]) == {(-90.0, 90.0)}
    assert fans([(361, 0.0), (180, 0.0)]) == {(-90.0, 90.0), (-90.0, 89.0)}
    given = fans(INTERLACED, start_angle_deg=-45.0, step_deg=0.5)
    assert given == {(-45.0, 45.0), (-44.75, 44.75)}


def test_a_bag_made_of_its_log_gives_the_same_path(tmp_path: Path) -> None:
    written(tmp_path / 'log.clf', INTERLACED, 0, 40)
    log = CarmenLog(tmp_path / 'log.clf')
    convert(log, tmp_path / 'bag')
    by_log = replay(log, CONFIG)
    by_bag = replay(BagLog(tmp_path / 'bag'), CONFIG)
    assert not by_log.warnings and not by_bag.warnings
    assert np.array(by_bag.poses) == pytest.approx(np.array(by_log.poses), abs=1e-6)
