"""A merged session goes on living: it is continued, corrected, joined and merged again."""

import signal
from dataclasses import dataclass

import numpy as np
import pytest
from support.carried_robot import carried
from support.driven_pieces import driven_piece

from thinmap_ros.core import se2
from thinmap_ros.core.grid.edits import Erasures, MapEdits
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.slam.graph.keyframes import SavedKeyframes
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.files import sessions
from thinmap_ros.files.merging import merge_maps
from thinmap_ros.files.sessions import EXPLORATION, GRID, KEYFRAMES, LOCALIZER, PARTS, TOPOLOGY
from thinmap_ros.pipeline import Pipeline, PipelineConfig

DRIFT = 0.012
ALL = ('.grid.npz', '.keyframes.npz', '.pgm', '.regions.npz', '.slam.npz', '.topology.npz', '.yaml')


@dataclass(frozen=True, eq=False)
class Drive:
    """A saved session, and the true poses (N, 3) of its keyframes."""

    stem: str
    truths: np.ndarray

    @staticmethod
    def of(stem, frames, truths):
        """Of those of some keyframes that were saved, given the truths of all."""
        pairs = zip(frames, truths, strict=True)
        known = {frame.T_map_base.tobytes(): truth for frame, truth in pairs}
        return Drive(stem, np.array([known[T.tobytes()] for T in poses_of(stem)]))

    @property
    def T_world_map(self):  # noqa: N802
        return se2.compose(self.truths[0], se2.invert(poses_of(self.stem)[0]))


def poses_of(stem):
    return np.array([frame.T_map_base for frame in KEYFRAMES.load(stem).frames])


def map_drive(stem, number):
    """Map a drive of 60 m, and save it."""
    pipeline = Pipeline(PipelineConfig(grid=PAPER_GRID, scans_per_graph=20))
    truths = {}
    for moment in carried((9, number, 60.0)):
        pipeline.step(moment.scan, moment.T_odom_base)
        truths[moment.scan.stamp_ns] = moment.T_world_base
    pipeline.save_session(stem)
    frames = pipeline.localizer.keyframes
    return Drive.of(str(stem), frames, [truths[frame.scan.stamp_ns] for frame in frames])


def errors_of(poses, truths):
    """Distances (N,), m, from where they truly are, both relative to the first pose."""
    off = [se2.between(poses[0], T) for T in poses], [se2.between(truths[0], T) for T in truths]
    return np.hypot(*(np.array(off[0]) - np.array(off[1]))[:, :2].T)


@pytest.fixture(scope='module')
def days(tmp_path_factory):
    """Two sessions of a building from starts of their own, and both as one."""
    folder = tmp_path_factory.mktemp('days')
    drives = [map_drive(folder / f'day{number}', number) for number in (0, 1)]
    merged = merge_maps([drive.stem for drive in drives])
    merged.save(str(folder / 'both'))
    return (*drives, str(folder / 'both'))


def test_the_graph_has_the_keyframes_and_edges_of_both_where_they_are(days):
    first, second, _ = days
    before = [KEYFRAMES.load(drive.stem) for drive in (first, second)]
    piece = merge_maps([first.stem, second.stem]).piece
    after = SavedKeyframes.of_graph(piece.frames, piece.edges)
    poses = np.array([frame.T_map_base for frame in after.frames])
    count = len(before[0].frames)
    assert len(after.frames) == count + len(before[1].frames)
    assert len(after.steps) + len(after.edges) > sum(
        len(each.steps) + len(each.edges) for each in before
    )
    links = [edge for edge in after.edges if edge.a < count <= edge.b]
    assert len(links) > 10
    assert errors_of(poses, np.vstack([first.truths, second.truths])).max() < 0.1
    # The second map has its covariances relative to its own start, where they are zero.
    start = np.trace(before[1].frames[0].covariance[:2, :2])
    variances = np.array([np.trace(frame.covariance[:2, :2]) for frame in after.frames])
    assert variances[count] > 10.0 * start and variances.max() < 1.0
    off_m = errors_of(poses, np.vstack([first.truths, second.truths]))
    assert np.mean(off_m[1:] ** 2 < 9.0 * variances[1:] + 0.01**2) > 0.95
    # A path and submaps of their own, as those of a robot that has driven both.
    assert min(f.path_m for f in after.frames[count:]) >= before[0].frames[-1].path_m
    assert after.frames[0].submap != after.frames[count].submap


def test_a_merged_session_has_the_keyframes_that_no_other_show_as_well(days):
    first, second, both = days
    after = KEYFRAMES.load(both)
    longest = max(len(drive.truths) for drive in (first, second))
    assert longest < len(after.frames) < len(first.truths) + len(second.truths)
    assert len(sessions.load_scans(both)) == len(after.frames)


