"""Data of a view are in the .rrd file, read with rerun's own reader."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap, flat_topology
from thinmap_ros.core.topology.regions import RegionKind
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.view import palette, rerun_sinks, rerun_view
from thinmap_ros.view.interface import NullView
from thinmap_ros.view.message_view import MessageView, recording_from_bag
from thinmap_ros.view.rerun_view import View

ROOT = Path(__file__).resolve().parents[2]
S = 1_000_000_000
START = 1_700_000_000 * S
needs_rerun = pytest.mark.skipif(
    not rerun_sinks.is_installed(),
    reason='needs rerun, which is not installed (the extra "viewer")',
)


def read_back(path):
    """Rows (seconds since the first, columns by component) of each entity; number of blueprints."""
    from rerun.chunk import RrdReader

    reader = RrdReader(path)
    rows = {}
    assert len(reader.recordings()) == 1
    for chunk in reader.stream():
        columns = chunk.to_record_batch().to_pydict()
        times = columns.pop('time', [None] * chunk.num_rows)
        for i, time in enumerate(times):
            values = {name: column[i] for name, column in columns.items()}
            seconds = None if time is None else time.total_seconds()
            rows.setdefault(chunk.entity_path, []).append((seconds, values))
    for entity in rows.values():
        entity.sort(key=lambda row: -1.0 if row[0] is None else row[0])
    return rows, len(reader.blueprints())


def patch_of(cells, origin=(-1.0, 2.0)):
    return GridPatch(GridFrame(*origin, 0.1), np.array(cells, dtype=np.int8))


def topology():
    nodes = [Node(1, NodeKind.END, 0.0, 0.0, 0.5), Node(2, NodeKind.BRANCH, 1.0, 0.0, 0.5)]
    return TopologicalMap(
        nodes, [Edge(3, 1, 2, np.array([[0.0, 0.0], [0.5, 0.1], [1.0, 0.0]]), 1.0, 0.5)]
    )


@needs_rerun
def test_map_lies_where_it_is_and_is_the_right_way_up(tmp_path):
    view = View(tmp_path / 'a.rrd')
    view.grid(START, patch_of([[0, 100, -1], [50, 0, 0]]))
    view.close()
    rows, blueprints = read_back(tmp_path / 'a.rrd')
    ((seconds, grid),) = rows['/map/grid']
    assert seconds == 0.0
    assert blueprints >= 1
    assert np.ravel(grid['GridMap:translation']).tolist() == [-1.0, 2.0, 0.0]
    assert np.ravel(grid['GridMap:cell_size']) == pytest.approx(0.1)
    # Grey images are shown in grey, and not with a colour map.
    assert np.ravel(grid['GridMap:colormap']).tolist() == [1]
    # Upper row first; free is white, occupied black, unknown between.
    assert np.ravel(grid['GridMap:data']).tolist() == [127, 255, 255, 255, 0, 205]


@needs_rerun
def test_large_things_are_drawn_once_a_second_and_the_last_is_not_lost(tmp_path):
    view = View(tmp_path / 'a.rrd')
    for i in range(14):
        view.grid(START + i * S // 5, patch_of([[0] * (i + 1)]))
        view.topology(START + i * S // 5, topology())
    view.close()
    rows, _ = read_back(tmp_path / 'a.rrd')
    assert [seconds for seconds, _ in rows['/map/grid']] == pytest.approx([0.0, 1.0, 2.0, 2.6])
    assert [len(np.ravel(r['GridMap:data'])) for _, r in rows['/map/grid']] == [1, 6, 11, 14]
    assert len(rows['/map/skeleton']) == len(rows['/map/nodes']) == 4


@needs_rerun
def test_robot_scan_and_trail(tmp_path):
    view = View(tmp_path / 'a.rrd')
    scan = Scan.create(
        START, [1.0, 2.0, np.inf], 0.0, np.pi / 2.0, 0.1, 8.0, se2.pose(0.1, 0.0, 0.0)
    )
    view.scan(START, scan)
    # A robot that first stands still: this adds no points to the trail.
    for i, x in enumerate([0.0, 0.01, 0.0, 0.2, 0.4]):
        view.pose(START + i * S, se2.pose(x, 1.0, 0.5), np.diag([0.04, 0.01, 0.001]))
    view.close()
    rows, _ = read_back(tmp_path / 'a.rrd')
    points = np.array(rows['/map/robot/scan'][0][1]['Points3D:positions'])
    np.testing.assert_allclose(points[:, :2], [[1.1, 0.0], [0.1, 2.0]], atol=1e-6)
    assert len(rows['/map/robot']) == 5
    steps = [
        np.array(values['LineStrips3D:strips'][0])[:, :2] for _, values in rows['/map/estimate']
    ]
    np.testing.assert_allclose(
        steps, [[[0.0, 1.0], [0.2, 1.0]], [[0.2, 1.0], [0.4, 1.0]]], atol=1e-6
    )
    outline = np.array(rows['/map/covariance'][0][1]['LineStrips3D:strips'][0])[:, :2] - (0.0, 1.0)
    # Every point of it has the same Mahalanobis distance.
    np.testing.assert_allclose(
        outline[:, 0] ** 2 / 0.04 + outline[:, 1] ** 2 / 0.01, 5.991, rtol=1e-4
    )


@needs_rerun
def test_graph_target_lines_and_numbers(tmp_path):
    view = View(tmp_path / 'a.rrd')
    view.topology(START, topology())
    view.end_nodes(START, np.array([[0.0, 0.0]]), np.array([0.444]))
    view.lines(
        START,
        np.array([[[0.0, 0.0], [1.0, 2.0]], [[3.0, 0.0], [3.0, 1.0]]]),
        np.array([True, False]),
    )
    view.local_area(START, np.array([[1.0, 0.0]]))
    view.particles(START, np.array([[4.0, 5.0], [6.0, 7.0]]))
    view.plan(START, np.array([[0.0, 0.0], [1.0, 0.0]]))
    for i, place in enumerate([np.array([1.0, 2.0]), np.array([1.0, 2.0]), None, None]):
        view.target(START + i * S, place)
    view.scalar(START + S, 'step', 'localizer', 4.5)
    view.close()
    rows, _ = read_back(tmp_path / 'a.rrd')
    colours = rows['/map/nodes'][0][1]['Points3D:colors']
    assert colours == [0xD55E00FF, 0x0072B2FF]
    text = rows['/map/end_nodes/probability'][0][1]
    assert text['Points3D:labels'] == ['0.44']
    assert text['Points3D:colors'] == [0x000000FF], 'readable whatever the colour of the node'
    assert np.array(rows['/map/skeleton'][0][1]['LineStrips3D:strips']).shape == (1, 3, 3)
    np.testing.assert_allclose(
        np.array(rows['/map/lines'][0][1]['LineStrips3D:strips'])[0, :, :2], [[0, 0], [1, 2]]
    )
    targets = [(s, len(v['Points3D:positions'])) for s, v in rows['/map/target']]
    assert targets == [(0.0, 1), (2.0, 0)]
    steps = rows['/plots/step/localizer']
    assert [(s, v['Scalars:scalars']) for s, v in steps if s is not None] == [(1.0, [4.5])]
    near, far = rows['/map/lines'][0][1]['LineStrips3D:colors']
    assert near != far, 'the features of the local area stand out'
    np.testing.assert_allclose(
        np.array(rows['/map/local_area'][0][1]['Points3D:positions'])[:, :2], [[1, 0]]
    )
    np.testing.assert_allclose(
        np.array(rows['/map/samples'][0][1]['Points3D:positions'])[:, :2], [[4, 5], [6, 7]]
    )
    assert len(rows['/map/plan']) == 1


@needs_rerun
def test_a_recording_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(InputError, match=r'file/a\.rrd'):
        View(tmp_path / 'file' / 'a.rrd')
    with pytest.raises(InputError, match=str(tmp_path)):
        View(tmp_path)


@needs_rerun
@pytest.mark.skipif(sys.platform != 'linux', reason='screens are found by these variables on Linux')
def test_viewer_without_a_screen_is_refused(tmp_path, monkeypatch):
    monkeypatch.delenv('DISPLAY', raising=False)
    monkeypatch.delenv('WAYLAND_DISPLAY', raising=False)
    with pytest.raises(InputError, match='no screen'):
        View(tmp_path / 'a.rrd', spawn=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.programs
@needs_rerun
def test_viewer_is_sent_what_the_file_holds_and_ends_with_the_view(tmp_path, monkeypatch):
    # The real program, which writes a file of what it receives instead of opening a window.
    received = tmp_path / 'received.rrd'
    stand_in = tmp_path / 'viewer'
    stand_in.write_text(
        f'#!/bin/sh\nexec "{rerun_sinks.viewer_program()}" --save "{received}" "$@"\n'
    )
    stand_in.chmod(0o755)
    monkeypatch.setattr(rerun_sinks, 'viewer_program', lambda: str(stand_in))
    monkeypatch.setenv('DISPLAY', ':none')
    view = View(tmp_path / 'a.rrd', spawn=True)
    viewer = view._streams.viewer
    for i in range(10):
        view.scalar(START + i * S, 'progress', 'seen, m2', 10.0 * i)
    assert viewer.poll() is None
    view.close()
    assert viewer.poll() is not None
    rows, _ = read_back(tmp_path / 'a.rrd')
    assert sum(seconds is not None for seconds, _ in rows['/plots/progress/seen_m2']) == 10
    # It is killed without finishing its file: only its connection matters.
    assert received.stat().st_size > 0


def write_bag(path):
    with BagWriter(path) as bag:
        types = bag.typestore.types
        time = types['builtin_interfaces/msg/Time']

        def pose(i, x):
            point = types['geometry_msgs/msg/Point'](x, 0.0, 0.0)
            turn = types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
            header = types['std_msgs/msg/Header'](time(1000 + i, 0), 'map')
            return header, types['geometry_msgs/msg/Pose'](point, turn)

        for i in range(4):
            header, exact = pose(i, 0.5 * i)
            truth = types['geometry_msgs/msg/PoseStamped'](header, exact)
            bag.write('/ground_truth', 'geometry_msgs/msg/PoseStamped', (1000 + i) * S, truth)
            header, wrong = pose(i, float('nan') if i == 2 else 0.5 * i + 0.03)
            covariance = types['geometry_msgs/msg/PoseWithCovariance'](wrong, np.zeros(36))
            estimate = types['geometry_msgs/msg/PoseWithCovarianceStamped'](header, covariance)
            bag.write(
                '/pose', 'geometry_msgs/msg/PoseWithCovarianceStamped', (1000 + i) * S, estimate
            )


@needs_rerun
def test_bag_becomes_a_recording_with_the_error_of_the_pose(tmp_path):
    write_bag(tmp_path / 'bag')
    recording_from_bag(tmp_path / 'bag', tmp_path / 'run.rrd')
    rows, _ = read_back(tmp_path / 'run.rrd')
    # Only the pose that is not a number is left out.
    errors = [
        (s, v['Scalars:scalars'][0]) for s, v in rows['/plots/error/position_cm'] if s is not None
    ]
    assert errors == [(s, pytest.approx(3.0)) for s in (0.0, 1.0, 3.0)]
    assert len(rows['/map/truth']) == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == ['bag', 'run.rrd']


@needs_rerun
def test_no_bag_leaves_no_recording(tmp_path):
    with pytest.raises(InputError, match='nowhere'):
        recording_from_bag(tmp_path / 'nowhere', tmp_path / 'run.rrd')
    assert not list(tmp_path.iterdir())


@pytest.mark.programs
def test_without_rerun_a_view_names_what_to_install():
    code = """
