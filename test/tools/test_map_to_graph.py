"""The program map_to_graph.

From any map_server map to a route graph, or to an error of one line.
"""

import json
from pathlib import Path

import networkx
import numpy as np
import pytest
import yaml
from PIL import Image

from thinmap_ros.core.grid.edits import KeepOut, MapEdits
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.topology.segmentation import RegionTracker
from thinmap_ros.files.occupancy_maps import read_map
from thinmap_ros.files.sessions import EDITS, GRID, REGIONS
from thinmap_ros.tools import map_to_graph

YAML = {
    'image': 'm.png',
    'resolution': 0.1,
    'origin': [-1.0, 2.0, 0.0],
    'negate': 0,
    'occupied_thresh': 0.65,
    'free_thresh': 0.196,
}


def corridors() -> np.ndarray:
    """A T of corridors 1 m wide, grey values, the first row on top."""
    grey = np.zeros((60, 90), dtype=np.uint8)
    grey[10:20, 10:80] = grey[10:35, 40:50] = 254
    return grey


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr('sys.argv', ['map_to_graph', *map(str, words)])
    try:
        map_to_graph.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def written(tmp_path: Path, grey: np.ndarray, **changes: object) -> Path:
    Image.fromarray(grey).save(tmp_path / 'm.png')
    path = tmp_path / 'm.yaml'
    path.write_text(yaml.safe_dump({k: v for k, v in (YAML | changes).items() if v is not None}))
    return path


def test_three_formats_and_a_picture_of_one_graph(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, corridors())
    for name in ('g.geojson', 'g.graphml', 'g.tmap2.yaml'):
        assert run(monkeypatch, path, '-o', tmp_path / name, '--picture', tmp_path / 'g.png') == 0
    features = json.loads((tmp_path / 'g.geojson').read_text())['features']
    points = {
        f['properties']['id']: f['geometry']['coordinates']
        for f in features
        if f['geometry']['type'] == 'Point'
    }
    polygons = [f for f in features if f['geometry']['type'] == 'Polygon']
    graph = networkx.read_graphml(tmp_path / 'g.graphml', node_type=int)
    regions = {d['region'] for d in graph.nodes.values()}
    assert regions == {f['properties']['id'] for f in polygons} and regions
    assert {k: [d['x'], d['y']] for k, d in graph.nodes.items()} == points
    assert sorted(d['kind'] for d in graph.nodes.values()) == ['branch', 'end', 'end', 'end']
    assert all(d['clearance'] >= 0.25 and d['length'] > 1.0 for d in graph.edges.values())
    tmap2 = yaml.safe_load((tmp_path / 'g.tmap2.yaml').read_text())
    places = {n['node']['name']: n['node']['pose']['position'] for n in tmap2['nodes']}
    assert {k: [at['x'], at['y']] for k, at in places.items()} == {
        f'NODE{k}': v for k, v in points.items()
    }
    ways = {(n['node']['name'], e['node']) for n in tmap2['nodes'] for e in n['node']['edges']}
    assert ways == {(f'NODE{a}', f'NODE{b}') for k, n in graph.edges for a, b in ((k, n), (n, k))}
    ids = [e['edge_id'] for n in tmap2['nodes'] for e in n['node']['edges']]
    assert len(set(ids)) == len(ids) == 6
    assert Image.open(tmp_path / 'g.png').size[0] > 300


def test_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, corridors())
    out = tmp_path / 'g.graphml'

    def nodes(*words: object) -> int:
        assert run(monkeypatch, path, '-o', out, *words) == 0
        return len(networkx.read_graphml(out))

    assert nodes() == 4
    assert nodes('--robot-radius-m', 0.6) == 0
    assert nodes('--min-clearance-m', 0.6) == 0
    assert nodes('--prune-m', 2.0) == 2
    assert nodes('--detail-m', 0) == 4
    assert nodes('--start=3.0,6.5') == 4
    assert nodes('--start=-50,0') == 0


