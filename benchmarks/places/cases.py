"""Pieces of map that are recorded, and the pairs of them that are measured."""

from collections.abc import Iterable
from pathlib import Path

from benchmarks.places.make import HALVES, make_exploration, make_halves
from benchmarks.places.recorded import RecordedPiece

LOGS = ('fhw', 'intel_raw', 'aces_raw', 'csail_raw')
# Two starts of a building share ground, but those that APART names.
EXPLORATIONS = (
    ('kth/50052748', 0),
    ('kth/50052748', 1),
    ('kth/50052748', 9),
    ('kth/50052751', 0),
    ('kth/50052751', 1),
    ('kth/50052749', 0),
    ('kth/50052749', 1),
    ('kth/50037764_PLAN1', 0),
    ('kth/50037764_PLAN1', 6),
    ('dungeon/d1115', 0),
    ('dungeon/d1115', 1),
    ('dungeon/d114', 0),
    ('dungeon/d1305', 0),
    ('dungeon/d1336', 0),
    ('dungeon/d1407', 0),
)
APART = {
    ('kth_50052748.s0', 'kth_50052748.s9'),
    ('kth_50052748.s1', 'kth_50052748.s9'),
    ('kth_50037764_PLAN1.s0', 'kth_50037764_PLAN1.s6'),
}
_EXPLORATION_S = 500.0
Pairs = list[tuple[RecordedPiece, RecordedPiece]]


def recorded(folder: Path, data: Path, count: int | None) -> list[RecordedPiece]:
    """All pieces, made where a folder does not have them; count: of logs and of explorations."""
    for name in LOGS[:count]:
        make_halves(data / 'logs', name, folder)
    for name, start in EXPLORATIONS[:count]:
        make_exploration(data / 'worlds', name, start, folder, _EXPLORATION_S)
    names = [f'{name}.{half}' for name in LOGS[:count] for half in HALVES]
    names += [f'{name.replace("/", "_")}.s{start}' for name, start in EXPLORATIONS[:count]]
    return [RecordedPiece.load(folder, name) for name in names]


def with_shared_ground(pieces: Iterable[RecordedPiece]) -> Pairs:
    """Ordered pairs of one building that share ground."""
    return [pair for pair in _ordered(pieces) if is_shared(*pair)]


def without_shared_ground(pieces: Iterable[RecordedPiece]) -> Pairs:
    """Ordered pairs of two buildings, or of two parts of one."""
    return [pair for pair in _ordered(pieces) if not is_shared(*pair)]


def is_shared(known: RecordedPiece, query: RecordedPiece) -> bool:
    """Whether two pieces share ground."""
    names = (min(known.name, query.name), max(known.name, query.name))
    return known.building == query.building and names not in APART


def _ordered(pieces: Iterable[RecordedPiece]) -> Pairs:
    known = list(pieces)
    return [(one, other) for one in known for other in known if one is not other]
