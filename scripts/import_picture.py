"""Draws which package of thinmap_ros imports which, read from the source, as an SVG file.

    python scripts/import_picture.py [-o docs/images/imports.svg]

A package stands above all that it imports. Imports that a path of other arrows implies have no
arrow. The width of an arrow grows with the number of imports.
"""

import argparse
import ast
import math
from collections import Counter
from pathlib import Path

import matplotlib

matplotlib.use('svg')
from matplotlib import pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'thinmap_ros'
_CORE_COLOUR = '#cfe3f5'
_OTHER_COLOUR = '#f3ead6'


def room_of(module: str) -> str:
    """Package of a dotted module below thinmap_ros: `core.grid`, `core`, `nodes`, `pipeline`."""
    parts = module.split('.')
    if parts[0] == 'core' and len(parts) > 1 and (PACKAGE / 'core' / parts[1]).is_dir():
        return f'core.{parts[1]}'
    return parts[0]


def imports_between_rooms() -> Counter[tuple[str, str]]:
    """Number of import statements from one package to another."""
    found: Counter[tuple[str, str]] = Counter()
    for path in PACKAGE.rglob('*.py'):
        room = room_of('.'.join(path.relative_to(PACKAGE).with_suffix('').parts))
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or '').startswith('thinmap_ros'):
                base = (node.module or '').removeprefix('thinmap_ros').removeprefix('.')
                for alias in node.names:
                    other = room_of(f'{base}.{alias.name}'.removeprefix('.'))
                    if other != room and not room.startswith('__'):
                        found[room, other] += 1
    return found


def levels_of(edges: Counter[tuple[str, str]]) -> dict[str, int]:
    """Level of each package: one above the highest that it imports."""
    rooms = {room for edge in edges for room in edge if not room.startswith('__')}
    levels: dict[str, int] = {}
    while len(levels) < len(rooms):
        ready = {
            room: 1 + max((levels[b] for a, b in edges if a == room and b in levels), default=-1)
            for room in rooms - set(levels)
            if all(b in levels or b.startswith('__') for a, b in edges if a == room)
        }
        if not ready:
            raise SystemExit(f'import cycle among {", ".join(sorted(rooms - set(levels)))}')
        levels |= ready
    return levels


def without_implied(edges: Counter[tuple[str, str]]) -> Counter[tuple[str, str]]:
    """Edges but those between packages that a path of other edges connects."""

    def reachable(room: str) -> set[str]:
        below = {b for a, b in edges if a == room}
        return below.union(*(reachable(b) for b in below))

    return Counter(
        {
            (a, b): count
            for (a, b), count in edges.items()
            if not any(b in reachable(c) for d, c in edges if d == a and c != b)
        }
    )


def draw(path: Path) -> None:
    """Write the picture."""
    edges = imports_between_rooms()
    levels = levels_of(edges)
    rows: dict[int, list[str]] = {}
    for room in sorted(levels):
        rows.setdefault(levels[room], []).append(room)
    place = {
        room: ((column + 0.5) / len(row), level)
        for level, row in rows.items()
        for column, room in enumerate(row)
    }
    figure, axes = plt.subplots(figsize=(8.0, 0.8 * len(rows) + 0.5))
    for (a, b), count in sorted(without_implied(edges).items()):
        if a in place and b in place:
            style = {'arrowstyle': '->', 'lw': 0.4 + 0.5 * math.log2(1 + count), 'color': '#7a8794'}
            x_a, y_a = place[a]
            x_b, y_b = place[b]
            ends = ((x_b, y_b + 0.19), (x_a, y_a - 0.19))
            axes.annotate('', *ends, arrowprops=style | {'shrinkA': 0, 'shrinkB': 0})
    for room, (x, y) in place.items():
        colour = _CORE_COLOUR if room.startswith('core') else _OTHER_COLOUR
        box = {'boxstyle': 'round,pad=0.4', 'facecolor': colour, 'edgecolor': '#55606b'}
        axes.text(x, y, room, ha='center', va='center', fontsize=9, bbox=box)
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.axis('off')
    figure.tight_layout()
    plt.rcParams['svg.hashsalt'] = 'thinmap'
    figure.savefig(path, metadata={'Date': None})


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('-o', '--out', type=Path, default=ROOT / 'docs' / 'images' / 'imports.svg')
    draw(parser.parse_args().out)