@pytest.mark.parametrize(('resolution', 'gap'), [(0.05, 9), (0.125, 3)])
def test_a_gap_that_nav2_calls_inscribed_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, resolution: float, gap: int
) -> None:
    """The middle of the gap is 0.25 m from both walls, centre to centre of the cells."""
    grey = np.zeros((80, 100), dtype=np.uint8)
    grey[5:75, 5:48] = grey[5:75, 52:95] = grey[40 : 40 + gap, 48:52] = 254
    path = written(tmp_path, grey, resolution=resolution)
    out = tmp_path / 'g.graphml'

    def parts(*words: object) -> int:
        assert run(monkeypatch, path, '-o', out, *words) == 0
        return networkx.number_connected_components(networkx.read_graphml(out))

    assert parts() == 2
    assert parts('--allow-touching') == 1
    assert parts('--robot-radius-m', 0.2) == 1


def test_nodes_are_fewer_the_larger_the_node_spacing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grey = np.zeros((70, 200), dtype=np.uint8)
    grey[30:37, 5:195] = 254
    for number, col in enumerate(range(15, 185, 12)):  # niches of 1 m on both sides
        grey[(20 if number % 2 else 37) : (30 if number % 2 else 49), col : col + 7] = 254
    path = written(tmp_path, grey)
    out = tmp_path / 'g.graphml'

    def nodes(*words: object) -> int:
        assert run(monkeypatch, path, '-o', out, *words) == 0
        return len(networkx.read_graphml(out))

    dense, usual, sparse = (nodes('--node-spacing-m', spacing_m) for spacing_m in (0.3, 1.2, 3.0))
    assert dense > 2 * usual >= 2 * sparse
    assert usual == nodes()
    assert nodes('--detail-m', 3.0) == nodes('--detail-m', 3.0, '--node-spacing-m', 3.0)


def test_the_graph_stays_out_of_a_keep_out_mask(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mask has other cells than the map, and closes the foot of the T."""
    path = written(tmp_path, corridors())
    grey = np.full((20, 20), 254, dtype=np.uint8)
    grey[5:13, :] = 0
    (tmp_path / 'mask').mkdir()
    mask = written(tmp_path / 'mask', grey, resolution=0.15, origin=[2.5, 3.5, 0.0])
    out = tmp_path / 'g.geojson'

    def found(*words: object) -> tuple[float, list[object]]:
        """Lowest y of the graph's nodes and edges, and the regions."""
        assert run(monkeypatch, path, '-o', out, *words) == 0
        features = json.loads(out.read_text())['features']
        shapes = [f['geometry'] for f in features]
        graph = [np.ravel(s['coordinates'])[1::2] for s in shapes if s['type'] != 'Polygon']
        return float(np.concatenate(graph).min()), [s for s in shapes if s['type'] == 'Polygon']

    open_y, regions = found()
    kept_y, regions_kept = found('--keep-out', mask)
    assert capsys.readouterr().out.endswith('keep-out mask: 3.6 m2\n')
    assert open_y < 5.5 and kept_y > 5.75 + 0.25
    assert regions == regions_kept


@pytest.mark.parametrize(
    ('origin', 'others', 'expected'),
    [
        ([50.0, 2.0, 0.0], [], 'mask.yaml: mask of x 50.0 to 59.0 m, y 2.0 to 8.0 m: expected one'),
        ([-1.0, 2.0, 0.0], ['m.yaml'], '--keep-out: expected one map'),
    ],
)
def test_a_mask_beside_the_map_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    origin: list[float],
    others: list[str],
    expected: str,
) -> None:
    path = written(tmp_path, corridors(), origin=origin).rename(tmp_path / 'mask.yaml')
    written(tmp_path, corridors())
    maps = [tmp_path / name for name in ('m.yaml', *others)]
    assert run(monkeypatch, *maps, '-o', tmp_path / 'out.geojson', '--keep-out', path) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('map_to_graph: error: ') and expected in line