import sys
sys.modules['rerun'] = None
from thinmap_ros.view import rerun_view
from thinmap_ros.core.errors import InputError
try:
    rerun_view.View()
except InputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout == "rerun is not installed: pip install 'rerun-sdk>=0.41,<0.42'\n", (
        done.stderr
    )


def test_null_view_takes_all_that_a_view_takes():
    taken = {name for name in vars(View) if not name.startswith('_')}
    assert taken == {name for name in vars(NullView) if not name.startswith('_')}


def test_feed_refuses_what_makes_no_sense():
    flat = flat_topology(TopologicalMap([Node(1, NodeKind.END, 0.0, 0.0, 0.5)]))
    flat['node_kinds'][0] = 9
    with pytest.raises(InputError, match=r'node_kinds\[0\]: 9'):
        MessageView(NullView(), lambda frame: None).show('topology', stamped(**flat))


class Diary(NullView):
    """A view that stores its calls."""

    def __init__(self):
        self.numbers = []
        self.near = None

    def scalar(self, ns, plot, curve, value):
        self.numbers.append((plot, curve, value))

    def local_area(self, ns, places):
        self.near = places.tolist()


def plain(**values):
    return SimpleNamespace(**values)


def stamped(**values):
    return plain(header=plain(stamp=plain(sec=3, nanosec=0)), **values)


