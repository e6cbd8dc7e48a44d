"""Pieces of map that are recorded, and the pairs of them that are measured."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.places.make import HALVES, make_exploration, make_halves
from benchmarks.places.recorded import RecordedPiece

LOGS = ('fhw', 'intel_raw', 'aces_raw', 'csail_raw')
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
_EXPLORATION_S = 500.0
_NEAR_M = 2.0
_APART_M = 8.0  # range of the simulated laser
_MIN_SHARED = 30  # keyframes: 20 m of path, which recognition needs
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
    """Ordered pairs that share enough ground."""
    return [pair for pair in _ordered(pieces) if is_shared(*pair)]


def without_shared_ground(pieces: Iterable[RecordedPiece]) -> Pairs:
    """Ordered pairs of two buildings, or of two parts of one that are not in sight."""
    return [pair for pair in _ordered(pieces) if not _count_near(*pair, _APART_M)]


def is_shared(known: RecordedPiece, query: RecordedPiece) -> bool:
    """Whether two pieces share enough ground, by the truth."""
    return _count_near(known, query, _NEAR_M) >= _MIN_SHARED


def _count_near(known: RecordedPiece, query: RecordedPiece, near_m: float) -> int:
    """Keyframes of the query that are near one of the known piece, by the truth."""
    if known.building != query.building:
        return 0
    places = [piece.truth[~np.isnan(piece.truth[:, 0]), :2] for piece in (known, query)]
    away, _ = cKDTree(places[0]).query(places[1])
    return int(np.count_nonzero(away < near_m))


def _ordered(pieces: Iterable[RecordedPiece]) -> Pairs:
    known = list(pieces)
    return [(one, other) for one in known for other in known if one is not other]