def test_no_edge_of_a_file_crosses_the_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grey = corridors()
    grey[25:27, 40:50] = 205  # 0.2 m across the middle corridor
    path = written(tmp_path, grey)
    out = tmp_path / 'g.graphml'
    assert run(monkeypatch, path, '-o', out) == 0
    closed = networkx.read_graphml(out)
    assert run(monkeypatch, path, '-o', out, '--max-unknown-gap-m', 0.2) == 0
    crossed = networkx.read_graphml(out)
    assert networkx.number_connected_components(closed) == 2
    assert networkx.number_connected_components(crossed) == 1


@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (['-o', 'g.svg'], '.geojson'),
        (['-o', 'g.graphml', '--robot-radius-m', '-1'], 'robot_radius_m'),
        (['-o', 'g.graphml', '--robot-radius-m', 'nan'], 'robot_radius_m'),
        (['-o', 'g.graphml', '--min-clearance-m', '0.1'], 'min-clearance-m'),
        (['-o', 'g.graphml', '--max-unknown-gap-m', '-0.1'], 'max_unknown_gap_m'),
        (['-o', 'g.graphml', '--start', 'here'], 'start'),
        (['-o', 'g.graphml', '--detail-m', '-1'], '--detail-m -1'),
        (['-o', 'g.graphml', '--node-spacing-m', '0'], '--node-spacing-m 0.0: expected 0.05 m'),
        (['-o', 'g.graphml', '--node-spacing-m', '-2'], '--node-spacing-m -2.0: expected'),
        (['-o', 'g.graphml', '--node-spacing-m', 'nan'], '--node-spacing-m nan: expected'),
        (['-o', 'g.graphml', '--node-spacing-m', 'inf'], '--node-spacing-m inf: expected'),
        (['-o', 'g.graphml', '--node-spacing-m', '1e-9'], '--node-spacing-m 1e-09: expected'),
        (['-o', 'g.graphml', '--node-spacing-m', '2', '--detail-m', '0'], '--detail-m above 0'),
        (['-o', 'g.geojson', '--speed-limit', '1'], '--speed-limit=1'),
        (['-o', 'g.geojson', '--speed-limit', '1,0'], 'speed limit of 0'),
        (['-o', 'g.graphml', '--speed-limit', '1,50'], '.geojson'),
        (['-o', 'g.graphml', '--picture', 'g.jpg'], '.png'),
    ],
)
def test_wrong_options(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    said: str,
) -> None:
    path = written(tmp_path, corridors())
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, path, *words) == 2
    error = capsys.readouterr().err
    assert error.count('\n') == 1 and said in error
    assert not list(tmp_path.glob('g.*'))


@pytest.mark.parametrize('value', [0, 205, 254])
def test_maps_of_one_value(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], value: int
) -> None:
    path = written(tmp_path, np.full((50, 80), value, dtype=np.uint8))
    assert run(monkeypatch, path, '-o', tmp_path / 'g.geojson') == 0
    warned = 'warning' in capsys.readouterr().err
    features = json.loads((tmp_path / 'g.geojson').read_text())['features']
    assert warned == (value != 254)
    assert len(features) == 0 if warned else len(features) > 0