def test_step_times_are_those_of_the_robot_that_is_shown():
    diary = Diary()
    feed = MessageView(diary, lambda frame: None, '/robot2')
    pair = plain(key='graph update: step time', value='median 12.5 ms, p95 20.0 ms, max 31.0 ms')
    rate = plain(key='scan: rate', value='5.0 Hz')
    names = (
        'topology_builder: thinmap',
        'robot2/topology_builder: thinmap',
        'robot2/x/topology_builder: thinmap',
    )
    feed.show(
        'diagnostics', stamped(status=[plain(name=name, values=[rate, pair]) for name in names])
    )
    assert diary.numbers == [('step', 'graph update', 12.5)]


def test_the_area_seen_never_falls_within_an_exploration():
    diary = Diary()
    feed = MessageView(diary, lambda frame: None)
    for distance_m, known_m2 in ((0.0, 5.0), (1.0, 9.0), (2.0, 8.5), (0.0, 6.0)):
        target = {'target_position': plain(x=0.0, y=0.0), 'has_target': False}
        progress = {'distance_m': distance_m, 'known_area_m2': known_m2}
        feed.show('exploration_status', stamped(end_nodes_remaining=1, **target, **progress))
    seen = [value for _, curve, value in diary.numbers if curve == 'seen, m2']
    assert seen == [5.0, 9.0, 9.0, 6.0]


