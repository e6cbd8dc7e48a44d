"""Damaged files of all kinds: logs, maps, worlds, trajectories."""

import gzip
import io
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from fuzz.cases import NUMBERS, Source, chosen, damaged_bytes, damaged_text, finite, nothing, tried
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap
from thinmap_ros.files.occupancy_maps import read_map
from thinmap_ros.files.trajectories import read_tum, write_tum
from thinmap_ros.files.worlds import read_tour, read_world
from thinmap_ros.logs.log import LaserOptions, OdometryEvent
from thinmap_ros.logs.readers.carmen import CarmenLog

WORLDS = Path(__file__).resolve().parents[2] / 'worlds'
_MAX_WORLD = 4_000


def write(rng: np.random.Generator, path: Path, text: str) -> Path:
    """A damaged text, sometimes damaged again as bytes."""
    content = damaged_text(rng, text).encode('utf-8', 'surrogatepass')
    path.write_bytes(damaged_bytes(rng, content) if rng.random() < 0.3 else content)
    return path


def carmen_text(rng: np.random.Generator) -> str:
    """A log of up to 20 lines of each kind."""
    lines = ['# a log']
    for k in range(int(rng.integers(1, 20))):
        count = int(chosen(rng, (1, 3, 180, 181, 361)))
        ranges = ' '.join(f'{r:.2f}' for r in rng.uniform(0.0, 90.0, count))
        place = ' '.join(f'{v:.3f}' for v in rng.uniform(-5.0, 5.0, 3))
        stamp = 976052857.0 + 0.2 * k
        tail = f'{stamp:.6f} host {0.2 * k:.3f}'
        lines += [
            f'ODOM {place} 0.1 0.2 0.0 {tail}',
            f'FLASER {count} {ranges} {place} {place} {tail}',
            f'ROBOTLASER1 0 -1.57 3.14 0.0175 30.0 0.01 0 {count} {ranges} 2 7 8 '
            f'{place} {place} 0.1 0.2 0.3 0.4 0.5 {tail}',
        ]
    return '\n'.join(lines) + '\n'


def _laser_options(rng: np.random.Generator) -> LaserOptions | None:
    values = {}
    if rng.random() < 0.3:
        values['step_deg'] = float(rng.uniform(-12.0, 12.0))
        values['range_min_m'] = float(rng.uniform(-1.0, 11.0))
        values['range_max_m'] = float(rng.uniform(0.0, 100.0))
    options: LaserOptions | None = tried(lambda: LaserOptions(**values))
    return options


def read_carmen(shared: None, rng: np.random.Generator, folder: Path) -> None:
    path = write(rng, folder / 'log.clf', carmen_text(rng))
    if rng.random() < 0.3:
        packed = damaged_bytes(rng, gzip.compress(path.read_bytes(), 1))
        path = folder / 'log.clf.gz'
        path.write_bytes(packed)
    options = _laser_options(rng)
    if options is None:
        return
    log = CarmenLog(path, options)
    for event in tried(lambda: list(log.events())) or ():
        if isinstance(event, OdometryEvent):
            finite(event.T_odom_base)
            assert event.stamp_ns >= 0
        else:
            finite(event.scan.points_base(), event.scan.angles_rad)
            assert event.scan.ranges_m.size > 0


def _image(rng: np.random.Generator) -> tuple[str, bytes]:
    rows, cols = rng.integers(1, 40, 2)
    grey = rng.choice(np.array([0, 100, 205, 254, 255], dtype=np.uint8), (rows, cols))
    mode = chosen(rng, ('L', 'L', 'RGB', 'RGBA', '1', 'P', 'LA', 'I;16'))
    kind = chosen(rng, ('png', 'pgm', 'bmp', 'tiff')) if mode in ('L', 'RGB', '1') else 'png'
    kind = 'ppm' if (kind, mode) == ('pgm', 'RGB') else kind
    image = Image.fromarray(grey) if mode == 'I;16' else Image.fromarray(grey).convert(mode)
    stream = io.BytesIO()
    image.save(stream, format='PPM' if kind in ('pgm', 'ppm') else kind.upper())
    if kind == 'pgm' and rng.random() < 0.5:
        words = ' '.join(str(value) for value in grey.ravel())
        return kind, damaged_text(rng, f'P2\n# drawn\n{cols} {rows}\n255\n{words}\n').encode()
    return kind, stream.getvalue()


def strange_value(rng: np.random.Generator) -> Any:
    """A random YAML value."""
    return chosen(
        rng,
        (
            *(None, True, 0, -1, 1, 2**70, 10**400, 0.5, 1e300, float('nan'), float('inf')),
            *(
                '',
                'x',
                'm.png',
                '../m.png',
                '/etc/hostname',
                '/dev/zero',
                'trinary',
                'raw',
                'scale',
            ),
            *([], {}, [0], [0, 0, 0], [1e9, 1e9, 0], [[]], {'a': 1}, [[0, 0], [1, 1]]),
            *(list(NUMBERS[:3]), [float('nan')] * 3, [0.0, 0.0, 0.5]),
        ),
    )


