"""A loaded session with keyframes is corrected as a map that has never been saved."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from support.laps import driven
from support.slam_room import drive_round_the_block

from thinmap_ros.core.ekf_slam.ekf_localizer import EkfLocalizer
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.correction import CorrectableGrid
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import LOCALIZATION
from thinmap_ros.files import sessions
from thinmap_ros.files.sessions import KEYFRAMES, LOCALIZER, load_localizer, save_localizer

START = LocalizerConfig(initial_x_m=3.0, initial_y_m=1.2)
Step = tuple[Scan, Array, Array]


def run(localizer: Localizer, grid: CorrectableGrid, steps: list[Step]) -> int:
    """Localize and map as the pipeline; returns the number of corrections of the grid."""
    corrections = 0
    for scan, T_odom_base, _ in steps:
        estimate = localizer.step(scan, T_odom_base)
        if estimate.correction is not None:
            corrections += grid.apply_correction(*localizer.keyframe_trajectory(), scan.stamp_ns)
        grid.update(scan, estimate.T_map_base, estimate.destination)
    return corrections


@dataclass(eq=False)
class Half:
    """The first half of a lap, saved; its steps, and those of the second half."""

    stem: str
    localizer: Localizer
    grid: OccupancyGrid
    first: list[Step]
    rest: list[Step]

    def config(
        self, mode: str = LocalizerConfig.mode, T_map_base: Array | None = None
    ) -> LocalizerConfig:
        """At a pose (3,), or at that at which the first half ended."""
        x, y, yaw = (self.localizer.pose if T_map_base is None else T_map_base).tolist()
        return LocalizerConfig(mode=mode, initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)

    def errors(self, localizer: Localizer) -> Array:
        """Distances (N,) of the keyframes of the first half from their true places, m."""
        frames = self.localizer.keyframes
        places = {scan.stamp_ns: truth for scan, _, truth in self.first}
        truths = np.array([places[frame.scan.stamp_ns] for frame in frames])
        poses = np.array([frame.T_map_base for frame in localizer.keyframes[: len(frames)]])
        return np.asarray(np.hypot(*(poses - truths)[:, :2].T))


@pytest.fixture(scope='module')
def half(tmp_path_factory: pytest.TempPathFactory) -> Half:
    steps = list(drive_round_the_block())
    middle = len(steps) // 2
    localizer = Localizer(START)
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    run(localizer, grid, steps[:middle])
    grid.finish()
    stem = str(tmp_path_factory.mktemp('session') / 'block')
    sessions.save_grid(stem, grid.shown)
    save_localizer(stem, localizer)
    return Half(stem, localizer, grid.shown, steps[:middle], steps[middle:])


def wall_cells(grid: OccupancyGrid) -> int:
    return int(np.count_nonzero(grid.known_area().occupied))


def test_a_loop_that_closes_after_loading_corrects_the_loaded_map(half: Half) -> None:
    localizer = load_localizer(half.stem, half.config())
    assert isinstance(localizer, Localizer)
    grid = CorrectableGrid(sessions.load_grid(half.stem), scans=sessions.load_scans(half.stem))
    before = half.errors(localizer)
    assert run(localizer, grid, half.rest[:60]) == 0
    assert np.array_equal(half.errors(localizer), before), 'nothing has closed yet'
    assert run(localizer, grid, half.rest[60:]) > 0
    grid.finish()
    assert before.max() > 0.5, 'without drift there is nothing to correct'
    assert half.errors(localizer).max() < 0.9 * before.max()
    bare = LOCALIZER.load(half.stem, half.config())
    assert isinstance(bare, Localizer)
    uncorrected = CorrectableGrid(sessions.load_grid(half.stem), keeps_scans=False)
    run(bare, uncorrected, half.rest)
    truth = half.rest[-1][2]
    off_m = [math.dist(each.pose[:2], truth[:2]) for each in (localizer, bare)]
    assert off_m[0] < 0.4 < 0.8 < off_m[1]
    # The corridor of before the loop is drawn once.
    assert wall_cells(grid.shown) < wall_cells(uncorrected.shown)


def test_without_keyframes_a_session_is_loaded_as_before_and_stays(half: Half) -> None:
    KEYFRAMES.file(half.stem).rename(KEYFRAMES.file(half.stem).with_suffix('.aside'))
    try:
        assert sessions.load_scans(half.stem) == []
        localizer = load_localizer(half.stem, half.config())
    finally:
        KEYFRAMES.file(half.stem).with_suffix('.aside').rename(KEYFRAMES.file(half.stem))
    assert isinstance(localizer, Localizer) and localizer.keyframes == []
    grid = CorrectableGrid(sessions.load_grid(half.stem), keeps_scans=False)
    assert run(localizer, grid, half.rest[:40]) == 0
    assert localizer.keyframes and localizer.saved_keyframes() is None, 'not of all of the map'


def test_the_map_stays_the_loaded_one_until_a_correction(half: Half) -> None:
    localizer = load_localizer(half.stem, half.config())
    assert isinstance(localizer, Localizer)
    state = half.localizer.state()
    for name, array in localizer.state().items():
        np.testing.assert_array_equal(array, state[name])
    localizer.set_pose(half.localizer.pose, 0.01 * np.eye(3))
    for name, array in localizer.state().items():
        np.testing.assert_array_equal(array, state[name])
    scans = sessions.load_scans(half.stem)
    grid = CorrectableGrid(sessions.load_grid(half.stem), scans=scans)
    grid.update(None, half.localizer.pose)
    assert np.array_equal(grid.shown.known_area().cells, half.grid.known_area().cells)


def test_a_session_that_is_continued_is_saved_with_all_keyframes(
    half: Half, tmp_path: Path
) -> None:
    localizer = load_localizer(half.stem, half.config())
    assert isinstance(localizer, Localizer)
    run(localizer, CorrectableGrid(OccupancyGrid(PAPER_GRID)), half.rest[:60])
    assert save_localizer(str(tmp_path / 'more'), localizer).endswith('.keyframes.npz')
    again = KEYFRAMES.load(str(tmp_path / 'more'))
    assert len(again.frames) == len(localizer.keyframes) > len(half.localizer.keyframes) + 3
    stamps = [frame.scan.stamp_ns for frame in again.frames]
    assert stamps == list(range(1, len(stamps) + 1))
    # The part that was driven later is bound to the part that was loaded.
    assert any(edge.a < len(half.localizer.keyframes) <= edge.b for edge in again.edges)


def test_a_robot_that_starts_elsewhere_is_bound_to_the_keyframes_there(half: Half) -> None:
    """And not to the last one, which it has not come from."""
    there = 20
    frame = half.localizer.keyframes[there]
    localizer = load_localizer(half.stem, half.config(T_map_base=frame.T_map_base))
    assert isinstance(localizer, Localizer)
    steps = [step for step in half.first if step[0].stamp_ns >= frame.scan.stamp_ns]
    later = steps[-1][0].stamp_ns
    again = [(replace(scan, stamp_ns=later + scan.stamp_ns), *rest) for scan, *rest in steps[:80]]
    run(localizer, CorrectableGrid(OccupancyGrid(PAPER_GRID)), again)
    loaded = len(half.localizer.keyframes)
    keyframes = localizer.saved_keyframes()
    assert keyframes is not None
    own = [*keyframes.steps[loaded - 1 :], *(e for e in keyframes.edges if e.b >= loaded)]
    assert own
    for edge in own:
        places = [keyframes.frames[k].T_map_base[:2] for k in (edge.a, edge.b)]
        assert math.dist(*places) < 3.0


def test_a_session_of_many_laps_is_saved_with_the_keyframes_of_the_last(tmp_path: Path) -> None:
    laps = driven(3)
    localizer = Localizer.from_keyframes(laps, Localizer().calibration)
    save_localizer(str(tmp_path / 'laps'), localizer)
    again = KEYFRAMES.load(str(tmp_path / 'laps'))
    assert len(again.frames) < 0.5 * len(laps.frames) == 0.5 * len(localizer.keyframes)
    assert load_localizer(str(tmp_path / 'laps'), START) is not None


def test_localization_reads_no_keyframes(half: Half) -> None:
    localizer = load_localizer(half.stem, half.config(LOCALIZATION))
    assert isinstance(localizer, Localizer)
    assert localizer.keyframes == [] and localizer.saved_keyframes() is None


def test_keyframes_of_another_session_are_archived(half: Half, tmp_path: Path) -> None:
    stem = str(tmp_path / 'block')
    save_localizer(stem, half.localizer)
    message = save_localizer(stem, EkfLocalizer(), overwrite=True)
    assert 'block.keyframes.npz of an earlier session renamed to' in message
    names = sorted(file.name for file in tmp_path.iterdir())
    assert names == ['block.keyframes.npz.old', 'block.slam.npz']


def test_a_damaged_file_is_one_line_and_nothing_is_lost(half: Half, tmp_path: Path) -> None:
    stem = str(tmp_path / 'block')
    sessions.save_grid(stem, half.grid)
    save_localizer(stem, half.localizer)
    whole = KEYFRAMES.file(stem).read_bytes()
    foreign = LOCALIZER.file(stem).read_bytes()
    for content in (b'', whole[:-300], foreign, whole[:400] + bytes(100) + whole[500:]):
        KEYFRAMES.file(stem).write_bytes(content)
        for read in (
            lambda: load_localizer(stem, half.config()),
            lambda: sessions.load_scans(stem),
        ):
            with pytest.raises(InputError) as refused:
                read()
            line = str(refused.value)
            assert line.startswith(f'{stem}.keyframes.npz: ') and '\n' not in line
            assert 'expected a saved keyframes' in line
        assert KEYFRAMES.file(stem).read_bytes() == content
    assert load_localizer(stem, half.config(LOCALIZATION)) is not None


def test_a_file_of_somebody_else_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / 'block.keyframes.npz').write_bytes(b'mine')
    with pytest.raises(InputError, match='was not written by thinmap'):
        sessions.require_own_files(str(tmp_path / 'block'), LOCALIZER)