def test_a_map_of_map_saver_has_no_graph_round_the_building(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    grey = corridors()
    grey[:8] = grey[40:] = 205
    graphs = {}
    for free_thresh in (0.196, 0.25):
        path = written(tmp_path, grey, free_thresh=free_thresh)
        assert run(monkeypatch, path, '-o', tmp_path / 'g.geojson') == 0
        graphs[free_thresh] = (tmp_path / 'g.geojson').read_text()
        said = capsys.readouterr().err
        assert ('2520 cells of grey 205' in said) is (free_thresh == 0.25)
        assert said.count('\n') == (free_thresh == 0.25)
    assert graphs[0.25] == graphs[0.196]


@pytest.mark.parametrize(
    'changes',
    [
        {'image': 'missing.png'},
        {'image': 'm.yaml'},
        {'image': None},
        {'resolution': 0},
        {'resolution': -0.1},
        {'resolution': float('nan')},
        {'resolution': None},
        {'origin': [0.0, 0.0]},
        {'origin': [0.0, float('nan'), 0.0]},
        {'mode': 'colour'},
    ],
)
def test_bad_maps(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, object],
) -> None:
    path = written(tmp_path, corridors(), **changes)
    assert run(monkeypatch, path, '-o', tmp_path / 'g.geojson') == 2
    error = capsys.readouterr().err
    assert error.startswith('map_to_graph: error: ') and error.count('\n') == 1
    assert not (tmp_path / 'g.geojson').exists()


@pytest.mark.parametrize(
    'content', [b'P5\n0 0\n255\n', b'P5\n5 0\n255\n', b'', b'P5\n10 10\n255\n123']
)
def test_images_of_no_size_or_cut_short(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    content: bytes,
) -> None:
    path = written(tmp_path, corridors(), image='m.pgm')
    (tmp_path / 'm.pgm').write_bytes(content)
    assert run(monkeypatch, path, '-o', tmp_path / 'g.geojson') == 2
    assert 'm.pgm' in capsys.readouterr().err


def test_a_map_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, tmp_path / 'no.yaml', '-o', tmp_path / 'g.geojson') == 2
    assert 'no.yaml' in capsys.readouterr().err


@pytest.mark.parametrize('deep', [False, True])
def test_colour_and_16_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, deep: bool) -> None:
    grey = corridors()
    picture = grey.astype(np.uint16) * 257 if deep else np.stack([grey] * 3, axis=-1)
    path = written(tmp_path, picture)
    assert run(monkeypatch, path, '-o', tmp_path / 'g.graphml') == 0
    assert len(networkx.read_graphml(tmp_path / 'g.graphml')) == 4


def test_regions_of_a_saved_session_keep_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, corridors())
    tracker = RegionTracker()
    regions = tracker.update(read_map(path))
    (number,) = regions.regions
    place = np.array([regions.regions[number].x, regions.regions[number].y])
    tracker.names.put(regions, number, place, 'Südflur')
    REGIONS.save(str(path), tracker)
    assert run(monkeypatch, path, '-o', tmp_path / 'g.geojson') == 0
    features = json.loads((tmp_path / 'g.geojson').read_text())['features']
    names = [f['properties']['name'] for f in features if f['geometry']['type'] == 'Polygon']
    assert names == ['Südflur']


def test_no_edge_leads_through_a_keep_out_area_of_the_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, corridors())
    stem = str(path.with_suffix(''))
    # Across the right part of the long corridor.
    corners = np.array([[5.0, 5.9], [5.5, 5.9], [5.5, 7.1], [5.0, 7.1]])
    keep_out = KeepOut().with_area(corners, is_wall=False)
    GRID.save(stem, OccupancyGrid.from_patch(read_map(path)))
    EDITS.save(stem, MapEdits(keep_out))
    out = tmp_path / 'g.geojson'
    assert run(monkeypatch, path, '-o', out) == 0
    printed = capsys.readouterr().out
    assert 'connected parts: 2, ' in printed
    assert 'keep-out areas: 1' in printed
    EDITS.file(stem).unlink()
    assert run(monkeypatch, path, '-o', out) == 0
    printed = capsys.readouterr().out
    assert 'connected parts: 1' in printed
    assert 'keep-out' not in printed


def told(
    path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *words: object,
) -> tuple[str, list[str]]:
    """What a run prints, and its warnings on the graph."""
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, path, *words) == 0
    printed = capsys.readouterr()
    lines = printed.err.splitlines()
    return printed.out, [line for line in lines if line.startswith('map_to_graph: warning: ')]