@needs_rerun
def test_curves_that_are_always_zero_are_not_shown(tmp_path):
    view = View(tmp_path / 'a.rrd')
    for i, nodes in enumerate([0.0, 0.0, 3.0, 0.0]):
        view.scalar(START + i * S, 'count', 'features', 0.0)
        view.scalar(START + i * S, 'count', 'nodes', nodes)
    view.close()
    rows, _ = read_back(tmp_path / 'a.rrd')
    nodes = [(s, v['Scalars:scalars']) for s, v in rows['/plots/count/nodes'] if s is not None]
    assert nodes == [(0.0, [0.0]), (2.0, [3.0]), (3.0, [0.0])]
    assert all(seconds is None for seconds, _ in rows['/plots/count/features'])
    legend = rows['/legends/count'][-1][1]['TextDocument:text']
    assert legend == ['- **pink** nodes']


def test_local_area_is_where_its_features_are_stored():
    diary = Diary()
    feed = MessageView(diary, lambda frame: None)
    nodes = [Node(i, NodeKind.END, 1.0 * i, 0.0, 0.5) for i in (1, 2, 3)]
    feed.show('topology', stamped(**flat_topology(TopologicalMap(nodes))))
    point = plain(x=0.0, y=0.0)
    kept = [([1, 7], True), ([2], True), ([3], False)]  # node 7 is gone
    features = [
        plain(start=point, end=point, node_ids=ids, in_local_area=local) for ids, local in kept
    ]
    feed.show('line_features', stamped(features=features))
    assert diary.near == [[1.0, 0.0], [2.0, 0.0]]


def test_regions_are_shown_in_the_colour_of_their_kind():
    shown = []

    class Outlines(NullView):
        def regions(self, ns, outlines, colours):
            shown.append((ns, [o.tolist() for o in outlines], list(colours)))

    points = [plain(x=float(x), y=float(y)) for x, y in ((0, 0), (2, 0), (2, 1))]
    middle = plain(x=1.0, y=0.5)
    outline = plain(points=points)
    region = plain(id=5, kind=1, outline=outline, center=middle, area_m2=1.0, name='')
    feed = MessageView(Outlines(), lambda frame: None)
    feed.show('regions', stamped(regions=[region], doors=[]))
    ((ns, (outline,), (colour,)),) = shown
    assert ns == 3 * S and outline == [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]]
    assert colour in palette.REGIONS[RegionKind.CORRIDOR]
    region.kind = 7
    with pytest.raises(InputError, match='region 5: kind 7: expected 0 to 2'):
        feed.show('regions', stamped(regions=[region], doors=[]))
    region.kind = 1
    points[0].x = float('nan')
    with pytest.raises(InputError, match='region 5'):
        feed.show('regions', stamped(regions=[region], doors=[]))