def described_map(rng: np.random.Generator, folder: Path) -> Path:
    """A map_server map with a damaged description or image."""
    kind, image = _image(rng)
    (folder / f'm.{kind}').write_bytes(damaged_bytes(rng, image))
    content: dict[str, Any] = {
        'image': f'm.{kind}',
        'resolution': float(rng.uniform(0.01, 0.5)),
        'origin': [float(v) for v in (*rng.uniform(-50.0, 50.0, 2), 0.0)],
        'negate': int(rng.integers(2)),
        'occupied_thresh': 0.65,
        'free_thresh': 0.196,
        'mode': str(chosen(rng, ('trinary', 'scale', 'raw'))),
        'start': [1.0, 1.0, 0.0],
    }
    for _ in range(int(rng.integers(0, 3))):
        content[chosen(rng, list(content))] = strange_value(rng)
    if rng.random() < 0.2:
        del content[chosen(rng, list(content))]
    text = yaml.safe_dump(content, allow_unicode=True)
    path = folder / 'm.yaml'
    if rng.random() < 0.5:
        path.write_text(text)
        return path
    return write(rng, path, text)


def sound_patch(patch: GridPatch) -> None:
    """Raise AssertionError unless a map is valid."""
    finite(patch.frame.as_array())
    assert patch.frame.resolution > 0.0
    assert patch.cells.ndim == 2
    assert patch.cells.size == 0 or -1 <= patch.cells.min() <= patch.cells.max() <= 100


def read_any_map(shared: None, rng: np.random.Generator, folder: Path) -> None:
    path = described_map(rng, folder)
    patch = tried(lambda: read_map(path, folder if rng.random() < 0.5 else None))
    if patch is not None:
        sound_patch(patch)
    _read_as_world(path)


def _read_as_world(path: Path) -> None:
    world = tried(lambda: read_world(path))
    if world is not None:
        sound_patch(world[1])
        assert np.isfinite(world[2]).all() or np.isnan(world[2][:2]).all()
    tour = tried(lambda: read_tour(path))
    if tour is not None:
        finite(tour)


def world_texts(folder: Path) -> list[str]:
    texts = [path.read_text() for path in sorted(WORLDS.glob('*.yaml'))]
    return [text for text in texts if len(text) < _MAX_WORLD]


def read_any_world(shared: list[str], rng: np.random.Generator, folder: Path) -> None:
    text = chosen(rng, shared)
    if rng.random() < 0.5:
        content = yaml.safe_load(text)
        content[chosen(rng, list(content))] = strange_value(rng)
        text = yaml.safe_dump(content)
    _read_as_world(write(rng, folder / 'w.yaml', text))


def small_graph() -> TopologicalMap:
    """Three nodes and two edges, one of them from a node to itself."""
    kinds = (NodeKind.END, NodeKind.BRANCH, NodeKind.CORNER)
    nodes = [Node(i + 1, kind, 1.0 * i, 0.5, 0.4) for i, kind in enumerate(kinds)]
    path = np.array([[0.0, 0.5], [0.5, 0.6], [1.0, 0.5]])
    ring = np.array([[1.0, 0.5], [2.0, 2.0], [1.0, 0.5]])
    return TopologicalMap(nodes, [Edge(4, 1, 2, path, 1.1, 0.3), Edge(5, 2, 2, ring, 3.6, 0.2)])


def sound_graph(graph: TopologicalMap) -> None:
    """Raise AssertionError unless a graph is valid."""
    for node in graph.nodes.values():
        finite([node.x, node.y, node.clearance_m])
    for edge in graph.edges.values():
        finite(edge.path, [edge.length_m, edge.clearance_m])
        assert {edge.a, edge.b} <= graph.nodes.keys()


def read_trajectory(shared: None, rng: np.random.Generator, folder: Path) -> None:
    poses = rng.uniform(-9.0, 9.0, (int(rng.integers(1, 9)), 3))
    stamps = [10**18 + 10**8 * k for k in range(len(poses))]
    write_tum(folder / 'a.tum', stamps, list(poses))
    path = write(rng, folder / 'b.tum', (folder / 'a.tum').read_text())
    read = tried(lambda: read_tum(path))
    if read is not None:
        finite(read[1])


SOURCES = (
    Source('carmen', nothing, read_carmen),
    Source('map', nothing, read_any_map),
    Source('world', world_texts, read_any_world),
    Source('trajectory', nothing, read_trajectory),
)
