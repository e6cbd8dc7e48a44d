"""How much the nodes contribute: candidates of views from nodes, pairs of nodes, or random places.

The question of the topological map paper, whose global localization samples poses at nodes.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.places.pieces import RecordedPiece, true_pose, with_shared_ground
from thinmap_ros.baselines.voronoi import build_voronoi
from thinmap_ros.core.places.piece import Landmarks, MapPiece, are_same, landmarks_of
from thinmap_ros.core.places.views import View
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.evaluation.outcome import Table

_HEADINGS = 36
_SHOWN = 0.7  # share of the walls of a view that a map shows at the true place
_KNOWN = 0.5  # and of which it tells
_NEAR_M = 3.0  # from a keyframe of the map
Generator = Callable[[View], Array]


@dataclass(eq=False)
class _Count:
    """Views whose place was the first one, and CPU time, s."""

    first: int = 0
    cpu_s: float = 0.0


def generators(pieces: list[RecordedPiece]) -> Table:
    """Share of views whose place is the best candidate after refinement, and ms a view."""
    rows: list[list[Any]] = []
    for known, query in with_shared_ground(pieces):
        if known.name < query.name:
            rows += _rows(known, query)
    return Table('generators', ('pair', 'candidates', 'views', 'share', 'ms'), rows, timed=True)


def _rows(known: RecordedPiece, query: RecordedPiece) -> Iterator[list[Any]]:
    there = MapPiece(known.frames, known.patch, known.graph)
    own = MapPiece(query.frames, query.patch, query.graph)
    counts: dict[str, _Count] = {}
    views = list(_views_in_map(known, query, there, own))
    for name, generate in _generators(there, own).items():
        count = counts.setdefault(name, _Count())
        for view, T in views:
            began = time.process_time()
            candidates = generate(view)
            best = _refined(there, view, candidates)
            count.cpu_s += time.process_time() - began
            count.first += best is not None and bool(are_same(best[None], T)[0])
    for name, count in counts.items():
        shown = max(len(views), 1)
        yield [
            f'{known.name} <- {query.name}',
            name,
            len(views),
            count.first / shown,
            1e3 * count.cpu_s / shown,
        ]


def _generators(there: MapPiece, own: MapPiece) -> dict[str, Generator]:
    voronoi = build_voronoi(there.patch)
    own_voronoi = landmarks_of(build_voronoi(own.patch))
    nodes = there.landmarks.xy
    places = there.field.random_poses(len(nodes), np.random.default_rng(0))[:, :2]
    none = Landmarks(np.empty((0, 2)), np.empty(0))
    return {
        'pairs of branch nodes': lambda view: there.index.candidates(own.landmarks.around(view)),
        'branch nodes, thinning': _at(nodes, own.landmarks),
        'branch nodes, Voronoi': _at(landmarks_of(voronoi).xy, own_voronoi),
        'random places, as many as nodes': _at(places, none),
    }


def _at(places: Array, own: Landmarks) -> Generator:
    """Poses in which the landmark nearest to a view, or the view itself, is at a place (N, 2)."""

    def generate(view: View) -> Array:
        near = own.around(view).xy
        at = near[int(np.hypot(*near.T).argmin())] if len(near) else np.zeros(2)
        turns = np.linspace(0.0, 2.0 * math.pi, _HEADINGS, endpoint=False)
        cos = np.cos(turns)
        sin = np.sin(turns)
        off = np.column_stack([cos * at[0] - sin * at[1], sin * at[0] + cos * at[1]])
        xy = (places[:, None, :] - off).reshape(-1, 2)
        return np.column_stack([xy, np.tile(wrap(turns), len(places))])

    return generate


def _refined(there: MapPiece, view: View, poses: Array) -> Array | None:
    """The best pose (3,) of candidates (N, 3)."""
    if not len(poses):
        return None
    rough, fits = there.field.refined_widely(view, poses)
    return there.field.refined(view, rough[int(fits.argmax())])[0]


def _views_in_map(
    known: RecordedPiece, query: RecordedPiece, there: MapPiece, own: MapPiece
) -> Iterator[tuple[View, Array]]:
    """Views that a map shows, with their true poses (3,) in it."""
    for view in own.views:
        T_true = query.truth[view.frames[1]]
        if np.isnan(T_true).any():
            continue
        T, away = true_pose(known, T_true)
        T, _, _ = there.field.refined(view, T)
        found, told = there.field.agreement(view, T)
        if away < _NEAR_M and found > _SHOWN and told > _KNOWN:
            yield view, T
