"""`from thinmap_ros import ...`: the public names, without ROS."""

import ast
import inspect
import os
import subprocess
import sys
from importlib import import_module
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from support.hidden_library import hide_ros

import thinmap_ros
from thinmap_ros.replaying import replay, write_outputs

pytestmark = pytest.mark.programs

ROOT = Path(__file__).resolve().parents[1]
LOG = str(ROOT / 'bags' / 'dead_end.mcap')


@pytest.fixture(autouse=True)
def without_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hide_ros(tmp_path, monkeypatch)


def run(code: str) -> str:
    command = [sys.executable, '-c', code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_the_package_loads_no_library() -> None:
    loaded = run('import sys, thinmap_ros; dir(thinmap_ros); print(*sys.modules)').split()
    assert 'thinmap_ros' in loaded
    assert not {'numpy', 'numba', 'rclpy', 'rosbags', 'scipy'} & set(loaded)


def test_importing_the_package_changes_nothing_in_the_process() -> None:
    code = """
import os, signal
def state():
    return dict(os.environ), [signal.getsignal(number) for number in signal.valid_signals()]
before = state()
import thinmap_ros
print(state() == before)
"""
    assert run(code) == 'True\n'


def test_every_name_resolves_without_ros() -> None:
    code = """
import sys
from thinmap_ros import *
import thinmap_ros
print(*(type(globals()[name]).__name__ for name in thinmap_ros.__all__))
print('rclpy' in sys.modules)
"""
    kinds, ros = run(code).splitlines()
    assert len(kinds.split()) == len(thinmap_ros.__all__)
    assert ros == 'False'


def test_names_and_places_agree() -> None:
    assert thinmap_ros.__all__ == sorted(thinmap_ros._PLACES)
    for name, place in thinmap_ros._PLACES.items():
        module, _, attribute = place.rpartition('.')
        assert getattr(thinmap_ros, name) is getattr(
            import_module(f'thinmap_ros.{module}'), attribute
        )


def test_type_checkers_see_the_same_names_at_the_same_places() -> None:
    tree = ast.parse(Path(thinmap_ros.__file__).read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    assert ast.unparse(block.test) == 'TYPE_CHECKING'
    seen = {
        name.asname or name.name: f'{node.module}.{name.name}'.removeprefix('thinmap_ros.')
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    assert seen == thinmap_ros._PLACES


def test_a_name_that_does_not_exist_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'thinmap_ros' has no attribute 'nothing'"):
        _ = thinmap_ros.nothing
    with pytest.raises(ImportError):
        from thinmap_ros import nothing  # noqa: F401


def test_what_a_notebook_shows_has_numbers_and_a_picture(tmp_path: Path) -> None:
    slam = thinmap_ros.Pipeline()
    log = thinmap_ros.open_log(str(ROOT / 'bags' / 'dead_end.mcap'))
    for scan, T_odom_base in islice(thinmap_ros.paired_scans(log), 20):
        slam.step(scan, T_odom_base)
    patch = slam.grid.known_area()
    graph = slam.topology.map
    assert repr(graph) == f'TopologicalMap({len(graph.nodes)} nodes, {len(graph.edges)} edges)'
    assert repr(slam) == f'Pipeline(20 scans, {patch!r}, {graph!r})'
    assert repr(patch).startswith(f'GridPatch({patch.shape[0]} x ')
    assert slam._repr_png_().startswith(b'\x89PNG')
    thinmap_ros.plot(patch, graph, title='by hand').savefig(tmp_path / 'map.png')
    assert (tmp_path / 'map.png').stat().st_size > 10_000
    with pytest.raises(thinmap_ros.InputError, match='plot: a int: expected a Pipeline'):
        thinmap_ros.plot(3)


@pytest.fixture(scope='module')
def finished() -> thinmap_ros.Pipeline:
    """A pipeline after a log."""
    slam = thinmap_ros.Pipeline()
    for scan, T_odom_base in thinmap_ros.paired_scans(thinmap_ros.open_log(LOG)):
        slam.step(scan, T_odom_base)
    slam.finish()
    return slam


def test_a_trajectory_has_each_scan_live_and_final(finished, tmp_path: Path) -> None:
    live, final = finished.trajectory
    assert len(live.stamps_ns) == len(live.poses) == len(final.poses) == 219
    np.testing.assert_array_equal(live.stamps_ns, final.stamps_ns)
    np.testing.assert_allclose(live.poses[-1], [7.0, 1.88, 1.57], atol=0.05)
    assert 0.0 < np.abs(live.poses - final.poses).max() < 0.05
    assert repr(final) == 'StampedPoses(219 poses, 8.7 m)'


def test_the_files_and_errors_of_a_pipeline_are_those_of_the_programs(
    finished, tmp_path: Path
) -> None:
    result = replay(thinmap_ros.open_log(LOG), thinmap_ros.PipelineConfig())
    write_outputs(result, tmp_path, 'dead end', (1.0, 1.0))
    for kind, name in (('live', 'trajectory.tum'), ('final', 'trajectory_final.tum')):
        thinmap_ros.write_trajectory(tmp_path / kind, getattr(finished.trajectory, kind))
        assert (tmp_path / kind).read_text() == (tmp_path / name).read_text()
    reference = tmp_path / 'trajectory_final.tum'
    errors = thinmap_ros.evaluate(finished, reference)
    assert list(errors) == ['live', 'final']
    assert errors['final'].errors['APE, m'].max < 1e-6  # digits of a file
    of_files = thinmap_ros.evaluate(tmp_path, str(reference))
    assert errors['live'].errors['APE, m'].rmse == pytest.approx(
        of_files['trajectory.tum'].errors['APE, m'].rmse, abs=1e-6
    )
    assert str(errors['live']).splitlines()[0].startswith('  APE, m         rmse 0.00')
    live, final = finished.trajectory
    (alone,) = thinmap_ros.evaluate(live, final).values()
    assert alone.errors['APE, m'].rmse == pytest.approx(errors['live'].errors['APE, m'].rmse, 1e-3)


def test_a_session_begins_a_new_trajectory(finished, tmp_path: Path) -> None:
    finished.save_session(tmp_path / 'map')
    continued = thinmap_ros.Pipeline()
    scans = list(islice(thinmap_ros.paired_scans(thinmap_ros.open_log(LOG)), 6))
    for number, (scan, T_odom_base) in enumerate(scans):
        if number == 3:
            continued.load_session(tmp_path / 'map')
        continued.step(scan, T_odom_base)
    live, final = continued.trajectory
    assert live.stamps_ns.tolist() == [scan.stamp_ns for scan, _ in scans[3:]]
    assert final.poses.shape == (3, 3)


def test_a_picture_has_the_layers_and_the_size_that_are_asked_for(finished) -> None:
    final = finished.trajectory.final
    figure = thinmap_ros.plot(finished, true=final)
    lines = {line.get_label(): line for line in figure.axes[0].lines}
    np.testing.assert_array_equal(lines['path, estimated'].get_xydata(), final.poses[:, :2])
    assert len(lines['path, driven'].get_xydata()) == 219
    large = thinmap_ros.plot(finished, size_in=14.0)
    assert large.get_size_inches()[0] == pytest.approx(figure.get_size_inches()[0] + 7.0, abs=0.1)
    bare = thinmap_ros.plot(finished, layers=['regions', 'map'])
    labels = {text.get_text() for text in bare.legends[0].get_texts()}
    assert {'corridor', 'wall'} <= labels
    assert not labels & {'path, estimated', 'edge', 'skeleton'}
    only = thinmap_ros.plot(finished, layers='path')
    labels = {text.get_text() for text in only.legends[0].get_texts()}
    assert labels == {'path, estimated', 'start', 'end'}


def test_a_grid_tells_its_size_and_what_is_known(finished) -> None:
    grid = finished.grid
    patch = grid.known_area()
    rows, cols = patch.shape
    free = int(patch.free.sum())
    occupied = int(patch.occupied.sum())
    size = f'{rows} x {cols} cells of 0.05 m'
    assert repr(grid) == f'OccupancyGrid({size}, {free} free, {occupied} occupied)'
    assert min(rows, cols, free, occupied) > 100


def test_the_nearest_node_is_that_of_a_place_or_two_numbers(finished) -> None:
    graph = finished.topology.map
    assert graph.nearest_node((6.0, 3.0)) is graph.nearest_node(6.0, 3.0)
    assert graph.nearest_node(np.array([6.0, 3.0])) is graph.nearest_node(6.0, 3.0)


def test_a_world_of_the_package_is_explored_by_its_name() -> None:
    options = thinmap_ros.ExplorationOptions(time_limit_s=3.0)
    robot, report = thinmap_ros.explore('room_10x10', options=options)
    assert report['world'] == 'room_10x10'
    start = thinmap_ros.read_world(thinmap_ros.world_path('room_10x10'))[2]
    np.testing.assert_allclose(robot.log.true_poses[0], start, atol=0.3)


def test_keywords_are_shown_where_a_notebook_asks_for_them() -> None:
    for callable_, name in (
        (thinmap_ros.Pipeline, 'resolution_m'),
        (thinmap_ros.ExplorationOptions, 'speed_m_s'),
        (thinmap_ros.plot, 'layers'),
    ):
        assert name in inspect.signature(callable_).parameters


def test_the_image_of_a_map_names_the_file_beside_it(tmp_path: Path) -> None:
    thinmap_ros.write_map(tmp_path / 'room', thinmap_ros.OccupancyGrid().known_area())
    with pytest.raises(thinmap_ros.InputError, match=r'did you mean .*room\.yaml') as raised:
        thinmap_ros.read_map(tmp_path / 'room.pgm')
    assert len(str(raised.value).splitlines()) == 1


def test_paths_may_be_texts(tmp_path: Path) -> None:
    stem = str(tmp_path / 'room')
    world = str(ROOT / 'worlds' / 'room_10x10.yaml')
    _, patch, _ = thinmap_ros.read_world(world)
    thinmap_ros.write_map(stem, patch)
    assert thinmap_ros.read_map(f'{stem}.yaml').shape == patch.shape
    graph = thinmap_ros.build_topology(patch, None, thinmap_ros.TopologyConfig())
    thinmap_ros.write_graph(f'{stem}.geojson', graph)
    assert (tmp_path / 'room.geojson').stat().st_size > 1000


def test_the_first_use_says_that_it_compiles(tmp_path: Path) -> None:
    code = """
import numpy as np
from thinmap_ros import thin
thin(np.ones((5, 5), dtype=np.bool_))
"""
    command = [sys.executable, '-c', code]
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path / 'empty')}
    # It says so before it compiles, which takes a while. Others test what follows.
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=environment
    ) as process:
        assert process.stderr is not None
        first_line = process.stderr.readline()
        process.kill()
    assert first_line.startswith('thinmap: compiling kernels, once: 0 of at most ')