def save_drifted(stem, number):
    """A session of keyframes that dead reckoning has placed, with its truth."""
    driven = driven_piece(9, number, 60.0, DRIFT)
    patch = driven.piece.patch
    sessions.save_grid(stem, OccupancyGrid.from_patch(patch))
    TOPOLOGY.save(stem, TopologyBuilder.continued(patch, driven.piece.graph, 5000))
    KEYFRAMES.save(stem, SavedKeyframes(list(driven.piece.keyframes), driven.edges, []))
    true = [f.T_map_base - (0.0, DRIFT * f.path_m, 0.0) for f in driven.piece.keyframes]
    return Drive(stem, np.array([se2.compose(driven.T_world_piece, T) for T in true]))


@pytest.fixture(scope='module')
def drifted(tmp_path_factory):
    """Two sessions that have drifted, as one, and its true poses (N, 3)."""
    folder = tmp_path_factory.mktemp('drifted')
    one, two = (save_drifted(str(folder / f'day{number}'), number) for number in (0, 1))
    both = str(folder / 'both')
    merged = merge_maps([one.stem, two.stem])
    merged.save(both)
    return Drive.of(both, merged.piece.frames, [*one.truths, *two.truths])


@pytest.mark.cpu_budget(25.0, 'a robot drives until it recognizes its place')
def test_a_robot_that_starts_anywhere_joins_the_merged_map_and_corrects_it(drifted):
    localizer = sessions.load_localizer(drifted.stem, LocalizerConfig())
    before = poses_of(drifted.stem)
    found = []
    for moment in list(carried((9, 5, 38.0)))[::2]:
        estimate = localizer.step(moment.scan, moment.T_odom_base)
        T_world_base = se2.compose(drifted.T_world_map, estimate.T_map_base)
        found.append((estimate, np.hypot(*(T_world_base - moment.T_world_base)[:2])))
    assert any(estimate.is_mapping_apart for estimate, _ in found)
    last, off_m = found[-1]
    assert not last.is_lost and last.apart is None and off_m < 0.15
    after = np.array([frame.T_map_base for frame in localizer.keyframes[: len(before)]])
    before_m = errors_of(before, drifted.truths).max()
    assert before_m > 0.12, 'without drift there is nothing to correct'
    assert errors_of(after, drifted.truths).max() < 0.85 * before_m
    assert len(localizer.saved_keyframes().frames) > len(before)


def test_a_merged_session_is_merged_again(days, tmp_path):
    _, _, both = days
    third = map_drive(tmp_path / 'day3', 3)
    merged = merge_maps([both, third.stem])
    merged.save(str(tmp_path / 'all'))
    count = len(KEYFRAMES.load(both).frames)
    assert len(merged.piece.frames) == count + len(third.truths)
    assert count < len(KEYFRAMES.load(str(tmp_path / 'all')).frames) < len(merged.piece.frames)
    assert sessions.load_localizer(str(tmp_path / 'all'), LocalizerConfig()) is not None


def test_the_cells_are_those_of_the_first_session(days, tmp_path):
    first, second, _ = days
    config = LocalizerConfig(local_map=LocalMapConfig(resolution_m=0.1))
    stems = []
    for drive in (first, second):
        stem = str(tmp_path / drive.stem[-4:])
        sessions.copy_map(drive.stem, stem)
        coarse = Localizer.from_keyframes(KEYFRAMES.load(stem), Localizer().calibration, config)
        sessions.save_localizer(stem, coarse)
        stems.append(stem)
    merge_maps(stems).save(str(tmp_path / 'both'))
    assert sessions.load_localizer(str(tmp_path / 'both'), config) is not None


def test_a_copy_has_all_files_and_none_of_another_session(days, tmp_path):
    _, _, both = days
    to = str(tmp_path / 'copy')
    erasures = Erasures()
    erasures.add(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), 5)
    sessions.save_grid(both, GRID.load(both), edits=MapEdits(erasures=erasures))
    EXPLORATION.file(to).write_bytes(LOCALIZER.file(both).read_bytes())
    lines = sessions.copy_map(both, to)
    assert any('renamed' in line for line in lines)
    assert {ending for ending in ALL if (tmp_path / f'copy{ending}').exists()} == set(ALL)
    for part in PARTS:
        if part is not EXPLORATION and part is not GRID:
            assert part.file(to).read_bytes() == part.file(both).read_bytes()
    assert 'copy.pgm' in (tmp_path / 'copy.yaml').read_text()
    assert len(sessions.load_edits(to).erasures) == 1
    assert sessions.load_localizer(to, LocalizerConfig()) is not None


def test_ctrl_c_leaves_all_files_or_none(days, tmp_path):
    first, second, _ = days
    merged = merge_maps([first.stem, second.stem])

    class Interrupted(OccupancyGrid):
        """A grid whose saving is interrupted: other files have been written before."""

        def state(self):
            signal.raise_signal(signal.SIGINT)
            return super().state()

    merged.grid.__class__ = Interrupted
    with pytest.raises(KeyboardInterrupt):
        merged.save(str(tmp_path / 'both'))
    assert sorted(path.name for path in tmp_path.iterdir()) == [f'both{end}' for end in ALL]
