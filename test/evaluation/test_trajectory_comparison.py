"""Errors of trajectories have the numbers that evo gives for the same files."""

import json
from pathlib import Path

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.evaluation import run_errors
from thinmap_ros.evaluation.trajectory_errors import associated
from thinmap_ros.files.trajectories import write_tum
from thinmap_ros.tools import evaluate
from thinmap_ros.view.plots import error_plot

# What evo 1.38.1 prints: evo_ape|evo_rpe tum reference.tum trajectory.tum [-a] [-r angle_deg], of
# relative errors with --delta 2.
STATISTICS = ('rmse', 'mean', 'median', 'std', 'min', 'max', 'sse')
RELATIVE = {
    'RPE, m': (0.037295, 0.036077, 0.035129, 0.009454, 0.021936, 0.055245, 0.023646),
    'RPE, deg': (0.706039, 0.584056, 0.474854, 0.396698, 0.111031, 1.478542, 8.474343),
}
AS_IT_IS = {
    'APE, m': (1.952292, 1.797618, 1.681187, 0.761586, 0.884711, 3.518772, 133.400528),
    'APE, deg': (39.918975, 39.915959, 39.949976, 0.490697, 38.665049, 40.885594, 55773.359615),
}
ALIGNED = {
    'APE, m': (0.023104, 0.020695, 0.020370, 0.010272, 0.002866, 0.039691, 0.018683),
    'APE, deg': (0.597068, 0.462541, 0.360249, 0.377554, 0.006353, 1.591068, 12.477176),
}


def stamps_of(count: int, offset_ns: int = 0) -> list[int]:
    return [k * SECOND_NS // 10 + offset_ns for k in range(count)]


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Estimate and reference: a curve, whose noise and frame differ, and stamps by 4 ms."""
    noise = np.random.default_rng(7).normal(0.0, (0.02, 0.02, 0.01), (40, 3))
    truth = [se2.pose(0.2 * k, np.sin(0.1 * k), 0.3 * np.cos(0.1 * k)) for k in range(40)]
    moved = [
        se2.compose(se2.pose(2.0, -1.0, 0.7), pose + off)
        for pose, off in zip(truth, noise, strict=True)
    ]
    reference = tmp_path / 'reference.tum'
    write_tum(reference, stamps_of(40), truth)
    estimate = tmp_path / 'trajectory.tum'
    # The last five have no partner.
    write_tum(estimate, [*stamps_of(35, 4_000_000), *stamps_of(40, 50_000_000)[35:]], moved)
    return estimate, reference


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr('sys.argv', ['evaluate', *map(str, words)])
    try:
        evaluate.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@pytest.mark.parametrize(('options', 'absolute'), [((), AS_IT_IS), (('--align',), ALIGNED)])
def test_the_numbers_are_those_of_evo(
    files: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
    absolute: dict[str, tuple[float, ...]],
) -> None:
    estimate, reference = files
    out = tmp_path / 'errors.json'
    words = (estimate, '--reference', reference, '--delta', 2, '--json', out, *options)
    assert run(monkeypatch, *words) == 0
    found = json.loads(out.read_text())['trajectory.tum']
    assert found.pop('poses') == 35
    assert {name: tuple(found[name][key] for key in STATISTICS) for name in found} == {
        name: pytest.approx(numbers, abs=1.1e-6)
        for name, numbers in {**absolute, **RELATIVE}.items()
    }


def test_errors_are_drawn_over_time(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimate, reference = files
    picture = tmp_path / 'errors.png'
    assert run(monkeypatch, estimate, '--reference', reference, '--picture', picture) == 0
    assert picture.read_bytes().startswith(b'\x89PNG')
    (result,) = run_errors.evaluate(estimate, reference, delta=2).values()
    assert result.curves['APE, m'][:, 0].tolist() == [
        ns / SECOND_NS for ns in stamps_of(35, 4_000_000)
    ]
    assert result.curves['RPE, deg'][:, 0].tolist() == result.curves['APE, m'][2::2, 0].tolist()
    (metres,) = error_plot({'run': result.curves}).panels[0].layers
    assert (metres.points[0, 0], metres.label) == (0.0, 'run')


def test_both_trajectories_of_a_run_are_compared(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate, reference = files
    estimate.with_name('trajectory_final.tum').write_text(reference.read_text())
    assert run(monkeypatch, estimate.parent, '--reference', reference) == 0
    heads = [line for line in capsys.readouterr().out.splitlines() if not line.startswith(' ')]
    assert len(heads) == 2
    assert 'trajectory.tum: 35' in heads[0] and 'trajectory_final.tum: 40' in heads[1]


def test_relations_count_where_their_stamps_have_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_tum(tmp_path / 'trajectory.tum', stamps_of(20), [se2.pose(k, 0, 0) for k in range(20)])
    lines = [
        '0.1 0.4 3.3 0.4 0 0 0 0.1',  # off by 0.5 m and 0.1 rad
        '0.5 0.2 -3 0 0 0 0 0',  # exact, and backwards
        '0.5 7.0 3 0 0 0 0 0',  # without a pose
    ]
    (tmp_path / 'relations').write_text('\n'.join(lines))
    out = tmp_path / 'errors.json'
    assert run(monkeypatch, tmp_path, '--reference', tmp_path / 'relations', '--json', out) == 0
    found = json.loads(out.read_text())['trajectory.tum']
    assert found['poses'] == 2
    assert found['relations, m']['max'] == pytest.approx(0.5)
    assert found['relations, m']['mean'] == pytest.approx(0.25)
    assert found['relations, deg']['max'] == pytest.approx(np.degrees(0.1))


@pytest.mark.parametrize(
    ('reference', 'words', 'line'),
    [
        ('far.tum', (), '0 stamps within 0.01 s of those of'),
        ('empty.tum', (), '0 stamps within'),
        ('relations', (), 'no relation whose stamps are within 0.01 s of poses of'),
        ('truth.txt', (), 'expected a name that ends in .tum or relations'),
        ('none.tum', (), 'No such file'),
        ('far.tum', ('--delta', 0), 'expected no negative time, and at least 1 pose'),
        ('far.tum', ('--t-max-diff', 'nan'), 'expected no negative time'),
        ('far.tum', ('--picture', 'errors.pdf'), 'errors.pdf: expected a name that ends in .png'),
    ],
)
def test_what_cannot_be_compared_is_one_line(
    files: tuple[Path, Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    reference: str,
    words: tuple[object, ...],
    line: str,
) -> None:
    folder = files[0].parent
    write_tum(folder / 'far.tum', stamps_of(5, 10**12), [np.zeros(3)] * 5)
    (folder / 'empty.tum').write_text('')
    (folder / 'relations').write_text('1000 1001 0 0 0 0 0 0\n')
    assert run(monkeypatch, folder, '--reference', folder / reference, *words) == 2
    (printed,) = capsys.readouterr().err.splitlines()
    assert line in printed


def test_a_folder_without_trajectories_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, tmp_path, '--reference', 'x.tum') == 2
    assert 'no trajectory.tum and no trajectory_final.tum' in capsys.readouterr().err


def test_each_stamp_of_the_shorter_list_has_its_nearest() -> None:
    few = np.array([0, 100, 250])
    many = np.array([-8, 3, 96, 104, 245, 256, 400])
    own, other = associated(few, many, 6)
    assert own.tolist() == [0, 1, 2]
    assert other.tolist() == [1, 2, 4]  # of two that are as near, the earlier one
    swapped = associated(many, few, 6)
    assert [side.tolist() for side in swapped] == [[1, 2, 4], [0, 1, 2]]
    assert associated(few, many, 2)[0].tolist() == []