def localized(state, x):
    """LocalizedScan of three beams, 2 m long, at a pose."""
    upright = plain(x=0.0, y=0.0, z=0.0, w=1.0)
    beams = plain(
        header=plain(frame_id=''),
        ranges=[2.0, 2.0, 2.0],
        angle_min=-0.5,
        angle_max=0.5,
        angle_increment=0.5,
        range_min=0.1,
        range_max=10.0,
        time_increment=0.0,
        scan_time=0.1,
    )
    return stamped(
        scan=beams,
        laser_pose=plain(position=plain(x=0.1, y=0.0, z=0.0), orientation=upright),
        pose=plain(pose=plain(position=plain(x=x, y=0.0, z=0.0), orientation=upright)),
        status=plain(state=state, MAPPING_APART=5),
    )


def test_scans_of_a_piece_apart_are_shown_until_it_is_joined():
    shown = []

    class Pieces(NullView):
        def apart(self, ns, points):
            shown.append(points)

    feed = MessageView(Pieces(), lambda frame: None)
    for state, x in ((0, 0.0), (5, 1.0), (5, 1.2), (5, 2.0), (0, 3.0), (0, 4.0)):
        feed.show('localized_scan', localized(state, x))
    assert [len(points) for points in shown] == [3, 6, 0]
    assert shown[1][[1, 4]] == pytest.approx(np.array([[3.1, 0.0], [4.1, 0.0]]))


@needs_rerun
def test_a_piece_apart_is_pale_in_the_recording(tmp_path):
    view = View(tmp_path / 'a.rrd')
    view.apart(START, np.array([[1.0, 2.0], [3.0, 4.0]]))
    view.close()
    ((_, row),) = read_back(tmp_path / 'a.rrd')[0]['/map/apart']
    assert np.ravel(row['Points3D:positions']).tolist()[:2] == [1.0, 2.0]


@needs_rerun
def test_regions_are_closed_lines(tmp_path):
    view = View(tmp_path / 'a.rrd')
    view.regions(START, [np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]])], ['#C9DFF2'])
    view.close()
    ((_, row),) = read_back(tmp_path / 'a.rrd')[0]['/map/regions']
    points = np.array(row['LineStrips3D:strips']).reshape(-1, 3)
    assert len(points) == 4 and points[0].tolist() == points[-1].tolist()


@needs_rerun
def test_the_camera_looks_straight_down_on_the_middle_of_the_map():
    import rerun as rr
    import rerun.blueprint

    patch = GridPatch(GridFrame(-2.0, 1.0, 0.1), np.zeros((40, 80), dtype=np.int8))
    eye = rerun_view._eye(rr.blueprint, patch)
    position, target, up = (
        np.array(batch.as_arrow_array().to_pylist()[0])
        for batch in (eye.position, eye.look_target, eye.eye_up)
    )
    np.testing.assert_allclose(position[:2], [2.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(target, [2.0, 3.0, 0.0], atol=1e-6)
    assert up.tolist() == [0.0, 1.0, 0.0]
    # The map fits into the height and the width of the picture.
    half_m = position[2] * np.tan(np.radians(27.5))
    assert half_m > 2.0 and 1.3 * half_m > 4.0


@needs_rerun
def test_the_estimated_path_is_wider_and_below_the_true_one(tmp_path):
    view = View(tmp_path / 'a.rrd')
    for name in ('estimate', 'truth'):
        view.trajectory(START, name, np.zeros(3))
        view.trajectory(START + S, name, np.array([1.0, 0.0, 0.0]))
    view.close()
    rows, _ = read_back(tmp_path / 'a.rrd')
    estimate, truth = (rows[f'/map/{name}'][0][1] for name in ('estimate', 'truth'))
    assert estimate['LineStrips3D:radii'][0] < truth['LineStrips3D:radii'][0] < 0.0
    heights = [row['LineStrips3D:strips'][0][0][2] for row in (estimate, truth)]
    assert heights[0] < heights[1]
