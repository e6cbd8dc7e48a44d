"""Two drives through one building: their sessions are merged, or the second continues the first."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from support.slam_room import drive_round_the_block

from thinmap_ros.core import se2
from thinmap_ros.core.grid.edits import KeepOut
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import LOCALIZATION, config_at
from thinmap_ros.experiments.drives import Source
from thinmap_ros.files import sessions
from thinmap_ros.files.merging import merge_maps
from thinmap_ros.files.sessions import KEYFRAMES, LOCALIZER
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.drives import DriveSample

OF_LOCALIZER = (LOCALIZER, KEYFRAMES)

EVERY = 6  # scans of a drive that are used


def drive_of(seed: int, first: int, end: int) -> list[DriveSample]:
    return list(islice(Source(seed).samples('floor_40x10'), first, end, EVERY))


@pytest.fixture(scope='module')
def first_day() -> list[DriveSample]:
    return drive_of(0, 0, 1200)


@pytest.fixture(scope='module')
def second_day() -> list[DriveSample]:
    """Starts elsewhere, and continues to where the first day did not come."""
    return drive_of(7, 150, 1400)


def mapped(pipeline: Pipeline, samples: list[DriveSample]) -> Array:
    """Poses (N, 3) of a drive that a pipeline maps, after all corrections."""
    for sample in samples:
        pipeline.step(sample.scan, sample.T_odom_base)
    pipeline.finish()
    return pipeline.localizer.optimized_trajectory()


def true_poses(first: DriveSample, samples: list[DriveSample]) -> Array:
    """True poses (N, 3) of samples in the map that begins with the first one."""
    return np.array([se2.between(first.T_world_base, each.T_world_base) for each in samples])


def errors_m(poses: Array, truths: Array) -> Array:
    return np.asarray(np.hypot(*(poses - truths)[:, :2].T))


@pytest.fixture(scope='module')
def session(tmp_path_factory: pytest.TempPathFactory, first_day: list[DriveSample]) -> Path:
    pipeline = Pipeline()
    mapped(pipeline, first_day)
    stem = tmp_path_factory.mktemp('days') / 'first'
    pipeline.save_session(stem)
    return stem


def test_sessions_of_two_days_are_merged(
    session: Path, tmp_path: Path, first_day: list[DriveSample], second_day: list[DriveSample]
) -> None:
    pipeline = Pipeline()
    mapped(pipeline, second_day)
    pipeline.save_session(tmp_path / 'second')
    merged = merge_maps([session, tmp_path / 'second'])
    (joined,) = merged.joins
    truth = true_poses(first_day[0], second_day[:1])[0]
    x, y, yaw = (joined.T_merged_map - truth).tolist()
    assert np.hypot(x, y) < 0.12 and abs(se2.wrap(yaw)) < 0.01
    earlier = {part: part.file(str(tmp_path / 'second')).read_bytes() for part in OF_LOCALIZER}
    merged.save(str(tmp_path / 'second'))
    for part, content in earlier.items():  # they are of the merged map now
        assert part.file(str(tmp_path / 'second')).read_bytes() != content
    poses = {frame.T_map_base.tobytes() for frame in merged.piece.frames}
    saved = KEYFRAMES.load(str(tmp_path / 'second')).frames
    assert {frame.T_map_base.tobytes() for frame in saved} <= poses


def test_the_same_way_again_does_not_double_the_walls(
    session: Path, first_day: list[DriveSample]
) -> None:
    again = drive_of(7, 0, 1200)
    pipeline = Pipeline()
    pipeline.load_session(session)
    before = pipeline.grid.known_area().occupied.sum()
    poses = mapped(pipeline, again)
    assert errors_m(poses, true_poses(first_day[0], again)).max() < 0.12
    assert pipeline.grid.known_area().occupied.sum() < 1.1 * before


def test_a_given_start_elsewhere_continues_at_once(
    session: Path, first_day: list[DriveSample], second_day: list[DriveSample]
) -> None:
    truths = true_poses(first_day[0], second_day)
    start = config_at(LocalizerConfig(), truths[0] + [0.1, 0.1, 0.05])
    pipeline = Pipeline(PipelineConfig(localizer=start))
    pipeline.load_session(session)
    free = pipeline.grid.known_area().free.sum()
    nodes = pipeline.topology.map.nodes.keys()
    poses = mapped(pipeline, second_day)
    assert errors_m(poses, truths)[2:].max() < 0.12
    assert pipeline.grid.known_area().free.sum() > 1.2 * free
    assert len(nodes & pipeline.topology.map.nodes.keys()) > len(nodes) / 2


def test_in_mode_localization_the_map_stays(
    session: Path, first_day: list[DriveSample], second_day: list[DriveSample]
) -> None:
    truths = true_poses(first_day[0], second_day[:60])
    start = config_at(LocalizerConfig(mode=LOCALIZATION), truths[0])
    pipeline = Pipeline(PipelineConfig(localizer=start))
    pipeline.load_session(session)
    before = pipeline.grid.known_area()
    poses = mapped(pipeline, second_day[:60])
    assert errors_m(poses, truths).max() < 0.12
    after = pipeline.grid.known_area()
    assert after.frame == before.frame and np.array_equal(after.cells, before.cells)


def test_keep_out_areas_and_names_of_a_session_stay(
    session: Path, tmp_path: Path, first_day: list[DriveSample]
) -> None:
    edits = sessions.load_edits(str(session))
    corners = np.array([[1.0, -0.5], [2.0, -0.5], [2.0, 0.5]])
    edits = replace(edits, keep_out=KeepOut().with_area(corners, is_wall=False))
    known = Pipeline()
    known.load_session(session)
    regions = known._regions
    found = regions.update(known.grid.known_area())
    some = next(iter(found.regions.values()))
    regions.names.put(found, some.id, np.array([some.x, some.y]), 'kitchen')
    parts = (known.grid, known.topology, regions, edits, known.localizer)
    sessions.save_session(str(tmp_path / 'named'), sessions.SessionMap(*parts))
    again = Pipeline()
    again.load_session(tmp_path / 'named')
    mapped(again, first_day[:20])
    again.save_session(tmp_path / 'again')
    (area,) = sessions.load_edits(str(tmp_path / 'again')).keep_out.areas
    assert np.allclose(area.corners, corners)
    kept = sessions.REGIONS.load(str(tmp_path / 'again'))
    named = kept.names.named(kept.update(again.grid.known_area())).regions
    assert named[some.id].name == 'kitchen'


def test_a_session_that_is_saved_after_a_loop_closure_has_all_of_the_local_map(
    tmp_path: Path,
) -> None:
    """The local map is rendered again in slices, which a log that ends does not wait for."""
    localizer = Localizer(LocalizerConfig(initial_x_m=3.0, initial_y_m=1.2))
    for scan, T_odom_base, _ in drive_round_the_block():
        if localizer.step(scan, T_odom_base).correction is not None:
            break
    unfinished = localizer.state()['hits'].sum()
    sessions.save_localizer(str(tmp_path / 'loop'), localizer)
    saved = LOCALIZER.load(str(tmp_path / 'loop')).state()['hits'].sum()
    assert saved > 1.1 * unfinished
    rendered = Localizer.from_keyframes(
        KEYFRAMES.load(str(tmp_path / 'loop')), localizer.calibration
    )
    rendered.complete_map()
    assert saved == pytest.approx(rendered.state()['hits'].sum(), rel=0.1)