def test_small_parts_are_left_out_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    grey = np.zeros((120, 120), dtype=np.uint8)
    grey[5:105, 5:105] = 254
    grey[40:60, 40:60] = 0
    grey[44:56, 44:56] = 254  # the inside of a cupboard
    path = written(tmp_path, grey)
    out, warnings = told(path, tmp_path, monkeypatch, capsys)
    assert 'connected parts: 1, ' in out
    assert out.endswith(', small parts left out: 1 (0.6 m2)\n')
    assert not warnings


def test_parts_without_a_route_between_them_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    grey = np.zeros((60, 120), dtype=np.uint8)
    grey[5:55, 5:55] = grey[5:55, 65:115] = 254
    path = written(tmp_path, grey)
    out, (warning,) = told(path, tmp_path, monkeypatch, capsys)
    assert 'connected parts: 2, ' in out and 'left out' not in out
    assert f'{path}: 2 parts without a route between them (21.2, 21.2 m2): --start X,Y' in warning
    out, warnings = told(path, tmp_path, monkeypatch, capsys, '--start=2,5')
    assert 'connected parts: 1, ' in out
    assert not warnings


def room_of_walls(grey_of_walls: int) -> np.ndarray:
    """A corridor and two rooms in the unknown."""
    grey = np.full((130, 160), 205, dtype=np.uint8)
    grey[35:95, 35:125] = grey_of_walls
    grey[37:60, 37:78] = grey[37:60, 80:123] = grey[62:93, 37:123] = 254
    grey[60:62, 52:62] = grey[60:62, 95:105] = 254
    return grey


@pytest.mark.parametrize(
    ('walls', 'speck_share', 'words', 'said'),
    [
        (0, 0.0, (), None),
        (205, 0.0, (), 'as rays through glass do; --detail-m 0 keeps them'),
        (205, 0.0, ('--detail-m', 0), None),
        (0, 0.05, (), 'nearer than that to unknown cells; --max-unknown-gap-m closes gaps'),
        (0, 0.05, ('--max-unknown-gap-m', 0.2), None),
    ],
)
def test_a_graph_that_covers_little_of_the_floor_says_why(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    walls: int,
    speck_share: float,
    words: tuple[object, ...],
    said: str | None,
) -> None:
    grey = room_of_walls(walls)
    grey[(np.random.default_rng(3).random(grey.shape) < speck_share) & (grey == 254)] = 205
    path = written(tmp_path, grey)
    _, warnings = told(path, tmp_path, monkeypatch, capsys, *words)
    found = [line for line in warnings if 'the graph covers' in line]
    assert len(found) == (said is not None)
    assert all(said in line and str(path) in line for line in found if said)


@pytest.mark.parametrize(
    ('name', 'nodes', 'parts'),
    [
        ('marrtino_r3d/maps/garage', 10, 1),
        ('marrtino_r3d/maps/casa', 6, 3),
        ('ecn_house', 15, 6),
        ('kobuki_lab', 10, 2),
        ('elsabot_4wd/maps/upstairs', 10, 1),
    ],
)
def test_graphs_of_homes(
    shared_data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
    nodes: int,
    parts: int,
) -> None:
    """Walls that a cheap laser drew, and furniture in whose insides a robot would fit."""
    path = shared_data / 'maps' / 'homes' / f'{name}.yaml'
    _, told_of_all = told(path, tmp_path, monkeypatch, capsys, '-o', tmp_path / 'g.graphml')
    warnings = [line for line in told_of_all if 'cells of grey' not in line]
    graph = networkx.read_graphml(tmp_path / 'g.graphml')
    assert len(graph) >= nodes
    assert networkx.number_connected_components(graph) == parts
    assert [line for line in warnings if 'parts without' not in line] == []
    assert len(warnings) == (parts > 1)
